"""The predicted information of a circle: slopes are derivatives, and the bound is the closed form's."""

import numpy as np
import pytest

from coordinator.batch_estimation.imu_prediction import imu_readings
from coordinator.excitation.fisher_information import (
    CircleSetting,
    JointPath,
    SensorNoise,
    circle_covariance,
    circle_readings,
    circle_slopes,
    radial_directions,
)
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import BIASES_ONLY, CALIBRATED, UNCALIBRATED, ImuPrior

RATE_HZ = 250.0
NOTHING_UNKNOWN = ImuPrior(0.0, 0.0, 1e-9, 1e-9, 0.0, 0.0)


def sine(amplitude: float, frequency_hz: float, duration_s: float = 5.6) -> JointPath:
    t = np.arange(0.0, duration_s, 1.0 / RATE_HZ)
    w = 2 * np.pi * frequency_hz
    return JointPath(
        amplitude * np.sin(w * t),
        amplitude * w * np.cos(w * t),
        -amplitude * w**2 * np.sin(w * t),
        RATE_HZ,
    )


def random_setting(seed: int) -> CircleSetting:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    radial = rng.normal(size=3)
    radial = 0.3 * (radial - axis * (axis @ radial))
    gravity = rng.normal(size=3)
    return CircleSetting(axis, radial, 9.81 * gravity / np.linalg.norm(gravity))


def upright(length_m: float = 0.3) -> CircleSetting:
    """A link that sweeps a horizontal plane: gravity along the axis."""
    return CircleSetting(
        np.array([0.0, 0.0, 1.0]), np.array([length_m, 0.0, 0.0]), np.array([0.0, 0.0, 9.81])
    )


def hanging(length_m: float = 0.3) -> CircleSetting:
    """A link that swings in a vertical plane and hangs down."""
    return upright(length_m)._replace(gravity_m_s2=np.array([-9.81, 0.0, 0.0]))


@pytest.mark.parametrize("seed", range(4))
def test_the_model_is_that_of_a_chain_with_one_moving_joint(seed: int) -> None:
    setting, path = random_setting(seed), sine(0.3, 1.0, 1.0)
    homes = np.tile(np.eye(4), (2, 1, 1))
    homes[1, :3, 3] = setting.radial_m
    chain = Chain(
        serials=("A", "B"),
        parent=(-1, 0),
        reversed=(False, False),
        axis=np.array([setting.axis, setting.axis]),
        point=np.zeros((2, 3)),
        imu_home=homes,
        gravity=setting.gravity_m_s2,
    )
    both = [np.column_stack([one, np.zeros_like(one)]) for one in path[:3]]
    expected = imu_readings(chain, *both)
    found = circle_readings(setting, path)
    np.testing.assert_allclose(found[:3].T, expected.gyro_rad_s[:, 1], atol=1e-12)
    np.testing.assert_allclose(found[3:].T, expected.accel_m_s2[:, 1], atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_slopes_are_the_derivatives_of_the_readings(seed: int) -> None:
    setting, path = random_setting(seed), sine(0.4, 1.3, 1.0)
    across, step = radial_directions(setting), 1e-6

    def moved(k: int, size: float) -> CircleSetting:
        if k < 2:
            return setting._replace(radial_m=setting.radial_m + size * across[k])
        if k < 4:
            return setting._replace(axis=setting.axis + size * np.cross(across[k - 2], setting.axis))
        return setting._replace(gravity_m_s2=setting.gravity_m_s2 + size * np.eye(3)[k - 4])

    def read(at: CircleSetting) -> np.ndarray:
        # An axis that leaves the radial vector's plane: -r w^2 is j x (j x r) w^2 then.
        plain = circle_readings(at, path)
        plain[3:] += np.outer(at.axis, at.axis @ at.radial_m * path.qd_rad_s**2)
        return plain

    for k, slope in enumerate(circle_slopes(setting, path)):
        numeric = (read(moved(k, step)) - read(moved(k, -step))) / (2 * step)
        np.testing.assert_allclose(slope, numeric, atol=2e-7, rtol=1e-6)


def test_with_all_else_known_the_bound_is_the_closed_form() -> None:
    path = sine(0.09, 2.0)
    noise = SensorNoise(1e-9, 0.0294)
    setting = upright()
    found = circle_covariance(setting, [path], noise, NOTHING_UNKNOWN)
    # Tangential alpha and centripetal omega^2 both depend on the radius; gravity that is unknown but for a
    # bias of 1e-9 is one more unknown of three, which costs the part of both that does not change: none of
    # alpha, and the mean of omega^2.
    alpha2 = np.sum(path.qdd_rad_s2**2)
    assert np.sqrt(found[0, 0]) == pytest.approx(noise.accel_m_s2 / np.sqrt(alpha2), rel=0.05)


def test_twice_the_time_halves_the_variance_where_noise_is_all_there_is() -> None:
    path, noise = sine(0.15, 1.0), SensorNoise()
    once, twice = (circle_covariance(upright(), [path] * n, noise, BIASES_ONLY) for n in (1, 2))
    # A little more than half of the radius' is left: the bias is not quite unknown beforehand either.
    np.testing.assert_allclose(np.diag(twice)[:4], 0.5 * np.diag(once)[:4], rtol=0.1)


def test_gravity_calibrates_the_scale_of_a_link_that_swings_in_it_and_not_of_one_that_does_not() -> None:
    motions, noise = [sine(0.15, 1.0), sine(1.0, 0.2, 5.0)], SensorNoise()
    swinging, flat = (
        np.sqrt(circle_covariance(s, motions, noise, UNCALIBRATED)[0, 0]) for s in (hanging(), upright())
    )
    # Two axes with scales known to 1 % determine 0.3 m to 3 mm / sqrt(2); gravity is known to 0.2 %.
    assert flat == pytest.approx(2.1e-3, rel=0.1)
    assert swinging < 0.5 * flat
    assert np.sqrt(circle_covariance(upright(), motions, noise, CALIBRATED)[0, 0]) < 0.3e-3


def test_no_motion_is_refused() -> None:
    with pytest.raises(DataError, match="no motion"):
        circle_covariance(hanging(), [], SensorNoise(), CALIBRATED)
