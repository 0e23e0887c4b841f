"""The regressor's arithmetic, sample by sample in scalars, compiled; `regressor` says what it computes.

A sample's intermediates stay in the first cache, and no entry is touched that is zero. Arrays are indexed,
never sliced: a slice costs as much as a cross product.
"""

from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from module_agent.model.chain import Array
from module_agent.model.compiled import compiled

Index = NDArray[np.int64]
Vector = tuple[float, float, float]
# Of every body: angular rate, velocity, angular acceleration, acceleration against free fall.
_OMEGA, _VELOCITY, _ALPHA, _ACCEL = 0, 1, 2, 3


@compiled
def fill_regressor(
    carriers: Index,
    depth: Index,
    axis: Array,
    point: Array,
    gravity: Array,
    q: Array,
    qd: Array,
    qdd: Array,
    out: Array,
) -> None:
    """Write the regressor of a motion of n joints, m samples.

    Args:
        carriers: (n, n) for every body the joints that carry it, the root's first and its own last; of them
            the first `depth` (n,) count.
        axis, point: (n, 3) of the joints in the root frame at q = 0.
        gravity: (3,) the specific force of rest.
        q, qd, qdd: (m, n).
        out: (m, n, 10 n); only what some joint carries is written, the rest must be zero.
    """
    joints = len(depth)
    motion = np.zeros((joints, 4, 3))
    # In the body's frame, of every joint that carries it: direction and moment.
    screws = np.zeros((joints, joints, 6))
    turn = np.empty((3, 3))
    for s in range(q.shape[0]):
        for i in range(joints):
            own = depth[i] - 1
            below = carriers[i, own - 1]
            p = _displace(axis, point, i, q[s, i], turn)
            for a in range(own):
                w = (screws[below, a, 0], screws[below, a, 1], screws[below, a, 2])
                v = (screws[below, a, 3], screws[below, a, 4], screws[below, a, 5])
                _keep(screws, i, a, _turned(turn, w), _turned(turn, _plus(v, _cross(w, p))))
            j = (axis[i, 0], axis[i, 1], axis[i, 2])
            moment = _cross((point[i, 0], point[i, 1], point[i, 2]), j)
            _keep(screws, i, own, j, moment)
            if own == 0:
                w = v = dw = (0.0, 0.0, 0.0)
                dv = _turned(turn, (gravity[0], gravity[1], gravity[2]))
            else:
                w, v = _at(motion, below, _OMEGA), _at(motion, below, _VELOCITY)
                dw, dv = _at(motion, below, _ALPHA), _at(motion, below, _ACCEL)
                # Accelerations are carried as spatial vectors, and kept as classical ones.
                dv = _turned(turn, _plus(_less(dv, _cross(w, v)), _cross(dw, p)))
                dw = _turned(turn, dw)
                v = _turned(turn, _plus(v, _cross(w, p)))
                w = _turned(turn, w)
            w = _plus(w, _times(j, qd[s, i]))
            v = _plus(v, _times(moment, qd[s, i]))
            dw = _plus(_plus(dw, _times(_cross(w, j), qd[s, i])), _times(j, qdd[s, i]))
            dv = _plus(dv, _times(_plus(_cross(v, j), _cross(w, moment)), qd[s, i]))
            dv = _plus(_plus(dv, _times(moment, qdd[s, i])), _cross(w, v))
            _put(motion, i, _OMEGA, w)
            _put(motion, i, _VELOCITY, v)
            _put(motion, i, _ALPHA, dw)
            _put(motion, i, _ACCEL, dv)
            for a in range(own + 1):
                _write_row(screws, i, a, w, dw, dv, out, s, carriers[i, a])


