"""Read recordings of joint positions and torques from CSV, npz or MCAP onto a uniform time base.

CSV, a line of names and a line per sample: `t_s`, and per joint `q_<joint>_rad`, `tau_<joint>_nm` and, for
all joints or none, `qd_<joint>_rad_s`; <joint> as in the URDF, columns in any order, others are ignored.

With torque constants, `i_<joint>_a` takes the place of `tau_<joint>_nm`.

npz: `position_rad` (m, n); `torque` or `torque_nm` (m, n); `sample_rate_hz` () or `t_s` (m,); optionally
`velocity_rad_s` (m, n) and `joint_names` (n,), without which the joints are in the URDF's order.

mcap: messages of `sensor_msgs/JointState` (`joint_state`) with position, effort and perhaps velocity.
"""

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple, NoReturn
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import binary_opening

from coordinator.arm_fit.joint_state import joint_states
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError
from module_agent.model.read_only import frozen

# Of a sampling interval; a fiftieth at 0.1 of the sampling rate is 1.3 % of the amplitude, between samples.
_JITTER = 0.02
# Longer gaps than this, in usual intervals, are holes. Up to a quarter of a period of 25 Hz, which arms do
# not reach, they are bridged; at longer ones the recording is split.
_GAP, _BRIDGED_S = 5.0, 0.010
_MAX_REPEATED = 3
# Of a joint that is taken as fixed [rad, m]: a gripper's fingers move by centimetres, and weigh little.
_TRAVEL = 0.05
# Share of positions that stay while another joint moves: the encoder's resolution shows.
_COARSE = 0.3


# What a signal is called where a column has those of all joints.
_FIELDS = {
    ".npz": {"t": "t_s or sample_rate_hz", "q": "position_rad", "qd": "velocity_rad_s", "tau": "torque"},
    ".mcap": {"t": "header.stamp", "q": "position", "qd": "velocity", "tau": "effort"},
}
_NOTHING: Mapping[str, float] = MappingProxyType({})


class DataFileError(UsageError):
    """A recording that cannot be read, or does not fit the robot."""


class JointLog(NamedTuple):
    """A recording of n joints in the order of the robot's chain at m uniform times, read-only.

    rate_hz: sampling rate. q_rad: (m, n) joint positions. qd_rad_s: (m, n) joint velocities, None if they
    were not measured. tau_nm: (m, n) joint torques. resampled: whether the times of the file were not
    uniform. breaks: samples before which there is a hole, or where another recording begins. repeated: rows
    like the one before, left out. bridged: holes of up to 10 ms, interpolated. file: where it was read from.
    others: mean positions of further joints. starts_s: times of the first samples of the pieces, zeros if
    empty.
    """

    rate_hz: float
    q_rad: Array
    qd_rad_s: Array | None
    tau_nm: Array
    resampled: bool = False
    breaks: tuple[int, ...] = ()
    repeated: int = 0
    bridged: int = 0
    file: str = "a recording in memory"
    others: Mapping[str, float] = _NOTHING
    starts_s: tuple[float, ...] = ()

    def column(self, signal: Literal["t", "q", "qd", "tau"], joint: str) -> str:
        """Return the file and the column of a joint's signal, for messages."""
        if (fields := _FIELDS.get(Path(self.file).suffix.lower())) is not None:
            return f"{self.file}: {fields[signal]}" + (f" of {joint}" if signal != "t" else "")
        names = {"t": "t_s", "q": f"q_{joint}_rad", "qd": f"qd_{joint}_rad_s", "tau": f"tau_{joint}_nm"}
        return f"{self.file}: column {names[signal]}"

    @property
    def duration_s(self) -> float:
        """The time that was recorded, without holes [s]."""
        return (len(self.q_rad) - 1 - len(self.breaks)) / self.rate_hz

    def pieces(self) -> tuple["JointLog", ...]:
        """Return the parts between the breaks."""
        ends = (0, *self.breaks, len(self.q_rad))
        starts = self.starts_s if len(self.starts_s) == len(ends) - 1 else (0.0,) * (len(ends) - 1)
        return tuple(
            self._replace(
                q_rad=self.q_rad[a:b],
                qd_rad_s=None if self.qd_rad_s is None else self.qd_rad_s[a:b],
                tau_nm=self.tau_nm[a:b],
                breaks=(),
                starts_s=(start,),
            )
            for (a, b), start in zip(pairwise(ends), starts, strict=True)
        )


