"""Sicknesses of sensors, clocks and messages: a session of a healthy robot as it would have been recorded.

Every alteration takes the entries of a session, the serials of the modules that are ill, and the number of
the row in the middle of a fast motion of one of them; it returns the altered entries.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from coordinator.recording.recording import Entry
from module_agent.wire.codec import decode, encode
from module_agent.wire.feedback_rows import ROW, Rows
from module_agent.wire.keys import Leaf, parse
from module_agent.wire.messages import Ack, Feedback, Info, Status
from module_agent.wire.topics import TOPICS

Alteration = Callable[[list[Entry], tuple[str, ...], int], list[Entry]]
# Changes the rows of one message in place, given the number of the first and that of the middle.
Change = Callable[[Rows, int, int], None]

# A type whose IMU is 55 mm away from that of the module's own.
OTHER_TYPE = "X5-9-old"
# Rows that are lost in one piece: an eighth of a second. Rows before and after the middle of a burst.
LOST_ROWS, BURST_ROWS = 32, 250
POSITION = ("position_rad", "velocity_rad_s")
COMMANDS = ("position_command_rad", "velocity_command_rad_s")


def _is_module(entry: Entry, ill: Sequence[str], *leaves: Leaf) -> bool:
    """Return whether a module that is ill has sent an entry, and of these kinds if any are given."""
    if entry.kind in ("journal", "request"):
        return False
    key = parse(entry.topic)
    return key.serial in ill and (not leaves or key.leaf in leaves)


def sent_rows(entry: Entry) -> tuple[Feedback, Rows]:
    """Return a feedback message and a copy of its rows."""
    message = decode(Feedback, entry.payload)
    return message, np.frombuffer(message.rows, ROW).copy()


def with_rows(change: Change, entries: list[Entry], ill: tuple[str, ...], middle: int) -> list[Entry]:
    """Change the rows of all messages of the modules that are ill."""
    altered = []
    for entry in entries:
        if _is_module(entry, ill, Leaf.FEEDBACK, Leaf.HISTORY):
            message, rows = sent_rows(entry)
            change(rows, message.first_row, middle)
            entry = entry._replace(payload=encode(message.model_copy(update={"rows": rows.tobytes()})))
        altered.append(entry)
    return altered


def multiplied(fields: Sequence[str], factor: float) -> Alteration:
    """Multiply some fields by a factor."""

    def change(rows: Rows, first: int, middle: int) -> None:
        for field in fields:
            rows[field] *= factor

    return partial(with_rows, change)


def dead(field: str, axes: Sequence[int] = (0, 1, 2)) -> Alteration:
    """Set axes of an IMU to zero."""

    def change(rows: Rows, first: int, middle: int) -> None:
        rows[field][:, list(axes)] = 0.0

    return partial(with_rows, change)


def stuck(*fields: str) -> Alteration:
    """Hold what is read from the middle on."""

    def altered(entries: list[Entry], ill: tuple[str, ...], middle: int) -> list[Entry]:
        held: dict[str, Rows] = {}

        def change(rows: Rows, first: int, middle: int) -> None:
            later = first + np.arange(len(rows)) >= middle
            for field in fields:
                if later.any():
                    rows[field][later] = held.setdefault(field, rows[field][later][0].copy())

        return with_rows(change, entries, ill, middle)

    return altered


def saturated(field: str, share: float) -> Alteration:
    """Clip axes of an IMU at a share of their largest reading in the session."""

    def altered(entries: list[Entry], ill: tuple[str, ...], middle: int) -> list[Entry]:
        own = [sent_rows(e)[1][field] for e in entries if _is_module(e, ill, Leaf.FEEDBACK)]
        end = share * float(np.abs(np.concatenate(own)).max())

        def change(rows: Rows, first: int, middle: int) -> None:
            np.clip(rows[field], -end, end, out=rows[field])

        return with_rows(change, entries, ill, middle)

    return altered


def jumped(field: str, by: float) -> Alteration:
    """Add an offset from the middle on."""

    def change(rows: Rows, first: int, middle: int) -> None:
        rows[field][first + np.arange(len(rows)) >= middle] += by

    return partial(with_rows, change)


def not_a_number(field: str) -> Alteration:
    """Make every tenth message of a burst about the middle unreadable by a value that is no number."""

    def change(rows: Rows, first: int, middle: int) -> None:
        if abs(first - middle) < BURST_ROWS and first % 10 == 0:
            rows[field][0] = np.nan

    return partial(with_rows, change)


def leaping_clock(by_ns: int) -> Alteration:
    """Let a module's clock leap in the middle, in its rows and in all its answers after that."""

    def altered(entries: list[Entry], ill: tuple[str, ...], middle: int) -> list[Entry]:
        leapt_ns: int | None = None

        def change(rows: Rows, first: int, middle: int) -> None:
            later = first + np.arange(len(rows)) >= middle
            rows["t_ns"][later] += by_ns
            rows["imu_t_ns"][later] += by_ns

        changed = []
        for entry in with_rows(change, entries, ill, middle):
            if _is_module(entry, ill, Leaf.FEEDBACK) and leapt_ns is None:
                message, _ = sent_rows(entry)
                leapt_ns = entry.t_ns if message.first_row + message.count > middle else None
            elif leapt_ns is not None and entry.kind == "reply" and _is_module(entry, ill):
                kind = TOPICS[parse(entry.topic).leaf].message("reply")
                answer = None if kind is None else decode(kind, entry.payload)
                if isinstance(answer, Ack | Status):
                    payload = encode(answer.model_copy(update={"t_ns": answer.t_ns + by_ns}))
                    entry = entry._replace(payload=payload)
            changed.append(entry)
        return changed

    return altered


