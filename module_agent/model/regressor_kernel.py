"""The regressor's arithmetic, compiled, for groups of samples; `regressor` says what it computes.

The innermost loops run over the samples of a group, and arrays have them last, in lanes: compilers make
vector instructions of such loops. They do so only where the distance of two rows is a constant that they
see, hence the inlined functions that take whole arrays and row numbers. A sample has the same IEEE
operations wherever it stands: alone it gives the same bits as in a batch.
"""

from math import cos, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.model.chain import Array
from module_agent.model.compiled import compiled, inlined

Index = NDArray[np.int64]
Vector = tuple[float, float, float]

# Two vectors of AVX-512: a group of 7 joints takes 56 KB. 8 and 32 are as fast within 5 %.
LANES = 16
# Reduction by pi / 2 in three parts, 33 bits in each of the first two: exact up to this angle (fdlibm).
_REDUCED_RAD = 1e5
_HALF_PI_1, _HALF_PI_2 = 1.57079632673412561417e00, 6.07710050630396597660e-11
_HALF_PI_3 = 2.02226624879595063154e-21
_PER_HALF_PI = 6.36619772367581382433e-01
# Adding and subtracting it rounds to the nearest integer.
_ROUND = 6755399441055744.0


class _Group(NamedTuple):
    """What is known of a group of samples, in lanes.

    signals: sin q, cos q, qd, qdd of every joint.
    bodies: angular rate, velocity and their spatial derivatives of every body in its frame, the base last.
    screws: direction and moment, in the body's frame, of every joint that carries it.
    turn, wrench, block: of the body that is being worked on.
    """

    signals: Array
    bodies: Array
    screws: Array
    turn: Array
    wrench: Array
    block: Array


@compiled
def fill_regressor(
    carriers: Index, axis: Array, point: Array, gravity: Array, motion: Array, out: Array
) -> None:
    """Write the regressor of a motion of n joints, m samples.

    Args:
        carriers: (n, n) for every body the joints that carry it, the root's first and its own last, then -1.
        axis, point: (n, 3) of the joints in the root frame at q = 0.
        gravity: (3,) the specific force of rest.
        motion: (m, 3, n) positions, velocities, accelerations.
        out: (m, n, 10 n); only what some joint carries is written, the rest must be zero.
    """
    joints = len(carriers)
    group = _Group(
        signals=np.empty((joints, 4, LANES)),
        bodies=np.zeros((joints + 1, 12, LANES)),
        screws=np.empty((joints * joints, 6, LANES)),
        turn=np.empty((12, LANES)),
        wrench=np.empty((21, LANES)),
        block=np.empty((10, LANES)),
    )
    group.bodies[joints, 9:] = gravity.reshape(3, 1)
    whole = motion.shape[0] // LANES * LANES
    for first in range(0, whole, LANES):
        # With a constant number the loops need no remainder, which takes a quarter of the time.
        _read_motion(motion, first, LANES, group.signals)
        for i in range(joints):
            _fill_body(carriers, axis, point, i, group, LANES, out, first)
    lanes = motion.shape[0] - whole
    if lanes > 0:
        _read_motion(motion, whole, lanes, group.signals)
        for i in range(joints):
            _fill_body(carriers, axis, point, i, group, lanes, out, whole)


@inlined
def _fill_body(
    carriers: Index, axis: Array, point: Array, i: int, group: _Group, lanes: int, out: Array, first: int
) -> None:
    """Write what a body contributes to the torques of a group's samples, after the body below it."""
    signals, bodies, screws, turn, wrench, block = group
    joints = len(carriers)
    own = 0
    while carriers[i, own] != i:
        own += 1
    below = carriers[i, own - 1] if own > 0 else joints
    j = (axis[i, 0], axis[i, 1], axis[i, 2])
    p = (point[i, 0], point[i, 1], point[i, 2])
    moment = _cross(p, j)
    _set_turn(j, p, signals, i, turn, lanes)
    for a in range(own):
        _move_screw(screws, below * joints + a, i * joints + a, turn, lanes)
    _set_screw(screws, i * joints + own, j, moment, lanes)
    _move_body(bodies, below, i, turn, j, moment, signals, lanes)
    _set_wrench(bodies, i, wrench, lanes)
    for a in range(own + 1):
        _set_block(screws, i * joints + a, wrench, block, lanes)
        row = carriers[i, a]
        for k in range(lanes):
            for c in range(10):
                out[first + k, row, 10 * i + c] = block[c, k]


