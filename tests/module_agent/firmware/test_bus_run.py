"""Many ticks on the bus in one compiled call are those that the Python objects run, to the bit."""

import socket
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from module_agent.control.safety import UNCONFIGURED, Safety
from module_agent.firmware import bus_run
from module_agent.firmware.bus_run import BusRun
from module_agent.firmware.firmware import Incoming, Outgoing
from module_agent.firmware.quiet_ticks import QuietTicks
from module_agent.hardware.bus_client import BusClient
from module_agent.hardware.bus_frames import MAX_HANDSHAKE_BYTES, TickFrames, Welcome, pack_welcome
from module_agent.hardware.hardware import HardwareLost, Readings, SensorSample
from module_agent.hardware.loop_inside import LoopInside
from module_agent.host import AgentHost, InlineWorker
from module_agent.wire.keys import Leaf
from tests.module_agent.firmware.test_quiet_ticks import ROBOT, SERIALS, STEPS, Agent, Life, Scripted

FRAMES = TickFrames.of(len(SERIALS))
# Packets that a Unix socket holds that are not read, on every system.
WAITING = 8


class Bus:
    """The world's end of a bus, which sends what the test says, several ticks ahead."""

    def __init__(self, path: str):
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(path)
        self._listener.listen()
        self.answers: list[list[float]] = []
        self.tick = 0

    def welcome(self) -> None:
        self._agent, _ = self._listener.accept()
        self._agent.recv(MAX_HANDSHAKE_BYTES)
        self._agent.send(pack_welcome(Welcome(0, Scripted().modules)))

    def send(self, samples: list[SensorSample]) -> None:
        self.tick += 1
        self._agent.send(FRAMES.pack_samples(self.tick, Readings.of(samples), range(len(samples))))

    def read(self) -> None:
        while True:
            try:
                frame = self._agent.recv(FRAMES.pwm.size + 1, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            tick, pwm = FRAMES.unpack_pwm(frame)
            assert tick == len(self.answers)
            self.answers.append(list(pwm))

    def close(self) -> None:
        self._agent.close()
        self._listener.close()


class OnBus(Agent):
    """The agent of the tests of quiet ticks, on a bus: its ticks wait there until a message comes."""

    def __init__(self, bus: Bus, path: str, expiry: str, safety: Sequence[Safety]):
        super().__init__(True, 3, expiry, 250.0, safety)
        self.bus = bus
        hello = threading.Thread(target=bus.welcome)
        hello.start()
        client = BusClient(path, SERIALS)
        hello.join()
        # What has not come yet is not waited for.
        client._socket.setblocking(False)
        self._state = client.kernel_state[-1]
        loops = LoopInside(client, dict(zip(SERIALS, safety, strict=True)))
        self.network.sent = []
        configs = [module.firmware.config for module in self.host.modules]
        self.host = AgentHost(ROBOT, loops, self.network, configs, InlineWorker())
        tell = self.network.tell

        def tell_in_time(serial: str, leaf: Leaf, payload: bytes) -> None:
            self.catch_up()
            tell(serial, leaf, payload)

        self.network.tell = tell_in_time  # type: ignore[method-assign]

    def tick(self, samples: list[SensorSample]) -> None:
        self.bus.send(samples)
        if self.bus.tick % WAITING == 0:
            self.catch_up()

    @property
    def tick_now(self) -> int:
        return int(self._state[0])

    def catch_up(self) -> None:
        while self.tick_now < self.bus.tick:
            self.host.cycle()
        self.bus.read()


LIMITS = (
    Safety(position_rad=(-0.5, 0.02), at_limit=("hold", "spring"), current_a=0.1),
    Safety(position_rad=(-0.05, 0.4), at_limit="motor_off", effort_nm=0.2),
    UNCONFIGURED,
)


@pytest.mark.parametrize("safety", [LIMITS, (UNCONFIGURED,) * 3], ids=["limits", "no limits"])
@pytest.mark.parametrize("expiry", ["motor_off", "hold", "damping"])
def test_a_life_on_the_bus_is_that_of_the_objects(
    tmp_path: Path, expiry: str, safety: tuple[Safety, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []
    run = BusRun.run

    def counted(self: BusRun, busy: list[int], most: int) -> list[int]:
        calls.append(most)
        return run(self, busy, most)

    monkeypatch.setattr(bus_run.BusRun, "run", counted)
    plain, bus = Agent(False, 3, expiry, 250.0, safety), Bus(path := str(tmp_path / "bus"))
    agent = OnBus(bus, path, expiry, safety)
    life = Life([plain, agent], 3)
    life.ticks(3)
    for k in range(3):
        life.act(("acquire", k))
    for action in STEPS:
        life.act(action)
    agent.catch_up()
    assert repr(bus.answers[: bus.tick]) == repr(plain.wires.pwm)
    assert repr(agent.everything[1:]) == repr(plain.everything[1:])
    assert [module.now_ns for module in agent.host.modules] == [
        module.now_ns for module in plain.host.modules
    ]
    if safety is not LIMITS:
        # A module at its limit is not quiet; all others run several ticks a call, at most as many as wait.
        assert len(calls) < 0.7 * bus.tick
    bus.close()
    with pytest.raises(HardwareLost):
        agent.host.cycle()
    agent.host.close()


def test_what_arrives_ends_a_run_of_ticks_at_once(tmp_path: Path) -> None:
    bus = Bus(path := str(tmp_path / "bus"))
    agent = OnBus(bus, path, "hold", (UNCONFIGURED,) * 3)
    life = Life([agent], 3)
    # The first ticks of an agent need its objects.
    life.ticks(WAITING)
    life.ticks(WAITING - 1)
    behind = bus.tick - agent.tick_now
    agent.host.bell[0] = 1
    assert agent.host._bus_run is not None
    agent.host._bus_run.run([], 32)
    assert bus.tick - agent.tick_now == behind - 1
    # The tick is answered all the same.
    bus.read()
    assert len(bus.answers) == agent.tick_now + 1
    agent.host.bell[0] = 0
    agent.host._bus_run.run([], 32)
    assert bus.tick - agent.tick_now < behind - 2
    bus.close()
    agent.host.close()


def test_a_tick_is_answered_before_the_renewals_that_came_for_it_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = Bus(path := str(tmp_path / "bus"))
    agent = OnBus(bus, path, "hold", (UNCONFIGURED,) * 3)
    life = Life([agent], 3)
    life.ticks(3)
    life.act(("acquire", 0))
    life.ticks(3)
    agent.catch_up()
    unanswered, read_renewals = list[int](), QuietTicks.read_renewals

    def noted(self: QuietTicks, place: int, renewals: Sequence[Incoming]) -> list[Outgoing]:
        bus.read()
        unanswered.append(agent.tick_now + 1 - len(bus.answers))
        return read_renewals(self, place, renewals)

    monkeypatch.setattr(QuietTicks, "read_renewals", noted)
    life.act(("renew", 0))
    agent.catch_up()
    assert unanswered == [0]
    bus.close()
    agent.host.close()
