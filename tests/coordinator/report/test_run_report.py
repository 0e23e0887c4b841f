"""The report of a run has every joint with the numbers of `result.json`; an early end has what there is."""

import asyncio
import errno
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from coordinator.excitation.plan import Plan
from coordinator.identification.result import Result
from coordinator.main import app
from coordinator.recording.journal import JournalEvent, exclusion_event
from coordinator.recording.recording import JOURNAL_TOPIC, Entry
from coordinator.recording.run_folder import HELD_OUT, INFORMATION, REPORT, RESULT, SESSION
from coordinator.recording.session_file import SessionWriter, read_session
from coordinator.report.document import Document, Table, figures, tables
from coordinator.report.pages import html_page
from coordinator.report.plots import robot_plot, without_pauses
from coordinator.report.result_sections import HALF_95
from coordinator.report.run_report import MAX_BARS, gone, read_run, run_report, step_bars
from module_agent.model.chain import Chain
from module_agent.model.errors import EXIT_SUSPECT, UsageError
from sim.robot.robot_file import load_robot
from sim.virtual_time.run import QUICK_PLAN, VirtualConfig, run_virtual
from tests.random_chains import random_robot

ROBOT = "thesis_171_vertical"
# One process makes the run that all tests here read.
pytestmark = pytest.mark.xdist_group("report")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run on an arm of two modules, dynamics included."""
    out = tmp_path_factory.mktemp("report") / "run"
    plan = QUICK_PLAN.model_copy(update={"dynamics": True, "dynamic_repeats": 1})
    run_virtual(VirtualConfig(load_robot(ROBOT), out, seed=3, plan=plan, report=True))
    return out


@pytest.fixture(scope="module")
def document(folder: Path) -> Document:
    return run_report(read_run(folder))


@pytest.fixture(scope="module")
def result(folder: Path) -> Result:
    return Result.model_validate_json((folder / RESULT).read_bytes())


def column(table: Table, name: str, group: str = "") -> list[Any]:
    (k,) = [k for k, c in enumerate(table.columns) if (c.name, c.group) == (name, group)]
    return [row[k] for row in table.rows]


def test_the_run_wrote_the_report_that_its_folder_gives(folder: Path, document: Document) -> None:
    assert (folder / REPORT).read_text() == html_page(document)


def test_a_result_of_another_run_is_refused(folder: Path, result: Result, tmp_path: Path) -> None:
    (tmp_path / SESSION).symlink_to(folder / SESSION)
    text = (folder / RESULT).read_text()
    for serial in result.serials:
        text = text.replace(f'"{serial}"', f'"{serial}-B"')
    (tmp_path / RESULT).write_text(text)
    with pytest.raises(UsageError, match=r"has nothing .*-B.*: they are not of one run"):
        read_run(tmp_path)
    (tmp_path / RESULT).write_text("{")
    with pytest.raises(UsageError, match="is no result of a run: it is no JSON"):
        read_run(tmp_path)


def test_a_link_of_unknown_length_is_said_and_has_no_interval(folder: Path, result: Result) -> None:
    (link,) = result.links
    unknown = result.model_copy(update={"links": [link.model_copy(update={"link_length_sigma_mm": None})]})
    shown = run_report(read_run(folder)._replace(result=unknown))
    assert f"The length of the link {link.parent} - {link.child} is not known." in html_page(shown)
    assert "The length of the only link is known" not in html_page(shown)
    lengths = tables(shown.section("Links"))[0]
    assert (column(lengths, "length"), column(lengths, "± 95 %")) == ([None], [None])


def test_the_topology_beyond_a_joint_that_did_not_move_is_not_called_sure(
    folder: Path, result: Result
) -> None:
    base, tip = (one.model_copy(update={"joint_moved": False}) for one in result.topology)
    for topology, said in (
        ([base, result.topology[1]], f"but not what {base.serial} carries: the joint did not move"),
        ([base, tip], f"but not what {base.serial}, {tip.serial} carry: the joints did not move"),
        (result.topology, "% sure."),
    ):
        shown = result.model_copy(update={"topology": topology})
        assert said in html_page(run_report(read_run(folder)._replace(result=shown)))


def test_every_module_has_its_row_in_every_table(document: Document, result: Result) -> None:
    for title, name in (("Topology", "module"), ("Axes", "joint"), ("IMUs", "module"), ("Torques", "joint")):
        (table,) = tables(document.section(title))
        assert sorted(column(table, name)) == sorted(result.serials), title
    modules = tables(document.section("Summary"))[0]
    assert column(modules, "module") == sorted(result.serials)
    assert column(modules, "IMU") == [250.0] * len(result.serials)


def test_every_joint_has_a_plot_with_data(folder: Path, document: Document, result: Result) -> None:
    held_out = read_run(folder).held_out
    assert held_out is not None
    _, parts = without_pauses(held_out.t_s)
    plots = figures(document.section("Torques"))
    assert [one.caption.split(":")[0] for one in plots] == list(result.chain.serials)
    for one in plots:
        drawing = ElementTree.fromstring(one.svg[one.svg.index("<svg") :])
        curves = [p.get("d", "") for p in drawing.iter("{http://www.w3.org/2000/svg}path")]
        # Measured, predicted and their difference in every motion; a straight line has two points.
        assert sum(len(re.findall("[ML]", curve)) > 50 for curve in curves) == 3 * len(parts)
        heights = [float(y) for c in curves for y in re.findall(r"[ML] [-\d.]+ ([-\d.]+)", c)]
        assert np.isfinite(heights).all()


def test_links_axes_and_imus_are_those_of_the_result(document: Document, result: Result) -> None:
    lengths, poses = tables(document.section("Links"))
    assert column(lengths, "length") == [link.link_length_mm for link in result.links]
    assert column(lengths, "± 95 %") == [HALF_95 * link.link_length_sigma_mm for link in result.links]
    for row, one in zip(poses.rows, result.transforms, strict=True):
        assert list(row[2::2]) == one.values
        assert list(row[3::2]) == [None if s is None else HALF_95 * s for s in one.sigma]
    (axes,) = tables(document.section("Axes"))
    shown = np.array([row[1:4] for row in axes.rows], dtype=float)
    np.testing.assert_array_equal(shown, result.chain.axis)
    (imus,) = tables(document.section("IMUs"))
    for row, place in zip(imus.rows, result.imu_places, strict=True):
        numbers = np.array(row[1:], dtype=float)
        np.testing.assert_allclose(numbers[:6:2], np.degrees(place.turn_rad))
        np.testing.assert_allclose(numbers[6::2], 1e3 * np.array(place.displacement_m))
        sigma = np.sqrt(np.diag(place.covariance))
        np.testing.assert_allclose(numbers[7::2], HALF_95 * 1e3 * sigma[3:])
    mounted = tables(document.section("Topology"))[0]
    assert column(mounted, "mounted on") == [one.parent or "the base" for one in result.topology]


def test_torque_residuals_are_those_of_the_result_and_of_the_held_out_file(
    document: Document, result: Result
) -> None:
    dynamics = result.dynamics
    assert dynamics is not None
    assert dynamics.held_out is not None
    (table,) = tables(document.section("Torques"))
    assert column(table, "residual, rms", "fitted motions") == list(dynamics.residual_rms_nm.values())
    percent = column(table, "residual / torque", "held-out motions")
    per_joint = dynamics.held_out.relative_error_per_joint
    np.testing.assert_allclose(percent, [100.0 * per_joint[s] for s in column(table, "joint")])
    # The same from the samples that are plotted.
    levels = [np.array(column(table, f"{what}, rms", "held-out motions")) for what in ("residual", "torque")]
    np.testing.assert_allclose(100.0 * levels[0] / levels[1], percent, rtol=1e-6)


def test_what_cannot_be_known_names_every_unresolved_direction_and_every_parameter(
    document: Document, result: Result
) -> None:
    chain, inertia = tables(document.section("What cannot be known"))
    assert set(column(chain, "joint")) == {one.joint for one in result.unresolved}
    assert set(column(chain, "what would tell it")) == {one.resolved_by for one in result.unresolved}
    assert result.dynamics is not None
    named = {name for row in inertia.rows for cell in row[1:] if cell for name in str(cell).split(", ")}
    assert named == {one.parameter for one in result.dynamics.identifiability}


def test_the_page_needs_nothing_from_elsewhere(folder: Path) -> None:
    page = (folder / REPORT).read_text()
    assert "<script" not in page
    assert "@import" not in page
    targets = re.findall(r"(?:src|href)\s*=\s*[\"']([^\"']*)", page) + re.findall(r"url\(([^)]*)\)", page)
    assert targets
    assert [one for one in targets if not one.startswith("#")] == []
    # Names of XML are no references.
    assert set(re.findall(r"https?://[^\"' <]+", page)) <= {
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xlink",
    }


def test_the_command_writes_it_in_other_formats(folder: Path, document: Document, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["report", str(folder), "--out", str(tmp_path / "again.json")])
    assert done.exit_code == 0, done.output
    assert f"written to {tmp_path / 'again.json'}" in done.output
    assert Document.model_validate_json((tmp_path / "again.json").read_bytes()) == document
    before = (folder / REPORT).read_bytes()
    (folder / REPORT).unlink()
    assert CliRunner().invoke(app, ["report", str(folder)]).exit_code == 0
    assert (folder / REPORT).read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((".",), "holds no session.mcap: give the folder of a run"),
        ((".", "--out", "page.pdf"), "a report ends in .html, .md, .json"),
        ((".", "--out", "nowhere/page.html"), "there is no folder nowhere"),
    ],
)
def test_wrong_usage_of_the_command_is_answered(
    arguments: tuple[str, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["report", *arguments])
    assert done.exit_code == 2
    assert words in done.output


def test_a_result_that_cannot_be_read_is_answered_with_the_place(folder: Path, tmp_path: Path) -> None:
    (tmp_path / SESSION).write_bytes((folder / SESSION).read_bytes())
    (tmp_path / RESULT).write_text('{"schema": 2, "robot": 3}')
    done = CliRunner().invoke(app, ["report", str(tmp_path)])
    assert done.exit_code == 2
    assert "result.json is no result of a run: robot" in done.output


def test_of_a_recording_that_is_whole_nothing_is_gone(folder: Path, tmp_path: Path) -> None:
    assert gone(read_run(folder)) == []
    cut_short = cut(folder, tmp_path / "cut", lambda e: e.what == "explored", "lost")
    (cut_short / RESULT).write_bytes((folder / RESULT).read_bytes())
    (sentence,) = gone(read_run(cut_short))
    assert sentence.startswith("session.mcap is not what result.json was computed from: the recording ends")
    assert "x5-coordinator replay" in sentence
    assert "the recording ends" in html_page(run_report(read_run(cut_short)))


# --------------------------------------------------------------------------- runs that ended early


def cut(folder: Path, out: Path, last: Callable[[JournalEvent], bool], failed: str) -> Path:
    """Write a recording that fails after the first event of its journal of which `last` is true."""
    out.mkdir()
    writer = SessionWriter(out / SESSION)
    for entry in read_session(folder / SESSION):
        writer.write(entry)
        if entry.kind == "journal" and last(JournalEvent.model_validate_json(entry.payload)):
            break
    event = JournalEvent(t_ns=entry.t_ns + 1, what="failed", text=failed)
    writer.write(Entry("journal", JOURNAL_TOPIC, event.t_ns, event.encode()))
    writer.close()
    return out


def test_a_run_that_ended_early_is_reported_as_far_as_it_came(folder: Path, tmp_path: Path) -> None:
    ended = cut(folder, tmp_path / "cut", lambda e: e.what == "begin" and e.step.startswith("excite"), "lost")
    run = read_run(ended)
    document = run_report(run)
    assert "The run ended early: lost." in html_page(document)
    assert "ended before it had a result" in document.subtitle
    titles = [section.title for section in document.sections]
    assert titles == ["Summary", "Joints so far", "Findings", "Network and clocks", "Events"]
    # Nothing is claimed about what was not computed.
    assert "contradicts" not in html_page(document)
    (estimates,) = tables(document.section("Joints so far"))
    pairs = list(zip(column(estimates, "joint that moved"), column(estimates, "module"), strict=True))
    assert pairs == sorted(run.recording.estimates)
    newest = [list(run.recording.estimates[pair].values())[-1] for pair in pairs]
    distances = [e.best.distance_m * 1e3 if e.best is not None else None for e in newest]
    assert column(estimates, "distance from the axis") == distances
    bars = step_bars(run.recording.journal)
    assert [bar.failed for bar in bars] == [*[False] * (len(bars) - 1), True]
    assert column(tables(document.section("Events"))[0], "event")[-1] == "lost"


def test_a_run_without_any_joint_and_without_an_end_is_reported(folder: Path, tmp_path: Path) -> None:
    ended = cut(folder, tmp_path / "cut", lambda e: e.what == "session", "no module")
    document = run_report(read_run(ended))
    assert "No module answered" in html_page(document)
    assert "before any joint was explored" in html_page(document)


def test_a_recording_in_which_a_module_took_no_part_ends_with_code_5_and_the_report_says_why(
    folder: Path, tmp_path: Path
) -> None:
    writer = SessionWriter(tmp_path / SESSION)
    entries = list(read_session(folder / SESSION))
    silent = exclusion_event(entries[0].t_ns, "X-66666", "it did not answer", by_limits=False)
    for entry in (entries[0], Entry("journal", JOURNAL_TOPIC, silent.t_ns, silent.encode()), *entries[1:]):
        writer.write(entry)
    writer.close()
    # Of an earlier evaluation that knew inertia.
    for name in (INFORMATION, HELD_OUT):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    again = CliRunner().invoke(app, ["replay", str(tmp_path)])
    assert again.exit_code == EXIT_SUSPECT, again.output
    assert not [name for name in (INFORMATION, HELD_OUT) if (tmp_path / name).exists()]
    why = "The result is not to be believed as usual: X-66666 took no part: it did not answer."
    page = (tmp_path / REPORT).read_text()
    summary = page[: page.index("<h2>Topology")]
    assert why in summary
    # Torques of a robot that has one more module are not those of the bodies that are known.
    assert "Inertial parameters are not identified" in summary
    assert Result.model_validate_json((tmp_path / RESULT).read_bytes()).dynamics is None
    # The length of the only link has one interval.
    assert re.search(r"The length of the only link is known within ± [\d.]+ mm", summary)


def interrupted(out: Path, lines: list[str]) -> None:
    """Run a robot in virtual time that is interrupted while it moves."""

    class Screen:
        def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None: ...

        def note(self, text: str) -> None:
            lines.append(text)

    presses: list[Any] = []
    config = VirtualConfig(
        load_robot(ROBOT), out, plan=Plan(dynamics=False, discover_s=0.3, link_s=0.3), report=True
    )
    with pytest.raises(asyncio.CancelledError):
        run_virtual(
            config,
            Screen(),
            lambda robot: robot.loop.call_at(2.5, lambda: presses[0](signal.SIGINT, None)),
            presses.append,
        )


def test_an_interrupted_run_leaves_a_report(tmp_path: Path) -> None:
    lines: list[str] = []
    interrupted(tmp_path / "run", lines)
    assert "The run ended early: stopped: " in (tmp_path / "run" / REPORT).read_text()


def test_a_report_that_cannot_be_written_is_said_and_a_defect_of_it_is_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail_with(error: Exception) -> Callable[..., None]:
        def write(*_: Any) -> None:
            raise error

        return write

    lines: list[str] = []
    full = OSError(errno.ENOSPC, "No space left on device", "report.html")
    monkeypatch.setattr("coordinator.session.run.write_report", fail_with(full))
    interrupted(tmp_path / "full", lines)
    assert any("no report" in line and "No space left" in line for line in lines)
    monkeypatch.setattr("coordinator.session.run.write_report", fail_with(KeyError("a mistake")))
    with pytest.raises(KeyError, match="a mistake"):
        interrupted(tmp_path / "mistake", [])


def test_without_matplotlib_runs_and_replays_end_as_they_would_and_say_so(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coordinator.report.plots.find_spec", lambda name: None)
    lines: list[str] = []
    interrupted(tmp_path / "run", lines)
    assert any("no report: a report needs matplotlib" in line for line in lines)
    done = CliRunner().invoke(app, ["replay", str(folder / SESSION), "--out", str(tmp_path / "again")])
    assert done.exit_code == 0, done.output
    steps = [line for line in done.output.splitlines() if line.startswith("[")]
    assert [line[:5] for line in steps] == ["[1/3]", "[2/3]", "[3/3]"]
    assert "x5-self-model[report]" in done.output
    assert (tmp_path / "again" / RESULT).read_bytes() == (folder / RESULT).read_bytes()
    assert not (tmp_path / "again" / REPORT).exists()


# --------------------------------------------------------------------------- pieces


def test_many_steps_share_a_bar() -> None:
    journal = []
    for k in range(MAX_BARS + 1):
        for what, t_s in (("begin", k), ("done", k + 1)):
            journal.append(JournalEvent(t_ns=t_s * 10**9, what=what, step=f"explore/{k}"))
    (bar,) = step_bars(journal)
    assert bar == ("explore", 0.0, MAX_BARS + 1.0, False)
    assert len(step_bars(journal[:-2])) == MAX_BARS


def test_robots_of_any_shape_are_drawn_with_all_their_names() -> None:
    for joints in (1, 2, 7, 20):
        chain: Chain = random_robot(5, joints)[0]
        svg = robot_plot(chain)
        assert "nan" not in svg
        # In both views.
        for serial in chain.serials:
            assert len(re.findall(rf">{re.escape(serial)}<", svg)) == 2
