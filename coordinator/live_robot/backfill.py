"""Complete recordings over a network that loses messages: missing feedback rows are requested again."""

from collections.abc import Callable, Coroutine

from coordinator.live_robot.messenger import Refused, gather_all
from module_agent.wire.refusal import Refusal
from module_agent.wire.row_log import RowLog

HOLES_AT_ONCE = 8
ROUNDS = 200

Fetch = Callable[[int, int], Coroutine[None, None, None]]


class RowCompletion:
    """Completes one module's log of rows, from its first row on, by `fetch(first, end)`."""

    def __init__(self, log: RowLog, fetch: Fetch):
        self._log = log
        self._fetch = fetch
        self._met_row = log.end_row
        self._complete_to = 0

    def has_gap(self, end: int) -> bool:
        """Return whether a row before `end` is missing."""
        return bool(self._log.missing(self._first, end))

    async def complete(self, end: int) -> None:
        """Fetch the rows missing before row `end`.

        After `ROUNDS` rounds it returns; rows still missing are requested by the next call.

        Raises:
            Refused: the module no longer has rows that it sent since the session began.
            NoAnswer: it does not answer.
        """
        first = self._first
        for _ in range(ROUNDS):
            missing = self._log.missing(first, end)
            if not missing:
                self._complete_to = end
                return
            try:
                await gather_all(self._fetch(*gap) for gap in missing[:HOLES_AT_ONCE])
            except Refused as refused:
                # The module may no longer have the rows of the time between a crash and the resumption; the
                # steps that are done had all their rows before.
                if refused.ack.reason != Refusal.GONE.value or missing[0][0] >= self._met_row:
                    raise
                first = missing[0][1]

    @property
    def _first(self) -> int:
        return max(self._log.first_row, self._complete_to)
