"""Whatever order rows arrive in, what is there is right and what is missing is known."""

import tracemalloc
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from module_agent.wire.feedback_rows import ROW
from module_agent.wire.messages import Feedback
from module_agent.wire.refusal import WireError
from module_agent.wire.row_log import MAX_ROWS, RowLog
from tests.other_thread import repeating


def block(first: int, count: int) -> Feedback:
    rows: Any = np.zeros(count, dtype=ROW)
    rows["t_ns"] = np.arange(first, first + count)
    return Feedback(serial="A", boot=1, seq=0, first_row=first, count=count, rows=rows.tobytes())


@given(st.lists(st.tuples(st.integers(0, 300), st.integers(0, 40)), max_size=30), st.integers(0, 350))
def test_a_row_log_agrees_with_a_set_of_row_numbers(blocks: list[tuple[int, int]], first: int) -> None:
    log, model = RowLog(1), {n for start, count in blocks for n in range(start, start + count)}
    for start, count in blocks:
        log.add(block(start, count))
    end = first + 60
    wanted = set(range(first, end))
    assert log.rows(first, end)["t_ns"].tolist() == sorted(wanted & model)
    missing = {n for a, b in log.missing(first, end) for n in range(a, b)}
    assert missing == wanted - model
    assert all(b > a for a, b in log.missing(first, end))
    assert log.end_row == max(model, default=-1) + 1


def test_rows_are_numbered_by_their_times_whatever_is_missing_between() -> None:
    log = RowLog(1)
    assert log.range_between(0, 10**9) == (0, 0)
    log.add(block(50, 10))
    log.add(block(70, 10))
    # The times of these rows are their numbers.
    assert log.range_between(55, 74) == (55, 75)
    assert log.range_between(60, 69) == (0, 0)
    assert log.range_between(0, 1000) == (50, 80)


def test_a_span_in_which_no_row_has_arrived_is_empty() -> None:
    log = RowLog(1)
    assert len(log.between(0, 10)) == 0
    log.add(block(5, 3))
    assert len(log.between(20, 30)) == 0
    assert log.between(6, 30)["t_ns"].tolist() == [6, 7]


def test_forgetting_keeps_what_is_newer() -> None:
    log = RowLog(1)
    log.add(block(0, 100))
    log.forget_before(60)
    assert log.rows(0, 100)["t_ns"].tolist() == list(range(60, 100))
    assert log.end_row == 100


def test_what_was_forgotten_is_not_missing_and_what_it_lacked_is_counted() -> None:
    log = RowLog(1)
    log.add(block(100, 400))
    log.add(block(520, 480))
    log.forget_before(900)
    assert log.missing(100, 1000) == []
    assert (log.lost, log.count) == (20, 100)
    # They are not kept when they come late, but for those that are not forgotten.
    log.add(block(500, 20))
    log.add(block(895, 10))
    assert (log.first_row, log.lost, log.count) == (900, 20, 100)
    assert log.has(505)
    assert log.missing(0, 1010) == [(1000, 1010)]


@given(st.lists(st.tuples(st.integers(0, 900), st.integers(1, 40), st.integers(0, 900)), max_size=30))
def test_rows_of_a_log_that_forgets_are_kept_lost_or_missing(steps: list[tuple[int, int, int]]) -> None:
    log, arrived, forgotten, lost = RowLog(1), set[int](), 0, 0
    for first, count, edge in steps:
        log.add(block(first, count))
        arrived |= {n for n in range(first, first + count) if n >= forgotten}
        low, edge = log.first_row, min(edge, log.end_row)
        log.forget_before(edge)
        if edge > low:
            lost += len(set(range(low, edge)) - arrived)
            forgotten, arrived = edge, {n for n in arrived if n >= edge}
    assert (log.lost, log.count) == (lost, len(arrived))
    assert log.rows(0, 1000)["t_ns"].tolist() == sorted(arrived)
    missing = {n for a, b in log.missing(log.first_row, log.end_row) for n in range(a, b)}
    assert missing == set(range(log.first_row, log.end_row)) - arrived


