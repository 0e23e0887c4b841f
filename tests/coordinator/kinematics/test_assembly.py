"""The chain follows from circles and gravity; unresolved directions are named and stay neutral."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from coordinator.kinematics.assembly import AssemblyError, ChainFit, assemble
from coordinator.kinematics.chain_observations import (
    AXIS_FLOOR_RAD,
    DISTANCE_FLOOR_M,
    DISTANCE_FLOOR_RELATIVE,
    GRAVITY_FLOOR_RAD,
    PairObservation,
    pack,
    predict,
    residuals,
)
from module_agent.model.catalogue import CATALOGUE
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.model.forward_kinematics import imu_poses
from module_agent.model.perturbation import apply_perturbation

X5 = CATALOGUE["X5-4"]


def fit_exact(robots: Any, chain: Chain, types: Any, seed: int) -> ChainFit:
    positions = robots.positions(chain, seed)
    return assemble(
        robots.topology(chain), types, robots.observe(chain, positions), [robots.rest(chain, positions[0])]
    )


def without_null_space(fit: ChainFit, truth: Chain) -> Chain:
    """Move the estimate along its null space, and nowhere else, as near to the truth as it goes."""

    def off(amounts: np.ndarray) -> np.ndarray:
        return (
            apply_perturbation(fit.chain, fit.estimate.null_basis @ amounts).imu_home - truth.imu_home
        ).ravel()

    start = np.zeros(fit.estimate.null_basis.shape[1])
    best = least_squares(off, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x if start.size else start
    return apply_perturbation(fit.chain, fit.estimate.null_basis @ best)


@pytest.mark.parametrize("seed", range(12))
def test_exact_observations_of_any_tree_give_the_exact_chain_up_to_the_named_null_space(
    robots: Any, seed: int
) -> None:
    chain, types = robots.random(seed, joints=2 + seed % 7)
    fit = fit_exact(robots, chain, types, seed)
    found = without_null_space(fit, chain)
    np.testing.assert_allclose(found.imu_home, chain.imu_home, atol=1e-6)
    np.testing.assert_allclose(found.axis, chain.axis, atol=1e-6)
    np.testing.assert_allclose(found.point, chain.point, atol=1e-6)
    np.testing.assert_allclose(fit.chain.gravity, chain.gravity, atol=1e-5)
    q = np.random.default_rng(seed).uniform(-2, 2, (4, len(types)))
    np.testing.assert_allclose(imu_poses(found, q), imu_poses(chain, q), atol=1e-5)
    assert fit.estimate.rank + fit.estimate.null_basis.shape[1] == 6 * len(chain.serials) - 4
    assert fit.reduced_chi2 < 1e-10


@pytest.mark.parametrize("seed", range(4))
def test_only_the_offset_along_the_first_axis_is_open_in_a_general_serial_robot(
    robots: Any, seed: int
) -> None:
    chain, types = robots.random(50 + seed, joints=5, serial=True)
    fit = fit_exact(robots, chain, types, seed)
    assert [(u.kind, u.joint) for u in fit.estimate.unresolved] == [("offset_along_axis", "M00")]
    assert "nothing" in fit.estimate.unresolved[0].resolved_by


def test_two_trees_on_one_base_cannot_know_where_the_other_stands(robots: Any) -> None:
    chain, types = robots.random(7, joints=6, roots=2)
    fit = fit_exact(robots, chain, types, 7)
    kinds = [(u.kind, u.joint) for u in fit.estimate.unresolved]
    assert ("position", "") in kinds
    assert ("rotation_about_gravity", "") in kinds
    assert all(kind != "combination" for kind, _ in kinds)
    # Heading and place of the other tree may be far off: compared are the links, which depend on neither.
    for k, parent in enumerate(chain.parent):
        if parent >= 0:
            off = chain.imu_home[k, :3, 3] - chain.point[parent]
            length = np.linalg.norm(np.cross(off, chain.axis[parent]))
            assert fit.estimate.link_length_m[k] == pytest.approx(length, abs=1e-6)


def test_every_branch_of_a_tree_has_an_unobservable_offset_of_its_own(robots: Any) -> None:
    homes = np.tile(np.eye(4), (3, 1, 1))
    homes[0] = robots.root_pose(X5)
    homes[1, :3, 3], homes[2, :3, 3] = [0.2, 0.0, 0.05], [-0.2, 0.1, 0.15]
    homes[1:, :3, :3] = Rotation.random(2, rng=np.random.default_rng(1)).as_matrix()
    chain = robots.build([-1, 0, 0], [False] * 3, homes, [X5] * 3, np.array([1.0, 0.0, 0.3]))
    fit = fit_exact(robots, chain, [X5] * 3, 1)
    assert [(u.kind, u.joint, u.modules) for u in fit.estimate.unresolved] == [
        ("offset_along_axis", "M00", ("M01",)),
        ("offset_along_axis", "M00", ("M02",)),
    ]


def test_modules_mounted_half_a_turn_from_straight_are_found_through_joints_that_swing_along(
    robots: Any,
) -> None:
    """Parallel joints, links turned by half a turn: observations of an axis determine its sign."""
    homes = np.tile(np.eye(4), (5, 1, 1))
    homes[0] = robots.root_pose(X5)
    turns = [("z", 0.0), ("x", np.pi / 2), ("x", -np.pi / 2), ("x", np.pi / 2), ("y", np.pi / 2)]
    for k, (about, angle) in enumerate(turns[1:], start=1):
        homes[k, :3, :3] = Rotation.from_euler(about, angle).as_matrix()
        homes[k, :3, 3] = [0.05 * (-1) ** k, 0.02 * k, 0.2 * k]
    chain = robots.build([-1, 0, 1, 2, 3], [False] * 5, homes, [X5] * 5, np.array([0.1, 0.05, 1.0]))
    positions = robots.positions(chain, 1)
    # Held joints that swing with 40 % of the moving one's motion.
    poor = [p._replace(sigma_axis_rad=0.4) for p in robots.observe(chain, positions)]
    fit = assemble(robots.topology(chain), [X5] * 5, poor, [robots.rest(chain, positions[0])])
    along = np.sum(fit.chain.axis * chain.axis, axis=1)
    assert along.min() > np.cos(0.2), along


def noisy(robots: Any, chain: Chain, seed: int, positions: np.ndarray) -> tuple[Any, Any]:
    """Observations with errors of exactly the size that the fit believes in."""
    rng = np.random.default_rng(seed)
    pairs = []
    for p in robots.observe(chain, positions):
        floor = DISTANCE_FLOOR_M + DISTANCE_FLOOR_RELATIVE * np.linalg.norm(p.radial_m)
        size = np.hypot(1e-3, floor)
        tilt = Rotation.from_rotvec(rng.normal(0, np.hypot(1e-3, AXIS_FLOOR_RAD), 3))
        pairs.append(
            p._replace(
                axis=tilt.apply(p.axis),
                radial_m=p.radial_m + rng.normal(0, size, 3),
                sigma_axis_rad=1e-3,
                sigma_distance_m=1e-3,
            )
        )
    rest = robots.rest(chain, positions[0])
    tilt = Rotation.from_rotvec(rng.normal(0, GRAVITY_FLOOR_RAD, (len(chain.serials), 3)))
    return pairs, [rest._replace(specific_force_m_s2=tilt.apply(rest.specific_force_m_s2))]


def test_with_noise_the_errors_are_those_that_the_covariance_states(robots: Any) -> None:
    """Mahalanobis distances of the resolved errors over 20 draws, and the chi2 of the residuals."""
    chain, types = robots.random(3, joints=5, serial=True)
    positions = robots.positions(chain, 3)
    chi2, lengths, distances = [], [], []
    truth = assemble(
        robots.topology(chain), types, robots.observe(chain, positions), [robots.rest(chain, positions[0])]
    ).estimate.link_length_m
    for seed in range(20):
        fit = assemble(robots.topology(chain), types, *noisy(robots, chain, seed, positions))
        chi2.append(fit.reduced_chi2)
        lengths.append((fit.estimate.link_length_m - truth)[1:] / fit.estimate.link_length_sigma_m[1:])
        aligned = without_null_space(fit, chain)
        distances.append(mahalanobis(aligned, chain, fit))
    freedom = 4 * 10 + 2 * 5 - fit.estimate.rank
    # 20 draws of `freedom` squares each: sigma of the mean is sqrt(2 / (20 freedom)), four times that.
    assert np.mean(chi2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (20 * freedom)))
    assert np.sqrt(np.mean(np.square(lengths))) == pytest.approx(1.0, abs=4 / np.sqrt(2 * 80))
    assert np.abs(lengths).max() < 4.5
    # Squares over the resolved directions of the poses: rank less the two of gravity.
    assert np.mean(distances) / (fit.estimate.rank - 2) == pytest.approx(1.0, abs=0.3)


def mahalanobis(found: Chain, truth: Chain, fit: ChainFit) -> float:
    """Squared distance of two chains by the fit's covariance, null space left out."""
    error = RigidTransform.from_matrix(truth.imu_home @ np.linalg.inv(found.imu_home)).as_exp_coords().ravel()
    return float(error @ np.linalg.pinv(fit.estimate.covariance, rcond=1e-9, hermitian=True) @ error)


