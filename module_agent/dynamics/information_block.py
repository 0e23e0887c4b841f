"""The information of a joint as bytes, for the wire: doubles as they are, so that nothing is rounded.

Little-endian: the number of columns, of rows k and of columns f that are not zero ("<3I"), how many samples
went in ("<Q"), and `rest` ("<d"); the f columns ("<u2" each); of every row i the values from its diagonal on,
f - i of them; the k targets.
"""

import struct

import numpy as np

from module_agent.dynamics.information import JointInformation

_HEAD = struct.Struct("<3IQd")
# 64 bodies, and half as many further columns.
MOST_COLUMNS = 960
MOST_BYTES = _HEAD.size + 2 * MOST_COLUMNS + 8 * (MOST_COLUMNS * (MOST_COLUMNS + 1) // 2 + MOST_COLUMNS)


def pack(information: JointInformation) -> bytes:
    """Return the bytes of what `information.gather_joint` or `merge_joint` has returned.

    Raises:
        ValueError: more than `MOST_COLUMNS` columns, or rows that are not triangular.
    """
    rows, columns = information.r.shape
    felt = np.flatnonzero(information.r.any(axis=0))
    kept = information.r[:, felt]
    if columns > MOST_COLUMNS or rows > felt.size or np.tril(kept, -1).any():
        raise ValueError(
            f"{rows} rows of {columns} columns: triangular ones of at most {MOST_COLUMNS} columns are packed"
        )
    upper = kept[np.triu_indices(rows, 0, felt.size)]
    head = _HEAD.pack(columns, rows, felt.size, information.samples, information.rest)
    values = np.concatenate([upper, information.z]).astype("<f8")
    return head + felt.astype("<u2").tobytes() + values.tobytes()


def unpack(block: bytes) -> JointInformation:
    """Return the information that `pack` has made bytes of; its arrays are read-only.

    Raises:
        ValueError: the bytes are not what they announce, or hold a value that is not finite.
    """
    if len(block) < _HEAD.size:
        raise ValueError(f"{len(block)} bytes of information, the head alone has {_HEAD.size}")
    columns, rows, felt_count, samples, rest = _HEAD.unpack_from(block)
    if not rows <= felt_count <= columns <= MOST_COLUMNS:
        raise ValueError(
            f"{rows} rows in {felt_count} of {columns} columns: at most {MOST_COLUMNS}, and rows in as many"
        )
    upper = felt_count * rows - rows * (rows - 1) // 2
    due = _HEAD.size + 2 * felt_count + 8 * (upper + rows)
    if len(block) != due:
        raise ValueError(f"{len(block)} bytes of information, {due} are announced")
    felt = np.frombuffer(block, "<u2", felt_count, _HEAD.size).astype(np.int64)
    values = np.frombuffer(block, "<f8", upper + rows, _HEAD.size + 2 * felt_count).astype(np.float64)
    if not (np.diff(felt, prepend=-1) > 0).all() or (felt >= columns).any():
        raise ValueError("the columns of the information are out of order, or out of range")
    if not (np.isfinite(values).all() and np.isfinite(rest) and rest >= 0.0):
        raise ValueError("the information holds a value that is not finite, or a negative square")
    kept = np.zeros((rows, felt_count))
    kept[np.triu_indices(rows, 0, felt_count)] = values[:upper]
    r = np.zeros((rows, columns))
    r[:, felt] = kept
    z = values[upper:].copy()
    r.flags.writeable = z.flags.writeable = False
    return JointInformation(r, z, rest, samples)
