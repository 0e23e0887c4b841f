"""Real bodies are told from impossible ones, and the nearest real body is one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng

from coordinator.dynamics.pseudo_inertia import (
    REACH_M,
    body,
    is_consistent,
    nearest_consistent,
    parameters,
    pseudo_inertia,
)
from module_agent.model.chain import Array

UPPER = np.triu_indices(3)


def of_point_masses(masses: Array, places: Array) -> Array:
    inertia = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, places, strict=True))
    return np.concatenate([[masses.sum()], masses @ places, np.asarray(inertia)[UPPER]])


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_cloud_of_masses_is_a_real_body(seed: int) -> None:
    rng = default_rng(seed)
    masses, places = rng.uniform(0.01, 1.0, 6), rng.uniform(-0.5, 0.5, (6, 3))
    phi = of_point_masses(masses, places)
    pseudo = pseudo_inertia(phi)
    assert is_consistent(pseudo)
    np.testing.assert_allclose(parameters(pseudo), phi, atol=1e-14)
    found = body(pseudo)
    centre = masses @ places / masses.sum()
    assert found.mass_kg == pytest.approx(masses.sum())
    np.testing.assert_allclose(found.com_m, centre, atol=1e-12)
    about = of_point_masses(masses, places - centre)[4:]
    np.testing.assert_allclose(found.inertia_kg_m2[UPPER], about, atol=1e-12)


@pytest.mark.parametrize(
    "phi",
    [
        [-0.1, 0, 0, 0, 1, 0, 0, 1, 0, 1],
        [1.0, 0, 0, 0, -0.1, 0, 0, 1, 0, 1],
        [1.0, 0, 0, 0, 1.0, 0, 0, 1, 0, 2.1],
        [1.0, 0.5, 0, 0, 0.1, 0, 0, 0.1, 0, 0.1],
        [0.0, 0.1, 0, 0, 0, 0, 0, 0, 0, 0],
    ],
    ids=[
        "negative mass",
        "negative inertia",
        "triangle inequality",
        "inertia below m c^2",
        "moment of no mass",
    ],
)
def test_impossible_bodies_are_found_and_replaced_by_possible_ones(phi: list[float]) -> None:
    pseudo = pseudo_inertia(phi)
    assert not is_consistent(pseudo)
    nearest = nearest_consistent(pseudo)
    assert is_consistent(nearest)
    found = body(nearest)
    a, b, c = np.linalg.eigvalsh(found.inertia_kg_m2)
    assert found.mass_kg > 0
    assert 0 < a <= b <= c < a + b


def test_no_real_body_is_nearer_than_the_nearest() -> None:
    rng = default_rng(3)
    reach = np.outer([REACH_M] * 3 + [1.0], [REACH_M] * 3 + [1.0])
    pseudo = pseudo_inertia([0.1, 0.2, -0.1, 0.0, 0.02, 0, 0.01, 0.01, 0, -0.01])
    best = nearest_consistent(pseudo)
    distance = np.linalg.norm((best - pseudo) / reach)
    for _ in range(300):
        step = rng.normal(size=(4, 4)) * 0.02
        other = np.linalg.cholesky(best / reach) + step
        candidate = (other @ other.T + 5e-4 * np.eye(4)) * reach
        assert np.linalg.norm((candidate - pseudo) / reach) > distance
