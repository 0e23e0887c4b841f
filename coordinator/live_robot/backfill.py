"""Whole recordings from a network that drops: a module's feedback rows that are missing are asked for."""

from collections.abc import Callable, Coroutine

from coordinator.live_robot.messenger import Refused, gather_all
from module_agent.wire.refusal import Refusal
from module_agent.wire.row_log import RowLog

HOLES_AT_ONCE = 8
ROUNDS = 200

Fetch = Callable[[int, int], Coroutine[None, None, None]]


class RowCompletion:
    """Keeps one module's log of rows whole from its first row on, by `fetch(first, end)`."""

    def __init__(self, log: RowLog, fetch: Fetch):
        self._log = log
        self._fetch = fetch
        self._met_row = log.end_row
        self._whole_to: int | None = None

    def has_gap(self, end: int) -> bool:
        """Return whether a row before `end` is missing."""
        return bool(self._log.missing(self._first, end))

    async def complete(self, end: int) -> None:
        """Fetch what is missing before row `end`.

        After `ROUNDS` it is given up until the next time; what is missing still counts as missing.

        Raises:
            Refused: rows since the module was met are kept no longer.
            NoAnswer: it does not answer.
        """
        first = self._first
        for _ in range(ROUNDS):
            missing = self._log.missing(first, end)
            if not missing:
                self._whole_to = end
                return
            try:
                await gather_all(self._fetch(*hole) for hole in missing[:HOLES_AT_ONCE])
            except Refused as refused:
                # What passed while nobody listened, between a crash and its resumption, may be forgotten by
                # now; steps that are done had all their rows before.
                if refused.ack.reason != Refusal.GONE.value or missing[0][0] >= self._met_row:
                    raise
                first = missing[0][1]

    @property
    def _first(self) -> int:
        return max(self._log.first_row, self._whole_to or 0)