class _Table(NamedTuple):
    """The contents of a file: times (m,) [s], signals by name (m, n), and what one of its rows is called."""

    t_s: Array
    signals: dict[str, Array]
    row: Callable[[int], str]
    others: Mapping[str, float] = _NOTHING


def joined(logs: Sequence[JointLog]) -> JointLog:
    """Return recordings of one rate as one, with breaks between them; velocities only if all have them."""
    velocities = [log.qd_rad_s for log in logs if log.qd_rad_s is not None]
    starts = np.cumsum([0, *(len(log.q_rad) for log in logs)])
    breaks = [int(start) + b for start, log in zip(starts, logs, strict=False) for b in (0, *log.breaks)]
    return JointLog(
        logs[0].rate_hz,
        frozen(np.concatenate([log.q_rad for log in logs])),
        frozen(np.concatenate(velocities)) if len(velocities) == len(logs) else None,
        frozen(np.concatenate([log.tau_nm for log in logs])),
        any(log.resampled for log in logs),
        tuple(breaks[1:]),
        sum(log.repeated for log in logs),
        sum(log.bridged for log in logs),
        ", ".join(dict.fromkeys(log.file for log in logs)),
        logs[0].others,
        tuple(start for log in logs for piece in log.pieces() for start in piece.starts_s),
    )


def at_rate(log: JointLog, rate_hz: float) -> JointLog:
    """Return a recording interpolated to another, higher rate."""
    if log.rate_hz == rate_hz:
        return log
    pieces = []
    for piece in log.pieces():
        times = np.arange(len(piece.q_rad)) / log.rate_hz
        even = np.arange(int(times[-1] * rate_hz) + 1) / rate_hz
        q, tau = (_even(times, signal, even) for signal in (piece.q_rad, piece.tau_nm))
        qd = None if piece.qd_rad_s is None else _even(times, piece.qd_rad_s, even)
        pieces.append(JointLog(rate_hz, q, qd, tau, True, starts_s=piece.starts_s))
    return joined(pieces)._replace(
        repeated=log.repeated, bridged=log.bridged, file=log.file, others=log.others
    )


def in_two(log: JointLog) -> tuple[JointLog, JointLog]:
    """Return two recordings of the same motion at the same times with independent noise.

    One is every other sample. The other is interpolated from the rest to the times of the first, which is
    accurate for frequencies well below the sampling rate.
    """
    pairs = [_piece_in_two(piece) for piece in log.pieces()]
    return joined([one for one, _ in pairs]), joined([other for _, other in pairs])


def _piece_in_two(log: JointLog) -> tuple[JointLog, JointLog]:
    count = (len(log.q_rad) - 1) // 2
    odd, even = (np.arange(first, 2 * count + 1, 2) / log.rate_hz for first in (0, 1))

    def half(of: Callable[[Array], Array]) -> JointLog:
        velocity = None if log.qd_rad_s is None else of(log.qd_rad_s)
        starts_s = (log.starts_s[0] + 1.0 / log.rate_hz,)
        return JointLog(
            0.5 * log.rate_hz, of(log.q_rad), velocity, of(log.tau_nm), log.resampled, starts_s=starts_s
        )

    return half(lambda signal: frozen(signal[1 : 2 * count : 2])), half(
        lambda signal: _even(odd, signal[0 : 2 * count + 1 : 2], even)
    )


def read_log(
    path: str | Path,
    joints: Sequence[str],
    gains: Mapping[str, float] = _NOTHING,
    held: Sequence[str] = (),
) -> JointLog:
    """Return the recording in a CSV, npz or MCAP file, (m, n) positions and torques, split at holes.

    CSV: a line of names and a line per sample; `t_s` [s], and per joint `q_<joint>_rad`, `tau_<joint>_nm` and
    optionally `qd_<joint>_rad_s`. npz: `position_rad` (m, n), `torque_nm` (m, n), `t_s` (m,) or
    `sample_rate_hz` (), and optionally `velocity_rad_s` (m, n) and `joint_names` (n,).

    Args:
        path: of the file; its name ends on .csv, .npz or .mcap.
        joints: (n,) names of the joints in the order that the columns shall have, `robot.chain.serials` of
            `read_urdf`.
        gains: torque constants [Nm/A], gear included, of the joints whose currents are in the file instead of
            torques: `i_<joint>_a`, in an npz `current_a` (m, n).
        held: joints whose mean positions are to be read if they are there: `q_<joint>_m` or `q_<joint>_rad`,
            in an npz columns that `joint_names` names.

    Raises:
        DataFileError: another file, columns or arrays that are missing or do not fit the joints, a
            value that is not a finite number, or times that do not increase; the message names
            file, column and row.
        OSError: the file cannot be read.
    """
    path = Path(path)
    readers = {".csv": _read_csv, ".npz": _read_npz, ".mcap": _read_mcap}
    if path.suffix.lower() not in readers:
        raise DataFileError(f"{path}: its name ends on {path.suffix!r}; {', '.join(readers)} are read")
    try:
        return _log(readers[path.suffix.lower()](path, joints, gains, held))._replace(file=str(path))
    except UsageError as error:
        raise DataFileError(f"{path}: {error}") from None


