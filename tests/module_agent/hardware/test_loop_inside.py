"""What a simulated module does by itself: limits of temperature and position, brake, watchdog."""

import math
from typing import Any

import pytest

from module_agent.control.controller import BRAKE, MOTOR_OFF, Command
from module_agent.control.gains import default_gains
from module_agent.hardware.hardware import LimitState, ModuleSample, Readings, SensorSample
from module_agent.hardware.loop_inside import DEFAULT_LIFETIME_NS, LoopInside
from module_agent.hardware.motor_guard import DAMPING_LIMIT_PWM
from module_agent.model.catalogue import CATALOGUE
from tests.module_agent.wired_firmware import MS, ScriptedWires

NAN = math.nan
PUSH = Command(NAN, NAN, 0.9)
PULL = Command(NAN, NAN, -0.9)
REST = SensorSample(0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 40.0, 48.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.8)


class Bench:
    """One module, by DirectPWM; what it reads is what the test says."""

    def __init__(self, kind: str = "SEA-snake") -> None:
        self.wires = ScriptedWires(kind)
        self.modules = LoopInside(self.wires)
        self.modules.set_gains(0, default_gains(CATALOGUE[kind], 1))  # type: ignore[index]
        self.now_ns = 0

    def receive(self, **readings: Any) -> ModuleSample:
        self.now_ns += MS
        self.wires.sample = REST._replace(t_ns=self.now_ns, **readings)
        (sample,) = self.modules.receive()
        return sample

    def drive(self, command: Command, **readings: Any) -> tuple[float, LimitState]:
        """Return the PWM of a command, and which limits the next sample says acted on it."""
        self.receive(**readings)
        (pwm,) = self.modules.send([command])
        return pwm, self.receive().limits


def test_a_command_within_all_limits_is_followed_as_it_is() -> None:
    assert Bench().drive(PUSH) == (0.9, LimitState.NONE)


@pytest.mark.parametrize(
    ("position_rad", "command", "pwm", "state"),
    [
        (1.6, PUSH, 0.0, LimitState.POSITION),
        (1.6, PULL, -0.9, LimitState.NONE),
        (-1.6, PULL, 0.0, LimitState.POSITION),
        (-1.6, PUSH, 0.9, LimitState.NONE),
    ],
)
def test_beyond_its_range_a_motor_is_driven_back_only(
    position_rad: float, command: Command, pwm: float, state: LimitState
) -> None:
    assert Bench().drive(command, position_rad=position_rad) == (pwm, state)


@pytest.mark.parametrize(
    ("winding_c", "ceiling", "state"),
    [(150.0, 0.8, LimitState.TEMPERATURE), (154.0, 0.0, LimitState.OVER_TEMPERATURE)],
)
def test_a_hot_winding_lowers_the_ceiling_to_nothing(
    winding_c: float, ceiling: float, state: LimitState
) -> None:
    """1 - 1/(155 - T)."""
    for command, sign in ((PUSH, 1.0), (PULL, -1.0)):
        pwm, limits = Bench().drive(command, winding_temperature_c=winding_c)
        assert pwm == pytest.approx(sign * ceiling)
        assert limits is state


def test_the_ceiling_is_one_of_the_duty_and_not_of_the_pwm_at_48_v() -> None:
    pwm, _ = Bench().drive(PUSH, winding_temperature_c=150.0, voltage_v=24.0)
    assert pwm == pytest.approx(0.4)


def test_the_brake_is_proportional_to_the_motor_s_speed_and_bounded() -> None:
    kind = CATALOGUE["X5-9"]
    max_motor_rad_s = kind.gear_ratio * kind.max_speed_rad_s
    bench = Bench("X5-9")
    for share in (-0.1, 0.0, 0.1):
        pwm, _ = bench.drive(BRAKE, motor_velocity_rad_s=share * max_motor_rad_s, velocity_rad_s=5.0)
        assert pwm == pytest.approx(-share)
    pwm, _ = bench.drive(BRAKE, motor_velocity_rad_s=-max_motor_rad_s)
    assert pwm == DAMPING_LIMIT_PWM


@pytest.mark.parametrize(("strategy", "follows_motor"), [(2, True), (3, True), (4, False)])
def test_the_velocity_loop_of_strategies_2_and_3_follows_the_motor(
    strategy: int, follows_motor: bool
) -> None:
    def damping(**readings: float) -> float:
        bench = Bench("X5-9")
        bench.modules.set_gains(0, default_gains(CATALOGUE["X5-9"], strategy))
        return bench.drive(Command(NAN, 0.0, NAN), **readings)[0]

    assert (damping(velocity_rad_s=0.4, deflection_velocity_rad_s=0.4) == 0.0) is follows_motor
    assert (damping(velocity_rad_s=0.0, deflection_velocity_rad_s=-0.4) < 0.0) is follows_motor


@pytest.mark.parametrize("between", [MOTOR_OFF, BRAKE])
def test_loops_forget_their_past_while_the_motor_is_off_or_brakes(between: Command) -> None:
    bench = Bench()
    gains = default_gains(CATALOGUE["SEA-snake"], 3)
    integral = gains.position.model_copy(update={"ki": 50.0, "i_clamp": 1.0})
    bench.modules.set_gains(0, gains.model_copy(update={"position": integral}))
    first, _ = bench.drive(Command(0.1, NAN, NAN))
    later, _ = bench.drive(Command(0.1, NAN, NAN))
    assert later > first
    bench.drive(between)
    assert bench.drive(Command(0.1, NAN, NAN))[0] == first


