"""Outcomes of seeds: one for each, and the table of faults against outcomes."""

import logging
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple, get_args

from module_agent.model.errors import RobotError
from sim.faults.fault import KINDS, Fault
from sim.faults.invariants import Claim, FolderCheck, check_folder, is_misnamed
from sim.faults.run import Ending, run_schedule, witness_of
from sim.faults.schedule import PlanName, Schedule, simpler
from sim.physics.engine import Physics
from sim.virtual_time.loop import NS_PER_S

Outcome = Literal[
    "right",
    "vague",
    "suspect, right",
    "suspect, wrong",
    "wrong though suspected",
    "named",
    "misnamed",
    "stopped",
    "violation",
    "hung",
    "died",
    "raised",
]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
# Those that say that something is wrong.
_ACCUSING = ("suspect, right", "suspect, wrong", "wrong though suspected", "named", "misnamed")
NO_FAULT = "no fault"
# Sessions that a violation is made simpler in, at the most.
MAX_SHRINKING = 20


class SeedReport(NamedTuple):
    """What became of a seed.

    modules, network, faults, physics, expects, planned: the session, so that it can be run again.
    kinds: of the faults that had begun by its end.
    outcome: the right robot with exit code 0, or one whose claims are so wide that it says little; a result
    called suspect that is right within its claims, that is wrong, or that is wrong where none of its
    suspicions is; an error that names what may have happened, or accuses a healthy module; stopped with its
    coordinator killed; or a violation of an invariant. A seed hung, its process died, or the judge raised.
    named_rightly: whether an error or a suspicion names a fault that had begun, None without either.
    simplest: the simplest session found that violates the same invariant, None if none was looked for.
    claim: the widest of the right robot; None without one. wrong: what is wrong with a suspect one.
    """

    seed: int
    robot: str
    modules: int
    network: str
    faults: tuple[str, ...]
    kinds: tuple[str, ...]
    ending: str
    text: str
    outcome: Outcome
    violations: dict[str, str]
    named_rightly: bool | None = None
    simplest: "SeedReport | None" = None
    physics: Physics = "compiled"
    expects: bool = True
    planned: PlanName = "short"
    claim: Claim | None = None
    wrong: str = ""

    def options(self, robot: str | None = None) -> str:
        """Return the options of `x5-sim faults` that repeat it; `robot` is the robot as the user gave it."""
        faults = "".join(f' --fault "{fault}"' for fault in self.faults)
        engine = "" if self.physics == "compiled" else f" --physics {self.physics}"
        expect = "--expect" if self.expects else "--no-expect"
        return (
            f"--seeds {self.seed}..{self.seed} --robot {robot or self.robot} --modules {self.modules} "
            f"--network {self.network}{engine} {expect} --plan {self.planned}{faults}"
        )


def lost_seed(schedule: Schedule, how: Literal["hung", "died", "raised"], text: str) -> SeedReport:
    """Return the report of a session of which nothing came back: all of its faults count as begun."""
    return _report(schedule, schedule.faults, Ending(how, text), how, {how: text})


def run_seed(schedule: Schedule, shrinks: bool = True) -> SeedReport:
    """Run a session in a temporary folder and judge it; one that violates an invariant is made simpler."""
    report = _judged(schedule)
    if not (report.violations and shrinks):
        return report
    return report._replace(simplest=_simplest(schedule, report))


class _LoggedExceptions(logging.Handler):
    """Collects the exceptions that a program logs with a traceback instead of ending with them."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.errors: list[BaseException] = []

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        if error is not None:
            self.errors.append(error)


@contextmanager
def _logged_exceptions() -> Iterator[list[BaseException]]:
    """Give the list of exceptions that are logged within a block."""
    handler = _LoggedExceptions()
    logging.getLogger().addHandler(handler)
    try:
        yield handler.errors
    finally:
        logging.getLogger().removeHandler(handler)


def _described(error: BaseException) -> str:
    """Return an exception with the line of ours that it comes from."""
    last = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in last if "site-packages" not in frame.filename] or last
    at = f" at {Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else ""
    return f"{type(error).__name__}{at}: {error}"


def _judged(schedule: Schedule) -> SeedReport:
    witness = witness_of(schedule)
    violations: dict[str, str] = {}
    with TemporaryDirectory(prefix="x5-faults-") as folder, _logged_exceptions() as logged:
        try:
            ending = run_schedule(schedule, Path(folder) / "run", witness)
        except RobotError as error:
            # Not of the coordinator, whose errors are endings.
            ending = Ending(type(error).__name__, str(error), witness.seen_until_ns / NS_PER_S)
            violations["agent died"] = str(error)
        except Exception as error:
            ending = Ending(type(error).__name__, str(error), witness.seen_until_ns / NS_PER_S)
            violations["traceback"] = _described(error)
        if logged:
            violations.setdefault("traceback", f"logged: {_described(logged[0])}")
        checked = check_folder(Path(folder) / "run", ending, schedule.clock_sick)
        violations |= witness.violations | checked.violations
    begun = tuple(fault for fault in schedule.faults if fault.begins_s <= ending.at_s)
    # What was still to come has done nothing.
    outcome = "violation" if violations else _outcome(schedule._replace(faults=begun), ending, checked)
    named = any(fault.is_named(ending.text, schedule.robot.serials) for fault in begun)
    return _report(schedule, begun, ending, outcome, violations)._replace(
        claim=checked.claim if outcome in ("right", "vague") else None,
        wrong=checked.wrong,
        named_rightly=named if outcome in _ACCUSING else None,
    )


def _report(
    schedule: Schedule, begun: Sequence[Fault], ending: Ending, outcome: Outcome, violations: dict[str, str]
) -> SeedReport:
    return SeedReport(
        seed=schedule.seed,
        robot=schedule.robot.name,
        modules=len(schedule.robot.modules),
        network=schedule.network,
        faults=tuple(map(str, schedule.faults)),
        kinds=tuple(fault.kind for fault in begun),
        ending=ending.name,
        text=ending.text,
        outcome=outcome,
        violations=violations,
        physics=schedule.physics,
        expects=schedule.expects,
        planned=schedule.planned,
    )


def _outcome(schedule: Schedule, ending: Ending, checked: FolderCheck) -> Outcome:
    """Return the outcome of a session that violates nothing."""
    if ending.name == "result":
        return "vague" if checked.claim is not None and checked.claim.is_vague else "right"
    if ending.name == "suspect":
        if not checked.wrong:
            return "suspect, right"
        return "suspect, wrong" if checked.is_explained else "wrong though suspected"
    if ending.name == "lost":
        return "stopped"
    return "misnamed" if is_misnamed(schedule, ending) else "named"


def _simplest(schedule: Schedule, report: SeedReport) -> SeedReport:
    """Return the simplest session found that violates one of the same invariants."""
    left = MAX_SHRINKING
    found = True
    while found and left:
        found = False
        for candidate in simpler(schedule):
            tried = _judged(candidate)
            left -= 1
            if tried.violations.keys() & report.violations.keys():
                schedule, report, found = candidate, tried, True
                break
            if not left:
                break
    return report


def by_fault(reports: Sequence[SeedReport]) -> dict[str, Counter[str]]:
    """Return how often each outcome followed on each kind of fault; a seed counts for each of its kinds.

    A fault that had not begun counts for none of them, and a seed without any as one without faults.
    """
    counted: dict[str, Counter[str]] = {kind: Counter() for kind in (*KINDS, NO_FAULT)}
    for report in reports:
        for kind in set(report.kinds) or (NO_FAULT,):
            counted[kind][report.outcome] += 1
    return counted
