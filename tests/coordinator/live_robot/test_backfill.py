"""Holes in a module's rows are requested for, several at once, until there are none."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.live_robot.backfill import HOLES_AT_ONCE, RowCompletion
from coordinator.live_robot.messenger import Refused, gather_all
from module_agent.wire.keys import Leaf
from module_agent.wire.refusal import Refusal
from module_agent.wire.row_log import RowLog


class Module:
    """Answers questions for rows, counts how many are under way at once, and keeps what is requested."""

    def __init__(self, wire: SimpleNamespace, log: RowLog, retained_from: int = 0):
        self.wire, self.log, self.retained_from = wire, log, retained_from
        self.requested: list[tuple[int, int]] = []
        self.most, self._now = 0, 0

    async def fetch(self, first: int, end: int) -> None:
        self.requested.append((first, end))
        self._now += 1
        self.most = max(self.most, self._now)
        await asyncio.sleep(0)
        self._now -= 1
        if first < self.retained_from:
            ack = self.wire.ack(accepted=False).model_copy(update={"reason": Refusal.GONE.value})
            raise Refused("A", Leaf.HISTORY, ack)
        self.log.add(self.wire.feedback(first=first, count=end - first))


def _with_holes(wire: SimpleNamespace, count: int) -> RowLog:
    """Five rows there, five missing, and so on; the last five are there."""
    log = RowLog(1)
    for batch in range(count + 1):
        log.add(wire.feedback(first=10 * batch, count=5))
    return log


def test_every_gap_is_requested_once_and_in_small_groups(wire: SimpleNamespace) -> None:
    log = _with_holes(wire, 20)
    module = Module(wire, log)
    completion = RowCompletion(log, module.fetch)
    assert completion.has_gap(205)
    asyncio.run(completion.complete(205))
    assert module.requested == [(10 * k + 5, 10 * k + 10) for k in range(20)]
    assert module.most == HOLES_AT_ONCE
    assert not completion.has_gap(205)


def test_only_rows_from_before_the_session_may_be_unavailable(
    wire: SimpleNamespace,
) -> None:
    log = _with_holes(wire, 3)
    module = Module(wire, log, retained_from=20)
    asyncio.run(RowCompletion(log, module.fetch).complete(35))
    assert log.missing(20, 35) == []
    log = RowLog(1)
    log.add(wire.feedback(first=0, count=5))
    late = Module(wire, log, retained_from=20)
    met = RowCompletion(log, late.fetch)
    log.add(wire.feedback(first=10, count=5))
    with pytest.raises(Refused, match="gone"):
        asyncio.run(met.complete(15))


def test_rows_that_never_come_still_count_as_missing(wire: SimpleNamespace) -> None:
    log = _with_holes(wire, 1)

    async def empty_answers(first: int, end: int) -> None:
        pass

    completion = RowCompletion(log, empty_answers)
    asyncio.run(completion.complete(15))
    assert completion.has_gap(15)


def test_gather_all_runs_everything_to_its_end_before_it_raises() -> None:
    done: list[int] = []

    async def work(number: int) -> Any:
        await asyncio.sleep(0.0 if number == 1 else 1e-3)
        if number == 1:
            raise ValueError("one")
        done.append(number)

    with pytest.raises(ValueError, match="one"):
        asyncio.run(gather_all(work(number) for number in range(4)))
    assert done == [0, 2, 3]
