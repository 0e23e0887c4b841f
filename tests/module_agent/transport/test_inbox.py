"""A bounded queue that keeps the oldest and counts what it had to turn away."""

import threading

from hypothesis import given
from hypothesis import strategies as st

from module_agent.transport.transport import Event, Inbox, Sample


def _event(number: int) -> Event:
    return Sample("k", str(number).encode())


@given(
    capacity=st.integers(1, 8),
    steps=st.lists(st.one_of(st.just("put"), st.integers(0, 10)), max_size=60),
)
def test_what_is_kept_comes_out_once_in_order_and_the_rest_is_counted(
    capacity: int, steps: list[str | int]
) -> None:
    inbox = Inbox(capacity)
    waiting: list[Event] = []
    offered, taken, dropped = 0, 0, 0
    for step in steps:
        if isinstance(step, int):
            got = inbox.drain(limit=step)
            assert got == waiting[:step]
            del waiting[:step]
            taken += len(got)
        else:
            offered += 1
            inbox.put(_event(offered))
            if len(waiting) < capacity:
                waiting.append(_event(offered))
            else:
                dropped += 1
        assert len(inbox) == len(waiting) <= capacity
        assert inbox.dropped == dropped
    assert offered == taken + dropped + len(inbox)


def test_threads_that_put_at_once_lose_nothing_uncounted() -> None:
    inbox = Inbox(capacity=10_000)
    threads = [threading.Thread(target=lambda: [inbox.put(_event(i)) for i in range(1000)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(inbox.drain(limit=10_000)) + inbox.dropped == 4000
    assert inbox.dropped == 0