def test_a_worse_observation_is_named_by_its_misfit(robots: Any) -> None:
    chain, types = robots.random(11, joints=4, serial=True)
    positions = robots.positions(chain, 11)
    pairs, rests = noisy(robots, chain, 1, positions)
    bad = next(n for n, p in enumerate(pairs) if (p.joint, p.observer) == ("M01", "M03"))
    pairs[bad] = pairs[bad]._replace(radial_m=pairs[bad].radial_m + np.array([0.03, -0.03, 0.03]))
    fit = assemble(robots.topology(chain), types, pairs, rests)
    assert fit.reduced_chi2 > 3.0
    others = [n for n, p in enumerate(pairs) if p.joint != p.observer]
    rest = residuals(fit.chain, pack(chain.serials, pairs, rests))[: 4 * len(others)].reshape(2, -1, 2)
    assert others[int(np.argmax(np.sum(rest**2, axis=(0, 2))))] == bad


def two_modules(robots: Any, up: np.ndarray, yaw: float) -> Chain:
    """A root whose axis is z, and a link of 0.3 m with the next module turned by `yaw` about it."""
    homes = np.tile(np.eye(4), (2, 1, 1))
    homes[0] = robots.root_pose(X5)
    homes[1, :3, :3] = Rotation.from_euler("zx", [yaw, 0.4]).as_matrix()
    homes[1, :3, 3] = [0.3 * np.cos(yaw), 0.3 * np.sin(yaw), 0.12]
    return robots.build([-1, 0], [False, False], homes, [X5, X5], up)