def test_without_commands_the_loops_run_on_until_the_lifetime_is_over() -> None:
    bench = Bench()
    bench.receive()
    bench.modules.send([PUSH])
    lifetime = DEFAULT_LIFETIME_NS // MS
    # The first tick carries out the command, and so do those up to the lifetime after its sample.
    pwm = [bench.receive().pwm for _ in range(lifetime + 4)]
    assert pwm == [0.9] * (lifetime + 1) + [0.0] * 3
    assert bench.drive(PUSH)[0] == 0.9


def test_while_its_clock_stands_still_a_command_lives_and_when_it_goes_back_it_ends() -> None:
    bench = Bench()
    bench.receive()
    bench.modules.send([PUSH])
    for back_ns, pwm in ((MS, 0.9), (MS, 0.9), (MS + 1, 0.9), (0, 0.0)):
        # What a module reads acts on the tick after it.
        bench.now_ns -= back_ns
        assert bench.receive().pwm == pwm


def test_a_command_is_carried_out_once() -> None:
    """Its integral is of the time that passes, and not of how often the loops are asked."""
    bench = Bench()
    gains = default_gains(CATALOGUE["SEA-snake"], 3)
    integral = gains.position.model_copy(update={"ki": 50.0, "i_clamp": 1.0})
    bench.modules.set_gains(0, gains.model_copy(update={"position": integral}))
    for _ in range(3):
        bench.receive()
        (pwm,) = bench.modules.send([Command(0.1, NAN, NAN)])
        assert bench.receive().pwm == bench.wires.pwm[-1] == pwm


def test_samples_are_counted_and_so_are_those_of_quiet_ticks() -> None:
    bench = Bench()
    assert [bench.receive().sequence for _ in range(3)] == [1, 2, 3]
    for _ in range(2):
        bench.modules.exchange([0.0])
    assert bench.receive().sequence == 6


def test_readings_in_a_block_of_memory_are_handed_on_as_they_are() -> None:
    bench = Bench()
    bench.receive()
    block = Readings.of([REST])
    samples = bench.modules.exchange([0.0])
    assert list(samples) == [bench.wires.sample]
    bench.wires.exchange = lambda pwm: block  # type: ignore[method-assign]
    assert bench.modules.exchange([0.0]) is block


def test_a_fresh_module_is_clean_and_does_nothing() -> None:
    bench = Bench()
    sample = bench.receive()
    assert (sample.m_stop, sample.fault, bench.modules.identified) == (False, "", ())
    assert sample.m_stop is False
    for command, running in (
        (MOTOR_OFF, False),
        (PUSH, True),
        (MOTOR_OFF, False),
        (PUSH, True),
        (BRAKE, False),
    ):
        bench.modules.send([command])
        assert bench.modules.quiet_state(0).running is running
        bench.receive()
    assert Bench().modules.quiet_state(0)[1:5] == (False, False, 0, 0.0)


def test_a_module_goes_on_from_what_a_quiet_tick_has_left_of_it() -> None:
    bench = Bench()
    bench.drive(PUSH)
    assert bench.modules.quiet_state(0)[1:5] == (True, True, 0, 0.9)
    drive = bench.modules.quiet_state(0)
    memory = [loop.memory for loop in drive.controller.loops]
    last = REST._replace(t_ns=bench.now_ns, position_rad=0.7)
    bench.drive(PUSH)
    bench.modules.go_on(0, last, 0.3, False, 2, memory)
    assert bench.modules.quiet_state(0)[1:5] == (True, False, 2, 0.3)
    bench.modules.send([MOTOR_OFF])
    bench.modules.go_on(0, last, 0.3, True, 2, memory)
    sample = bench.receive(position_rad=NAN)
    assert (sample.pwm, sample.limits, sample.sensors.position_rad) == (0.3, LimitState.VELOCITY, 0.7)
    assert bench.wires.pwm[-1] == 0.3


def test_before_the_first_command_the_motor_is_off() -> None:
    bench = Bench()
    assert [bench.receive().pwm for _ in range(5)] == [0.0] * 5


def test_a_module_shows_which_one_it_is_until_it_is_told_otherwise() -> None:
    bench = Bench()
    bench.modules.identify(0, True)
    assert bench.modules.identified == ("A",)
    bench.modules.identify(0, False)
    assert bench.modules.identified == ()


def test_there_is_one_command_per_module_after_a_first_sample() -> None:
    bench = Bench()
    with pytest.raises(ValueError, match=r"1 commands for 1 modules, 0 of them have been read"):
        bench.modules.send([PUSH])
    bench.receive()
    with pytest.raises(ValueError, match=r"2 commands for 1 modules, 1 of them have been read"):
        bench.modules.send([PUSH, PUSH])


@pytest.mark.parametrize("lifetime_ns", [0, -MS])
def test_a_lifetime_is_positive(lifetime_ns: int) -> None:
    with pytest.raises(ValueError, match="it must be over 0"):
        Bench().modules.set_lifetime(0, lifetime_ns)
    Bench().modules.set_lifetime(0, 1)


def test_a_lifetime_is_that_of_its_module() -> None:
    bench = Bench()
    bench.modules.set_lifetime(0, 3 * MS)
    bench.receive()
    bench.modules.send([PUSH])
    assert [bench.receive().pwm for _ in range(7)] == [0.9] * 4 + [0.0] * 3


def test_after_close_the_motor_is_off() -> None:
    bench = Bench()
    bench.drive(PUSH)
    bench.modules.close()
    assert bench.wires.pwm[-1] == 0.0
