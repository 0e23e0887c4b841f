"""A change is found by as much as least squares with it fits better, and by chance as chance has it."""

import numpy as np
import pytest
from numpy.random import Generator
from scipy.stats import chi2

from coordinator.monitoring.likelihood_ratio import (
    ChangeTest,
    Evidence,
    evidence_of,
    gain_above,
    joined,
    tempered,
    without_own,
)

PARAMETERS, WIDE = 6, np.full(6, 10.0)
CHANGE = np.eye(PARAMETERS)[:, :2] * 100.0


@pytest.fixture
def rng() -> Generator:
    return np.random.default_rng(7)


def measured(rng: Generator, theta: np.ndarray, samples: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rows = rng.normal(size=(samples, PARAMETERS))
    return rows, rows @ theta + rng.normal(size=samples)


def test_gain_and_size_are_those_of_least_squares_over_all_samples_at_once(rng: Generator) -> None:
    theta = rng.normal(size=PARAMETERS)
    changed = theta + CHANGE @ [0.004, -0.002]
    (b, y), (later, z) = measured(rng, theta), measured(rng, changed)
    found = ChangeTest(evidence_of(b, y), WIDE, (CHANGE,)).find(evidence_of(later, z))[0]
    # All samples, the prior of theta and that of the change as rows of their own.
    none = np.zeros((len(b), 2))
    rows = np.vstack(
        [
            np.column_stack([b, none]),
            np.column_stack([later, later @ CHANGE]),
            np.column_stack([np.eye(PARAMETERS) / 10.0, np.zeros((PARAMETERS, 2))]),
            np.column_stack([np.zeros((2, PARAMETERS)), np.eye(2)]),
        ]
    )
    target = np.concatenate([y, z, np.zeros(PARAMETERS + 2)])
    best = np.linalg.lstsq(rows, target, rcond=None)[0]
    without = np.linalg.lstsq(rows[:, :PARAMETERS], target, rcond=None)[0]
    misfits = [np.sum((rows[:, : len(x)] @ x - target) ** 2) for x in (without, best)]
    np.testing.assert_allclose(found.size, best[PARAMETERS:], rtol=1e-8)
    assert found.gain == pytest.approx(misfits[0] - misfits[1], rel=1e-8)
    covariance = np.linalg.inv(rows.T @ rows)[PARAMETERS:, PARAMETERS:]
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-8)


def test_several_hypotheses_are_judged_each_by_itself_and_by_its_own_size(rng: Generator) -> None:
    """Of two parameters each, each as large as is likely of it."""
    theta = rng.normal(size=PARAMETERS)
    before, later = (evidence_of(*measured(rng, theta + shift)) for shift in (0.0, 0.3))
    changes = tuple(np.eye(PARAMETERS)[:, k : k + 2] * 100.0 for k in range(4))
    likely = (1.0, 1e-3, 5e-3, 0.1)
    together = ChangeTest(before, WIDE, changes, likely).find(later)
    for change, size, found in zip(changes, likely, together, strict=True):
        # A prior of another size is one of 1 in other units, and sizes are those under a prior of 1.
        judged = ChangeTest(before, WIDE, (size * change,)).find(later)[0]
        measured_by_itself = ChangeTest(before, WIDE, (change,)).find(later)[0]
        assert found.gain == pytest.approx(judged.gain, rel=1e-9)
        np.testing.assert_allclose(found.size, measured_by_itself.size, rtol=1e-9)
        np.testing.assert_allclose(found.covariance, measured_by_itself.covariance, rtol=1e-9)
    assert len({round(found.gain, 3) for found in together}) == len(together)


def test_hypotheses_and_their_likely_sizes_are_as_many(rng: Generator) -> None:
    evidence = evidence_of(*measured(rng, rng.normal(size=PARAMETERS)))
    with pytest.raises(ValueError, match="1 hypotheses are judged by 2 likely sizes"):
        ChangeTest(evidence, WIDE, (CHANGE,), (1.0, 0.1))


def test_chance_exceeds_a_level_as_seldom_as_was_asked_for(rng: Generator) -> None:
    theta = rng.normal(size=PARAMETERS)
    test = ChangeTest(evidence_of(*measured(rng, theta, 2000)), WIDE, (CHANGE,))
    gains = np.array([test.find(evidence_of(*measured(rng, theta, 50)))[0].gain for _ in range(1500)])
    # Of 1500 draws 150 exceed what one in ten does, give or take 3.5 binomial sigmas of 12.
    level = gain_above(2, 10.0, 1.0)
    assert level == pytest.approx(chi2.isf(0.1, 2))
    assert 150 - 42 < np.count_nonzero(gains > level) < 150 + 42


def test_what_neither_stretch_tells_makes_no_gain(rng: Generator) -> None:
    rows = rng.normal(size=(100, PARAMETERS))
    rows[:, :2] = 0.0
    quiet = evidence_of(rows, rng.normal(size=100))
    assert ChangeTest(quiet, WIDE, (CHANGE,)).find(quiet)[0].gain == pytest.approx(0.0, abs=1e-9)


