"""The progress line counts the time left down; in a pipe a step's line says it."""

import pytest
from rich.progress import Progress, TextColumn

from coordinator.runtime.terminal import Terminal, TimeLeft


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
