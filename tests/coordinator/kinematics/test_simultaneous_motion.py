"""Topology, axes and radial vectors from one motion of all joints at once."""

from types import SimpleNamespace

import numpy as np
import pytest

from coordinator.batch_estimation.estimator import refine_chain
from coordinator.batch_estimation.imu_prediction import imu_readings
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.kinematics.assembly import assemble
from coordinator.kinematics.simultaneous_motion import (
    SimultaneousMotion,
    SimultaneousResponse,
    StillReading,
    circle_observations,
    motion_observations,
    simultaneous_response,
)
from coordinator.topology.topology import find_topology
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError

RATE_HZ = 250.0
DURATION_S = 12.0


def multi_sines(count: int, slow_rad: float = 0.2, fast_rad: float = 0.03) -> tuple[np.ndarray, ...]:
    """Positions, rates and accelerations (m, n): every joint at two frequencies of its own."""
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)[:, None]
    slow, fast = 2 * np.pi * np.linspace(0.2, 0.6, count), 2 * np.pi * np.linspace(1.0, 2.2, count)
    # Begins at q = 0, where the rest was read.
    return (
        slow_rad * np.sin(slow * t) + fast_rad * np.sin(fast * t),
        slow_rad * slow * np.cos(slow * t) + fast_rad * fast * np.cos(fast * t),
        -slow_rad * slow**2 * np.sin(slow * t) - fast_rad * fast**2 * np.sin(fast * t),
    )


def moved(chain: Chain, seed: int, noise: float = 1.0) -> tuple[SimultaneousMotion, StillReading]:
    """What IMUs with white noise and gyro offsets read of a robot that moves all joints."""
    rng = np.random.default_rng(seed)
    count = len(chain.serials)
    q, qd, qdd = multi_sines(count)
    gyro, accel = imu_readings(chain, q, qd, qdd)
    rest = imu_readings(chain, np.zeros((1, count)), np.zeros((1, count)), np.zeros((1, count)))
    offset = rng.normal(0.0, 0.02, (count, 3))
    data = SimultaneousMotion(
        q,
        qd,
        qdd,
        gyro + offset + noise * rng.normal(0.0, 2e-3, gyro.shape),
        accel + noise * rng.normal(0.0, 0.03, accel.shape),
    )
    return data, StillReading(rest.gyro_rad_s[0] + offset, rest.accel_m_s2[0])


def answered(chain: Chain, seed: int) -> SimultaneousResponse:
    return simultaneous_response(chain.serials, *moved(chain, seed), RATE_HZ, 15.0)


@pytest.mark.parametrize("seed", range(6))
def test_the_tree_is_found_with_reversed_modules_and_several_roots(
    robots: SimpleNamespace, seed: int
) -> None:
    chain, _ = robots.random(seed, joints=7, roots=1 + seed % 2)
    found = find_topology(motion_observations(chain.serials, answered(chain, seed)))
    parents = {
        s: None if p < 0 else found.serials[p] for s, p in zip(found.serials, found.parent, strict=True)
    }
    true = {s: None if p < 0 else chain.serials[p] for s, p in zip(chain.serials, chain.parent, strict=True)}
    assert parents == true
    assert dict(zip(found.serials, found.reversed, strict=True)) == dict(
        zip(chain.serials, chain.reversed, strict=True)
    )
    assert found.confidence > 0.3


@pytest.mark.parametrize("seed", range(4))
def test_circles_are_near_the_true_ones_and_within_what_is_claimed_of_them(
    robots: SimpleNamespace, seed: int
) -> None:
    chain, _ = robots.random(10 + seed, joints=6, serial=True)
    response = answered(chain, seed)
    found = circle_observations(chain.serials, response)
    index = {serial: k for k, serial in enumerate(chain.serials)}
    carried = [(i, k) for k in range(6) for i in chain.ancestors(chain.carrier(k)) if i != k]
    assert sorted((index[p.joint], index[p.observer]) for p in found) == sorted(carried)
    axis_off, radius_off = [], []
    for pair in found:
        axis, radial = robots.circle(chain, index[pair.joint], index[pair.observer], response.q_mean_rad)
        assert axis @ pair.axis > 0.9
        axis_off.append(np.linalg.norm(np.cross(axis, pair.axis)) / pair.sigma_axis_rad)
        radius_off.append(np.linalg.norm(radial - pair.radial_m) / pair.sigma_distance_m)
    # Two components each, of one sigma: rms 1.4. A third of 15 to 30 pairs may be twice that.
    assert np.sqrt(np.mean(np.square(axis_off))) < 2.0
    assert np.sqrt(np.mean(np.square(radius_off))) < 2.0


