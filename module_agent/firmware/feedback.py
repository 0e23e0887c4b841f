"""Feedback rows: when one is due, its contents, when a batch is published, and the last minute of them.

The history lets a receiver ask again for rows that the network has dropped.
"""

import numpy as np

from module_agent.control.controller import NOMINAL_VOLTAGE_V, Command
from module_agent.firmware.config import FirmwareConfig
from module_agent.hardware.hardware import SensorSample
from module_agent.wire.feedback_rows import ROW, STATE_NAMES, Rows, pack_row
from module_agent.wire.messages import State
from module_agent.wire.refusal import Refusal, WireError


class History:
    """A ring of feedback rows, numbered from 0 since boot."""

    def __init__(self, capacity: int):
        self._bytes = bytearray(capacity * ROW.itemsize)
        # The same memory: rows are written one by one as bytes and read in bulk as records.
        self._ring: Rows = np.frombuffer(self._bytes, dtype=ROW)
        self.capacity = capacity
        self.next_row = 0

    @property
    def first_row(self) -> int:
        """The number of the oldest row in the ring."""
        return max(0, self.next_row - self.capacity)

    def keep(self, rows: memoryview) -> None:
        """Add rows, no more than there is room for in the ring, by their bytes."""
        start, room = self.next_row % self.capacity * ROW.itemsize, len(self._bytes)
        fitting = min(len(rows), room - start)
        self._bytes[start : start + fitting] = rows[:fitting]
        self._bytes[: len(rows) - fitting] = rows[fitting:]
        self.next_row += len(rows) // ROW.itemsize

    def append(self, values: tuple[float, ...]) -> None:
        """Add one row: its values in the order of `feedback_rows.ROW`, vectors element by element."""
        pack_row(self._bytes, self.next_row % self.capacity, values)
        self.next_row += 1

    def rows(self, first: int, end: int) -> Rows:
        """Return a copy of rows `first` up to and without `end`, shape (end - first,); see `block`."""
        return np.frombuffer(self.block(first, end), dtype=ROW)

    def block(self, first: int, end: int) -> bytes:
        """Return the bytes of rows `first` up to and without `end`.

        Raises:
            WireError: GONE, a row is overwritten or not yet there; the message has the range available.
        """
        if first > end or first < self.first_row or end > self.next_row:
            raise WireError(
                Refusal.GONE,
                f"rows {first} to {end} are not kept; kept are {self.first_row} to {self.next_row}",
            )
        start = first % self.capacity * ROW.itemsize
        stop = start + (end - first) * ROW.itemsize
        ring = memoryview(self._bytes)
        if stop <= len(ring):
            return bytes(ring[start:stop])
        return bytes(ring[start:]) + bytes(ring[: stop - len(ring)])

    def between(self, start_ns: int, end_ns: int) -> Rows:
        """Return a copy of the available rows whose module time is within a span, both ends included."""
        kept = np.arange(self.first_row, self.next_row)
        t_ns = self._ring["t_ns"][kept % self.capacity]
        first, end = self.first_row + np.searchsorted(t_ns, (start_ns, end_ns + 1))
        return self.rows(int(first), int(max(first, end)))


STATE_INDEX = {name: index for index, name in enumerate(STATE_NAMES)}


class FeedbackStream:
    """The feedback rows of one module, at its feedback rate and never twice with one IMU sample if slower.

    `history` keeps what has been appended.
    """

    def __init__(self, config: FirmwareConfig):
        self.history = History(config.history_rows)
        self._batch_rows = config.batch_rows
        self._period_ns = round(1e9 / config.feedback_rate_hz)
        self._half_tick_ns = config.tick_ns // 2
        self._imu_period_ns = config.imu_period_ns
        # Rows no faster than the IMU wait for its next sample, so that every row holds a new one.
        self._waits_for_imu = self._period_ns >= config.imu_period_ns
        self._due_ns = 0
        self._last_imu_ns = -1
        self._sent_row = 0

    @property
    def times_ns(self) -> tuple[int, int]:
        """When the next row is due, and the IMU's time in the last tick."""
        return self._due_ns, self._last_imu_ns

    @property
    def periods(self) -> tuple[int, int, int, bool]:
        """Period of rows, half a tick, period of the IMU [ns], and whether rows wait for the IMU."""
        return self._period_ns, self._half_tick_ns, self._imu_period_ns, self._waits_for_imu

    def go_on(self, due_ns: int, imu_ns: int) -> None:
        """Go on from times as `times_ns` gives them."""
        self._due_ns, self._last_imu_ns = due_ns, imu_ns

    def begin_anew(self) -> None:
        """Let a row be due at once, after a clock that went back: the next one would be long in coming."""
        self._due_ns, self._last_imu_ns = 0, -1

    def due(self, now_ns: int, imu_t_ns: int) -> bool:
        """Return whether this tick, asked for once and with its IMU's time, is to make a row."""
        new_imu = imu_t_ns != self._last_imu_ns
        self._last_imu_ns = imu_t_ns
        if now_ns < self._due_ns - self._half_tick_ns:
            return False
        in_step = self._waits_for_imu and new_imu
        if self._waits_for_imu and not new_imu and now_ns < self._due_ns + self._imu_period_ns:
            return False
        begin_ns = now_ns if in_step else max(self._due_ns, now_ns - self._half_tick_ns)
        self._due_ns = begin_ns + self._period_ns
        return True

    def append(
        self, sample: SensorSample, motion_id: int, state: State, command: Command, pwm: float
    ) -> tuple[int, int] | None:
        """Add the row of a tick; return the batch complete with it: its first row, one past its last."""
        voltage_v = sample.voltage_v
        duty = pwm * NOMINAL_VOLTAGE_V / voltage_v if voltage_v else 0.0
        history = self.history
        # From the deflection to the IMU, a sample's fields are in the order of a row's.
        history.append(
            (
                sample.t_ns,
                sample.imu_t_ns,
                motion_id,
                STATE_INDEX[state],
                sample.position_rad,
                sample.velocity_rad_s,
                sample.effort_nm,
                *command[:3],
                min(max(duty, -1.0), 1.0),
                *sample[5:16],
            )
        )
        return self._batch()

    @property
    def rows_to_batch(self) -> int:
        """How many rows complete the batch that is to be published next."""
        return self._sent_row + self._batch_rows - self.history.next_row

    def keep(self, rows: memoryview) -> tuple[int, int] | None:
        """Add at most `rows_to_batch` rows by their bytes; return the batch that they complete, if any."""
        self.history.keep(rows)
        return self._batch()

    def _batch(self) -> tuple[int, int] | None:
        first, end = self._sent_row, self.history.next_row
        if end - first < self._batch_rows:
            return None
        self._sent_row = end
        return first, end
