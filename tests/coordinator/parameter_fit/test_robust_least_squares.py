"""Weighted and robust fits of torques: against a known truth, and claims of certainty against repetitions."""

import numpy as np
import pytest
from numpy.random import Generator, default_rng
from scipy.signal import lfilter

from coordinator.parameter_fit.robust_least_squares import correlation_times, fit_weighted
from coordinator.parameter_fit.spectrum import UndeterminedError
from module_agent.model.chain import Array
from module_agent.model.errors import DataError

TRUTH = np.array([1.0, -2.0, 0.5])


def smooth_columns(rng: Generator, samples: int, joints: int = 2) -> Array:
    """Columns of a slow motion, as a regressor's are."""
    t = np.arange(samples)[:, None, None] / samples
    turns, phase = rng.uniform(3.0, 12.0, (joints, 3)), rng.uniform(0.0, 6.0, (joints, 3))
    return np.sin(2.0 * np.pi * turns * t + phase)


def coloured(rng: Generator, shape: tuple[int, int], pole: float) -> Array:
    """Noise of standard deviation 1 with rho_k = pole^k, so that (1 + pole) / (1 - pole) samples are one."""
    found: Array = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.normal(size=shape), axis=0)
    return found


def test_torques_without_noise_give_the_parameters_back(rng: Generator) -> None:
    y = smooth_columns(rng, 200)
    fit = fit_weighted(y, y @ TRUTH, np.ones(3))
    np.testing.assert_allclose(fit.parameters, TRUTH, rtol=1e-10)
    assert fit.rank == 3


def test_a_noisy_joint_does_not_drown_a_quiet_one(rng: Generator) -> None:
    y, sigma = rng.normal(size=(4000, 2, 3)), np.array([0.01, 1.0])
    tau = y @ TRUTH + sigma * rng.normal(size=(4000, 2))
    fit = fit_weighted(y, tau, np.ones(3))
    # 4000 samples: each standard deviation is known to 1.1 %; 5 of those.
    np.testing.assert_allclose(fit.sigma_nm, sigma, rtol=0.06)
    # The quiet joint alone gives 0.01 / sqrt(4000) = 1.6e-4; plain least squares some 1e-2.
    assert np.abs(fit.parameters - TRUTH).max() < 5 * 1.6e-4


@pytest.mark.parametrize("pole", [0.0, 0.6, 0.9])
def test_as_many_samples_count_as_one_as_the_noise_resembles_its_neighbours(pole: float) -> None:
    noise = coloured(default_rng(3), (20_000, 3), pole)
    # The window of 5 correlation times leaves out exp(-10) and scatters by sqrt(2 (2 w + 1) / m), at most
    # 15 %.
    assert correlation_times(noise).mean() == pytest.approx((1 + pole) / (1 - pole), rel=0.15)


def test_samples_left_out_do_not_change_the_correlation_of_the_rest() -> None:
    noise = coloured(default_rng(4), (20_000, 1), 0.8)
    noise[np.arange(20_000) % 700 < 150] = np.nan
    assert correlation_times(noise)[0] == pytest.approx(9.0, rel=0.2)


def test_the_claimed_scatter_is_that_of_repetitions_with_coloured_noise() -> None:
    rng = default_rng(5)
    y = smooth_columns(rng, 1500)
    found, claimed = [], []
    for _ in range(120):
        fit = fit_weighted(y, y @ TRUTH + coloured(rng, (1500, 2), 0.8), np.ones(3))
        found.append(fit.parameters)
        claimed.append(np.sqrt(np.diagonal(fit.covariance)))
    # Noise counted as independent would claim a third. 120 repetitions tell a scatter to 6.5 %, the motion
    # is a little faster than the noise's correlation, and its time is itself estimated: 25 %.
    np.testing.assert_allclose(np.mean(claimed, axis=0), np.std(found, axis=0), rtol=0.25)


