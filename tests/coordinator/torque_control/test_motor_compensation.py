"""The motor compensation, compared with the simulated motor, which has equations of its own."""

from typing import Literal

import numpy as np
import pytest

from coordinator.torque_control.feed_forward import Reference, SetPoints
from coordinator.torque_control.motor_compensation import motor_pwm, winding_c, with_motor_compensation
from module_agent.control.controller import Command, Controller
from module_agent.control.gains import default_gains
from module_agent.model.catalogue import CATALOGUE, ModuleType
from module_agent.model.chain import Array
from module_agent.wire.messages import GainSet
from sim.actuator.actuator import Actuators
from sim.actuator.thermal import Windings
from sim.imperfections.noise_profile import NOISE_PROFILES

X5_4, X5_9 = CATALOGUE["X5-4"], CATALOGUE["X5-9"]
TICK_S = 1e-3


def spring_torque(kind: ModuleType, pwm: float, speed_rad_s: float, ticks: int = 1500) -> float:
    """What the spring exerts in the end on an output that something immovable turns at a constant speed."""
    motor = Actuators([kind], TICK_S, NOISE_PROFILES["ideal"])
    immovable, nothing = np.array([[1e9]]), np.zeros(1)
    motor.reset(np.zeros(1), np.zeros(1))
    for k in range(ticks):
        motor.step(
            np.array([pwm]), np.array([speed_rad_s * k * TICK_S]), np.array([speed_rad_s]), immovable, nothing
        )
    return float(motor.state.torque_nm[0])


