"""The angle between axes does not depend on turns about, or shifts along, the parent's axis."""

from typing import Any

import numpy as np

from coordinator.kinematics.frames import axis_angles
from module_agent.model.perturbation import apply_perturbation


def test_the_sigma_is_the_spread_of_many_robots_drawn_from_the_chains(robots: Any) -> None:
    chain, _ = robots.random(3, joints=4)
    rng = np.random.default_rng(5)
    root = rng.normal(size=(24, 24)) * 1e-4
    root[:6] = 0.0
    angle, sigma = axis_angles(chain, root @ root.T)
    drawn = [
        axis_angles(apply_perturbation(chain, root @ rng.normal(size=24)), np.zeros((24, 24)))[0]
        for _ in range(4000)
    ]
    assert np.isnan(angle[0])
    # 4000 draws determine a sigma to 1.1 %.
    np.testing.assert_allclose(np.std(drawn, axis=0)[1:], sigma[1:], rtol=0.05)
    cosine = np.sum(chain.axis[list(chain.parent)[1:]] * chain.axis[1:], axis=1)
    np.testing.assert_allclose(np.cos(angle[1:]), cosine, atol=1e-12)


def test_a_turn_about_the_parents_axis_changes_nothing_and_costs_nothing(robots: Any) -> None:
    chain, _ = robots.random(7, joints=2)
    twist = np.concatenate([np.zeros(6), chain.axis[0], np.cross(chain.point[0], chain.axis[0])])
    turned, _ = axis_angles(apply_perturbation(chain, 0.8 * twist), np.zeros((12, 12)))
    angle, sigma = axis_angles(chain, np.outer(twist, twist))
    np.testing.assert_allclose(turned[1], angle[1], atol=1e-12)
    np.testing.assert_allclose(sigma[1], 0.0, atol=1e-12)


def test_of_parallel_axes_any_tilt_counts(robots: Any) -> None:
    chain, _ = robots.random(2, joints=2)
    parallel = chain._replace(axis=np.array([chain.axis[0], -chain.axis[0]]))
    angle, sigma = axis_angles(parallel, np.diag([0.0] * 6 + [1e-6] * 6))
    np.testing.assert_allclose(angle[1], np.pi, atol=1e-7)
    np.testing.assert_allclose(sigma[1], np.sqrt(2e-6))
