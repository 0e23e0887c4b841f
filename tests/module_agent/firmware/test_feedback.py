"""The ring of rows agrees with a list of all rows, cut to its capacity."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from module_agent.firmware.feedback import History
from module_agent.wire.refusal import Refusal, WireError

CAPACITY = 7


def filled(stamps: list[int]) -> History:
    history = History(CAPACITY)
    for t_ns in stamps:
        history.append((t_ns, t_ns, 0, 0, *[0.0] * 18))
    return history


@given(st.integers(0, 25), st.integers(0, 25), st.integers(0, 25))
def test_rows_are_those_of_a_list_or_gone(count: int, first: int, end: int) -> None:
    history = filled([10 * n for n in range(count)])
    if max(0, count - CAPACITY) <= first <= end <= count:
        assert history.rows(first, end)["t_ns"].tolist() == [10 * n for n in range(first, end)]
        assert history.block(first, end) == history.rows(first, end).tobytes()
    else:
        with pytest.raises(WireError) as refused:
            history.rows(first, end)
        assert refused.value.reason is Refusal.GONE


@given(st.lists(st.integers(1, 9), max_size=20), st.integers(-5, 100), st.integers(-5, 100))
def test_rows_between_two_times_are_those_that_a_comparison_of_all_finds(
    steps: list[int], start_ns: int, end_ns: int
) -> None:
    stamps = np.cumsum([0, *steps]).tolist()
    available = stamps[-CAPACITY:]
    rows = filled(stamps).between(start_ns, end_ns)
    assert rows["t_ns"].tolist() == [t for t in available if start_ns <= t <= end_ns]


def test_rows_that_were_read_stay_as_they_were_when_the_ring_goes_on() -> None:
    history = filled(list(range(CAPACITY)))
    rows = history.rows(0, CAPACITY)
    for t_ns in range(100, 100 + CAPACITY):
        history.append((t_ns, t_ns, 0, 0, *[0.0] * 18))
    assert rows["t_ns"].tolist() == list(range(CAPACITY))
    assert not rows.flags.writeable
