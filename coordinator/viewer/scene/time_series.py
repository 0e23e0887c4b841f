"""Feedback rows as time series: one vector entity per group of sensors, thinned out to what a screen shows.

A chunk of a recording has some 2.6 kB of headers, and a call of `send_columns` costs the same for 25 rows as
for 250, so rows should come in large batches. The recording shows the run; every row is in the MCAP file.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from coordinator.viewer.scene import entity_paths
from module_agent.wire.feedback_rows import STATE_NAMES, Rows

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

# At most two rows per interval are logged. On 1500 pixels a minute looks the same as with all rows.
INTERVAL_NS = 40_000_000
# Voltage and temperature change over seconds.
SLOW_INTERVAL_NS = 1_000_000_000


class Batch(NamedTuple):
    """Rows of one module: `t_ns` (m,) in session time, `rows` (m,) records of `feedback_rows.ROW`."""

    serial: str
    t_ns: IntArray
    rows: Rows


class Series(NamedTuple):
    """A group of sensors: the last part of its entity, its fields in a row, and its components in plots."""

    group: str
    fields: tuple[str, ...]
    components: tuple[str, ...] = ("",)

    def values(self, rows: Rows) -> FloatArray:
        """Return the group's values (m, k) in m rows."""
        return np.column_stack([rows[field] for field in self.fields]).astype(float)


_COMMAND, _XYZ = ("command",), ("x", "y", "z")
FAST: tuple[Series, ...] = (
    Series(entity_paths.POSITION, ("position_rad",)),
    Series(entity_paths.VELOCITY, ("velocity_rad_s",)),
    Series(entity_paths.EFFORT, ("effort_nm",)),
    Series(entity_paths.POSITION_COMMAND, ("position_command_rad",), _COMMAND),
    Series(entity_paths.VELOCITY_COMMAND, ("velocity_command_rad_s",), _COMMAND),
    Series(entity_paths.EFFORT_COMMAND, ("effort_command_nm",), _COMMAND),
    Series(entity_paths.GYRO, ("gyro_rad_s",), _XYZ),
    Series(entity_paths.ACCEL, ("accel_m_s2",), _XYZ),
    Series(entity_paths.PWM, ("pwm",)),
    Series(entity_paths.CURRENT, ("motor_current_a",)),
)
SLOW: tuple[Series, ...] = (
    Series(entity_paths.VOLTAGE, ("voltage_v",)),
    Series(entity_paths.TEMPERATURE, ("winding_temperature_c",)),
)