def test_on_a_vertical_axis_the_yaw_of_the_next_module_is_unknown_and_said_so(robots: Any) -> None:
    chain = two_modules(robots, np.array([0.0, 0.0, 1.0]), yaw=0.9)
    fit = fit_exact(robots, chain, [X5, X5], 0)
    assert [(u.kind, u.joint, u.modules) for u in fit.estimate.unresolved] == [
        ("offset_along_axis", "M00", ("M01",)),
        ("rotation_about_axis", "M00", ("M01",)),
    ]
    assert "base yaw" in fit.estimate.unresolved[1].text
    assert "fixed base" in fit.estimate.unresolved[0].text
    assert fit.estimate.link_length_m[1] == pytest.approx(0.3 - 0.0, abs=0.05)
    np.testing.assert_allclose(without_null_space(fit, chain).imu_home, chain.imu_home, atol=1e-6)
    # Left at neutral, in the plane of the root's output face, but for what the first guess was off (0.1 mm).
    assert fit.chain.imu_home[1, 2, 3] == pytest.approx(X5.output_xyz[2], abs=1e-4)


def test_on_a_horizontal_axis_gravity_resolves_the_yaw_but_not_the_offset(robots: Any) -> None:
    chain = two_modules(robots, np.array([1.0, 0.2, 0.0]), yaw=-0.7)
    fit = fit_exact(robots, chain, [X5, X5], 0)
    assert [(u.kind, u.joint) for u in fit.estimate.unresolved] == [("offset_along_axis", "M00")]
    np.testing.assert_allclose(fit.chain.imu_home[1, :3, :3], chain.imu_home[1, :3, :3], atol=1e-6)


def test_a_single_module_is_a_chain_with_nothing_unknown_but_gravity(robots: Any) -> None:
    chain = robots.build([-1], [True], robots.root_pose(X5)[None], [X5], np.array([0.1, 0.0, 1.0]))
    fit = assemble(robots.topology(chain), [X5], [], [robots.rest(chain, np.array([0.8]))])
    np.testing.assert_allclose(fit.chain.gravity, chain.gravity, atol=1e-9)
    np.testing.assert_allclose(fit.chain.axis, [[0, 0, -1]])
    assert fit.estimate.unresolved == ()
    assert np.isnan(fit.estimate.link_length_m[0])


def test_parallel_axes_leave_the_offset_along_them_open_however_many_they_are(robots: Any) -> None:
    """A planar arm: three parallel axes, and gravity across them."""
    homes = np.tile(np.eye(4), (3, 1, 1))
    homes[0] = robots.root_pose(X5)
    homes[1, :3, 3], homes[2, :3, 3] = [0.3, 0.0, 0.05], [0.5, 0.1, 0.11]
    chain = robots.build([-1, 0, 1], [False] * 3, homes, [X5] * 3, np.array([0.0, 1.0, 0.0]))
    fit = fit_exact(robots, chain, [X5] * 3, 4)
    assert [(u.kind, u.joint) for u in fit.estimate.unresolved] == [
        ("offset_along_axis", "M00"),
        ("offset_along_axis", "M01"),
    ]
    assert "parallel" in fit.estimate.unresolved[1].text
    np.testing.assert_allclose(without_null_space(fit, chain).imu_home, chain.imu_home, atol=1e-6)


