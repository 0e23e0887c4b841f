"""What torques show of many parameters is a few sums of them, and every sum says what is in it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Generator, default_rng

from coordinator.description.urdf_writer import link_homes
from coordinator.dynamics.pseudo_inertia import REACH_M, parameter_transform
from coordinator.parameter_fit.base_parameters import (
    BaseParameters,
    base_parameters,
    inertial_columns,
    into_frames,
    whitened,
)
from coordinator.parameter_fit.least_squares import solve_information
from coordinator.parameter_fit.spectrum import UndeterminedError
from coordinator.parameter_fit.systematic_errors import scale_effects, whitened_effects
from coordinator.parameter_fit.torque_sensor_scale import TorqueScale
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.information import gather
from module_agent.model.regressor import inverse_dynamics, torque_regressor

SCALE = REACH_M ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])


def chain_of(parents: tuple[int, ...], axis: Array, point: Array) -> Chain:
    n = len(parents)
    return Chain(
        serials=tuple(f"M{i}" for i in range(n)),
        parent=parents,
        reversed=(False,) * n,
        axis=axis,
        point=point,
        imu_home=np.tile(np.eye(4), (n, 1, 1)),
        gravity=np.array([0.0, 0.0, 9.81]),
    )


def random_tree(rng: Generator, joints: int) -> Chain:
    """Draw a tree of right angles and parallel axes as modules make it, where much is lumped."""
    parents = tuple(int(rng.integers(-1, i)) for i in range(joints))
    axis = np.eye(3)[rng.integers(0, 3, joints)] * rng.choice([-1.0, 1.0], (joints, 1))
    return chain_of(parents, axis, rng.uniform(-0.4, 0.4, (joints, 3)))


def motion(rng: Generator, samples: int, joints: int) -> tuple[Array, Array, Array]:
    q, qd, qdd = rng.uniform(-1.0, 1.0, (3, samples, joints)) * np.array([3.0, 3.0, 20.0])[:, None, None]
    return q, qd, qdd


def bodies(rng: Generator, joints: int) -> Array:
    return (rng.uniform(-1.0, 1.0, (joints, 10)) * SCALE * 0.5).ravel()


def in_frames(chain: Chain, phi: Array) -> Array:
    """Return root-frame parameters in the frames of the links, by the inverse of each change of frame."""
    pairs = zip(link_homes(chain), phi.reshape(-1, 10), strict=True)
    return np.concatenate([np.linalg.solve(parameter_transform(home), body) for home, body in pairs])


def found_of(chain: Chain, truth: Array, rng: Generator) -> BaseParameters:
    """Return the base parameters of a motion without noise, in the links' frames."""
    y = torque_regressor(chain, *motion(rng, 150, len(chain.parent)))
    rows = into_frames(y.reshape(-1, truth.size), link_homes(chain))
    return base_parameters(rows, (y @ truth).ravel(), inertial_columns(len(chain.parent)))


@settings(max_examples=20, deadline=None)
@given(joints=st.integers(1, 6), seed=st.integers(0, 2**32 - 1))
def test_base_parameters_are_as_many_as_the_rank_and_equal_the_truths_sums(joints: int, seed: int) -> None:
    rng = default_rng(seed)
    chain, truth = random_tree(rng, joints), bodies(rng, joints)
    found = found_of(chain, truth, rng)
    # Another motion's regressor in the root frame, its rank counted by numpy.
    y = torque_regressor(chain, *motion(rng, 200, joints)).reshape(-1, truth.size)
    other = y * np.tile(SCALE, joints)
    # Nothing lies between rounding, 1e-15, and the weakest of real combinations, a few 1e-4.
    assert found.rank == np.linalg.matrix_rank(other, tol=1e-9 * np.linalg.norm(other, 2))
    expected = found.grouping @ in_frames(chain, truth)
    # Rounding grows with the condition; the rest is exact.
    assert np.abs(found.value - expected).max() < 1e-11 * found.condition
    # They alone give the torques of the other motion.
    rows = into_frames(y, link_homes(chain))
    assert np.abs(rows[:, found.independent] @ found.value - y @ truth).max() < 1e-9 * found.condition


