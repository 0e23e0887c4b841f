"""IMUs measured in several sessions: each recording and the catalogue count once, changes of biases apart."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.batch_estimation.estimator import refine_chain, with_placement
from coordinator.batch_estimation.imu_calibration import (
    SIZE,
    CalibrationInformation,
    ImuCalibration,
    catalogued,
    information_between,
    measured_before,
)
from coordinator.batch_estimation.imu_intrinsics import ACCEL_BIAS, DELAY, GYRO_BIAS, ImuIntrinsics, read
from coordinator.batch_estimation.imu_prediction import imu_readings
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.merge.calibration_file import (
    each_once,
    read_calibration,
    write_calibration,
)
from coordinator.merge.merge_calibrations import merge_calibrations
from coordinator.merge.run_arrays import RunArraysError
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import ACCEL_BIAS_CHANGE_M_S2, CALIBRATED, UNCALIBRATED

GYRO_NOISE, ACCEL_NOISE = 2e-3, 0.03


def _recording(serials: tuple[str, ...], seed: int) -> CalibrationInformation:
    """What a recording tells of some directions only, in units of the prior's standard deviations."""
    rng = np.random.default_rng(seed)
    size = catalogued(serials, UNCALIBRATED).sigma.ravel()
    rows = rng.normal(size=(60, len(size))) / size
    return CalibrationInformation(serials, rows.T @ rows, rows.T @ rng.normal(size=60), f"session {seed}")


def _jointly(serials: tuple[str, ...], recordings: list[CalibrationInformation]) -> ImuCalibration:
    """The next session's prior by one system of normal equations: constants, and every session's changes."""
    changes, constant = np.zeros(SIZE), catalogued(("A",), UNCALIBRATED).sigma[0] ** 2
    changes[ACCEL_BIAS] = ACCEL_BIAS_CHANGE_M_S2**2
    changes[GYRO_BIAS], changes[DELAY] = constant[GYRO_BIAS], constant[DELAY]
    constant = constant - changes
    count, sessions = SIZE * len(serials), len(recordings) + 1
    variances = np.concatenate([np.tile(one, len(serials)) for one in (constant, *[changes] * sessions)])
    information, vector = np.diag(1.0 / np.maximum(variances, 1e-16)), np.zeros(count * (sessions + 1))
    for k, one in enumerate(recordings, start=1):
        rows = np.concatenate([SIZE * serials.index(s) + np.arange(SIZE) for s in one.serials])
        # A session's parameters are the sum of the constants and of its changes.
        for there in (rows, count * k + rows):
            vector[there] += one.vector
            for other in (rows, count * k + rows):
                information[np.ix_(there, other)] += one.matrix
    size = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
    next_session = np.zeros((count, len(vector)))
    next_session[:, :count] = next_session[:, -count:] = np.eye(count)
    mean = next_session @ covariance @ vector
    return ImuCalibration(serials, mean.reshape(-1, SIZE), next_session @ covariance @ next_session.T)


def test_recordings_of_shared_modules_make_what_all_of_them_make_jointly() -> None:
    recordings = [_recording(("A", "B"), 1), _recording(("C", "B"), 2), _recording(("B",), 3)]
    jointly = _jointly(("A", "B", "C"), recordings)
    for order in (recordings, recordings[::-1]):
        prior = measured_before(("A", "B", "C"), UNCALIBRATED, order)
        size = jointly.sigma.ravel()
        np.testing.assert_allclose(prior.sigma, jointly.sigma, rtol=1e-6)
        np.testing.assert_allclose((prior.mean - jointly.mean).ravel() / size, 0.0, atol=1e-6)
        apart = (prior.covariance - jointly.covariance) / np.outer(size, size)
        np.testing.assert_allclose(apart, 0.0, atol=1e-6)
    # A module that was not measured has the catalogue's prior, one of those measured what all tell of it.
    some = measured_before(("B", "D"), UNCALIBRATED, recordings)
    np.testing.assert_allclose(some.sigma[0], jointly.sigma[1], rtol=1e-6)
    np.testing.assert_allclose(some.sigma[1], catalogued(("D",), UNCALIBRATED).sigma[0], rtol=1e-9)


def test_what_a_recording_adds_does_not_depend_on_its_prior() -> None:
    prior, one, other = catalogued(("A", "B"), CALIBRATED), *(_recording(("A", "B"), seed) for seed in (4, 5))
    size = prior.sigma.ravel()

    def after(before: ImuCalibration) -> ImuCalibration:
        inverse, _ = before.information()
        covariance = np.linalg.inv((inverse + one.matrix) * np.outer(size, size)) * np.outer(size, size)
        mean = covariance @ (inverse @ before.mean.ravel() + one.vector)
        return ImuCalibration(before.serials, mean.reshape(-1, SIZE), covariance)

    for before in (prior, measured_before(("A", "B"), CALIBRATED, [other])):
        added = information_between(before, after(before))
        np.testing.assert_allclose((added.matrix - one.matrix) * np.outer(size, size), 0.0, atol=1e-6)
        np.testing.assert_allclose((added.vector - one.vector) * size, 0.0, atol=1e-6)