def exchanged(entries: list[Entry], ill: tuple[str, ...], middle: int) -> list[Entry]:
    """Exchange the encoders of two modules."""
    other = dict(zip(ill, reversed(ill), strict=True))
    tracks: dict[tuple[str, int], Any] = {}
    for entry in entries:
        if _is_module(entry, ill, Leaf.FEEDBACK, Leaf.HISTORY):
            message, rows = sent_rows(entry)
            tracks |= {(message.serial, message.first_row + n): row for n, row in enumerate(rows)}
    altered = []
    for entry in entries:
        if _is_module(entry, ill, Leaf.FEEDBACK, Leaf.HISTORY):
            message, rows = sent_rows(entry)
            for n in range(len(rows)):
                row = tracks.get((other[message.serial], message.first_row + n))
                if row is not None:
                    for field in POSITION:
                        rows[field][n] = row[field]
            entry = entry._replace(payload=encode(message.model_copy(update={"rows": rows.tobytes()})))
        altered.append(entry)
    return altered


def mislabelled(entries: list[Entry], ill: tuple[str, ...], middle: int) -> list[Entry]:
    """Let a module report another type than it is."""
    altered = []
    for entry in entries:
        if _is_module(entry, ill, Leaf.INFO):
            info = decode(Info, entry.payload).model_copy(update={"module_type": OTHER_TYPE})
            entry = entry._replace(payload=encode(info))
        altered.append(entry)
    return altered


def with_hole(entries: list[Entry], ill: tuple[str, ...], middle: int) -> list[Entry]:
    """Leave out some rows in the middle."""
    lost, kept = range(middle, middle + LOST_ROWS), []
    for entry in entries:
        if _is_module(entry, ill, Leaf.FEEDBACK, Leaf.HISTORY):
            message, rows = sent_rows(entry)
            if any(message.first_row + n in lost for n in range(len(rows))):
                continue
        kept.append(entry)
    return kept


def silent(entries: list[Entry], ill: tuple[str, ...], middle: int) -> list[Entry]:
    """Leave out everything that the modules sent."""
    return [entry for entry in entries if not _is_module(entry, ill)]