@settings(max_examples=20, deadline=None)
@given(joints=st.integers(1, 5), seed=st.integers(0, 2**32 - 1))
def test_robots_that_move_alike_have_the_same_base_parameters(joints: int, seed: int) -> None:
    rng = default_rng(seed)
    chain, truth = random_tree(rng, joints), bodies(rng, joints)
    found = found_of(chain, truth, rng)
    y = torque_regressor(chain, *motion(rng, 200, joints)).reshape(-1, truth.size)
    _, values, rows = np.linalg.svd(y)
    hidden = rows[np.sum(values > 1e-10 * values[0]) :]
    twin = truth + hidden.T @ rng.normal(size=len(hidden))
    difference = found.grouping @ in_frames(chain, twin - truth)
    assert np.linalg.norm(twin - truth) > 0.1
    assert np.abs(difference).max() < 1e-9


def test_a_double_pendulum_has_the_base_parameters_of_the_textbook(rng: Generator) -> None:
    # Two axes along -y, 0.35 m apart along x, gravity along -z. In the links' frames z is the axis.
    chain = chain_of((-1, 0), np.array([[0.0, -1.0, 0.0]] * 2), np.array([[0.0, 0.0, 0.0], [0.35, 0.0, 0.0]]))
    found = found_of(chain, bodies(rng, 2), rng)
    assert [found.summary(i) for i in range(found.rank)] == [
        "m1 c1x + 0.35 m2",
        "m1 c1y",
        "I1zz + 0.122 m2",
        "m2 c2x",
        "m2 c2y",
        "I2zz",
    ]
    known_alone = [found.columns.names[j] for j in np.flatnonzero(found.share > 1.0 - 1e-9)]
    assert known_alone == ["m1 c1y", "m2 c2x", "m2 c2y", "I2zz"]
    without_effect = {found.columns.names[j] for j in np.flatnonzero(found.share < 1e-9)}
    assert {"m1", "m1 c1z", "I1xx", "m2 c2z", "I2xy"} < without_effect


def test_across_a_right_angle_the_difference_of_two_moments_is_what_shows(rng: Generator) -> None:
    # A turntable that carries an arm whose axis is level, a classical case: I2xx and I2yy only show as their
    # difference, because their sum turns with the table and is its inertia.
    chain = chain_of((-1, 0), np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]), np.zeros((2, 3)))
    found = found_of(chain, bodies(rng, 2), rng)
    words = [found.summary(i) for i in range(found.rank)]
    assert words[0] == "I1zz + I2yy"
    assert "I2xx - I2yy" in words
    assert found.rank == 8


def test_masses_beyond_a_joint_are_named_in_one_bracket(rng: Generator) -> None:
    axis = np.array([[0.0, 1.0, 0.0]] * 3)
    chain = chain_of((-1, 0, 1), axis, np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.0, 0.1]]))
    found = found_of(chain, bodies(rng, 3), rng)
    assert "m1 c1x + 0.2 (m2 + m3)" in [found.summary(i) for i in range(found.rank)]


def test_standard_deviations_are_the_scatter_of_repeated_fits(rng: Generator) -> None:
    chain, sigma = random_tree(rng, 3), np.array([0.3, 0.1, 0.02])
    truth = bodies(rng, 3)
    signals = motion(rng, 150, 3)
    tau = inverse_dynamics(chain, truth, *signals)
    found = []
    for _ in range(300):
        pieces = gather(chain, *signals, tau + sigma * rng.normal(size=tau.shape))
        found.append(base_parameters(*whitened(pieces, sigma), inertial_columns(3)))
    scatter = np.std([one.value for one in found], axis=0)
    # A deviation out of 300 trials has a standard error of 4 %: five of them.
    np.testing.assert_allclose(found[0].sigma, scatter, rtol=0.2)
    pulls = np.mean([(one.value - one.grouping @ truth) / one.sigma for one in found], axis=0)
    assert np.abs(pulls).max() < 5.0 / np.sqrt(300)
    np.testing.assert_allclose(found[0].relative_sigma, found[0].sigma / np.abs(found[0].value))


