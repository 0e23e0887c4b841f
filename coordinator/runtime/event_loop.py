"""An asyncio loop at a multiple of real time, for simulations, and interruption of its task by signals."""

import asyncio
import math
import selectors
import signal
import time
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from module_agent.model.errors import UsageError
from module_agent.model.garbage import leave_out_imports


def check_speed(speed: float) -> float:
    """Return a speed that a clock can run at.

    Raises:
        UsageError: not positive, or not finite.
    """
    if not (math.isfinite(speed) and speed > 0.0):
        raise UsageError(f"speed {speed}: it must be a positive number, 1 for real time")
    return speed


class _ScaledSelector(selectors.DefaultSelector):
    def __init__(self, speed: float):
        super().__init__()
        self._speed = speed

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait for the real time that `timeout` session seconds take."""
        return super().select(timeout if timeout is None else timeout / self._speed)


class ScaledLoop(asyncio.SelectorEventLoop):
    """Sleeps and time-outs are in session seconds: `speed` of them pass in a real second.

    Raises:
        UsageError: see `check_speed`.
    """

    def __init__(self, speed: float = 1.0):
        super().__init__(_ScaledSelector(check_speed(speed)))
        self._speed = speed
        # Wall time at the start, so that the recordings of a resumed session do not overlap.
        self._origin_ns = time.time_ns()
        self._start_ns = time.monotonic_ns()

    def time(self) -> float:
        """Return session seconds."""
        return time.monotonic() * self._speed

    def clock_ns(self) -> int:
        """Return session time as integer nanoseconds since 1970 (at the start)."""
        return self._origin_ns + int((time.monotonic_ns() - self._start_ns) * self._speed)


T = TypeVar("T")

# A closed terminal ends a program in order, too, unless it was started to outlive it (nohup).
_OUTLIVES_TERMINAL = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
SIGNALS = (signal.SIGINT, signal.SIGTERM, *(() if _OUTLIVES_TERMINAL else (signal.SIGHUP,)))


def ignore_signals() -> None:
    """Ignore signals until the process ends, so that a second one does not change the exit code."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


class Interruption:
    """A signal handler: the first call cancels the task, later ones do not disturb its clean-up."""

    def __init__(self, loop: asyncio.AbstractEventLoop, task: "asyncio.Task[T]"):
        self._loop = loop
        self._task = task
        self.requested = False

    def __call__(self, *_: object) -> None:
        """Cancel the task, once; to be called from the loop's thread."""
        if not self.requested:
            self.requested = True
            # By the loop, so that a task that has not begun yet runs as far as its `try` first.
            self._loop.call_soon(self._task.cancel, "interrupted")


def end_tasks(loop: asyncio.AbstractEventLoop) -> None:
    """Cancel the tasks of a loop that does not run, and await their end."""
    remaining = sorted(asyncio.all_tasks(loop), key=lambda each: each.get_name())
    for each in remaining:
        each.cancel()
    if remaining:
        loop.run_until_complete(asyncio.gather(*remaining, return_exceptions=True))


def run_to_end(loop: asyncio.AbstractEventLoop, task: "asyncio.Task[T]") -> T:
    """Run a task, then cancel and await its remaining tasks; return its result or raise its error."""
    try:
        return loop.run_until_complete(task)
    finally:
        end_tasks(loop)


def attend(
    loop: asyncio.AbstractEventLoop, work: Coroutine[Any, Any, T], ends: Callable[[], bool] = lambda: False
) -> T:
    """Run work to its end, and close the loop; a signal cancels the work, unless `ends` ends it in order."""
    leave_out_imports()
    task = loop.create_task(work)
    interruption = Interruption(loop, task)

    def on_signal() -> None:
        if not ends():
            interruption()

    for number in SIGNALS:
        loop.add_signal_handler(number, on_signal)
    try:
        return run_to_end(loop, task)
    finally:
        loop.run_until_complete(loop.shutdown_default_executor())
        # Closing hands the signals back to Python.
        loop.close()
        if interruption.requested:
            ignore_signals()
