"""`x5-sim faults` says what was violated, and how to see it again."""

import json
import math
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest
from typer.testing import CliRunner

from module_agent.model.errors import EXIT_FINDING, EXIT_INTERRUPTED, EXIT_USAGE
from sim.benchmark.case import Failed, Trial
from sim.benchmark.workers import run_trial
from sim.commands import faults
from sim.faults import report
from sim.faults.fault import Fault
from sim.faults.invariants import Claim, FolderCheck
from sim.faults.plant_witness import PlantWitness
from sim.faults.report import run_seed
from sim.faults.run import Ending
from sim.faults.schedule import PLANS, Schedule, draw
from sim.main import app


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the sessions here, and let those with an agent that boots be violations."""

    def run_schedule(schedule: Schedule, out: Path, witness: PlantWitness) -> Ending:
        if any(fault.kind == "agent reboot" for fault in schedule.faults):
            witness.violations["driven too late"] = "module X at 1.000 s"
        return Ending("result")

    monkeypatch.setattr(report, "run_schedule", run_schedule)
    monkeypatch.setattr(
        report, "check_folder", lambda out, ending, clock_sick: FolderCheck({}, Claim("A - B", 1.5, 0.3))
    )
    monkeypatch.setattr(faults, "run_trials", one_after_another)


def one_after_another(trials: list[Trial], workers: int, on_done: Callable[[int, Any], None]) -> None:
    for index, trial in enumerate(trials):
        on_done(index, run_trial(trial))


@pytest.mark.usefixtures("in_this_process")
def test_a_violation_is_made_simpler_and_its_command_repeats_it(tmp_path: Path) -> None:
    # Seed 15: four modules, two faults, one of them an agent that boots.
    runner, document = CliRunner(), tmp_path / "faults.json"
    options = ["faults", "--seeds", "15..15", "--json", str(document)]
    found = runner.invoke(app, options)
    assert found.exit_code == EXIT_FINDING
    assert "driven too late: module X at 1.000 s" in found.output
    (line,) = (line for line in found.output.splitlines() if "or simpler:" in line)
    command = shlex.split(line.partition("x5-sim ")[2])
    assert command.count("--fault") == 1
    assert command[command.index("--modules") + 1] == "2"
    assert command[command.index("--network") + 1] == "none"
    again = runner.invoke(app, command)
    assert again.exit_code == EXIT_FINDING
    assert "driven too late" in again.output
    written = json.loads(document.read_text())
    assert written["by_fault"]["agent reboot"] == {"violation": 1}
    assert written["reports"][0]["simplest"]["violations"] == {"driven too late": "module X at 1.000 s"}
    whole = next(one for one in found.output.splitlines() if "repeat it with:" in one)
    repeated = runner.invoke(app, shlex.split(whole.partition("x5-sim ")[2]))
    assert whole in repeated.output


@pytest.mark.usefixtures("in_this_process")
def test_a_fault_that_had_not_begun_as_its_session_ended_counts_for_none_of_its_kind(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    document = tmp_path / "faults.json"
    serial = draw(7).robot.serials[1]
    monkeypatch.setattr(report, "run_schedule", lambda *of: Ending("ModuleLost", f"module {serial}", 5.0))
    early, late = (
        "agent crash of module {} from {}.000 s on, size 0.500".format(*of) for of in ((0, 4), (1, 6))
    )
    options = ["faults", "--seeds", "7..7", "--fault", late, "--json", str(document)]
    # Accused is a module to which nothing had happened yet, and then one to which it had.
    for given, counted, words in (
        ([], {"no fault": {"misnamed": 1}}, "1 of 1 faults had not begun"),
        (["--fault", early], {"agent crash": {"misnamed": 1}}, "1 of 2 faults had not begun"),
        (["--fault", late.replace("6.", "3.")], {"agent crash": {"named": 1}}, "1 of 2 faults had not begun"),
    ):
        found = CliRunner().invoke(app, [*options, *given])
        assert words in found.output
        by_fault = json.loads(document.read_text())["by_fault"]
        assert {kind: counts for kind, counts in by_fault.items() if counts} == counted


def test_of_a_session_that_ends_with_a_traceback_the_time_is_what_the_plant_has_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def run_schedule(schedule: Schedule, out: Path, witness: PlantWitness) -> Ending:
        witness.seen_until_ns = 5_000_000_000
        raise KeyError("X")

    monkeypatch.setattr(report, "run_schedule", run_schedule)
    schedule = draw(7)._replace(
        faults=(Fault("agent crash", 4.0, math.inf, 0), Fault("agent freeze", 6.0, math.inf, 0))
    )
    assert run_seed(schedule, shrinks=False).kinds == ("agent crash",)


@pytest.mark.usefixtures("in_this_process")
def test_seeds_without_violation_end_with_zero() -> None:
    found = CliRunner().invoke(app, ["faults", "--seeds", "7..7"])
    assert found.exit_code == 0
    assert "1 seeds, 0 with violations" in found.output
    assert "0 of 1 right robots are vague" in found.output
    assert "the widest: seed 7, A - B, 1.5 mm, 0.30 degrees" in found.output


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(
    ("name", "checked", "outcome"),
    [
        ("result", FolderCheck({}, Claim("A - B", 6.0, 0.3)), "vague"),
        ("suspect", FolderCheck({}), "suspect, right"),
        ("suspect", FolderCheck({}, wrong="link A - B", is_explained=True), "suspect, wrong"),
        ("suspect", FolderCheck({}, wrong="link A - B"), "wrong though suspected"),
        ("suspect", FolderCheck({"unreadable result": "no"}, wrong="link A - B"), "violation"),
    ],
)
def test_results_that_are_not_plainly_right_have_columns_of_their_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, checked: FolderCheck, outcome: str
) -> None:
    document = tmp_path / "faults.json"
    monkeypatch.setattr(report, "run_schedule", lambda *of: Ending(name, "C: its gyro", 60.0))
    monkeypatch.setattr(report, "check_folder", lambda out, ending, clock_sick: checked)
    options = ["faults", "--seeds", "7..7", "--no-shrink"]
    found = CliRunner().invoke(app, options)
    assert found.exit_code == (EXIT_FINDING if outcome == "violation" else 0)
    assert outcome.split()[-1] in found.output
    assert ("seed 7: wrong though suspected: link A - B; suspected is C: its gyro" in found.output) is (
        outcome == "wrong though suspected"
    )
    CliRunner().invoke(app, [*options, "--json", str(document)])
    assert json.loads(document.read_text())["reports"][0]["outcome"] == outcome


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("how", ["hung", "died", "raised"])
def test_a_seed_of_which_nothing_came_back_is_in_the_table_with_the_command_that_repeats_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, how: Literal["hung", "died", "raised"]
) -> None:
    def lose_the_first(trials: list[Trial], workers: int, on_done: Callable[[int, Any], None]) -> None:
        on_done(0, Failed("no word of it", how))
        on_done(1, run_trial(trials[1]))

    monkeypatch.setattr(faults, "run_trials", lose_the_first)
    document = tmp_path / "faults.json"
    found = CliRunner().invoke(app, ["faults", "--seeds", "7..8", "--out", str(tmp_path / "kept")])
    assert found.exit_code == EXIT_FINDING
    assert f"seed 7: {how}: no word of it" in found.output
    (line,) = (line for line in found.output.splitlines() if "repeat it with:" in line)
    assert "--seeds 7..7" in line
    assert f"2 seeds, 0 with violations, 1 {how}; " in found.output
    assert any("all seeds" in line and line.count("1") == 2 for line in found.output.splitlines())
    # It is not kept: the same command runs it again.
    monkeypatch.setattr(faults, "run_trials", one_after_another)
    again = ["faults", "--seeds", "7..8", "--out", str(tmp_path / "kept"), "--json", str(document)]
    assert CliRunner().invoke(app, again).exit_code == 0
    assert [one["outcome"] for one in json.loads(document.read_text())["reports"]] == ["right", "right"]


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(
    ("options", "expects"), [(["--expect"], {True}), (["--no-expect"], {False}), ([], {True, False})]
)
def test_whether_modules_are_counted_is_drawn_or_chosen(
    tmp_path: Path, options: list[str], expects: set[bool]
) -> None:
    document = tmp_path / "faults.json"
    CliRunner().invoke(app, ["faults", "--seeds", "0..19", "--no-shrink", "--json", str(document), *options])
    assert {one["expects"] for one in json.loads(document.read_text())["reports"]} == expects


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(("options", "planned"), [(["--plan", "d-optimal"], {"d-optimal"}), ([], set(PLANS))])
def test_what_is_planned_is_drawn_or_chosen(tmp_path: Path, options: list[str], planned: set[str]) -> None:
    document = tmp_path / "faults.json"
    CliRunner().invoke(app, ["faults", "--seeds", "0..49", "--no-shrink", "--json", str(document), *options])
    assert {one["planned"] for one in json.loads(document.read_text())["reports"]} == planned


def test_a_dask_cluster_finds_what_this_process_finds(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    document = tmp_path / "faults.json"
    with distributed.LocalCluster(host="127.0.0.1", protocol="tcp", **options) as cluster:
        found = CliRunner().invoke(
            app,
            [
                "faults",
                "--seeds",
                "94..95",
                "--no-shrink",
                "--dask",
                cluster.scheduler_address,
                "--json",
                str(document),
            ],
        )
    assert found.exit_code == 0, found.output
    reports = json.loads(document.read_text())["reports"]
    assert [one["seed"] for one in reports] == [94, 95]
    here = [run_seed(draw(seed), shrinks=False) for seed in (94, 95)]
    assert [(one["outcome"], one["text"]) for one in reports] == [(one.outcome, one.text) for one in here]


@pytest.mark.usefixtures("in_this_process")
def test_seeds_that_are_over_are_kept_and_not_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[int] = []

    def interrupted(trials: list[Trial], workers: int, on_done: Callable[[int, Any], None]) -> None:
        for index, trial in enumerate(trials):
            begun.append(trial.arguments[0].seed)
            if begun == [1, 2, 3]:
                raise KeyboardInterrupt
            on_done(index, run_trial(trial))

    monkeypatch.setattr(faults, "run_trials", interrupted)
    command = ["faults", "--seeds", "1..4", "--out", str(tmp_path), "--json", str(tmp_path / "faults.json")]
    first = CliRunner().invoke(app, command)
    assert first.exit_code == EXIT_INTERRUPTED
    assert "the same command continues" in first.output
    second = CliRunner().invoke(app, command)
    assert begun == [1, 2, 3, 3, 4]
    assert second.exit_code == EXIT_FINDING
    assert "4 seeds, 2 with violations" in second.output
    # What was kept is what one run of all of them gives, simpler sessions included.
    kept = json.loads((tmp_path / "faults.json").read_text())
    monkeypatch.setattr(faults, "run_trials", one_after_another)
    assert CliRunner().invoke(app, [*command[:3], *command[5:]]).exit_code == EXIT_FINDING
    assert kept == json.loads((tmp_path / "faults.json").read_text())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--seeds", "9"), "expected A..B"),
        (("--seeds", "1..1", "--fault", "thunder"), "expected KIND"),
        (("--seeds", "1..1", "--fault", "partition from 1.000 s on, size 0.500"), "ends: at S s for S s"),
        (
            ("--seeds", "3..3", "--fault", "agent crash of module 5 from 1.000 s on, size 0.500"),
            "has modules 0 to 1",
        ),
        (("--seeds", "1..1", "--robot", "a2085_03", "--modules", "7"), "it has 3"),
        (("--seeds", "1..1", "--network", "string"), "string"),
    ],
)
def test_wrong_usage_is_answered_with_what_is_right(options: tuple[str, ...], words: str) -> None:
    found = CliRunner().invoke(app, ["faults", *options])
    text = str(found.exception) + found.output
    assert words in text
    assert found.exit_code == EXIT_USAGE or getattr(found.exception, "exit_code", None) == EXIT_USAGE


def test_a_seed_gives_the_same_report_twice() -> None:
    # An agent freezes early: the session is short.
    assert run_seed(draw(289)) == run_seed(draw(289))
