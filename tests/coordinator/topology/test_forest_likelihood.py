"""The forest of maximum likelihood and its rivals agree with an enumeration of all forests."""

from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.topology.forest_likelihood import (
    Parents,
    ancestors,
    edge_log_odds,
    likeliest_forest,
    log_likelihood,
    rivals,
)

# One in a hundred is wrong.
DOUBTFUL = np.log(99.0)


def forests(n: int) -> Iterator[Parents]:
    """Every forest of n modules: 3, 16, 125, 1296 of 2 to 5 (Cayley's formula, (n + 1)^(n - 1))."""
    for parent in product(range(-1, n), repeat=n):
        try:
            ancestors(parent)
        except ValueError:
            continue
        yield parent


@pytest.mark.parametrize(("n", "count"), [(2, 3), (3, 16), (4, 125)])
def test_there_are_as_many_forests_as_cayley_says(n: int, count: int) -> None:
    assert len(list(forests(n))) == count


@given(st.integers(0, 2**32), st.integers(2, 4))
@settings(deadline=None, max_examples=30)
def test_gains_of_moves_are_the_differences_of_the_likelihoods(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    odds = rng.normal(size=(n, n))
    every = list(forests(n))
    parent = every[rng.integers(len(every))]
    here = log_likelihood(parent, odds)
    for other, gain in rivals(parent, odds).items():
        assert other != parent
        assert gain == pytest.approx(log_likelihood(other, odds) - here, abs=1e-9)


@given(st.integers(0, 2**32), st.integers(2, 5), st.integers(0, 1))
@settings(deadline=None, max_examples=20)
def test_of_observations_with_one_flipped_the_likeliest_forest_is_found(
    seed: int, n: int, flips: int
) -> None:
    rng = np.random.default_rng(seed)
    every = list(forests(n))
    truth = every[rng.integers(len(every))]
    odds = np.where(ancestors(truth), 1.0, -1.0) * rng.uniform(4.0, 9.0, (n, n))
    for flat in rng.choice(n * n, flips, replace=False):
        odds.flat[flat] *= -1.0
    best = max(log_likelihood(parent, odds) for parent in every)
    assert log_likelihood(likeliest_forest(odds), odds) == pytest.approx(best, abs=1e-9)


@given(st.integers(0, 2**32))
@settings(deadline=None, max_examples=20)
def test_the_odds_of_an_edge_are_those_of_counting_through_all_forests(seed: int) -> None:
    """What lies two moves away is wrong in several observations at once: it counts only among the sure."""
    rng, n = np.random.default_rng(seed), 4
    every = list(forests(n))
    truth = every[rng.integers(len(every))]
    odds = np.where(ancestors(truth), 1.0, -1.0) * rng.uniform(2.0, 6.0, (n, n))
    found = edge_log_odds(truth, rivals(truth, odds))
    weight = np.array([log_likelihood(parent, odds) for parent in every])
    for k in range(n):
        right = np.array([parent[k] == truth[k] for parent in every])
        exact = np.logaddexp.reduce(weight[right]) - np.logaddexp.reduce(weight[~right])
        if exact < DOUBTFUL:
            # Of 400 drawn, the farthest is 0.25 off.
            assert found[k] == pytest.approx(exact, abs=0.4)
        else:
            assert found[k] > DOUBTFUL - 0.1


def test_a_module_that_carries_nothing_is_given_no_children() -> None:
    odds = np.array([[0.0, 5.0, 5.0], [-5.0, 0.0, 5.0], [-5.0, -5.0, 0.0]])
    assert likeliest_forest(odds) == (-1, 0, 1)
    assert likeliest_forest(odds, leaves=[1]) == (-1, 0, 0)
    assert all(1 not in rival for rival in rivals((-1, 0, 0), odds, leaves=[1]))


def test_a_ring_is_no_forest() -> None:
    with pytest.raises(ValueError, match=r"modules \[0, 1\] never reach the base"):
        ancestors((1, 0, -1))


def test_a_chain_of_sixty_four_modules_is_certain() -> None:
    n = 64
    odds = np.where(np.triu(np.ones((n, n), dtype=bool), 1), 6.0, -6.0)
    found = likeliest_forest(odds)
    assert found == tuple(range(-1, n - 1))
    # 127 rivals of one wrong observation each would make 6 - log(127) = 1.2 of every edge; each has a few.
    assert edge_log_odds(found, rivals(found, odds)).min() > 4.0
