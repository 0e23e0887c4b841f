"""Previews of a robot being explored are computed in a thread, one at a time; data without one end no run."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coordinator.identification.preview import Previewer
from coordinator.live_robot.messenger import Sender
from coordinator.recording.journal import JournalEvent
from coordinator.session.run import PREVIEW_EVERY_S, PREVIEW_SHARE, Run, RunConfig
from module_agent.model.errors import DataError
from module_agent.transport.transport import Transport
from module_agent.wire.messages import MotionRecord, Rest


class Slow:
    """A previewer that takes until it is released, and notes what it was asked for."""

    def __init__(self) -> None:
        self.asked: list[list[str]] = []
        self.begun = threading.Event()
        self.release = threading.Event()

    def preview(self, explored: Collection[str]) -> Any:
        self.asked.append(list(explored))
        self.begun.set()
        assert self.release.wait(10.0)
        return SimpleNamespace(explored=tuple(explored))


def run_of(
    tmp_path: Path,
    previewer: Any,
    shown: list[Any],
    inline: bool = False,
    clock: Callable[[], int] = lambda: 0,
) -> Run:
    transport: Transport = SimpleNamespace()  # type: ignore[assignment]
    screen = SimpleNamespace(step=lambda *_: None, note=lambda *_: None)
    config = RunConfig(robot="arm", out=tmp_path / "run", sender=Sender("me"), inline=inline)
    run = Run(config, transport, clock, lambda work: None, screen)  # type: ignore[arg-type]
    run._previewer = previewer
    run._feed = SimpleNamespace(  # type: ignore[assignment]
        estimates=lambda *_: None, preview=lambda t_ns, preview: shown.append(preview.explored)
    )
    return run


def explore_until(run: Run, *joints: str) -> None:
    run.recording.estimates = {(joint, "B"): {} for joint in joints}
    run.estimates(joints[-1])


async def begun(slow: Slow) -> None:
    assert await asyncio.to_thread(slow.begun.wait, 10.0)


def test_previews_are_computed_one_at_a_time_while_the_run_goes_on(tmp_path: Path) -> None:
    slow, shown = Slow(), []

    async def explore() -> None:
        run = run_of(tmp_path, slow, shown)
        explore_until(run, "A")
        await begun(slow)
        # The call for the next joint returns at once, though the first preview is not done.
        explore_until(run, "A", "B")
        assert shown == []
        slow.release.set()
        await run._await_preview()
        assert shown == [("A",)]
        explore_until(run, "A", "B", "C")
        await run._await_preview()

    asyncio.run(explore())
    assert slow.asked == [["A"], ["A", "B", "C"]]
    assert shown == [("A",), ("A", "B", "C")]


def test_previews_of_joints_take_no_more_than_their_share_and_the_last_one_asked_for_is_shown(
    tmp_path: Path,
) -> None:
    begun_ns, shown, took_s = list[int](), [], 0.02

    def preview(explored: Collection[str]) -> Any:
        begun_ns.append(time.monotonic_ns())
        time.sleep(took_s)
        return SimpleNamespace(explored=tuple(explored))

    async def explore() -> None:
        run = run_of(tmp_path, SimpleNamespace(preview=preview), shown, clock=time.monotonic_ns)
        joints = [f"J{k}" for k in range(12)]
        for k in range(12):
            explore_until(run, *joints[: k + 1])
            await asyncio.sleep(0.25 * took_s)
        async with asyncio.timeout(10.0):
            while not shown or len(shown[-1]) < 12:
                await asyncio.sleep(0.25 * took_s)
        await run._await_preview()

    asyncio.run(explore())
    assert len(shown) == len(begun_ns) >= 2
    assert min(np.diff(begun_ns)) >= 1e9 * took_s / PREVIEW_SHARE


def test_in_virtual_time_a_preview_is_computed_before_the_call_returns(tmp_path: Path) -> None:
    slow, shown = Slow(), []
    slow.release.set()
    explore_until(run_of(tmp_path, slow, shown, inline=True), "A")
    assert shown == [("A",)]


def fail_with(error: Exception) -> Any:
    def fail(explored: Collection[str]) -> None:
        raise error

    return SimpleNamespace(preview=fail)


def test_data_that_give_no_preview_are_logged_and_nothing_is_shown(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shown: list[Any] = []
    with caplog.at_level(logging.INFO, "coordinator.session.run"):
        explore_until(run_of(tmp_path, fail_with(DataError("contradiction")), shown, inline=True), "A")
    assert shown == []
    assert "no preview of the robot: contradiction" in caplog.text


def test_a_defect_of_a_preview_is_raised_once_and_no_other_preview_hides_it(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="a mistake"):
        explore_until(run_of(tmp_path, fail_with(KeyError("a mistake")), [], inline=True), "A")

    async def explore() -> None:
        run = run_of(tmp_path, fail_with(KeyError("a mistake")), [])
        explore_until(run, "A")
        assert run._preview_task is not None
        await asyncio.wait([run._preview_task])
        explore_until(run, "A", "B")
        with pytest.raises(KeyError, match="a mistake"):
            await run._await_preview()
        # At the end of a run it is awaited again.
        await run._await_preview()

    asyncio.run(explore())


def test_without_estimates_there_is_no_preview(tmp_path: Path) -> None:
    shown: list[Any] = []
    run = run_of(tmp_path, None, shown, inline=True)
    run._previewer = Previewer(run.recording)
    run.estimates("A")
    assert shown == []


def test_previews_of_a_moving_robot_take_no_more_than_their_share_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    took_ns, begun_ns, now_ns, shown = 3_000_000_000, [], [0], []

    class Moving:
        """Every preview takes 3 s of the session's time."""

        def preview_of_all(self, event: JournalEvent, serials: Sequence[str]) -> Any:
            assert event.motion is motion
            begun_ns.append(now_ns[0])
            now_ns[0] += took_ns
            return SimpleNamespace(explored=tuple(serials))

    async def sleep(seconds: float) -> None:
        now_ns[0] += int(1e9 * seconds)
        if run._preview_task is not None:
            await run._preview_task
        if now_ns[0] > 60_000_000_000:
            raise asyncio.CancelledError

    motion = MotionRecord(
        motion_id=1,
        pattern=Rest(duration_s=1.0),
        outcome="running",
        start_ns=0,
        start_row=0,
        end_row=9,
        origin_rad=0.0,
    )
    run = run_of(tmp_path, Moving(), shown, clock=lambda: now_ns[0])
    run._group = SimpleNamespace(running=lambda serial: motion)  # type: ignore[assignment]
    monkeypatch.setattr("coordinator.session.run.asyncio.sleep", sleep)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(run.moving(["A", "B"]))
    # Of every 12 s at most 3; the next one begins with the first look after that, and the looks are here 2 s
    # and the 3 s apart that a preview takes of this clock.
    assert len(shown) >= 4
    assert min(np.diff(begun_ns)) >= took_ns / PREVIEW_SHARE
    assert max(np.diff(begun_ns)) <= took_ns / PREVIEW_SHARE + 1e9 * PREVIEW_EVERY_S + took_ns
