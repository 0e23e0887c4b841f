"""Estimates run beside the ticks in order; one that crashes is not swallowed."""

import threading
import time

import pytest

from module_agent.estimate.observer import Finding
from module_agent.host import InlineWorker
from module_agent.worker import ThreadWorker


def _finding(joint: str) -> Finding:
    return Finding(joint, (1,), False, 0.0, (0.0, 0.0, 9.81), None, None, "")


def test_jobs_run_beside_the_caller_in_the_order_of_submission() -> None:
    worker, go, findings = ThreadWorker(), threading.Event(), list[tuple[str, str]]()

    def job(joint: str) -> Finding:
        assert go.wait(5.0)
        return _finding(joint)

    for joint in ("A", "B", "C"):
        worker.submit(
            lambda joint=joint: job(joint),
            lambda f: findings.append((f.joint, threading.current_thread().name)),
        )
    # The caller has not been held up by jobs that cannot have begun.
    assert findings == []
    go.set()
    last = threading.Event()
    worker.submit(lambda: _finding("end"), lambda _: last.set())
    assert last.wait(5.0)
    worker.close()
    assert [joint for joint, _ in findings] == ["A", "B", "C"]
    assert all(name.startswith("estimate") for _, name in findings)
    worker.check()


def test_a_job_that_crashes_is_raised_where_it_is_checked() -> None:
    worker, ran = ThreadWorker(), threading.Event()

    def crash() -> Finding:
        raise ZeroDivisionError("a defect")

    worker.submit(crash, lambda _: None)
    worker.submit(lambda: _finding("A"), lambda _: ran.set())
    assert ran.wait(5.0)
    with pytest.raises(ZeroDivisionError, match="a defect"):
        worker.check()
    worker.close()


def test_a_receiver_that_crashes_is_raised_where_it_is_checked() -> None:
    worker, ran = ThreadWorker(), threading.Event()

    def refuse(_: Finding) -> None:
        raise KeyError("receiver")

    worker.submit(lambda: _finding("A"), refuse)
    worker.submit(lambda: _finding("B"), lambda _: ran.set())
    assert ran.wait(5.0)
    with pytest.raises(KeyError, match="receiver"):
        worker.check()
    worker.close()


def test_closing_ends_the_running_job_and_drops_the_waiting_ones() -> None:
    worker, started, findings = ThreadWorker(), threading.Event(), list[str]()

    def slow() -> Finding:
        started.set()
        # Closing begins meanwhile.
        time.sleep(0.3)
        return _finding("running")

    worker.submit(slow, lambda f: findings.append(f.joint))
    worker.submit(lambda: _finding("waiting"), lambda f: findings.append(f.joint))
    assert started.wait(5.0)
    worker.close()
    assert findings == ["running"]
    # What was dropped has not failed.
    worker.check()


def test_inline_work_is_done_at_once_and_its_crash_comes_at_once() -> None:
    worker, findings = InlineWorker(), list[Finding]()
    worker.submit(lambda: _finding("A"), findings.append)
    assert [f.joint for f in findings] == ["A"]

    def crash() -> Finding:
        raise ZeroDivisionError("a defect")

    with pytest.raises(ZeroDivisionError):
        worker.submit(crash, findings.append)


def test_closing_with_jobs_waiting_logs_no_error(caplog: pytest.LogCaptureFixture) -> None:
    worker, started = ThreadWorker(), threading.Event()
    worker.submit(lambda: (started.set(), time.sleep(0.05), _finding("running"))[2], lambda _: None)
    worker.submit(lambda: _finding("waiting"), lambda _: None)
    assert started.wait(5.0)
    worker.close()
    assert caplog.records == []
