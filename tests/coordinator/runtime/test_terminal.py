"""The progress line counts the time left down; in a pipe a step's line says it."""

import subprocess
import sys
from pathlib import Path

import pytest
from rich.progress import Progress, TextColumn

from coordinator.runtime.terminal import JsonLines, Terminal, TimeLeft
from module_agent.model.errors import FileError


def test_the_time_left_counts_down_between_steps_and_is_unknown_once_it_is_over() -> None:
    now_s = [100.0]
    column = TimeLeft(lambda: now_s[0])
    progress = Progress(TextColumn(""))
    progress.add_task("exploring", total=5, end_s=175.0)
    (task,) = progress.tasks
    shown = []
    for seconds in (0.0, 10.0, 74.0, 80.0):
        now_s[0] = 100.0 + seconds
        shown.append(column.render(task).plain)
    assert shown == ["1:15", "1:05", "0:01", "-:--"]


def test_in_a_pipe_a_step_says_the_time_left(capfd: pytest.CaptureFixture[str]) -> None:
    terminal = Terminal()
    terminal.step(2, 9, "listening at rest", 61.6)
    terminal.step(9, 9, "estimating")
    assert capfd.readouterr().err.splitlines() == ["[2/9] listening at rest (62 s left)", "[9/9] estimating"]


def test_a_full_disk_ends_lines_of_json_with_the_file_s_name() -> None:
    lines = JsonLines(Path("/dev/full"))
    with pytest.raises(FileError, match="cannot use /dev/full: No space left on device"):
        lines.write({"a": 1})


@pytest.mark.parametrize("full", [True, False])
def test_the_world_goes_on_where_nothing_can_be_said(tmp_path: Path, full: bool) -> None:
    """Standard error is a file on a full disk, or a pipe that nobody reads any more."""
    say = "from sim.commands.world import _say\nfor _ in range(3): _say('agent is slow')\nprint('goes on')"
    with Path("/dev/full").open("w") as disk:
        program = [sys.executable, "-c", say]
        process = subprocess.Popen(
            program, stdout=subprocess.PIPE, stderr=disk if full else subprocess.PIPE, text=True
        )
        if process.stderr is not None:
            process.stderr.close()
        said, _ = process.communicate(timeout=60)
    assert said == "goes on\n"
