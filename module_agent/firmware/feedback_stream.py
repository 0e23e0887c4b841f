"""When feedback rows are due, what they hold, and when a batch of them is to be published."""

from typing import NamedTuple

from module_agent.firmware.config import FirmwareConfig
from module_agent.firmware.controller import NOMINAL_VOLTAGE_V, Command
from module_agent.firmware.history import History
from module_agent.hardware import SensorSample
from module_agent.wire.feedback_rows import STATE_NAMES
from module_agent.wire.messages import State

_STATE_INDEX = {name: index for index, name in enumerate(STATE_NAMES)}
_NAN = float("nan")


class Batch(NamedTuple):
    """Consecutive rows to be published: the number of the first, one past the last, and their bytes."""

    first_row: int
    end_row: int
    block: bytes


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
    ) -> Batch | None:
        """Add the row of a tick; return the batch that is complete with it."""
        voltage_v = sample.voltage_v
        duty = pwm * NOMINAL_VOLTAGE_V / voltage_v if voltage_v else 0.0
        position, velocity, effort = command
        history = self.history
        # From the deflection on, a sample's fields are in the order of a row's.
        history.append(
            (
                sample.t_ns,
                sample.imu_t_ns,
                motion_id,
                _STATE_INDEX[state],
                sample.position_rad,
                sample.velocity_rad_s,
                sample.effort_nm,
                _NAN if position is None else position,
                _NAN if velocity is None else velocity,
                _NAN if effort is None else effort,
                min(max(duty, -1.0), 1.0),
                *sample[5:],
            )
        )
        first, end = self._sent_row, history.next_row
        if end - first < self._batch_rows:
            return None
        self._sent_row = end
        return Batch(first, end, history.block(first, end))
