import threading

import pytest

from coordinator.viewer.logging_thread import LoggingThread


def nothing() -> None:
    pass


@pytest.fixture
def gate() -> threading.Event:
    return threading.Event()


def blocked(gate: threading.Event, length: int, reserved: int) -> LoggingThread:
    """Start a thread whose first job waits for the gate, so that the queue stays as it is filled."""
    thread = LoggingThread(nothing, nothing, length, reserved)
    begun = threading.Event()

    def wait() -> None:
        begun.set()
        gate.wait()

    thread.submit(wait)
    assert begun.wait(10.0)
    return thread


def test_jobs_run_in_order_and_all_before_it_closes() -> None:
    ran: list[int] = []
    thread = LoggingThread(nothing, nothing)
    for i in range(1000):
        thread.submit(lambda i=i: ran.append(i))  # type: ignore[misc]
    thread.close()
    assert ran == list(range(1000))
    assert thread.dropped == 0


def test_what_does_not_fit_is_dropped_and_counted_and_the_caller_never_waits(gate: threading.Event) -> None:
    ran: list[int] = []
    thread = blocked(gate, length=10, reserved=2)
    taken = [thread.submit(lambda i=i: ran.append(i)) for i in range(25)]  # type: ignore[misc]
    assert taken == [True] * 10 + [False] * 15
    assert thread.dropped == 15
    gate.set()
    thread.close()
    assert ran == list(range(10))


def test_steps_still_fit_behind_a_flood_of_data(gate: threading.Event) -> None:
    thread = blocked(gate, length=10, reserved=2)
    for _ in range(25):
        thread.submit(nothing)
    assert [thread.submit(nothing, essential=True) for _ in range(3)] == [True, True, False]
    assert thread.dropped == 16
    gate.set()
    thread.close()


def test_a_job_that_raises_is_counted_reported_once_and_stops_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fail() -> None:
        raise ValueError("a bad value")

    ran: list[str] = []
    thread = LoggingThread(nothing, nothing)
    for _ in range(3):
        thread.submit(fail)
    thread.submit(lambda: ran.append("after"))
    thread.close()
    assert (thread.failed, ran) == (3, ["after"])
    assert caplog.text.count("the viewer could not log something") == 1


def test_one_job_runs_while_nothing_comes_and_another_last_of_all() -> None:
    idle = threading.Event()
    ran: list[str] = []
    thread = LoggingThread(idle.set, lambda: ran.append("end"))
    assert idle.wait(10.0)
    thread.submit(lambda: ran.append("job"))
    thread.close()
    assert ran == ["job", "end"]


def test_closing_twice_ends_once() -> None:
    ended: list[str] = []
    thread = LoggingThread(nothing, lambda: ended.append("end"))
    thread.close()
    thread.close()
    assert ended == ["end"]


def test_a_job_that_hangs_is_given_up(gate: threading.Event) -> None:
    begun = threading.Event()

    def hang() -> None:
        begun.set()
        gate.wait()

    thread = LoggingThread(nothing, nothing, length=1, reserved=0, waits=True, patience_s=0.05)
    thread.submit(hang)
    assert begun.wait(10.0)
    assert thread.submit(nothing)
    # In virtual time one waits for a place, as long as there is hope.
    assert not thread.submit(nothing)
    assert thread.dropped == 1
    assert not thread.close()
    gate.set()


def test_a_queue_that_takes_long_in_all_is_no_job_that_hangs() -> None:
    ran: list[int] = []
    thread = LoggingThread(nothing, nothing, patience_s=0.5)

    def slow() -> None:
        threading.Event().wait(0.05)
        ran.append(1)

    for _ in range(20):
        thread.submit(slow)
    assert thread.close()
    assert len(ran) == 20
