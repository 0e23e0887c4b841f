"""The time, and functions called later: the contract, and its implementation in real time."""

import heapq
import itertools
import threading
import time
from collections.abc import Callable
from typing import Protocol


class Scheduler(Protocol):
    """Calls functions later: a thread in real time, the event loop in virtual time."""

    @property
    def now_s(self) -> float:
        """The time from any origin [s]; it never decreases."""

    def call_later(self, delay_s: float, call: Callable[[], None]) -> None:
        """Call `call` after `delay_s`; calls due at the same time run in the order of scheduling."""


class TimerThread:
    """Calls functions later on one thread of its own, in the order of their times, then of scheduling.

    Calls must be short, since they hold up all others. One that raises ends the thread (its traceback goes to
    `threading.excepthook`), and every later `call_later` says so.
    """

    def __init__(self, name: str = "timer"):
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._counter = itertools.count()
        self._wake = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def now_s(self) -> float:
        """The monotonic time [s]."""
        return time.monotonic()

    def call_later(self, delay_s: float, call: Callable[[], None]) -> None:
        """Call `call` after `delay_s` on the timer's thread; nothing is called after `close`.

        Raises:
            RuntimeError: the thread has died of an exception in an earlier call.
        """
        due_s = self.now_s + max(delay_s, 0.0)
        with self._wake:
            if self._closed:
                return
            if not self._thread.is_alive():
                raise RuntimeError(f"timer thread {self._thread.name!r} died of an exception in a call")
            heapq.heappush(self._heap, (due_s, next(self._counter), call))
            # Only a new head shortens the wait.
            if self._heap[0][2] is call:
                self._wake.notify()

    def close(self) -> None:
        """Stop; pending calls are dropped. May be called twice, also from a call."""
        with self._wake:
            self._closed = True
            self._heap.clear()
            self._wake.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while (call := self._next()) is not None:
            call()

    def _next(self) -> Callable[[], None] | None:
        with self._wake:
            while not self._closed:
                if not self._heap:
                    self._wake.wait()
                    continue
                left_s = self._heap[0][0] - self.now_s
                if left_s <= 0.0:
                    return heapq.heappop(self._heap)[2]
                self._wake.wait(left_s)
            return None
