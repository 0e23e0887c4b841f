"""Least squares must find what torques show of the bodies, and must say what they do not show."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Generator, default_rng

from coordinator.dynamics.pseudo_inertia import REACH_M
from coordinator.parameter_fit.least_squares import InertialFit, solve_information, solve_weighted
from coordinator.parameter_fit.spectrum import UndeterminedError
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.information import compress, gather, merge
from module_agent.model.regressor import torque_regressor

SCALE = REACH_M ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])


def solve_pseudo_inverse(regressor: Array, tau_nm: Array, weights: Any = None, **options: Any) -> InertialFit:
    return solve_information(compress(regressor, tau_nm), weights, **options)


def tree(rng: Generator, parents: tuple[int, ...]) -> Chain:
    n = len(parents)
    axis = rng.normal(size=(n, 3))
    return Chain(
        serials=tuple(f"M{i}" for i in range(n)),
        parent=parents,
        reversed=(False,) * n,
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        point=rng.uniform(-0.4, 0.4, (n, 3)),
        imu_home=np.tile(np.eye(4), (n, 1, 1)),
        gravity=np.array([0.0, 0.0, 9.81]),
    )


def one_joint(axis: list[float]) -> Chain:
    return tree(default_rng(0), (-1,))._replace(axis=np.array([axis]), point=np.zeros((1, 3)))


def motion(rng: Generator, samples: int, joints: int) -> tuple[Array, Array, Array]:
    q, qd, qdd = rng.uniform(-1.0, 1.0, (3, samples, joints)) * np.array([3.0, 3.0, 20.0])[:, None, None]
    return q, qd, qdd


def bodies(rng: Generator, joints: int) -> Array:
    return (rng.uniform(-1.0, 1.0, (joints, 10)) * SCALE * 0.5).ravel()


@settings(max_examples=15, deadline=None)
@given(joints=st.integers(1, 5), seed=st.integers(0, 2**32 - 1))
def test_without_noise_the_identifiable_part_of_the_truth_comes_back(joints: int, seed: int) -> None:
    rng = default_rng(seed)
    chain = tree(rng, tuple(int(rng.integers(-1, i)) for i in range(joints)))
    truth = bodies(rng, joints)
    y = torque_regressor(chain, *motion(rng, 120, joints))
    fit = solve_pseudo_inverse(y, y @ truth)
    # Random axes may lie close to each other; the error then grows with the condition number.
    bound = 1e-13 * fit.condition * np.abs(truth).max() + 1e-12
    assert np.abs((fit.phi - fit.projector @ truth) / np.tile(SCALE, joints)).max() < bound / SCALE.min()
    # Prediction does not care for the parameters that were not identified.
    others = torque_regressor(chain, *motion(rng, 50, joints))
    assert np.abs(others @ (fit.phi - truth)).max() < 1e-8 * np.abs(others @ truth).max()


@pytest.mark.parametrize(
    ("axis", "rank", "words"),
    [
        ([0.0, 0.0, 1.0], 1, "a turntable about the vertical shows its own inertia alone"),
        ([0.0, -1.0, 0.0], 3, "an arm against gravity shows two first moments as well"),
    ],
)
def test_one_joint_shows_what_mechanics_says(
    rng: Generator, axis: list[float], rank: int, words: str
) -> None:
    chain = one_joint(axis)
    truth = bodies(rng, 1)
    y = torque_regressor(chain, *motion(rng, 200, 1))
    fit = solve_pseudo_inverse(y, y @ truth)
    assert fit.rank == rank, words
    expected = {1: [9], 3: [1, 3, 7]}[rank]  # Izz; or mcx, mcz and Iyy
    assert np.flatnonzero(fit.identifiable).tolist() == expected
    share = np.diagonal(fit.projector)
    np.testing.assert_allclose(share, np.isin(np.arange(10), expected), atol=1e-9)
    np.testing.assert_allclose(fit.phi[expected], truth[expected], rtol=1e-10)
    # The pseudo-inverse leaves at zero what it knows nothing of, and hides it under no ridge.
    assert np.abs(np.delete(fit.phi, expected)).max() < 1e-12
    assert (fit.singular_values[rank:] < 1e-12 * fit.singular_values[0]).all()


def test_a_prior_rules_where_torques_are_silent_and_nowhere_else(rng: Generator) -> None:
    chain = tree(rng, (-1, 0, 1))
    truth, prior = bodies(rng, 3), bodies(rng, 3)
    y = torque_regressor(chain, *motion(rng, 200, 3))
    plain = solve_pseudo_inverse(y, y @ truth)
    informed = solve_pseudo_inverse(y, y @ truth, prior_phi=prior)
    np.testing.assert_allclose(y @ informed.phi, y @ plain.phi, atol=1e-10)
    silent = np.eye(30) - informed.projector
    np.testing.assert_allclose(silent @ informed.phi, silent @ prior, atol=1e-10)
    np.testing.assert_allclose(informed.projector @ informed.phi, plain.phi, atol=1e-9)


def test_the_rank_is_that_of_the_torque_equation(rng: Generator) -> None:
    # An independent count: numpy's rank of the plain matrix, and the known 48 base parameters less none for a
    # six-joint arm with general axes on a fixed base: 7 per body beyond the first, 3 for the first.
    chain = tree(rng, (-1, 0, 1, 2, 3, 4))
    y = torque_regressor(chain, *motion(rng, 400, 6))
    fit = solve_pseudo_inverse(y, y @ bodies(rng, 6))
    assert fit.rank == np.linalg.matrix_rank(y.reshape(-1, 60), tol=1e-9) == 3 + 5 * 7


def test_equals_numpys_pseudo_inverse_in_the_common_unit(rng: Generator) -> None:
    chain = tree(rng, (-1, 0, 0))
    y = torque_regressor(chain, *motion(rng, 150, 3))
    tau = y @ bodies(rng, 3) + 0.01 * rng.normal(size=(150, 3))
    scale = np.tile(SCALE, 3)
    expected = scale * (np.linalg.pinv((y * scale).reshape(-1, 30), rcond=1e-11) @ tau.ravel())
    fit = solve_pseudo_inverse(y, tau, max_sigma_kg=np.inf)
    np.testing.assert_allclose(fit.phi, expected, atol=1e-9)
    residual = y @ expected - tau
    np.testing.assert_allclose(fit.residual_rms_nm, np.sqrt(np.mean(residual**2, axis=0)), rtol=1e-9)


@pytest.mark.parametrize("weighted", [False, True])
def test_the_covariance_is_the_scatter_of_repeated_fits(rng: Generator, weighted: bool) -> None:
    chain = tree(rng, (-1, 0))
    sigma = np.array([0.3, 0.02])
    y = torque_regressor(chain, *motion(rng, 200, 2))
    tau = y @ bodies(rng, 2)
    weights = 1.0 / sigma if weighted else None
    fits = [solve_pseudo_inverse(y, tau + sigma * rng.normal(size=tau.shape), weights) for _ in range(400)]
    assert {fit.rank for fit in fits} == {10}
    scatter = np.cov(np.array([fit.phi for fit in fits]).T)
    claimed = np.mean([fit.covariance for fit in fits], axis=0)
    seen = np.diagonal(scatter) > 1e-9 * np.diagonal(scatter).max()
    # A variance out of 400 trials has a standard error of 7 %: four of them.
    np.testing.assert_allclose(np.diagonal(claimed)[seen], np.diagonal(scatter)[seen], rtol=0.28)
    noise = np.mean([f.torque_sigma_nm for f in fits], axis=0)
    if weighted:
        # The noise of a joint out of 200 samples and 400 trials: 0.25 %, four of them.
        np.testing.assert_allclose(noise, sigma, rtol=0.01)
    else:
        # The noisy joint's errors act on the quiet one: too large, never too small.
        assert (noise > 0.99 * sigma).all()


def test_a_direction_that_the_noise_hides_is_not_called_identified(rng: Generator) -> None:
    # The second axis is 0.1 mrad from parallel to the first: some combinations act on the torque, but by less
    # than the noise can show.
    chain = tree(rng, (-1, 0))
    almost = chain.axis[0] + 1e-4 * np.cross(chain.axis[0], [0.3, 0.5, 0.8])
    chain = chain._replace(axis=np.stack([chain.axis[0], almost / np.linalg.norm(almost)]))
    y = torque_regressor(chain, *motion(rng, 300, 2))
    truth = bodies(rng, 2)
    noisy = y @ truth + 0.05 * rng.normal(size=(300, 2))
    clean, hidden = solve_pseudo_inverse(y, y @ truth), solve_pseudo_inverse(y, noisy)
    everything = solve_pseudo_inverse(y, noisy, max_sigma_kg=np.inf)
    assert hidden.rank < clean.rank == everything.rank
    assert (
        np.linalg.norm(hidden.phi / np.tile(SCALE, 2))
        < 5.0
        < np.linalg.norm(everything.phi / np.tile(SCALE, 2))
    )
    other = torque_regressor(chain, *motion(rng, 300, 2))
    assert np.linalg.norm(other @ (hidden.phi - truth)) < 0.05 * np.linalg.norm(other @ truth)


def test_a_direction_that_systematic_errors_hide_is_not_called_identified(rng: Generator) -> None:
    """Noise averages out over the samples; an effect of a chain's error, common to all of them, does not."""
    chain = one_joint([0.0, 1.0, 0.0])
    y = torque_regressor(chain, *motion(rng, 500, 1))
    information = compress(y, y @ bodies(rng, 1) + 1e-3 * rng.normal(size=(500, 1)))
    plain = solve_information(information)
    weakest = plain.singular_values[plain.rank - 1]
    left = information[0].r * SCALE @ np.linalg.svd(information[0].r * SCALE)[2][plain.rank - 1] / weakest
    for size_kg, rank in ((0.2, plain.rank), (0.4, plain.rank - 1)):
        effect = size_kg * weakest * left[:, None]
        found = solve_information(information, max_sigma_kg=0.3, effects=[effect])
        assert found.rank == rank
        # The claim is that of the noise alone: systematic errors are added to base parameters.
        if rank == plain.rank:
            np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-9, atol=1e-15)


