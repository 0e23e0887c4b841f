"""The second model agrees with the first where it must, and its bound with another way to compute it."""

from typing import Any

import numpy as np
import pytest

from coordinator.batch_estimation.estimator import refine_chain, with_placement
from coordinator.batch_estimation.imu_prediction import imu_readings
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.kinematics.chain_estimate import link_lengths
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import CALIBRATED
from module_agent.model.perturbation import apply_perturbation
from sim.benchmark.chain_bound import (
    EVERY,
    ChainModel,
    Slopes,
    _without_motion,
    available,
    chain_bounds,
)
from sim.imperfections.noise_profile import NoiseProfile, noise_profile, switched
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.scoring.chain_score import tip_spread
from sim.world.truth import Motion

pytestmark = pytest.mark.skipif(not available(), reason="pinocchio is not installed")

STEP = 1e-6


def readings(chain: Chain, *motion: Array) -> Array:
    return np.concatenate(imu_readings(chain, *motion), axis=2)


@pytest.mark.parametrize("seed", range(4))
def test_readings_and_slopes_are_those_of_the_product_of_exponentials(robots: Any, seed: int) -> None:
    chain, _ = robots.random(seed, joints=4)
    motion = np.random.default_rng(seed).normal(size=(3, 20, 4))
    model = ChainModel(chain)
    np.testing.assert_allclose(model.readings(*motion), readings(chain, *motion), atol=1e-11)
    found = model.slopes(list(motion), 0.01)

    def slope(ahead: Array, behind: Array) -> Array:
        return (ahead - behind) / (2.0 * STEP)

    for k, unit in enumerate(STEP * np.eye(24)):
        ahead, behind = (readings(apply_perturbation(chain, sign * unit), *motion) for sign in (1.0, -1.0))
        np.testing.assert_allclose(found.unknown[..., k], slope(ahead, behind), atol=1e-6)
    for imu, unit in np.ndindex(4, 6):
        step = np.zeros((4, 6))
        step[imu, unit] = STEP
        ahead, behind = (readings(with_placement(chain, sign * step), *motion) for sign in (1.0, -1.0))
        column = 24 + 3 + 40 * imu + 34 + unit
        np.testing.assert_allclose(found.unknown[..., column], slope(ahead, behind), atol=1e-6)
    for which, joint in np.ndindex(3, 4):
        change = np.zeros_like(motion)
        change[which, :, joint] = STEP
        ahead, behind = (readings(chain, *(motion + sign * change)) for sign in (1.0, -1.0))
        np.testing.assert_allclose(found[1 + which][..., joint], slope(ahead, behind), atol=1e-6)


def test_eliminating_the_motion_in_bands_is_eliminating_it_at_once() -> None:
    rng = np.random.default_rng(1)
    samples, joints, unknowns, step_s = 12, 2, 5, 0.1
    slopes = Slopes(*(rng.normal(size=(samples, joints, 6, k)) for k in (unknowns, joints, joints, joints)))
    imu = rng.uniform(0.5, 1.0, (samples, joints, 6))
    encoder = rng.uniform(0.01, 0.02, (samples, joints))
    rows = []
    for t in range(1, samples - 1):
        by_motion = np.zeros((6 * joints, samples, joints))
        speed, change = slopes.qd[t] / (2.0 * step_s), slopes.qdd[t] / step_s**2
        parts = (change - speed, slopes.q[t] - 2.0 * change, change + speed)
        for at, part in zip((t - 1, t, t + 1), parts, strict=True):
            by_motion[:, at] = part.reshape(-1, joints)
        full = np.hstack([slopes.unknown[t].reshape(-1, unknowns), by_motion.reshape(6 * joints, -1)])
        rows.append(full / imu[t].reshape(-1, 1))
    jacobian = np.vstack(rows)
    information = jacobian.T @ jacobian
    information[unknowns:, unknowns:] += np.diag(encoder.ravel() ** -2.0)
    expected = np.linalg.inv(np.linalg.inv(information)[:unknowns, :unknowns])
    np.testing.assert_allclose(_without_motion(slopes, imu, encoder, step_s), expected, rtol=1e-8, atol=1e-8)


def swing(serials: tuple[str, ...], seconds: float) -> Motion:
    t = np.arange(0.0, seconds, 0.004)
    rates = 2.0 * np.pi * (0.4 + 0.17 * np.arange(len(serials)))
    q, qd = 0.5 * np.sin(np.outer(t, rates)), 0.5 * rates * np.cos(np.outer(t, rates))
    t_ns = np.round(1e9 * t).astype(np.int64)
    return Motion(serials, t_ns, np.tile(t_ns[:, None], len(serials)), q, qd, np.zeros_like(q))


# IMUs in their places: where they are unknown, no motion tells where a leaf's housing is.
CATALOGUED = switched(noise_profile("x5"), off=("imu-place", "imu-mounting", "housing-axis"))


def bounds_of(seconds: float, **changed: float) -> Any:
    robot = load_robot("a2085_03")
    profile = CATALOGUED.model_copy(update=changed)
    types = [module.type for module in robot.modules]
    found = chain_bounds(true_chain(robot), types, swing(robot.serials, seconds), profile, CALIBRATED)
    assert found is not None
    return found


