"""A sensor that goes off is told from what it might be taken for: a payload, a displaced link, friction."""

import numpy as np
import pytest

from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.monitoring.likelihood_ratio import (
    Change,
    Evidence,
    joined,
    most_of,
    tempered,
    without_own,
)
from coordinator.monitoring.reference import BaselineTest
from coordinator.monitoring.residual_tests import (
    IMU_ERRORS,
    LARGE,
    LIKELY,
    OWN_SIGMA,
    PRIOR_KG,
    DriveModel,
    ImuModel,
    catalogued_drive,
    drive_evidence,
    imu_changes,
    imu_evidence,
    link_changes,
    payload_changes,
    torque_evidence,
    torque_window,
)
from coordinator.monitoring.segments import DataSegment
from coordinator.monitoring.sensor_errors import (
    LEAD,
    SensorError,
    drive_offset,
    imu_error,
    torque_sensor_error,
)
from module_agent.model.chain import Array
from module_agent.model.regressor import inverse_dynamics
from tests.coordinator.monitoring.moving_arm import CHAIN, JOINTS, KINDS, MODEL, PHI, TORQUE_SIGMA, segments


def torque_parts(parts: list[DataSegment]) -> list[Evidence]:
    return [torque_evidence(CHAIN, PHI, np.full(JOINTS, TORQUE_SIGMA), one) for one in parts]


@pytest.fixture(scope="module")
def torque_test() -> BaselineTest:
    known = torque_window(torque_parts(segments(1, 60)))
    return BaselineTest(known, np.zeros(0), np.full(PHI.size, PRIOR_KG), payload_changes(JOINTS), 1.0)


def imu_test_of(model: ImuModel, inflation: float = 1.0) -> BaselineTest:
    """Return the test of links, gyros and accelerometers by a minute in which the robot was well."""
    parts = [tempered(imu_evidence(model, one), inflation) for one in segments(1, 60)]
    sensors = [one for sensor in IMU_ERRORS for one in imu_changes(JOINTS, sensor)]
    links = link_changes(CHAIN)
    likely = (*[LIKELY / LARGE] * len(links), *[1.0] * len(sensors))
    known = without_own(joined(parts), model.own_sigma)
    return BaselineTest(known, model.own_sigma, model.prior_sigma, (*links, *sensors), inflation, likely)


def imu_judged(
    test: BaselineTest, model: ImuModel, sick: list[DataSegment]
) -> tuple[SensorError, list[Change]]:
    """Return the best sensor, and what each link explains."""
    later = joined([imu_evidence(model, one) for one in sick])
    found, links = test.find(later), len(CHAIN.linked)
    return imu_error(found[links:], later), list(found[:links])


@pytest.fixture(scope="module")
def imu_test() -> BaselineTest:
    return imu_test_of(MODEL)


@pytest.mark.parametrize("joint", range(JOINTS))
def test_an_offset_of_a_torque_sensor_is_found_at_its_joint_and_measured(
    torque_test: BaselineTest, joint: int
) -> None:
    sick = [one._replace(tau_nm=one.tau_nm + 0.3 * np.eye(JOINTS)[joint]) for one in segments(2)]
    found = torque_sensor_error(torque_test, torque_parts(sick))
    best = max(change.gain for change in torque_test.find(torque_window(torque_parts(sick))))
    assert (found.kind, found.place) == ("torque-sensor", joint)
    assert found.error == pytest.approx(0.3, abs=4.0 * found.sigma)
    assert found.sigma < 0.05
    assert found.gain > best + LEAD
    assert "the torque sensor of M1 reads" in found.detection("M1", 0.0).summary


def test_a_payload_is_not_taken_for_a_torque_sensor(torque_test: BaselineTest) -> None:
    heavier = PHI.copy()
    # Half a kilogram at a hand's breadth beyond the last axis.
    at = CHAIN.point[-1] + [0.1, 0.05, 0.1]
    heavier[-10:] += 0.5 * np.array([1.0, *at, *_about_root(at)])
    loaded = []
    for one in segments(3):
        more = inverse_dynamics(CHAIN, heavier - PHI, one.q_rad, one.qd_rad_s, one.qdd_rad_s2)
        loaded.append(one._replace(tau_nm=one.tau_nm + more))
    window = torque_window(torque_parts(loaded))
    best = max(change.gain for change in torque_test.find(window))
    assert torque_sensor_error(torque_test, torque_parts(loaded)).gain < best
    assert best == pytest.approx(torque_test.misfit(window), rel=0.05)


def _about_root(at: Array) -> list[float]:
    inertia = at @ at * np.eye(3) - np.outer(at, at)
    return [float(v) for v in inertia[np.triu_indices(3)]]


@pytest.mark.parametrize("place", range(JOINTS))
def test_a_bias_of_an_accelerometer_is_told_from_a_displaced_link(imu_test: BaselineTest, place: int) -> None:
    bias = 0.8 * np.eye(JOINTS)[place][:, None] * [0.6, 0.0, 0.8]
    sick = [one._replace(accel_m_s2=one.accel_m_s2 + bias) for one in segments(4)]
    found, links = imu_judged(imu_test, MODEL, sick)
    assert (found.kind, found.place) == ("accelerometer", place)
    assert found.gain > max(change.gain for change in links) + LEAD
    assert found.error == pytest.approx(0.8, abs=max(4.0 * found.sigma, 0.02))


