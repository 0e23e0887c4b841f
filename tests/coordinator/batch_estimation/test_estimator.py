"""The batch estimator recovers known robots with calibrated covariance and names what is unresolved."""

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.linalg import orth
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from coordinator.batch_estimation import estimator
from coordinator.batch_estimation.estimator import Refinement, refine_chain, with_placement
from coordinator.batch_estimation.imu_intrinsics import (
    DELAY,
    SIZE,
    ImuIntrinsics,
    beyond,
    read,
    slopes,
)
from coordinator.batch_estimation.imu_jacobian import Displacements
from coordinator.batch_estimation.imu_prediction import imu_readings
from coordinator.batch_estimation.link_compliance import ComplianceJacobian
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.kinematics.null_space import name_null_space
from module_agent.model.catalogue import GRAVITY_M_S2, GRAVITY_SIGMA_M_S2
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import BIASES_ONLY, CALIBRATED, UNCALIBRATED, ImuPrior
from module_agent.model.perturbation import apply_perturbation
from tests.random_chains import displaced

GYRO_NOISE, ACCEL_NOISE = 2e-3, 0.03


def _motion(joints: int, samples: int = 300, seed: int = 0) -> tuple[Array, Array, Array]:
    """All joints at once at 1 to 2 Hz: positions, velocities and accelerations, (m, n) each."""
    rng = np.random.default_rng(1000 + seed)
    rate, phase = rng.uniform(6, 12, joints), rng.uniform(0, 6, joints)
    t = np.linspace(0, 4.0, samples)[:, None]
    swing = 0.3 * np.sin(0.9 * t + phase) + 0.1 * np.sin(rate * t + phase)
    velocity = 0.27 * np.cos(0.9 * t + phase) + 0.1 * rate * np.cos(rate * t + phase)
    acceleration = -0.243 * np.sin(0.9 * t + phase) - 0.1 * rate**2 * np.sin(rate * t + phase)
    return swing, velocity, acceleration


def _sensed(
    chain: Chain, seed: int = 0, noise: float = 0.0, bias: float = 0.0, samples: int = 300
) -> SensorData:
    """What the sensors of a chain read; `bias` in standard deviations of the data sheet's."""
    q, qd, qdd = _motion(len(chain.serials), samples)
    ideal = imu_readings(chain, q, qd, qdd)
    rng = np.random.default_rng(seed)
    shape, each = ideal.gyro_rad_s.shape, (len(chain.serials), 3)
    gyro_bias = bias * rng.normal(0, BIASES_ONLY.gyro_bias_rad_s, each)
    accel_bias = bias * rng.normal(0, BIASES_ONLY.accel_bias_m_s2, each)
    gyro = ideal.gyro_rad_s + gyro_bias + noise * rng.normal(0, GYRO_NOISE, shape)
    accel = ideal.accel_m_s2 + accel_bias + noise * rng.normal(0, ACCEL_NOISE, shape)
    return SensorData(q, qd, qdd, gyro, accel)


def _perturbed(chain: Chain, seed: int, angle: float, offset: float) -> Chain:
    """Every module but the root displaced; gravity tilted by as much."""
    rng = np.random.default_rng(500 + seed)
    count = len(chain.serials)
    delta = np.concatenate([rng.normal(0, angle, (count, 3)), rng.normal(0, offset, (count, 3))], axis=1)
    # Turning about the root would carry distal modules far off: every module turns about itself.
    delta[:, 3:] += np.cross(chain.imu_home[:, :3, 3], delta[:, :3])
    delta[0] = 0.0
    tilt = Rotation.from_rotvec(rng.normal(0, angle, 3))
    return apply_perturbation(chain, delta.ravel())._replace(gravity=tilt.apply(chain.gravity))


def _increment(found: Chain, truth: Chain) -> Array:
    """The increment (6 n,) that leads from `truth` to `found`."""
    moved = found.imu_home @ np.linalg.inv(truth.imu_home)
    return np.asarray(RigidTransform.from_matrix(moved).as_exp_coords().ravel())