@compiled
def _displace(axis: Array, point: Array, i: int, q: float, turn: Array) -> Vector:
    """Set R^T and return p of the turn (R, p) about a joint's axis by q: Rodrigues' formula for -q."""
    s, versed = sin(q), 1.0 - cos(q)
    x, y, z = axis[i, 0], axis[i, 1], axis[i, 2]
    turn[0, 0] = 1.0 - versed + versed * x * x
    turn[1, 1] = 1.0 - versed + versed * y * y
    turn[2, 2] = 1.0 - versed + versed * z * z
    turn[0, 1], turn[1, 0] = versed * x * y + s * z, versed * x * y - s * z
    turn[1, 2], turn[2, 1] = versed * y * z + s * x, versed * y * z - s * x
    turn[2, 0], turn[0, 2] = versed * x * z + s * y, versed * x * z - s * y
    x, y, z = point[i, 0], point[i, 1], point[i, 2]
    return (
        x - turn[0, 0] * x - turn[1, 0] * y - turn[2, 0] * z,
        y - turn[0, 1] * x - turn[1, 1] * y - turn[2, 1] * z,
        z - turn[0, 2] * x - turn[1, 2] * y - turn[2, 2] * z,
    )


@compiled
def _write_row(
    screws: Array, i: int, a: int, omega: Vector, alpha: Vector, accel: Vector, out: Array, s: int, joint: int
) -> None:
    """Write one joint's row for one body.

    With the wrench (f, n) of thesis eq. 25 on the body and the joint's screw (w, v): tau = w . n + v . f.
    Grouped by parameter that is v . a for the mass, a x w + v x alpha + omega x (omega x v) for `mc`, and
    w . (I alpha) + (w x omega) . (I omega) for the inertia.
    """
    w = (screws[i, a, 0], screws[i, a, 1], screws[i, a, 2])
    v = (screws[i, a, 3], screws[i, a, 4], screws[i, a, 5])
    first = _plus(_plus(_cross(accel, w), _cross(v, alpha)), _cross(omega, _cross(omega, v)))
    u = _cross(w, omega)
    at = 10 * i
    out[s, joint, at] = v[0] * accel[0] + v[1] * accel[1] + v[2] * accel[2]
    out[s, joint, at + 1] = first[0]
    out[s, joint, at + 2] = first[1]
    out[s, joint, at + 3] = first[2]
    out[s, joint, at + 4] = w[0] * alpha[0] + u[0] * omega[0]
    out[s, joint, at + 5] = w[0] * alpha[1] + w[1] * alpha[0] + u[0] * omega[1] + u[1] * omega[0]
    out[s, joint, at + 6] = w[0] * alpha[2] + w[2] * alpha[0] + u[0] * omega[2] + u[2] * omega[0]
    out[s, joint, at + 7] = w[1] * alpha[1] + u[1] * omega[1]
    out[s, joint, at + 8] = w[1] * alpha[2] + w[2] * alpha[1] + u[1] * omega[2] + u[2] * omega[1]
    out[s, joint, at + 9] = w[2] * alpha[2] + u[2] * omega[2]


@compiled
def _turned(turn: Array, a: Vector) -> Vector:
    return (
        turn[0, 0] * a[0] + turn[0, 1] * a[1] + turn[0, 2] * a[2],
        turn[1, 0] * a[0] + turn[1, 1] * a[1] + turn[1, 2] * a[2],
        turn[2, 0] * a[0] + turn[2, 1] * a[1] + turn[2, 2] * a[2],
    )


@compiled
def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def _plus(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@compiled
def _less(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@compiled
def _times(a: Vector, s: float) -> Vector:
    return (a[0] * s, a[1] * s, a[2] * s)


@compiled
def _at(motion: Array, i: int, what: int) -> Vector:
    return (motion[i, what, 0], motion[i, what, 1], motion[i, what, 2])


@compiled
def _put(motion: Array, i: int, what: int, a: Vector) -> None:
    motion[i, what, 0], motion[i, what, 1], motion[i, what, 2] = a


@compiled
def _keep(screws: Array, i: int, a: int, w: Vector, v: Vector) -> None:
    screws[i, a, 0], screws[i, a, 1], screws[i, a, 2] = w
    screws[i, a, 3], screws[i, a, 4], screws[i, a, 5] = v
