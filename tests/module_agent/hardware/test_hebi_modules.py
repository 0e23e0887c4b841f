"""The driver of real modules: what it makes of modules that are silent, stopped, or held by someone else."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from module_agent.control.controller import BRAKE, MOTOR_OFF, Command
from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.control.safety import Safety
from module_agent.firmware.config import config_of
from module_agent.firmware.firmware import Answer, Firmware, Incoming
from module_agent.hardware import hebi_library, hebi_network
from module_agent.hardware.hardware import (
    HardwareLost,
    LimitState,
    ModuleInformation,
    ModuleSample,
    SensorSample,
)
from module_agent.hardware.hebi_modules import FEEDBACK_TIMEOUT_MS, HELD_BY_OTHER, HebiModules
from module_agent.hardware.sample_check import MAX_HELD
from module_agent.model.catalogue import module_type
from module_agent.model.errors import UsageError
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ack, GainsCommand, GainSet, LeaseRequest, Message, Setpoint, Stop
from sim.hebi_stand_in import messages
from sim.hebi_stand_in.library import Group, StandIn
from sim.hebi_stand_in.modules import FAMILY, ModuleNetwork, NetworkModule
from sim.robot.robot_file import load_robot
from sim.world.world import World

NAN = math.nan
ROBOT = "thesis_171_vertical"
LAST = 1
TICKS = 4  # of the modules in one of the driver's: 250 Hz
FORWARD = Command(5.0, NAN, NAN)


class Bench:
    """Two simulated modules on HEBI's network, and the driver at 250 Hz."""

    def __init__(self) -> None:
        self.world = World(load_robot(ROBOT), seed=1, noise="ideal")
        self.network = ModuleNetwork(self.world.modules)
        self.module = self.network.all[LAST]
        self.library = StandIn(self.network)
        self.pwm = [0.0, 0.0]
        self.pass_ticks(1)
        self.group = self.library.Lookup().get_group_from_family(FAMILY)
        self.driver = self.open(self.group)

    def open(self, group: Any, ticks: int = TICKS) -> HebiModules:
        """Return a driver of the modules, the first or one of another program."""
        information = hebi_network.describe(self.library, group, 1000.0 / ticks)
        return HebiModules(self.library, group, information, lambda: self.pass_ticks(ticks) and None)

    def pass_ticks(self, count: int) -> list[float]:
        """Let time pass; return the last module's PWM in each tick."""
        pwm = []
        for _ in range(count):
            self.pwm = self.network.tick(self.world.exchange(self.pwm))
            pwm.append(self.pwm[LAST])
        return pwm

    def tick(self, command: Command = MOTOR_OFF) -> ModuleSample:
        """Run one tick of the driver; return the last module's sample."""
        sample = self.driver.receive()[LAST]
        self.driver.send([MOTOR_OFF, command])
        return sample

    def ticks(self, count: int, command: Command = MOTOR_OFF) -> list[ModuleSample]:
        return [self.tick(command) for _ in range(count)]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_times_are_those_of_the_modules_and_the_imu_is_as_old_as_its_values(bench: Bench) -> None:
    """The driver asks at 1 kHz, the IMU reads at 250 Hz: the first feedback with new values dates them."""
    bench.driver = bench.open(bench.group, ticks=1)
    bench.ticks(10, FORWARD)
    for _ in range(40):
        sensors = bench.tick(FORWARD).sensors
        assert (sensors.t_ns, sensors.imu_t_ns) == bench.world.readings[LAST][:2]


def test_a_motor_that_no_driver_commands_any_more_is_off_after_hebis_lifetime(bench: Bench) -> None:
    bench.driver.set_lifetime(0, 100_000_000)
    bench.driver.set_lifetime(LAST, 60_000_000)
    bench.ticks(50, FORWARD)
    pwm = bench.pass_ticks(80)
    assert min(pwm[:59]) > 0.1
    assert max(pwm[62:]) == 0.0


@pytest.mark.parametrize(("lifetime_ns", "set_ms"), [(250_000_000, 250), (1_500_000, 1), (100_000, 1)])
def test_no_lifetime_is_for_ever(bench: Bench, lifetime_ns: int, set_ms: int) -> None:
    """HEBI's modules take 0 for ever: a lifetime of under a millisecond is one."""
    bench.driver.set_lifetime(LAST, lifetime_ns)
    assert bench.group.command_lifetime == set_ms


