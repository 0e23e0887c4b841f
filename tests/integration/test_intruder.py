"""A program on the robot's network that is no coordinator: what it can do, with security and without.

That the attacks are real is shown by the positive controls of `tests/module_agent/transport/
test_credentials.py`: without `--secure` they succeed where nothing on the network tells who spoke.
"""

import resource
import time
from collections import deque
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from coordinator.live_robot.authority import make_credentials
from coordinator.recording.run_folder import SESSION, load_recording
from module_agent.model.errors import EXIT_FAILED, EXIT_USAGE
from module_agent.transport.credentials import COORDINATOR, OBSERVER, host_credentials, load_credentials
from module_agent.transport.transport import NoHub, Request
from module_agent.transport.zenoh_transport import ZenohConfig, ZenohTransport, open_zenoh
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.feedback_rows import unpack
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import Ack, Feedback, LeaseRequest, Setpoint, Status, Stop
from module_agent.wire.refusal import WireError
from sim.faults.intruder import HUGE, Intruder
from sim.faults.invariants import RESOLUTION_MM, SIGMAS
from sim.robot.robot_file import load_robot
from sim.scoring.score import score
from sim.world.truth import read_motion

ROBOT = "thesis_171_horizontal"
G_M_S2 = 9.81
GARBAGE = b"garbage"


@pytest.fixture
def secured(launcher, tmp_path) -> Any:
    """A launcher whose programs speak mutual TLS, and the folder of the keys."""
    robot = launcher(ROBOT)
    folder = tmp_path / "keys"
    make_credentials(folder, ROBOT, [*robot.config.serials, "INTRUDER"])
    robot.config = robot.config._replace(secure=folder)
    return robot, folder


def at(endpoint: str) -> tuple[str, ...]:
    return "--robot", ROBOT, "--listen", endpoint


def list_modules(programs, endpoint: str, folder: Path) -> Any:
    options = (*at(endpoint), "--secure", str(folder), "--expect", "2")
    return programs.run("coordinator.main", "list", *options)


