"""A known robot brought up to date: what is kept stays as it was, what changed comes from the session."""

from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest

from coordinator.baseline.difference import difference, joints_to_explore
from coordinator.baseline.update import placed
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.topology.topology import Topology
from module_agent.model.chain import Chain
from module_agent.model.perturbation import adjoint, apply_perturbation, perturbation_between
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain

FINE, COARSE = (3e-4, 2e-4), (3e-3, 2e-3)


@cache
def _robot(name: str) -> Robot:
    return load_robot(name)


def _without(robot: Robot, serial: str) -> Robot:
    """The same robot with one module taken out, and what it carried put onto its parent."""
    gone = robot.modules[robot.serials.index(serial)]
    kept = [
        m.model_copy(update={"parent": gone.parent}) if m.parent == serial else m
        for m in robot.modules
        if m.serial != serial
    ]
    return robot.model_copy(update={"modules": tuple(kept)})


def _renamed(robot: Robot, serial: str, other: str) -> Robot:
    """The same robot with a module of another serial in one place."""
    names = {serial: other}
    modules = [
        m.model_copy(
            update={"serial": names.get(m.serial, m.serial), "parent": names.get(m.parent, m.parent)}
        )
        for m in robot.modules
    ]
    return robot.model_copy(update={"modules": tuple(modules)})


def _topology(chain: Chain) -> Topology:
    values: dict[str, object] = dict.fromkeys(Topology._fields)
    values |= {"serials": chain.serials, "parent": chain.parent, "reversed": chain.reversed}
    return Topology(**values)  # type: ignore[arg-type]


def _spread(chain: Chain, sigma: Mapping[str, tuple[float, float]]) -> np.ndarray:
    """Every link's errors displace all beyond it: [rad, m] by the serial of its module."""
    found = np.zeros((6 * len(chain.serials),) * 2)
    for k, serial in enumerate(chain.serials):
        if k:
            columns = np.zeros((6 * len(chain.serials), 6))
            for j in chain.descendants(k):
                columns[6 * j : 6 * j + 6] = adjoint(chain.imu_home[k])
            found += columns @ np.diag(np.repeat(sigma.get(serial, FINE), 3) ** 2) @ columns.T
    return found


def _fit(chain: Chain, covariance: np.ndarray, hidden: np.ndarray | None = None) -> ChainEstimate:
    null_basis = np.zeros((len(covariance), 0)) if hidden is None else hidden
    return ChainEstimate(chain, covariance, null_basis, 0, 1.0)


def _drawn(chain: Chain, covariance: np.ndarray, rng: np.random.Generator) -> ChainEstimate:
    noise = rng.multivariate_normal(np.zeros(len(covariance)), covariance, method="eigh")
    return _fit(apply_perturbation(chain, noise), covariance)


def _relative(chain: Chain, top: str, serial: str) -> np.ndarray:
    a, b = (chain.imu_home[chain.serials.index(s)] for s in (top, serial))
    return np.asarray(np.linalg.inv(a) @ b)


ARM = "arm6"


@pytest.mark.parametrize(
    ("known", "found", "parts", "explored"),
    [
        ("full", "full", [6], ()),
        ("no A-6", "full", [5, 1], ("A-4", "A-5")),
        ("full", "no A-6", [5], ()),
        ("full", "A-4 swapped", [3, 1, 2], ("A-2", "A-3", "other")),
        ("full", "no A-4", [3, 2], ("A-2", "A-3")),
    ],
)
def test_only_the_links_next_to_what_is_other_are_looked_at(
    known: str, found: str, parts: list[int], explored: tuple[str, ...]
) -> None:
    robot = _robot(ARM)
    robots = {
        "full": robot,
        "no A-6": _without(robot, "A-6"),
        "no A-4": _without(robot, "A-4"),
        "A-4 swapped": _renamed(robot, "A-4", "other"),
    }
    before, after = (_topology(true_chain(robots[name])) for name in (known, found))
    other = difference(before, after)
    assert [len(part) for part in other.parts] == parts
    assert joints_to_explore(after, other) == explored
    assert other.nothing == (known == found)


def test_a_module_that_is_mounted_elsewhere_takes_along_what_hangs_on_it() -> None:
    robot = _robot("tree_y")
    moved = robot.model_copy(
        update={
            "modules": tuple(
                m.model_copy(update={"parent": "right-2"}) if m.serial == "left-2" else m
                for m in robot.modules
            )
        }
    )
    after = true_chain(robot)
    parent = list(after.parent)
    parent[after.serials.index("left-2")] = after.serials.index("right-2")
    other = difference(_topology(after), _topology(after._replace(parent=tuple(parent))))
    assert moved.modules[2].parent == "right-2"
    assert other.moved == ("left-2",)
    assert ("left-2", "left-3") in other.parts


