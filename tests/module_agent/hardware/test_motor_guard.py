"""A configured limit bounds every PWM, whatever the loops ask, and holds against what the load does."""

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.control.gains import catalogue_limits
from module_agent.control.safety import UNCONFIGURED, Safety
from module_agent.hardware.hardware import LimitState, SensorSample
from module_agent.hardware.motor_guard import (
    APPROACH_PER_S,
    DAMPING_LIMIT_PWM,
    FREE,
    HOLD,
    MARGIN_RAD,
    OFF,
    RETURN_RAD_S,
    SPRING,
    STOP,
    MotorGuard,
    bounds_of,
)
from module_agent.model.catalogue import CATALOGUE

INF, NAN = math.inf, math.nan
KIND = CATALOGUE["X5-9"]
RANGE = (-0.5, 0.5)
REST = SensorSample(0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 40.0, 48.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.8)
# Back-EMF as PWM per speed of the output, and PWM per torque at rest, by the motor's constants.
EMF = 1742.22 * 0.00575 / 48.0
LOAD = 9.99 / 48.0 / (0.00626 * 1742.22)


def guard(kind: str = "X5-9", **limits: Any) -> MotorGuard:
    module = CATALOGUE[kind]  # type: ignore[index]
    return MotorGuard(module, catalogue_limits(module), Safety(**limits))


def reading(q: float = 0.0, speed: float = 0.0, stretch: float = 0.0, **others: float) -> SensorSample:
    """Return what the X5-9 reads at a position with its motor at a speed, `stretch` ahead of the output."""
    values = {"motor_velocity_rad_s": speed * KIND.gear_ratio, "deflection_rad": -stretch, **others}
    return REST._replace(position_rad=q, **values)


def driven(limiter: MotorGuard, pwm: float, sample: SensorSample) -> tuple[float, LimitState]:
    limiter.watch(sample)
    return limiter.limit(pwm, sample), limiter.state


# ------------------------------------------------------------------ position