def resident_mb(pid: int) -> float:
    """Return how much memory a process has."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return 1e-6 * pages * resource.getpagesize()


def start_hub(robot, programs, *options: str) -> Any:
    """Start a coordinator and wait for its hub, or a `list` that is faster is the hub until it has ended."""
    coordinator = robot.start_coordinator(list(options), quiet=True)
    programs.until(lambda: "discovering modules" in programs.words(coordinator), "a hub", coordinator)
    return coordinator


def leases(requests: list[Request]) -> list[LeaseRequest]:
    """Return the requests that are of the coordinator; what the intruders ask themselves is garbage."""
    read = []
    for request in requests:
        with suppress(WireError):
            read.append(decode(LeaseRequest, request.payload))
    return read


def attack(intruder, serial: str, status: Status, holder_ns: int, number: int) -> None:
    """Act in the holder's name with everything that is published, and speak in the module's name."""
    head = {
        "serial": serial,
        "boot": status.boot,
        "seq": 1_000_000 + number,
        "sender": status.holder,
        "token": status.token,
        "echo_ns": holder_ns,
    }
    aims = {"position_rad": 1.0, "velocity_rad_s": None, "effort_nm": None}
    for message, leaf in (
        (LeaseRequest.model_validate({**head, "action": "acquire"}), Leaf.LEASE),
        (LeaseRequest.model_validate({**head, "action": "release"}), Leaf.LEASE),
        (Setpoint.model_validate({**head, **aims}), Leaf.SETPOINT),
    ):
        at = key(ROBOT, serial, leaf)
        if leaf is Leaf.SETPOINT:
            intruder.transport.publish(at, encode(message))
        else:
            intruder.transport.query(at, encode(message), 0.5, lambda event: None, number)


def test_what_is_published_lets_nobody_act_in_the_holders_name(launcher, client, programs) -> None:
    """Without any security: the lease's secret is known to the holder and the module only.

    Nor does a program end of statuses of a module that cannot be, and of motions of 2^62 rows.
    """
    robot = launcher(ROBOT)
    robot.start_world()
    agents = robot.start_agents()
    coordinator = robot.start_coordinator(quiet=True)
    intruder = client(ROBOT)
    serial = robot.config.serials[0]
    poisoner = Intruder(intruder.transport, ROBOT, serial, 0, 1)
    intruder.motion(serial, "windowed_sine", 20, coordinator)
    numbers = count()

    def refused() -> bool:
        poisoner.poison()
        latest = intruder.statuses[serial][-1]
        # A busy machine may have held up the keep-alives: then there is nobody in whose name to act.
        if latest.holder is not None:
            attack(intruder, serial, latest, intruder.newest_ns[serial], next(numbers))
        return latest.refusals.get("unproven", 0) >= 80

    intruder.until(refused, "refusals", *agents)
    assert all(agent.process.poll() is None for agent in agents)
    code, text = programs.ended(coordinator)
    assert code == 0, text
    robot.stop()
    assert score(robot.config.out).topology_correct


def answer_stops(session: zenoh.Session, statuses: dict[str, list[Status]]) -> list[str]:
    """Answer every stop in the module's place, as a queryable that calls itself complete.

    Returns the serials of those that were answered.
    """
    answered: list[str] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            stop = decode(Stop, query.payload.to_bytes())
            latest = statuses[stop.serial][-1]
            ack = Ack(
                serial=stop.serial,
                boot=latest.boot,
                seq=1_000_000,
                re=stop.seq,
                accepted=True,
                reason="",
                detail="",
                t_ns=latest.t_ns,
                holder=None,
                lease_left_ns=0,
                token=0,
            )
            query.reply(query.key_expr, encode(ack))
            answered.append(stop.serial)

    session.declare_queryable(f"x5/{ROBOT}/*/stop", answer, complete=True)
    return answered


def test_a_stop_reaches_the_modules_past_one_who_answers_in_their_place(
    launcher, client, programs, endpoint, lasting_plan
) -> None:
    """Without any security: whose answer comes first is nobody's to say, but the motors are stopped."""
    robot = launcher(ROBOT)
    robot.start_world()
    agents = robot.start_agents()
    coordinator = robot.start_coordinator(["--plan", str(lasting_plan)], quiet=True)
    ear = client(ROBOT)
    ear.motion(robot.config.serials[0], "windowed_sine", 50, coordinator)
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    with zenoh.open(config) as impostor:
        answered = answer_stops(impostor, ear.statuses)
        programs.run("coordinator.main", "stop", *at(endpoint))
        code, said = programs.ended(coordinator)
    assert answered
    assert code == EXIT_FAILED
    assert "was stopped by" in said
    ear.close()
    witness = client(ROBOT, hub=True)
    witness.meet(robot.config.serials, *agents)
    for serial in robot.config.serials:
        assert witness.status(serial).state == "stopped"


class Forger:
    """Hears a module's feedback and publishes false rows next to it, in its name.

    They have the module's serial, boot, sequence, row numbers and times; encoder and gyroscope say the
    opposite of the truth, and the accelerometer twice g. Of two rows of one number the later is kept.
    """

    def __init__(self, transport: ZenohTransport, serial: str):
        self._transport, self._at = transport, key(ROBOT, serial, Leaf.FEEDBACK)
        self._true: deque[bytes] = deque(maxlen=1)
        self.forged: set[bytes] = set()
        transport.subscribe(self._at, lambda event: self._hear(event.payload))

    def _hear(self, payload: bytes) -> None:
        # A session hears itself as well.
        if payload not in self.forged and payload != GARBAGE:
            self._true.append(payload)

    def publish(self) -> None:
        """Publish what is made of the newest true message, once."""
        if not self._true:
            return
        true = decode(Feedback, self._true.pop(), MAX_MESSAGE_BYTES)
        rows = unpack(true).copy()
        for name in ("position_rad", "velocity_rad_s", "gyro_rad_s"):
            rows[name] *= -1.0
        rows["accel_m_s2"] = 2.0 * rows["accel_m_s2"][:, [1, 2, 0]]
        false = encode(true.model_copy(update={"rows": rows.tobytes()}))
        self.forged.add(false)
        self._transport.publish(self._at, false)


