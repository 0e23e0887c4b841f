"""Runs local estimates beside the ticks, on one background thread."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from module_agent.estimate.observer import Finding


class ThreadWorker:
    """One thread that works through estimates in the order of submission."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="estimate")
        self._failure: BaseException | None = None

    def submit(self, job: Callable[[], Finding], done: Callable[[Finding], None]) -> None:
        """Queue a job; `done` is called on the worker's thread."""

        def finish(future: Future[Finding]) -> None:
            error = future.exception()
            if error is not None:
                self._failure = error
            else:
                done(future.result())

        self._pool.submit(job).add_done_callback(finish)

    def check(self) -> None:
        """Raise what a job raised: an estimate that crashes is a defect, not a finding."""
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Wait for the job that runs and drop the others."""
        self._pool.shutdown(wait=True, cancel_futures=True)
