"""The table and the JSON of `x5-sim watch`, and what it refuses."""

import json

import pytest
from rich.console import Console
from typer.testing import CliRunner

from sim.benchmark.monitored_life import Life, LifePlan, Said
from sim.benchmark.slow_change import SlowChange
from sim.commands.watch import alarm_lines, change_table, figures
from sim.main import app

QUIET = Life(LifePlan("a2085_03", 0, "x5", 0, 3600.0), None, 3600.0, 3600.0, (), 60.0)
ALARM = QUIET._replace(said=(Said(10.0, "collision", "elbow", "a blow", 0.0, True),))
CHANGED = Life(
    LifePlan("a2085_03", 0, "x5", 1, 420.0, "friction"),
    SlowChange("friction", "elbow", 50.0, (1.0, 0.0, 0.0), 60.0, 300.0),
    420.0,
    60.0,
    (Said(240.0, "friction", "elbow", "30 % more", 30.0, True),),
    10.0,
)


def test_the_table_says_when_a_change_was_named_and_how_large_it_was() -> None:
    console = Console(width=200)
    with console.capture() as capture:
        console.print(change_table([QUIET, CHANGED]))
    row = next(line for line in capture.get().splitlines() if "friction" in line)
    assert "180" in row
    assert "30 %" in row


def test_alarms_are_a_rate_with_its_interval_and_the_cost_of_it() -> None:
    (line,) = alarm_lines([QUIET, ALARM])
    # One in two hours; Garwood: 0.0253 to 5.572 for one counted.
    assert "1 false alarms in 2.00 h: 0.50 an hour, 95 % interval 0.01 to 2.79" in line
    assert "60 simulated hours a core hour" in line


def test_the_json_has_every_life() -> None:
    written = json.loads(json.dumps(figures([ALARM, CHANGED])))
    assert written["false_alarms"] == 1
    assert written["unchanged_s"] == 3660.0
    assert written["changes"]["friction"]["outcomes"]["rightly"] == 1
    assert [life["outcome"] for life in written["lives"]] == [None, "rightly"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--kind", "plai"], "did you mean"), (["--hours", "0", "--trials", "0"], "nothing to do")],
)
def test_what_cannot_be_done_is_refused_at_once(arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(app, ["watch", *arguments])
    assert result.exit_code == 2
    assert words in result.output.replace("\n", " ")