def recorded_forgeries(programs, session: Path, forgers: list[Forger]) -> int:
    """Return how many of the false messages are in a recording."""
    forged = set().union(*(forger.forged for forger in forgers))
    return sum(entry.payload in forged for entry in programs.entries(session))


def test_without_security_false_rows_become_those_of_the_module(launcher, client, programs) -> None:
    """The positive control of the next test: the rows are well formed, and the coordinator believes them."""
    robot = launcher(ROBOT)
    robot.start_world()
    robot.start_agents()
    coordinator = robot.start_coordinator(quiet=True)
    intruder = client(ROBOT)
    serial = robot.config.serials[0]
    forger = Forger(intruder.transport, serial)
    intruder.motion(serial, "rest", 20, coordinator)

    def has_forged() -> bool:
        forger.publish()
        return len(forger.forged) >= 30

    programs.until(has_forged, "feedback of the module", coordinator)
    robot.stop()
    session = robot.config.out / SESSION
    assert recorded_forgeries(programs, session, [forger]) >= 15
    recording = load_recording(session)
    assert recording.refused == {}
    log = recording.modules[serial].rows
    accel = np.linalg.norm(log.rows(log.first_row, log.end_row)["accel_m_s2"], axis=1)
    # The module hangs still before it moves, and after that it is slow: nothing but a lie shows twice g.
    assert np.sum(accel > 1.5 * G_M_S2) >= 15


def lie(module, status: bytes) -> None:
    """Publish as the module that one is, with a certificate: a motion without end, numbers out of range."""
    record = {"motion_id": 1, "pattern": {"kind": "rest", "duration_s": 1.0}, "outcome": "running"}
    rows = {"start_ns": 0, "start_row": 0, "end_row": HUGE, "origin_rad": 0.0}
    whole = {"start_ns": 0, "start_row": 0, "end_row": 90_000, "origin_rad": 0.0, "outcome": "done"}
    endless = {"motion": record | whole | {"end_row": None}}
    lies = {"motion": record | rows}, {"motion": record | whole}, endless, {"next_row": HUGE}, {"t_ns": -HUGE}
    estimate = msgpack.unpackb(status) | {"serial": "INTRUDER", "motion_ids": (), "moved": True, "note": ""}
    estimate |= {"rate_ratio": 1.0, "gravity_m_s2": (0.0, 0.0, 9.81), "circle": None, "regression": None}
    for joint in load_robot(ROBOT).serials:
        told = msgpack.packb(estimate | {"joint": joint})
        module.publish(key(ROBOT, "INTRUDER", Leaf.ESTIMATE), told)
    for leaf in (Leaf.STATUS, Leaf.MOTION):
        for wrong in lies:
            told = msgpack.unpackb(status) | {"serial": "INTRUDER"} | wrong
            module.publish(key(ROBOT, "INTRUDER", leaf), msgpack.packb(told))


