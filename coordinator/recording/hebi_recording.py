"""Makes a recording of a log that HEBI's programs wrote, so that a robot is identified from it.

A log has what every module measured, and for each answer of a module three times: when the computer sent
the request and received the answer, and when the module sent it by its own clock. That is a round trip (see
`synchronisation.round_trips`). It does not say which motion was commanded for what purpose. A motion of all
joints at once needs no such words: it is looked for here, with the rest before it. What joints do one after
the other is not enough, since the modules' own estimates of each other's motions are missing from a log.
"""

from collections.abc import Callable, Iterator, Sequence
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.recording.journal import JournalEvent, Purpose
from coordinator.recording.recording import JOURNAL_TOPIC, Entry
from module_agent.control.gains import default_gains
from module_agent.hardware.hebi_log import HebiLogError, read_tables
from module_agent.model.catalogue import GRAVITY_M_S2, ImuKind, TorqueKind, module_type
from module_agent.wire.codec import encode
from module_agent.wire.feedback_rows import ROW, STATE_NAMES, Rows
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import (
    MAX_ROWS_PER_MOTION,
    Ask,
    Feedback,
    Info,
    Limits,
    MotionRecord,
    OtherMotion,
    Status,
)

BOOT = 1
# A joint stands still if it turns more slowly than this over so long: it sags and is held, but does not move.
STILL_RAD_S, OVER_S = 0.02, 0.4
# Both: shorter rests do not average the gyros' noise, and shorter stops are turning points.
MIN_REST_S = 1.0
MAX_REST_S = 20.0
# Every joint must turn by this much, for its axis to show.
MIN_TRAVEL_RAD = 0.05
GRID_S = 0.02
# At rest an accelerometer reads gravity within this, unless the module subtracts it.
GRAVITY_WITHIN = 0.1
BATCH_ROWS = 20
TRIP_EVERY_S = 0.1

_TIMES = ("transmit_time_us", "receive_time_us")
# Rows' fields as hebi-py names them; the first line must be set.
_NEEDED = {"position_rad": "position", "velocity_rad_s": "velocity", "effort_nm": "effort"}
_COMMANDS = {
    "position_command_rad": "position_command",
    "velocity_command_rad_s": "velocity_command",
    "effort_command_nm": "effort_command",
}
_OTHERS = {
    "pwm": "pwm_command",
    "deflection_rad": "deflection",
    "motor_velocity_rad_s": "motor_velocity",
    "motor_current_a": "motor_winding_current",
    "winding_temperature_c": "motor_winding_temperature",
    "voltage_v": "voltage",
}
_IMU = {"gyro_rad_s": "gyro", "accel_m_s2": "accelerometer"}


class LoggedModule(NamedTuple):
    """What the log does not say of a module: its name here, which stands for its serial, and its type."""

    name: str
    kind: str


class _Track(NamedTuple):
    """A module's rows (m,), and the session times at which each was asked for and received [ns]."""

    module: LoggedModule
    rows: Rows
    sent_ns: NDArray[np.int64]
    received_ns: NDArray[np.int64]

    def between(self, start_ns: int, end_ns: int) -> tuple[int, int]:
        """Return the first row received in a span, and one past the last."""
        first, end = np.searchsorted(self.received_ns, (start_ns, end_ns))
        return int(first), int(end)


def recorded_log(
    path: Path,
    robot: str,
    modules: Sequence[LoggedModule],
    load: Callable[[str], Any],
    priors: tuple[ImuKind, TorqueKind] = ("uncalibrated", "uncalibrated"),
) -> Iterator[Entry]:
    """Return the entries of a recording of the log, in the order of their times.

    Args:
        path: the log.
        robot: what the robot is called from now on.
        modules: of the group, in its order.
        load: `hebi.util.load_log`.
        priors: what is known of the IMUs' and of the torque sensors' errors.

    Raises:
        HebiLogError: it is no log of so many modules, or does not hold enough: a reading was not set, the
            accelerometers leave gravity out, no motion of all joints follows a rest.
        UnknownModuleType: the catalogue does not have a type.
    """
    tracks = _tracks(path, modules, load)
    rest_ns, motion_ns = _rest_and_motion(path, tracks)
    _check_gravity(path, tracks, rest_ns)
    session = JournalEvent(t_ns=0, what="session", robot=robot, imu=priors[0], torque=priors[1])
    journal = [
        session,
        *(_event(track, 1, "rest", *rest_ns) for track in tracks),
        *(_event(track, 2, "whole", *motion_ns) for track in tracks),
    ]
    last_ns = max(int(track.received_ns[-1]) for track in tracks)
    journal.append(JournalEvent(t_ns=last_ns, what="finished"))
    in_order = sorted(journal, key=lambda event: event.t_ns)
    events = (Entry("journal", JOURNAL_TOPIC, event.t_ns, event.encode()) for event in in_order)
    streams = [_messages(robot, track) for track in tracks]
    return merge(events, *streams, key=lambda entry: entry.t_ns)


