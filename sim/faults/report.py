"""Outcomes of seeds: one for each, and the table of faults against outcomes."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple, get_args

from sim.faults.fault import KINDS, LOSES_MODULE
from sim.faults.invariants import check_folder
from sim.faults.plant_witness import PlantWitness
from sim.faults.run import run_schedule
from sim.faults.schedule import draw
from sim.robot.robot_file import Robot

Outcome = Literal["right", "named", "stopped", "violation"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)


class SeedReport(NamedTuple):
    """What became of a seed.

    outcome: the right robot with exit code 0, an error with a name, stopped with its coordinator killed, or a
    violation of an invariant. named_module: whether the error names a module that was lost, None if none was.
    """

    seed: int
    robot: str
    network: str
    faults: tuple[str, ...]
    kinds: tuple[str, ...]
    ending: str
    text: str
    outcome: Outcome
    violations: dict[str, str]
    named_module: bool | None = None


def run_seed(seed: int, robot: Robot | None = None) -> SeedReport:
    """Run the session of a seed in a temporary folder and judge it."""
    schedule, witness = draw(seed, robot), PlantWitness()
    with TemporaryDirectory(prefix="x5-faults-") as folder:
        ending = run_schedule(schedule, Path(folder) / "run", witness)
        violations = witness.violations | check_folder(Path(folder) / "run", ending)
    outcome: Outcome = "right" if ending.name == "result" else "stopped" if ending.name == "lost" else "named"
    lost = [schedule.robot.serials[f.module] for f in schedule.faults if f.kind in LOSES_MODULE]
    named = any(serial in ending.text for serial in lost) if lost and outcome == "named" else None
    return SeedReport(
        seed=seed,
        robot=f"{schedule.robot.name}, {len(schedule.robot.modules)} modules",
        network=schedule.network,
        faults=tuple(map(str, schedule.faults)),
        kinds=tuple(fault.kind for fault in schedule.faults),
        ending=ending.name,
        text=ending.text,
        outcome="violation" if violations else outcome,
        violations=violations,
        named_module=named,
    )


def by_fault(reports: Sequence[SeedReport]) -> dict[str, Counter[str]]:
    """Return how often each outcome followed on each kind of fault; a seed counts for each of its kinds."""
    counted: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    for report in reports:
        for kind in set(report.kinds):
            counted[kind][report.outcome] += 1
    return counted
