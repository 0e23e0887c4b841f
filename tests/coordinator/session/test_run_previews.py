"""Looks at a robot being explored are worked out beside the run, one at a time, and never end it."""

import asyncio
import logging
import threading
from collections.abc import Collection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.identification.preview import Previewer
from coordinator.session.run import Run, RunConfig
from module_agent.transport.transport import Transport


class Slow:
    """Looks that take until they are let go; keeps what they were asked for."""

    def __init__(self) -> None:
        self.asked: list[list[str]] = []
        self.begun = threading.Event()
        self.release = threading.Event()

    def look(self, explored: Collection[str]) -> Any:
        self.asked.append(list(explored))
        self.begun.set()
        assert self.release.wait(10.0)
        return SimpleNamespace(explored=tuple(explored))


def run_of(tmp_path: Path, looks: Any, shown: list[Any], inline: bool = False) -> Run:
    transport: Transport = SimpleNamespace()  # type: ignore[assignment]
    screen = SimpleNamespace(step=lambda *_: None, note=lambda *_: None)
    config = RunConfig(robot="arm", out=tmp_path / "run", sender="me", inline=inline)
    run = Run(config, transport, lambda: 0, lambda work: None, screen)  # type: ignore[arg-type]
    run._looks = looks
    run._feed = SimpleNamespace(  # type: ignore[assignment]
        estimates=lambda *_: None, preview=lambda t_ns, found: shown.append(found.explored)
    )
    return run


def seen(run: Run, *joints: str) -> None:
    run.recording.estimates = {(joint, "B"): {} for joint in joints}
    run.estimates(joints[-1])


async def begun(slow: Slow) -> None:
    assert await asyncio.to_thread(slow.begun.wait, 10.0)


def test_while_one_look_is_worked_out_no_other_begins_and_the_run_goes_on(tmp_path: Path) -> None:
    slow, shown = Slow(), []

    async def explore() -> None:
        run = run_of(tmp_path, slow, shown)
        seen(run, "A")
        await begun(slow)
        # The call for the next joint returns at once, though the first look is not done.
        seen(run, "A", "B")
        assert shown == []
        slow.release.set()
        await run._looked()
        assert shown == [("A",)]
        seen(run, "A", "B", "C")
        await run._looked()

    asyncio.run(explore())
    assert slow.asked == [["A"], ["A", "B", "C"]]
    assert shown == [("A",), ("A", "B", "C")]


def test_in_virtual_time_a_look_is_done_before_the_call_returns(tmp_path: Path) -> None:
    slow, shown = Slow(), []
    slow.release.set()
    seen(run_of(tmp_path, slow, shown, inline=True), "A")
    assert shown == [("A",)]


@pytest.mark.parametrize("error", [ValueError("contradiction"), RuntimeError("a mistake of ours")])
def test_a_look_that_fails_is_logged_and_nothing_is_shown(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, error: Exception
) -> None:
    def fail(explored: Collection[str]) -> None:
        raise error

    shown: list[Any] = []
    with caplog.at_level(logging.INFO, "coordinator.session.run"):
        seen(run_of(tmp_path, SimpleNamespace(look=fail), shown, inline=True), "A")
    assert shown == []
    assert str(error) in caplog.text


def test_without_any_estimate_a_look_shows_nothing(tmp_path: Path) -> None:
    shown: list[Any] = []
    run = run_of(tmp_path, None, shown, inline=True)
    run._looks = Previewer(run.recording)
    run.estimates("A")
    assert shown == []
