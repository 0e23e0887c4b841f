"""Rate ratios of one slow motion have uncertainties that cover noise, shaking and compliant joints."""

import numpy as np
import pytest

from coordinator.topology.motion_evidence import (
    MIN_RATE_RAD_S,
    MIN_SAMPLES,
    RATIO_FLOOR,
    RESIDUAL_GIVE,
    NotMoved,
    carried_log_odds,
    motion_evidence,
)

SAMPLES, RATE_HZ = 60, 50.0
AXES = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def rates() -> np.ndarray:
    """Joint 0 of three goes up to 1 rad/s and back to rest; the others are held."""
    t = np.arange(SAMPLES) / RATE_HZ
    rate = np.zeros((SAMPLES, 3))
    rate[:, 0] = np.clip(np.minimum(t, t[-1] - t) / 0.15, 0.0, 1.0)
    return rate


def gyros(rate: np.ndarray, share: tuple[float, float, float]) -> np.ndarray:
    """Every IMU turns about its own axis with its share of joint 0's rate."""
    return rate[:, :1, None] * (np.array(share)[:, None] * AXES)


def test_a_carried_imu_answers_with_the_axis_and_one_that_is_not_with_nothing() -> None:
    rate = rates()
    seen = motion_evidence(0, rate, gyros(rate, (1.0, 1.0, 0.0)), np.zeros((3, 3)))
    np.testing.assert_allclose(seen.coefficient, AXES * np.array([[1.0], [1.0], [0.0]]), atol=1e-12)
    np.testing.assert_allclose(seen.rate_ratio, [1.0, 1.0, 0.0], atol=1e-12)
    # Nothing varied and nothing gave way: what is left is what no encoder sees.
    np.testing.assert_allclose(seen.ratio_sigma, RATIO_FLOOR, atol=1e-9)


def test_the_gyros_offsets_are_taken_off() -> None:
    rate, offset = rates(), np.full((3, 3), 0.3)
    seen = motion_evidence(0, rate, gyros(rate, (1.0, 0.0, 0.0)) + offset, offset)
    np.testing.assert_allclose(seen.rate_ratio, [1.0, 0.0, 0.0], atol=1e-12)


def test_the_spread_of_the_jackknife_is_that_of_repeated_motions_in_white_noise() -> None:
    rng, rate = np.random.default_rng(3), rates()
    found = [
        motion_evidence(0, rate, 0.2 * rng.normal(size=(SAMPLES, 3, 3)), np.zeros((3, 3))) for _ in range(300)
    ]
    # Of a vector of three components: the root of the summed variances.
    scatter = np.sqrt(np.array([seen.coefficient for seen in found]).var(axis=0).sum(axis=1))
    claimed = np.sqrt(np.mean([seen.sigma**2 for seen in found], axis=0))
    # 300 repeats give a scatter of three components to 2.4 %; the ramps make the first and last block count
    # less, which the jackknife overstates a little.
    np.testing.assert_allclose(claimed, scatter, rtol=0.15)


def test_shaking_in_time_with_no_stretch_of_the_motion_widens_the_spread() -> None:
    rate = rates()
    shake = 0.5 * np.sin(2 * np.pi * 3.0 * np.arange(SAMPLES) / RATE_HZ)
    still = gyros(rate, (0.0, 0.0, 0.0))
    shaken = motion_evidence(0, rate, still + shake[:, None, None], np.zeros((3, 3)))
    quiet = motion_evidence(0, rate, still, np.zeros((3, 3)))
    assert (shaken.sigma > 0.05).all()
    assert (quiet.sigma < 1e-12).all()


@pytest.mark.parametrize("give", [-0.4, -0.1, 0.1, 0.4])
def test_a_held_joint_that_gives_covers_the_error_that_it_makes(give: float) -> None:
    """A held joint, parallel to the moving one, turns along by a share: so does everything beyond it."""
    rate = rates()
    rate[:, 1] = give * rate[:, 0]
    seen = motion_evidence(0, rate, gyros(rate, (1.0 + give, give, 0.0)), np.zeros((3, 3)))
    np.testing.assert_allclose(seen.give, abs(give))
    error = np.abs(seen.rate_ratio - [1.0, 0.0, 0.0])
    # A uniform distribution reaches to the root of three of its sigmas.
    assert (error <= np.sqrt(3.0) * seen.ratio_sigma).all()
    assert (seen.ratio_sigma >= abs(give) / np.sqrt(3.0)).all()


