"""Unobservable motions have the right names and leave every observation unchanged."""

from typing import Any

import numpy as np
import pytest

from coordinator.kinematics.assembly import assemble
from coordinator.kinematics.chain_observations import pack, residuals
from coordinator.kinematics.null_space import name_null_space
from module_agent.model.perturbation import apply_perturbation


@pytest.mark.parametrize("seed", range(8))
def test_moving_along_a_named_direction_by_any_amount_changes_no_observation(robots: Any, seed: int) -> None:
    chain, types = robots.random(seed, joints=3 + seed % 4, roots=1 + seed % 2)
    if seed % 3 == 0:
        chain = chain._replace(gravity=9.81 * chain.axis[0])
    positions = robots.positions(chain, seed)
    pairs, rests = robots.observe(chain, positions), [robots.rest(chain, positions[0])]
    fit = assemble(robots.topology(chain), types, pairs, rests)
    seen = pack(chain.serials, pairs, rests)
    directions = [d for item in fit.estimate.unresolved for d in item.directions.T]
    assert len(directions) == fit.estimate.null_basis.shape[1]
    for direction in directions:
        moved = apply_perturbation(fit.chain, 1.3 * direction)  # no small amount: 1.3 m, or 1.3 rad
        # Residuals are in sigmas; rounding of 1e-12 m over 0.3 mm is far below.
        np.testing.assert_allclose(residuals(moved, seen), residuals(fit.chain, seen), atol=1e-5)


def test_named_directions_span_the_null_space(robots: Any) -> None:
    chain, types = robots.random(2, joints=6, roots=2)
    positions = robots.positions(chain, 2)
    pairs, rests = robots.observe(chain, positions), [robots.rest(chain, positions[0])]
    fit = assemble(robots.topology(chain), types, pairs, rests)
    named = np.concatenate([u.directions for u in fit.estimate.unresolved], axis=1)
    outside = named - fit.estimate.null_basis @ (fit.estimate.null_basis.T @ named)
    np.testing.assert_allclose(outside, 0.0, atol=1e-6)
    assert np.linalg.matrix_rank(named) == fit.estimate.null_basis.shape[1]


def test_a_direction_that_has_no_name_is_reported_as_a_combination(robots: Any) -> None:
    chain, _ = robots.random(4, joints=4, serial=True)
    odd = np.zeros((24, 1))
    odd[6:12, 0], odd[18:, 0] = [0.1, 0.2, 0.0, 0.0, 0.5, 0.3], [0.0, 0.3, 0.0, 0.4, 0.0, 0.0]
    (item,) = name_null_space(chain, odd / np.linalg.norm(odd))
    assert item.kind == "combination"
    assert item.modules == ("M01", "M03")
    assert "M01, M03" in item.text


def test_nothing_open_means_nothing_reported(robots: Any) -> None:
    chain, _ = robots.random(4, joints=3)
    assert name_null_space(chain, np.zeros((18, 0))) == ()