def test_a_copy_made_while_rows_come_and_go_has_only_whole_rows() -> None:
    """Row numbers are the rows' times, so that a row that is not whole, or not its own, shows."""
    log = RowLog(1)
    log.add(block(0, 10))

    def write(number: int) -> None:
        log.add(block(10 * number, 10))
        if number % 100 == 0:
            log.forget_before(10 * number - 3000)

    with repeating(write):
        for _ in range(300):
            copy = log.copied()
            rows = copy.between(0, 10**12)["t_ns"]
            assert rows.tolist() == list(range(copy.first_row, copy.end_row))
            assert (copy.count, copy.lost) == (len(rows), 0)


def test_a_row_that_comes_while_its_page_is_copied_is_whole_or_not_there() -> None:
    log = RowLog(1)
    log.add(block(1, 3))
    page: Any = log._pages[0]

    class Interrupted:
        """The page; a row comes when half of it has been read."""

        read = 0

        def __getattr__(self, name: str) -> Any:
            self.read += 1
            if self.read == 2:
                log._pages[0] = page
                log.add(block(4, 1))
            return getattr(page, name)

    pages: Any = log._pages
    pages[0] = Interrupted()
    copy = log.copied()
    assert log.has(4)
    assert copy.rows(0, 10)["t_ns"].tolist() == [1, 2, 3]


def test_the_end_is_known_however_far_the_log_has_grown() -> None:
    log = RowLog(1)
    for first in range(0, 40_000, 50):
        log.add(block(first, 50))
        assert log.end_row == first + 50
    assert len(log.rows(0, 40_000)) == 40_000


def test_a_row_that_is_impossibly_far_off_is_refused_before_memory_is_taken_for_it() -> None:
    log = RowLog(1)
    log.add(block(0, 5))
    with pytest.raises(WireError, match="too far"):
        log.add(block(10_000_000_000, 5))
    assert log.end_row == 5


def test_rows_that_arrive_after_a_look_are_in_the_next_one() -> None:
    log = RowLog(1)
    log.add(block(0, 10))
    assert len(log.between(0, 10**12)) == 10
    log.add(block(20, 10))
    assert len(log.between(0, 10**12)) == 20
    log.forget_before(25)
    assert len(log.between(0, 10**12)) == 5
    # Another log does not share what was looked up.
    other = log.copied()
    other.add(block(40, 10))
    assert (len(log.between(0, 10**12)), len(other.between(0, 10**12))) == (5, 15)


def test_a_look_that_began_before_earlier_rows_came_sees_the_rows_that_it_found() -> None:
    log = RowLog(1)
    log.add(block(1000, 300))
    looked_up = log._times()
    # Another thread adds what a network has delayed, and drops what is old, before the rows are taken.
    log.add(block(10, 40))
    log.forget_before(1100)
    log._index = looked_up._replace(changes=log._changes)
    assert log.between(1050, 1149)["t_ns"].tolist() == list(range(1050, 1150))
    assert log.range_between(1050, 1149) == (1050, 1150)


def test_two_rows_far_apart_take_no_memory_for_those_between_them() -> None:
    log = RowLog(1)
    tracemalloc.start()
    log.add(block(0, 1))
    log.add(block(MAX_ROWS - 1, 1))
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # Two pages of 26 kB; the rows between them would be 404 MB.
    assert taken < 500_000
    assert log.missing(0, MAX_ROWS) == [(1, MAX_ROWS - 1)]
    assert log.rows(0, MAX_ROWS)["t_ns"].tolist() == [0, MAX_ROWS - 1]


def test_rows_scattered_as_no_network_does_are_refused_and_true_ones_still_kept() -> None:
    log = RowLog(1)
    for number in range(0, MAX_ROWS - 1000, 1000):
        with suppress(WireError):
            log.add(block(number, 1))
    with pytest.raises(WireError, match="scattered"):
        log.add(block(MAX_ROWS - 1000, 1))
    # 65 free pages, and one for every 32 rows.
    assert log.count < 80
    log.add(block(2, 200))
    assert log.rows(2, 202)["t_ns"].tolist() == list(range(2, 202))


@pytest.mark.parametrize("lost", [0.0, 0.5, 0.8])
def test_a_network_that_loses_most_of_an_hour_fills_a_log(lost: float) -> None:
    log, kept = RowLog(1), np.random.default_rng(1).random(900_000 // 40) >= lost
    for first in np.flatnonzero(kept) * 40:
        log.add(block(int(first), 40))
    assert log.count == 40 * kept.sum()
