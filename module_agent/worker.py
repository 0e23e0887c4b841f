"""Runs local estimates on one background thread, while the ticks go on."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


class ThreadWorker:
    """One thread that works through estimates in the order of submission."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="estimate")
        self._failure: BaseException | None = None

    def submit(self, job: Callable[[], T], done: Callable[[T], None]) -> None:
        """Queue a job; `done` is called on the worker's thread."""
        self._pool.submit(self._run, job, done)

    def _run(self, job: Callable[[], T], done: Callable[[T], None]) -> None:
        try:
            done(job())
        except BaseException as error:  # stored for `check`: the pool would only log it
            self._failure = error

    def check(self) -> None:
        """Raise what a job or its receiver raised: an estimate that crashes is a defect, not a finding."""
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Wait for the job that runs and drop the others."""
        self._pool.shutdown(wait=True, cancel_futures=True)