def test_information_merges_exactly_in_any_order_and_does_not_grow(rng: Generator) -> None:
    chain = tree(rng, (-1, 0, 1))
    parts = [motion(rng, samples, 3) for samples in (7, 150, 90)]
    torques = [torque_regressor(chain, *part) @ bodies(rng, 3) for part in parts]
    pieces = [gather(chain, *part, tau) for part, tau in zip(parts, torques, strict=True)]
    whole = [np.concatenate(signal) for signal in zip(*parts, strict=True)]
    at_once = solve_pseudo_inverse(torque_regressor(chain, *whole), np.concatenate(torques))
    for order in ((0, 1, 2), (2, 0, 1)):
        merged = merge(merge(pieces[order[0]], pieces[order[1]]), pieces[order[2]])
        assert [piece.r.shape for piece in merged] == [(30, 30), (20, 30), (10, 30)]
        fit = solve_information(merged)
        np.testing.assert_allclose(fit.phi, at_once.phi, atol=1e-9 * at_once.condition)
        np.testing.assert_allclose(fit.residual_rms_nm, at_once.residual_rms_nm, rtol=1e-9)
        assert fit.samples.tolist() == [247] * 3


def test_the_noise_of_a_strong_joint_is_not_taken_for_torque_of_a_weak_one(rng: Generator) -> None:
    """The first of two joints has a hundred times the noise of the second."""
    chain, sigma = tree(rng, (-1, 0)), np.array([1.0, 0.01])
    truth, others = bodies(rng, 2), motion(rng, 200, 2)
    right = torque_regressor(chain, *others) @ truth
    alike, weighed = [], []
    for _ in range(10):
        signals = motion(rng, 300, 2)
        tau = torque_regressor(chain, *signals) @ truth + sigma * rng.normal(size=(300, 2))
        information = gather(chain, *signals, tau)
        for fit, off in ((solve_information(information), alike), (solve_weighted(information), weighed)):
            off.append((torque_regressor(chain, *others) @ fit.phi - right)[:, 1])
    # Ten parameters from 300 samples: the weak joint's own noise leaves a fifth of itself in a prediction.
    assert np.std(weighed) < 0.01
    assert np.std(weighed) < 0.2 * np.std(alike)