def test_in_the_middle_of_a_wide_range_nothing_is_bounded() -> None:
    assert driven(guard(position_rad=(-3.0, 3.0)), 0.4, reading()) == (0.4, LimitState.NONE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("action", ["hold", "spring"])
def test_towards_a_limit_the_motor_may_be_as_fast_as_it_can_stop(sign: float, action: str) -> None:
    """0.3 rad before where it aims, 5 rad/s^2 stop from sqrt(2 a (d - d0 / 2)), where d0 = a / (5 1/s)^2."""
    limiter = guard(position_rad=RANGE, at_limit=action)
    sample = reading(q=sign * (0.5 - 0.02 - 0.3), speed=sign)
    speed = math.sqrt(2.0 * 5.0 * (0.3 - 0.1))
    pwm, state = driven(limiter, sign, sample)
    assert pwm == pytest.approx(sign * (EMF * speed + 3.0 * EMF * (speed - 1.0)))
    near = reading(q=sign * (0.5 - 0.02 - 0.1))
    pwm, state = driven(limiter, sign, near)
    assert pwm == pytest.approx(sign * 4.0 * EMF * APPROACH_PER_S * 0.1)
    assert state is LimitState.POSITION
    # Away from the limit nothing is in the way.
    assert driven(limiter, -sign * 0.3, near)[0] == -sign * 0.3


def test_speed_and_slope_of_the_approach_have_no_step() -> None:
    limiter = guard(position_rad=(-3.0, 0.0), braking_rad_s2=2.5)
    knee = 2.5 / APPROACH_PER_S**2
    places = [-MARGIN_RAD - knee + d for d in (-2e-4, -1e-4, 0.0, 1e-4, 2e-4)]
    pwm = [driven(limiter, 1.0, reading(q=q))[0] for q in places]
    steps = [a - b for a, b in pairwise(pwm)]
    assert min(steps) == pytest.approx(max(steps), rel=5e-3)
    assert min(steps) > 0.0


def test_a_motor_that_is_too_fast_is_braked() -> None:
    limiter = guard(position_rad=RANGE)
    pwm, state = driven(limiter, 1.0, reading(q=0.4, speed=1.4))
    speed = APPROACH_PER_S * (0.1 - MARGIN_RAD)
    assert pwm == pytest.approx(EMF * speed + 3.0 * EMF * (speed - 1.4))
    assert pwm < 0.0
    assert state is LimitState.POSITION


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_nearer_of_output_and_motor_counts(sign: float) -> None:
    limiter = guard(position_rad=RANGE)
    at_motor = driven(limiter, sign, reading(q=sign * 0.40, stretch=sign * 0.05))[0]
    assert at_motor == pytest.approx(driven(limiter, sign, reading(q=sign * 0.45))[0])
    at_output = driven(limiter, sign, reading(q=sign * 0.45, stretch=-sign * 0.05))[0]
    assert at_output == at_motor


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_beyond_its_limit_a_joint_is_led_back_slowly(sign: float) -> None:
    limiter = guard(position_rad=RANGE)
    pwm, state = driven(limiter, 0.0, reading(q=sign * 2.0))
    assert pwm == pytest.approx(-sign * 4.0 * EMF * RETURN_RAD_S)
    assert state is LimitState.POSITION


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_hold_carries_the_load_at_the_limit_and_a_spring_gives_way(sign: float) -> None:
    sample = reading(q=sign * 0.6, effort_nm=-sign * 4.0)
    back = -sign * 4.0 * EMF * RETURN_RAD_S
    hold, _ = driven(guard(position_rad=RANGE), sign, sample)
    assert hold == pytest.approx(back - sign * LOAD * 4.0)
    assert driven(guard(position_rad=RANGE, at_limit="spring"), sign, sample)[0] == pytest.approx(back)
    # Before the limit a spring carries the load, too.
    within = sample._replace(position_rad=sign * 0.3)
    assert driven(guard(position_rad=RANGE, at_limit="spring"), sign, within) == driven(
        guard(position_rad=RANGE), sign, within
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_exactly_at_its_limit_a_spring_still_carries_the_load(sign: float) -> None:
    sample = reading(q=sign * 0.5, effort_nm=-sign * 4.0)
    hold = driven(guard(position_rad=RANGE), sign, sample)
    assert driven(guard(position_rad=RANGE, at_limit="spring"), sign, sample) == hold


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("limits", [{"position_rad": RANGE}, {"velocity_rad_s": 0.1}, {"effort_nm": 1.0}])
def test_what_is_exactly_at_a_bound_is_not_limited(limits: dict[str, Any], sign: float) -> None:
    sample = reading(q=sign * 0.45)
    bound, state = driven(guard(**limits), sign, sample)
    assert state is not LimitState.NONE
    assert driven(guard(**limits), bound, sample) == (bound, LimitState.NONE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_torque_exactly_at_its_limit_is_not_too_much(sign: float) -> None:
    pwm, _ = driven(guard(effort_nm=3.0), sign, reading(speed=sign, effort_nm=sign * 3.0))
    assert pwm == pytest.approx(sign * (LOAD * 3.0 + EMF))


def test_a_disabled_side_bounds_nothing() -> None:
    limiter = guard(position_rad=RANGE, at_limit=("hold", "disabled"))
    assert driven(limiter, 0.4, reading(q=7.0)) == (0.4, LimitState.NONE)
    assert driven(limiter, -0.4, reading(q=-0.48))[1] is LimitState.POSITION


def test_a_narrow_range_keeps_room_in_its_middle() -> None:
    limiter = guard(position_rad=(-0.01, 0.01))
    assert driven(limiter, 0.4, reading())[0] == pytest.approx(4.0 * EMF * APPROACH_PER_S * 0.0075)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_motor_is_off_shortly_before_its_limit_where_it_arrives_slowly(sign: float) -> None:
    limiter = guard(position_rad=RANGE, at_limit="motor_off")
    pwm, state = driven(limiter, sign, reading(q=sign * (0.499 - 2.0 * MARGIN_RAD)))
    assert pwm == pytest.approx(sign * 4.0 * EMF * APPROACH_PER_S * (MARGIN_RAD + 0.001))
    assert (state, limiter.fault) == (LimitState.POSITION, "")
    for beyond in (0.001, MARGIN_RAD, 1.0):
        sample = reading(q=sign * (0.5 - 2.0 * MARGIN_RAD + beyond))
        assert driven(limiter, -sign * 0.4, sample) == (0.0, LimitState.POSITION)
        assert f"motor off at the limit {sign * 0.5:g} rad" in limiter.fault
    # The motor has arrived before its load.
    assert driven(limiter, 0.4, reading(q=sign * 0.4, stretch=sign * 0.09))[0] == 0.0
    assert driven(limiter, -sign * 0.4, reading(q=sign * 0.4))[0] == -sign * 0.4
    assert limiter.fault == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_motor_is_off_from_exactly_twice_its_margin_before_the_limit(sign: float) -> None:
    # A range of an eighth has a margin of a 64th: all distances are exact.
    limiter = guard(position_rad=(-0.0625, 0.0625), at_limit="motor_off")
    assert limiter.fault == ""
    assert driven(limiter, 0.0, reading(q=sign * 0.03124))[1] is LimitState.NONE
    assert driven(limiter, -sign * 0.3, reading(q=sign * 0.03125)) == (0.0, LimitState.POSITION)
    assert limiter.fault != ""


@pytest.mark.parametrize(
    ("at_limit", "position"), [(("motor_off", "hold"), -0.6), (("hold", "motor_off"), 0.6)]
)
def test_every_side_has_its_own_action(at_limit: tuple[str, str], position: float) -> None:
    limiter = guard(position_rad=RANGE, at_limit=at_limit)
    assert driven(limiter, 0.1, reading(q=position))[0] == 0.0
    assert driven(limiter, 0.0, reading(q=-position))[0] != 0.0
    assert limiter.fault == ""


def test_a_configuration_takes_the_place_of_the_types_own_stop() -> None:
    snake = CATALOGUE["SEA-snake"]
    own = catalogue_limits(snake)
    assert bounds_of(snake, own, UNCONFIGURED)[:4] == (STOP, STOP, -1.5708, 1.5708)
    narrow = Safety(position_rad=(-0.5, INF), at_limit=("spring", "motor_off"))
    assert bounds_of(snake, own, narrow)[:4] == (SPRING, STOP, -0.5, 1.5708)
    wide = Safety(position_rad=(-3.0, 3.0), at_limit=("hold", "disabled"))
    assert bounds_of(snake, own, wide)[:4] == (HOLD, STOP, -1.5708, 1.5708)
    free = bounds_of(KIND, catalogue_limits(KIND), Safety(position_rad=(-INF, 1.0), at_limit="motor_off"))
    assert free[:4] == (FREE, OFF, -INF, 1.0)


# ------------------------------------------------------------------ speed, torque, current, winding


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_its_speed_limit_the_motor_gets_what_keeps_its_speed(sign: float) -> None:
    limiter = guard(velocity_rad_s=0.5)
    pwm, state = driven(limiter, sign, reading(speed=sign * 0.5))
    assert (pwm, state) == (pytest.approx(sign * EMF * 0.5), LimitState.VELOCITY)
    assert driven(limiter, sign, reading(speed=sign * 0.6))[0] == pytest.approx(sign * EMF * (0.5 - 0.3))
    assert driven(limiter, sign * 0.05, reading(speed=sign * 0.5)) == (sign * 0.05, LimitState.NONE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_without_a_configuration_a_motor_keeps_to_the_speed_of_its_type(sign: float) -> None:
    """Full PWM would drive an X5-9 that carries nothing at 4.8 rad/s, where its type is made for 1.466."""
    most = 1.1 * KIND.max_speed_rad_s
    pwm, state = driven(guard(), sign, reading(speed=sign * most))
    assert pwm == pytest.approx(sign * EMF * most)
    assert state is LimitState.VELOCITY
    # At the speed that loops allow at the most, PWM for a load of half the type's torque is left.
    clamped = reading(speed=sign * KIND.velocity_clamp_rad_s)
    needed = sign * (EMF * KIND.velocity_clamp_rad_s + LOAD * 0.5 * KIND.max_effort_nm)
    loaded = clamped._replace(effort_nm=sign * 0.5 * KIND.max_effort_nm)
    assert driven(guard(), needed, loaded) == (needed, LimitState.NONE)
    # A wider limit than the type's is none.
    assert driven(guard(velocity_rad_s=9.0), sign, reading(speed=sign * most))[0] == pwm


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_without_a_configuration_a_spring_keeps_to_the_torque_of_its_type(sign: float) -> None:
    """Full PWM would make a motor that stands push with more than twice what its type is made for."""
    most = 1.2 * KIND.max_effort_nm
    pwm = 0.9 * sign
    assert driven(guard(), pwm, reading(effort_nm=sign * most)) == (pwm, LimitState.NONE)
    more = reading(effort_nm=sign * math.nextafter(most, INF))
    pwm, state = driven(guard(), sign, more)
    assert pwm == pytest.approx(sign * LOAD * most)
    assert state is LimitState.EFFORT
    assert driven(guard(), sign, reading(effort_nm=sign * 1.25 * most))[0] == pytest.approx(0.0, abs=1e-9)
    # A wider limit than the type's is none.
    assert driven(guard(effort_nm=99.0), sign, more)[0] == pwm


def test_speed_limits_may_differ_by_direction() -> None:
    limiter = guard(velocity_rad_s=(-0.2, 0.5))
    assert driven(limiter, 1.0, reading())[0] == pytest.approx(4.0 * EMF * 0.5)
    assert driven(limiter, -1.0, reading())[0] == pytest.approx(-4.0 * EMF * 0.2)


def test_near_a_limit_the_slower_of_both_speeds_holds() -> None:
    limiter = guard(position_rad=RANGE, velocity_rad_s=0.1)
    assert driven(limiter, 1.0, reading())[1] is LimitState.VELOCITY
    assert driven(limiter, 1.0, reading(q=0.475))[1] is LimitState.POSITION


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_torque_limit_is_the_current_that_would_make_it_in_a_gear_without_loss(sign: float) -> None:
    limiter = guard(effort_nm=3.0)
    assert driven(limiter, sign, reading()) == (pytest.approx(sign * LOAD * 3.0), LimitState.EFFORT)
    # At a speed, the back-EMF is added.
    assert driven(limiter, sign, reading(speed=sign * 1.0))[0] == pytest.approx(sign * (LOAD * 3.0 + EMF))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_more_torque_than_the_limit_lowers_the_push_to_nothing_and_never_reverses_it(sign: float) -> None:
    limiter = guard(effort_nm=3.0)
    some = driven(limiter, sign, reading(effort_nm=sign * 3.25))[0]
    assert some == pytest.approx(sign * LOAD * 2.0)
    assert driven(limiter, sign, reading(effort_nm=sign * 9.0)) == (0.0, LimitState.EFFORT)
    assert driven(limiter, -sign * 0.05, reading(effort_nm=sign * 9.0)) == (-sign * 0.05, LimitState.NONE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_current_limit_allows_for_the_back_emf(sign: float) -> None:
    limiter = guard(current_a=0.4)
    ohm = 9.99 / 48.0
    assert driven(limiter, sign, reading()) == (pytest.approx(sign * 0.4 * ohm), LimitState.EFFORT)
    assert driven(limiter, sign, reading(speed=sign * 0.5))[0] == pytest.approx(
        sign * (0.4 * ohm + 0.5 * EMF)
    )
    # No push against the motion is more than zero PWM, by which the winding brakes.
    assert driven(limiter, sign, reading(speed=-sign * 1.4))[0] == 0.0


def test_the_lower_of_torque_and_current_holds() -> None:
    weak = driven(guard(effort_nm=3.0, current_a=0.1), 1.0, reading())[0]
    assert weak == pytest.approx(0.1 * 9.99 / 48.0)
    assert driven(guard(effort_nm=0.5, current_a=0.4), -1.0, reading())[0] == pytest.approx(-0.5 * LOAD)


def test_a_winding_limit_moves_the_ceiling() -> None:
    limiter = guard(winding_c=90.0)
    pwm, state = driven(limiter, 1.0, reading(winding_temperature_c=86.0))
    assert (pwm, state) == (pytest.approx(1.0 - 1.0 / 5.0), LimitState.TEMPERATURE)
    assert driven(limiter, 1.0, reading(winding_temperature_c=90.0)) == (0.0, LimitState.OVER_TEMPERATURE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_all_limits_that_act_are_named(sign: float) -> None:
    limiter = guard(position_rad=RANGE, effort_nm=0.5, winding_c=90.0)
    _, state = driven(limiter, sign, reading(q=sign * 0.3, winding_temperature_c=89.0))
    assert state == LimitState.POSITION | LimitState.EFFORT
    _, state = driven(limiter, sign, reading(q=sign * 0.3, winding_temperature_c=90.0))
    assert state == LimitState.POSITION | LimitState.EFFORT | LimitState.OVER_TEMPERATURE


def test_what_is_no_number_drives_no_motor() -> None:
    assert driven(guard(), NAN, reading()) == (0.0, LimitState.NONE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_the_end_of_its_types_range_a_motor_is_free_and_beyond_it_only_outward_pwm_is_taken(
    sign: float,
) -> None:
    snake = guard("SEA-snake")
    assert driven(snake, sign * 0.3, reading(q=sign * 1.5708)) == (sign * 0.3, LimitState.NONE)
    assert driven(snake, sign * 0.3, reading(q=sign * 1.5709)) == (0.0, LimitState.POSITION)
    assert driven(snake, 0.0, reading(q=sign * 1.6)) == (0.0, LimitState.NONE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_winding_as_hot_as_it_may_be_or_hotter_gets_nothing(sign: float) -> None:
    for winding_c in (154.0, 154.5, 155.0, 156.0, 300.0):
        sample = reading(winding_temperature_c=winding_c)
        assert driven(guard(), sign * 0.3, sample) == (0.0, LimitState.OVER_TEMPERATURE), winding_c


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_exactly_at_its_ceiling_a_pwm_is_not_limited(sign: float) -> None:
    hot = reading(winding_temperature_c=150.0)
    ceiling, state = driven(guard(), sign, hot)
    assert (ceiling, state) == (pytest.approx(sign * 0.8), LimitState.TEMPERATURE)
    assert driven(guard(), ceiling, hot) == (ceiling, LimitState.NONE)


@pytest.mark.parametrize("pwm", [-0.3, 0.0, 0.3])
def test_without_a_supply_and_with_one_that_reads_below_zero_there_is_no_pwm(pwm: float) -> None:
    for voltage_v in (0.0, -24.0):
        assert driven(guard(), pwm, reading(voltage_v=voltage_v))[0] == 0.0
    # As little as there is, is used.
    some = math.copysign((1.0 - 1.0 / 115.0) * 0.5 / 48.0, pwm) if pwm else 0.0
    assert driven(guard(), pwm, reading(voltage_v=0.5))[0] == pytest.approx(some)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_more_than_its_nominal_voltage_a_command_is_at_most_one(sign: float) -> None:
    assert driven(guard(), sign * 3.0, reading(voltage_v=96.0))[0] == sign


def test_the_brake_is_bounded_like_any_command() -> None:
    limiter = guard(current_a=0.1)
    sample = reading(speed=-KIND.max_speed_rad_s)
    limiter.watch(sample)
    assert limiter.damping(sample) == 0.0
    assert guard(position_rad=RANGE).damping(reading(q=-0.45, speed=-1.4)) > DAMPING_LIMIT_PWM


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_stopped_joint_beyond_its_limit_is_braked_and_not_driven_back(sign: float) -> None:
    out = guard(position_rad=(-0.5, 0.5))
    assert out.damping(reading(q=sign * 1.2)) == 0.0
    # Outward it is braked, as hard as its speed asks for at most; on its way back it is not driven on.
    assert -1.0 <= sign * out.damping(reading(q=sign * 1.2, speed=sign * 0.3)) < 0.0
    assert sign * out.damping(reading(q=sign * 1.2, speed=-sign * 0.3)) >= 0.0
    assert abs(out.damping(reading(q=sign * 1.2, speed=sign * 1e-3))) < 1e-3
    # Slower than it would be led back: what leads it back is no brake.
    slow = reading(q=sign * 1.2, speed=-sign * 0.02)
    assert sign * out.limit(0.0, slow) < -0.01
    assert out.damping(slow) == 0.0


# ------------------------------------------------------------------ whatever comes

ANY = st.floats(-1e6, 1e6)
SIZE = st.sampled_from([0.01, 1.0, 100.0, INF])


@settings(max_examples=300, deadline=None)
@given(
    st.one_of(ANY, st.just(NAN), st.just(INF), st.just(-INF)),
    st.tuples(*(st.floats(-1e4, 1e4),) * 5),
    st.floats(-50.0, 400.0),
    st.floats(-100.0, 100.0),
    st.booleans(),
    st.builds(
        Safety,
        position_rad=st.sampled_from([(-INF, INF), (-0.5, 0.5), (-INF, 0.1), (0.0, 1e-6)]),
        at_limit=st.sampled_from(["disabled", "motor_off", "hold", "spring"]),
        velocity_rad_s=SIZE,
        effort_nm=SIZE,
        current_a=SIZE,
    ),
)
def test_whatever_is_asked_and_read_the_pwm_is_finite_and_below_the_ceiling(
    pwm: float, values: tuple[float, ...], winding_c: float, voltage_v: float, brakes: bool, safety: Safety
) -> None:
    limiter = MotorGuard(KIND, catalogue_limits(KIND), safety)
    q, speed, stretch, effort, current = values
    sample = reading(q, speed, stretch, effort_nm=effort, motor_current_a=current)
    sample = sample._replace(winding_temperature_c=winding_c, voltage_v=voltage_v)
    limiter.watch(sample)
    limited = limiter.damping(sample) if brakes else limiter.limit(pwm, sample)
    assert abs(limited) <= min(max(voltage_v, 0.0) / 48.0, 1.0)
    assert not (winding_c >= safety.winding_c and limited)
