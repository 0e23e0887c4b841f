"""Feedback rows into columns of time series, one vector entity per group of sensors.

A call of `send_columns` costs the same for 25 rows as for 250, so rows should come in large batches.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from coordinator.viewer import layout
from module_agent.wire.feedback_rows import STATE_NAMES, Rows

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]


class Batch(NamedTuple):
    """Rows of one module: `t_ns` (m,) in session time, `rows` (m,) records of `feedback_rows.ROW`."""

    serial: str
    t_ns: IntArray
    rows: Rows


class Series(NamedTuple):
    """What a group of sensors is called in plots: its entity's last part, its unit and its components."""

    group: str
    unit: str
    components: tuple[str, ...]


# The components are in the order of the columns of `groups`.
SERIES: tuple[Series, ...] = (
    Series(layout.POSITION, "rad", ("",)),
    Series(layout.VELOCITY, "rad/s", ("",)),
    Series(layout.EFFORT, "Nm", ("",)),
    Series(layout.POSITION_COMMAND, "rad", ("command",)),
    Series(layout.VELOCITY_COMMAND, "rad/s", ("command",)),
    Series(layout.EFFORT_COMMAND, "Nm", ("command",)),
    Series(layout.GYRO, "rad/s", ("x", "y", "z")),
    Series(layout.ACCEL, "m/s²", ("x", "y", "z")),
    Series(layout.MOTOR, "1, A", ("PWM", "current")),
    Series(layout.SUPPLY, "V, °C", ("bus voltage", "winding temperature")),
)


_COMMANDS = (
    (layout.POSITION_COMMAND, "position_command_rad"),
    (layout.VELOCITY_COMMAND, "velocity_command_rad_s"),
    (layout.EFFORT_COMMAND, "effort_command_nm"),
)


def groups(rows: Rows) -> Iterator[tuple[str, FloatArray]]:
    """Return the vector entities of m rows, as (group, (m, k)); a command that is nowhere set is left out."""
    yield layout.POSITION, _columns(rows, "position_rad")
    yield layout.VELOCITY, _columns(rows, "velocity_rad_s")
    yield layout.EFFORT, _columns(rows, "effort_nm")
    for group, field in _COMMANDS:
        if not np.isnan(rows[field]).all():
            yield group, _columns(rows, field)
    yield layout.GYRO, rows["gyro_rad_s"].astype(float)
    yield layout.ACCEL, rows["accel_m_s2"].astype(float)
    yield layout.MOTOR, _columns(rows, "pwm", "motor_current_a")


def send_rows(stream: rr.RecordingStream, batch: Batch) -> None:
    """Log a batch: every row of the fast groups, the last row of the slow one."""
    for group, values in groups(batch.rows):
        send_scalars(stream, layout.module_path(batch.serial, group), batch.t_ns, values)
    # Voltage and temperature change over seconds: one value per batch.
    supply = _columns(batch.rows[-1:], "voltage_v", "winding_temperature_c")
    send_scalars(stream, layout.module_path(batch.serial, layout.SUPPLY), batch.t_ns[-1:], supply)


def send_scalars(stream: rr.RecordingStream, path: str, t_ns: IntArray, values: FloatArray) -> None:
    """Log `values` (m, k) at `t_ns` (m,) as one entity of k series."""
    stream.send_columns(path, [time_column(t_ns)], rr.Scalars.columns(scalars=values))


def time_column(t_ns: IntArray) -> rr.TimeColumn:
    """Return the session time as integer nanoseconds; as float seconds rows would be misaligned by 1 ns."""
    return rr.TimeColumn(layout.TIMELINE, duration=np.asarray(t_ns, dtype=np.int64).astype("timedelta64[ns]"))


class StateChanges:
    """The firmware's state per module, logged when it changes."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def of(self, batch: Batch) -> tuple[IntArray, list[str]]:
        """Return the times and names of the states that differ from the row before, in the batch's order."""
        states = batch.rows["state"].astype(int)
        before = np.concatenate([[self._last.get(batch.serial, -1)], states[:-1]])
        self._last[batch.serial] = int(states[-1])
        at = np.flatnonzero(states != before)
        return batch.t_ns[at], [_state_name(int(s)) for s in states[at]]


def send_states(stream: rr.RecordingStream, serial: str, t_ns: IntArray, names: Sequence[str]) -> None:
    """Log changes of a module's state at `t_ns` (m,)."""
    if names:
        path = layout.module_path(serial, layout.STATE)
        stream.send_columns(path, [time_column(t_ns)], rr.StateChange.columns(state=list(names)))


def log_module_styles(stream: rr.RecordingStream, serial: str, label: str, colour: layout.Colour) -> None:
    """Log the names and colours of all series of a module, static."""
    for series in SERIES:
        names = [f"{label} {component}".strip() for component in series.components]
        style = rr.SeriesLines(names=names, colors=_colours(series, colour), widths=[1.5] * len(names))
        stream.log(layout.module_path(serial, series.group), style, static=True)
    stream.log(layout.module_path(serial, layout.STATE), _state_style(), static=True)
    _log_residual_styles(stream, serial, label, colour)
    _log_network_styles(stream, serial, label, colour)


def _log_residual_styles(stream: rr.RecordingStream, serial: str, label: str, colour: layout.Colour) -> None:
    held_out = rr.SeriesLines(
        names=[f"{label} measured", f"{label} predicted"],
        colors=[colour, layout.PREDICTION_COLOUR],
        widths=[2.0, 1.5],
    )
    stream.log(layout.residual_path(serial, layout.HELD_OUT), held_out, static=True)
    error = rr.SeriesLines(names=label, colors=[colour], widths=[1.0])
    stream.log(layout.residual_path(serial, layout.ERROR), error, static=True)


def _log_network_styles(stream: rr.RecordingStream, serial: str, label: str, colour: layout.Colour) -> None:
    for group in (layout.ROUND_TRIP, layout.AGE, layout.REFUSALS):
        shape: rr.components.InterpolationModeLike = "stepafter" if group == layout.REFUSALS else "linear"
        style = rr.SeriesLines(names=label, colors=[colour], widths=[1.5], interpolation_mode=shape)
        stream.log(layout.network_path(serial, group), style, static=True)


def _colours(series: Series, colour: layout.Colour) -> list[layout.Colour]:
    if series.components == ("command",):
        return [layout.COMMAND_COLOUR]
    return list(layout.axis_shades(colour)[: len(series.components)])


def _state_style() -> rr.StateConfiguration:
    return rr.StateConfiguration(
        values=list(layout.STATE_COLOURS),
        labels=list(layout.STATE_COLOURS),
        colors=list(layout.STATE_COLOURS.values()),
    )


def _state_name(state: int) -> str:
    # A newer firmware may know more states; show its number rather than lose the rows.
    return STATE_NAMES[state] if state < len(STATE_NAMES) else f"state {state}"


def _columns(rows: Rows, *fields: str) -> FloatArray:
    return np.stack([rows[field] for field in fields], axis=1).astype(float)
