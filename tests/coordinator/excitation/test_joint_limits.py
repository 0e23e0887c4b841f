"""The inertia that a joint moves is estimated from its own slow motion, with its uncertainty."""

import numpy as np
import pytest

from coordinator.excitation.joint_limits import Load, measured_load
from module_agent.control.waveform import duration_s, waveform
from module_agent.wire.messages import ConstantMotion

RATE_HZ = 250.0
SWEEP = ConstantMotion(velocity_rad_s=1.0, duration_s=0.6, ramp_s=0.4)


def swept(inertia: float, noise_nm: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Position and torque of an arm with gravity, dry and viscous friction that turns through 1 rad."""
    # A little rest at either end, as rows about a motion have.
    t = np.arange(-0.2, duration_s(SWEEP, 0.0) + 0.2, 1.0 / RATE_HZ)
    found = waveform(SWEEP, 0.0, np.clip(t, 0.0, duration_s(SWEEP, 0.0)))
    q = found.offset_rad - 0.5
    acceleration = np.gradient(found.velocity_rad_s, t)
    torque = inertia * acceleration + 1.5 * np.sin(q) + 0.1 * found.velocity_rad_s
    noise = np.random.default_rng(seed).normal(0.0, noise_nm, len(t))
    return q, torque + noise


@pytest.mark.parametrize("inertia", [0.02, 0.2, 1.0])
def test_the_inertia_of_an_arm_is_found_through_gravity_and_friction(inertia: float) -> None:
    found = measured_load(*swept(inertia, 0.0, 0), RATE_HZ)
    # The low-pass rounds the ramps of torque and motion alike; gravity's curve over +-0.5 rad stays.
    assert found.inertia_kg_m2 == pytest.approx(inertia, rel=0.05, abs=0.02)


def test_what_it_is_at_most_is_seldom_exceeded_and_no_guess_at_random() -> None:
    found = [measured_load(*swept(0.3, 0.2, seed), RATE_HZ) for seed in range(60)]
    exceeded = [one.at_most_kg_m2 < 0.3 for one in found]
    # Beyond two sigmas and a fifth: less than one in forty.
    assert np.mean(exceeded) < 0.05
    assert np.median([one.at_most_kg_m2 for one in found]) < 0.6


def test_an_arm_that_seems_to_weigh_less_than_nothing_weighs_what_it_may() -> None:
    assert Load(-0.1, 0.05).at_most_kg_m2 == pytest.approx(0.12)
    assert Load(0.0, 0.0).at_most_kg_m2 > 0.0
