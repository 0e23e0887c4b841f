"""Feedback rows as time series: one vector entity per group of sensors, thinned out to what a screen shows.

A chunk of a recording has some 2.6 kB of headers, and a call of `send_columns` costs the same for 25 rows as
for 250, so rows should come in large batches. The recording shows the run; every row is in the MCAP file.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

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
SUPPLY_INTERVAL_NS = 1_000_000_000


class Batch(NamedTuple):
    """Rows of one module: `t_ns` (m,) in session time, `rows` (m,) records of `feedback_rows.ROW`."""

    serial: str
    t_ns: IntArray
    rows: Rows


class Series(NamedTuple):
    """Names a group of sensors in plots: the last part of its entity, its unit and its components."""

    group: str
    unit: str
    components: tuple[str, ...]


# The components are in the order of the columns of `groups`.
SERIES: tuple[Series, ...] = (
    Series(entity_paths.POSITION, "rad", ("",)),
    Series(entity_paths.VELOCITY, "rad/s", ("",)),
    Series(entity_paths.EFFORT, "Nm", ("",)),
    Series(entity_paths.POSITION_COMMAND, "rad", ("command",)),
    Series(entity_paths.VELOCITY_COMMAND, "rad/s", ("command",)),
    Series(entity_paths.EFFORT_COMMAND, "Nm", ("command",)),
    Series(entity_paths.GYRO, "rad/s", ("x", "y", "z")),
    Series(entity_paths.ACCEL, "m/s²", ("x", "y", "z")),
    Series(entity_paths.MOTOR, "1, A", ("PWM", "current")),
    Series(entity_paths.SUPPLY, "V, °C", ("bus voltage", "winding temperature")),
)


_COMMANDS = (
    (entity_paths.POSITION_COMMAND, "position_command_rad"),
    (entity_paths.VELOCITY_COMMAND, "velocity_command_rad_s"),
    (entity_paths.EFFORT_COMMAND, "effort_command_nm"),
)


def groups(rows: Rows) -> Iterator[tuple[str, FloatArray]]:
    """Return the vector entities of m rows, as (group, (m, k)); a command that is never set is left out."""
    yield entity_paths.POSITION, _columns(rows, "position_rad")
    yield entity_paths.VELOCITY, _columns(rows, "velocity_rad_s")
    yield entity_paths.EFFORT, _columns(rows, "effort_nm")
    for group, field in _COMMANDS:
        if not np.isnan(rows[field]).all():
            yield group, _columns(rows, field)
    yield entity_paths.GYRO, rows["gyro_rad_s"].astype(float)
    yield entity_paths.ACCEL, rows["accel_m_s2"].astype(float)
    yield entity_paths.MOTOR, _columns(rows, "pwm", "motor_current_a")


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
    """Log the envelopes of a batch, and one row a second of the slow group."""
    for group, values in groups(batch.rows):
        path = entity_paths.module_path(batch.serial, group)
        send_scalars(stream, path, *envelope(batch.t_ns, values))
    slow = _first_rows(batch.t_ns, SUPPLY_INTERVAL_NS)
    supply = _columns(batch.rows[slow], "voltage_v", "winding_temperature_c")
    send_scalars(
        stream, entity_paths.module_path(batch.serial, entity_paths.SUPPLY), batch.t_ns[slow], supply
    )


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
        return batch.t_ns[at], [_state_name(int(s)) for s in states[at]]


def send_states(stream: rr.RecordingStream, serial: str, t_ns: IntArray, names: Sequence[str]) -> None:
    """Log changes of a module's state at `t_ns` (m,)."""
    if names:
        path = entity_paths.module_path(serial, entity_paths.STATE)
        stream.send_columns(path, [time_column(t_ns)], rr.StateChange.columns(state=list(names)))


def log_module_styles(
    stream: rr.RecordingStream, serial: str, label: str, colour: entity_paths.Colour
) -> None:
    """Log the names and colours of all series of a module, static."""
    for series in SERIES:
        names = [f"{label} {component}".strip() for component in series.components]
        style = rr.SeriesLines(names=names, colors=_colours(series, colour), widths=[1.5] * len(names))
        stream.log(entity_paths.module_path(serial, series.group), style, static=True)
    stream.log(entity_paths.module_path(serial, entity_paths.STATE), _state_style(), static=True)
    _log_residual_styles(stream, serial, label, colour)
    _log_network_styles(stream, serial, label, colour)


def _log_residual_styles(
    stream: rr.RecordingStream, serial: str, label: str, colour: entity_paths.Colour
) -> None:
    held_out = rr.SeriesLines(
        names=[f"{label} measured", f"{label} predicted"],
        colors=[colour, entity_paths.PREDICTION_COLOUR],
        widths=[2.0, 1.5],
    )
    stream.log(entity_paths.residual_path(serial, entity_paths.HELD_OUT), held_out, static=True)
    error = rr.SeriesLines(names=label, colors=[colour], widths=[1.0])
    stream.log(entity_paths.residual_path(serial, entity_paths.ERROR), error, static=True)


def _log_network_styles(
    stream: rr.RecordingStream, serial: str, label: str, colour: entity_paths.Colour
) -> None:
    for group in (entity_paths.ROUND_TRIP, entity_paths.AGE, entity_paths.REFUSALS):
        shape: rr.components.InterpolationModeLike = (
            "stepafter" if group == entity_paths.REFUSALS else "linear"
        )
        style = rr.SeriesLines(names=label, colors=[colour], widths=[1.5], interpolation_mode=shape)
        stream.log(entity_paths.network_path(serial, group), style, static=True)


def _colours(series: Series, colour: entity_paths.Colour) -> list[entity_paths.Colour]:
    if series.components == ("command",):
        return [entity_paths.COMMAND_COLOUR]
    return list(entity_paths.axis_shades(colour)[: len(series.components)])


def _state_style() -> rr.StateConfiguration:
    return rr.StateConfiguration(
        values=list(entity_paths.STATE_COLOURS),
        labels=list(entity_paths.STATE_COLOURS),
        colors=list(entity_paths.STATE_COLOURS.values()),
    )


def _state_name(state: int) -> str:
    # A newer firmware may know more states; show its number rather than lose the rows.
    return STATE_NAMES[state] if state < len(STATE_NAMES) else f"state {state}"


def _columns(rows: Rows, *fields: str) -> FloatArray:
    return np.stack([rows[field] for field in fields], axis=1).astype(float)