def test_a_gyro_with_another_scale_is_named(imu_test: BaselineTest) -> None:
    scale = 1.0 + 0.05 * np.eye(JOINTS)[1][:, None]
    sick = [one._replace(gyro_rad_s=one.gyro_rad_s * scale) for one in segments(5)]
    found, _ = imu_judged(imu_test, MODEL, sick)
    assert (found.kind, found.place) == ("gyro", 1)
    spin = np.concatenate([np.linalg.norm(one.gyro_rad_s[::5, 1], axis=1) for one in segments(5)])
    assert found.error == pytest.approx(50.0 * np.sqrt(np.mean(spin**2)), rel=0.1)


def test_a_bias_is_as_large_as_it_is_whatever_its_axes_scatter() -> None:
    """One axis has a third of the noise of the others; the bias is named, however coarse the test is."""
    sharp = MODEL._replace(sigma=MODEL.sigma * [1.0, 1.0, 1.0, 1.0, 1.0, 0.3])
    bias = 0.8 * np.eye(JOINTS)[1][:, None] * [0.6, 0.0, 0.8]
    sick = [one._replace(accel_m_s2=one.accel_m_s2 + bias) for one in segments(4)]
    found, links = imu_judged(imu_test_of(sharp, inflation=100.0), sharp, sick)
    assert (found.kind, found.place) == ("accelerometer", 1)
    assert found.error == pytest.approx(0.8, rel=0.1)
    # Biases drift by 0.05 m/s^2, so that this is 16 standard deviations of what is usual.
    assert found.gain > 100.0
    assert found.gain > max(change.gain for change in links) + LEAD


@pytest.mark.parametrize("inflation", [1.0, 20.0])
def test_a_displaced_link_is_no_imu_that_is_off(inflation: float) -> None:
    """What is beyond the link moves by 10 mm: all IMUs there are displaced alike."""
    shift = np.eye(4)
    shift[:3, 3] = [0.006, 0.008, 0.0]
    moved = CHAIN._replace(
        point=CHAIN.point + shift[:3, 3] * [[0.0], [1.0], [1.0]],
        imu_home=np.stack([CHAIN.imu_home[0], shift @ CHAIN.imu_home[1], shift @ CHAIN.imu_home[2]]),
    )
    sick = []
    for one in segments(6):
        before, after = (
            readings_on(chain, body_motions(chain, one.q_rad, one.qd_rad_s, one.qdd_rad_s2))
            for chain in (CHAIN, moved)
        )
        more = after.accel_m_s2 - before.accel_m_s2
        sick.append(one._replace(accel_m_s2=one.accel_m_s2 + more))
    sensor, links = imu_judged(imu_test_of(MODEL, inflation), MODEL, sick)
    best = most_of(links)
    assert CHAIN.linked[best] == 1
    assert sensor.gain < links[best].gain


def test_an_offset_shows_in_its_drive_and_friction_does_not_pass_for_it() -> None:
    kind, joint = KINDS[1], 1
    model = DriveModel(kind, catalogued_drive(kind), 0.05)

    # Torques are low-passed before they explain a motor's: the noise is that of its current.
    per_amp = kind.gear_ratio * kind.motor.back_emf_v_s_rad * kind.motor.efficiency

    def window(seed: int, offset_nm: float, more_friction: float) -> Evidence:
        rng, parts = np.random.default_rng(seed), []
        for one in segments(seed):
            drive = one.drive.copy()
            extra_nm = more_friction * catalogued_drive(kind)[2] * drive[:, joint, 3]
            drive[:, joint, 0] += (extra_nm + 0.05 * rng.normal(size=len(drive))) / per_amp
            tau = inverse_dynamics(CHAIN, PHI, one.q_rad, one.qd_rad_s, one.qdd_rad_s2)
            sick = one._replace(tau_nm=tau + offset_nm * np.eye(JOINTS)[joint], drive=drive)
            evidence = drive_evidence(model, sick, joint)
            if evidence is not None:
                parts.append(evidence)
        return joined(parts)

    before = without_own(window(7, 0.0, 0.0), OWN_SIGMA)
    test = BaselineTest(before, OWN_SIGMA, model.prior_sigma, (model.change,), 1.0)
    off, stiff = window(8, 0.4, 0.0), window(8, 0.0, 1.0)
    found = drive_offset(test, model, joint, off)
    assert found.gain > test.find(off)[0].gain + LEAD
    assert found.error == pytest.approx(0.4, abs=4.0 * found.sigma)
    assert drive_offset(test, model, joint, stiff).gain < test.find(stiff)[0].gain


def test_a_sensor_that_is_well_explains_no_more_than_chance(
    torque_test: BaselineTest, imu_test: BaselineTest
) -> None:
    """Chi-square of 2 and of 6 degrees of freedom, the largest of 3 and of 6: above 30 once in 10,000."""
    healthy = segments(9)
    assert torque_sensor_error(torque_test, torque_parts(healthy)).gain < 30.0
    sensor, links = imu_judged(imu_test, MODEL, healthy)
    assert max(sensor.gain, *(change.gain for change in links)) < 30.0