@pytest.mark.parametrize("kind", [X5_4, X5_9])
@pytest.mark.parametrize(
    ("tau_nm", "speed_rad_s"), [(2.0, 0.5), (2.0, -0.5), (-1.0, 0.8), (0.0, 0.3), (-3.0, -0.2)]
)
def test_the_simulated_motor_exerts_the_torque_that_the_pwm_was_worked_out_for(
    kind: ModuleType, tau_nm: float, speed_rad_s: float
) -> None:
    m = 50
    pwm = motor_pwm(kind, np.full(m, tau_nm), np.full(m, speed_rad_s))
    # Of some Nm; this motor stays as cold as it is, the other has been warmed for 25 ms.
    assert spring_torque(kind, float(pwm[m // 2]), speed_rad_s) == pytest.approx(tau_nm, abs=0.03)


def test_an_accelerated_motor_is_given_what_its_rotor_takes() -> None:
    t_s = np.arange(400) * TICK_S
    still, speeding = np.ones(400), 0.5 + 2.0 * t_s
    rotor = X5_9.gear_ratio**2 * X5_9.motor.rotor_inertia_kg_m2
    per_amp = X5_9.motor.back_emf_v_s_rad * X5_9.gear_ratio
    steady = motor_pwm(X5_9, still, np.full(400, speeding[200]))[200]
    more = motor_pwm(X5_9, still, speeding)[200] - steady
    ampere = rotor * 2.0 / X5_9.motor.efficiency / per_amp
    # The windings of both are a little warm after 0.2 s.
    assert more == pytest.approx(X5_9.motor.resistance_ohm * ampere / 48.0, rel=0.02)


# --------------------------------------------------------------------------- the winding


def simulated_c(watt: Array, body_k: float = 0.0) -> Array:
    """What the simulated winding does under losses at the ambient temperature's resistance, tick by tick."""
    windings = Windings(1, TICK_S)
    windings.above_k[:] = body_k
    found = []
    for one in watt:
        found.append(float(windings.winding_c[0]))
        windings.step(np.array([one * windings.resistance_factor[0]]))
    return np.array(found)


@pytest.mark.parametrize(("body_k", "begin"), [(0.0, 0), (0.0, 5000), (20.0, 5000)])
def test_a_winding_warms_as_the_simulated_one_does(body_k: float, begin: int) -> None:
    watt = 6.0 + 4.0 * np.sin(2.0 * np.pi * 0.3 * np.arange(10_000) * TICK_S)
    true = simulated_c(watt, body_k)
    # From the middle on, as after another motion, the housing is only guessed from winding and losses. Of 30
    # to 50 K; a kelvin is 0.4 % of the resistance.
    found = winding_c(watt[begin::10], 10 * TICK_S, true[begin])
    np.testing.assert_allclose(found, true[begin::10], atol=1.0 if begin == 0 else 6.0)
    cold = winding_c(watt[::10], 10 * TICK_S, 25.0)
    assert cold[-1] > 45.0


def test_a_warm_winding_takes_more_voltage_for_the_same_torque() -> None:
    tau, rate = np.full(20, 3.0), np.zeros(20)
    cold, warm = (motor_pwm(X5_4, tau, rate, start)[0] for start in (25.0, 75.0))
    assert warm / cold == pytest.approx(1.0 + 50.0 * 0.00393, rel=1e-9)


# --------------------------------------------------------------------------- in the set-point


def points(tau_nm: Array, qd_rad_s: Array) -> SetPoints:
    t_s = np.arange(len(tau_nm)) * TICK_S
    q = np.cumsum(qd_rad_s) * TICK_S
    columns = [signal[:, None] for signal in (q, qd_rad_s, np.zeros_like(q))]
    return SetPoints(Reference(t_s, *columns), tau_nm[:, None])


@pytest.mark.parametrize("side", ["motor", "output"])
@pytest.mark.parametrize("strategy", [2, 3, 4])
def test_loops_that_are_without_error_put_out_the_pwm_that_the_motor_needs(
    strategy: int, side: Literal["motor", "output"]
) -> None:
    kind = X5_4._replace(velocity_loop=side)
    t_s = np.arange(1000) * TICK_S
    tau, rate = 2.0 + np.sin(6.0 * t_s), 0.7 * np.cos(4.0 * t_s)
    gains = default_gains(X5_4, strategy)
    # Ten times the factory's, so that a spring's speed left out would show.
    gains = gains.model_copy(
        update={"velocity": gains.velocity.model_copy(update={"kp": 10.0 * gains.velocity.kp})}
    )
    given = with_motor_compensation(points(tau, rate), [kind], [gains])
    controller = Controller(kind, gains, TICK_S)
    q = given.reference.q_rad[:, 0]
    speed = rate + np.gradient(tau, TICK_S) / X5_4.spring_nm_rad if controller.follows_motor else rate
    pwm = [
        controller.update(Command(q[k], rate[k], given.effort_nm[k, 0]), q[k], speed[k], tau[k])
        for k in range(1000)
    ]
    # Their low-passes are a tick or two late; the derivative of the measured torque is not compensated.
    late = np.abs(np.array(pwm) - motor_pwm(X5_4, tau, rate))[20:]
    assert np.median(late) < 0.005


def test_at_rest_only_the_constant_efficiency_is_put_right() -> None:
    tau = np.full(200, 3.0)
    given = with_motor_compensation(points(tau, np.zeros(200)), [X5_4], [default_gains(X5_4, 3)])
    # Half way between driving and being driven.
    added = given.effort_nm[100, 0] - 3.0
    assert abs(added) < 0.1 * 3.0


def test_where_a_loop_integrates_or_none_takes_an_effort_nothing_is_added() -> None:
    tau, rate = np.linspace(1.0, 2.0, 300), np.full(300, 0.4)
    factory = default_gains(X5_4, 3)
    winding = factory.model_copy(update={"effort": factory.effort.model_copy(update={"ki": 0.8})})
    asked: list[GainSet] = [winding, default_gains(X5_4, 0), default_gains(X5_4, 1)]
    for gains in asked:
        given = with_motor_compensation(points(tau, rate), [X5_4], [gains])
        np.testing.assert_array_equal(given.effort_nm[:, 0], tau)
