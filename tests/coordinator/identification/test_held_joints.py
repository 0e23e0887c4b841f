"""A joint that gives way while it is held, and what that looks like in healthy sensors."""

import numpy as np
import pytest

from coordinator.identification.finding import Finding, Sickness
from coordinator.identification.held_joints import GivenWay, explained, given_way
from coordinator.identification.sensor_checks import EXPLORATION
from coordinator.synchronisation.motion_windows import RATE_HZ, Window
from module_agent.model.catalogue import GRAVITY_M_S2
from module_agent.model.chain import Array

SERIALS = ("A", "B", "C")
MOTION = "the constant motion of A"
# How B gives way: 0.01 rad to either side, 0.5 times a second.
AMPLITUDE_RAD, OMEGA = 0.01, np.pi
NOISE = np.full((1, 3), 1e-3)


def turned(amplitude_rad: float) -> Window:
    t_s = np.arange(10 * RATE_HZ) / RATE_HZ
    q = np.zeros((len(t_s), 3))
    q[:, 0], q[:, 1] = np.sin(t_s), amplitude_rad * np.sin(OMEGA * t_s)
    still = np.zeros((len(t_s), 3, 3))
    return Window(np.round(1e9 * t_s).astype(np.int64), q, np.zeros_like(q), still, still, np.zeros(3))


def given(amplitude_rad: float, noise: Array = NOISE) -> list[GivenWay]:
    return given_way(SERIALS, ["B"], [turned(amplitude_rad)], noise, [MOTION])


def contradiction(
    serial: str, kind: Sickness, measured: float, motion: str = MOTION, serious: bool = True
) -> Finding:
    return Finding(serial, motion, "it", measured, 0.0, 50.0, "", "sick", kind, serious)


def test_what_a_joint_that_gave_way_adds_to_the_readings_beyond_it_follows_from_its_encoder() -> None:
    (found,) = given(AMPLITUDE_RAD)
    rms = AMPLITUDE_RAD / np.sqrt(2.0)
    assert (found.serial, found.motion) == ("B", MOTION)
    assert found.travel_rad == pytest.approx(2.0 * AMPLITUDE_RAD, rel=0.02)
    assert found.gyro_rad_s == pytest.approx(OMEGA * rms, rel=0.02)
    assert found.sigmas == pytest.approx(OMEGA * rms / 1e-3, rel=0.02)
    # It tilts against gravity, and accelerates what is within two metres of it.
    assert found.accel_m_s2 == pytest.approx((GRAVITY_M_S2 + 2.0 * OMEGA**2) * rms, rel=0.02)


def test_joints_that_moved_by_themselves_and_what_no_gyro_sees_are_nothing_that_gave_way() -> None:
    assert given(AMPLITUDE_RAD, noise=100.0 * NOISE) == []
    assert given_way(SERIALS, [], [turned(AMPLITUDE_RAD)], NOISE, [MOTION]) == []


def test_a_joint_that_gave_way_is_accused_in_the_place_of_the_sensors_that_it_turned() -> None:
    seen = [
        contradiction("C", "gyro_contradicts", 0.02),
        contradiction("C", "imu_error", 0.1, EXPLORATION),
        # It may be mounted in reverse.
        contradiction("B", "accelerometer_contradicts", 0.1),
    ]
    joint, *others = explained(seen, given(AMPLITUDE_RAD))
    assert (joint.serial, joint.kind, joint.serious) == ("B", "joint_gives", True)
    assert [other.serious for other in others] == [False, False, False]
    assert all("joint B gave way" in other.summary for other in others)


@pytest.mark.parametrize(
    "seen",
    [
        # More than the joint turned, of another sort, in another motion.
        contradiction("C", "gyro_contradicts", 0.04),
        contradiction("C", "accelerometer_contradicts", 0.4),
        contradiction("C", "encoder_scale", 0.02),
        contradiction("C", "gyro_contradicts", 0.02, "the constant motion of C"),
    ],
)
def test_what_it_cannot_have_turned_accuses_the_sensor(seen: Finding) -> None:
    assert explained([seen], given(AMPLITUDE_RAD)) == [seen]


def test_a_joint_that_gave_way_is_no_more_serious_than_what_it_explains() -> None:
    assert explained([], given(AMPLITUDE_RAD)) == []
    mild = contradiction("C", "gyro_contradicts", 0.02, serious=False)
    assert not any(one.serious for one in explained([mild], given(AMPLITUDE_RAD)))
