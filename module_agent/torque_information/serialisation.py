"""Chains, clock maps and a joint's information as parts of messages, and back, without rounding.

The bytes of a joint's information are little-endian: the numbers of columns, of rows k and of columns f that
are not zero ("<3I"), the number of samples ("<Q"), and `rest` ("<d"); the indices of the f columns ("<u2"
each); of every row i the f - i values from its diagonal on; the k targets.
"""

import struct
from collections.abc import Sequence

import numpy as np

from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only
from module_agent.signals.clock_map import ClockMap
from module_agent.wire.information_messages import GEOMETRY_BYTES, ChainPart, ClockPart


def chain_part(chain: Chain) -> ChainPart:
    """Return a chain as part of a message.

    Raises:
        DataError: more modules than a message carries.
    """
    columns = [chain.axis, chain.point, chain.imu_home.reshape(-1, 16)]
    x, y, z = chain.gravity.tolist()
    return ChainPart(
        serials=chain.serials,
        parent=tuple(map(int, chain.parent)),
        reversed=tuple(map(bool, chain.reversed)),
        geometry=np.hstack(columns).astype("<f8").tobytes(),
        gravity_m_s2=(x, y, z),
    )


def chain_of(part: ChainPart) -> Chain:
    """Return the chain that a message carries; its arrays are read-only.

    Raises:
        DataError: parts that do not fit, a parent that does not come before its child, a serial twice, or a
            value that is not finite.
    """
    joints = len(part.serials)
    if len(part.geometry) != joints * GEOMETRY_BYTES:
        raise DataError(
            f"{len(part.geometry)} bytes of geometry, {joints} modules need {joints * GEOMETRY_BYTES}"
        )
    values = np.frombuffer(part.geometry, "<f8").reshape(joints, 22)
    geometry = {
        "axis": values[:, :3],
        "point": values[:, 3:6],
        "imu_home": values[:, 6:].reshape(joints, 4, 4),
        "gravity": part.gravity_m_s2,
    }
    return Chain.from_dict(part.model_dump(include={"serials", "parent", "reversed"}) | geometry)


def clock_part(clock: ClockMap) -> ClockPart:
    """Return a clock map as part of a message, without its sigmas."""
    return ClockPart(
        origin_ns=int(clock.origin_ns), offset_ns=float(clock.offset_ns), drift=float(clock.drift)
    )


def clocks_of(parts: Sequence[ClockPart]) -> list[ClockMap]:
    """Return the clock maps that a message carries."""
    return [ClockMap(part.origin_ns, part.offset_ns, part.drift, 0.0) for part in parts]


_HEAD = struct.Struct("<3IQd")
# 64 bodies, and half as many further columns.
MAX_COLUMNS = 960
MAX_BYTES = _HEAD.size + 2 * MAX_COLUMNS + 8 * (MAX_COLUMNS * (MAX_COLUMNS + 1) // 2 + MAX_COLUMNS)


def pack(information: JointInformation) -> bytes:
    """Return the bytes of a result of `information.gather_joint` or `merge_joint`.

    Raises:
        DataError: more than `MAX_COLUMNS` columns, or rows that are not triangular.
    """
    rows, columns = information.r.shape
    nonzero = np.flatnonzero(information.r.any(axis=0))
    triangle = information.r[:, nonzero]
    if columns > MAX_COLUMNS or rows > nonzero.size or np.tril(triangle, -1).any():
        raise DataError(
            f"{rows} rows of {columns} columns: triangular ones of at most {MAX_COLUMNS} columns are packed"
        )
    upper = triangle[np.triu_indices(rows, 0, nonzero.size)]
    head = _HEAD.pack(columns, rows, nonzero.size, information.samples, information.rest)
    values = np.concatenate([upper, information.z]).astype("<f8")
    return head + nonzero.astype("<u2").tobytes() + values.tobytes()


def unpack(block: bytes) -> JointInformation:
    """Return the information from the bytes of `pack`; its arrays are read-only.

    Raises:
        DataError: the bytes are not what they announce, or hold a value that is not finite.
    """
    if len(block) < _HEAD.size:
        raise DataError(f"{len(block)} bytes of information, the head alone has {_HEAD.size}")
    columns, rows, nonzero_count, samples, rest = _HEAD.unpack_from(block)
    if not rows <= nonzero_count <= columns <= MAX_COLUMNS:
        raise DataError(
            f"{rows} rows in {nonzero_count} of {columns} columns: at most {MAX_COLUMNS}, and rows in as many"
        )
    upper = nonzero_count * rows - rows * (rows - 1) // 2
    due = _HEAD.size + 2 * nonzero_count + 8 * (upper + rows)
    if len(block) != due:
        raise DataError(f"{len(block)} bytes of information, {due} are announced")
    nonzero = np.frombuffer(block, "<u2", nonzero_count, _HEAD.size).astype(np.int64)
    values = np.frombuffer(block, "<f8", upper + rows, _HEAD.size + 2 * nonzero_count).astype(np.float64)
    if not (np.diff(nonzero, prepend=-1) > 0).all() or (nonzero >= columns).any():
        raise DataError("the columns of the information are out of order, or out of range")
    if not (np.isfinite(values).all() and np.isfinite(rest) and rest >= 0.0):
        raise DataError("the information holds a value that is not finite, or a negative square")
    triangle = np.zeros((rows, nonzero_count))
    triangle[np.triu_indices(rows, 0, nonzero_count)] = values[:upper]
    r = np.zeros((rows, columns))
    r[:, nonzero] = triangle
    z = values[upper:].copy()
    make_read_only((r, z))
    return JointInformation(r, z, rest, samples)