@compiled
def fill_torques(
    parent: Index, axis: Array, point: Array, gravity: Array, phi: Array, motion: Array, out: Array
) -> None:
    """Write the joint torques (m, n) of a motion by recursive Newton-Euler, without the regressor.

    Args:
        parent: (n,) the joint below, -1 for a root; before its children.
        phi: (10 n,). axis, point, gravity, motion: as for `fill_regressor`.
    """
    joints = len(parent)
    signals = np.empty((joints, 4, LANES))
    turns = np.empty((joints, 12, LANES))
    bodies = np.zeros((joints + 1, 12, LANES))
    bodies[joints, 9:] = gravity.reshape(3, 1)
    wrench = np.empty((21, LANES))
    # Of every body with all that it carries, in its own frame: force and torque about the origin.
    forces = np.empty((joints, 6, LANES))
    for first in range(0, motion.shape[0], LANES):
        lanes = min(LANES, motion.shape[0] - first)
        _read_motion(motion, first, lanes, signals)
        for i in range(joints):
            j = (axis[i, 0], axis[i, 1], axis[i, 2])
            p = (point[i, 0], point[i, 1], point[i, 2])
            below = parent[i] if parent[i] >= 0 else joints
            _set_turn(j, p, signals, i, turns[i], lanes)
            _move_body(bodies, below, i, turns[i], j, _cross(p, j), signals, lanes)
            _set_wrench(bodies, i, wrench, lanes)
            _set_force(wrench, phi[10 * i : 10 * i + 10], forces, i, lanes)
        for i in range(joints - 1, -1, -1):
            j = (axis[i, 0], axis[i, 1], axis[i, 2])
            moment = _cross((point[i, 0], point[i, 1], point[i, 2]), j)
            for k in range(lanes):
                force = (forces[i, 0, k], forces[i, 1, k], forces[i, 2, k])
                torque = (forces[i, 3, k], forces[i, 4, k], forces[i, 5, k])
                out[first + k, i] = _dot(j, torque) + _dot(moment, force)
            if parent[i] >= 0:
                _pass_force(forces, i, parent[i], turns[i], lanes)


@inlined
def _set_force(wrench: Array, phi: Array, forces: Array, i: int, lanes: int) -> None:
    """Set the force and torque that the body's ten parameters need (thesis eq. 25)."""
    m, cx, cy, cz = phi[0], phi[1], phi[2], phi[3]
    ixx, ixy, ixz, iyy, iyz, izz = phi[4], phi[5], phi[6], phi[7], phi[8], phi[9]
    for k in range(lanes):
        a0, a1, a2 = wrench[0, k], wrench[1, k], wrench[2, k]
        xy, xz, yz = wrench[6, k], wrench[7, k], wrench[8, k]
        m01, m10 = wrench[15, k], wrench[16, k]
        m02, m20 = wrench[17, k], wrench[18, k]
        m12, m21 = wrench[19, k], wrench[20, k]
        forces[i, 0, k] = m * a0 + wrench[12, k] * cx + m01 * cy + m02 * cz
        forces[i, 1, k] = m * a1 + m10 * cx + wrench[13, k] * cy + m12 * cz
        forces[i, 2, k] = m * a2 + m20 * cx + m21 * cy + wrench[14, k] * cz
        turning = ixx * wrench[3, k] - ixy * m20 + ixz * m10 + (izz - iyy) * yz + iyz * wrench[11, k]
        forces[i, 3, k] = cy * a2 - cz * a1 + turning
        turning = iyy * wrench[4, k] + ixy * m21 - iyz * m01 + (ixx - izz) * xz + ixz * wrench[10, k]
        forces[i, 4, k] = cz * a0 - cx * a2 + turning
        turning = izz * wrench[5, k] - ixz * m12 + iyz * m02 + (iyy - ixx) * xy + ixy * wrench[9, k]
        forces[i, 5, k] = cx * a1 - cy * a0 + turning


