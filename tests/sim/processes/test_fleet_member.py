"""What a member of a fleet counts while it forgets."""

import numpy as np
import pytest

from module_agent.wire.feedback_rows import ROW
from module_agent.wire.messages import Feedback
from module_agent.wire.row_log import RowLog
from sim.processes.fleet_member import RowCount


def block(first: int, count: int = 5) -> Feedback:
    return Feedback(
        serial="A", boot=1, seq=0, first_row=first, count=count, rows=np.zeros(count, ROW).tobytes()
    )


@pytest.mark.parametrize("retained", [10**6, 100, 7])
def test_rows_are_counted_once_as_come_or_lost_however_few_are_kept(retained: int) -> None:
    log = RowLog(1)
    for first in (0, 10, 15):
        log.add(block(first))
    count = RowCount(log)
    # What was lost before, and comes late, is of another time.
    log.add(block(5))
    for first in range(20, 10_000, 5):
        if first not in (200, 5000, 9990):
            log.add(block(first))
            log.forget_before(log.end_row - retained)
    assert count() == (10_000 - 20 - 15, 15)