def _upright(robots: Any, seed: int, joints: int, tilt_rad: float = 0.0) -> Chain:
    """A serial robot whose first axis is vertical, or tilted by an angle."""
    chain, types = robots.random(seed, joints, serial=True)
    up = Rotation.from_rotvec([tilt_rad, 0.0, 0.0]).apply([0.0, 0.0, 1.0])
    return robots.build(list(chain.parent), [False] * joints, np.array(chain.imu_home), types, np.asarray(up))


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_that_is_roughly_known_is_recovered_from_ideal_data(robots: Any, seed: int) -> None:
    truth, _ = robots.random(seed, joints=2 + seed % 4)
    found = refine_chain(_perturbed(truth, seed, 0.05, 0.02), _sensed(truth))
    # What cannot be known may differ, but not what the sensors read in any other motion.
    q, qd, qdd = _motion(len(truth.serials), seed=9)
    for mine, theirs in zip(
        imu_readings(found.chain, q, qd, qdd), imu_readings(truth, q, qd, qdd), strict=True
    ):
        # 1e-7 rad of convergence on readings of up to 20 m/s^2.
        np.testing.assert_allclose(mine, theirs, atol=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_parameters_are_exact_but_for_the_null_space(robots: Any, seed: int) -> None:
    truth, _ = robots.random(seed, joints=2 + seed % 4)
    # What hides is a finite twist; small starts keep its second order, 0.5 * (7e-4)^2, below the bound.
    found = refine_chain(_perturbed(truth, seed, 2e-4, 2e-4), _sensed(truth))
    error = _increment(found.chain, truth)
    known = error - found.estimate.null_basis @ (found.estimate.null_basis.T @ error)
    assert np.abs(known).max() < 1e-6
    assert found.estimate.rank + found.estimate.null_basis.shape[1] == 6 * (len(truth.serials) - 1)


def test_biases_do_not_bend_the_robot(robots: Any) -> None:
    truth, _ = robots.random(3, joints=4, serial=True)
    data = _sensed(truth, seed=7, bias=1.0)
    found = refine_chain(_perturbed(truth, 1, 0.02, 0.01), data)
    q, qd, qdd = data.q_rad, data.qd_rad_s, data.qdd_rad_s2
    again = imu_readings(found.chain, q, qd, qdd)
    gyro = data.gyro_rad_s - found.intrinsics.gyro_bias_rad_s - again.gyro_rad_s
    assert np.abs(gyro).max() < 1e-6
    true_rates = imu_readings(truth, q, qd, qdd).gyro_rad_s
    np.testing.assert_allclose(again.gyro_rad_s, true_rates, atol=1e-5)


def test_the_covariance_is_honest_over_many_noisy_runs(robots: Any) -> None:
    truth, _ = robots.random(4, joints=3, serial=True)
    squares, freedom = 0.0, 0
    for seed in range(25):
        found = refine_chain(truth, _sensed(truth, seed, noise=1.0, bias=1.0))
        values, vectors = np.linalg.eigh(found.estimate.covariance)
        kept = values > values.max() * 1e-12
        along = vectors[:, kept].T @ _increment(found.chain, truth)
        squares += float(np.sum(along**2 / values[kept]))
        freedom += int(np.count_nonzero(kept))
    assert freedom == 25 * found.estimate.rank
    # Chi-square with some 275 degrees of freedom: one sigma is 0.085; four sigma for what the seeds share.
    assert 0.66 < squares / freedom < 1.34


def test_residuals_tell_the_noise_of_the_sensors(robots: Any) -> None:
    truth, _ = robots.random(4, joints=4)
    found = refine_chain(truth, _sensed(truth, 1, noise=1.0))
    # 900 values for each, 2 % of scatter, and the few degrees of freedom that the fit takes.
    np.testing.assert_allclose(found.residual_gyro_rad_s, GYRO_NOISE, rtol=0.1)
    np.testing.assert_allclose(found.residual_accel_m_s2, ACCEL_NOISE, rtol=0.1)


@pytest.mark.parametrize(
    ("tilt_rad", "kinds"),
    [(0.0, ["offset_along_axis", "rotation_about_axis"]), (0.5, ["offset_along_axis"])],
)
@pytest.mark.parametrize("joints", [2, 3])
def test_a_vertical_first_axis_hides_offset_and_heading_and_a_tilted_one_the_offset(
    robots: Any, tilt_rad: float, kinds: list[str], joints: int
) -> None:
    truth = _upright(robots, 11, joints, tilt_rad)
    found = refine_chain(truth, _sensed(truth, 0, noise=1.0))
    named = name_null_space(found.chain, found.estimate.null_basis)
    assert [u.kind for u in named] == kinds
    assert {u.joint for u in named} == {truth.serials[0]}
    assert found.estimate.null_basis.shape[1] == len(kinds)
    np.testing.assert_allclose(
        found.estimate.null_basis.T @ found.estimate.null_basis, np.eye(len(kinds)), atol=1e-9
    )
    # The covariance claims nothing along what is unknown.
    np.testing.assert_allclose(found.estimate.covariance @ found.estimate.null_basis, 0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_every_step_brings_the_model_nearer_to_the_data(
    robots: Any, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    truth, _ = robots.random(seed, joints=3)
    start, data = _perturbed(truth, seed, 0.05, 0.02), _sensed(truth, seed, noise=1.0)
    costs = []
    for iterations in (1, 2, 3, 8):
        monkeypatch.setattr(estimator, "ITERATIONS", iterations)
        found = refine_chain(start, data)
        costs.append(
            float(np.sum((found.residual_gyro_rad_s / GYRO_NOISE) ** 2))
            + float(np.sum((found.residual_accel_m_s2 / ACCEL_NOISE) ** 2))
        )
    before = imu_readings(start, data.q_rad, data.qd_rad_s, data.qdd_rad_s2)
    first = float(np.sum(np.mean((data.gyro_rad_s - before.gyro_rad_s) ** 2, axis=(0, 2)) / GYRO_NOISE**2))
    assert costs[0] < first
    # Down to the noise, where each sensor's share is one.
    assert all(later < 1.001 * earlier for earlier, later in itertools.pairwise(costs))
    assert costs[-1] == pytest.approx(6.0, rel=0.1)


def test_scipy_finds_the_same_minimum(robots: Any) -> None:
    truth, _ = robots.random(2, joints=3)
    data = _sensed(truth, 3, noise=1.0)
    found = refine_chain(truth, data)
    q, qd, qdd = data.q_rad, data.qd_rad_s, data.qdd_rad_s2
    w_gyro, w_accel = 1 / found.residual_gyro_rad_s[:, None], 1 / found.residual_accel_m_s2[:, None]
    # Scipy's solver stalls along directions that change nothing: it moves in the others only.
    poses = orth(np.eye(12) - found.estimate.null_basis[6:] @ found.estimate.null_basis[6:].T)

    def misfit(x: Array) -> Array:
        moved = apply_perturbation(truth, np.concatenate([np.zeros(6), poses @ x[: found.estimate.rank]]))
        tilt, biases = (
            x[found.estimate.rank : found.estimate.rank + 3],
            x[found.estimate.rank + 3 :].reshape(2, 3, 3),
        )
        read = imu_readings(moved._replace(gravity=truth.gravity + tilt), q, qd, qdd)
        return np.concatenate(
            [
                ((data.gyro_rad_s - read.gyro_rad_s - biases[0]) * w_gyro).ravel(),
                ((data.accel_m_s2 - read.accel_m_s2 - biases[1]) * w_accel).ravel(),
                biases[0].ravel() / BIASES_ONLY.gyro_bias_rad_s,
                biases[1].ravel() / BIASES_ONLY.accel_bias_m_s2,
                [(np.linalg.norm(truth.gravity + tilt) - GRAVITY_M_S2) / GRAVITY_SIGMA_M_S2],
            ]
        )

    theirs = least_squares(
        misfit, np.zeros(found.estimate.rank + 21), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    their = np.concatenate([np.zeros(6), poses @ theirs.x[: found.estimate.rank]])
    apart = _increment(found.chain, truth) - their
    sigma = np.sqrt(np.einsum("ij,jk,ik->i", poses.T, found.estimate.covariance[6:, 6:], poses.T))
    # The same point on the scale of what the noise leaves open: a hundredth of a standard deviation.
    assert np.abs((poses.T @ apart[6:]) / sigma).max() < 0.01


def _uncalibrated(
    data: SensorData, seed: int, prior: ImuPrior = UNCALIBRATED
) -> tuple[SensorData, ImuIntrinsics]:
    """The same motion as read by IMUs whose errors are drawn from what is allowed beforehand."""
    rates = np.concatenate(
        [np.gradient(part, 4.0 / 299, axis=0) for part in (data.gyro_rad_s, data.accel_m_s2)], axis=2
    )
    count = data.q_rad.shape[1]
    errors = np.random.default_rng(seed).normal(size=(count, SIZE)) * prior.sigmas
    imus = ImuIntrinsics(errors)
    gyro, accel = read(imus, data.gyro_rad_s, data.accel_m_s2, rates)
    return data._replace(gyro_rad_s=gyro, accel_m_s2=accel, imu_rates=rates), imus


def _with_noise(data: SensorData, seed: int) -> SensorData:
    rng = np.random.default_rng(seed)
    return data._replace(
        gyro_rad_s=data.gyro_rad_s + rng.normal(0, GYRO_NOISE, data.gyro_rad_s.shape),
        accel_m_s2=data.accel_m_s2 + rng.normal(0, ACCEL_NOISE, data.accel_m_s2.shape),
    )


def test_the_intervals_hold_with_imus_as_delivered(robots: Any) -> None:
    truth, _ = robots.random(4, joints=3, serial=True)
    squares, freedom = 0.0, 0
    for seed in range(25):
        data, _ = _uncalibrated(_sensed(truth), seed)
        found = refine_chain(truth, _with_noise(data, 100 + seed), UNCALIBRATED)
        values, vectors = np.linalg.eigh(found.estimate.covariance)
        kept = values > values.max() * 1e-12
        along = vectors[:, kept].T @ _increment(found.chain, truth)
        squares += float(np.sum(along**2 / values[kept]))
        freedom += int(np.count_nonzero(kept))
    # Chi-square with some 275 degrees of freedom: one sigma is 0.085; four sigma for what the seeds share.
    assert 0.66 < squares / freedom < 1.34


def _displaced_fits(robots: Any, backwards: bool) -> list[tuple[Chain, Refinement, Array]]:
    """The truth, the fit and the true placement of 40 robots whose calibrated IMUs sit off their places."""
    truth, types = robots.random(4, joints=3, serial=True)
    if backwards:
        truth = robots.build(
            list(truth.parent),
            [False, True, True],
            np.array(truth.imu_home),
            types,
            np.array([0.0, 0.6, 0.8]),
        )
    fits = []
    for seed in range(40):
        drawn = np.random.default_rng(seed).normal(size=(3, 6)) * CALIBRATED.placement_sigmas
        data, _ = _uncalibrated(_sensed(with_placement(truth, drawn)), seed, CALIBRATED)
        fits.append((truth, refine_chain(truth, _with_noise(data, 100 + seed), CALIBRATED), drawn))
    return fits


@pytest.mark.parametrize("backwards", [False, True])
def test_the_intervals_hold_with_imus_off_their_places(robots: Any, backwards: bool) -> None:
    squares, freedom, placed = 0.0, 0, []
    for truth, fit, drawn in _displaced_fits(robots, backwards):
        values, vectors = np.linalg.eigh(fit.estimate.covariance)
        kept = values > values.max() * 1e-12
        along = vectors[:, kept].T @ _increment(fit.chain, truth)
        squares += float(np.sum(along**2 / values[kept]))
        freedom += int(np.count_nonzero(kept))
        placed.append((fit.placement - drawn) / fit.placement_sigma)
    # 40 times 10 to 12 degrees of freedom: one sigma is 0.07; four sigma for what the parameters share.
    assert 0.72 < squares / freedom < 1.28
    assert 0.72 < np.mean(np.square(placed)) < 1.28


def test_a_module_that_turns_itself_tells_where_its_imu_is(robots: Any) -> None:
    (_, fit, _), *_ = _displaced_fits(robots, backwards=True)
    (_, forward, _), *_ = _displaced_fits(robots, backwards=False)
    # The IMU of a reversed module runs on a circle about its own axis: the catalogue's radius is measured.
    across = fit.placement_sigma[1:, 3:].min(axis=1)
    assert across.max() < 0.5 * CALIBRATED.place_m
    # The first module's, on the base, never moves: its prior stays.
    np.testing.assert_allclose(forward.placement_sigma[0, 3:], CALIBRATED.place_m, rtol=0.01)


def test_scale_and_axes_of_an_imu_are_found_where_distal_joints_turn_it(robots: Any) -> None:
    truth, _ = robots.random(4, joints=4, serial=True)
    data, imus = _uncalibrated(_sensed(truth), 3)
    calibrated = refine_chain(truth, _with_noise(data, 1), UNCALIBRATED)
    trusted = refine_chain(truth, _with_noise(data, 1), BIASES_ONLY)
    error = calibrated.intrinsics.errors - imus.errors
    # Module 2 is turned by two joints and observed against a third; their encoders make its gyro observable.
    before = np.abs(imus.errors[2, :9]).max()
    assert np.abs(error[2, :9]).max() < 0.5 * before
    # And what is trusted blindly bends the robot.
    assert np.abs(_increment(calibrated.chain, truth)).max() < np.abs(_increment(trusted.chain, truth)).max()


def test_the_delay_of_an_imu_is_estimated(robots: Any) -> None:
    truth, _ = robots.random(4, joints=3, serial=True)
    data, imus = _uncalibrated(_sensed(truth), 5)
    found = refine_chain(truth, _with_noise(data, 2), UNCALIBRATED)
    # 900 gyro samples of 2 mrad/s on changes of some 5 rad/s^2: 0.02 ms, with room for what is shared.
    np.testing.assert_allclose(found.intrinsics.errors[1:, DELAY], imus.errors[1:, DELAY], atol=2e-4)


def test_the_slopes_by_an_imus_own_errors_are_those_of_differences() -> None:
    rng = np.random.default_rng(0)
    gyro, accel, rates = (rng.normal(size=(7, 1, k)) for k in (3, 3, 6))
    found = slopes(gyro[:, 0], accel[:, 0], rates[:, 0], np.ones(SIZE, dtype=bool))
    for k in range(SIZE):
        ahead, behind = (
            np.concatenate(read(ImuIntrinsics(h * np.eye(1, SIZE, k)), gyro, accel, rates), axis=2)[:, 0]
            for h in (0.5, -0.5)
        )
        # The readings are linear in the errors.
        np.testing.assert_allclose(found[k], (ahead - behind).T, atol=1e-14)


def test_what_the_model_leaves_out_widens_the_intervals(robots: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    truth, _ = robots.random(4, joints=3, serial=True)
    data = _sensed(truth, 1, noise=1.0)
    # A base that answers to the first joint's torque.
    swing = 0.03 * data.qdd_rad_s2[:, :1, None] * np.array([1.0, 0.0, 0.0])
    shaken = data._replace(accel_m_s2=data.accel_m_s2 + swing)
    told = refine_chain(truth, shaken)
    monkeypatch.setattr(estimator, "samples_per_independent", lambda residual, *_: np.ones(residual.shape[1]))
    untold = refine_chain(truth, shaken)
    np.testing.assert_array_equal(told.chain.imu_home, untold.chain.imu_home)
    wider = np.diag(told.estimate.covariance)[6:] / np.diag(untold.estimate.covariance)[6:]
    # Gyros alone know some parameters; the sigmas of those by accelerometers grow by a good deal.
    assert wider.min() > 0.999
    assert wider.max() > 2.0


def test_an_imu_with_larger_errors_than_its_prior_is_detected(robots: Any) -> None:
    truth, _ = robots.random(4, joints=4, serial=True)
    data, _ = _uncalibrated(_sensed(truth), 3)
    usual = refine_chain(truth, _with_noise(data, 1), UNCALIBRATED)
    assert beyond(usual.intrinsics, UNCALIBRATED).max() < 3.5
    gyro = np.array(data.gyro_rad_s)
    gyro[:, 2] *= 1.08
    worse = refine_chain(truth, _with_noise(data._replace(gyro_rad_s=gyro), 1), UNCALIBRATED)
    assert np.argmax(beyond(worse.intrinsics, UNCALIBRATED)) == 2
    assert beyond(worse.intrinsics, UNCALIBRATED)[2] > 4.0


def test_delays_need_the_rates_of_the_readings(robots: Any) -> None:
    truth, _ = robots.random(0, joints=2)
    with pytest.raises(ValueError, match="imu_rates"):
        refine_chain(truth, _sensed(truth), UNCALIBRATED)


def test_too_few_samples_are_refused(robots: Any) -> None:
    truth, _ = robots.random(0, joints=4)
    few = SensorData(*(signal[:5] for signal in _sensed(truth)[:5]))
    with pytest.raises(DataError, match="5 samples are too few to refine a chain of 4 modules"):
        refine_chain(truth, few)


def test_results_cannot_be_written_to(robots: Any) -> None:
    truth, _ = robots.random(0, joints=2)
    found = refine_chain(truth, _sensed(truth, 0, noise=1.0))
    for array in (found.estimate.covariance, found.estimate.null_basis, found.residual_gyro_rad_s):
        assert not array.flags.writeable
    assert not found.intrinsics.errors.flags.writeable
    for array in (found.chain.axis, found.chain.point, found.chain.imu_home, found.chain.gravity):
        assert not array.flags.writeable


def test_residuals_far_beyond_the_noise_count_once_a_motion(robots: Any) -> None:
    """A wave that the model lacks is no noise: the claim of what leans on that IMU's motion is widened."""
    truth, _ = robots.random(4, joints=3, serial=True)
    data = _sensed(truth, 1, noise=1.0)
    motion = np.repeat([0, 1], len(data.q_rad) // 2)
    wave = 30.0 * ACCEL_NOISE * np.sin(np.arange(len(motion)) / 3.0) * (motion == 1)
    accel = data.accel_m_s2.copy()
    accel[:, 2] += wave[:, None]
    data = data._replace(accel_m_s2=accel, motion=motion)
    noise = np.broadcast_to(np.array([GYRO_NOISE, ACCEL_NOISE])[:, None, None], (2, 2, 3))
    unaware, known = refine_chain(truth, data), refine_chain(truth, data, noise=noise)
    assert known.residuals.shape == (2, 2, 3)
    ratio = known.residuals / noise
    assert np.unravel_index(ratio.argmax(), ratio.shape) == (1, 1, 2)
    assert np.sort(ratio.ravel())[-2] < 1.3
    assert np.trace(known.estimate.covariance) > np.trace(unaware.estimate.covariance)
    # That by noise alone stays: it is expressed along directions that differ in the last digits.
    np.testing.assert_allclose(np.diag(known.noise_covariance), np.diag(unaware.noise_covariance), rtol=1e-6)
    # Without systematic errors nothing changes.
    healthy = _sensed(truth, 1, noise=1.0)._replace(motion=motion)
    plain, checked = refine_chain(truth, healthy), refine_chain(truth, healthy, noise=noise)
    np.testing.assert_array_equal(checked.estimate.covariance, plain.estimate.covariance)


def test_links_that_contradict_their_prior_widen_the_claim_where_residuals_are_systematic(
    robots: Any,
) -> None:
    truth, _ = robots.random(4, joints=3, serial=True)
    data = _sensed(truth, 1, noise=1.0)
    samples = len(data.q_rad)
    # One compliance shows as a slow turning of the last link, as large as five sigmas of its prior.
    twists = np.zeros((1, 18, samples))
    twists[0, 6] = 20.0 * GYRO_NOISE * np.sin(np.arange(samples) / 40.0)
    flex = ComplianceJacobian(np.array([1.0]), Displacements.by_twists((2,), (False,), twists), np.zeros(1))
    seen = displaced(truth, data.joints, flex.carried, np.array([5.0])).transpose(2, 0, 1)
    data = data._replace(gyro_rad_s=data.gyro_rad_s + seen[..., :3])
    accel = data.accel_m_s2 + seen[..., 3:]
    data = data._replace(accel_m_s2=accel.copy())
    noise = np.array([GYRO_NOISE, ACCEL_NOISE])[:, None, None] * np.ones((2, 1, 3))
    modelled = refine_chain(truth, data, flex=flex, noise=noise)
    unaware = refine_chain(truth, data, flex=flex)
    # The estimate contradicts its prior, but leaves no systematic residual: nothing is scaled.
    assert modelled.compliance[0] == pytest.approx(5.0, rel=0.02)
    np.testing.assert_array_equal(modelled.estimate.covariance, unaware.estimate.covariance)
    accel[:, 2] += (30.0 * ACCEL_NOISE * np.sin(np.arange(samples) / 3.0))[:, None]
    data = data._replace(accel_m_s2=accel)
    contradicted = refine_chain(truth, data, flex=flex, noise=noise)
    agreeing = refine_chain(truth, data, flex=flex._replace(sigmas=np.array([10.0])), noise=noise)
    pull = float(contradicted.compliance[0])
    assert pull == pytest.approx(5.0, rel=0.02)
    sigma, plain = (np.sqrt(np.diag(one.estimate.covariance)[6:]) for one in (contradicted, agreeing))
    np.testing.assert_allclose(sigma, pull * plain, rtol=0.02)
    mine, others = (np.diag(one.noise_covariance)[6:] for one in (contradicted, agreeing))
    np.testing.assert_allclose(mine, others, rtol=0.02)
