"""What currents say of friction where the readings of springs lag, and IMUs of links that give way."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coordinator.batch_estimation.imu_intrinsics import SIZE, ImuIntrinsics, read
from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.batch_estimation.link_compliance import estimated_turns
from coordinator.monitoring.likelihood_ratio import Change, joined, most_of, without_own
from coordinator.monitoring.reference import BaselineTest
from coordinator.monitoring.residual_tests import (
    LARGE,
    LIKELY,
    OWN_SIGMA,
    DriveModel,
    ImuModel,
    catalogued_drive,
    displacement,
    drive_evidence,
    drive_rows,
    fitted_drive,
    imu_evidence,
    imu_noise,
    link_changes,
)
from coordinator.monitoring.segments import DataSegment
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import apply_perturbation
from tests.coordinator.monitoring.moving_arm import (
    ACCEL_SIGMA,
    CHAIN,
    GYRO_SIGMA,
    JOINTS,
    KINDS,
    MODEL,
    RATE_HZ,
    SAMPLES,
    segments,
    swings,
)

JOINT, KIND = 0, KINDS[0]
# A load that turns about an upright axis, and the lag of the reading of the spring that turns it.
INERTIA_KG_M2, LAG_S = 0.6, 4e-3
NOISE_NM = 0.06
# The motions that the drive is known from, and the quick one that is judged.
USUAL_RAD_S, QUICK_RAD_S = (2.0, 5.0), 12.0
PEAK_RAD_S = 0.8
# About what `gain_above` asks of six joints.
ALARM = 30.0


def turned(rad_s: float, phase_rad: float, friction: float = 1.0) -> DataSegment:
    """Return half a second in which the joint swings; `friction` is its drive's over the catalogue's.

    The spring transmits tau = reading + LAG_S reading'.
    """
    angle = rad_s * np.arange(SAMPLES) / RATE_HZ + phase_rad
    speed, change = PEAK_RAD_S * np.cos(angle), -PEAK_RAD_S * rad_s * np.sin(angle)
    # What tau = -I W w sin(a) is behind a low-pass of the first order with the lag as its time constant.
    late = angle - np.arctan(LAG_S * rad_s)
    peak_nm = INERTIA_KG_M2 * PEAK_RAD_S * rad_s / np.hypot(1.0, LAG_S * rad_s)
    reading, rate = -peak_nm * np.sin(late), -peak_nm * rad_s * np.cos(late)
    drive, sign = catalogued_drive(KIND), np.sign(speed)
    motor = INERTIA_KG_M2 * change + friction * (drive[2] * sign + drive[3] * speed) + drive[4] * change
    per_amp = KIND.gear_ratio * KIND.motor.back_emf_v_s_rad
    driving = np.where(motor * speed > 0.0, motor, 0.0) / (per_amp * KIND.motor.efficiency)
    driven = np.where(motor * speed > 0.0, 0.0, motor) / per_amp
    seen = (driving, driven, sign * np.abs(reading), sign, KIND.gear_ratio * speed, KIND.gear_ratio * change)
    any_one = segments(0, 1)[0]
    return any_one._replace(
        raw=any_one.raw._replace(motor_rad_s=_of_all(KIND.gear_ratio * speed)),
        tau_nm=_of_all(reading),
        tau_rate_nm_s=_of_all(rate),
        drive=np.stack([_of_all(one) for one in seen], axis=2),
    )


def _of_all(column: Array) -> Array:
    return np.tile(column[:, None], JOINTS)


def usual() -> list[DataSegment]:
    """Return the motions that the drive is known from."""
    rng = np.random.default_rng(3)
    return [turned(rng.uniform(*USUAL_RAD_S), rng.uniform(0.0, 6.28)) for _ in range(40)]


def without_rate(one: DataSegment) -> DataSegment:
    """Return a stretch as a model without a lag sees it."""
    return one._replace(tau_rate_nm_s=np.zeros_like(one.tau_rate_nm_s))


def known_from(parts: list[DataSegment]) -> DriveModel:
    """Return the drive that explains motions best."""
    columns = zip(*(drive_rows(KIND, one, JOINT) for one in parts), strict=True)
    return DriveModel(KIND, fitted_drive(KIND, *map(np.concatenate, columns)), NOISE_NM)


def change_of(before: list[DataSegment], later: DataSegment) -> tuple[Change, float]:
    """Return the change of friction that a stretch shows, and by how much of itself it is more."""
    model = known_from(before)
    evidence = [drive_evidence(model, one, JOINT) for one in [*before, later]]
    *known, last = [one for one in evidence if one is not None]
    usual = joined([without_own(one, OWN_SIGMA) for one in known])
    test = BaselineTest(usual, OWN_SIGMA, model.prior_sigma, (model.change,), inflation=1.0)
    change = test.find(last)[0]
    return change, float(change.size @ model.relative_friction)


def test_the_lag_of_a_spring_is_found_beside_its_drives_friction() -> None:
    found = known_from([*usual(), turned(QUICK_RAD_S, 0.3)]).theta

    # The prior pulls a little.
    assert found[5] == pytest.approx(LAG_S, rel=0.02)
    assert found[2:4] == pytest.approx(catalogued_drive(KIND)[2:4], rel=0.01)


def test_one_quick_swing_on_a_spring_that_lags_is_no_change_of_friction() -> None:
    quick = turned(QUICK_RAD_S, -1.2)
    # A model without the lag takes it for less friction: the motion would be an alarm.
    blind, less = change_of([without_rate(one) for one in usual()], without_rate(quick))
    assert blind.gain > ALARM
    assert less < -0.5

    assert change_of(usual(), quick)[0].gain < 0.01 * ALARM
    worn, more = change_of(usual(), turned(QUICK_RAD_S, -1.2, friction=4.0))
    assert worn.gain > ALARM
    assert more > 1.0


# Of both links, bending and twisting [1e-4 rad/Nm], and their hinges where they are expected: soft tubes.
COMPLIANCE = np.array([6.0, 15.0, 6.0, 15.0, *[0.0] * 6])
GIVING = MODEL._replace(compliance=COMPLIANCE)
# A ring of the joints on their springs.
RING_RAD_S, RING_RAD = 26.0, 0.04
# Turns are differentiated twice, less well at either end.
BEYOND_THE_ENDS = 40


def jolted(
    seed: int, more_giving: float = 0.0, moved: Chain = CHAIN, ring_rad: float = RING_RAD
) -> DataSegment:
    """Return half a second in which all joints ring on their springs, on links that give way.

    more_giving: by what share of the turns of the links these turn more than by `COMPLIANCE`.
    """
    rng = np.random.default_rng(seed)
    samples = np.arange(-BEYOND_THE_ENDS, SAMPLES + BEYOND_THE_ENDS)
    speed = RING_RAD_S * rng.uniform(0.9, 1.1, JOINTS)
    joints = swings(
        samples,
        rng.uniform(-0.5, 0.5, JOINTS),
        np.full(JOINTS, ring_rad),
        speed,
        rng.uniform(0.0, 6.28, JOINTS),
    )
    compliance = (1.0 + more_giving) * COMPLIANCE
    turns = estimated_turns(moved, KINDS, compliance, joints, RATE_HZ)
    ideal = readings_on(moved, body_motions(moved, *joints, turns=turns), turns)
    within = slice(BEYOND_THE_ENDS, -BEYOND_THE_ENDS)
    q, qd, qdd = (one[within] for one in joints)
    noise = rng.normal(size=(2, SAMPLES, JOINTS, 3))
    any_one = segments(0, 1)[0]
    return any_one._replace(
        q_rad=q,
        qd_rad_s=qd,
        qdd_rad_s2=qdd,
        gyro_rad_s=ideal.gyro_rad_s[within] + GYRO_SIGMA * noise[0],
        accel_m_s2=ideal.accel_m_s2[within] + ACCEL_SIGMA * noise[1],
    )


def link_test(model: ImuModel, before: list[DataSegment], likely: float = LIKELY) -> BaselineTest:
    """Return the test of links against what a robot did before."""
    known = without_own(joined([imu_evidence(model, one) for one in before]), model.own_sigma)
    links = link_changes(model.chain)
    usual = (likely / LARGE,) * len(links)
    return BaselineTest(known, model.own_sigma, model.prior_sigma, links, 1.0, usual)


def link_gains(model: ImuModel, before: list[DataSegment], later: list[DataSegment]) -> list[float]:
    """Return how much a displacement of each link explains."""
    seen = joined([imu_evidence(model, one) for one in later])
    return [one.gain for one in link_test(model, before).find(seen)]


def test_links_that_give_way_to_a_jolt_are_not_displaced() -> None:
    usual, jolt = segments(1, 40), [jolted(seed) for seed in range(6)]
    # The model of rigid links takes the jolt for a link that is displaced.
    assert max(link_gains(MODEL, usual, jolt)) > ALARM
    assert max(link_gains(GIVING, [*usual, *jolt[:3]], jolt[3:])) < ALARM


def test_a_displaced_link_is_seen_in_a_jolt() -> None:
    shift = np.eye(4)
    shift[:3, 3] = [0.006, 0.008, 0.0]
    moved = CHAIN._replace(
        point=CHAIN.point + shift[:3, 3] * [[0.0], [1.0], [1.0]],
        imu_home=np.stack([CHAIN.imu_home[0], shift @ CHAIN.imu_home[1], shift @ CHAIN.imu_home[2]]),
    )
    known = [jolted(seed) for seed in range(20)]
    later = joined([imu_evidence(GIVING, jolted(seed, moved=moved)) for seed in range(20, 30)])
    found = link_test(GIVING, known).find(later)
    best = most_of(found)
    assert found[best].gain > ALARM
    assert CHAIN.linked[best] == 1
    # Along the axis of the joint below nothing tells where it is.
    assert displacement(found[best].size)[1][:2] == pytest.approx([0.006, 0.008], abs=1e-3)


def test_a_link_that_turns_is_measured_at_its_imu() -> None:
    """The last link, by 30 mrad about the place of its IMU, six times what is likely: it is not made smaller,
    and not taken for a shift, although that IMU is 0.37 m from the base.
    """
    turn, place = np.array([0.0, 0.03, 0.0]), CHAIN.imu_home[2, :3, 3]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    pose[:3, 3] = place - pose[:3, :3] @ place
    moved = CHAIN._replace(
        axis=np.stack([*CHAIN.axis[:2], pose[:3, :3] @ CHAIN.axis[2]]),
        point=np.stack([*CHAIN.point[:2], pose[:3, :3] @ CHAIN.point[2] + pose[:3, 3]]),
        imu_home=np.stack([*CHAIN.imu_home[:2], pose @ CHAIN.imu_home[2]]),
    )
    later = []
    for one in segments(8, 10):
        joints = one.q_rad, one.qd_rad_s, one.qdd_rad_s2
        before, after = (readings_on(chain, body_motions(chain, *joints)) for chain in (CHAIN, moved))
        gyro = one.gyro_rad_s + after.gyro_rad_s - before.gyro_rad_s
        accel = one.accel_m_s2 + after.accel_m_s2 - before.accel_m_s2
        later.append(imu_evidence(MODEL, one._replace(gyro_rad_s=gyro, accel_m_s2=accel)))
    found = link_test(MODEL, segments(1, 60)).find(joined(later))[CHAIN.linked.index(2)]
    turned, shifted = displacement(found.size)
    sigma = LARGE * np.sqrt(np.diag(found.covariance))
    assert found.gain > ALARM
    assert np.all(np.abs(turned - turn) < 4.0 * sigma[:3] + 1e-3)
    assert np.all(np.abs(shifted) < 4.0 * sigma[3:] + 1e-3)


def test_the_noise_of_imus_is_not_what_jolts_leave_of_them() -> None:
    """Links turn by a sixth more than they are known to."""
    usual = segments(2, 30)
    jolts = [jolted(seed, more_giving=1.0 / 6.0, ring_rad=2.5 * RING_RAD) for seed in range(10)]
    before, after = imu_noise(GIVING, usual), imu_noise(GIVING, [*usual, *jolts])
    assert np.median(before / MODEL.sigma) == pytest.approx(1.0, abs=0.15)
    # Of one axis of 18 what is left lasts as long as a jolt; two thirds would have 1.3 to 3 times the noise.
    assert np.mean(after > 1.2 * before) <= 1.0 / 18.0
    assert np.median(after / before) == pytest.approx(1.0, abs=0.05)


def test_an_arm_that_hardly_moves_has_no_link_displaced_by_half_a_metre() -> None:
    """Something shakes an arm that stands, and its encoders show half of that."""
    rng = np.random.default_rng(5)
    still = np.zeros(JOINTS)
    q, qd, qdd = swings(np.arange(SAMPLES), still, still + 1.5e-4, still + 45.0, still)
    seen = readings_on(CHAIN, body_motions(CHAIN, q, 2.0 * qd, 2.0 * qdd))
    any_one = segments(0, 1)[0]._replace(q_rad=q, qd_rad_s=qd, qdd_rad_s2=qdd)
    shaken = []
    for _ in range(10):
        noise = rng.normal(size=(2, SAMPLES, JOINTS, 3))
        gyro, accel = seen.gyro_rad_s + GYRO_SIGMA * noise[0], seen.accel_m_s2 + ACCEL_SIGMA * noise[1]
        shaken.append(any_one._replace(gyro_rad_s=gyro, accel_m_s2=accel))
    later = joined([imu_evidence(MODEL, one) for one in shaken])
    # Of any size, a displacement explains it.
    assert max(one.gain for one in link_test(MODEL, segments(1, 40), LARGE).find(later)) > ALARM
    assert max(one.gain for one in link_test(MODEL, segments(1, 40)).find(later)) < ALARM


def test_slopes_are_those_of_what_imus_with_errors_read() -> None:
    """IMUs off by some percent, whose modules are displaced by a thousandth: evidence is that of a line."""
    rng = np.random.default_rng(6)
    errors = np.zeros((JOINTS, SIZE))
    errors[:, :18] = 0.05 * rng.normal(size=(JOINTS, 18))
    model = MODEL._replace(intrinsics=ImuIntrinsics(errors))
    one = segments(2, 1)[0]
    joints = one.q_rad, one.qd_rad_s, one.qdd_rad_s2
    delta = 1e-4 * rng.normal(size=6 * JOINTS)

    def vector(chain: Chain) -> Array:
        ideal = readings_on(chain, body_motions(chain, *joints))
        gyro, accel = read(model.intrinsics, ideal.gyro_rad_s, ideal.accel_m_s2, None)
        return imu_evidence(model, one._replace(gyro_rad_s=gyro, accel_m_s2=accel)).vector

    own = len(model.own_sigma)
    matrix = imu_evidence(model, one).matrix
    change = matrix[:, own : own + 6 * JOINTS] @ delta
    found = vector(apply_perturbation(CHAIN, delta)) - vector(CHAIN)
    # What is left is the square of the displacement.
    np.testing.assert_allclose(found, change, rtol=0.0, atol=2e-3 * np.abs(change).max())


def test_what_imus_read_near_the_ends_of_a_stretch_has_no_say() -> None:
    """How links turn takes the joints' fourth derivatives, which 40 ms from where samples end are poor."""
    jolt = jolted(3)
    gyro, accel = jolt.gyro_rad_s.copy(), jolt.accel_m_s2.copy()
    for ends in (slice(None, 10), slice(-10, None)):
        gyro[ends] += 0.5
        accel[ends] += 5.0
    without, whole = (
        imu_evidence(GIVING, jolt._replace(gyro_rad_s=gyro, accel_m_s2=accel)),
        imu_evidence(GIVING, jolt),
    )
    np.testing.assert_allclose(without.vector, whole.vector, rtol=1e-9, atol=1e-6)
    # In between they have.
    gyro[30:-30] += 0.5
    changed = imu_evidence(GIVING, jolt._replace(gyro_rad_s=gyro, accel_m_s2=accel))
    assert np.abs(changed.vector - whole.vector).max() > 1.0