@pytest.mark.parametrize("turned_rad", [0.0, 0.3])
def test_the_motion_of_a_held_joint_is_subtracted_where_its_imus_are_known(turned_rad: float) -> None:
    """Joint 1 carries the first two IMUs; joints between have turned its axis a little since it showed."""
    rate, give = rates(), 0.8
    rate[:, 1] = give * rate[:, 0]
    carried, own = np.array([1.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    across = np.cross(AXES, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.full((3, 3, 3), np.nan)
    axes[1] = carried[:, None] * across
    axes[2] = 0.0
    now = np.cos(turned_rad) * across + np.sin(turned_rad) * np.cross(AXES, across)
    gyro = rate[:, :1, None] * (own[:, None] * AXES) + rate[:, 1:2, None] * (carried[:, None] * now)
    seen = motion_evidence(0, rate, gyro, np.zeros((3, 3)), axes)
    without = motion_evidence(0, rate, gyro, np.zeros((3, 3)))
    assert np.abs(without.rate_ratio - own).max() > 0.25
    assert (np.abs(seen.rate_ratio - own) <= np.sqrt(3.0) * seen.ratio_sigma).all()
    np.testing.assert_allclose(seen.give, RESIDUAL_GIVE * give)
    if turned_rad == 0.0:
        np.testing.assert_allclose(seen.rate_ratio, own, atol=1e-12)


def test_of_a_joint_of_which_nothing_is_known_all_may_have_been_given() -> None:
    rate = rates()
    rate[:, 1] = 0.4 * rate[:, 0]
    seen = motion_evidence(
        0, rate, gyros(rate, (1.0, 0.0, 0.0)), np.zeros((3, 3)), np.full((3, 3, 3), np.nan)
    )
    np.testing.assert_allclose(seen.give, 0.4)
    np.testing.assert_allclose(seen.rate_ratio, [1.0, 0.0, 0.0], atol=1e-12)


def test_a_joint_that_is_stuck_has_not_moved_whatever_its_encoder_jitters() -> None:
    rate = 0.5 * MIN_RATE_RAD_S * np.random.default_rng(1).normal(size=(SAMPLES, 3))
    with pytest.raises(NotMoved, match=r"rad/s rms; 0.02 is needed"):
        motion_evidence(0, rate, np.zeros((SAMPLES, 3, 3)), np.zeros((3, 3)))


def test_too_short_a_motion_is_refused() -> None:
    few = MIN_SAMPLES - 1
    with pytest.raises(NotMoved, match=f"only {few} samples"):
        motion_evidence(0, rates()[:few], np.zeros((few, 3, 3)), np.zeros((3, 3)))


def test_a_module_that_hardly_moved_is_less_certain_of_the_same_noise() -> None:
    rng, rate = np.random.default_rng(5), rates()
    noise = 0.02 * rng.normal(size=(SAMPLES, 3, 3))
    odds = []
    for size in (1.0, 0.1, 0.03):
        seen = motion_evidence(0, size * rate, gyros(size * rate, (1.0, 0.0, 0.0)) + noise, np.zeros((3, 3)))
        odds.append(carried_log_odds(float(seen.rate_ratio[0]), float(seen.ratio_sigma[0])))
    assert odds[0] > odds[1] > odds[2] > 0.0


def test_a_ratio_that_fits_neither_is_nearly_uninformative() -> None:
    assert carried_log_odds(1.0, 0.05) > 8.0
    assert carried_log_odds(0.0, 0.05) < -8.0
    for odd in (0.5, 0.4, 0.6, 2.5):
        assert abs(carried_log_odds(odd, 0.05)) < 0.1