def test_with_security_the_robot_identifies_itself_among_intruders(
    secured, programs, endpoint, plan, tmp_path
) -> None:
    """An observer and a hostile module with a certificate attack all the time; nothing of it arrives.

    What the module says as itself does arrive, and harms nobody. Others, without a certificate or with one of
    another authority, are not let in.
    """
    robot, folder = secured
    serial = robot.config.serials[0]
    robot.start_world()
    # Agents wait for the hub as long as it takes; the hub waits for them for ten seconds only.
    agents = robot.start_agents()
    # The session lasts until all who attack have come.
    longer = tmp_path / "longer.toml"
    longer.write_text(plan.read_text().replace("sine_centre_s = 1.4", "sine_centre_s = 6.0"))
    coordinator = start_hub(robot, programs, "--plan", str(longer))
    programs.until(
        lambda: list_modules(programs, endpoint, folder).returncode == 0, "the modules", coordinator
    )
    hostile = [
        open_zenoh(ZenohConfig(mode="client", connect=(endpoint,), connect_timeout_s=60.0, credentials=known))
        for known in (
            host_credentials(folder, ROBOT, ["INTRUDER"]),
            load_credentials(folder, ROBOT, [OBSERVER]),
        )
    ]
    forgers = [Forger(one, name) for one in hostile for name in robot.config.serials]
    make_credentials(tmp_path / "foreign", ROBOT, [*robot.config.serials])
    outsiders = (None, load_credentials(tmp_path / "foreign", ROBOT, [COORDINATOR]))
    answered: list[Request] = []
    heard: list[bytes] = []
    for one in hostile:
        one.serve(key(ROBOT, serial, Leaf.LEASE), lambda event: answered.append(event))
        one.subscribe(key(ROBOT, serial, Leaf.STATUS), lambda event: heard.append(event.payload))
    programs.until(lambda: heard, "a status", coordinator)
    for outsider in outsiders:
        config = ZenohConfig(mode="client", connect=(endpoint,), connect_timeout_s=1.5, credentials=outsider)
        with pytest.raises(NoHub):
            open_zenoh(config)
    turns = count()
    while coordinator.process.poll() is None:
        latest = heard[-1]
        for one in hostile:
            # Statuses and rows of the module as of another, replayed, and garbage on every key of the robot.
            for name in (serial, robot.config.serials[1], "GHOST"):
                one.publish(key(ROBOT, name, Leaf.STATUS), latest)
                one.publish(key(ROBOT, name, Leaf.FEEDBACK), GARBAGE)
            one.publish(f"x5/{ROBOT}/**", GARBAGE)
            one.query(key(ROBOT, serial, Leaf.LEASE), latest, 0.1, lambda event: None, 1)
        for forger in forgers:
            forger.publish()
        if next(turns) % 5 == 0:
            lie(hostile[0], heard[0])
        time.sleep(0.02)
    code, text = programs.ended(coordinator)
    for one in hostile:
        one.close()
    assert code == 0, text
    assert not leases(answered)
    for agent in agents:
        assert agent.process.poll() is None
        assert resident_mb(agent.process.pid) < 400.0
    robot.stop()
    result = score(robot.config.out)
    assert result.topology_correct
    # The claim of the result covers the true link of the robot's file, in spite of all.
    for link in result.links:
        assert abs(link.link_length_error_mm) < max(SIGMAS * link.link_length_sigma_mm, RESOLUTION_MM)
    assert all(len(forger.forged) >= 100 for forger in forgers)
    assert recorded_forgeries(programs, robot.config.out / SESSION, forgers) == 0
    recorded = programs.entries(robot.config.out / SESSION)
    assert not [entry for entry in recorded if entry.payload == GARBAGE or "GHOST" in entry.topic]


def test_anyone_of_the_fleet_stops_the_robot_and_nobody_else(
    secured, programs, endpoint, client, lasting_plan
) -> None:
    robot, folder = secured
    serial = robot.config.serials[0]
    robot.start_world()
    robot.start_agents()
    coordinator = start_hub(robot, programs, "--plan", str(lasting_plan))
    observer = folder.parent / "observer"
    observer.mkdir()
    for name in ("fleet.toml", "authority.pem", "observer.pem", "observer.key"):
        (observer / name).write_bytes((folder / name).read_bytes())
    programs.until(
        lambda: list_modules(programs, endpoint, observer).returncode == 0, "the modules", coordinator
    )
    without = programs.run("coordinator.main", "stop", "--robot", ROBOT, "--connect", endpoint)
    assert without.returncode == EXIT_USAGE
    assert "--secure" in without.stderr
    assert coordinator.process.poll() is None
    stopped = programs.run("coordinator.main", "stop", *at(endpoint), "--secure", str(observer))
    assert stopped.returncode == 0, stopped.stderr
    code, text = programs.ended(coordinator)
    assert code != 0
    assert "stop" in text
    robot.stop()
    truth = read_motion(robot.config.out / "truth.npz")
    index = truth.serials.index(serial)
    assert np.ptp(truth.q_rad[-100:, index]) < 0.05
