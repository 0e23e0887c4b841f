"""The truth stands in the picture where the identified robot does, and what is left between them is error."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from coordinator.excitation.plan import Plan
from coordinator.kinematics.null_space import Unresolved, name_null_space
from coordinator.runtime.terminal import Terminal
from module_agent.model.chain import BASE, Chain
from module_agent.model.perturbation import apply_perturbation
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.robot.variants import as_built
from sim.scoring.chain_score import link_length_m
from sim.scoring.gauge_alignment import move_root, reorder
from sim.scoring.truth_view import aligned_truth
from sim.virtual_time.run import VirtualConfig, run_virtual


def free(chain: Chain) -> tuple[Unresolved, ...]:
    """All that a fixed base may leave open: how what is beyond the first joint stands along and about it."""
    beyond = [k for k, p in enumerate(chain.parent) if p == 0]
    columns = []
    for child in beyond:
        for twist in (
            np.r_[np.zeros(3), chain.axis[0]],
            np.r_[chain.axis[0], np.cross(chain.point[0], chain.axis[0])],
        ):
            column = np.zeros((len(chain.serials), 6))
            column[list(chain.descendants(child))] = twist
            columns.append(column.ravel())
    basis, _ = np.linalg.qr(np.array(columns).T)
    found = name_null_space(chain, basis)
    assert len(found) == len(columns)
    return found


def moved(chain: Chain, unresolved: tuple[Unresolved, ...], by: float) -> Chain:
    for number, item in enumerate(unresolved):
        chain = apply_perturbation(chain, item.directions[:, 0] * by * (1 + number))
    return chain


@pytest.mark.parametrize("name", ["a2085_04", "tree_y"])
@pytest.mark.parametrize("by", [0.02, 0.9, -1.3])
def test_what_cannot_be_known_is_taken_from_the_estimate(name: str, by: float) -> None:
    truth = true_chain(load_robot(name))
    unresolved = free(truth)
    estimated = moved(truth, unresolved, by)
    drawn = aligned_truth(truth, estimated, unresolved)
    np.testing.assert_allclose(drawn.imu_home, estimated.imu_home, atol=1e-6)
    np.testing.assert_allclose(drawn.axis, estimated.axis, atol=1e-6)


def test_an_error_that_can_be_known_stays_in_the_picture() -> None:
    truth = true_chain(load_robot("a2085_04"))
    wrong = np.zeros((4, 6))
    wrong[3, 3:] = 0.005 * (truth.imu_home[3, :3, 3] - truth.imu_home[2, :3, 3]) / 0.35
    estimated = moved(apply_perturbation(truth, wrong.ravel()), free(truth), 0.4)
    drawn = aligned_truth(truth, estimated, free(truth))
    apart = np.linalg.norm(drawn.imu_home[3, :3, 3] - estimated.imu_home[3, :3, 3])
    # 5 mm, of which the unknown turn and height take up no more than they can.
    assert 0.002 < apart <= 0.0051


def test_a_part_of_the_robot_in_its_own_frame_has_the_whole_truth_aligned_truth_it() -> None:
    truth = true_chain(load_robot("a2085_04"))
    # From the elbow on, as it is known when only the elbow has moved.
    root = truth.serials.index("elbow")
    housing = truth.imu_home[root].copy()
    housing[:3, 3] -= housing[:3, :3] @ [0.025, 0.0, 0.003]
    there, _ = move_root(truth, np.zeros((24, 0)), np.linalg.inv(housing))
    kept = [root, *[k for k in range(4) if root in truth.ancestors(k)[:-1]]]
    part = Chain(
        serials=tuple(there.serials[k] for k in kept),
        parent=(BASE, 0),
        reversed=(False, False),
        axis=there.axis[kept],
        point=there.point[kept],
        imu_home=there.imu_home[kept],
        gravity=there.gravity,
    )
    drawn = aligned_truth(truth, part, ())
    assert drawn.serials == truth.serials
    np.testing.assert_allclose(drawn.imu_home[kept], part.imu_home, atol=1e-9)


def test_the_order_of_the_estimates_modules_does_not_matter() -> None:
    truth = true_chain(load_robot("tree_y"))
    order = ("root", "right-1", "left-1", "left-2", "right-2", "left-3")
    unresolved = free(truth)
    estimated = moved(truth, unresolved, 0.5)
    one, other = (aligned_truth(truth, e, unresolved) for e in (estimated, reorder(estimated, order)))
    np.testing.assert_allclose(one.imu_home, other.imu_home, atol=1e-6)


def _values(file: Path, entity: str) -> Any:
    stored: Any = RrdReader(str(file)).stream().collect()
    table = stored.reader(index="session_time", contents=entity).to_pandas()
    (name,) = [c for c in table if c.endswith((":values", ":scalars"))]
    return np.array([np.asarray(v)[0] for v in table[name].dropna()])


def test_a_virtual_run_shows_both_robots_and_estimates_that_come_nearer(
    tmp_path: Path, quick_plan: Plan
) -> None:
    config = VirtualConfig(load_robot("thesis_350_vertical"), tmp_path / "run", seed=2, plan=quick_plan)
    result = run_virtual(config, Terminal(quiet=True))
    file = tmp_path / "run" / "session.rrd"
    entities = {chunk.entity_path for chunk in RrdReader(str(file)).stream()}
    base, tip = result.serials
    assert {f"/world/{world}/body/{base}/link" for world in ("est", "true")} <= entities
    lengths = _values(file, f"/estimates/link_length/{tip}")
    # Known from the first joint on, refined in the end, and shown until then.
    assert len(np.unique(lengths)) >= 2
    assert lengths[-1] == pytest.approx(result.links[0].link_length_mm)
    built = 1e3 * link_length_m(true_chain(as_built(config.robot, config.seed)), child=1)
    np.testing.assert_allclose(_values(file, f"/estimates/link_length/{tip}/true"), built, atol=1e-3)
