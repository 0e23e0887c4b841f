"""A program on the robot's network that is no coordinator: what it can do, with security and without.

That the attacks are real is shown by the positive controls of `tests/module_agent/transport/
test_credentials.py`: without `--secure` they succeed where nothing on the network tells who spoke.
"""

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.live_robot.authority import make_credentials
from module_agent.model.errors import EXIT_USAGE
from module_agent.transport.credentials import OBSERVER, host_credentials, load_credentials
from module_agent.transport.transport import Request
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import LeaseRequest, Setpoint, Status
from module_agent.wire.refusal import WireError
from sim.scoring.score import score
from sim.world.truth import read_motion

ROBOT = "thesis_171_horizontal"


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


def start_hub(robot, programs) -> Any:
    """Start a coordinator and wait for its hub, or a `list` that is faster is the hub until it has ended."""
    coordinator = robot.start_coordinator(quiet=True)
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
    """Without any security: the lease's secret is known to the holder and the module only."""
    robot = launcher(ROBOT)
    robot.start_world()
    coordinator = robot.start_coordinator(quiet=True)
    agents = robot.start_agents()
    intruder = client(ROBOT)
    serial = robot.config.serials[0]
    intruder.motion(serial, "windowed_sine", 20, coordinator)
    for number in range(40):
        intruder.pump()
        attack(intruder, serial, intruder.statuses[serial][-1], intruder.newest_ns[serial], number)
    refused = intruder.until(
        lambda: intruder.statuses[serial][-1].refusals.get("unproven", 0) >= 80, "refusals", *agents
    )
    assert refused
    code, text = programs.ended(coordinator)
    assert code == 0, text
    robot.stop()
    assert score(robot.config.out).topology_correct


def test_with_security_the_robot_identifies_itself_among_intruders(secured, programs, endpoint) -> None:
    """An observer and a hostile module with a certificate attack all the time; nothing of it arrives."""
    robot, folder = secured
    serial = robot.config.serials[0]
    robot.start_world()
    coordinator = start_hub(robot, programs)
    robot.start_agents()
    listed = list_modules(programs, endpoint, folder)
    assert listed.returncode == 0, listed.stderr
    hostile = [
        open_zenoh(ZenohConfig(mode="client", connect=(endpoint,), connect_timeout_s=60.0, credentials=known))
        for known in (
            host_credentials(folder, ROBOT, ["INTRUDER"]),
            load_credentials(folder, ROBOT, [OBSERVER]),
        )
    ]
    answered: list[Request] = []
    heard: list[bytes] = []
    for one in hostile:
        one.serve(key(ROBOT, serial, Leaf.LEASE), lambda event: answered.append(event))
        one.subscribe(key(ROBOT, serial, Leaf.STATUS), lambda event: heard.append(event.payload))
    programs.until(lambda: heard, "a status", coordinator)
    while coordinator.process.poll() is None:
        latest = heard[-1]
        for one in hostile:
            # Statuses and rows of the module as of another, replayed, and garbage on every key of the robot.
            for name in (serial, robot.config.serials[1], "GHOST"):
                one.publish(key(ROBOT, name, Leaf.STATUS), latest)
                one.publish(key(ROBOT, name, Leaf.FEEDBACK), b"garbage")
            one.publish(f"x5/{ROBOT}/**", b"garbage")
            one.query(key(ROBOT, serial, Leaf.LEASE), latest, 0.1, lambda event: None, 1)
        time.sleep(0.02)
    code, text = programs.ended(coordinator)
    for one in hostile:
        one.close()
    assert code == 0, text
    assert not leases(answered)
    robot.stop()
    result = score(robot.config.out)
    assert result.topology_correct
    recorded = programs.entries(robot.config.out / "session.mcap")
    assert not [entry for entry in recorded if entry.payload == b"garbage" or "GHOST" in entry.topic]


def test_anyone_of_the_fleet_stops_the_robot_and_nobody_else(secured, programs, endpoint, client) -> None:
    robot, folder = secured
    serial = robot.config.serials[0]
    robot.start_world()
    coordinator = start_hub(robot, programs)
    robot.start_agents()
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
