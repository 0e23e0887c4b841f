"""`x5-coordinator safety`: what a file says is shown, and is the same in the other format."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from coordinator.main import app
from module_agent.control.safety_file import read_safety
from module_agent.model.errors import EXIT_USAGE

SERIALS = ["A", "B"]
TOML = """
[default]
position_rad = [-1.5, 1.0]
velocity_rad_s = 1.2
m_stop = "hold"

[module.B]
at_limit = "motor_off"
effort_nm = [-2.0, 3.0]
"""


@pytest.fixture
def limits(tmp_path: Path) -> Path:
    file = tmp_path / "limits.toml"
    file.write_text(TOML)
    return file


def run(*words: object) -> tuple[int, str]:
    done = CliRunner(env={"COLUMNS": "160"}).invoke(app, ["safety", *map(str, words)])
    return done.exit_code, done.output


def test_the_limits_of_every_module_are_shown_in_the_units_of_people(limits: Path) -> None:
    code, text = run(limits, *SERIALS)
    assert code == 0
    for words in ("-85.94 .. 57.3", "motor_off", "-68.75 .. 68.75", "-2 .. 3", "hold"):
        assert words in text


def test_programs_read_the_limits_of_every_module_with_none_for_the_types_own(limits: Path) -> None:
    code, text = run(limits, *SERIALS, "--json", "-")
    assert code == 0
    first, second = json.loads(text)
    assert (first["serial"], second["serial"]) == ("A", "B")
    assert first["position_rad"] == [-1.5, 1.0]
    assert first["velocity_rad_s"] == [-1.2, 1.2]
    assert first["effort_nm"] == [None, None]
    assert second["effort_nm"] == [-2.0, 3.0]
    assert (second["at_limit"], second["m_stop"]) == (["motor_off", "motor_off"], "hold")


def test_limits_are_the_same_after_the_way_through_hebis_format_and_back(
    limits: Path, tmp_path: Path
) -> None:
    assert run(limits, *SERIALS, "--out", tmp_path / "limits.xml")[0] == 0
    assert run(tmp_path / "limits.xml", *SERIALS, "--out", tmp_path / "again.toml")[0] == 0
    assert read_safety(tmp_path / "again.toml", SERIALS) == read_safety(limits, SERIALS)


@pytest.mark.parametrize(
    ("changed", "out", "said"),
    [
        ("current_a = 1.0", "limits.xml", "have no current_a"),
        ("", "limits.yaml", "must end in .toml or .xml"),
        ("colour = 1", "limits.xml", "colour"),
    ],
)
def test_what_cannot_be_said_is_refused_and_nothing_is_written(
    limits: Path, tmp_path: Path, changed: str, out: str, said: str
) -> None:
    limits.write_text(f"{TOML}{changed}\n")
    done = CliRunner().invoke(app, ["safety", str(limits), *SERIALS, "--out", str(tmp_path / out)])
    assert done.exit_code == EXIT_USAGE
    assert said in done.output
    assert not (tmp_path / out).exists()
