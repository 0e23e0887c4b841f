"""Modules of one type differ; friction, gear and heat act as much as the profile says."""

import numpy as np
import pytest

from module_agent.model.catalogue import module_type
from sim.actuator.actuator import Actuators
from sim.actuator.thermal import Windings
from sim.imperfections.module_errors import alike, draw_variation
from sim.imperfections.noise_profile import NOISE_PROFILES, NoiseProfile, noise_profile

IDEAL = NOISE_PROFILES["ideal"]
X5_4 = module_type("X5-4")


def test_modules_differ_by_the_profiles_spreads() -> None:
    serials = [f"m{i}" for i in range(600)]
    profile = noise_profile("x5")
    found = draw_variation(1, serials, profile)
    spreads = (profile.friction_spread, profile.motor_spread, profile.motor_spread, profile.spring_spread)
    for factors, spread in zip(found, spreads, strict=True):
        # 600 draws: a sigma of the sample deviation is 2.9 %, so four of them.
        assert np.log(factors).std() == pytest.approx(spread, rel=0.12)
        assert abs(np.log(factors).mean()) < 4 * spread / np.sqrt(600)
    assert abs(np.corrcoef(np.log(found.motor), np.log(found.resistance))[0, 1]) < 0.17


def test_a_modules_variation_depends_on_the_seed_and_its_serial_alone() -> None:
    profile = noise_profile("x5")
    alone, with_another = draw_variation(5, ["b"], profile), draw_variation(5, ["a", "b"], profile)
    for one, two in zip(alone, with_another, strict=True):
        assert one[0] == two[1]
    assert draw_variation(6, ["b"], profile).friction[0] != alone.friction[0]


def test_without_spreads_all_modules_are_as_catalogued() -> None:
    for drawn, same in zip(draw_variation(3, ["a", "b"], IDEAL), alike(2), strict=True):
        np.testing.assert_array_equal(drawn, same)


def _free_speed(profile: NoiseProfile, pwm: float = 0.5) -> float:
    actuator = Actuators([X5_4], 1e-3, profile)
    q, qd, mass, none = np.zeros(1), np.zeros(1), np.array([[1e-3]]), np.zeros(1)
    for _ in range(800):
        qd = qd + 1e-3 * actuator.step(np.array([pwm]), q, qd, mass, none)[0] / 1e-3
        q = q + 1e-3 * qd
    return float(qd[0])


def test_without_friction_and_gear_loss_a_free_motor_turns_at_its_back_emfs_speed() -> None:
    free = IDEAL.model_copy(update={"friction": 0.0, "gear_loss": 0.0})
    speeds = [_free_speed(IDEAL.model_copy(update={"friction": f})) for f in (0.0, 0.5, 1.0, 2.0)]
    assert _free_speed(free) == pytest.approx(24.0 / (0.00575 * X5_4.gear_ratio), rel=1e-9)
    # Losses of the gear need a torque to lose; friction slows, the more the larger.
    assert speeds[0] == pytest.approx(_free_speed(free), rel=1e-9)
    assert speeds[0] > speeds[1] > speeds[2] > speeds[3] > 0.5 * speeds[0]


def test_a_stalled_motor_draws_less_as_copper_warms_by_0_393_percent_a_kelvin() -> None:
    def stalled(heat: float) -> tuple[float, float]:
        profile = IDEAL.model_copy(update={"heat": heat})
        actuator, windings = Actuators([X5_4], 1e-3, profile), Windings(1, 1e-3, heat)
        still, heavy = np.zeros(1), np.array([[1e9]])
        for _ in range(2000):
            actuator.step(np.array([0.2]), still, still, heavy, still, windings.resistance_factor)
            windings.step(actuator.state.copper_w)
        return float(actuator.state.current_a[0]), float(windings.winding_c[0])

    cold, ambient = stalled(0.0)
    warm, degrees = stalled(1.0)
    assert ambient == 25.0
    assert degrees > 35.0
    # The last step's current saw the temperature of a tick before: far below the bound.
    assert cold / warm == pytest.approx(1.0 + 0.00393 * (degrees - 25.0), rel=1e-4)