def test_noise_does_not_resolve_what_parallel_axes_leave_open(robots: Any) -> None:
    homes = np.tile(np.eye(4), (3, 1, 1))
    homes[0] = robots.root_pose(X5)
    homes[1, :3, 3], homes[2, :3, 3] = [0.3, 0.0, 0.05], [0.5, 0.1, 0.11]
    chain = robots.build([-1, 0, 1], [False] * 3, homes, [X5] * 3, np.array([0.0, 0.0, 1.0]))
    positions = robots.positions(chain, 5)
    for seed in range(5):
        fit = assemble(robots.topology(chain), [X5] * 3, *noisy(robots, chain, seed, positions))
        kinds = [(u.kind, u.joint) for u in fit.estimate.unresolved]
        assert ("offset_along_axis", "M00") in kinds
        assert ("offset_along_axis", "M01") in kinds
        assert ("rotation_about_axis", "M00") in kinds


def test_a_wrong_sign_of_an_axis_is_reported_and_not_fitted(robots: Any) -> None:
    chain, types = robots.random(21, joints=4, serial=True)
    positions = robots.positions(chain, 21)
    pairs = [
        p._replace(axis=-p.axis) if (p.joint, p.observer) == ("M00", "M03") else p
        for p in robots.observe(chain, positions)
    ]
    with pytest.raises(AssemblyError, match="M03 saw the axis of joint"):
        assemble(robots.topology(chain), types, pairs, [robots.rest(chain, positions[0])])


def through_play(robots: Any, chain: Chain, positions: np.ndarray, seed: int) -> list[PairObservation]:
    """Observations of which those through three joints and more err by up to 1.1 rad, and claim 0.003."""
    rng, pairs = np.random.default_rng(seed), []
    for pair in robots.observe(chain, positions):
        is_far = chain.serials.index(pair.observer) - chain.serials.index(pair.joint) >= 3
        turn = rng.normal(size=3)
        turn *= (1.1 if is_far else 0.03) * rng.uniform(0.3, 1.0) / np.linalg.norm(turn)
        place = rng.normal(0.0, 0.2 * np.linalg.norm(turn), 3)
        pairs.append(
            pair._replace(
                axis=Rotation.from_rotvec(turn).apply(pair.axis),
                radial_m=pair.radial_m + place,
                sigma_axis_rad=0.003 if is_far else 0.05,
                sigma_distance_m=0.003 if is_far else 0.02,
            )
        )
    return pairs


@pytest.mark.parametrize("seed", [13, 14])
def test_observations_that_are_worse_than_they_claim_turn_no_axis_around(robots: Any, seed: int) -> None:
    """As those through many joints with play: least squares would end with an axis the other way round."""
    chain, types = robots.random(seed, joints=8, serial=True)
    positions = robots.positions(chain, seed)
    pairs, rests = through_play(robots, chain, positions, seed), [robots.rest(chain, positions[0])]
    fit = assemble(robots.topology(chain), types, pairs, rests)
    observations = pack(chain.serials, pairs, rests)
    true, found = (predict(one, observations).axis for one in (chain, fit.chain))
    off_deg = np.degrees(np.arccos(np.clip(np.sum(true * found, axis=1), -1.0, 1.0)))
    # Within reach of the batch refinement; the far observations err by 40 degrees in the mean.
    assert off_deg.max() < 30.0
    assert np.median(off_deg) < 10.0


def test_a_missing_rest_and_unknown_serials_are_refused(robots: Any) -> None:
    chain, types = robots.random(1, joints=2)
    positions = robots.positions(chain, 1)
    pairs, rest = robots.observe(chain, positions), robots.rest(chain, positions[0])
    with pytest.raises(DataError, match="gravity"):
        assemble(robots.topology(chain), types, pairs, [])
    silent = rest._replace(specific_force_m_s2=np.array(rest.specific_force_m_s2) * [[1.0], [0.0]])
    with pytest.raises(DataError, match="the accelerometer of M01 reads nothing at rest"):
        assemble(robots.topology(chain), types, pairs, [rest, silent])
    with pytest.raises(ValueError, match="M99 is not in the topology"):
        assemble(robots.topology(chain), types, [pairs[0]._replace(joint="M99")], [rest])
    with pytest.raises(ValueError, match="1 module types for 2 modules"):
        assemble(robots.topology(chain), types[:1], pairs, [rest])
