"""Denavit-Hartenberg parameters of a chain: the standard convention of the thesis' eq. 2, and Hayati's.

Frame i - 1 has its z along the axis of joint i, so that joint i turns

    A_i = Rz(theta_i + q_i) Tz(d_i) Tx(a_i) Rx(alpha_i) Ry(beta_i)

with beta = 0 in the standard convention. They exist for serial chains only: a tree has one table per path
from a root to a leaf. Two axes that are all but parallel have a common normal that noise places anywhere
along them, tens of metres away. Their rows are therefore those of Hayati (1983, Robot arm geometric link
parameter estimation, IEEE CDC): d = 0, the x axis points to where the next axis meets the plane through the
origin across z, and a second small angle beta about y takes what alpha does not.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from module_agent.model.chain import Array, Chain
from module_agent.model.read_only import frozen

# At this angle a milliradian of an axis moves the feet of the common normal of a link of 0.3 m by 3 cm, at a
# right angle by 0.3 mm: it goes with the sine's inverse square.
NEARLY_PARALLEL_RAD = 0.1
MEETING_BELOW_M = 1e-9


class DhRow(NamedTuple):
    """The parameters of one joint; `theta_rad` is the offset that is added to the joint's position.

    beta_rad: of a joint whose axis and the next one are parallel, or all but so; then d_m is zero.
    """

    serial: str
    theta_rad: float
    d_m: float
    a_m: float
    alpha_rad: float
    beta_rad: float = 0.0


class DhPath(NamedTuple):
    """The table of one path from the base to a leaf; base: (4, 4) pose of frame 0 in the root frame.

    The last row has only zeros: beyond the last joint there is no axis to refer to.
    """

    base: Array
    rows: tuple[DhRow, ...]


def dh_paths(chain: Chain) -> tuple[DhPath, ...]:
    """Return one table per leaf, in the order of the chain."""
    return tuple(dh_path(chain, leaf) for leaf in chain.leaves)


def dh_path(chain: Chain, leaf: int) -> DhPath:
    """Return the table of the joints from the base to module `leaf`.

    Frame 0 has its origin at the first joint's point and its x along the root frame's x, as near as it goes.
    """
    path = chain.ancestors(leaf)
    first = path[0]
    frame = _frame(chain.axis[first], _x_axis_across(chain.axis[first]), chain.point[first])
    base, rows = frozen(frame), []
    for joint, following in pairwise(path):
        axis, point = chain.axis[following], chain.point[following]
        sine = float(np.linalg.norm(np.cross(frame[:3, 2], axis)))
        step = _hayati if sine < np.sin(NEARLY_PARALLEL_RAD) else _by_common_normal
        row, frame = step(chain.serials[joint], frame, axis, point)
        rows.append(row)
    rows.append(DhRow(chain.serials[path[-1]], 0.0, 0.0, 0.0, 0.0))
    return DhPath(base, tuple(rows))


def _by_common_normal(serial: str, frame: Array, axis: Array, point: Array) -> tuple[DhRow, Array]:
    """Return the row from a frame to the next axis by their common normal, and the next frame."""
    x, z, origin = frame[:3, 0], frame[:3, 2], frame[:3, 3]
    cross, between = np.cross(z, axis), point - origin
    sine = float(np.linalg.norm(cross))
    foot = origin + z * float(np.cross(between, axis) @ cross) / sine**2
    along = point + axis * float(np.cross(between, z) @ cross) / sine**2
    normal = cross / sine
    # From the first axis to the second, so that a >= 0; of axes that meet either direction will do.
    normal = -normal if float((along - foot) @ normal) < 0.0 else normal
    d_m, a_m = float((foot - origin) @ z), float((along - foot) @ normal)
    row = DhRow(serial, _angle(x, normal, z), d_m, a_m, _angle(z, axis, normal))
    return row, _frame(axis, normal, along)


def _hayati(serial: str, frame: Array, axis: Array, point: Array) -> tuple[DhRow, Array]:
    """Return the row from a frame to the next axis, which is nearly parallel to its z, and the next frame."""
    x, z, origin = frame[:3, 0], frame[:3, 2], frame[:3, 3]
    met = point + axis * float(z @ (origin - point)) / float(z @ axis)
    a_m = float(np.linalg.norm(met - origin))
    towards = (met - origin) / a_m if a_m > MEETING_BELOW_M else x
    between = _frame(z, towards, met)
    aside, back, ahead = axis @ between[:3, :3]
    # Of axes that are all but opposite alpha is all but pi, from either side.
    alpha, beta = float(np.arctan2(-back, ahead)), float(np.arcsin(aside))
    alpha += 2.0 * np.pi if alpha < -0.5 * np.pi else 0.0
    following = between.copy()
    following[:3, :3] = between[:3, :3] @ Rotation.from_euler("XY", [alpha, beta]).as_matrix()
    return DhRow(serial, _angle(x, towards, z), 0.0, a_m, alpha, beta), following


def _angle(start: Array, end: Array, about: Array) -> float:
    return float(np.arctan2(np.cross(start, end) @ about, start @ end))


def _x_axis_across(axis: Array) -> Array:
    """Return the unit vector across `axis` that is nearest to the root frame's x, or to its y."""
    for candidate in np.eye(3)[:2]:
        across = candidate - axis * (axis @ candidate)
        size = float(np.linalg.norm(across))
        if size > 0.1:
            break
    return np.asarray(across / size)


def _frame(z: Array, x: Array, origin: Array) -> Array:
    frame = np.eye(4)
    # An x that is off by rounding, or by near-parallel axes, is squared up against z.
    x = x - z * (z @ x)
    x = x / np.linalg.norm(x)
    frame[:3, 0], frame[:3, 1], frame[:3, 2], frame[:3, 3] = x, np.cross(z, x), z, origin
    return frame
