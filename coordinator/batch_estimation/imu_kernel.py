"""The arithmetic of IMU readings, of their derivatives and of links' loads, compiled; `imu_prediction`,
`imu_jacobian` and `link_compliance` say what it computes.

As in `regressor_kernel` the innermost loops run over the samples of a group, in lanes: compilers make vector
instructions of loops over arrays whose rows are a constant distance apart.
"""

from math import cos, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.model.chain import Array
from module_agent.model.compiled import compiled, inlined

Index = NDArray[np.int64]
Vector = tuple[float, float, float]

# Samples in a group. Of 16 the compiler unrolls its loops, which takes twice the time.
LANES = 64


class _Group(NamedTuple):
    """What is known of a group of samples at the body that is being worked on, in lanes.

    seen: the IMU relative to the body, in its frame: orientation row by row (9), place (3), velocity (3).
    body: its angular rate, angular acceleration and acceleration against free fall (3 each).
    slopes: how a displacement [theta, u] of the IMU changes the specific force, in the body's frame: by theta
        and by u, 3 by 3 each, row by row.
    mixed: from changes in the body's frame to weighted readings, 3 by 3 each: of gyros by rates, of gyros by
        specific forces, of accelerometers by specific forces.
    cause: six signals, their rates and accelerations. twist: the displacement [theta, u] that they make, its
        rate and its acceleration. signals: sine, cosine and rate of a joint.
    change: of rate and specific force by some displacement, in the body's frame. block: of the weighted
    readings, a column of the Jacobian.
    """

    seen: Array
    body: Array
    slopes: Array
    mixed: Array
    cause: Array
    twist: Array
    signals: Array
    change: Array
    block: Array


class Path(NamedTuple):
    """What an IMU's readings depend on.

    modules: (k,) from the root to the IMU's own. turned: whether the latter's own joint turns the IMU.
    axis, point: (n, 3) of all joints. home: (4, 4) of the IMU.
    """

    modules: Index
    turned: bool
    axis: Array
    point: Array
    home: Array


class Turns(NamedTuple):
    """How links turn, k small turns of n links: the i-th link has those from first[i] to first[i + 1].

    first: (n + 1,). hinge: (k, 3). theta: (k, 9, m) rotation vector, its first and its second derivative.
    """

    first: Index
    hinge: Array
    theta: Array


class KernelDisplacements(NamedTuple):
    """`Displacements` as kernels take them.

    causes: (g, s, 18, LANES) of g groups of samples and s causes six signals, their first and second time
        derivatives. cause: (l,) of l displacements. maps: (l, 6, 6) from those signals to turn and shift.
    """

    causes: Array
    cause: Index
    maps: Array


class Carried(NamedTuple):
    """What every one of n links carries, as masses at places of the root frame at q = 0.

    own, link: (n,) [kg] of the module and of the link below it. at, middle: (n, 3) where these are.
    hinge: (n, 3) about which the link turns. flipped: (n,) whether the module is mounted reversed.
    """

    own: Array
    link: Array
    at: Array
    middle: Array
    hinge: Array
    flipped: NDArray[np.bool_]


@compiled
def fill_bodies(parent: Index, axis: Array, point: Array, joints: Array, turns: Turns, bodies: Array) -> None:
    """Write the motion of the bodies of n joints, m samples; that of the base, the last one, is given.

    At a point of the axis both bodies accelerate alike (Craig, Introduction to Robotics, eqs 6.45-6.48).

    Args:
        parent: (n,) body below every joint, -1 for the base; before its children.
        axis, point: (n, 3) of the joints at q = 0.
        joints: (3, m, n) positions, velocities and accelerations.
        turns: of the links below the joints.
        bodies: (n + 1, 9, m) angular rate, angular acceleration, acceleration against free fall.
    """
    count = len(parent)
    for i in range(count):
        below = parent[i] if parent[i] >= 0 else count
        j = (axis[i, 0], axis[i, 1], axis[i, 2])
        p = (point[i, 0], point[i, 1], point[i, 2])
        for s in range(joints.shape[1]):
            q, qd, qdd = joints[0, s, i], joints[1, s, i], joints[2, s, i]
            si, co = -sin(q), cos(q)
            w, dw, a = _beyond_link(bodies, below, turns, i, s)
            a = _at(p, w, dw, a)
            w, dw, a = _turned(j, si, co, w), _turned(j, si, co, dw), _turned(j, si, co, a)
            spin = _times(j, qd)
            dw = _plus(dw, _plus(_cross(w, spin), _times(j, qdd)))
            w = _plus(w, spin)
            a = _minus(a, _plus(_cross(dw, p), _cross(w, _cross(w, p))))
            bodies[i, 0, s], bodies[i, 1, s], bodies[i, 2, s] = w
            bodies[i, 3, s], bodies[i, 4, s], bodies[i, 5, s] = dw
            bodies[i, 6, s], bodies[i, 7, s], bodies[i, 8, s] = a