def test_they_are_the_projection_that_least_squares_finds(rng: Generator) -> None:
    chain = random_tree(rng, 3)
    signals = motion(rng, 150, 3)
    tau = inverse_dynamics(chain, bodies(rng, 3), *signals) + 0.1 * rng.normal(size=(150, 3))
    pieces = gather(chain, *signals, tau)
    fit = solve_information(pieces, max_sigma_kg=np.inf)
    found = base_parameters(*whitened(pieces, np.ones(3)), inertial_columns(3))
    assert found.rank == fit.rank
    np.testing.assert_allclose(found.grouping @ fit.phi, found.value, atol=1e-10)
    np.testing.assert_allclose(found.share, np.diagonal(fit.projector), atol=1e-9)


def test_a_direction_in_the_noise_is_none_of_the_base_parameters(rng: Generator) -> None:
    # Axes 0.1 mrad from parallel: in theory they show more than parallel ones, in the noise they do not.
    almost = np.array([0.0, 1.0, 1e-4])
    axis = np.array([[0.0, 1.0, 0.0], almost / np.linalg.norm(almost)])
    chain = chain_of((-1, 0), axis, rng.uniform(-0.3, 0.3, (2, 3)))
    signals = motion(rng, 200, 2)
    tau = inverse_dynamics(chain, bodies(rng, 2), *signals) + 0.05 * rng.normal(size=(200, 2))
    rows = whitened(gather(chain, *signals, tau), np.full(2, 0.05))
    assert base_parameters(*rows, inertial_columns(2)).rank > 6
    assert base_parameters(*rows, inertial_columns(2), max_sigma=0.3).rank == 6


def test_a_direction_that_the_errors_of_axes_hide_is_none_of_the_base_parameters(rng: Generator) -> None:
    # Axes 1 mrad from parallel, and known no better than that: quiet torques do not make up for it.
    almost = np.array([0.0, 1.0, 1e-3])
    axis = np.array([[0.0, 1.0, 0.0], almost / np.linalg.norm(almost)])
    chain = chain_of((-1, 0), axis, rng.uniform(-0.3, 0.3, (2, 3)))
    phi, signals = bodies(rng, 2), motion(rng, 200, 2)
    parallel = chain._replace(axis=np.array([[0.0, 1.0, 0.0]] * 2))
    tau = inverse_dynamics(chain, phi, *signals)
    change = inverse_dynamics(parallel, phi, *signals) - tau
    pieces = gather(chain, *signals, tau + 1e-4 * rng.normal(size=tau.shape))
    effects = [gather(chain, *signals, change)[i].z[:, None] for i in range(2)]
    rows, noise = whitened(pieces, np.full(2, 1e-4)), whitened_effects(effects, np.full(2, 1e-4))
    quiet = base_parameters(*rows, inertial_columns(2), max_sigma=0.3)
    assert quiet.rank == 8
    # One direction of errors hides one direction of parameters.
    assert base_parameters(*rows, inertial_columns(2), max_sigma=0.3, common_errors=noise).rank == 7


def test_noise_may_leave_no_base_parameter_at_all(rng: Generator) -> None:
    signals = motion(rng, 200, 1)
    pieces = gather(random_tree(rng, 1), *signals, rng.normal(size=(200, 1)))
    found = base_parameters(*whitened(pieces, [1e6]), inertial_columns(1), max_sigma=0.3)
    assert found.rank == 0
    assert found.grouping.shape == (0, 10)
    assert (found.share == 0.0).all()


