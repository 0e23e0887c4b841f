"""Local estimates as observations of the chain: how far they are believed."""

import numpy as np
import pytest

from coordinator.kinematics.chain_observations import circle_observation
from module_agent.wire.messages import CircleEstimate, Estimate

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
Q_RAD = np.array([0.1, -0.2])


def estimate(circle: CircleEstimate | None, rate_ratio: float = 1.0) -> Estimate:
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
    )


def test_a_circle_is_believed_as_far_as_it_claims() -> None:
    found = circle_observation(estimate(CIRCLE), Q_RAD)
    assert found is not None
    assert (found.joint, found.observer) == ("parent", "child")
    assert found.radial_m[0] == 0.353
    assert (found.sigma_axis_rad, found.sigma_distance_m) == (1e-3, 2e-3)
    np.testing.assert_array_equal(found.q_rad, Q_RAD)


def test_without_a_circle_there_is_nothing_to_observe() -> None:
    assert circle_observation(estimate(None), Q_RAD) is None


@pytest.mark.parametrize("rate_ratio", [0.98, 1.02])
def test_an_imu_that_turned_by_more_or_less_than_the_joint_is_believed_less(rate_ratio: float) -> None:
    found = circle_observation(estimate(CIRCLE, rate_ratio), Q_RAD)
    assert found is not None
    assert found.sigma_axis_rad == pytest.approx(1e-3 + 0.02)
    assert found.sigma_distance_m == pytest.approx(2e-3 + 0.02 * 0.353)
