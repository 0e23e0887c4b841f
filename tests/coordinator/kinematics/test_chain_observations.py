"""The Jacobian of the assembly must be the slope of its residuals."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coordinator.kinematics.chain_observations import jacobian, pack, predict, residuals
from module_agent.model.perturbation import apply_perturbation


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
