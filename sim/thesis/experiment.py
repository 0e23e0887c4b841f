"""An experiment of the thesis: the work it takes, and its result as plain data that any page can show.

The work of an experiment is units: functions of the configuration whose results are kept as JSON. Experiments
share units. What a unit measures depends on its arguments and the code alone.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict

from coordinator.report.document import Column as DocumentColumn
from coordinator.report.document import Curve as Curve
from coordinator.report.document import Outcome, Table
from coordinator.report.document import Panel as Panel
from coordinator.report.document import Plot as Plot
from sim.robot.noise_choice import NoiseChoice


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Column(DocumentColumn):
    """A column of a report's table whose numbers are shown with one decimal unless it says otherwise."""

    form: str = ".1f"


class ExperimentResult(_Part):
    """An experiment of the thesis, and what became of it on simulated modules.

    finding: what the thesis found, in a sentence of our own. reading: which reading was taken where its text,
    captions and tables contradict each other, and other remarks. reason: of the outcome.
    """

    id: str
    title: str
    finding: str
    reading: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    plots: tuple[Plot, ...] = ()
    outcome: Outcome
    reason: str


class ThesisResults(_Part):
    """All experiments of one run of the command, and its settings."""

    schema_version: int = 1
    settings: dict[str, int | str | bool | tuple[str, ...]]
    experiments: tuple[ExperimentResult, ...]


class Check(NamedTuple):
    """A statement about the data, with its figures, and whether it holds."""

    statement: str
    holds: bool


def concluded(checks: Sequence[Check]) -> tuple[Outcome, str]:
    """Return the outcome and its reason: seen if all checks hold, not seen if none does, else in part."""
    holding = [check.statement for check in checks if check.holds]
    failing = [check.statement for check in checks if not check.holds]
    outcome: Outcome = "seen" if not failing else "seen in part" if holding else "not seen"
    parts = [f"Holds: {'; '.join(holding)}."] if holding else []
    parts += [f"Does not hold: {'; '.join(failing)}."] if failing else []
    return outcome, " ".join(parts)


class Scope(NamedTuple):
    """What all experiments of one run of the command are run with; quick ones have fewer trials."""

    seed: int
    noise: NoiseChoice
    quick: bool = False


class Unit(NamedTuple):
    """One piece of work: a function of a module, its arguments, and the type of its result.

    The type is one that pydantic writes as JSON and reads back. cost_s: processor time, roughly. shares: as
    of a `Trial`.
    """

    name: str
    work: Callable[..., Any]
    arguments: tuple[Any, ...]
    kind: Any
    cost_s: float
    shares: str = ""


class Findings(NamedTuple):
    """What follows from the results of an experiment's units."""

    checks: Sequence[Check]
    tables: tuple[Table, ...] = ()
    plots: tuple[Plot, ...] = ()
    reading: tuple[str, ...] = ()


class Experiment(NamedTuple):
    """A table or figure of the thesis that shows data.

    finding: what the thesis found. units: the work in a scope. examine: given the results of the units in
        their order, what follows; its checks decide the outcome.
    """

    id: str
    title: str
    finding: str
    units: Callable[[Scope], tuple[Unit, ...]]
    examine: Callable[[list[Any]], Findings]

    def result(self, measured: list[Any]) -> ExperimentResult:
        """Return the result from those of the units, in their order."""
        findings = self.examine(measured)
        outcome, reason = concluded(findings.checks)
        return ExperimentResult(
            id=self.id,
            title=self.title,
            finding=self.finding,
            reading=findings.reading,
            tables=findings.tables,
            plots=findings.plots,
            outcome=outcome,
            reason=reason,
        )
