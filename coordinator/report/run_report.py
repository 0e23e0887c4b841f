"""The report of a run, from what its folder holds: the result if it has one, and the recording.

Everything in it is what the coordinator knows. A run that ended early is reported as far as it came.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from coordinator.identification.result import DynamicsPart, Result
from coordinator.merge.run_arrays import read_held_out_arrays
from coordinator.recording.journal import JournalEvent, excluded_modules, exclusion_notes
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import HELD_OUT, REPORT, RESULT, SESSION, load_recording
from coordinator.report.document import (
    Block,
    Bullets,
    Column,
    Document,
    Figure,
    Paragraph,
    Section,
    Table,
)
from coordinator.report.pages import markdown_page, write_page
from coordinator.report.plots import (
    Bar,
    check_plots,
    delay_plot,
    robot_plot,
    time_line_plot,
)
from coordinator.report.result_sections import HALF_95, HeldOutTorques, result_sections, sure_topology
from coordinator.synchronisation.feedback_delays import FeedbackDelay, feedback_delays
from coordinator.synchronisation.round_trips import map_clocks
from module_agent.model.errors import DataError, UsageError
from module_agent.model.model_faults import first_fault

MAX_BARS = 40
_NS = 1e-9


class RunData(NamedTuple):
    """What a run left: `result` and `held_out` are None for a run that ended before them."""

    name: str
    recording: Recording
    result: Result | None = None
    held_out: HeldOutTorques | None = None


def read_run(folder: Path) -> RunData:
    """Read a run from its folder.

    Raises:
        UsageError: the folder holds no recording of a run, or a result that cannot be read or is of another.
        SessionFileError: the recording cannot be read.
    """
    session, result = folder / SESSION, folder / RESULT
    if not session.is_file():
        raise UsageError(f"{folder} holds no {SESSION}: give the folder of a run")
    try:
        read = Result.model_validate_json(result.read_bytes()) if result.is_file() else None
    except ValidationError as error:
        raise UsageError(f"{result} is no result of a run: {first_fault(error)}") from error
    recording = load_recording(session)
    if read is not None and (strangers := sorted(set(read.serials) - recording.modules.keys())):
        raise UsageError(
            f"{result} has modules of which {session} has nothing ({', '.join(strangers)}): they are not of "
            f"one run; `x5-coordinator replay {folder}` makes the result anew"
        )
    torques = read_held_out(folder / HELD_OUT) if read is not None and read.dynamics is not None else None
    return RunData(folder.resolve().name, recording, read, torques)


def write_report(folder: Path, recording: Recording, result: Result | None) -> Path:
    """Write the page of a run into its folder, which holds its held-out torques; return its path.

    Raises:
        MissingPlots: matplotlib is not installed.
        OSError: the file cannot be written.
    """
    torques = read_held_out(folder / HELD_OUT) if result is not None and result.dynamics is not None else None
    path = folder / REPORT
    write_page(path, run_report(RunData(folder.resolve().name, recording, result, torques)))
    return path


def result_markdown(result: Result) -> str:
    """Return the tables of a result as Markdown: topology, links, axes, torques and what cannot be known."""
    document = Document(
        title=f"{result.robot}, as identified", sections=tuple(result_sections(result, held_out=None))
    )
    return markdown_page(document, folder="")[0]


def read_held_out(path: Path) -> HeldOutTorques | None:
    """Read the torques of held-out motions; None if the run has none.

    Raises:
        RunArraysError: the file is not what it should be.
    """
    if not path.is_file():
        return None
    arrays = read_held_out_arrays(path)
    t_s = _NS * (arrays.session_ns - arrays.session_ns[0]).astype(float)
    return HeldOutTorques(arrays.serials, t_s, arrays.measured_nm, arrays.predicted_nm)


def run_report(run: RunData) -> Document:
    """Return the report of a run.

    Raises:
        MissingPlots: matplotlib is not installed.
    """
    check_plots()
    result, recording = run.result, run.recording
    sections = [_summary(run)]
    if result is not None:
        sections += result_sections(result, run.held_out)
    else:
        sections.append(_estimates(recording))
    sections += [_findings(run), _network(recording), _events(recording)]
    robot = next((event.robot for event in recording.journal if event.robot), run.name)
    return Document(
        title=f"{robot}: identification run {run.name}",
        subtitle=_subtitle(run),
        sections=tuple(sections),
    )


def _subtitle(run: RunData) -> str:
    modules = f"{len(run.recording.modules)} modules, {_duration_s(run.recording):.1f} s on the robot"
    if run.result is None:
        return f"{modules}; ended before it had a result"
    # Enough of the hash to tell runs apart.
    return f"{modules}; trace hash {run.result.trace_hash[:16]}"


# ---------------------------------------------------------------------- the robot


def _summary(run: RunData) -> Section:
    result = run.result
    blocks: list[Block]
    if result is None:
        failed = [event.text for event in run.recording.journal if event.what == "failed"]
        why = failed[-1] if failed else "the recording ends without a word on why"
        blocks = [Paragraph(text=f"The run ended early: {why}."), _modules(run)]
        return Section(title="Summary", blocks=tuple(blocks))
    items = [f"{sentence}." for sentence in gone(run)]
    items += [f"The result is not to be believed as usual: {why}." for why in result.suspicions]
    items.append(sure_topology(result))
    sigmas = [link.link_length_sigma_mm for link in result.links]
    spread = [HALF_95 * sigma for sigma in sigmas if sigma is not None]
    if spread:
        items.append(f"{_links_known(len(spread))} within ± {_from_to(min(spread), max(spread))} mm (95 %).")
    items += [
        f"The length of the link {link.parent} - {link.child} is not known."
        for link in result.links
        if link.link_length_sigma_mm is None
    ]
    if result.dynamics is None:
        withheld = bool(result.suspicions) and run.recording.motions("dynamic")
        items.append(
            "Inertial parameters are not identified, since torques do not tell of all bodies then."
            if withheld
            else "Inertial parameters were not asked for (--no-dynamics)."
        )
    else:
        items += _sure_inertia(result.dynamics)
    if result.unresolved:
        count = len({(one.kind, one.joint) for one in result.unresolved})
        displacements = "displacement leaves" if count == 1 else "displacements leave"
        items.append(f"{count} {displacements} every reading the same and cannot be known, see below.")
    items.append(
        f"{len(result.sensors) or 'No'} finding{'s' * (len(result.sensors) != 1)} on sensors and links."
    )
    drawing = Figure(
        caption="The identified robot at q = 0. A joint is drawn where its axis is nearest to its IMU.",
        alt=f"Two projections of {len(result.serials)} joints with their axes and links",
        svg=robot_plot(result.chain.chain()),
    )
    blocks = [Bullets(items=tuple(items)), drawing, _modules(run)]
    return Section(title="Summary", blocks=tuple(blocks))


def gone(run: RunData) -> list[str]:
    """Return what is gone of the recording since its result was computed, as sentences."""
    recording, result = run.recording, run.result
    if result is None or result.trace_hash == recording.trace_hash:
        return []
    why = "; ".join([*recording.damage, *recording.remarks])
    return [
        f"{SESSION} is not what {RESULT} was computed from{': ' if why else ''}{why}. Network, clocks and "
        "events are of what there is; `x5-coordinator replay` computes the result anew"
    ]


def _from_to(least: float, most: float) -> str:
    ends = f"{least:.2g}", f"{most:.2g}"
    return " to ".join(dict.fromkeys(ends))


def _links_known(count: int) -> str:
    return "The length of the only link is known" if count == 1 else f"The lengths of {count} links are known"


def _sure_inertia(dynamics: DynamicsPart) -> Iterator[str]:
    yield f"{dynamics.rank} combinations of {dynamics.parameters} inertial parameters are determined."
    if dynamics.held_out is not None:
        yield (
            f"Torques of held-out motions are predicted within {dynamics.held_out.in_words()}, rms; "
            f"a constant would be off by {dynamics.held_out.in_words(dynamics.held_out.mean_baseline)}."
        )


def _modules(run: RunData) -> Table:
    excluded = excluded_modules(run.recording.journal)
    rows = []
    for serial, module in sorted(run.recording.modules.items()):
        info = module.info
        rows.append(
            (
                serial,
                info.module_type if info is not None else None,
                info.firmware if info is not None else None,
                info.feedback_rate_hz if info is not None else None,
                1e9 / info.imu_period_ns if info is not None and info.imu_period_ns else None,
                f"excluded: {excluded[serial]}" if serial in excluded else "takes part",
            )
        )
    columns = (
        Column(name="module"),
        Column(name="type"),
        Column(name="firmware"),
        Column(name="feedback", unit="Hz", form=".0f"),
        Column(name="IMU", unit="Hz", form=".0f"),
        Column(name="in this run"),
    )
    return Table.of("Modules", columns, rows)


# ---------------------------------------------------------------------- findings


def _findings(run: RunData) -> Section:
    blocks: list[Block] = []
    if run.result is not None and run.result.sensors:
        columns = (
            Column(name="module"),
            Column(name="motion"),
            Column(name="measured", form=".4g"),
            Column(name="expected", form=".4g"),
            Column(name="unit"),
            Column(name="sigmas", form=".1f"),
            Column(name="finding"),
        )
        rows = [
            (one.serial, one.motion, one.measured, one.expected, one.unit, one.sigmas, one.summary)
            for one in run.result.sensors
        ]
        blocks.append(Table.of("Sensors and links that contradict the model", columns, rows))
    # The notes of a result have these, too.
    notes = exclusion_notes(run.recording.journal) if run.result is None else run.result.notes
    if notes:
        blocks.append(Bullets(items=tuple(notes)))
    if not blocks:
        none = "No sensor and no link contradicts the model; there are no notes."
        unchecked = "The run ended before sensors and links were checked against a model."
        blocks.append(Paragraph(text=unchecked if run.result is None else none))
    return Section(title="Findings", blocks=tuple(blocks))


def _estimates(recording: Recording) -> Section:
    rows = []
    for (joint, observer), estimates in sorted(recording.estimates.items()):
        newest = list(estimates.values())[-1]
        best = newest.best
        rows.append(
            (
                joint,
                observer,
                "yes" if newest.moved else "no",
                1e3 * best.distance_m if best is not None else None,
                HALF_95 * 1e3 * best.sigma_distance_m if best is not None else None,
            )
        )
    columns = (
        Column(name="joint that moved"),
        Column(name="module"),
        Column(name="moved with it"),
        Column(name="distance from the axis", unit="mm", form=".2f"),
        Column(name="± 95 %", unit="mm", form=".2f"),
    )
    if not rows:
        text = Paragraph(text="The run ended before any joint was explored.")
        return Section(title="Joints so far", blocks=(text,))
    return Section(
        title="Joints so far", blocks=(Table.of("Estimates of the modules themselves", columns, rows),)
    )


# ---------------------------------------------------------------------- network and time


def _network(recording: Recording) -> Section:
    timed = {serial: module.trips for serial, module in sorted(recording.modules.items()) if module.trips}
    if not timed:
        text = Paragraph(text="No module answered a request, so that neither delays nor clocks are known.")
        return Section(title="Network and clocks", blocks=(text,))
    trips_ms = {
        serial: 1e-6 * np.array([t.received_ns - t.sent_ns for t in trips]) for serial, trips in timed.items()
    }
    try:
        clocks = map_clocks(timed)
    except DataError:
        clocks = {}
    rows = []
    delays = {one.serial: one for one in feedback_delays(recording)}
    for serial, ms in trips_ms.items():
        delay = delays.get(serial)
        loss, clock = recording.modules[serial].loss, clocks.get(serial)
        rows.append(
            (
                serial,
                len(ms),
                float(np.median(ms)),
                float(np.percentile(ms, 95)),
                loss.received + loss.missing,
                loss.lost,
                loss.missing,
                _delay_cell(delay, delay.p50_ms) if delay is not None else None,
                _delay_cell(delay, delay.p99_ms) if delay is not None else None,
                _NS * clock.offset_ns if clock is not None else None,
                1e-6 * HALF_95 * clock.sigma_ns if clock is not None else None,
                1e6 * clock.drift if clock is not None else None,
            )
        )
    columns = (
        Column(name="module"),
        Column(name="number", form=".0f", group="round trips"),
        Column(name="median", unit="ms", form=".2f", group="round trips"),
        Column(name="95th percentile", unit="ms", form=".2f", group="round trips"),
        Column(name="published", form=".0f", group="feedback rows"),
        Column(name="lost at first", form=".0f", group="feedback rows"),
        Column(name="missing", form=".0f", group="feedback rows"),
        Column(name="median", unit="ms", form=".2f", group="feedback, sample to coordinator", right=True),
        Column(
            name="99th percentile", unit="ms", form=".2f", group="feedback, sample to coordinator", right=True
        ),
        Column(name="offset", unit="s", form=".6f", group="clock against the session"),
        Column(name="± 95 %", unit="ms", form=".3f", group="clock against the session"),
        Column(name="drift", unit="ppm", form=".1f", group="clock against the session"),
    )
    blocks: list[Block] = [
        Table.of("Delays, losses and clocks", columns, rows),
        Figure(
            caption="Round trips of requests to the modules, the module's own time included.",
            alt="Round trips of every module: shortest, median, 95th percentile and longest",
            svg=delay_plot(trips_ms),
        ),
    ]
    missing = (
        "Rows that were lost at first, or not heard, were asked for; missing are those that never came. The "
        "delay of feedback is the age of a message's newest row when it arrived."
    )
    costs = [event.cpu_us_per_message for event in recording.journal if event.cpu_us_per_message]
    cost = f" Receiving and recording a message took {costs[-1]:.0f} µs of processor time." if costs else ""
    refused = ", ".join(f"{count} {reason}" for reason, count in sorted(recording.refused.items()))
    unreadable = f" Unreadable messages: {refused}." if refused else ""
    blocks.append(Paragraph(text=missing + cost + unreadable))
    return Section(title="Network and clocks", blocks=tuple(blocks))


def _delay_cell(delay: FeedbackDelay, delay_ms: float) -> float | str:
    """Return a delay [ms] as a cell, in words where the clock does not tell it from none."""
    return delay_ms if delay_ms >= delay.clock_sigma_ms else delay.shown(delay_ms)


def _duration_s(recording: Recording) -> float:
    times = [event.t_ns for event in recording.journal]
    return _NS * (max(times) - min(times)) if times else 0.0


def _events(recording: Recording) -> Section:
    journal = recording.journal
    if not journal:
        return Section(title="Events", blocks=(Paragraph(text="The recording has no journal."),))
    start_ns = min(event.t_ns for event in journal)
    blocks: list[Block] = []
    bars = step_bars(journal)
    if bars:
        caption = "Steps of the run." + (
            " One that did not end is marked." if any(b.failed for b in bars) else ""
        )
        alt = f"{len(bars)} steps as bars over time, from {bars[0].name} to {bars[-1].name}"
        blocks.append(Figure(caption=caption, alt=alt, svg=time_line_plot(bars)))
    labels = {"session": "the session begins", "finished": "the robot is released; estimating", "settled": ""}
    rows = [
        (_NS * (event.t_ns - start_ns), event.step or None, event.text or labels.get(event.what, event.what))
        for event in journal
        if event.what in ("session", "note", "failed", "finished")
    ]
    columns = (Column(name="time", unit="s", form=".2f"), Column(name="step"), Column(name="event"))
    blocks.append(Table.of("Beginning, end, and what went otherwise than planned", columns, rows))
    return Section(title="Events", blocks=tuple(blocks))


def step_bars(journal: Sequence[JournalEvent]) -> list[Bar]:
    """Return the steps of a run in their order, in seconds since its beginning.

    Of more than `MAX_BARS` steps those whose names begin alike are one bar. A step that did not end lasts to
    the last event, and is marked.
    """
    start_ns, end_ns = (of(event.t_ns for event in journal) for of in (min, max))
    spans: list[tuple[str, int, int, bool]] = []
    open_steps: dict[str, int] = {}
    for event in journal:
        if event.what == "begin":
            open_steps[event.step] = event.t_ns
        elif event.what == "done" and event.step in open_steps:
            spans.append((event.step, open_steps.pop(event.step), event.t_ns, False))
    spans += [(step, begin_ns, end_ns, True) for step, begin_ns in open_steps.items()]
    spans.sort(key=lambda span: span[1])
    if len(spans) > MAX_BARS:
        merged: dict[str, tuple[str, int, int, bool]] = {}
        for name, first, last, failed in spans:
            head = name.split("/")[0]
            _, first_before, last_before, failed_before = merged.get(head, (head, first, last, False))
            merged[head] = (head, min(first, first_before), max(last, last_before), failed or failed_before)
        spans = list(merged.values())
    return [
        Bar(name, _NS * (first - start_ns), _NS * (last - start_ns), failed)
        for name, first, last, failed in spans
    ]
