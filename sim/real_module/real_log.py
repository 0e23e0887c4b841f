"""Logs of real modules: CSV with one row per feedback sample and units in the column names, or .hebilog."""

import csv
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from module_agent.hardware.hebi_log import read_tables
from module_agent.model.errors import UsageError
from module_agent.model.read_only import read_only
from sim.geometry.pose import Array


class LogFileError(UsageError):
    """A log file is invalid; the message names file, line and column."""


class RealLog(NamedTuple):
    """Feedback of one module, arrays (k,), read-only; a command that was not set is NaN.

    `pwm` is the duty of the bus voltage that the bridge applied, in [-1, 1]. Other columns of the file are
    ignored.
    """

    t_s: Array
    position_rad: Array
    velocity_rad_s: Array
    effort_nm: Array
    position_command_rad: Array
    velocity_command_rad_s: Array
    effort_command_nm: Array
    winding_current_a: Array
    winding_temperature_c: Array
    voltage_v: Array
    pwm: Array


_COLUMNS = {
    "winding_current_a": "motor_winding_current_a",
    "winding_temperature_c": "motor_winding_temperature_c",
    "pwm": "pwm_command",
}
_MAY_BE_UNSET = frozenset({"position_command_rad", "velocity_command_rad_s", "effort_command_nm"})
# The same in HEBI's feedback, but for the time.
_HEBI = {
    "position_rad": "position",
    "velocity_rad_s": "velocity",
    "effort_nm": "effort",
    "position_command_rad": "position_command",
    "velocity_command_rad_s": "velocity_command",
    "effort_command_nm": "effort_command",
    "winding_current_a": "motor_winding_current",
    "winding_temperature_c": "motor_winding_temperature",
    "voltage_v": "voltage",
    "pwm": "pwm_command",
}


def read_log(path: Path) -> RealLog:
    """Read a log.

    Raises:
        LogFileError: a column is missing, a value is no number, or times do not grow; the message names the
        file, the line and the column.
        OSError: the file cannot be read.
    """
    with path.open(newline="", encoding="utf-8") as file:
        try:
            return _parse(list(csv.reader(file)), str(path))
        except (UnicodeDecodeError, csv.Error) as error:
            raise LogFileError(f"{path}: not a CSV text file: {error}") from error


def read_hebilog(path: Path, module: int, load: Callable[[str], Any]) -> RealLog:
    """Read one module's part of a log that HEBI's programs wrote.

    Feedback that the module sent once and the log has twice is taken once.

    Args:
        path: the log.
        module: its place in the group, from 1 on.
        load: `hebi.util.load_log`, or what stands in for it: iterates over feedback by `feedback_iterate`.

    Raises:
        HebiLogError: it is no log, has no such module, or has fewer than two samples.
        LogFileError: it lacks a reading.
    """
    (table,) = read_tables(path, list(_HEBI.values()), load, module)
    table[:, 0] = 1e-6 * (table[:, 0] - table[0, 0])
    for field, values in zip(_HEBI, table[:, 1:].T, strict=True):
        unset = np.flatnonzero(np.isnan(values))
        if unset.size and field not in _MAY_BE_UNSET:
            raise LogFileError(
                f"{path}: sample {unset[0] + 1}: {_HEBI[field]}: is not set; only commands may be"
            )
    values = dict(zip(("t_s", *_HEBI), map(read_only, table.T), strict=True))
    return RealLog(**values)


def _parse(rows: list[list[str]], name: str) -> RealLog:
    header = rows[0] if rows else []
    columns = [_COLUMNS.get(field, field) for field in RealLog._fields]
    if missing := [column for column in columns if column not in header]:
        raise LogFileError(f"{name}:1: columns missing: {', '.join(missing)}")
    if len(rows) < 3:
        raise LogFileError(f"{name}: {len(rows) - 1} rows of data; at least 2 are needed")
    for line, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise LogFileError(f"{name}:{line}: {len(row)} values for {len(header)} columns")
    places = [header.index(column) for column in columns]
    values = {f: _column(rows, place, f, name) for f, place in zip(RealLog._fields, places, strict=True)}
    late = np.flatnonzero(np.diff(values["t_s"]) <= 0.0)
    if late.size:
        raise LogFileError(f"{name}:{late[0] + 3}: t_s: times must grow from row to row")
    return RealLog(**values)


def _column(rows: list[list[str]], place: int, field: str, name: str) -> Array:
    column = rows[0][place]
    numbers = [_number(row[place], f"{name}:{line}: {column}") for line, row in enumerate(rows[1:], 2)]
    values = np.array(numbers)
    unset = np.flatnonzero(np.isnan(values))
    if unset.size and field not in _MAY_BE_UNSET:
        raise LogFileError(f"{name}:{unset[0] + 2}: {column}: is not set; only commands may be")
    return read_only(values)


def _number(text: str, where: str) -> float:
    try:
        value = float(text) if text.strip() else math.nan
    except ValueError as error:
        raise LogFileError(f"{where}: {text!r} is no number") from error
    if math.isinf(value):
        raise LogFileError(f"{where}: {text!r} is not finite")
    return value
