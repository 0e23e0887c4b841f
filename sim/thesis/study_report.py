"""Results of the thesis' experiments as files: `report.html`, `report.md` with figures, `thesis.json`."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from coordinator.report.document import (
    Block,
    Bullets,
    Column,
    Conclusion,
    Document,
    Outcome,
    Paragraph,
    Section,
    Table,
)
from coordinator.report.pages import write_page
from coordinator.report.plots import panel_figure
from module_agent.model.files import write_json
from sim.thesis.experiment import ExperimentResult, ThesisResults

HTML, MARKDOWN, DATA = "report.html", "report.md", "thesis.json"
_OUTCOMES: tuple[Outcome, ...] = ("seen", "seen in part", "not seen")


def write_results(folder: Path, results: ThesisResults) -> None:
    """Write `report.html`, `report.md` with a folder of figures, and `thesis.json` into a folder.

    Raises:
        MissingPlots: matplotlib is not installed.
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    document = study_document(results)
    for name in (HTML, MARKDOWN):
        write_page(folder / name, document)
    write_json(folder / DATA, results)


def study_document(results: ThesisResults) -> Document:
    """Return the report: a summary that leads to a section for each experiment.

    Raises:
        MissingPlots: matplotlib is not installed.
        ValueError: a plot without data.
    """
    settings = ", ".join(f"{name} {_setting(value)}" for name, value in results.settings.items())
    return Document(
        title="The thesis' experiments on simulated modules",
        subtitle=settings,
        sections=(_summary(results), *map(_section, results.experiments)),
    )


def _setting(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return " ".join(value) or "none" if isinstance(value, tuple) else str(value)


def counted(results: ThesisResults) -> str:
    """Return how many experiments have which outcome, as a sentence."""
    counts = Counter(one.outcome for one in results.experiments)
    total = len(results.experiments)
    parts = ", ".join(f"{counts[outcome]} {outcome}" for outcome in _OUTCOMES)
    return f"{total} experiment{'s' * (total != 1)}: {parts}."


def _summary(results: ThesisResults) -> Section:
    columns = (Column(name="experiment", link=True), Column(name="outcome"))
    rows = [(one.title, one.outcome) for one in results.experiments]
    blocks = (
        Paragraph(
            text="Tables and figures of the thesis that show data, repeated on simulated modules: what was "
            "printed, what the thesis' method gives here, and what ours gives on the same recordings. The "
            "outcome of an experiment is whether what the thesis describes is seen here too."
        ),
        Paragraph(text=counted(results)),
        Table.of("Experiments and their outcomes", columns, rows),
    )
    return Section(title="Summary", blocks=blocks)


def _section(one: ExperimentResult) -> Section:
    return Section(title=one.title, blocks=tuple(_blocks(one)))


def _blocks(one: ExperimentResult) -> Iterator[Block]:
    yield Paragraph(text=one.finding)
    yield from one.tables
    yield from map(panel_figure, one.plots)
    if one.reading:
        yield Bullets(items=one.reading)
    yield Conclusion(outcome=one.outcome, reason=one.reason)