def _tracks(path: Path, modules: Sequence[LoggedModule], load: Callable[[str], Any]) -> list[_Track]:
    names = (*_TIMES, *_IMU.values(), *_NEEDED.values(), *_COMMANDS.values(), *_OTHERS.values())
    tables = read_tables(path, names, load)
    if len(tables) != len(modules):
        raise HebiLogError(f"{path}: it has {len(tables)} modules, {len(modules)} are named")
    origin_us = min(float(table[0, 1]) for table in tables)
    return [_track(path, *pair, origin_us) for pair in zip(modules, tables, strict=True)]


def _track(path: Path, module: LoggedModule, table: NDArray[np.float64], origin_us: float) -> _Track:
    clock_us, sent_us, received_us, rest = *table[:, :3].T, table[:, 3:]
    rows = np.zeros(len(table), ROW)
    rows["t_ns"] = 1000 * clock_us.astype(np.int64)
    rows["state"] = STATE_NAMES.index("armed")
    for place, field in enumerate(_IMU):
        rows[field] = rest[:, 3 * place : 3 * place + 3]
    # It does not tell when the IMU was read: that is dated by the first feedback with its values.
    fresh = np.r_[True, np.any(np.diff(rest[:, :6], axis=0) != 0.0, axis=1)]
    rows["imu_t_ns"] = rows["t_ns"][np.maximum.accumulate(np.where(fresh, np.arange(len(rows)), 0))]
    for field, values in zip((*_NEEDED, *_COMMANDS, *_OTHERS), rest[:, 6:].T, strict=True):
        rows[field] = values
    needed = np.column_stack([sent_us, received_us, rest[:, : 6 + len(_NEEDED)]])
    if not np.isfinite(needed).all():
        sample, column = np.argwhere(~np.isfinite(needed))[0]
        name = [*_TIMES, *(name for name in _IMU.values() for _ in "xyz"), *_NEEDED.values()][column]
        raise HebiLogError(f"{path}: sample {sample + 1} of {module.name}: {name} is not set")
    for field in _OTHERS:
        rows[field] = np.nan_to_num(rows[field])
    times = (np.rint(1e3 * (t_us - origin_us)).astype(np.int64) for t_us in (sent_us, received_us))
    return _Track(module, rows, *times)


# ------------------------------------------------------------------ which part of it is used