def envelope(t_ns: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Thin out a series so that peaks stay visible.

    Of the rows in one interval of `INTERVAL_NS` remain the smallest and the largest value of every component,
    in the order in which they occurred, at the times of the interval's first and last row. So a value is
    displaced by less than an interval, and a component that is monotonic within it keeps values and times.

    Args:
        t_ns: (m,) times; they may jump back, where rows came late.
        values: (m, k); NaN is left out where an interval has numbers as well.

    Returns:
        Times (j,) and values (j, k), at most two per interval.
    """
    if not t_ns.size:
        return t_ns, values
    first = _first_rows(t_ns, INTERVAL_NS)
    last = np.concatenate([first[1:], [t_ns.size]]) - 1
    lowest, highest = np.fmin.reduceat(values, first), np.fmax.reduceat(values, first)
    interval, row = np.repeat(np.arange(first.size), last - first + 1), np.arange(t_ns.size)[:, None]
    lowest_at = np.minimum.reduceat(np.where(values == lowest[interval], row, t_ns.size), first)
    highest_at = np.minimum.reduceat(np.where(values == highest[interval], row, t_ns.size), first)
    rising = lowest_at <= highest_at
    pair = np.stack([np.where(rising, lowest, highest), np.where(rising, highest, lowest)], axis=1)
    # An interval with a single row has no second one.
    retained = np.stack([np.ones(first.size, dtype=bool), last > first], axis=1)
    return np.stack([t_ns[first], t_ns[last]], axis=1)[retained], pair[retained]


def _first_rows(t_ns: IntArray, interval_ns: int) -> NDArray[np.intp]:
    """Return the indices of the rows with which another interval begins."""
    return np.concatenate([[0], 1 + np.flatnonzero(np.diff(t_ns // interval_ns))])


def send_rows(stream: rr.RecordingStream, batch: Batch) -> None:
    """Log the envelopes of a batch without commands that are never set, and the slow ones once a second."""
    for series in FAST:
        values = series.values(batch.rows)
        if series.components != _COMMAND or not np.isnan(values).all():
            path = entity_paths.module_path(batch.serial, series.group)
            send_scalars(stream, path, *envelope(batch.t_ns, values))
    rows = _first_rows(batch.t_ns, SLOW_INTERVAL_NS)
    for series in SLOW:
        path = entity_paths.module_path(batch.serial, series.group)
        send_scalars(stream, path, batch.t_ns[rows], series.values(batch.rows[rows]))


def send_scalars(stream: rr.RecordingStream, path: str, t_ns: IntArray, values: FloatArray) -> None:
    """Log `values` (m, k) at `t_ns` (m,) as one entity of k series."""
    stream.send_columns(path, [time_column(t_ns)], rr.Scalars.columns(scalars=values))


def time_column(t_ns: IntArray) -> rr.TimeColumn:
    """Return the session time as integer nanoseconds; as float seconds rows would be misaligned by 1 ns."""
    return rr.TimeColumn(
        entity_paths.TIMELINE, duration=np.asarray(t_ns, dtype=np.int64).astype("timedelta64[ns]")
    )


class StateChanges:
    """The firmware's state per module, logged when it changes."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def changes(self, batch: Batch) -> tuple[IntArray, list[str]]:
        """Return the times and names of the states that differ from the row before, in the batch's order."""
        states = batch.rows["state"].astype(int)
        before = np.concatenate([[self._last.get(batch.serial, -1)], states[:-1]])
        self._last[batch.serial] = int(states[-1])
        at = np.flatnonzero(states != before)
        # A newer firmware may know more states; show its number rather than lose the rows.
        names = [STATE_NAMES[s] if s < len(STATE_NAMES) else f"state {s}" for s in states[at].tolist()]
        return batch.t_ns[at], names


def send_states(stream: rr.RecordingStream, serial: str, t_ns: IntArray, names: Sequence[str]) -> None:
    """Log changes of a module's state at `t_ns` (m,)."""
    if names:
        path = entity_paths.module_path(serial, entity_paths.STATE)
        stream.send_columns(path, [time_column(t_ns)], rr.StateChange.columns(state=list(names)))


def log_module_styles(stream: rr.RecordingStream, serial: str, colour: entity_paths.Colour) -> None:
    """Log the names and colours of all series of a module, static."""

    def log(path: str, names: Sequence[str], colours: Sequence[entity_paths.Colour], **style: Any) -> None:
        labels = [f"{serial} {name}".strip() for name in names]
        widths = style.pop("widths", [1.5] * len(labels))
        lines = rr.SeriesLines(names=labels, colors=list(colours), widths=widths, **style)
        stream.log(path, lines, static=True)

    for series in (*FAST, *SLOW):
        shades = entity_paths.axis_shades(colour)[: len(series.components)]
        colours = (entity_paths.COMMAND_COLOUR,) if series.components == _COMMAND else shades
        log(entity_paths.module_path(serial, series.group), series.components, colours)
    states = entity_paths.STATE_COLOURS
    style = rr.StateConfiguration(values=list(states), labels=list(states), colors=list(states.values()))
    stream.log(entity_paths.module_path(serial, entity_paths.STATE), style, static=True)
    both = (colour, entity_paths.PREDICTION_COLOUR)
    held_out = entity_paths.residual_path(serial, entity_paths.HELD_OUT)
    log(held_out, ("measured", "predicted"), both, widths=[2.0, 1.5])
    log(entity_paths.residual_path(serial, entity_paths.ERROR), ("",), (colour,), widths=[1.0])
    for group in (entity_paths.ROUND_TRIP, entity_paths.AGE, entity_paths.REFUSALS):
        mode = "stepafter" if group == entity_paths.REFUSALS else "linear"
        log(entity_paths.network_path(serial, group), ("",), (colour,), interpolation_mode=mode)