def _sensed(chain: Chain, placement: Array, errors: Array, session: int) -> SensorData:
    """What displaced IMUs with errors read in one session; its motion is its own."""
    rng = np.random.default_rng(session)
    t = np.linspace(0.0, 4.0, 300)[:, None]
    rate, phase = rng.uniform(6, 12, len(chain.serials)), rng.uniform(0, 6, len(chain.serials))
    q = 0.3 * np.sin(0.9 * t + phase) + 0.1 * np.sin(rate * t + phase)
    qd = 0.27 * np.cos(0.9 * t + phase) + 0.1 * rate * np.cos(rate * t + phase)
    qdd = -0.243 * np.sin(0.9 * t + phase) - 0.1 * rate**2 * np.sin(rate * t + phase)
    ideal = imu_readings(with_placement(chain, placement), q, qd, qdd)
    rates = np.concatenate([np.gradient(part, 4.0 / 299, axis=0) for part in ideal], axis=2)
    gyro, accel = read(ImuIntrinsics(errors), *ideal, rates)
    gyro = gyro + rng.normal(0, GYRO_NOISE, gyro.shape)
    return SensorData(q, qd, qdd, gyro, accel + rng.normal(0, ACCEL_NOISE, accel.shape), rates)


def test_the_intervals_hold_over_three_sessions_with_the_same_imus(robots: Any) -> None:
    chain, types = robots.random(4, joints=3, serial=True)
    parent, home = list(chain.parent), np.array(chain.imu_home)
    backwards = robots.build(parent, [False, True, True], home, types, np.array([0.0, 0.6, 0.8]))
    size, squares, narrowed = catalogued(chain.serials, CALIBRATED).sigma, [], []
    for seed in range(30):
        drawn = np.random.default_rng(seed).normal(size=size.shape) * size
        recordings: list[CalibrationInformation] = []
        for session, truth in enumerate((chain, backwards, chain)):
            prior = measured_before(truth.serials, CALIBRATED, recordings)
            data = _sensed(truth, drawn[:, -6:], drawn[:, :-6], 100 * seed + session)
            fit = refine_chain(truth, data, CALIBRATED, None, prior)
            information = fit.calibration_information
            recordings.append(information._replace(session=str(session)))
        squares.append(((fit.placement - drawn[:, -6:]) / fit.placement_sigma) ** 2)
        narrowed.append(fit.placement_sigma / size[:, -6:])
    # 30 times 18 parameters, of which a third share their errors: one sigma is 0.08, four of these.
    assert 0.68 < np.mean(squares) < 1.32
    # The two modules that were mounted reversed have run on circles about their own axes.
    assert np.mean(narrowed, axis=0)[1:, 3:].min(axis=1).max() < 0.5


def test_a_recording_that_two_runs_share_counts_once_and_a_run_that_differs_is_named(tmp_path: Path) -> None:
    one, other = (_recording(("A", "B"), seed) for seed in (6, 7))
    alone, twice = merge_calibrations([[one], [other]]), merge_calibrations([[one], [other, one]])
    np.testing.assert_array_equal(alone.calibration.covariance, twice.calibration.covariance)
    displaced = other._replace(vector=other.vector + other.matrix @ np.eye(2 * SIZE)[SIZE - 1] * 0.05)
    apart = merge_calibrations([[one], [displaced], []]).inconsistency_sigma
    assert apart[2] is None
    assert apart[1] is not None
    assert apart[1] > 10.0 > max(sigma or 0.0 for sigma in alone.inconsistency_sigma)


def test_what_is_written_is_read_again_and_damage_is_named(tmp_path: Path) -> None:
    path = tmp_path / "imu_calibration.npz"
    recordings = [_recording(("A", "B"), 8), _recording(("B",), 9)._replace(imu="calibrated")]
    write_calibration(path, recordings)
    for wrote, again in zip(recordings, read_calibration(path), strict=True):
        assert (again.serials, again.session, again.imu) == (wrote.serials, wrote.session, wrote.imu)
        np.testing.assert_array_equal(again.matrix, wrote.matrix)
        np.testing.assert_array_equal(again.vector, wrote.vector)
    assert len(each_once([*recordings, *recordings])) == 2
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(RunArraysError, match="not what runs tell of IMUs"):
        read_calibration(path)
    write_calibration(path, [recordings[0]._replace(serials=("A",))])
    with pytest.raises(RunArraysError, match="do not fit 1 modules"):
        read_calibration(path)
    with pytest.raises(RunArraysError, match="every run writes it"):
        read_calibration(tmp_path / "none.npz")