def _rest_and_motion(path: Path, tracks: Sequence[_Track]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the spans in session time of the best motion of all joints and of the rest before it."""
    start_ns = max(int(track.received_ns[0]) for track in tracks)
    end_ns = min(int(track.received_ns[-1]) for track in tracks)
    t_ns = np.arange(start_ns, end_ns, round(1e9 * GRID_S))
    q_rad = np.array([np.interp(t_ns, track.received_ns, track.rows["position_rad"]) for track in tracks])
    over = round(OVER_S / GRID_S)
    if len(t_ns) <= over:
        raise HebiLogError(f"{path}: {1e-9 * (end_ns - start_ns):.1f} s are too short to see motion in it")
    turned = np.abs(q_rad[:, over:] - q_rad[:, :-over]) > STILL_RAD_S * OVER_S
    moves = np.zeros(len(t_ns), bool)
    for shift in (0, over):
        moves[shift : shift + turned.shape[1]] |= turned.any(axis=0)
    best: tuple[float, int, int, int] | None = None
    rested = 0
    for first, end in _runs(moves, round(MIN_REST_S / GRID_S)):
        travel_rad = float(np.ptp(q_rad[:, first:end], axis=1).min())
        if first - rested >= round(MIN_REST_S / GRID_S) and (best is None or travel_rad > best[0]):
            best = travel_rad, rested, first, end
        rested = end
    if best is None:
        raise HebiLogError(
            f"{path}: no motion follows a rest of {MIN_REST_S:g} s of all modules: let them stand still first"
        )
    travel_rad, rested, first, end = best
    if travel_rad < MIN_TRAVEL_RAD:
        least = tracks[int(np.argmin(np.ptp(q_rad[:, first:end], axis=1)))].module.name
        raise HebiLogError(
            f"{path}: {least} turns by {travel_rad:.3f} rad in the best motion, from "
            f"{1e-9 * t_ns[first]:.1f} to {1e-9 * t_ns[end - 1]:.1f} s; all joints must turn at once, by "
            f"{MIN_TRAVEL_RAD:g} rad at least"
        )
    rested = max(rested, first - round(MAX_REST_S / GRID_S))
    return (int(t_ns[rested]), int(t_ns[first])), (int(t_ns[first]), int(t_ns[end - 1]))


def _runs(moves: NDArray[np.bool_], bridged: int) -> list[tuple[int, int]]:
    """Return first and end of every stretch of motion; shorter stops than `bridged` are part of it."""
    edges = np.flatnonzero(np.diff(moves.astype(np.int8), prepend=0, append=0))
    runs: list[tuple[int, int]] = []
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if runs and first - runs[-1][1] < bridged:
            runs[-1] = runs[-1][0], end
        else:
            runs.append((first, end))
    return runs


def _check_gravity(path: Path, tracks: Sequence[_Track], rest_ns: tuple[int, int]) -> None:
    for track in tracks:
        first, end = track.between(*rest_ns)
        force = float(np.linalg.norm(track.rows["accel_m_s2"][first:end].mean(axis=0)))
        if abs(force - GRAVITY_M_S2) > GRAVITY_WITHIN * GRAVITY_M_S2:
            raise HebiLogError(
                f"{path}: the accelerometer of {track.module.name} reads {force:.2f} m/s^2 at rest, "
                f"{GRAVITY_M_S2:.2f} are expected: switch its accel_includes_gravity on, and log again"
            )


# ------------------------------------------------------------------ messages


def _event(track: _Track, number: int, purpose: Purpose, start_ns: int, end_ns: int) -> JournalEvent:
    first, end = track.between(start_ns, end_ns)
    end = min(end, first + MAX_ROWS_PER_MOTION)
    motion = MotionRecord(
        motion_id=number,
        pattern=OtherMotion(),
        outcome="done",
        start_ns=int(track.rows["t_ns"][first]),
        start_row=first,
        end_row=end,
        origin_rad=float(track.rows["position_rad"][first]),
    )
    name = track.module.name
    t_ns = int(track.received_ns[end - 1])
    return JournalEvent(
        t_ns=t_ns, what="motion", step=purpose, serial=name, boot=BOOT, purpose=purpose, motion=motion
    )


def _messages(robot: str, track: _Track) -> Iterator[Entry]:
    name, rows = track.module.name, track.rows
    head: dict[str, Any] = {"serial": name, "boot": BOOT}
    yield Entry("reply", key(robot, name, Leaf.INFO), int(track.received_ns[0]), encode(_info(head, track)))
    period_s = 1e-9 * float(np.median(np.diff(rows["t_ns"])))
    every = max(1, round(TRIP_EVERY_S / period_s / BATCH_ROWS))
    feedback, status = key(robot, name, Leaf.FEEDBACK), key(robot, name, Leaf.STATUS)
    for batch, first in enumerate(range(0, len(rows), BATCH_ROWS)):
        end = min(first + BATCH_ROWS, len(rows))
        sent_ns, received_ns = int(track.sent_ns[end - 1]), int(track.received_ns[end - 1])
        if batch % every == 0:
            question = Ask(**head, seq=batch, sender=robot)
            yield Entry("request", status, sent_ns, encode(question))
            answer = _status(head, batch, int(rows["t_ns"][end - 1]), end)
            yield Entry("reply", status, received_ns, encode(answer))
        block = rows[first:end].tobytes()
        message = Feedback(**head, seq=batch, first_row=first, count=end - first, rows=block)
        yield Entry("publication", feedback, received_ns, encode(message))


def _status(head: dict[str, Any], number: int, t_ns: int, next_row: int) -> Status:
    return Status(
        **head,
        seq=number,
        re=number,
        t_ns=t_ns,
        state="armed",
        holder=None,
        lease_left_ns=0,
        token=0,
        next_row=next_row,
        motion=None,
        refusals={},
        expiries=0,
        dropped_events=0,
    )


def _info(head: dict[str, Any], track: _Track) -> Info:
    kind = module_type(track.module.kind)
    period_ns = int(np.median(np.diff(track.rows["t_ns"])))
    low, high = kind.range_rad or (None, None)
    limits = Limits(
        max_speed_rad_s=kind.max_speed_rad_s,
        max_effort_nm=kind.max_effort_nm,
        min_position_rad=low,
        max_position_rad=high,
    )
    return Info(
        **head,
        seq=0,
        module_type=kind.name,
        firmware="a log of HEBI's programs",
        feedback_rate_hz=1e9 / period_ns,
        batch_rows=BATCH_ROWS,
        history_rows=0,
        tick_ns=period_ns,
        imu_period_ns=int(np.median(np.diff(np.unique(track.rows["imu_t_ns"])))),
        lifetime_ns=0,
        expiry_action="hold",
        limits=limits,
        gains=default_gains(kind, 3),
        t_ns=int(track.rows["t_ns"][0]),
        name=track.module.name,
    )