def test_a_robust_fit_shrugs_off_collisions(rng: Generator) -> None:
    y = smooth_columns(rng, 2000)
    tau = y @ TRUTH + 0.01 * rng.normal(size=(2000, 2))
    tau[300:400] += 5.0
    plain, robust = (fit_weighted(y, tau, np.ones(3), robust=r) for r in (False, True))
    assert np.abs(plain.parameters - TRUTH).max() > 0.02
    # One sample in 20 is a blow: Huber's fit moves by about that fraction of the limit, 1.3 sigma of 0.01.
    assert np.abs(robust.parameters - TRUTH).max() < 0.005
    # The blows, and 18 % of normal noise lies beyond 1.345 sigma.
    assert robust.downweighted == pytest.approx([0.22, 0.22], abs=0.06)
    assert not plain.downweighted.any()


def test_samples_that_are_not_used_have_no_say(rng: Generator) -> None:
    y = smooth_columns(rng, 500)
    tau = y @ TRUTH
    tau[100:200, 1] = 99.0
    used = np.ones(tau.shape, bool)
    used[100:200, 1] = False
    fit = fit_weighted(y, tau, np.ones(3), used)
    np.testing.assert_allclose(fit.parameters, TRUTH, rtol=1e-9)
    assert fit.samples.tolist() == [500, 400]


def test_what_no_row_shows_stays_zero_and_is_not_counted(rng: Generator) -> None:
    y = smooth_columns(rng, 300)
    both = np.concatenate([y, y[..., :1], np.zeros_like(y[..., :1])], axis=2)
    fit = fit_weighted(both, y @ TRUTH, np.ones(5))
    assert fit.rank == 3
    assert fit.parameters[4] == 0.0
    assert fit.parameters[0] + fit.parameters[3] == pytest.approx(TRUTH[0])


def test_instruments_have_no_bias_where_noise_in_the_regressor_makes_everything_too_small() -> None:
    rng = default_rng(6)
    true = np.sqrt(0.5) * rng.normal(size=(4000, 2, 3))
    # Noise as large as the motion: least squares finds the share of the motion's power, one half.
    one, other = true + np.sqrt(0.5) * rng.normal(size=(2, *true.shape))
    tau = true @ TRUTH + 0.01 * rng.normal(size=true.shape[:2])
    plain = fit_weighted(one, tau, np.ones(3))
    tooled = fit_weighted(one, tau, np.ones(3), instruments=other)
    np.testing.assert_allclose(plain.parameters / TRUTH, 0.5, atol=0.06)
    sigma = np.sqrt(np.diagonal(tooled.covariance))
    assert (np.abs(tooled.parameters - TRUTH) < 4.0 * sigma).all()
    # 8000 rows with noise of about 1.6 on columns of power one half: 1.6 / sqrt(8000 / 2) = 2.5 %.
    assert (sigma < 0.05).all()
    # What is handed on holds the same answer.
    np.testing.assert_allclose(np.linalg.solve(tooled.rows, tooled.target), tooled.parameters, rtol=1e-9)


def test_instruments_that_are_the_regressor_are_least_squares(rng: Generator) -> None:
    y = smooth_columns(rng, 300)
    tau = y @ TRUTH + 0.1 * rng.normal(size=(300, 2))
    plain, tooled = (fit_weighted(y, tau, np.ones(3), instruments=z) for z in (None, y))
    np.testing.assert_allclose(tooled.parameters, plain.parameters, rtol=1e-9)
    np.testing.assert_allclose(tooled.covariance, plain.covariance, rtol=1e-6)
    with pytest.raises(DataError, match="must be finite and of the regressor's shape"):
        fit_weighted(y, tau, np.ones(3), instruments=y[:10])


def test_too_little_to_fit_is_said_joint_by_joint(rng: Generator) -> None:
    y = smooth_columns(rng, 50)
    used = np.ones((50, 2), bool)
    used[:, 1] = False
    with pytest.raises(UndeterminedError, match="joint 2 has no samples to fit: it never moves fast enough"):
        fit_weighted(y, y @ TRUTH, np.ones(3), used)
    with pytest.raises(
        UndeterminedError, match=r"joint 1 has 1 samples for \d.\d parameters; nothing is left"
    ):
        fit_weighted(y[:1], y[:1] @ TRUTH, np.ones(3))