@inlined
def _pass_force(forces: Array, i: int, below: int, turn: Array, lanes: int) -> None:
    """Add a body's force to that of the body that carries it."""
    for k in range(lanes):
        f0, f1, f2 = forces[i, 0, k], forces[i, 1, k], forces[i, 2, k]
        n0, n1, n2 = forces[i, 3, k], forces[i, 4, k], forces[i, 5, k]
        f = (
            turn[0, k] * f0 + turn[3, k] * f1 + turn[6, k] * f2,
            turn[1, k] * f0 + turn[4, k] * f1 + turn[7, k] * f2,
            turn[2, k] * f0 + turn[5, k] * f1 + turn[8, k] * f2,
        )
        arm = _cross((turn[9, k], turn[10, k], turn[11, k]), f)
        forces[below, 0, k] += f[0]
        forces[below, 1, k] += f[1]
        forces[below, 2, k] += f[2]
        forces[below, 3, k] += turn[0, k] * n0 + turn[3, k] * n1 + turn[6, k] * n2 + arm[0]
        forces[below, 4, k] += turn[1, k] * n0 + turn[4, k] * n1 + turn[7, k] * n2 + arm[1]
        forces[below, 5, k] += turn[2, k] * n0 + turn[5, k] * n1 + turn[8, k] * n2 + arm[2]


@inlined
def _read_motion(motion: Array, first: int, lanes: int, signals: Array) -> None:
    joints = signals.shape[0]
    for k in range(lanes):
        for i in range(joints):
            signals[i, 1, k] = motion[first + k, 0, i]
            signals[i, 2, k] = motion[first + k, 1, i]
            signals[i, 3, k] = motion[first + k, 2, i]
    far = 0
    for i in range(joints):
        for k in range(lanes):
            q = signals[i, 1, k]
            far |= abs(q) > _REDUCED_RAD
            signals[i, 0, k], signals[i, 1, k] = _sine_and_cosine(q)
    if far:
        for i in range(joints):
            for k in range(lanes):
                q = motion[first + k, 0, i]
                if abs(q) > _REDUCED_RAD:
                    signals[i, 0, k], signals[i, 1, k] = sin(q), cos(q)


@inlined
def _sine_and_cosine(q: float) -> tuple[float, float]:
    """Return both within 1e-15, without branches: the polynomials of fdlibm (`k_sin.c`, `k_cos.c`)."""
    quadrant = (q * _PER_HALF_PI + _ROUND) - _ROUND
    r = ((q - quadrant * _HALF_PI_1) - quadrant * _HALF_PI_2) - quadrant * _HALF_PI_3
    z = r * r
    s = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
    s = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * s)
    s = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * s)
    s = r + r * z * s
    c = 2.08757232129817482790e-09 - z * 1.13596475577881948265e-11
    c = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * c)
    c = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * c)
    c = 1.0 - (0.5 * z - z * z * c)
    half = (0.5 * quadrant - 0.25 + _ROUND) - _ROUND
    odd = quadrant - 2.0 * half > 0.5
    sign = 1.0 - 2.0 * (half - 2.0 * ((0.5 * half - 0.25 + _ROUND) - _ROUND))
    return sign * (c if odd else s), sign * (-s if odd else c)


