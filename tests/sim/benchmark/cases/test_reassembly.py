"""Three assemblies of the same modules tell more together than any of them tells by itself."""

from pathlib import Path

import numpy as np
import pytest

from coordinator.identification.inertia.agent_information import AGREES_BELOW
from sim.benchmark.cases.reassembly import ROBOT, assemblies, reassembly_trial, reordered
from sim.robot.robot_file import load_robot


def test_merging_three_assemblies_raises_the_rank_and_cuts_the_deviations(tmp_path: Path) -> None:
    arm = load_robot(ROBOT)
    found = reassembly_trial(1, tmp_path)
    assert found.parameters == 60
    assert found.difference <= AGREES_BELOW
    # With the modules in another order hardly a sum of three joints is what it was.
    assert found.rank_merged > max(found.rank_alone) + 8
    # What two assemblies show alike is known better: at least by the root of two, if it is most of it.
    assert min(found.sigma_ratios) < 0.75
    assert found.sigma_ratio < 0.9
    # Noise makes 1 at most, and what is claimed of the chains and the torque sensors is a guess to a half.
    assert max(found.inconsistency_sigma) < 3.0
    assert {run.name for run in tmp_path.iterdir()} == set(assemblies(arm))
    assert all((run / "information.npz").exists() for run in tmp_path.iterdir())


def test_modules_change_their_order_and_keep_their_links() -> None:
    robot = load_robot("a2085_03")
    turned = assemblies(robot)["reordered"]
    assert turned.serials == robot.serials[::-1]
    assert turned.parents == (-1, 0, 1)
    assert {m.serial: m.link for m in turned.modules} == {m.serial: m.link for m in robot.modules}
    with pytest.raises(IndexError):
        reordered(robot, np.array([0, 3]))