def test_while_motors_are_off_another_program_can_have_the_modules(bench: Bench) -> None:
    bench.ticks(10, FORWARD)
    other = bench.open(bench.library.Lookup().get_group_from_family(FAMILY))
    assert other.receive()[LAST].fault == HELD_BY_OTHER
    bench.ticks(10)
    # That they are off was repeated for a lifetime; after another one they are free.
    for _ in range(2 * 250 // 4 + 2):
        bench.tick()
    assert other.receive()[LAST].fault == ""
    other.send([MOTOR_OFF, FORWARD])
    bench.pass_ticks(2)
    assert bench.tick().fault == HELD_BY_OTHER
    assert bench.pwm[LAST] > 0.1


def test_a_silent_module_keeps_its_last_sample_then_is_a_fault_and_at_last_lost(bench: Bench) -> None:
    good = bench.tick()
    bench.module.silent = True
    held = bench.ticks(MAX_HELD)
    assert {sample.fault for sample in held} == {""}
    assert {sample.sequence for sample in held} == {good.sequence}
    assert [sample.sensors.position_rad for sample in held] == [good.sensors.position_rad] * MAX_HELD
    times = [sample.sensors.t_ns for sample in (good, *held)]
    assert times == sorted(set(times))
    # hebi-py does not tell which one: the other module answers, and is no different.
    of_group = f"no feedback in {MAX_HELD + 1} ticks of the whole group, in which one module may be silent"
    assert {sample.fault for sample in bench.driver.receive()} == {of_group}
    bench.module.silent = False
    # However little the module's clock has gone on, as that of a world that is slower than real time.
    assert times[-1] - times[0] < 1_000
    back = bench.tick()
    assert back.fault == ""
    assert back.sequence == good.sequence + MAX_HELD + 2
    assert back.sensors.t_ns > times[-1]
    bench.module.silent = True
    with pytest.raises(
        HardwareLost, match="X-00009, X-00010 have not all answered for 1 s; one that is silent is enough"
    ):
        bench.ticks(1000 // FEEDBACK_TIMEOUT_MS + 1)


def test_a_single_silent_module_is_named_by_its_faults(bench: Bench) -> None:
    bench.driver = bench.open(Group([bench.module], lambda: True))
    bench.driver.receive()
    bench.module.silent = True
    faults = [bench.driver.receive()[0].fault for _ in range(MAX_HELD + 1)]
    assert faults[-1] == f"no feedback in {MAX_HELD + 1} ticks"
    for _ in range(1000 // FEEDBACK_TIMEOUT_MS - MAX_HELD - 2):
        bench.driver.receive()
    with pytest.raises(HardwareLost, match="X-00010 has not answered for 1 s"):
        bench.driver.receive()


def test_readings_that_are_not_set_are_held_over_and_then_named(bench: Bench) -> None:
    good = bench.tick()
    write = bench.module.write_feedback

    def without(sender: object, feedback: Any, index: int) -> None:
        write(sender, feedback, index)
        feedback.effort[index] = NAN

    bench.module.write_feedback = without  # type: ignore[method-assign]
    samples = bench.ticks(MAX_HELD + 1)
    assert all(sample.sensors.effort_nm == good.sensors.effort_nm for sample in samples)
    assert samples[0].fault == ""
    assert samples[-1].fault.startswith("effort_nm reads nan")


def test_a_pressed_m_stop_keeps_targets_and_gains_from_its_module(bench: Bench) -> None:
    gains = default_gains(module_type("X5-9"), 4)
    bench.driver.set_gains(LAST, gains)
    bench.ticks(5, FORWARD)
    bench.module.m_stop = True
    assert bench.ticks(3, FORWARD)[-1].m_stop
    # The end of a lease sets gains, and a module whose strategy is given would follow again.
    bench.driver.set_gains(LAST, gains)
    bench.ticks(3, FORWARD)
    bench.driver.identify(LAST, True)
    assert (bench.module.gains.strategy, bench.pwm[LAST]) == (0, 0.0)
    bench.module.m_stop = False
    assert not bench.ticks(3)[-1].m_stop
    # HEBI's M-stop leaves strategy 0 behind, which a brake does not end: it comes without a lease.
    bench.ticks(3, BRAKE)
    assert bench.module.gains.strategy == 0
    bench.ticks(3, FORWARD)
    assert bench.module.gains.strategy == 4
    assert bench.pwm[LAST] > 0.1


BOOT = 77


class Leased(Bench):
    """The last module under its firmware, and a coordinator that acquires its lease."""

    def __init__(self) -> None:
        super().__init__()
        self.sent = 0
        self.strategies: set[int] = set()
        self._seq = 0
        self.boot()

    def boot(self, safety: Safety | None = None) -> None:
        """Begin anew with another agent, with limits of a file for the last module."""
        information = hebi_network.describe(self.library, self.group, 250.0)
        if safety is not None:
            both = [Safety(), safety]
            information = hebi_network.restrict(self.library, self.group, information, both)
        self.driver = HebiModules(
            self.library, self.group, information, lambda: self.pass_ticks(TICKS) and None
        )
        self.firmware = Firmware(config_of(information[LAST], BOOT), self.driver, LAST)
        self.run(1)

    def run(self, ticks: int, *incoming: Incoming) -> list[bytes]:
        """Run ticks of the driver; return what the firmware answers."""
        answers: list[bytes] = []
        for _ in range(ticks):
            self.sample = self.driver.receive()[LAST]
            self.driver.send([MOTOR_OFF, self.firmware.step(self.sample, incoming)])
            out = self.firmware.publish(0.0)
            answers += [one.payload for one in out if isinstance(one, Answer)]
            self.strategies.add(self.module.gains.strategy)
            incoming = ()
        return answers

    def ask(self, leaf: Leaf, kind: type[Message], **fields: Any) -> Ack:
        """Send one message; return the firmware's answer."""
        self._seq += 1
        head = {"serial": "X-00010", "boot": BOOT, "seq": self._seq, "sender": "me"}
        lease = {"token": self.firmware.lease.token, "echo_ns": self.sample.sensors.t_ns}
        message = kind.model_validate({**head, **({} if kind is Stop else lease), **fields})
        (answer,) = self.run(1, Incoming(leaf, encode(message), 1))
        return decode(Ack, answer)

    def acquire(self) -> Ack:
        return self.ask(Leaf.LEASE, LeaseRequest, action="acquire", duration_ns=200_000_000)

    def give_gains(self, strategy: int) -> Ack:
        gains = default_gains(self.module._kind, strategy)
        return self.ask(Leaf.GAINS, GainsCommand, gains=gains, keep=True)


@pytest.fixture
def leased() -> Leased:
    return Leased()


@pytest.mark.parametrize("presses", ["under a lease", "before the agent"])
def test_a_motor_stays_off_after_its_m_stop_until_the_lease_is_acquired_with_the_button_released(
    leased: Leased, presses: str
) -> None:
    if presses == "under a lease":
        assert leased.acquire().accepted
        leased.run(10)
        assert leased.module.gains.strategy == 3
    leased.module.m_stop = True
    if presses == "before the agent":
        leased.pass_ticks(2)
        leased.boot()
    leased.run(2)
    assert (leased.firmware.state, leased.sample.m_stop) == ("stopped", True)
    leased.strategies.clear()
    if presses == "under a lease":
        # Gains of its holder, and then the end of its lease, which sets gains too.
        assert leased.give_gains(4).accepted
        leased.run(100)
        assert leased.firmware.lease.holder is None
    refused = leased.acquire()
    assert (refused.accepted, refused.detail) == (False, "the M-stop is pressed: release it first")
    leased.module.m_stop = False
    # A released button alone commands nothing, nor does a stop.
    leased.run(100)
    assert leased.ask(Leaf.STOP, Stop, why="for the test").accepted
    leased.run(100)
    assert leased.strategies == {0}
    assert leased.pwm[LAST] == 0.0
    assert leased.acquire().accepted
    leased.run(3)
    assert leased.module.gains.strategy == (4 if presses == "under a lease" else 3)


def test_a_stop_brakes_under_the_factorys_gains_whatever_the_holders_gains_do(leased: Leased) -> None:
    """Gains of a velocity loop whose least output drives the motor pass every check of gains."""
    own = default_gains(leased.module._kind, 3)
    driving = own.model_copy(update={"velocity": own.velocity.model_copy(update={"min_output": 0.3})})
    assert leased.acquire().accepted
    assert leased.ask(Leaf.GAINS, GainsCommand, gains=driving, keep=True).accepted
    leased.run(20)
    assert leased.pwm[LAST] > 0.1
    assert leased.ask(Leaf.STOP, Stop, why="for the test").accepted
    leased.run(50)
    assert leased.module.gains.velocity.min_output == -1.0
    assert abs(leased.sample.sensors.velocity_rad_s) < 0.01
    assert leased.acquire().accepted
    leased.run(2)
    assert leased.module.gains.velocity.min_output == pytest.approx(0.3)


def test_a_stop_brakes_at_once_though_no_gains_are_confirmed(
    leased: Leased, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An agent that ended of it would leave all of its motors off."""
    assert leased.acquire().accepted
    leased.run(20)
    with monkeypatch.context() as patch:
        tried: list[int] = []
        patch.setattr(
            Group, "send_command_with_acknowledgement", lambda *_, timeout_ms, **__: tried.append(timeout_ms)
        )
        assert leased.ask(Leaf.STOP, Stop, why="for the test").accepted
        leased.run(50)
        assert leased.firmware.state == "stopped"
        # Tried again and again, and never waited for.
        assert 4 <= len(tried) <= 7
        assert max(tried) <= 5
        velocity = leased.driver._targets[LAST, 1]
        assert velocity == 0.0
    leased.run(12)
    assert leased.driver._links[LAST].given is leased.driver._links[LAST].brake_gains


def losing_answers(patch: pytest.MonkeyPatch, lost: int) -> list[int]:
    """Let commands arrive whose first answers are lost; return how long was waited for each [ms]."""
    waited: list[int] = []
    send = Group.send_command

    def answer(group: Group, command: Any, timeout_ms: int = 0) -> bool:
        waited.append(timeout_ms)
        return send(group, command) and len(waited) > lost

    patch.setattr(Group, "send_command_with_acknowledgement", answer)
    return waited


def test_other_modules_have_their_ticks_while_the_answer_to_new_gains_is_lost(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited = losing_answers(monkeypatch, 2)
    alone: list[int] = []
    monkeypatch.setattr(Group, "send_command", lambda *_: alone.append(len(waited)) or True)
    for tick in range(1, 4):
        bench.tick(FORWARD)
        # A stop that comes meanwhile waits for one answer, not for all.
        assert len(waited) == tick
        assert waited[-1] <= 50
    bench.tick(FORWARD)
    # The target comes along with the gains, and without them only when these are confirmed.
    assert alone == [3, 3]


def test_gains_that_are_never_confirmed_end_the_driver_with_the_modules_name(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited = losing_answers(monkeypatch, 10**6)
    with pytest.raises(HardwareLost, match="the gains of X-00010 are not confirmed in 3 tries of 50 ms"):
        bench.ticks(5, FORWARD)
    assert len(waited) == 3


def test_a_module_whose_answer_was_lost_has_its_owners_gains_in_the_end(
    leased: Leased, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = default_gains(leased.module._kind, 4)
    leased.module._loops.set_gains(0, own)
    leased.boot()
    assert leased.acquire().accepted
    with monkeypatch.context() as patch:
        waited = losing_answers(patch, 1)
        assert leased.give_gains(2).accepted
        assert (len(waited), leased.module.gains.strategy) == (1, 2)
        leased.driver.close()
    assert hebi_network.describe(leased.library, leased.group, 250.0)[LAST].gains == own


def test_another_modules_brake_brings_no_target_without_its_gains(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.driver.receive()
    bench.driver.send([FORWARD, MOTOR_OFF])
    sent: list[tuple[int, float]] = []
    with monkeypatch.context() as patch:
        patch.setattr(
            Group,
            "send_command_with_acknowledgement",
            lambda _, command, timeout_ms: sent.append((timeout_ms, float(command.position[LAST]))),
        )
        patch.setattr(
            Group, "send_command", lambda _, command: sent.append((0, float(command.position[LAST]))) or True
        )
        bench.driver.receive()
        bench.driver.send([BRAKE, FORWARD])
    assert sent == [(50, 5.0), (5, pytest.approx(NAN, nan_ok=True))]


def test_a_module_that_moves_keeps_its_target_while_the_answer_to_other_gains_is_lost(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would let go of its load otherwise."""
    bench.driver.receive()
    bench.driver.send([FORWARD, FORWARD])
    bench.driver.set_gains(LAST, default_gains(module_type("X5-9"), 4))
    targets: list[float] = []
    for name in ("send_command", "send_command_with_acknowledgement"):
        monkeypatch.setattr(
            Group, name, lambda _, command, **__: targets.append(float(command.position[LAST])) and False
        )
    bench.driver.receive()
    bench.driver.send([BRAKE, FORWARD])
    assert targets == [5.0, 5.0]


def test_a_second_stop_brakes_at_once_under_the_factorys_gains(leased: Leased) -> None:
    """Also where the lease was acquired anew just before."""
    assert leased.acquire().accepted
    assert leased.give_gains(4).accepted
    for _ in range(2):
        assert leased.ask(Leaf.STOP, Stop, why="for the test").accepted
        leased.run(1)
        assert leased.driver._links[LAST].given is leased.driver._links[LAST].brake_gains
        assert leased.acquire().accepted
        leased.run(1)
        assert leased.module.gains.strategy == 4


def test_a_stop_brakes_under_the_factorys_gains_where_the_answer_to_others_was_lost(
    leased: Leased, monkeypatch: pytest.MonkeyPatch
) -> None:
    """These have arrived all the same."""
    assert leased.acquire().accepted
    assert leased.give_gains(4).accepted
    assert leased.ask(Leaf.STOP, Stop, why="for the test").accepted
    leased.run(1)
    with monkeypatch.context() as patch:
        losing_answers(patch, 1)
        assert leased.acquire().accepted
    assert leased.module.gains.strategy == 4
    assert leased.ask(Leaf.STOP, Stop, why="for the test").accepted
    leased.run(1)
    assert leased.module.gains.strategy == leased.driver._links[LAST].brake_gains.strategy == 3


@pytest.mark.parametrize("ends", ["at once", "later"])
@pytest.mark.parametrize("before", ["gains of its holder", "a stop"])
def test_no_gains_are_handed_back_to_a_module_that_is_off_at_its_m_stop(
    leased: Leased, before: str, ends: str
) -> None:
    """With gains comes a strategy, under which it would follow again."""
    own = default_gains(leased.module._kind, 4)
    leased.module._loops.set_gains(0, own)
    leased.boot()
    assert leased.acquire().accepted
    leased.run(2)
    if before == "a stop":
        assert leased.ask(Leaf.STOP, Stop, why="for the test").accepted
    else:
        assert leased.give_gains(2).accepted
    leased.run(20)
    leased.module.m_stop = True
    leased.run(2)
    leased.strategies.clear()
    if ends == "later":
        # Its lease expires, and what HEBI's module follows; the button is released; the agent ends.
        leased.run(300)
        leased.module.m_stop = False
        leased.run(50)
    leased.driver.close()
    leased.pass_ticks(2)
    assert leased.strategies <= {0}
    assert leased.module.gains.strategy == 0


def test_a_module_that_was_off_at_its_m_stop_has_its_owners_gains_after_its_next_lease(
    leased: Leased,
) -> None:
    own = default_gains(leased.module._kind, 4)
    leased.module._loops.set_gains(0, own)
    leased.boot()
    assert leased.acquire().accepted
    assert leased.give_gains(2).accepted
    leased.run(20)
    leased.module.m_stop = True
    leased.run(300)
    leased.module.m_stop = False
    leased.run(50)
    assert leased.acquire().accepted
    leased.run(5)
    assert leased.module.gains.strategy == 2
    leased.run(300)
    assert hebi_network.describe(leased.library, leased.group, 250.0)[LAST].gains == own


def test_the_next_agent_and_other_programs_find_the_gains_that_the_module_came_with(leased: Leased) -> None:
    own = default_gains(leased.module._kind, 4)
    leased.module._loops.set_gains(0, own)
    for ends in ("the agent", "the lease", "its holder"):
        leased.boot()
        assert leased.acquire().accepted
        assert leased.give_gains(2).accepted
        assert leased.module.gains.strategy == 2
        if ends == "the lease":
            assert leased.ask(Leaf.LEASE, LeaseRequest, action="release", duration_ns=1).accepted
        if ends != "the agent":
            leased.run(2 * 250 // TICKS)
        leased.driver.close()
        assert hebi_network.describe(leased.library, leased.group, 250.0)[LAST].gains == own


def test_every_lease_has_its_gains_also_after_another_program_had_the_module(leased: Leased) -> None:
    others = default_gains(leased.module._kind, 2)
    assert leased.acquire().accepted
    leased.run(5)
    # Its holder dies: the motor is off, and a lifetime later nothing is sent any more.
    leased.run(2 * 250 // TICKS)
    leased.module._loops.set_gains(0, others)
    leased.run(400)
    assert leased.firmware.lease.holder is None
    assert leased.module.gains == others
    assert leased.acquire().accepted
    leased.run(2)
    assert leased.module.gains.strategy == leased.firmware._info().gains.strategy == 3


def test_nothing_is_sent_to_a_module_before_its_first_lease_and_its_owners_gains_stay(
    leased: Leased, monkeypatch: pytest.MonkeyPatch
) -> None:
    owners = default_gains(leased.module._kind, 4)
    soft = owners.position.model_copy(update={"kp": 2.5, "min_output": -1e6, "max_output": 1e6})
    owners = owners.model_copy(update={"position": soft})
    leased.module._loops.set_gains(0, owners)
    sent: list[str] = []
    with monkeypatch.context() as patch:
        for name in ("send_command", "send_command_with_acknowledgement"):
            patch.setattr(Group, name, lambda *_, _name=name, **__: sent.append(_name) or True)
        leased.boot()
        leased.run(200)
        assert leased.ask(Leaf.STOP, Stop, why="for the test").accepted
        leased.run(200)
        leased.driver.close()
        assert sent == []
    leased.boot()
    assert leased.firmware._info().gains == owners
    assert leased.acquire().accepted
    leased.run(3)
    # What has been written, in single precision, is what was read.
    assert leased.module.gains != owners
    assert hebi_network.describe(leased.library, leased.group, 250.0)[LAST].gains == owners


def test_gains_that_a_module_does_not_tell_are_the_factorys_and_said(bench: Bench) -> None:
    write = bench.module.write_info
    notes: list[str] = []

    def described(**changes: float) -> GainSet:
        def told(info: Any, index: int) -> None:
            write(info, index)
            for name, value in changes.items():
                getattr(info, name)[index] = value

        bench.module.write_info = told  # type: ignore[method-assign]
        return hebi_network.describe(bench.library, bench.group, 250.0, note=notes.append)[LAST].gains

    factory = default_gains(bench.module._kind, 3)
    assert described(position_kp=2.5).position.kp == 2.5
    assert notes == []
    assert described(position_kp=NAN, velocity_output_lowpass=2.0) == factory
    assert described(control_strategy=0, position_kp=2.5) == factory
    assert notes == [
        "module X-00010 does not tell position_kp, velocity_*: with its first lease it gets the factory's",
        "module X-00010 has control strategy 0, as after an M-stop: with its first lease it gets the factory "
        "gains of its type for strategy 3, in place of its owner's",
    ]


@pytest.mark.parametrize("whose", ["the file's", "the module's own"])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_motor_that_is_off_at_a_limit_is_a_fault_until_the_joint_is_back_and_its_lease_acquired(
    leased: Leased, whose: str, side: float
) -> None:
    limited = Safety(position_rad=(-0.2, 0.2), at_limit="motor_off")
    leased.boot(limited)
    if whose == "the module's own":
        leased.boot()
    assert leased.acquire().accepted
    leased.run(3)
    target = {"position_rad": 0.19 * side, "velocity_rad_s": None, "effort_nm": None}
    for _ in range(250):
        if leased.firmware.state == "fault":
            break
        leased.ask(Leaf.LEASE, LeaseRequest, action="renew", duration_ns=200_000_000)
        assert leased.ask(Leaf.SETPOINT, Setpoint, **target).accepted or leased.firmware.state == "fault"
    assert f"motor off at the limit {0.2 * side:g} rad" in leased.firmware._note
    assert leased.module.gains.strategy == 0
    leased.strategies.clear()
    leased.run(200)
    refused = leased.acquire()
    assert "motor off at the limit" in refused.detail
    # It is turned back by hand, which the test's world cannot do.
    leased.module.tick = lambda reading: NetworkModule.tick(  # type: ignore[method-assign]
        leased.module, reading._replace(position_rad=0.0, deflection_rad=0.0)
    )
    leased.run(5)
    assert leased.firmware.state == "fault"
    assert leased.strategies == {0}
    assert leased.acquire().accepted
    leased.run(3)
    assert (leased.firmware.state, leased.module.gains.strategy) == ("armed", 3)


def test_every_gain_arrives_as_it_was_given(bench: Bench) -> None:
    gains = default_gains(module_type("X5-9"), 2)
    loop = gains.position.model_copy(
        update={"ki": 0.5, "kd": 0.25, "punch": 0.125, "dead_zone": 0.0625, "d_on_error": False}
    )
    gains = gains.model_copy(update={"position": loop, "effort": loop})
    bench.driver.set_gains(LAST, gains)
    bench.ticks(1, FORWARD)
    assert bench.module.gains.strategy == 2
    assert bench.module.gains.position == loop
    assert bench.module.gains.effort == loop
    assert bench.driver.information[LAST].gains == gains
    (_, read) = hebi_network.describe(bench.library, bench.group, 250.0)
    assert read.gains.position == loop


def test_the_led_is_lit_and_given_back_while_the_motor_follows_its_command(bench: Bench) -> None:
    bench.ticks(5, FORWARD)
    bench.driver.identify(LAST, True)
    assert bench.module.led is not None
    bench.driver.identify(LAST, False)
    assert bench.module.led is None
    assert min(bench.pass_ticks(4)) > 0.1


def test_limits_and_temperatures_are_reported_by_what_acts(bench: Bench) -> None:
    write = bench.module.write_feedback

    def hot(sender: object, feedback: Any, index: int) -> None:
        write(sender, feedback, index)
        feedback.temperature_state[index], feedback.position_limit_state[index] = 3, 4

    bench.module.write_feedback = hot  # type: ignore[method-assign]
    assert bench.tick().limits == LimitState.OVER_TEMPERATURE | LimitState.POSITION


def test_accelerometers_are_made_to_read_gravity(bench: Bench) -> None:
    bench.module.accel_includes_gravity = False
    bench.open(bench.group)
    assert bench.module.accel_includes_gravity
    assert bench.tick().sensors.accel_x_m_s2 == pytest.approx(bench.world.readings[LAST].accel_x_m_s2)


def test_an_accelerometer_that_leaves_out_gravity_for_good_is_refused(bench: Bench) -> None:
    bench.module._settings = lambda command, index: None  # type: ignore[method-assign]
    bench.module.accel_includes_gravity = False
    with pytest.raises(HardwareLost, match=r"of X-00010 leaves out gravity"):
        bench.open(bench.group)


def test_names_types_and_narrower_limits_are_the_modules_own(bench: Bench) -> None:
    write = bench.module.write_info

    def told(info: Any, index: int) -> None:
        write(info, index)
        info.name[index], info.family[index], info.mechanical_type[index] = "elbow", "arm", "X5-4 rev B"
        info.position_limit_min[index], info.position_limit_max[index] = -0.5, 0.75
        info.min_position_limit_strategy[index] = 2
        info.velocity_limit_min[index], info.velocity_limit_max[index] = -0.25, 0.5

    bench.module.write_info = told  # type: ignore[method-assign]
    (_, own) = hebi_network.describe(bench.library, bench.group, 500.0)
    assert (own.name, own.family, own.module_type, own.tick_ns) == ("elbow", "arm", "X5-4", 2_000_000)
    # The upper side's limit is disabled in the module.
    assert own.limits == catalogue_limits(module_type("X5-4")).model_copy(
        update={"min_position_rad": -0.5, "max_speed_rad_s": 0.25}
    )


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"rate_hz": 5000.0}, "it must be 50 to 1000 Hz"),
        ({"types": ["X5-4"]}, "1 types for 2 modules"),
        ({"types": ["X5-4", "T-1000"]}, "module X-00010 is of type 'T-1000'"),
    ],
)
def test_what_cannot_be_driven_is_refused_with_what_is_possible(
    bench: Bench, change: dict[str, Any], match: str
) -> None:
    with pytest.raises(UsageError, match=match):
        hebi_network.describe(bench.library, bench.group, **{"rate_hz": 250.0} | change)


LIMITED = Safety(position_rad=(-0.5, 0.3), velocity_rad_s=(-1.0, 0.4), effort_nm=(-2.0, 1.5), m_stop="hold")


def restrict(bench: Bench, safety: Safety) -> ModuleInformation:
    """Give the last module limits, and the other one none, by the driver; return what it is then."""
    information = hebi_network.describe(bench.library, bench.group, 250.0)
    both = hebi_network.restrict(bench.library, bench.group, information, [Safety(), safety])
    assert both[0] == information[0]
    return both[LAST]


def test_limits_of_a_file_are_enforced_by_the_module_itself(bench: Bench) -> None:
    limits = restrict(bench, LIMITED).limits
    assert (limits.min_position_rad, limits.max_position_rad) == (-0.5, 0.3)
    assert (limits.max_speed_rad_s, limits.max_effort_nm) == (0.4, 1.5)
    told = hebi_network.describe(bench.library, bench.group, 250.0)[LAST].limits
    assert told.max_position_rad == 0.3
    speeds, positions = [], []
    for _ in range(500):
        bench.tick(FORWARD)
        sensors = bench.module.sample.sensors
        speeds.append(sensors.velocity_rad_s)
        positions.append(sensors.position_rad)
    # Ten rad away is where it is sent to. The speed's loop overshoots by less than a quarter.
    assert max(speeds) < 1.25 * 0.4
    assert 0.2 < max(positions) < 0.3


def test_different_limits_of_both_directions_are_written_as_they_are(bench: Bench) -> None:
    restrict(bench, LIMITED)
    assert bench.module._safety.velocity_rad_s == pytest.approx((-1.0, 0.4))
    assert bench.module._safety.effort_nm == pytest.approx((-2.0, 1.5))


def test_a_module_that_was_never_heard_has_a_fault(bench: Bench) -> None:
    driver = bench.open(bench.group)
    bench.module.silent = True
    assert driver.receive()[LAST].fault == "no feedback yet"


def test_a_module_that_boots_anew_is_a_fault_since_what_was_set_in_it_is_lost(bench: Bench) -> None:
    bench.pass_ticks(2000)
    bench.ticks(2)
    link = bench.driver._links[LAST]
    link.feedback_ns += 2_000_000_000
    assert "X-00010 has restarted without its limits" in bench.tick().fault
    assert "has restarted" in bench.tick().fault


def test_gains_are_sent_with_the_next_targets_and_repeat_none_that_are_over(bench: Bench) -> None:
    """When a command expires the gains are set anew: the old target must not come with them."""
    bench.ticks(3, FORWARD)
    bench.driver.set_gains(LAST, default_gains(bench.module._kind, 2))
    bench.driver.receive()
    bench.driver.send([MOTOR_OFF, MOTOR_OFF])
    assert bench.module.gains.strategy == 2
    assert max(bench.pass_ticks(3)) == 0.0


def test_a_narrower_limit_of_the_module_stays(bench: Bench) -> None:
    restrict(bench, LIMITED)
    wider = restrict(bench, Safety(position_rad=(-1.0, 0.2), velocity_rad_s=(-5.0, 5.0)))
    assert (wider.limits.min_position_rad, wider.limits.max_position_rad) == (-0.5, 0.2)
    assert wider.limits.max_speed_rad_s == pytest.approx(0.4)


def test_at_the_m_stop_the_module_does_what_its_file_says(bench: Bench) -> None:
    restrict(bench, LIMITED)
    bench.ticks(100, Command(0.1, NAN, NAN))
    bench.module.m_stop = True
    samples = bench.ticks(100, Command(-0.1, NAN, NAN))
    assert samples[-1].m_stop
    moved = [sample.sensors.position_rad - samples[0].sensors.position_rad for sample in samples]
    assert np.max(np.abs(moved)) < 0.01


def test_a_limit_that_real_modules_do_not_have_is_refused(bench: Bench) -> None:
    with pytest.raises(UsageError, match="X-00010: a real module has no limit current_a, winding_c"):
        restrict(bench, Safety(current_a=1.0, winding_c=80.0))


def test_a_module_that_does_not_take_its_limits_is_named(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench.module, "_restrict", lambda written: None)
    with pytest.raises(HardwareLost, match=r"X-00010 does not take position_limit_min -0\.5, it has nan"):
        restrict(bench, LIMITED)


def test_modules_are_found_by_family_and_name_and_what_is_missing_is_named(bench: Bench) -> None:
    waited: list[float] = []
    group = hebi_network.find_group(bench.library, FAMILY, ["X-00010"], waited.append)
    assert group.size == 1
    assert hebi_network.find_group(bench.library, FAMILY, [], waited.append).size == 2
    with pytest.raises(
        UsageError, match=r"simulated/X-1: not all are on the network, which has simulated/X-0"
    ):
        hebi_network.find_group(bench.library, FAMILY, ["X-1"], waited.append)
    with pytest.raises(UsageError, match="any module of family Arm"):
        hebi_network.find_group(bench.library, "Arm", [], waited.append)
    assert waited == [hebi_network.LOOKUP_S] * 4
    described = hebi_network.describe(bench.library, bench.group, 250.0)
    assert [one.module_type for one in described] == [one.module_type for one in bench.world.modules]
    rows = hebi_network.seen(bench.library, waited.append)
    assert [(row.family, row.name, row.mechanical_type) for row in rows] == [
        (FAMILY, module.serial, module.module_type) for module in bench.world.modules
    ]


def test_ticks_are_even_and_late_ones_are_not_made_up_for() -> None:
    now = [10.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    pace = hebi_network.Pace(250.0, lambda: now[0], sleep)
    began = []
    for number in range(50):
        pace.wait()
        began.append(now[0])
        now[0] += 0.1 if number == 20 else 0.001
    steps = np.diff(began)
    assert np.allclose(steps[:20], 0.004)
    assert steps[20] == pytest.approx(0.1)
    # One tick late comes at once, then all is even again.
    assert np.all(steps[21:] < 0.0041)
    assert np.allclose(steps[23:], 0.004)


# ------------------------------------------------------------------ hebi-py itself, where it is installed


def hebi() -> Any:
    try:
        return hebi_library.library()
    except UsageError:
        pytest.skip("hebi-py is not installed")


def test_without_hebi_py_the_error_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "hebi", None)
    with pytest.raises(UsageError, match=r"pip install --no-deps hebi-py==2"):
        hebi_library.library()


def test_actions_at_limits_have_hebi_pys_numbers() -> None:
    numbers = hebi().GroupCommand(1)
    names = {
        "hold": "HoldPosition",
        "spring": "DampedSpring",
        "motor_off": "MotorOff",
        "disabled": "Disabled",
    }
    for action, number in hebi_network.AT_LIMIT.items():
        assert numbers._enum_max_position_limit_strategy_str_mappings[names[action]] == number
    for action, number in hebi_network.AT_M_STOP.items():
        assert numbers._enum_mstop_strategy_str_mappings[names[action]] == number


def test_the_stand_in_has_no_field_and_no_method_that_hebi_py_has_not() -> None:
    """The names, shapes and number formats of the stand-in are those of hebi-py."""
    real = hebi()
    pairs: list[tuple[Any, Any]] = [
        (messages.GroupCommand(2), real.GroupCommand(2)),
        (messages.GroupFeedback(2), real.GroupFeedback(2)),
        (messages.GroupInfo(2), real.GroupInfo(2)),
    ]
    for ours, theirs in pairs:
        for name, array in ours._arrays.items():
            value = getattr(theirs, name)
            assert np.shape(value) == np.shape(array), name
            assert name in messages.TEXTS or np.asarray(value).dtype == array.dtype, name
    for ours, theirs in ((Group, real.Group), (type(StandIn.Lookup), type(real.Lookup))):
        assert {n for n in vars(ours) if not n.startswith("_")} <= set(dir(theirs))
    assert real.Color(1, 2, 3, 4).a == messages.Color(1, 2, 3, 4).a


def imitated(hebi: Any, wait: Callable[[], None]) -> HebiModules:
    information = [
        ModuleInformation(
            f"I-{k}",
            "",
            "",
            "X5-4",
            default_gains(kind := module_type("X5-4"), 3),
            catalogue_limits(kind),
            4,
            4,
        )
        for k in range(3)
    ]
    group = hebi.util.create_imitation_group(3)
    return HebiModules(hebi, group, information, wait, time.monotonic_ns)


def test_hebis_imitation_group_echoes_what_the_driver_sends() -> None:
    """It has no dynamics and no times: this is plumbing, field by field, through hebi-py's own messages."""
    modules = imitated(hebi(), lambda: None)
    modules.receive()
    modules.send([Command(1.0, NAN, NAN), Command(NAN, NAN, 0.25), Command(NAN, 0.5, NAN)])
    modules.identify(1, True)
    modules.set_gains(2, default_gains(module_type("X5-4"), 4))
    sensors = [sample.sensors for sample in modules.receive()]
    assert sensors[0].position_rad == 1.0
    assert sensors[1].effort_nm == 0.25
    assert sensors[2].velocity_rad_s == 0.5
    # What it was not given it does not have; it is held over.
    assert sensors[0].effort_nm == sensors[1].position_rad == 0.0
    assert all(math.isfinite(value) for sample in sensors for value in sample)
    assert sensors[0].t_ns > 0
    # A state that it does not send reads 0: neither a pressed M-stop nor a limit.
    assert not any(sample.m_stop or sample.limits for sample in modules.receive())
    assert len(sensors[0]) == len(SensorSample._fields)
    modules.close()
    modules.close()
    with pytest.raises(HardwareLost):
        modules.receive()


def test_the_driver_paces_a_group_that_does_not() -> None:
    """Unpaced, the imitation group would run through 50 ticks in a few milliseconds."""
    modules = imitated(hebi(), hebi_network.Pace(250.0).wait)
    began = time.monotonic()
    for _ in range(50):
        modules.receive()
    assert time.monotonic() - began > 0.19
