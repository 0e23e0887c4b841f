"""An asyncio event loop in virtual time: its clock jumps to the next event, nothing ever sleeps.

Built on `asyncio.BaseEventLoop`; what it uses of its private side (`_run_once`, `_ready`, `_stopping` and
`_timer_handle_cancelled`) is that of Python 3.11, which the project pins.
"""

import asyncio
import heapq
import threading
from asyncio import events
from collections import deque
from collections.abc import Callable
from contextvars import Context
from typing import Any, TypeVar, TypeVarTuple

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

NS_PER_S = 1_000_000_000
# Timers cancelled before their time (one for every `wait_for` that ended well) are swept out of the heap when
# there are this many of them and they are the majority.
_SWEEP_AT = 256

_Entry = tuple[int, int, Callable[[], object], events.TimerHandle | None]


class VirtualDeadlock(RuntimeError):
    """Nothing is scheduled and the loop has not been stopped: its tasks wait for events that cannot come."""


class VirtualLoop(asyncio.BaseEventLoop):
    """A single-threaded, deterministic event loop that starts at time 0.

    Time moves on only when nothing is ready. Events due at the same nanosecond run in the order of
    scheduling. An exception in a callback ends the run instead of being logged. `run_in_executor`, and so
    `asyncio.to_thread`, runs its function inline: work takes no virtual time. Measured: 1.4 us an event.
    """

    _ready: deque[events.Handle]
    _stopping: bool

    def __init__(self) -> None:
        super().__init__()
        self._now_ns = 0
        self._counter = 0
        self._heap: list[_Entry] = []
        self._cancelled_timers = 0
        self._failure: BaseException | None = None
        self._owner = threading.get_ident()

    @property
    def now_ns(self) -> int:
        """The virtual time [ns]."""
        return self._now_ns

    def time(self) -> float:
        """Return the virtual time [s]."""
        return self._now_ns / NS_PER_S

    def schedule_ns(self, due_ns: int, call: Callable[[], object]) -> None:
        """Call `call` at a time [ns], at once if that has passed. The cheapest way; not to be cancelled."""
        self._push(due_ns, call, None)

    def freeze_tasks(self, for_ns: int) -> None:
        """Let a time [ns] pass in which no task, timer or ready call runs, as SIGSTOP of their process does.

        What was given to `schedule_ns` goes on. To be called from such a call; timers run late, in order.
        """
        until_ns, late = self._now_ns + for_ns, list[_Entry]()
        # Calls that let time pass go no further.
        self._push(until_ns, lambda: None, None)
        try:
            while self._heap and self._heap[0][0] <= until_ns:
                entry = heapq.heappop(self._heap)
                if entry[3] is not None:
                    late.append(entry)
                    continue
                self._now_ns = entry[0]
                entry[2]()
        finally:
            for due_ns, _, call, timer in late:
                self._push(due_ns, call, timer)

    @property
    def free_ns(self) -> int | None:
        """How long from now on nothing is due [ns]; 0 while calls are ready, None if nothing is scheduled."""
        if self._ready:
            return 0
        return self._heap[0][0] - self._now_ns if self._heap else None

    def pass_ns(self, time_ns: int) -> None:
        """Let some time pass within a call [ns], for what has done the work of later calls already.

        Raises:
            RuntimeError: something is due within it.
        """
        free_ns = self.free_ns
        if time_ns and free_ns is not None and free_ns <= time_ns:
            raise RuntimeError(f"{time_ns} ns cannot pass at once: something is due in {free_ns} ns")
        self._now_ns += time_ns

    def call_at(
        self, when: float, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> events.TimerHandle:
        """Call `callback(*args)` at virtual time `when` [s], rounded to nanoseconds."""
        timer = events.TimerHandle(when, callback, args, self, context)
        timer._scheduled = True  # type: ignore[attr-defined]
        self._push(round(when * NS_PER_S), timer._run, timer)
        return timer

    def call_later(
        self, delay: float, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> events.TimerHandle:
        """Call `callback(*args)` after `delay` [s]."""
        # There and back is exact: doubles tell neighbouring nanoseconds apart up to 52 days.
        due_ns = self._now_ns + round(delay * NS_PER_S)
        return self.call_at(due_ns / NS_PER_S, callback, *args, context=context)

    def call_soon_threadsafe(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> events.Handle:
        """Call `callback(*args)` soon; from this loop's own thread only.

        Raises:
            RuntimeError: called from another thread, whose timing no virtual clock could order.
        """
        if threading.get_ident() != self._owner:
            raise RuntimeError("a virtual loop is single-threaded, this call comes from another thread")
        return self.call_soon(callback, *args, context=context)

    def run_in_executor(self, executor: object, func: Callable[[*Ts], T], *args: *Ts) -> asyncio.Future[T]:
        """Run `func(*args)` inline and return its outcome as a finished future."""
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        """End the run with the exception of a callback; hand anything else to asyncio's own handler."""
        failure = context.get("exception")
        if "handle" in context and failure is not None:
            self._failure = failure
        else:
            super().call_exception_handler(context)

    def _push(self, due_ns: int, call: Callable[[], object], timer: events.TimerHandle | None) -> None:
        if self.is_closed():
            raise RuntimeError("the virtual loop is closed")
        self._counter += 1
        heapq.heappush(self._heap, (max(due_ns, self._now_ns), self._counter, call, timer))

    def _run_once(self) -> None:
        """Run until `stop` is called; asyncio's own version does one iteration, for the sake of I/O."""
        ready, heap = self._ready, self._heap
        while not self._stopping:
            if ready:
                self._run_ready()
            elif heap:
                due_ns, _, call, timer = heapq.heappop(heap)
                if timer is not None:
                    if timer.cancelled():
                        self._cancelled_timers -= 1
                        continue
                    timer._scheduled = False  # type: ignore[attr-defined]
                self._now_ns = due_ns
                call()
            else:
                raise VirtualDeadlock(self._deadlock_message())
            if self._failure is not None:
                failure, self._failure = self._failure, None
                raise failure
        # asyncio stops after the iteration in which `stop` was called, and so runs what is ready then.
        self._run_ready()

    def _run_ready(self) -> None:
        ready = self._ready
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle.cancelled():
                handle._run()

    def _timer_handle_cancelled(self, timer: Any) -> None:
        if not timer._scheduled:
            return
        self._cancelled_timers += 1
        if self._cancelled_timers > max(_SWEEP_AT, len(self._heap) // 2):
            # The entry of the timer being cancelled right now stays until its time, and is still counted.
            live = [entry for entry in self._heap if entry[3] is None or not entry[3].cancelled()]
            self._heap[:] = live
            heapq.heapify(self._heap)
            self._cancelled_timers = 1

    def _deadlock_message(self) -> str:
        waiting = sorted(f"{task.get_name()}: {task.get_coro()}" for task in asyncio.all_tasks(self))
        return (
            f"virtual time stands still at {self.time():.9f} s: nothing is scheduled, "
            f"yet these wait: {'; '.join(waiting) or 'a future of no task'}"
        )

    def _write_to_self(self) -> None:
        """Nothing to wake: there is no selector."""

    def _process_events(self, event_list: object) -> None:
        """No I/O, no I/O events."""


class LoopScheduler:
    """A `Scheduler` on an event loop; on a `VirtualLoop` by the cheap way."""

    def __init__(self, loop: asyncio.AbstractEventLoop):
        self._loop = loop

    @property
    def now_s(self) -> float:
        """The loop's time [s]."""
        return self._loop.time()

    def call_later(self, delay_s: float, call: Callable[[], None]) -> None:
        """Call `call` after `delay_s` on the loop."""
        if isinstance(self._loop, VirtualLoop):
            self._loop.schedule_ns(self._loop.now_ns + round(delay_s * NS_PER_S), call)
        else:
            self._loop.call_later(delay_s, call)