@inlined
def _set_turn(j: Vector, p: Vector, signals: Array, i: int, turn: Array, lanes: int) -> None:
    """Set R^T, row by row, and p of the turn (R, p) about a joint's axis by q: Rodrigues' formula for -q."""
    x, y, z = j
    for k in range(lanes):
        s, versed = signals[i, 0, k], 1.0 - signals[i, 1, k]
        xx, yy, zz = (
            1.0 - versed + versed * x * x,
            1.0 - versed + versed * y * y,
            1.0 - versed + versed * z * z,
        )
        xy, yx = versed * x * y + s * z, versed * x * y - s * z
        yz, zy = versed * y * z + s * x, versed * y * z - s * x
        zx, xz = versed * x * z + s * y, versed * x * z - s * y
        turn[0, k], turn[1, k], turn[2, k] = xx, xy, xz
        turn[3, k], turn[4, k], turn[5, k] = yx, yy, yz
        turn[6, k], turn[7, k], turn[8, k] = zx, zy, zz
        turn[9, k] = p[0] - xx * p[0] - yx * p[1] - zx * p[2]
        turn[10, k] = p[1] - xy * p[0] - yy * p[1] - zy * p[2]
        turn[11, k] = p[2] - xz * p[0] - yz * p[1] - zz * p[2]


@inlined
def _set_screw(screws: Array, to: int, j: Vector, moment: Vector, lanes: int) -> None:
    for k in range(lanes):
        screws[to, 0, k], screws[to, 1, k], screws[to, 2, k] = j
        screws[to, 3, k], screws[to, 4, k], screws[to, 5, k] = moment


@inlined
def _move_screw(screws: Array, source: int, to: int, turn: Array, lanes: int) -> None:
    for k in range(lanes):
        w = (screws[source, 0, k], screws[source, 1, k], screws[source, 2, k])
        v = (screws[source, 3, k], screws[source, 4, k], screws[source, 5, k])
        v = _turned(turn, k, _plus(v, _cross(w, (turn[9, k], turn[10, k], turn[11, k]))))
        w = _turned(turn, k, w)
        screws[to, 0, k], screws[to, 1, k], screws[to, 2, k] = w
        screws[to, 3, k], screws[to, 4, k], screws[to, 5, k] = v


@inlined
def _move_body(
    bodies: Array, below: int, i: int, turn: Array, j: Vector, moment: Vector, signals: Array, lanes: int
) -> None:
    for k in range(lanes):
        w = (bodies[below, 0, k], bodies[below, 1, k], bodies[below, 2, k])
        v = (bodies[below, 3, k], bodies[below, 4, k], bodies[below, 5, k])
        dw = (bodies[below, 6, k], bodies[below, 7, k], bodies[below, 8, k])
        dv = (bodies[below, 9, k], bodies[below, 10, k], bodies[below, 11, k])
        p = (turn[9, k], turn[10, k], turn[11, k])
        qd, qdd = signals[i, 2, k], signals[i, 3, k]
        dv = _turned(turn, k, _plus(dv, _cross(dw, p)))
        dw = _turned(turn, k, dw)
        v = _plus(_turned(turn, k, _plus(v, _cross(w, p))), _times(moment, qd))
        w = _plus(_turned(turn, k, w), _times(j, qd))
        dw = _plus(_plus(dw, _times(_cross(w, j), qd)), _times(j, qdd))
        dv = _plus(dv, _times(_plus(_cross(v, j), _cross(w, moment)), qd))
        dv = _plus(dv, _times(moment, qdd))
        bodies[i, 0, k], bodies[i, 1, k], bodies[i, 2, k] = w
        bodies[i, 3, k], bodies[i, 4, k], bodies[i, 5, k] = v
        bodies[i, 6, k], bodies[i, 7, k], bodies[i, 8, k] = dw
        bodies[i, 9, k], bodies[i, 10, k], bodies[i, 11, k] = dv


