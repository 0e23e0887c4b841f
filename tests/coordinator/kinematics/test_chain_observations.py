"""Weights of observations from local estimates, and the Jacobian against numerical differences."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coordinator.kinematics.chain_observations import (
    circle_observation,
    jacobian,
    joint_observation,
    pack,
    predict,
    residuals,
)
from module_agent.model.perturbation import apply_perturbation
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


def test_a_regression_is_preferred_to_a_circle() -> None:
    known: dict[str, Any] = {"axis": (0.0, 0.0, 1.0), "radial_m": (0.350, 0.0, 0.0), "distance_m": 0.350}
    none = (0.0, 0.0, 0.0)
    regression = RegressionEstimate(
        **known,
        sigma_axis_rad=1e-4,
        sigma_distance_m=2e-4,
        covariance=(0.0,) * 21,
        gravity_m_s2=none,
        gyro_bias_rad_s=none,
        accel_bias_m_s2=none,
        compliance_s2=0.0,
        delay_s=0.0,
        base_shakes=False,
        samples=200,
    )
    found = joint_observation(estimate(CIRCLE).model_copy(update={"regression": regression}), Q_RAD)
    assert found is not None
    assert (found.radial_m[0], found.sigma_distance_m) == (0.350, 2e-4)
    by_circle = joint_observation(estimate(CIRCLE), Q_RAD)
    assert by_circle is not None
    assert by_circle.radial_m[0] == 0.353


@pytest.mark.parametrize("rate_ratio", [0.98, 1.02])
def test_an_imu_that_turned_by_more_or_less_than_the_joint_is_believed_less(rate_ratio: float) -> None:
    found = circle_observation(estimate(CIRCLE, rate_ratio), Q_RAD)
    assert found is not None
    assert found.sigma_axis_rad == pytest.approx(1e-3 + 0.02)
    assert found.sigma_distance_m == pytest.approx(2e-3 + 0.02 * 0.353)


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobian_is_the_slope_of_the_residuals_of_any_tree(robots: Any, seed: int) -> None:
    chain, _ = robots.random(seed, joints=2 + seed)
    positions = robots.positions(chain, seed)
    rests = [robots.rest(chain, positions[0], 0.02), robots.rest(chain, positions[1], 0.01)]
    seen = pack(chain.serials, robots.observe(chain, positions), rests)
    rng = np.random.default_rng(seed)
    width = 6 * len(chain.serials)
    elsewhere = apply_perturbation(chain, rng.normal(0, 0.05, width))
    slopes = jacobian(elsewhere, seen)
    step = 1e-6
    for column in range(width + 3):
        ends = []
        for sign in (1.0, -1.0):
            delta = np.zeros(width + 3)
            delta[column] = sign * step
            turn = Rotation.from_rotvec(delta[width:])
            moved = apply_perturbation(elsewhere, delta[:width])
            ends.append(residuals(moved._replace(gravity=turn.apply(moved.gravity)), seen))
        numeric = (ends[0] - ends[1]) / (2 * step)
        # Second differences of weights up to 1/(0.3 mm): 3000 * 1e-12 / 1e-6, and rounding of the same size.
        np.testing.assert_allclose(slopes[:, column], numeric, atol=1e-4)


def test_predictions_are_what_an_imu_sees_of_a_turning_joint(robots: Any) -> None:
    chain, _ = robots.random(9, joints=6)
    positions = robots.positions(chain, 9)
    pairs = robots.observe(chain, positions)
    rest = robots.rest(chain, positions[2])
    seen = pack(chain.serials, pairs, [rest])
    found = predict(chain, seen)
    others = [p for p in pairs if p.joint != p.observer]
    np.testing.assert_allclose(found.axis, [p.axis for p in others], atol=1e-9)
    np.testing.assert_allclose(found.radial_m, [p.radial_m for p in others], atol=1e-9)
    np.testing.assert_allclose(robots.gravity_m_s2 * found.gravity, rest.specific_force_m_s2, atol=1e-9)
    np.testing.assert_allclose(residuals(chain, seen), 0.0, atol=1e-6)