def test_joined_evidence_is_that_of_all_samples_in_any_order(rng: Generator) -> None:
    parts = [evidence_of(*measured(rng, np.ones(PARAMETERS))) for _ in range(3)]
    one, other = joined(parts), joined(parts[::-1])
    for a, b in ((one, other), (one, joined([joined(parts[:2]), parts[2]]))):
        np.testing.assert_allclose(a.matrix, b.matrix, rtol=1e-10)
        np.testing.assert_allclose(a.vector, b.vector, rtol=1e-10)


def test_tempered_evidence_is_that_of_samples_with_as_much_more_noise(rng: Generator) -> None:
    rows, target = measured(rng, np.ones(PARAMETERS))
    noisier = evidence_of(rows / np.sqrt(30.0), target / np.sqrt(30.0))
    np.testing.assert_allclose(tempered(evidence_of(rows, target), 30.0).matrix, noisier.matrix)
    np.testing.assert_allclose(tempered(evidence_of(rows, target), 30.0).vector, noisier.vector)


def test_own_parameters_are_left_out_as_a_schur_complement_does(rng: Generator) -> None:
    rows, target = measured(rng, np.ones(PARAMETERS))
    left = without_own(evidence_of(rows, target), [0.5, 0.5])
    normal = rows.T @ rows
    normal[:2, :2] += 4.0 * np.eye(2)
    expected = normal[2:, 2:] - normal[2:, :2] @ np.linalg.solve(normal[:2, :2], normal[:2, 2:])
    np.testing.assert_allclose(left.matrix, expected, rtol=1e-9)


def test_evidence_about_other_parameters_is_refused() -> None:
    one = Evidence(np.eye(3), np.zeros(3))
    other = Evidence(np.eye(4), np.zeros(4))
    with pytest.raises(ValueError, match="cannot be joined"):
        joined([one, other])
    with pytest.raises(ValueError, match="prior of 3"):
        ChangeTest(one, np.ones(3), (np.eye(3),)).find(other)
    with pytest.raises(ValueError, match="not finite"):
        evidence_of([[np.nan]], [0.0])


def test_where_nothing_could_have_changed_there_is_no_change(rng: Generator) -> None:
    """A robot of one module has no link."""
    evidence = evidence_of(*measured(rng, rng.normal(size=PARAMETERS)))
    assert ChangeTest(evidence, WIDE, ()).find(evidence) == ()


def test_the_misfit_of_one_robot_is_chance_and_of_two_what_sets_them_apart(rng: Generator) -> None:
    theta = rng.normal(size=PARAMETERS)
    test = ChangeTest(evidence_of(*measured(rng, theta, 2000)), WIDE, ())
    same = [test.misfit(evidence_of(*measured(rng, theta, 50))) for _ in range(300)]
    # The mean of 300 chi-square draws of 6 degrees of freedom: within 3.5 sigmas of 0.2.
    assert np.mean(same) == pytest.approx(PARAMETERS, abs=0.7)
    rows, target = measured(rng, theta + 1.0, 50)
    apart = evidence_of(rows, target)
    # Two robots leave the noise, one leaves besides it what their difference makes of the later rows.
    assert test.misfit(apart) == pytest.approx(np.sum((rows @ np.ones(PARAMETERS)) ** 2), rel=0.3)


def test_rows_that_hardly_tell_a_parameter_keep_the_gain_of_a_qr(rng: Generator) -> None:
    """The information matrix squares the condition number: that of long runs is 1e5 in units of the prior."""
    weight = np.array([1e5, 1e4, 1e2, 1.0, 1e-2, 1e-4])
    theta = rng.normal(size=PARAMETERS)
    b, later = (rng.normal(size=(400, PARAMETERS)) * weight for _ in range(2))
    y, z = (
        b @ theta + rng.normal(size=400),
        later @ (theta + 3.0 * np.eye(PARAMETERS)[3]) + rng.normal(size=400),
    )
    change = np.eye(PARAMETERS)[:, 2:4]
    found = ChangeTest(evidence_of(b, y), np.ones(PARAMETERS), (change,)).find(evidence_of(later, z))[0]
    rows = np.vstack(
        [
            np.column_stack([b, np.zeros((400, 2))]),
            np.column_stack([later, later @ change]),
            np.eye(PARAMETERS + 2),
        ]
    )
    target = np.concatenate([y, z, np.zeros(PARAMETERS + 2)])
    misfits = []
    for columns in (PARAMETERS, PARAMETERS + 2):
        q = np.linalg.qr(rows[:, :columns])[0]
        misfits.append(np.sum((target - q @ (q.T @ target)) ** 2))
    assert found.gain == pytest.approx(misfits[0] - misfits[1], rel=1e-5)