@pytest.mark.parametrize("seed", range(4))
def test_the_refinement_ends_where_it_would_have_ended_from_the_true_robot(
    robots: SimpleNamespace, seed: int
) -> None:
    chain, types = robots.random(20 + seed, joints=6, serial=True)
    data, still = moved(chain, seed)
    response = simultaneous_response(chain.serials, data, still, RATE_HZ, 15.0)
    topology = find_topology(motion_observations(chain.serials, response))
    rest = robots.rest(chain, np.zeros(6))
    first = assemble(topology, types, circle_observations(chain.serials, response), [rest])
    sparse = SensorData(*(signal[::5] for signal in data))
    rng = np.random.default_rng(seed)
    motion = [rng.normal(0.0, size, (50, 6)) for size in (0.3, 1.0, 3.0)]
    # Unobservable directions differ with the start; the readings of any motion do not.
    own, true = (imu_readings(refine_chain(start, sparse).chain, *motion) for start in (first.chain, chain))
    np.testing.assert_allclose(own.gyro_rad_s, true.gyro_rad_s, atol=1e-6)
    np.testing.assert_allclose(own.accel_m_s2, true.accel_m_s2, atol=1e-5)


def test_without_noise_the_gyro_answers_a_single_joint_exactly(robots: SimpleNamespace) -> None:
    chain, _ = robots.random(31, joints=2, serial=True)
    data, _ = moved(chain, 0, noise=0.0)
    alone = data._replace(
        q_rad=data.q_rad[:, :1], qd_rad_s=data.qd_rad_s[:, :1], qdd_rad_s2=data.qdd_rad_s2[:, :1]
    )
    q = np.concatenate([alone.q_rad, np.zeros_like(alone.q_rad)], axis=1)
    qd = np.concatenate([alone.qd_rad_s, np.zeros_like(alone.q_rad)], axis=1)
    qdd = np.concatenate([alone.qdd_rad_s2, np.zeros_like(alone.q_rad)], axis=1)
    gyro, accel = imu_readings(chain, q, qd, qdd)
    seen = alone._replace(gyro_rad_s=gyro[:, 1:], accel_m_s2=accel[:, 1:])
    still = StillReading(np.zeros((1, 3)), accel[:1, 1])
    response = simultaneous_response(chain.serials[1:], seen, still, RATE_HZ, 15.0)
    axis, radial = robots.circle(chain, 0, 1, np.zeros(2))
    np.testing.assert_allclose(response.axis[0, 0], axis, atol=1e-9)
    # Integrating the gyro by the trapezoid rule at 250 Hz turns gravity wrongly by some microradians.
    np.testing.assert_allclose(np.cross(response.tangential_m[0, 0], axis), radial, atol=1e-4)


def test_joints_that_moved_alike_are_named() -> None:
    q, qd, qdd = multi_sines(3)
    qd[:, 2] = 2.0 * qd[:, 0]
    data = SimultaneousMotion(q, qd, qdd, np.zeros((len(q), 3, 3)), np.zeros((len(q), 3, 3)))
    with pytest.raises(DataError, match="joints A and C moved alike"):
        simultaneous_response("ABC", data, StillReading(np.zeros((3, 3)), np.zeros((3, 3))), RATE_HZ, 15.0)


def test_a_joint_that_did_not_turn_is_named() -> None:
    q, qd, qdd = multi_sines(3)
    qd[:, 1] = 0.0
    data = SimultaneousMotion(q, qd, qdd, np.zeros((len(q), 3, 3)), np.zeros((len(q), 3, 3)))
    with pytest.raises(DataError, match=r"joint B turned at only 0 rad/s"):
        simultaneous_response("ABC", data, StillReading(np.zeros((3, 3)), np.zeros((3, 3))), RATE_HZ, 15.0)


@pytest.mark.parametrize("samples", [0, 1, 31])
def test_modules_that_have_hardly_a_sample_at_the_same_times_are_no_response(
    robots: SimpleNamespace, samples: int
) -> None:
    chain, _ = robots.random(1, joints=3)
    data, still = moved(chain, 1)
    few = SimultaneousMotion(*(part[:samples] for part in data))
    with pytest.raises(DataError, match=f"have {samples} samples of the motion of all joints, at least 32"):
        simultaneous_response(chain.serials, few, still, RATE_HZ, 15.0)