def test_more_noise_and_less_motion_make_the_bound_larger() -> None:
    chain = true_chain(load_robot("a2085_03"))
    tips = [
        tip_spread(chain, *found.strict)[0]
        for found in (
            bounds_of(20.0),
            bounds_of(5.0),
            bounds_of(20.0, accel_white_m_s2=0.05, gyro_white_rad_s=3e-3),
        )
    ]
    assert tips[1] > 1.5 * tips[0]
    assert tips[2] > 2.0 * tips[0]


def test_errors_that_the_profile_has_count_without_priors() -> None:
    chain = true_chain(load_robot("a2085_03"))
    known, scaled = bounds_of(20.0), bounds_of(20.0, accel_scale=0.01, gyro_scale=0.01)
    assert tip_spread(chain, *scaled.strict)[0] > 2.0 * tip_spread(chain, *known.strict)[0]
    np.testing.assert_allclose(scaled.bayesian.covariance, known.bayesian.covariance)


# The places of IMUs, the profile's effects and the prior's.
PLACED = {"imu_place_m": 1e-3, "imu_mounting_rad": 2e-3}


def test_a_leaf_is_no_better_known_than_its_imu_is_placed() -> None:
    chain = true_chain(load_robot("a2085_03"))
    placed, catalogued = bounds_of(20.0, **PLACED), bounds_of(20.0)
    # The prior holds whether the profile has the effect or not.
    np.testing.assert_allclose(placed.bayesian.covariance, catalogued.bayesian.covariance)
    assert tip_spread(chain, *placed.bayesian)[0] > np.sqrt(3.0) * CALIBRATED.place_m
    assert tip_spread(chain, *catalogued.strict)[0] < 0.5 * CALIBRATED.place_m
    # Readings alone do not tell where the housing of a leaf is.
    assert placed.strict.null_basis.shape[1] >= catalogued.bayesian.null_basis.shape[1] + 6


def test_the_estimator_claims_what_the_bound_allows() -> None:
    robot = load_robot("a2085_04")
    chain, motion = true_chain(robot), swing(robot.serials, 8.0)
    # Encoders without noise, and gears that do not shake: what the estimator takes for granted.
    changed = {"position_step_rad": 1e-9, "sampling_jitter_s": 0.0, "vibration_rad_s": 0.0}
    profile = noise_profile("x5").model_copy(update=changed | {"vibration_m_s2": 0.0} | PLACED)
    types = [module.type for module in robot.modules]
    bounds = chain_bounds(chain, types, motion, profile, CALIBRATED)
    assert bounds is not None
    fit = refine_chain(chain, sensed(chain, motion, profile, 3), CALIBRATED)
    covariances = fit.noise_covariance, bounds.bayesian.covariance
    lengths = [link_lengths(chain, covariance)[1][1:] for covariance in covariances]
    free = bounds.bayesian.null_basis
    tips = [tip_spread(chain, covariance, free) for covariance in covariances]
    np.testing.assert_allclose(lengths[0], lengths[1], rtol=0.02)
    np.testing.assert_allclose(tips[0], tips[1], rtol=0.02)


def sensed(chain: Chain, motion: Motion, noise: NoiseProfile, seed: int) -> SensorData:
    """Return what IMUs with the profile's white noise and random places read, at every `EVERY`th row."""
    rng = np.random.default_rng(seed)
    q, qd = motion.q_rad, motion.qd_rad_s
    joints = q, qd, np.gradient(qd, 0.004, axis=0)
    drawn = with_placement(chain, rng.normal(size=(len(chain.serials), 6)) * CALIBRATED.placement_sigmas)
    ideal = readings(drawn, *joints)
    white = np.hypot(
        np.repeat([noise.gyro_white_rad_s, noise.accel_white_m_s2], 3),
        np.repeat([noise.gyro_step_rad_s, noise.accel_step_m_s2], 3) / np.sqrt(12.0),
    )
    read = ideal + rng.normal(size=ideal.shape) * white / np.sqrt(EVERY)
    kept = slice(None, None, EVERY)
    rates = np.gradient(ideal, 0.004, axis=0)[kept]
    q, qd, qdd = (part[kept] for part in joints)
    return SensorData(q, qd, qdd, read[kept, :, :3], read[kept, :, 3:], rates)


def test_the_tips_bound_is_the_shift_that_a_covariance_allows() -> None:
    chain = true_chain(load_robot("thesis_245_vertical"))
    covariance = np.zeros((12, 12))
    # The second module, which is the tip, may be 2 mm off along x and turned by nothing.
    covariance[9, 9] = 4e-6
    position_m, orientation_deg = tip_spread(chain, covariance, np.zeros((12, 0)))
    assert position_m == pytest.approx(2e-3, rel=1e-6)
    assert orientation_deg == pytest.approx(0.0, abs=1e-9)
    # A chain that may be moved along x for nothing has no error there.
    free = np.eye(12)[:, 9:10]
    assert tip_spread(chain, covariance, free)[0] == pytest.approx(0.0, abs=1e-9)
