"""`x5-sim faults` says what was violated, and how to see it again."""

import json
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from module_agent.model.errors import EXIT_FINDING, EXIT_USAGE
from sim.commands import faults
from sim.faults import report
from sim.faults.plant_witness import PlantWitness
from sim.faults.report import run_seed
from sim.faults.run import Ending
from sim.faults.schedule import Schedule, draw
from sim.main import app


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the sessions here, and let those with an agent that boots be violations."""

    def run_schedule(schedule: Schedule, out: Path, witness: PlantWitness) -> Ending:
        if any(fault.kind == "agent reboot" for fault in schedule.faults):
            witness.violations["driven too late"] = "module X at 1.000 s"
        return Ending("result")

    monkeypatch.setattr(report, "run_schedule", run_schedule)
    monkeypatch.setattr(report, "check_folder", lambda out, ending: {})
    monkeypatch.setattr(
        faults, "_run", lambda trials, workers, dask: [trial.work(*trial.arguments) for trial in trials]
    )


@pytest.mark.usefixtures("in_this_process")
def test_a_violation_is_made_simpler_and_its_command_repeats_it(tmp_path: Path) -> None:
    # Seed 8: three modules, two faults, one of them an agent that boots.
    runner, document = CliRunner(), tmp_path / "faults.json"
    options = ["faults", "--seeds", "8..8", "--json", str(document)]
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
def test_seeds_without_violation_end_with_zero() -> None:
    found = CliRunner().invoke(app, ["faults", "--seeds", "7..7"])
    assert found.exit_code == 0
    assert "1 seeds, 0 with violations" in found.output


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--seeds", "9"), "expected A..B"),
        (("--seeds", "1..1", "--fault", "thunder"), "expected KIND"),
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
    assert run_seed(draw(94)) == run_seed(draw(94))
