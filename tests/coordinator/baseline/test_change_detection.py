"""Which link changed: from two chains with known covariances, drawn as two sessions' noise would."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from coordinator.baseline.change_detection import FLOOR_M, FLOOR_RAD, TIED, TiedFits, find_changes
from coordinator.batch_estimation.estimator import Refinement
from coordinator.kinematics.chain_estimate import ChainEstimate
from module_agent.model.chain import Chain
from module_agent.model.perturbation import adjoint, apply_perturbation, perturbation_between
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain

ARM, TREE = "arm6", "tree_y"
# Noise of each module's housing, in the root frame.
SIGMA_RAD, SIGMA_M = 2e-4, 1e-4

Draw = Callable[..., TiedFits]


@cache
def _true(robot: str) -> Chain:
    return true_chain(load_robot(robot))


def _spread(chain: Chain, hidden: np.ndarray) -> np.ndarray:
    """Correlated from module to module, as errors of a chain are; nothing in what is hidden."""
    n = len(chain.serials)
    one = np.diag(np.repeat([SIGMA_RAD, SIGMA_M], 3) ** 2)
    steps = np.tril(np.ones((n, n))) @ np.diag([0.0] + [1.0] * (n - 1)) @ np.tril(np.ones((n, n))).T
    seen = np.eye(6 * n) - hidden @ hidden.T
    return np.asarray(seen @ np.kron(steps, one) @ seen)


def _fit(chain: Chain, covariance: np.ndarray, hidden: np.ndarray) -> Refinement:
    values: dict[str, object] = dict.fromkeys(Refinement._fields)
    values |= {
        "estimate": ChainEstimate(chain, covariance, hidden, 0, 1.0),
        "noise_covariance": covariance,
    }
    return Refinement(**values)  # type: ignore[arg-type]


def _ending_at(fits: TiedFits, chain: Chain) -> TiedFits:
    return fits._replace(after=fits.after._replace(estimate=replace(fits.after.estimate, chain=chain)))


@pytest.fixture
def draw() -> Draw:
    """Two sessions of one robot, the second one with a displacement of one link (in its IMU's frame)."""

    def make(
        robot: str,
        rng: np.random.Generator,
        child: str | None = None,
        twist: np.ndarray | None = None,
        hidden: np.ndarray | None = None,
    ) -> TiedFits:
        chain = _true(robot)
        unknown = np.zeros((6 * len(chain.serials), 0)) if hidden is None else hidden
        covariance = _spread(chain, unknown)
        change = np.zeros(6 * len(chain.serials))
        if child is not None and twist is not None:
            change = _moved(chain, chain.serials.index(child), twist)
        seen = np.eye(len(change)) - unknown @ unknown.T
        noise = [rng.multivariate_normal(np.zeros(len(change)), covariance, method="eigh") for _ in range(2)]
        before = apply_perturbation(chain, noise[0])
        after = apply_perturbation(chain, noise[1] + seen @ change)
        return TiedFits(*(_fit(c, covariance, unknown) for c in (before, after)))

    return make


def _moved(chain: Chain, k: int, twist: np.ndarray) -> np.ndarray:
    """All that hangs on module k moves with it: found by walking up from every module."""
    found = np.zeros((len(chain.serials), 6))
    for j in range(len(chain.serials)):
        at = j
        while at not in (-1, k):
            at = chain.parent[at]
        if at == k:
            found[j] = adjoint(chain.imu_home[k]) @ twist
    return found.ravel()


def test_increments_between_two_chains_lead_from_the_one_to_the_other() -> None:
    chain = _true(ARM)
    delta = 0.02 * np.random.default_rng(1).standard_normal(36)
    other = apply_perturbation(chain, delta)
    assert np.allclose(perturbation_between(chain, other), delta, atol=1e-12)


@pytest.mark.parametrize(("robot", "child"), [(ARM, "A-2"), (ARM, "A-4"), (ARM, "A-6"), (TREE, "right-1")])
def test_a_link_that_is_displaced_by_two_millimetres_is_found_and_sized(
    draw: Draw, robot: str, child: str
) -> None:
    twist = np.array([0.0, 0.0, 0.0, 1.2e-3, -1.2e-3, 1.06e-3])
    found = find_changes(draw(robot, np.random.default_rng(2), child, twist))
    chain = _true(robot)
    assert [chain.serials[c.child] for c in found.changed] == [child]
    assert found.false_alarm[0] < 1e-6
    # Noise of 0.1 mm a session and floors of 0.1 mm make 0.2 mm along each direction; four of these.
    assert np.linalg.norm(found.changed[0].displacement_m - twist[3:]) < 8e-4
    assert abs(found.changed[0].length_m - 2e-3) < 4.0 * found.changed[0].length_sigma_m


def test_links_beside_the_one_that_changed_look_as_chance_makes_them(draw: Draw) -> None:
    twist = np.array([0.0, 0.0, 0.0, 0.0, 2e-3, 0.0])
    found = find_changes(draw(ARM, np.random.default_rng(9), "A-4", twist))
    for one in found.each:
        # Of four links the least likely is below 1 in 1000 once in 250 robots.
        assert (one.chance < 1e-6) if one.child == 3 else (one.chance > 1e-3)


def test_of_two_links_that_changed_both_are_named_the_surer_one_first(draw: Draw) -> None:
    rng = np.random.default_rng(3)
    fits = draw(ARM, rng, "A-5", np.array([0.0, 0.0, 0.0, 0.0, 3e-3, 0.0]))
    chain = fits.before.chain
    second = _moved(chain, 2, np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
    both = _ending_at(fits, apply_perturbation(fits.after.chain, second))
    found = find_changes(both)
    assert [chain.serials[c.child] for c in found.changed] == ["A-3", "A-5"]
    assert found.changed[0].rotation_rad[0] == pytest.approx(0.02, abs=3e-3)


def test_robots_that_have_not_changed_are_called_changed_no_more_often_than_wanted(draw: Draw) -> None:
    rng = np.random.default_rng(4)
    wanted, checks = 0.05, 300
    alarms = sum(bool(find_changes(draw(ARM, rng), wanted).changed) for _ in range(checks))
    # The floors widen what is believed beyond the drawn noise, so that fewer are named; never more than
    # chance allows: the 99.9 % point of 300 draws at 5 % is 28.
    assert alarms <= 28


def test_the_gain_of_a_link_that_has_not_changed_is_distributed_as_chi_squared(draw: Draw) -> None:
    rng = np.random.default_rng(5)
    gains = []
    for _ in range(200):
        fits = draw(ARM, rng)
        # What the floors add is drawn as well: then all that is believed is there.
        chain = fits.after.chain
        for k in range(1, 6):
            twist = rng.standard_normal(6) * np.repeat([FLOOR_RAD, FLOOR_M], 3)
            chain = apply_perturbation(chain, _moved(_true(ARM), k, twist))
        (change,) = [c for c in find_changes(_ending_at(fits, chain)).each if c.child == 3]
        white = np.linalg.solve(
            np.linalg.cholesky(change.covariance), np.r_[change.rotation_rad, change.displacement_m]
        )
        gains.append(float(white @ white))
    # Mean 6 and variance 12; of 200 the mean is good to 0.25 and four of these are 1.
    assert np.mean(gains) == pytest.approx(6.0, abs=1.0)
    assert np.mean(np.array(gains) > chi2.isf(0.05, 6)) < 0.11


def test_it_is_the_generalised_least_squares_estimate(draw: Draw) -> None:
    twist = np.array([1e-3, 0.0, -2e-3, 2e-3, 0.0, 1e-3])
    fits = draw(ARM, np.random.default_rng(6), "A-4", twist)
    chain = fits.before.chain
    columns = np.array([_moved(chain, 3, unit) for unit in np.eye(6)]).T[6:]
    floor = sum(
        np.outer(c, c)
        for k in range(1, 6)
        for c in (
            _moved(chain, k, unit * size)[6:]
            for unit, size in zip(np.eye(6), np.repeat([FLOOR_RAD, FLOOR_M], 3), strict=True)
        )
    )
    weight = np.linalg.inv(2.0 * fits.before.noise_covariance[6:, 6:] + floor)
    difference = perturbation_between(chain, fits.after.chain)[6:]
    expected = np.linalg.solve(columns.T @ weight @ columns, columns.T @ weight @ difference)
    (change,) = find_changes(fits).changed
    assert np.allclose(np.r_[change.rotation_rad, change.displacement_m], expected, atol=1e-9)
    assert np.allclose(change.covariance, np.linalg.inv(columns.T @ weight @ columns), rtol=1e-6)


def test_what_neither_session_sees_is_named_and_left_at_zero(draw: Draw) -> None:
    chain = _true(ARM)
    lost = np.zeros((36, 1))
    # A displacement of all beyond A-6 along one direction of its IMU: not observable.
    lost[30:, 0] = adjoint(chain.imu_home[5]) @ np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    lost /= np.linalg.norm(lost)
    twist = np.array([0.0, 0.0, 0.0, 2e-3, 2e-3, 0.0])
    (change,) = find_changes(draw(ARM, np.random.default_rng(7), "A-6", twist, lost)).changed
    assert change.seen == 5
    assert np.allclose(np.abs(change.unseen), [[0.0, 0.0, 0.0, 0.0, 1.0, 0.0]], atol=5e-3)
    # The chain's own noise turns that direction by a milliradian.
    assert abs(change.displacement_m[1]) < 1e-5
    assert change.displacement_m[0] == pytest.approx(2e-3, abs=8e-4)


def test_what_would_be_found_is_found_in_the_worst_direction(draw: Draw) -> None:
    rng = np.random.default_rng(8)
    limit = find_changes(draw(ARM, rng)).would_find_m[5]
    (each,) = [c for c in find_changes(draw(ARM, rng)).each if c.child == 5]
    _, vectors = np.linalg.eigh(each.covariance[3:, 3:])
    twist = np.r_[np.zeros(3), limit * vectors[:, -1]]
    found = sum(bool(find_changes(draw(ARM, rng, "A-6", twist)).changed) for _ in range(60))
    # Two sigmas of margin: 98 of 100 are found, and of 60 at least 54 in all but one of 10^4 such draws.
    assert found >= 54
    assert np.isnan(find_changes(draw(ARM, rng)).would_find_m[0])


def test_imus_stay_where_the_baseline_found_them_so_that_they_do_not_absorb_a_displaced_link() -> None:
    # An IMU that may sit anywhere in its housing reads as a link that is displaced by as much.
    assert not TIED.placement_sigmas.any()