# ---------------------------------------------------------------------- CSV


def _read_csv(path: Path, joints: Sequence[str], gains: Mapping[str, float], held: Sequence[str]) -> _Table:
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            names = _csv_columns(header, joints, gains)
            at = {joint: n for joint in held for n in (f"q_{joint}_m", f"q_{joint}_rad") if n in header}
            numbered = ((reader.line_num, cells) for cells in reader)
            wanted = [*(n for some in names.values() for n in some), *at.values()]
            values, lines = _csv_values(numbered, header, wanted)
        except (csv.Error, UnicodeDecodeError) as error:
            _refuse(f"not a CSV file: {error}")
    count = len(joints)
    signals = {key: values[:, 1 + count * i : 1 + count * (i + 1)] for i, key in enumerate(list(names)[1:])}
    signals["tau"] = signals["tau"] * [gains.get(joint, 1.0) for joint in joints]
    others = values[:, values.shape[1] - len(at) :]
    means = {
        joint: _place_of(joint, own) if len(own) else 0.0 for joint, own in zip(at, others.T, strict=True)
    }
    return _Table(values[:, 0], signals, lambda row: f"line {lines[row]}", means)


def _csv_columns(
    header: Sequence[str], joints: Sequence[str], gains: Mapping[str, float]
) -> dict[str, list[str]]:
    wanted = {
        "t_s": ["t_s"],
        "q": [f"q_{joint}_rad" for joint in joints],
        "tau": [f"i_{joint}_a" if joint in gains else f"tau_{joint}_nm" for joint in joints],
        "qd": [f"qd_{joint}_rad_s" for joint in joints],
    }
    if not any(name in header for name in wanted["qd"]):
        del wanted["qd"]
    missing = [name for names in wanted.values() for name in names if name not in header]
    if missing:
        currents = [joint for joint in joints if joint not in gains and f"i_{joint}_a" in header]
        hint = f"; i_{currents[0]}_a needs --gain {currents[0]}=NM_PER_A" if currents else ""
        _refuse(
            f"line 1: no column {', '.join(missing)}; the columns are {', '.join(header) or 'none'}{hint}"
        )
    twice = [name for names in wanted.values() for name in names if header.count(name) > 1]
    if twice:
        _refuse(f"line 1: column {twice[0]} appears twice")
    return wanted


def _csv_values(
    numbered: Iterable[tuple[int, list[str]]], header: Sequence[str], wanted: Sequence[str]
) -> tuple[Array, list[int]]:
    at = [list(header).index(name) for name in wanted]
    rows: list[list[float]] = []
    lines: list[int] = []
    for line, cells in numbered:
        if not cells:
            continue
        if len(cells) != len(header):
            _refuse(f"line {line}: {len(cells)} cells; the first line names {len(header)} columns")
        rows.append([_number(cells[i], line, header[i]) for i in at])
        lines.append(line)
    return np.array(rows, dtype=float).reshape(len(rows), len(wanted)), lines