@compiled
def fill_readings(
    carrier: Index, home: Array, turns: Turns, bodies: Array, gyro: Array, accel: Array
) -> None:
    """Write what ideal IMUs read, (m, n, 3) each.

    Args:
        carrier: (n,) body that every IMU is on, -1 for the base.
        home: (n, 4, 4) of the IMUs.
        turns: between that body and the IMU.
        bodies: (n + 1, 9, m) of `fill_bodies`.
    """
    for k in range(len(carrier)):
        body = carrier[k] if carrier[k] >= 0 else len(bodies) - 1
        x = (home[k, 0, 3], home[k, 1, 3], home[k, 2, 3])
        for s in range(gyro.shape[0]):
            w, dw, a = _beyond_link(bodies, body, turns, k, s)
            a = _at(x, w, dw, a)
            for c in range(3):
                gyro[s, k, c] = w[0] * home[k, 0, c] + w[1] * home[k, 1, c] + w[2] * home[k, 2, c]
                accel[s, k, c] = a[0] * home[k, 0, c] + a[1] * home[k, 1, c] + a[2] * home[k, 2, c]


@compiled
def fill_loads(
    parent: Index,
    axis: Array,
    point: Array,
    q: Array,
    carried: Carried,
    turns: Turns,
    bodies: Array,
    loads: Array,
) -> None:
    """Write force and moment about its hinge, (n, 6, m), of all that hangs on the link below every joint.

    Args:
        parent, axis, point: of `fill_bodies`.
        q: (m, n) positions.
        carried: masses. Links on the base are no links, and have no load.
        turns, bodies: as of `fill_bodies`.
        loads: (n, 6, m) zeros; in the frame of the body that the link starts from.
    """
    count = len(parent)
    beyond = np.zeros((count, 6, len(q)))  # force on every body, and its moment about the root's origin
    for i in range(count - 1, -1, -1):
        x, middle = carried.at[i], carried.middle[i]
        at, mid = (x[0], x[1], x[2]), (middle[0], middle[1], middle[2])
        j = (axis[i, 0], axis[i, 1], axis[i, 2])
        p = (point[i, 0], point[i, 1], point[i, 2])
        h = (carried.hinge[i, 0], carried.hinge[i, 1], carried.hinge[i, 2])
        below = parent[i]
        for s in range(len(q)):
            f = (beyond[i, 0, s], beyond[i, 1, s], beyond[i, 2, s])
            t = (beyond[i, 3, s], beyond[i, 4, s], beyond[i, 5, s])
            if carried.flipped[i]:
                w, dw, a = _motion(bodies, i, s)
                one = _times(_at(at, w, dw, a), -carried.own[i])
                f, t = _plus(f, one), _plus(t, _cross(at, one))
            if below < 0:
                continue
            si, co = sin(q[s, i]), cos(q[s, i])
            t = _turned(j, si, co, _minus(t, _cross(p, f)))
            f = _turned(j, si, co, f)
            t = _plus(t, _cross(p, f))
            w, dw, a = _beyond_link(bodies, below, turns, i, s)
            one = _times(_at(mid, w, dw, a), -carried.link[i])
            f, t = _plus(f, one), _plus(t, _cross(mid, one))
            if not carried.flipped[i]:
                one = _times(_at(at, w, dw, a), -carried.own[i])
                f, t = _plus(f, one), _plus(t, _cross(at, one))
            loads[i, 0, s], loads[i, 1, s], loads[i, 2, s] = f
            loads[i, 3, s], loads[i, 4, s], loads[i, 5, s] = _minus(t, _cross(h, f))
            beyond[below, 0, s] += f[0]
            beyond[below, 1, s] += f[1]
            beyond[below, 2, s] += f[2]
            beyond[below, 3, s] += t[0]
            beyond[below, 4, s] += t[1]
            beyond[below, 5, s] += t[2]


