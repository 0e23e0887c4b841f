"""Merging three assemblies of the same modules identifies more parameters than any of them alone.

A small arm is identified as it is, then with its base on a wall, then with its modules in another order, each
with the link that leads to it. Another direction of gravity, or another load, excites other base parameters
of the same parts. The information that the agents gathered must equal the coordinator's.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.excitation.plan import Plan
from coordinator.merge.information_file import RunInformation, read_information
from coordinator.merge.merge_runs import merge_runs
from coordinator.recording.run_folder import INFORMATION
from sim.benchmark.case import Case, Summary, Trial, trial_seeds
from sim.benchmark.row import Row, largest
from sim.imperfections.noise_profile import DEFAULT_PROFILE
from sim.robot.robot_file import BASE, Robot, load_robot
from sim.virtual_time.run import VirtualConfig, run_virtual

ROBOT = "a2085_03"
# All joints explored at once, and the thesis' motions once: less robot time than any other way.
QUICK = Plan(
    mode="simultaneous",
    discover_s=0.3,
    link_s=0.3,
    rest_s=1.0,
    settle_s=0.3,
    travel_speed_rad_s=2.0,
    dynamic_repeats=1,
)


class Reassembly(NamedTuple):
    """The result of one trial.

    parameters: number of all parts' parameters. rank_alone: of every assembly. rank_merged: of all together.
    sigma_ratio: median, over the base parameters of single assemblies, of the merged standard deviation over
    the single one; sigma_ratios of every assembly. The same assembly three times would make 0.58.
    difference: largest relative difference between an agent's information and the coordinator's.
    inconsistency_sigma: see `merge_runs.RunShare`, of every assembly.
    """

    parameters: int
    rank_alone: tuple[int, ...]
    rank_merged: int
    sigma_ratio: float
    sigma_ratios: tuple[float, ...]
    difference: float
    inconsistency_sigma: tuple[float, ...]


def reassembly_trial(seed: int, folder: Path) -> Reassembly:
    """Identify a robot in three assemblies, in virtual time, and merge their torque information.

    Args:
        seed: of the modules, which are the same in all three, and of their noise, which is not.
        folder: for the three runs.

    Raises:
        ValueError: an agent did not answer, so that there is nothing to compare.
    """
    runs: list[RunInformation] = []
    differences: list[float] = []
    for number, (name, assembled) in enumerate(assemblies(load_robot(ROBOT)).items()):
        out = folder / name
        config = VirtualConfig(assembled, out, seed=seed, noise_seed=number, plan=QUICK)
        dynamics = run_virtual(config).dynamics
        if dynamics is None or dynamics.gathered_difference is None:
            raise ValueError(f"no agent of the assembly {name} sent its torque information")
        differences.append(dynamics.gathered_difference)
        runs.append(read_information(out / INFORMATION))
    merged = merge_runs(runs)
    return Reassembly(
        parameters=len(merged.base.columns.names),
        rank_alone=tuple(run.base.rank for run in merged.runs),
        rank_merged=merged.base.rank,
        sigma_ratio=merged.gain,
        sigma_ratios=tuple(run.gain for run in merged.runs),
        difference=max(differences),
        inconsistency_sigma=tuple(run.inconsistency_sigma for run in merged.runs),
    )


def assemblies(robot: Robot) -> dict[str, Robot]:
    """Return a chain as it is, on a wall, and with the order of its modules turned round."""
    wall = robot.base.model_copy(update={"mount": "wall", "rpy_deg": None})
    return {
        "as_built": robot,
        "on_a_wall": robot.model_copy(update={"base": wall}),
        "reordered": reordered(robot, np.arange(len(robot.modules))[::-1]),
    }


def reordered(robot: Robot, order: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> Robot:
    """Return a chain of the same modules in another order, each with the link that leads to it."""
    modules, parent = [], BASE
    for k in order:
        modules.append(robot.modules[k].model_copy(update={"parent": parent}))
        parent = robot.modules[k].serial
    return robot.model_copy(update={"modules": tuple(modules)})


AGREES_BELOW = 1e-10
_COST_S = 15.0


def reassembly_cases(trials: int, seed: int) -> list[Case]:
    """Return the one case: an arm as it is, on a wall, and with its modules in another order."""
    name = f"{ROBOT}, three assemblies"
    work = [Trial(reassembly_in_folder, (own,), _COST_S) for own in trial_seeds(seed, name, trials)]
    return [Case(name, work, _summary, DEFAULT_PROFILE, "nothing")]


def reassembly_in_folder(seed: int) -> Reassembly:
    """Run a trial in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        return reassembly_trial(seed, Path(folder))


def _summary(trials: Sequence[Reassembly]) -> Summary:
    difference = largest([t.difference for t in trials])
    lost = max((float(max(t.rank_alone) - t.rank_merged) for t in trials), default=None)
    sigma_ratio = max((t.sigma_ratio for t in trials), default=None)
    return Summary(
        [
            Row("agents' information against the coordinator's [relative]", difference, AGREES_BELOW),
            Row("rank of the best alone less that of all merged", lost, -1.0),
            Row("rank of all merged", min((float(t.rank_merged) for t in trials), default=None)),
            Row("standard deviations merged over alone, median", sigma_ratio, 1.0),
        ]
    )
