"""A task that a signal may end, with all that it does in its `finally`."""

import asyncio
import signal
from typing import TypeVar

T = TypeVar("T")


SIGNALS = (signal.SIGINT, signal.SIGTERM)


def ignore_signals() -> None:
    """Ignore what has been obeyed, up to the end of the process: it would end with another exit code."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


class Interruption:
    """A signal handler: the first call cancels the task, later ones do not disturb its clean-up."""

    def __init__(self, loop: asyncio.AbstractEventLoop, task: "asyncio.Task[T]"):
        self._loop = loop
        self._task = task
        self.asked = False

    def __call__(self, *_: object) -> None:
        """Cancel the task, once; to be called from the loop's thread."""
        if not self.asked:
            self.asked = True
            # By the loop, so that a task that has not begun yet runs as far as its `try` first.
            self._loop.call_soon(self._task.cancel, "interrupted")


def run_to_end(loop: asyncio.AbstractEventLoop, task: "asyncio.Task[T]") -> T:
    """Run a task, then cancel and await whatever it has left on the loop; return or raise what it did."""
    try:
        return loop.run_until_complete(task)
    finally:
        left = sorted(asyncio.all_tasks(loop), key=lambda each: each.get_name())
        loop.run_until_complete(_end(left))


async def _end(tasks: "list[asyncio.Task[object]]") -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
