"""Denavit-Hartenberg parameters of a chain: the standard convention of the thesis' eq. 2.

Frame i - 1 has its z along the axis of joint i, so that joint i turns A_i = Rz(theta_i + q_i) Tz(d_i) Tx(a_i)
Rx(alpha_i). They exist for serial chains only: a tree has one table per path from a root to a leaf. Two axes
that are all but parallel have a common normal far away, and d is dominated by noise (Hayati 1983).
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from module_agent.model.chain import Array, Chain
from module_agent.model.read_only import frozen

PARALLEL_BELOW_RAD = 1e-7
MEETING_BELOW_M = 1e-9


class DhRow(NamedTuple):
    """The parameters of one joint; `theta_rad` is the offset that is added to the joint's position."""

    serial: str
    theta_rad: float
    d_m: float
    a_m: float
    alpha_rad: float


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
    Of parallel axes the common normal through the last origin is taken, so that d = 0.
    """
    path = chain.ancestors(leaf)
    first = path[0]
    frame = _frame(chain.axis[first], _x_axis_across(chain.axis[first]), chain.point[first])
    base, rows = frozen(frame), []
    for joint, following in pairwise(path):
        x, z, origin = frame[:3, 0], frame[:3, 2], frame[:3, 3]
        axis = chain.axis[following]
        normal, foot, along = _common_normal(frame, axis, chain.point[following])
        theta_rad, alpha_rad = _angle(x, normal, z), _angle(z, axis, normal)
        d_m, a_m = float((foot - origin) @ z), float((along - foot) @ normal)
        rows.append(DhRow(chain.serials[joint], theta_rad, d_m, a_m, alpha_rad))
        frame = _frame(axis, normal, along)
    rows.append(DhRow(chain.serials[path[-1]], 0.0, 0.0, 0.0, 0.0))
    return DhPath(base, tuple(rows))


def _common_normal(frame: Array, axis: Array, point: Array) -> tuple[Array, Array, Array]:
    """Return the common normal of a frame's z and an axis: its direction and its feet on the two."""
    x, z, origin = frame[:3, 0], frame[:3, 2], frame[:3, 3]
    cross = np.cross(z, axis)
    between = point - origin
    sine = float(np.linalg.norm(cross))
    if sine < PARALLEL_BELOW_RAD:
        along = point - axis * (axis @ between)
        gap = (along - origin) - z * (z @ (along - origin))
        size = float(np.linalg.norm(gap))
        return (gap / size if size > MEETING_BELOW_M else x), origin, along
    foot = origin + z * float(np.cross(between, axis) @ cross) / sine**2
    along = point + axis * float(np.cross(between, z) @ cross) / sine**2
    normal = cross / sine
    # From the first axis to the second, so that a >= 0; of axes that meet either direction will do.
    return (-normal if float((along - foot) @ normal) < 0.0 else normal), foot, along


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