def test_friction_beside_inertia_stays_a_parameter_of_its_own(rng: Generator) -> None:
    chain = random_tree(rng, 2)
    signals = motion(rng, 200, 2)
    y = torque_regressor(chain, *signals).reshape(-1, 20)
    viscous = (signals[1][:, :, None] * np.eye(2)).reshape(-1, 2)
    columns = inertial_columns(2).append(["viscous 1", "viscous 2"])
    truth = np.concatenate([bodies(rng, 2), [0.3, 0.7]])
    rows = np.hstack([y, viscous])
    found = base_parameters(rows, rows @ truth, columns)
    assert found.rank == base_parameters(y, y @ truth[:20], inertial_columns(2)).rank + 2
    named = dict(zip((found.summary(i) for i in range(found.rank)), found.value, strict=True))
    assert named["viscous 1"] == pytest.approx(0.3)
    assert named["viscous 2"] == pytest.approx(0.7)


def test_samples_that_are_not_independent_widen_the_deviations(rng: Generator) -> None:
    chain = random_tree(rng, 1)
    signals = motion(rng, 50, 1)
    pieces = gather(chain, *signals, rng.normal(size=(50, 1)))
    plain, filtered = (
        base_parameters(*whitened(pieces, [1.0], fraction), inertial_columns(1)) for fraction in (1.0, 0.25)
    )
    np.testing.assert_allclose(filtered.sigma, 2.0 * plain.sigma)


def test_torque_sensors_of_unknown_scale_widen_what_is_claimed_as_much_as_they_err(rng: Generator) -> None:
    chain, sigma = random_tree(rng, 3), np.full(3, 0.02)
    truth = bodies(rng, 3)
    signals = motion(rng, 200, 3)
    tau = inverse_dynamics(chain, truth, *signals)
    found = []
    for _ in range(300):
        sensed = tau * (1.0 + 0.05 * rng.normal(size=3)) + sigma * rng.normal(size=tau.shape)
        pieces = gather(chain, *signals, sensed)
        rows, target = whitened(pieces, sigma)
        scale = TorqueScale(np.zeros(3), 0.05**2 * np.eye(3))
        errors = whitened_effects(scale_effects(pieces, scale), sigma)
        found.append(base_parameters(rows, target, inertial_columns(3), common_errors=errors))
    scatter = np.std([one.value for one in found], axis=0)
    claimed = np.mean([one.sigma for one in found], axis=0)
    # A deviation out of 300 trials has a standard error of 4 %: five of them.
    np.testing.assert_allclose(claimed, scatter, rtol=0.2)
    noise = base_parameters(*whitened(pieces, sigma), inertial_columns(3)).sigma
    assert (claimed > 5.0 * noise).any()
    np.testing.assert_allclose(found[-1].value, base_parameters(rows, target, inertial_columns(3)).value)


def test_what_does_not_fit_is_named_and_results_cannot_be_written_to(rng: Generator) -> None:
    columns = inertial_columns(1)
    with pytest.raises(ValueError, match=r"rows \(5, 9\) and target \(5,\) do not fit 10 named columns"):
        base_parameters(np.ones((5, 9)), np.ones(5), columns)
    with pytest.raises(UndeterminedError, match="the torques say nothing"):
        base_parameters(np.zeros((5, 10)), np.ones(5), columns)
    with pytest.raises(DataError, match="not finite"):
        base_parameters(np.full((5, 10), np.nan), np.ones(5), columns)
    with pytest.raises(ValueError, match=r"common errors \(4, 1\) must be finite, 5 rows"):
        base_parameters(np.ones((5, 10)), np.ones(5), columns, common_errors=np.ones((4, 1)))
    pieces = gather(random_tree(rng, 1), *motion(rng, 20, 1), np.ones((20, 1)))
    with pytest.raises(DataError, match="sigma_nm must be 1 positive numbers, one per joint"):
        whitened(pieces, [0.0])
    with pytest.raises(ValueError, match="independent_fraction is 2"):
        whitened(pieces, [1.0], 2.0)
    found = base_parameters(*whitened(pieces, [1.0]), columns)
    assert not any(array.flags.writeable for array in found if isinstance(array, np.ndarray))
