"""Axes and lever arms of synthetic IMUs on both sides of a joint are recovered within three sigma."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coordinator.kinematics.encoder_joint import link_from_joint
from coordinator.kinematics.imu_pair import ImuLink, link_from_imus
from module_agent.model.chain import Array
from module_agent.model.errors import DataError

RATE_HZ, LASTING_S = 250.0, 24.0
GYRO_NOISE, ACCEL_NOISE = 2e-3, 0.03
G = np.array([0.0, 0.0, 9.81])
STEP_S = 2e-4


class Truth(NamedTuple):
    """Axes and lever arms in the IMUs' frames, the rotation of side 2 at q = 0, biases (2, 6)."""

    axis: Array
    arm: Array
    mounting: Rotation
    bias: Array


class Readings(NamedTuple):
    t_s: Array
    gyro: Array
    accel: Array
    q_rad: Array


def truth(seed: int, biased: bool = False) -> Truth:
    """A joint whose axis is `axis[0]` on side 1; side 2 is mounted anyhow."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    if axis[int(np.argmax(np.abs(axis)))] < 0.0:
        axis = -axis
    mounting = Rotation.random(rng=rng)
    bias = np.hstack([rng.normal(scale=0.02, size=(2, 3)), rng.normal(scale=0.1, size=(2, 3))])
    return Truth(
        np.stack([axis, mounting.inv().apply(axis)]),
        rng.uniform(-0.3, 0.3, (2, 3)),
        mounting,
        bias if biased else np.zeros((2, 6)),
    )


def _sines(t_s: Array, rng: np.random.Generator, size: float) -> Array:
    """Sums of sines (m, 3) of 0.2 to 1.5 Hz."""
    frequency, phase = rng.uniform(0.2, 1.5, (3, 3)), rng.uniform(0.0, 2.0 * np.pi, (3, 3))
    return np.asarray(size / 3.0 * np.sin(2.0 * np.pi * frequency * t_s[:, None, None] + phase).sum(axis=2))


def read(known: Truth, seed: int, turning: float, noise: float = 1.0) -> Readings:
    """What both IMUs read while the joint moves and side 1 turns by `turning` [rad] and shifts with it."""
    t_s = np.arange(int(RATE_HZ * LASTING_S)) / RATE_HZ

    def poses(at_s: Array) -> tuple[list[Rotation], list[Array], Array]:
        again = np.random.default_rng(1000 + seed)
        q = 2.0 * _sines(at_s, again, 1.0)[:, 0]
        side_1 = Rotation.from_rotvec([0.3, -0.5, 0.2]) * Rotation.from_euler(
            "xyz", _sines(at_s, again, turning)
        )
        centre = _sines(at_s, again, 0.2 * turning)
        side_2 = side_1 * Rotation.from_rotvec(q[:, None] * known.axis[0]) * known.mounting
        turns = [side_1, side_2]
        places = [centre + turn.apply(arm) for turn, arm in zip(turns, known.arm, strict=True)]
        return turns, places, q

    before, here, after = (poses(t_s + shift) for shift in (-STEP_S, 0.0, STEP_S))
    rng = np.random.default_rng(seed)
    gyro, accel = [], []
    for i in range(2):
        gyro.append((before[0][i].inv() * after[0][i]).as_rotvec() / (2.0 * STEP_S))
        pushed = (before[1][i] - 2.0 * here[1][i] + after[1][i]) / STEP_S**2 + G
        accel.append(here[0][i].inv().apply(pushed))
        gyro[i] = gyro[i] + known.bias[i, :3] + noise * GYRO_NOISE * rng.normal(size=gyro[i].shape)
        accel[i] = accel[i] + known.bias[i, 3:] + noise * ACCEL_NOISE * rng.normal(size=accel[i].shape)
    return Readings(t_s, np.array(gyro), np.array(accel), here[2])


def fit(seen: Readings) -> ImuLink:
    return link_from_imus(seen.t_s, seen.gyro[0], seen.accel[0], seen.gyro[1], seen.accel[1])


def excess(found: ImuLink, known: Truth) -> Array:
    """Errors of axes and lever arms (along the axis: their difference) in standard deviations."""
    frames = (found.frame_1, found.frame_2)
    sigma = np.sqrt(np.diag(found.covariance))
    # A turn about x moves the axis towards -y, one about y towards x.
    axes = [frame[:, [1, 0]].T @ axis for frame, axis in zip(frames, known.axis, strict=True)]
    arms = [
        frame.T @ (arm - true)
        for frame, arm, true in zip(frames, (found.arm_1_m, found.arm_2_m), known.arm, strict=True)
    ]
    along = np.zeros(11)
    along[[7, 10]] = 1.0, -1.0
    spread = float(np.sqrt(along @ found.covariance @ along))
    errors = np.concatenate([*axes, arms[0][:2], arms[1][:2], [arms[0][2] - arms[1][2]]])
    return np.abs(errors / np.concatenate([sigma[[0, 1, 2, 3, 5, 6, 8, 9]], [spread]]))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("biased", [False, True])
def test_a_joint_between_moving_imus_comes_out_within_three_sigma(seed: int, biased: bool) -> None:
    known = truth(seed, biased)
    seen = read(known, seed, turning=0.8)
    found = fit(seen)
    assert excess(found, known).max() < 3.0
    assert found.sigma_distance_m.max() < 2e-3
    assert found.sigma_axis_rad.max() < 2e-3
    assert found.unresolved == ("the point on the axis, along it",)
    assert np.isinf(found.sigma_arm_m[:, 2]).all()
    distances = np.linalg.norm(np.cross(known.arm, known.axis), axis=1)
    assert (np.abs(found.distances_m - distances) < 3.0 * found.sigma_distance_m).all()
    assert found.opposite_sign_misfit > 3.0


def test_the_relative_rotation_follows_the_joint() -> None:
    known = truth(5)
    seen = read(known, 5, turning=0.8)
    found = fit(seen)
    q = np.interp(found.t_s, seen.t_s, seen.q_rad)
    np.testing.assert_allclose(found.angle_rad, q - q[0], atol=0.01)
    expected = (Rotation.from_rotvec(q[0] * known.axis[0]) * known.mounting).inv()
    assert (Rotation.from_matrix(found.rotation) * expected.inv()).magnitude() < 0.01


def test_what_a_base_at_rest_leaves_unresolved_is_named() -> None:
    known = truth(1)
    found = fit(read(known, 1, turning=0.0))
    named = " ".join(found.unresolved)
    for name in ("arm_1 along x", "arm_1 along y", "arm_1 along the axis", "arm_2 along the axis"):
        assert name in named
    # The fifth: everything may be turned about gravity, side 1 against the axis.
    assert found.null_basis.shape[1] == 5
    assert "axis_1" in named
    assert np.isinf(found.sigma_distance_m[0])
    axis = found.axis_2 * np.sign(found.axis_2 @ known.axis[1])
    assert np.linalg.norm(axis - known.axis[1]) < 3.0 * found.sigma_axis_rad[1]
    true = float(np.linalg.norm(np.cross(known.arm[1], known.axis[1])))
    assert abs(found.distances_m[1] - true) < 3.0 * found.sigma_distance_m[1]


def test_with_an_encoder_the_circle_of_one_imu_comes_out_within_three_sigma() -> None:
    known = truth(2)
    seen = read(known, 2, turning=0.0)
    found = link_from_joint(seen.t_s, seen.q_rad, seen.gyro[1], seen.accel[1])
    assert np.linalg.norm(found.axis - known.axis[1]) < 3.0 * found.sigma_axis_rad
    arm = known.arm[1] - known.axis[1] * (known.axis[1] @ known.arm[1])
    assert abs(found.distance_m - np.linalg.norm(arm)) < 3.0 * found.sigma_distance_m
    np.testing.assert_allclose(found.radial_m, arm, atol=3e-3)


def test_with_an_encoder_a_shaking_base_is_subtracted() -> None:
    known = truth(3)
    seen = read(known, 3, turning=0.01)
    found = link_from_joint(seen.t_s, seen.q_rad, seen.gyro[1], seen.accel[1], seen.gyro[0], seen.accel[0])
    arm = known.arm[1] - known.axis[1] * (known.axis[1] @ known.arm[1])
    assert found.base_shakes
    assert abs(found.distance_m - np.linalg.norm(arm)) < 3.0 * found.sigma_distance_m


def test_unsuitable_data_is_refused() -> None:
    seen = read(truth(0), 0, turning=0.5)
    with pytest.raises(ValueError, match="both gyro and accelerometer are needed"):
        link_from_joint(seen.t_s, seen.q_rad, seen.gyro[1], seen.accel[1], seen.gyro[0])
    with pytest.raises(DataError):
        link_from_joint(seen.t_s[:20], seen.q_rad[:20], seen.gyro[1, :20], seen.accel[1, :20])
    short = Readings(seen.t_s[:90], seen.gyro[:, :90], seen.accel[:, :90], seen.q_rad[:90])
    with pytest.raises(DataError, match="90 samples at 250 Hz"):
        fit(short)
    with pytest.raises(DataError, match="turned at"):
        fit(seen._replace(gyro=0.0 * seen.gyro))
    with pytest.raises(ValueError, match="not uniform"):
        fit(seen._replace(t_s=seen.t_s**1.2))
    with pytest.raises(ValueError, match="must have"):
        fit(seen._replace(gyro=seen.gyro[:, :-1]))
