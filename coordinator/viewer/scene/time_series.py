"""Feedback rows into columns of time series, one vector entity per group of sensors.

A call of `send_columns` costs the same for 25 rows as for 250, so rows should come in large batches.
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
    """Return the vector entities of m rows, as (group, (m, k)); a command that is nowhere set is left out."""
    yield entity_paths.POSITION, _columns(rows, "position_rad")
    yield entity_paths.VELOCITY, _columns(rows, "velocity_rad_s")
    yield entity_paths.EFFORT, _columns(rows, "effort_nm")
    for group, field in _COMMANDS:
        if not np.isnan(rows[field]).all():
            yield group, _columns(rows, field)
    yield entity_paths.GYRO, rows["gyro_rad_s"].astype(float)
    yield entity_paths.ACCEL, rows["accel_m_s2"].astype(float)
    yield entity_paths.MOTOR, _columns(rows, "pwm", "motor_current_a")


def send_rows(stream: rr.RecordingStream, batch: Batch) -> None:
    """Log a batch: every row of the fast groups, the last row of the slow one."""
    for group, values in groups(batch.rows):
        send_scalars(stream, entity_paths.module_path(batch.serial, group), batch.t_ns, values)
    # Voltage and temperature change over seconds: one value per batch.
    supply = _columns(batch.rows[-1:], "voltage_v", "winding_temperature_c")
    send_scalars(stream, entity_paths.module_path(batch.serial, entity_paths.SUPPLY), batch.t_ns[-1:], supply)


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