@inlined
def _set_wrench(bodies: Array, i: int, wrench: Array, lanes: int) -> None:
    """Set what the wrench on a body is made of: classical and angular acceleration, products of the rates.

    Of omega = (x, y, z) and alpha that are a, alpha, (xy, xz, yz), (xx - yy, zz - xx, yy - zz), and of
    [alpha] + [omega]^2 the diagonal and (01, 10, 02, 20, 12, 21).
    """
    for k in range(lanes):
        x, y, z = bodies[i, 0, k], bodies[i, 1, k], bodies[i, 2, k]
        v = (bodies[i, 3, k], bodies[i, 4, k], bodies[i, 5, k])
        p, q, r = bodies[i, 6, k], bodies[i, 7, k], bodies[i, 8, k]
        dv = (bodies[i, 9, k], bodies[i, 10, k], bodies[i, 11, k])
        wrench[0, k], wrench[1, k], wrench[2, k] = _plus(dv, _cross((x, y, z), v))
        wrench[3, k], wrench[4, k], wrench[5, k] = p, q, r
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        wrench[6, k], wrench[7, k], wrench[8, k] = xy, xz, yz
        wrench[9, k], wrench[10, k], wrench[11, k] = xx - yy, zz - xx, yy - zz
        wrench[12, k], wrench[13, k], wrench[14, k] = -yy - zz, -xx - zz, -xx - yy
        wrench[15, k], wrench[16, k] = xy - r, xy + r
        wrench[17, k], wrench[18, k] = xz + q, xz - q
        wrench[19, k], wrench[20, k] = yz - p, yz + p


@inlined
def _set_block(screws: Array, screw: int, wrench: Array, block: Array, lanes: int) -> None:
    """Set one joint's row for one body.

    With the wrench (f, n) of thesis eq. 25 on the body and the joint's screw (w, v): tau = w . n + v . f.
    Grouped by parameter that is v . a for the mass, a x w + ([alpha] + [omega]^2)^T v for `mc`, and
    w . (I alpha + omega x (I omega)) for the inertia.
    """
    for k in range(lanes):
        w0, w1, w2 = screws[screw, 0, k], screws[screw, 1, k], screws[screw, 2, k]
        v0, v1, v2 = screws[screw, 3, k], screws[screw, 4, k], screws[screw, 5, k]
        a0, a1, a2 = wrench[0, k], wrench[1, k], wrench[2, k]
        xy, xz, yz = wrench[6, k], wrench[7, k], wrench[8, k]
        m01, m10 = wrench[15, k], wrench[16, k]
        m02, m20 = wrench[17, k], wrench[18, k]
        m12, m21 = wrench[19, k], wrench[20, k]
        block[0, k] = v0 * a0 + v1 * a1 + v2 * a2
        block[1, k] = wrench[12, k] * v0 + m10 * v1 + m20 * v2 + (a1 * w2 - a2 * w1)
        block[2, k] = m01 * v0 + wrench[13, k] * v1 + m21 * v2 + (a2 * w0 - a0 * w2)
        block[3, k] = m02 * v0 + m12 * v1 + wrench[14, k] * v2 + (a0 * w1 - a1 * w0)
        block[4, k] = w0 * wrench[3, k] + w1 * xz - w2 * xy
        block[5, k] = w1 * m21 - w0 * m20 + w2 * wrench[9, k]
        block[6, k] = w0 * m10 + w1 * wrench[10, k] - w2 * m12
        block[7, k] = w1 * wrench[4, k] + w2 * xy - w0 * yz
        block[8, k] = w0 * wrench[11, k] - w1 * m01 + w2 * m02
        block[9, k] = w2 * wrench[5, k] + w0 * yz - w1 * xz


@inlined
def _turned(turn: Array, k: int, a: Vector) -> Vector:
    return (
        turn[0, k] * a[0] + turn[1, k] * a[1] + turn[2, k] * a[2],
        turn[3, k] * a[0] + turn[4, k] * a[1] + turn[5, k] * a[2],
        turn[6, k] * a[0] + turn[7, k] * a[1] + turn[8, k] * a[2],
    )


@inlined
def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inlined
def _plus(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inlined
def _times(a: Vector, s: float) -> Vector:
    return (a[0] * s, a[1] * s, a[2] * s)


@inlined
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
