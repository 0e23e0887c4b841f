"""A base's motion is separated from its IMU's noise, carries all else along, and resolves headings."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from coordinator.batch_estimation.estimator import Refinement, refine_chain
from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.batch_estimation.sensor_data import BaseMotion, SensorData, outstanding
from coordinator.identification.robot_refinement import faced
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import BIASES_ONLY
from module_agent.model.perturbation import apply_perturbation

RATE_HZ, CUTOFF_HZ = 250.0, 12.0
SAMPLES = 1400


def _noise(seed: int, sigma: float) -> Array:
    """White noise below the cut-off alone, (m, 3), of the given rms."""
    raw = np.random.default_rng(seed).normal(size=(SAMPLES, 3))
    spectrum = np.fft.rfft(raw, axis=0)
    spectrum[np.fft.rfftfreq(SAMPLES, 1 / RATE_HZ) > CUTOFF_HZ] = 0.0
    found = np.fft.irfft(spectrum, SAMPLES, axis=0)
    return np.asarray(found * sigma / found.std(axis=0))


def test_of_noise_alone_next_to_nothing_is_taken_for_motion() -> None:
    kept = [outstanding(_noise(seed, 0.2), np.full(3, 0.04), CUTOFF_HZ, RATE_HZ).var() for seed in range(20)]
    # Of some 67 frequencies below the cut-off one in 2000 passes, with its neighbours.
    assert np.mean(kept) < 0.02 * 0.04


def test_a_swing_well_above_the_noise_passes_whole_and_without_delay() -> None:
    t_s = np.arange(SAMPLES) / RATE_HZ
    swing = np.outer(np.exp(-0.5 * (t_s - 2.8) ** 2) * np.sin(2 * np.pi * 2.0 * t_s), [1.0, -0.5, 0.2])
    found = outstanding(swing + _noise(1, 0.02), np.full(3, 4e-4), CUTOFF_HZ, RATE_HZ)
    # The noise within the few frequencies of the swing stays: a tenth of it in power.
    assert np.sqrt(np.mean((found - swing + swing.mean(axis=0)) ** 2)) < 0.5 * 0.02


@pytest.fixture
def shaken(robots: Any) -> tuple[Chain, SensorData]:
    """Three joints on a base that tilts and slides by centimetres; joints move one after the other."""
    chain, _ = robots.random(4, joints=3, serial=True)
    chain = chain._replace(reversed=(False, *chain.reversed[1:]))
    t_s = np.arange(SAMPLES) / RATE_HZ
    wave = np.exp(-0.5 * (t_s - 2.8) ** 2) * np.sin(2 * np.pi * 2.0 * t_s)
    q = np.zeros((3 * SAMPLES, 3))
    for joint in range(3):
        q[joint * SAMPLES : (joint + 1) * SAMPLES, joint] = 0.3 * wave
    rate = np.gradient(q, 1 / RATE_HZ, axis=0)
    rng = np.random.default_rng(3)
    turns = np.concatenate([np.outer(wave, rng.normal(0, 0.004, 3)) for _ in range(3)])
    omega = np.gradient(turns, 1 / RATE_HZ, axis=0)
    shifts = np.concatenate([np.outer(wave, rng.normal(0, 0.002, 3)) for _ in range(3)])
    force = np.gradient(np.gradient(shifts, 1 / RATE_HZ, axis=0), 1 / RATE_HZ, axis=0)
    base = BaseMotion(omega, np.gradient(omega, 1 / RATE_HZ, axis=0), force)
    joints = (q, rate, np.gradient(rate, 1 / RATE_HZ, axis=0))
    seen = readings_on(chain, body_motions(chain, *joints, base))
    noise = (rng.normal(0, s, seen.gyro_rad_s.shape) for s in (5e-4, 1e-2))
    gyro, accel = (true + part for true, part in zip(seen, noise, strict=True))
    data = SensorData(*joints, gyro, accel, base_motion=np.concatenate(base, axis=1))
    return chain, SensorData(*(None if part is None else part[::5] for part in data))


def test_a_base_that_moves_moves_a_rigid_robot_as_any_other_body(robots: Any) -> None:
    """With all joints still, every IMU is a point of one rigid body, whose motion is known."""
    chain, _ = robots.random(2, joints=4)
    rng = np.random.default_rng(0)
    omega, alpha, force = rng.normal(size=(3, 5, 3))
    still = np.zeros((5, 4))
    seen = readings_on(chain, body_motions(chain, still, still, still, BaseMotion(omega, alpha, force)))
    first = chain.imu_home[0]
    for k, home in enumerate(chain.imu_home):
        turn = home[:3, :3].T @ first[:3, :3]
        arm = first[:3, :3].T @ (home[:3, 3] - first[:3, 3])
        gravity = first[:3, :3].T @ chain.gravity
        at_imu = force + gravity + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
        np.testing.assert_allclose(seen.gyro_rad_s[:, k], omega @ turn.T, atol=1e-12)
        np.testing.assert_allclose(seen.accel_m_s2[:, k], at_imu @ turn.T, atol=1e-12)


def _apart(found: Chain, truth: Chain) -> Array:
    return np.asarray(
        RigidTransform.from_matrix(found.imu_home @ np.linalg.inv(truth.imu_home)).as_exp_coords()
    )


def test_links_keep_their_lengths_on_a_base_that_moves(shaken: tuple[Chain, SensorData]) -> None:
    chain, data = shaken
    known, blind = (refine_chain(chain, one) for one in (data, data._replace(base_motion=None)))
    squares, freedom = 0.0, 0
    values, vectors = np.linalg.eigh(known.estimate.covariance)
    for value, vector in zip(values, vectors.T, strict=True):
        if value > values.max() * 1e-12:
            squares += float(vector @ _apart(known.chain, chain).ravel()) ** 2 / value
            freedom += 1
    # A dozen numbers within what is claimed: chi-square over its freedom is below 2.5 in 999 of 1000.
    assert squares / freedom < 2.5
    # Taken for a base at rest, the arm comes out wrong by many times as much.
    assert np.abs(_apart(blind.chain, chain)).max() > 5 * np.abs(_apart(known.chain, chain)).max()


@pytest.mark.parametrize("heading_deg", [-150, -60, 30, 170])
def test_a_shaking_base_shows_the_heading_that_gravity_hides(robots: Any, heading_deg: float) -> None:
    chain, types = robots.random(7, joints=3, serial=True)
    upright = robots.build(
        list(chain.parent), [False] * 3, np.array(chain.imu_home), types, np.array([0.0, 0.0, 1.0])
    )
    rng = np.random.default_rng(1)
    base = BaseMotion(*(0.05 * rng.normal(size=(3, 400, 3))))
    q, rate, acceleration = 0.1 * rng.normal(size=(3, 400, 3))
    seen = readings_on(upright, body_motions(upright, q, rate, acceleration, base))
    data = SensorData(q, rate, acceleration, *seen, base_motion=np.concatenate(base, axis=1))
    # The first axis is vertical through the root frame's origin.
    twist = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], 3)
    twist[:6] = 0.0
    turned = apply_perturbation(upright, np.radians(heading_deg) * twist)
    hidden = twist / np.linalg.norm(twist)
    found = faced(turned, data, hidden[:, None])
    left = Rotation.from_matrix(found.imu_home[2, :3, :3] @ upright.imu_home[2, :3, :3].T)
    # What the joints' own motion leaves in the gyros after a wrong heading is random against the base's.
    assert left.magnitude() < np.radians(15)
    settled = refine_chain(found, data, BIASES_ONLY)
    left = Rotation.from_matrix(settled.chain.imu_home[2, :3, :3] @ upright.imu_home[2, :3, :3].T)
    assert left.magnitude() < np.radians(0.1)


def _far_sigmas(found: Refinement, other: Refinement) -> float:
    """How far two fits are apart in standard deviations, along what both know."""
    values, vectors = np.linalg.eigh(found.estimate.covariance)
    kept = values > values.max() * 1e-12
    apart = vectors[:, kept].T @ _apart(other.chain, found.chain).ravel()
    return float(np.abs(apart / np.sqrt(values[kept])).max())


@pytest.mark.parametrize("seed", range(3))
def test_a_fit_on_a_shaking_base_ends_where_further_steps_do_not_lead_away(
    shaken: tuple[Chain, SensorData], seed: int
) -> None:
    chain, data = shaken
    off = np.random.default_rng(seed).normal(0.0, 0.01, (3, 6))
    off[0] = 0.0
    found = refine_chain(apply_perturbation(chain, off.ravel()), data)
    further = refine_chain(found.chain, data, begin=found)
    # The last step is below 0.03, and what is left of it is not much more.
    assert _far_sigmas(found, further) < 0.06
    hidden = found.estimate.null_basis.T @ _apart(further.chain, found.chain).ravel()
    assert np.abs(hidden).max() < 1e-3
    # Another fit may start from a coarse one.
    coarse = refine_chain(apply_perturbation(chain, off.ravel()), data, coarse=True)
    assert _far_sigmas(found, coarse) < 0.3
    from_coarse = refine_chain(coarse.chain, data, begin=coarse)
    assert _far_sigmas(found, from_coarse) < 0.06


def test_without_base_motion_no_heading_is_touched(shaken: tuple[Chain, SensorData]) -> None:
    chain, data = shaken
    twist = np.zeros((18, 1))
    assert faced(chain, data._replace(base_motion=None), twist) is chain
