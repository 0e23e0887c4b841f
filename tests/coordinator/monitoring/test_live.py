"""A live monitor keeps rows for a time, whatever their rate."""

import numpy as np
import pytest

from coordinator.monitoring.live import RETAINED_S, retained_rows
from coordinator.recording.recording import ModuleRecord
from module_agent.wire.feedback_rows import ROW
from module_agent.wire.messages import Feedback


def _record(rate_hz: float, messages: range) -> ModuleRecord:
    """A module's rows, of which the eleventh message is lost."""
    record = ModuleRecord("A", 1)
    for number in messages:
        rows = np.zeros(5, dtype=ROW)
        rows["t_ns"] = (5 * number + np.arange(5)) * round(1e9 / rate_hz)
        if number != messages[10]:
            message = Feedback(
                serial="A", boot=1, seq=number, first_row=5 * number, count=5, rows=rows.tobytes()
            )
            record.rows.add(message)
    return record


@pytest.mark.parametrize("rate_hz", [50.0, 250.0, 1000.0])
def test_rows_are_kept_for_a_time_by_the_rate_of_their_stamps(rate_hz: float) -> None:
    assert retained_rows(_record(rate_hz, range(20))) == round(RETAINED_S * rate_hz)


def test_without_a_rate_all_rows_are_kept() -> None:
    record = ModuleRecord("A", 1)
    assert retained_rows(record) == 0
    rows = np.zeros(1, dtype=ROW)
    record.rows.add(Feedback(serial="A", boot=1, seq=1, first_row=7, count=1, rows=rows.tobytes()))
    assert retained_rows(record) == 1