def _number(cell: str, line: int, column: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        _refuse(f"line {line}, column {column}: {cell!r}; a finite number is needed")
    return value


# ---------------------------------------------------------------------- npz


def _read_npz(path: Path, joints: Sequence[str], gains: Mapping[str, float], held: Sequence[str]) -> _Table:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
    except (BadZipFile, ValueError, EOFError) as error:
        _refuse(f"not an npz file of plain arrays: {error}")
    names, order = _npz_order(arrays, joints)
    position = _array(arrays, "position_rad", names)
    signals = {"q": position[:, order]}
    torque = "torque_nm" if "torque_nm" in arrays else "torque"
    if len(gains) < len(joints):
        signals["tau"] = _array(arrays, torque, names, len(position))[:, order]
    if gains:
        current = _array(arrays, "current_a", names, len(position))[:, order]
        factors = np.array([gains.get(joint, np.nan) for joint in joints])
        signals["tau"] = np.where(np.isnan(factors), signals.get("tau", current), factors * current)
    if "velocity_rad_s" in arrays:
        signals["qd"] = _array(arrays, "velocity_rad_s", names, len(position))[:, order]
    means = {n: _place_of(n, position[:, i]) for i, n in enumerate(names) if n in held and len(position)}
    return _Table(_npz_times(arrays, len(position)), signals, lambda row: f"row {row}", means)


def _array(arrays: dict[str, NDArray[np.generic]], key: str, joints: Sequence[str], rows: int = -1) -> Array:
    if key not in arrays:
        _refuse(f"no array {key}; its arrays are {', '.join(arrays) or 'none'}")
    array = arrays[key]
    if array.ndim != 2 or array.shape[1] != len(joints) or (rows >= 0 and array.shape[0] != rows):
        _refuse(
            f"{key} has shape {array.shape}; ({rows if rows >= 0 else 'samples'}, {len(joints)}) is needed: "
            f"the joints are {', '.join(joints)}"
        )
    values = _floats(array, key)
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        _refuse(f"{key}, row {row}, column {column}: {values[row, column]}; a finite number is needed")
    return values


def _floats(array: NDArray[np.generic], key: str) -> Array:
    if array.dtype.kind not in "fiu":
        _refuse(f"{key} holds {array.dtype}; real numbers are needed")
    return array.astype(float)


def _npz_times(arrays: dict[str, NDArray[np.generic]], rows: int) -> Array:
    if "t_s" in arrays:
        times = _floats(arrays["t_s"], "t_s")
        if times.shape != (rows,) or not np.isfinite(times).all():
            _refuse(f"t_s has shape {times.shape}; {rows} finite times are needed")
        return times
    if "sample_rate_hz" not in arrays:
        _refuse(f"neither t_s nor sample_rate_hz; its arrays are {', '.join(arrays)}")
    rate = _floats(arrays["sample_rate_hz"], "sample_rate_hz")
    if rate.size != 1 or not 0.0 < float(rate.reshape(())) < np.inf:
        _refuse(f"sample_rate_hz is {rate}; one positive number is needed")
    return np.arange(rows) / float(rate.reshape(()))


def _npz_order(arrays: dict[str, NDArray[np.generic]], joints: Sequence[str]) -> tuple[list[str], list[int]]:
    """Return the names of the file's columns, and where the joints are among them."""
    if "joint_names" not in arrays:
        return list(joints), list(range(len(joints)))
    names = [str(name) for name in arrays["joint_names"].reshape(-1)]
    if not set(joints) <= set(names):
        _refuse(f"joint_names are {', '.join(names)}; the URDF's joints are {', '.join(joints)}")
    return names, [names.index(joint) for joint in joints]


# ---------------------------------------------------------------------- MCAP


def _read_mcap(path: Path, joints: Sequence[str], gains: Mapping[str, float], held: Sequence[str]) -> _Table:
    states = list(joint_states(path))
    names = sorted({name for state in states for name in state.effort.keys() & state.position.keys()})
    if missing := [joint for joint in joints if joint not in names]:
        _refuse(
            f"no JointState with position and effort of {', '.join(missing)}; there are {', '.join(names)}"
        )
    # A gripper's messages may come on a topic of their own.
    whole = [s for s in states if all(joint in s.position and joint in s.effort for joint in joints)]
    signals = {"q": np.array([[state.position[joint] for joint in joints] for state in whole])}
    signals["tau"] = np.array([[s.effort[joint] * gains.get(joint, 1.0) for joint in joints] for s in whole])
    if all(joint in state.velocity for state in whole for joint in joints):
        signals["qd"] = np.array([[state.velocity[joint] for joint in joints] for state in whole])
    for key, values in signals.items():
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            _refuse(
                f"message {row}, {key} of {joints[column]}: {values[row, column]}; a finite number is needed"
            )
    positions = {joint: [s.position[joint] for s in states if joint in s.position] for joint in held}
    means = {joint: _place_of(joint, np.array(own)) for joint, own in positions.items() if own}
    return _Table(np.array([s.t_s for s in whole]), signals, lambda row: f"message {row}", means)


def _place_of(joint: str, position: Array) -> float:
    """Return the mean position [rad, m] of a joint that slides or mimics, and so is taken as fixed."""
    travel = float(np.ptp(position))
    if travel > _TRAVEL:
        _refuse(
            f"joint {joint!r} moves by {travel:.3g} (rad or m), and is taken as fixed, since it slides or "
            "mimics: what it carries would count wrongly; record it at rest, or leave its column out, which "
            "takes it at 0"
        )
    return float(position.mean())


# ---------------------------------------------------------------------- times


def _log(table: _Table) -> JointLog:
    # An identification needs thousands; four are what a spline needs.
    if table.t_s.size < 4:
        _refuse(f"{table.t_s.size} samples are no recording; at least 4 are needed")
    table, repeated = _without_repeated(table)
    times = table.t_s
    steps = np.diff(times)
    if (steps <= 0.0).any():
        row = int(np.argmax(steps <= 0.0)) + 1
        _refuse(f"{table.row(row)}: its time {times[row]} s is not after that of the sample before it")
    usual = float(np.median(steps))
    holes = np.flatnonzero(steps > _GAP * usual)
    split = holes[steps[holes] > max(_BRIDGED_S, _GAP * usual)]
    ends = (0, *(split + 1).tolist(), times.size)
    parts = [slice(a, b) for a, b in pairwise(ends) if b - a >= 4]
    if not parts:
        _refuse(f"{len(ends) - 2} holes in {times.size} samples leave no 4 in a row")
    spans = np.array([times[part.stop - 1] - times[part.start] for part in parts])
    rate_hz = float(np.round(spans / usual).sum() / spans.sum())
    log = joined([_uniform(table, part, rate_hz) for part in parts])
    return log._replace(repeated=repeated, bridged=len(holes) - len(split), others=table.others)


def _without_repeated(table: _Table) -> tuple[_Table, int]:
    """Leave out rows that repeat the one before, up to three in a row (more are a rest); return how many.

    A logger that is faster than its source writes a reading again in the place of the next: the step after
    it is twice as long, and the other rows keep their times. If that step is a usual one, rows were inserted;
    the others move up if the times went on. (Where an encoder's resolution makes steps alike, they do not.)
    """
    values = np.column_stack(list(table.signals.values()))
    same = np.concatenate([[False], (np.diff(values, axis=0) == 0.0).all(axis=1)])
    repeated = same & ~binary_opening(same, np.ones(_MAX_REPEATED + 1))
    kept = np.flatnonzero(~repeated)
    times, last = table.t_s[kept], np.flatnonzero(repeated[:-2] & ~same[1:-1])
    after, usual = (
        np.abs(table.signals["q"][last + k] - table.signals["q"][last + k - 1]).sum() for k in (1, 2)
    )
    stays = np.diff(table.signals["q"][kept], axis=0) == 0.0
    coarse = np.mean(stays[~stays.all(axis=1)]) > _COARSE if not stays.all() else True
    if not coarse and after < 1.5 * usual and (table.t_s[last] > table.t_s[last - 1]).all():
        times = table.t_s[: kept.size]
    signals = {key: signal[kept] for key, signal in table.signals.items()}
    return table._replace(t_s=times, signals=signals, row=lambda row: table.row(int(kept[row]))), int(
        repeated.sum()
    )


def _uniform(table: _Table, part: slice, rate_hz: float) -> JointLog:
    times = table.t_s[part] - table.t_s[part.start]
    even = np.arange(round(float(times[-1]) * rate_hz) + 1) / rate_hz
    uneven = even.size != times.size or bool(np.abs(times - even).max() > _JITTER / rate_hz)
    signals = {
        key: _even(times, values[part], even) if uneven else values[part]
        for key, values in table.signals.items()
    }
    # A curve through the noise on either side of a hole would swing out in it.
    after = np.clip(np.searchsorted(times, even), 1, times.size - 1)
    hole = np.diff(times)[after - 1] > _GAP / rate_hz
    for key in signals.keys() & {"tau", "qd"} if hole.any() else ():
        straight = make_interp_spline(times, table.signals[key][part], k=1)
        signals[key] = np.where(hole[:, None], straight(np.minimum(even, times[-1])), signals[key])
    start_s = float(table.t_s[part.start])
    return JointLog(rate_hz, signals["q"], signals.get("qd"), signals["tau"], uneven, starts_s=(start_s,))


def _even(times: Array, values: Array, even: Array) -> Array:
    """Interpolate (m, n) to even times from the first sample to the last."""
    return np.asarray(make_interp_spline(times, values, k=3)(np.clip(even, times[0], times[-1])))


def _refuse(text: str) -> NoReturn:
    raise DataFileError(text)
