"""What an attendant says: a warning of motion reaches people who asked for quiet, or for lines of JSON."""

import json
from pathlib import Path

import pytest

from coordinator.commands.views.attend import AttendScreen

MOVES = "THE ROBOT MOVES in 10 s"


@pytest.mark.parametrize(
    ("json_file", "quiet", "stream"),
    [(None, False, "out"), (None, True, "err"), (Path("-"), False, "err"), (Path("-"), True, "err")],
)
def test_a_warning_of_motion_is_said_whatever_is_quiet(
    json_file: Path | None, quiet: bool, stream: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with AttendScreen(json_file, quiet) as screen:
        screen.say("module wrist has gone", 0)
        screen.warn(MOVES, 0)
    shown = capfd.readouterr()
    people = shown.out if stream == "out" else shown.err
    assert people.count(MOVES) == 1
    assert ("wrist" in people) == (stream == "out")
    if json_file is not None:
        says = [json.loads(line)["says"] for line in shown.out.splitlines()]
        assert says == ["module wrist has gone", MOVES]