@compiled
def fill_slopes(
    path: Path,
    bodies: Array,
    signals: Array,
    displaced: KernelDisplacements,
    numbers: Index,
    first: Index,
    mixing: Array,
    weight: Array,
    whole: bool,
    begin: int,
    shared: Array,
    placed: Array,
) -> None:
    """Write the weighted slopes of one IMU's readings at m of m' samples, a multiple of `LANES`.

    Args:
        path: what it depends on, k modules.
        bodies: (n + 1, 9, m') of `fill_bodies`.
        signals: (3, n, m') sine and cosine of the joints' positions, and their rates.
        displaced: l displacements.
        numbers: (p,) those of them that move the IMU. first: (k + 1,) of these numbers those from first[i] to
            first[i + 1] are of the link or the joint of the path's i-th module.
        mixing: (6, 6) from true rates and forces to readings.
        weight: (2, m') of gyros and accelerometers.
        whole: whether the slopes by the modules' twists, gravity and the IMU's placement are wanted, too.
        begin: the first sample, a multiple of `LANES`.
        shared: (at least 6 k + 3 + p, 6, m) by the modules' twists, gravity, and the p displacements; if not
            `whole`, (p, 6, m) by these.
        placed: (6, 6, m) by the IMU's own turn and displacement in its own axes.
    """
    modules, count = path.modules, len(bodies) - 1
    last, by_poses = len(modules) - 1, 6 * len(modules)
    top = last + 1 if path.turned else last
    group = _new_group()
    for start in range(0, shared.shape[2], LANES):
        at = begin + start
        _set_home(group, path.home)
        cause = -1
        for i in range(top, -1, -1):
            _set_slopes(group, bodies, modules[i - 1] if i > 0 else count, mixing, weight, at)
            # One loop for columns of all kinds: what is written once is compiled once.
            own = 6 if i == top and whole else 0
            poses = own + (6 if i <= last and whole else 0)
            twisted = poses + (first[i + 1] - first[i] if i <= last else 0)
            for c in range(twisted + (3 if i == 0 and whole else 0)):
                if c < own:
                    _set_placed(group, path.home, c)
                elif c < poses:
                    _set_still(group, _unit(c - own), _unit(c - own - 3))
                elif c < twisted:
                    p = numbers[first[i] + c - poses]
                    if displaced.cause[p] != cause:
                        cause = displaced.cause[p]
                        _set_cause(group, displaced.causes[at // LANES, cause])
                    _set_twisted(group, displaced.maps[p])
                else:
                    _set_force(group, c - twisted)
                _mix(group)
                if c < own:
                    _write(group, placed, c, start)
                elif c < poses:
                    _write_pose(group, i, last, c - own, shared, start)
                elif c < twisted:
                    to = first[i] + c - poses
                    _write(group, shared, to + by_poses + 3 if whole else to, start)
                else:
                    _write(group, shared, by_poses + c - twisted, start)
            if i > 0:
                _step_below(group, path, signals, modules[i - 1], at)


@compiled
def add_upper(information: Array, part: Array, at: Index) -> None:
    """Add the upper triangle of a part to that of `information` at the rows and columns `at`."""
    for a in range(len(at)):
        for b in range(a, len(at)):
            information[min(at[a], at[b]), max(at[a], at[b])] += part[a, b]


@inlined
def _new_group() -> _Group:
    return _Group(
        seen=np.empty((15, LANES)),
        body=np.empty((9, LANES)),
        slopes=np.empty((18, LANES)),
        mixed=np.empty((27, LANES)),
        cause=np.zeros((18, LANES)),
        twist=np.zeros((18, LANES)),
        signals=np.empty((3, LANES)),
        change=np.empty((6, LANES)),
        block=np.empty((6, LANES)),
    )


@inlined
def _write(group: _Group, out: Array, row: int, start: int) -> None:
    for a in range(6):
        for k in range(LANES):
            out[row, a, start + k] = group.block[a, k]


@inlined
def _set_home(group: _Group, home: Array) -> None:
    for i in range(3):
        for j in range(3):
            for k in range(LANES):
                group.seen[3 * i + j, k] = home[i, j]
        for k in range(LANES):
            group.seen[9 + i, k] = home[i, 3]
            group.seen[12 + i, k] = 0.0


@inlined
def _step_below(group: _Group, path: Path, signals: Array, joint: int, start: int) -> None:
    """See the IMU from the body below a joint instead of that beyond it."""
    seen, now = group.seen, group.signals
    for row in range(3):
        for k in range(LANES):
            now[row, k] = signals[row, joint, start + k]
    j = (path.axis[joint, 0], path.axis[joint, 1], path.axis[joint, 2])
    p = (path.point[joint, 0], path.point[joint, 1], path.point[joint, 2])
    for column in range(3):
        for k in range(LANES):
            v = (seen[column, k], seen[3 + column, k], seen[6 + column, k])
            seen[column, k], seen[3 + column, k], seen[6 + column, k] = _turned(j, now[0, k], now[1, k], v)
    for k in range(LANES):
        off = _minus((seen[9, k], seen[10, k], seen[11, k]), p)
        off = _turned(j, now[0, k], now[1, k], off)
        v = _turned(j, now[0, k], now[1, k], (seen[12, k], seen[13, k], seen[14, k]))
        seen[9, k], seen[10, k], seen[11, k] = _plus(p, off)
        seen[12, k], seen[13, k], seen[14, k] = _plus(v, _cross(_times(j, now[2, k]), off))


@inlined
def _set_slopes(group: _Group, bodies: Array, body: int, mixing: Array, weight: Array, start: int) -> None:
    """Set the slopes by displacements at a body, and the way from there to weighted readings.

    With the IMU at x, moving at x' in the body's frame, its specific force there is a + alpha x x + omega x
    (omega x x) + 2 omega x x' + x''. A displacement turns R, x, x' and x'' by theta and moves x by u; what is
    turned with R cancels.
    """
    seen, b, slopes, mixed = group.seen, group.body, group.slopes, group.mixed
    for row in range(9):
        for k in range(LANES):
            b[row, k] = bodies[body, row, start + k]
    for k in range(LANES):
        w, dw = (b[0, k], b[1, k], b[2, k]), (b[3, k], b[4, k], b[5, k])
        x, v = (seen[9, k], seen[10, k], seen[11, k]), (seen[12, k], seen[13, k], seen[14, k])
        f = _plus((b[6, k], b[7, k], b[8, k]), _plus(_cross(dw, x), _cross(w, _cross(w, x))))
        f = _plus(f, _times(_cross(w, v), 2.0))
        for c in range(3):
            e = (1.0 if c == 0 else 0.0, 1.0 if c == 1 else 0.0, 1.0 if c == 2 else 0.0)
            d = _cross(e, x)
            by_turn = _plus(_cross(f, e), _times(_cross(w, _cross(e, v)), 2.0))
            by_turn = _plus(by_turn, _plus(_cross(dw, d), _cross(w, _cross(w, d))))
            slopes[c, k], slopes[3 + c, k], slopes[6 + c, k] = by_turn
            by_shift = _plus(_cross(dw, e), _cross(w, _cross(w, e)))
            slopes[9 + c, k], slopes[12 + c, k], slopes[15 + c, k] = by_shift
    for i in range(3):
        for j in range(3):
            g0, g1, g2 = mixing[i, 0], mixing[i, 1], mixing[i, 2]
            s0, s1, s2 = mixing[i, 3], mixing[i, 4], mixing[i, 5]
            a0, a1, a2 = mixing[3 + i, 3], mixing[3 + i, 4], mixing[3 + i, 5]
            for k in range(LANES):
                r0, r1, r2 = seen[3 * j, k], seen[3 * j + 1, k], seen[3 * j + 2, k]
                mixed[3 * i + j, k] = g0 * r0 + g1 * r1 + g2 * r2
                mixed[9 + 3 * i + j, k] = s0 * r0 + s1 * r1 + s2 * r2
                mixed[18 + 3 * i + j, k] = a0 * r0 + a1 * r1 + a2 * r2
    for row in range(27):
        of = 0 if row < 18 else 1
        for k in range(LANES):
            mixed[row, k] *= weight[of, start + k]


@inlined
def _set_still(group: _Group, theta: Vector, u: Vector) -> None:
    """Set the change, in the body's frame, by a constant displacement."""
    b, slopes, change = group.body, group.slopes, group.change
    for k in range(LANES):
        change[0, k], change[1, k], change[2, k] = _cross((b[0, k], b[1, k], b[2, k]), theta)
    for i in range(3):
        for k in range(LANES):
            by_turn = (
                slopes[3 * i, k] * theta[0]
                + slopes[3 * i + 1, k] * theta[1]
                + slopes[3 * i + 2, k] * theta[2]
            )
            by_shift = (
                slopes[9 + 3 * i, k] * u[0] + slopes[10 + 3 * i, k] * u[1] + slopes[11 + 3 * i, k] * u[2]
            )
            change[3 + i, k] = by_turn + by_shift


@inlined
def _set_placed(group: _Group, home: Array, c: int) -> None:
    """Set the change by the IMU's own turn, about itself, or of its displacement; at its carrier."""
    axis = c % 3
    t, x = (home[0, axis], home[1, axis], home[2, axis]), (home[0, 3], home[1, 3], home[2, 3])
    one = 1.0 if c < 3 else 0.0
    _set_still(group, _times(t, one), _plus(_times(_cross(x, t), one), _times(t, 1.0 - one)))


@inlined
def _set_cause(group: _Group, signals: Array) -> None:
    for row in range(18):
        for k in range(LANES):
            group.cause[row, k] = signals[row, k]


@inlined
def _set_twisted(group: _Group, by_cause: Array) -> None:
    """Set the change, in the body's frame, by a time-varying displacement."""
    seen, b, slopes, change = group.seen, group.body, group.slopes, group.change
    cause, t = group.cause, group.twist
    for row in range(6):
        m0, m1, m2 = by_cause[row, 0], by_cause[row, 1], by_cause[row, 2]
        m3, m4, m5 = by_cause[row, 3], by_cause[row, 4], by_cause[row, 5]
        for d in range(0, 18, 6):
            for k in range(LANES):
                t[d + row, k] = (
                    m0 * cause[d, k]
                    + m1 * cause[d + 1, k]
                    + m2 * cause[d + 2, k]
                    + m3 * cause[d + 3, k]
                    + m4 * cause[d + 4, k]
                    + m5 * cause[d + 5, k]
                )
    for k in range(LANES):
        w, theta, rate = (b[0, k], b[1, k], b[2, k]), (t[0, k], t[1, k], t[2, k]), (t[6, k], t[7, k], t[8, k])
        change[0, k], change[1, k], change[2, k] = _plus(_cross(w, theta), rate)
    for k in range(LANES):
        w, x, v = (
            (b[0, k], b[1, k], b[2, k]),
            (seen[9, k], seen[10, k], seen[11, k]),
            (seen[12, k], seen[13, k], seen[14, k]),
        )
        rate, du = (t[6, k], t[7, k], t[8, k]), (t[9, k], t[10, k], t[11, k])
        f = _times(_plus(_cross(w, _plus(_cross(rate, x), du)), _cross(rate, v)), 2.0)
        change[3, k], change[4, k], change[5, k] = f
    for k in range(LANES):
        x, spin, ddu = (
            (seen[9, k], seen[10, k], seen[11, k]),
            (t[12, k], t[13, k], t[14, k]),
            (t[15, k], t[16, k], t[17, k]),
        )
        f = _plus(_cross(spin, x), ddu)
        change[3, k] += f[0]
        change[4, k] += f[1]
        change[5, k] += f[2]
    for i in range(3):
        for k in range(LANES):
            by_turn = (
                slopes[3 * i, k] * t[0, k] + slopes[3 * i + 1, k] * t[1, k] + slopes[3 * i + 2, k] * t[2, k]
            )
            by_shift = (
                slopes[9 + 3 * i, k] * t[3, k]
                + slopes[10 + 3 * i, k] * t[4, k]
                + slopes[11 + 3 * i, k] * t[5, k]
            )
            change[3 + i, k] += by_turn + by_shift


@inlined
def _set_force(group: _Group, c: int) -> None:
    """Set the change, in the body's frame, to a unit of specific force."""
    for i in range(6):
        one = 1.0 if i == 3 + c else 0.0
        for k in range(LANES):
            group.change[i, k] = one


@inlined
def _mix(group: _Group) -> None:
    """Turn the change in the body's frame into one of weighted readings, a column of the Jacobian."""
    mixed, change, block = group.mixed, group.change, group.block
    for i in range(3):
        for k in range(LANES):
            by_rate = (
                mixed[3 * i, k] * change[0, k]
                + mixed[3 * i + 1, k] * change[1, k]
                + mixed[3 * i + 2, k] * change[2, k]
            )
            by_force = (
                mixed[9 + 3 * i, k] * change[3, k]
                + mixed[10 + 3 * i, k] * change[4, k]
                + mixed[11 + 3 * i, k] * change[5, k]
            )
            block[i, k] = by_rate + by_force
        for k in range(LANES):
            block[3 + i, k] = (
                mixed[18 + 3 * i, k] * change[3, k]
                + mixed[19 + 3 * i, k] * change[4, k]
                + mixed[20 + 3 * i, k] * change[5, k]
            )


@inlined
def _write_pose(group: _Group, i: int, last: int, c: int, shared: Array, start: int) -> None:
    """Write one slope at the body below the path's i-th module.

    A perturbation xi of module a makes the turn exp(S q) of its joint into exp(xi) exp(S q) exp(-xi): all
    beyond the joint is displaced by xi in the frame of the body below, and by -xi in that of the body beyond.
    """
    here, below = 6 * i + c, 6 * i - 6 + c
    kept = 0.0 if i == last else 1.0
    for a in range(6):
        for k in range(LANES):
            # Nothing is read of the first, which may be anything.
            before = shared[here, a, start + k] if kept > 0.0 else 0.0
            shared[here, a, start + k] = before + group.block[a, k]
        if i > 0:
            for k in range(LANES):
                shared[below, a, start + k] = -group.block[a, k]


@inlined
def _motion(bodies: Array, body: int, s: int) -> tuple[Vector, Vector, Vector]:
    """Return angular rate, angular acceleration and acceleration against free fall of a body at a sample."""
    w = (bodies[body, 0, s], bodies[body, 1, s], bodies[body, 2, s])
    dw = (bodies[body, 3, s], bodies[body, 4, s], bodies[body, 5, s])
    return w, dw, (bodies[body, 6, s], bodies[body, 7, s], bodies[body, 8, s])


@inlined
def _beyond_link(bodies: Array, body: int, turns: Turns, i: int, s: int) -> tuple[Vector, Vector, Vector]:
    """Return the motion beyond the i-th link, which starts from a body: `imu_prediction.given`."""
    w, dw, a = _motion(bodies, body, s)
    for k in range(turns.first[i], turns.first[i + 1]):
        h, th = turns.hinge[k], turns.theta[k]
        hinge = (h[0], h[1], h[2])
        angle, rate = (th[0, s], th[1, s], th[2, s]), (th[3, s], th[4, s], th[5, s])
        a = _at(hinge, w, dw, a)
        a = _minus(a, _cross(angle, a))
        gained = _plus((th[6, s], th[7, s], th[8, s]), _cross(w, rate))
        dw = _plus(dw, _minus(gained, _cross(angle, dw)))
        w = _plus(w, _minus(rate, _cross(angle, w)))
        a = _at(_times(hinge, -1.0), w, dw, a)
    return w, dw, a


@inlined
def _at(p: Vector, w: Vector, dw: Vector, a: Vector) -> Vector:
    """Return the acceleration of a point that is fixed to a body."""
    return _plus(a, _plus(_cross(dw, p), _cross(w, _cross(w, p))))


@inlined
def _unit(c: int) -> Vector:
    return (1.0 if c == 0 else 0.0, 1.0 if c == 1 else 0.0, 1.0 if c == 2 else 0.0)


@inlined
def _turned(j: Vector, si: float, co: float, v: Vector) -> Vector:
    """Return a vector turned about an axis, by sine and cosine of the angle: Rodrigues' formula."""
    along = (1.0 - co) * (j[0] * v[0] + j[1] * v[1] + j[2] * v[2])
    return _plus(_plus(_times(v, co), _times(_cross(j, v), si)), _times(j, along))


@inlined
def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inlined
def _plus(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inlined
def _minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@inlined
def _times(a: Vector, s: float) -> Vector:
    return (a[0] * s, a[1] * s, a[2] * s)
