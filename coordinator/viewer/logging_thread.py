"""One thread that does the logging, behind a bounded queue, so that control never waits for a viewer."""

import logging
import queue
import threading
import traceback
from collections.abc import Callable

# Half a minute of feedback of 16 modules at ten batches a second to a file and a live viewer.
QUEUE_LENGTH = 8192
# Places reserved for steps, topology and chain when there is too much data.
RESERVED = 512
IDLE_SECONDS = 0.25
# A job that takes longer never ends: the library waits for a disk that is full, or for a viewer that is gone.
PATIENCE_SECONDS = 20.0

Job = Callable[[], None]

logger = logging.getLogger(__name__)


class LoggingThread:
    """Runs jobs in the order of submission; `dropped` counts those that did not fit into the queue."""

    def __init__(
        self,
        on_idle: Job,
        on_end: Job,
        length: int = QUEUE_LENGTH,
        reserved: int = RESERVED,
        waits: bool = False,
        patience_s: float = PATIENCE_SECONDS,
    ) -> None:
        """Start the thread; `on_idle` runs in it whenever there was no job for a while, `on_end` at the end.

        With `waits`, `submit` waits for a place instead of dropping the job: for virtual time. A job that
        takes longer than `patience_s` is taken to hang, and the thread given up.
        """
        self._patience_s = patience_s
        self._hangs = False
        # Jobs that have ended.
        self._ended = 0
        self._waits = waits
        self._jobs: queue.Queue[Job | None] = queue.Queue(length + reserved)
        self._length = length
        self._on_idle = on_idle
        self._on_end = on_end
        self.dropped = 0
        self._failures: dict[str, int] = {}
        self._closed = False
        # A daemon, so that a process that fails before `close` can end.
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    @property
    def failed(self) -> int:
        """How many jobs raised; the first from every line of code is in the log."""
        return sum(self._failures.values())

    def submit(self, job: Job, *, essential: bool = False) -> bool:
        """Queue a job and return at once; False if it was dropped. Only essential jobs take reserved places.

        A thread that waits drops nothing, unless a job hangs.
        """
        if self._waits:
            kept = self._put(job)
            self.dropped += not kept
            return kept
        try:
            if not essential and self._jobs.qsize() >= self._length:
                raise queue.Full
            self._jobs.put_nowait(job)
        except queue.Full:
            self.dropped += 1
            return False
        return True

    def close(self) -> bool:
        """Run what is queued, then end the thread; False if a job hangs. May be called twice."""
        if not self._closed:
            self._closed = True
            self._put(None)
        while self._thread.is_alive() and not self._hangs:
            ended = self._ended
            self._thread.join(self._patience_s)
            self._hangs = self._thread.is_alive() and self._ended == ended
        return not self._hangs

    def _put(self, job: Job | None) -> bool:
        """Queue a job as soon as there is a place; False if none comes, as one before it hangs."""
        while not self._hangs:
            ended = self._ended
            try:
                self._jobs.put(job, timeout=self._patience_s)
                return True
            except queue.Full:
                self._hangs = self._ended == ended
        return False

    def _run(self) -> None:
        while True:
            try:
                job = self._jobs.get(timeout=IDLE_SECONDS)
            except queue.Empty:
                job = self._on_idle
            self._attempt(job if job is not None else self._on_end)
            if job is None:
                return

    def _attempt(self, job: Job) -> None:
        try:
            job()
        except Exception as failure:
            # A run goes on without a picture, and the next job may succeed.
            last = traceback.extract_tb(failure.__traceback__)[-1]
            # Of few values, unlike its text.
            kind = f"{type(failure).__name__} at {last.filename}:{last.lineno}"
            self._failures[kind] = self._failures.get(kind, 0) + 1
            if self._failures[kind] == 1:
                logger.exception("the viewer could not log something")
        self._ended += 1
