"""Local estimates as observations of the chain: which is taken, and how far it is believed."""

import numpy as np
import pytest

from coordinator.kinematics.pair_estimate import pair_observation
from module_agent.wire.messages import CircleEstimate, Estimate, RegressionEstimate

CIRCLE = CircleEstimate(
    axis=(0.0, 0.0, 1.0),
    tangent=(0.0, 1.0, 0.0),
    radial_m=(0.353, 0.0, 0.0),
    distance_m=0.353,
    sigma_axis_rad=1e-3,
    sigma_distance_m=2e-3,
    residual_rms_m_s2=0.03,
    singular_values=(3.0, 0.1, 0.03),
    delay_s=0.002,
    samples=1400,
)
REGRESSION = RegressionEstimate(
    axis=(0.0, 0.0, 1.0),
    radial_m=(0.350, 0.0, 0.0),
    distance_m=0.350,
    sigma_axis_rad=5e-4,
    sigma_distance_m=1e-4,
    covariance=(0.0,) * 21,
    gravity_m_s2=(0.0, 9.81, 0.0),
    gyro_bias_rad_s=(0.0, 0.0, 0.0),
    accel_bias_m_s2=(0.0, 0.0, 0.0),
    compliance_s2=0.0,
    delay_s=0.002,
    base_shakes=False,
    samples=240,
)
Q_RAD = np.array([0.1, -0.2])


def estimate(
    circle: CircleEstimate | None, regression: RegressionEstimate | None, rate_ratio: float = 1.0
) -> Estimate:
    return Estimate(
        serial="child",
        boot=1,
        seq=1,
        joint="parent",
        motion_ids=(1, 2),
        moved=True,
        rate_ratio=rate_ratio,
        gravity_m_s2=(0.0, 9.81, 0.0),
        circle=circle,
        regression=regression,
    )


def test_the_regression_is_taken_before_the_circle() -> None:
    found = pair_observation(estimate(CIRCLE, REGRESSION), Q_RAD)
    assert found is not None
    assert (found.joint, found.observer) == ("parent", "child")
    assert found.radial_m[0] == 0.350
    assert (found.sigma_axis_rad, found.sigma_distance_m) == (5e-4, 1e-4)
    np.testing.assert_array_equal(found.q_rad, Q_RAD)


def test_a_recording_of_agents_without_regression_gives_the_circle() -> None:
    found = pair_observation(estimate(CIRCLE, None), Q_RAD)
    assert found is not None
    assert (found.radial_m[0], found.sigma_distance_m) == (0.353, 2e-3)
    assert pair_observation(estimate(None, None), Q_RAD) is None


def test_an_imu_that_turned_by_more_than_the_joint_is_believed_less() -> None:
    found = pair_observation(estimate(CIRCLE, REGRESSION, rate_ratio=0.98), Q_RAD)
    assert found is not None
    assert found.sigma_distance_m == pytest.approx(1e-4 + 0.02 * 0.350)
    # The spring of a held joint in between: 1 % more than the encoder at 2 Hz.
    giving = REGRESSION.model_copy(update={"compliance_s2": 0.01 / (4.0 * np.pi) ** 2})
    found = pair_observation(estimate(CIRCLE, giving), Q_RAD)
    assert found is not None
    assert found.sigma_axis_rad == pytest.approx(5e-4 + 0.01)
    assert found.sigma_distance_m == pytest.approx(1e-4 + 0.01 * 0.350)
