"""`x5-sim benchmark kinematics`: what it writes, how it ends, and what it says when it cannot work."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from module_agent.model.errors import EXIT_FINDING
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row
from sim.commands import benchmark
from sim.main import app

KINEMATICS = ("benchmark", "kinematics")


def cases(limit: float | None, *trials: Trial) -> list[Case]:
    def summarise(results: Sequence[Any]) -> Summary:
        return Summary([Row("sum", float(sum(results)), limit, 9.0)])

    return [Case("powers", trials, summarise)]


def run(monkeypatch: pytest.MonkeyPatch, found: list[Case], *arguments: str) -> Any:
    monkeypatch.setattr(benchmark, "kinematic_cases", lambda effort, seed, motions: found)
    return CliRunner().invoke(app, [*KINEMATICS, *arguments])


@pytest.mark.parametrize(("limit", "code"), [(8.0, 0), (7.0, EXIT_FINDING), (None, 0)])
def test_the_exit_code_says_whether_all_bars_are_met(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, limit: float | None, code: int
) -> None:
    path = tmp_path / "found.json"
    done = run(monkeypatch, cases(limit, Trial(pow, (2, 3))), "--json", str(path), "--seed", "5")
    assert done.exit_code == code, done.output
    document = json.loads(path.read_text())
    assert document["rows"] == [
        {
            "case": "powers",
            "profile": "",
            "known": "",
            "figure": "sum",
            "thesis": 9.0,
            "ours": 8.0,
            "bound": None,
            "limit": limit,
            "holds": None if limit is None else limit >= 8.0,
        }
    ]
    assert document["settings"]["seed"] == 5
    assert "sum" in done.stdout


def test_a_trial_that_fails_is_named_and_misses_a_bar(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "found.json"
    found = cases(8.0, Trial(pow, (2, 3)), Trial(pow, (0, -1)))
    done = run(monkeypatch, found, "--json", str(path))
    assert done.exit_code == EXIT_FINDING
    assert "failed: powers: pow(0, -1): ZeroDivisionError" in done.stderr
    document = json.loads(path.read_text())
    assert [row["holds"] for row in document["rows"]] == [False, True]
    assert document["failures"][0].startswith("powers: pow(0, -1)")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--only", "moon"), "--only moon: no such case; they are\n  484 mm horizontal, x5 on a solid base"),
        (("--quick", "--trials", "3"), "--quick has its own number of trials: leave out --trials"),
        (("--trials", "0"), "greater than or equal to 1"),
        (("--json", "nowhere/found.json"), "nowhere/found.json: there is no folder nowhere"),
    ],
)
def test_wrong_usage_is_answered_with_what_is_right(arguments: tuple[str, ...], words: str) -> None:
    done = CliRunner().invoke(app, [*KINEMATICS, *arguments])
    assert done.exit_code == 2, done.output
    assert words in done.output


def test_one_arm_is_measured_from_end_to_end(tmp_path: Path) -> None:
    table, picture = tmp_path / "found.json", tmp_path / "found.png"
    done = CliRunner().invoke(
        app,
        [
            *(*KINEMATICS, "--only", "171 mm horizontal, x5 on a solid", "--trials", "1"),
            *("--json", str(table), "--plot", str(picture)),
        ],
    )
    assert done.exit_code in (0, EXIT_FINDING), done.output
    document = json.loads(table.read_text())
    assert document["failures"] == []
    assert document["settings"]["joints"] == 1
    length = document["rows"][0]
    assert length["figure"] == "length, mean |error| [mm]"
    # The thesis' way is off by millimetres, ours by less than one, and neither beats the bound by ten.
    assert length["thesis"] > length["ours"]
    assert length["ours"] < 1.0
    assert 0.0 < length["bound"] < 1.0
    assert picture.stat().st_size > 5000


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_command_and_its_processes_and_writes_nothing(
    tmp_path: Path, number: signal.Signals
) -> None:
    path = tmp_path / "found.json"
    command = [sys.executable, "-m", "sim.main", *KINEMATICS, "--json", str(path), "--processes", "1"]
    options = ["--only", "171 mm horizontal", "--trials", "1"]
    # Its temporary folders go to one of their own, so that what is left behind is seen.
    folder = tmp_path / "tmp"
    folder.mkdir()
    with subprocess.Popen(
        [*command, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "TMPDIR": str(folder)},
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("[1/3] 171 mm horizontal")
        os.killpg(process.pid, number) if number is signal.SIGINT else process.send_signal(number)
        # To the end of what holds the pipe, and that are the processes that share the work as well.
        said = process.stdout.read()
        assert process.wait(timeout=30) == 130
    assert "interrupted; nothing is written" in said
    assert "Traceback" not in said
    assert not path.exists()
    assert list(folder.glob("x5-benchmark-*")) == []