def test_torques_without_noise_are_fitted_all_the_same(rng: Generator) -> None:
    chain, signals = tree(rng, (-1, 0)), motion(rng, 100, 2)
    truth = bodies(rng, 2)
    y = torque_regressor(chain, *signals)
    fit = solve_weighted(gather(chain, *signals, y @ truth))
    assert np.abs(y @ (fit.phi - truth)).max() < 1e-8 * np.abs(y @ truth).max()


def test_correlated_samples_widen_the_covariance(rng: Generator) -> None:
    chain = tree(rng, (-1,))
    y = torque_regressor(chain, *motion(rng, 100, 1))
    tau = y @ bodies(rng, 1) + 0.01 * rng.normal(size=(100, 1))
    plain, filtered = solve_pseudo_inverse(y, tau), solve_pseudo_inverse(y, tau, independent_fraction=0.1)
    np.testing.assert_allclose(filtered.covariance, 10.0 * plain.covariance, rtol=1e-12)


def test_results_cannot_be_written_to(rng: Generator) -> None:
    chain = tree(rng, (-1,))
    y = torque_regressor(chain, *motion(rng, 100, 1))
    fit = solve_pseudo_inverse(y, y @ bodies(rng, 1))
    arrays = [item for item in fit if isinstance(item, np.ndarray)]
    assert len(arrays) == 8
    assert not any(array.flags.writeable for array in arrays)


def test_what_does_not_fit_is_named(rng: Generator) -> None:
    chain = tree(rng, (-1, 0))
    y = torque_regressor(chain, *motion(rng, 40, 2))
    tau = y @ bodies(rng, 2)
    with pytest.raises(ValueError, match=r"regressor \(40, 2, 20\) and torques \(39, 2\) do not fit"):
        solve_pseudo_inverse(y, tau[:-1])
    with pytest.raises(DataError, match="weights must be 2 positive numbers"):
        solve_pseudo_inverse(y, tau, weights=[1.0, 0.0])
    with pytest.raises(ValueError, match="prior_phi must be 20 finite numbers; got 10"):
        solve_pseudo_inverse(y, tau, prior_phi=np.zeros(10))
    with pytest.raises(UndeterminedError, match="joint 1 has 3 samples"):
        solve_pseudo_inverse(y[:3], tau[:3])
    with pytest.raises(UndeterminedError, match="torques say nothing"):
        solve_pseudo_inverse(np.zeros_like(y), tau)
    with pytest.raises(DataError, match="not finite"):
        compress(y, np.full_like(tau, np.nan))
    with pytest.raises(ValueError, match=r"of \[1, 2\] joints cannot be merged"):
        merge(compress(y, tau), compress(y[:, :1, :10], tau[:, :1]))