def test_a_part_that_is_kept_is_as_it_was_known_to_the_last_digit() -> None:
    rng = np.random.default_rng(1)
    full, short = true_chain(_robot(ARM)), true_chain(_without(_robot(ARM), "A-6"))
    known = _drawn(short, _spread(short, {}), rng)
    session = _drawn(full, _spread(full, dict.fromkeys(short.serials, COARSE)), rng)
    parts = difference(_topology(short), _topology(full)).parts
    result = placed(known, session, parts)
    for serial in short.serials:
        assert np.allclose(
            _relative(result.chain, "A-1", serial), _relative(known.chain, "A-1", serial), atol=1e-12
        )
    kept = 6 * len(short.serials)
    assert np.allclose(result.covariance[:kept, :kept], known.covariance, atol=1e-12)
    assert np.allclose(result.chain.axis[:5], known.chain.axis, atol=1e-12)


def test_a_swapped_module_leaves_both_arms_as_they_were_known() -> None:
    rng = np.random.default_rng(2)
    robot = _robot(ARM)
    before, after = true_chain(robot), true_chain(_renamed(robot, "A-4", "other"))
    known = _drawn(before, _spread(before, {}), rng)
    session = _drawn(after, _spread(after, {"A-2": COARSE, "A-3": COARSE, "A-6": COARSE}), rng)
    result = placed(known, session, difference(_topology(before), _topology(after)).parts)
    assert np.allclose(
        _relative(result.chain, "A-5", "A-6"), _relative(known.chain, "A-5", "A-6"), atol=1e-12
    )
    assert np.allclose(
        _relative(result.chain, "A-1", "A-3"), _relative(known.chain, "A-1", "A-3"), atol=1e-12
    )


@pytest.mark.parametrize("case", ["added", "swapped", "taken out"])
def test_errors_are_as_large_as_claimed(case: str) -> None:
    rng = np.random.default_rng(3)
    robot = _robot(ARM)
    robots = {
        "added": (_without(robot, "A-6"), robot),
        "swapped": (robot, _renamed(robot, "A-4", "other")),
        "taken out": (robot, _without(robot, "A-4")),
    }
    before, after = (true_chain(r) for r in robots[case])
    other = difference(_topology(before), _topology(after))
    fresh = {part[0] for part in other.parts}
    sigma = {s: FINE if s in fresh else COARSE for s in after.serials}
    spreads = _spread(before, {}), _spread(after, sigma)
    excess = []
    for _ in range(150):
        result = placed(_drawn(before, spreads[0], rng), _drawn(after, spreads[1], rng), other.parts)
        error = perturbation_between(after, result.chain)[6:]
        excess.append(error @ np.linalg.solve(result.covariance[6:, 6:], error) / len(error))
    assert result.null_basis.shape[1] == 0
    # Chi-squared of 24 to 30 degrees of freedom over itself: 150 of them average to 1 +- 0.024; the model is
    # linear, the errors are some mrad.
    assert np.mean(excess) == pytest.approx(1.0, abs=0.1)


def test_what_the_session_does_not_see_of_a_new_link_is_said() -> None:
    full, short = true_chain(_robot(ARM)), true_chain(_without(_robot(ARM), "A-6"))
    lost = np.zeros((36, 1))
    lost[30:, 0] = adjoint(full.imu_home[5]) @ np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    lost /= np.linalg.norm(lost)
    seen = np.eye(36) - lost @ lost.T
    session = _fit(full, seen @ _spread(full, {}) @ seen, lost)
    known = _fit(short, _spread(short, {}))
    result = placed(known, session, difference(_topology(short), _topology(full)).parts)
    assert result.null_basis.shape == (36, 1)
    assert abs(result.null_basis[:, 0] @ lost[:, 0]) == pytest.approx(1.0, abs=1e-6)
    assert result.rank == 29


def test_what_the_known_robot_did_not_tell_stays_untold() -> None:
    full = true_chain(_robot(ARM))
    lost = np.zeros((36, 1))
    for k in range(1, 6):
        lost[6 * k : 6 * k + 6, 0] = np.r_[np.zeros(3), full.axis[0]]
    lost /= np.linalg.norm(lost)
    seen = np.eye(36) - lost @ lost.T
    known = _fit(full, seen @ _spread(full, {}) @ seen, lost)
    result = placed(known, known, [full.serials])
    assert abs(result.null_basis[:, 0] @ lost[:, 0]) == pytest.approx(1.0, abs=1e-3)


def test_a_part_of_modules_that_are_not_known_is_refused() -> None:
    full = true_chain(_robot(ARM))
    short = true_chain(_without(_robot(ARM), "A-6"))
    with pytest.raises(ValueError, match="the baseline has no module A-6"):
        placed(_fit(short, _spread(short, {})), _fit(full, _spread(full, {})), [full.serials])
