"""Newton and Euler's equations of a tree of joints, compiled: motion, mass matrix, bias.

All vectors are in world axes, and wrenches and inertia are about the world's origin, so that those of several
bodies simply add up (Featherstone, Rigid Body Dynamics Algorithms, 2008, sections 5.3 and 6.2). Joints turn
about, or slide along, z of their frame.

Vectors are three numbers, which stay in registers: views of rows cost more than what is done with them. What
steps hand to each other is in `Work`, which a caller makes once for all its ticks.
"""

from typing import Any, NamedTuple

import numpy as np

from module_agent.model.compiled import compiled
from sim.geometry.pose import Array

Indices = np.ndarray[Any, np.dtype[np.int64]]
Vector = tuple[float, float, float]
# Of m joints: parent (-1 for the world), whether it slides, and sign of its position along z, (m,) each;
# rotation (m, 3, 3) and offset (m, 3) of its frame in its parent's.
Joints = tuple[Indices, Indices, Array, Array, Array]
# Masses (m,), centres (m, 3) and inertia about them (m, 3, 3), each in its own frame.
Bodies = tuple[Array, Array, Array]
# Of n IMUs: the body (-1 for the world) and, in its frame, the offset (n, 3) and rotation (n, 3, 3).
Imus = tuple[Indices, Array, Array]


class Work(NamedTuple):
    """What the steps of a calculation hand to each other, for m bodies; (m, 3) where not said otherwise.

    where (m, 3, 3), arm: orientation, and offset from the parent in world axes. spin, travel: the joint's
    unit twist at the world's origin. place: the body's origin. lever, central (m, 3, 3): offset of the centre
    of mass, and inertia about it, in world axes. omega, alpha, accel: angular rate and acceleration, specific
    force of the origin. force, moment: what moves the body. total (m,), first, whole (m, 3, 3): mass, first
    moment and inertia of all that the joint carries.
    """

    where: Array
    arm: Array
    spin: Array
    travel: Array
    place: Array
    lever: Array
    central: Array
    omega: Array
    alpha: Array
    accel: Array
    force: Array
    moment: Array
    total: Array
    first: Array
    whole: Array


@compiled
def work_of(m: int) -> Work:
    """Return the work space of m bodies."""
    return Work(
        np.empty((m, 3, 3)),
        np.empty((m, 3)),
        np.empty((m, 3)),
        np.empty((m, 3)),
        np.empty((m, 3)),
        np.empty((m, 3)),
        np.empty((m, 3, 3)),
        np.empty((m, 3)),
        np.empty((m, 3)),
        np.empty((m, 3)),
        np.empty((m, 3)),
        np.empty((m, 3)),
        np.empty(m),
        np.empty((m, 3)),
        np.empty((m, 3, 3)),
    )


class Tree(NamedTuple):
    """The joints, bodies and IMUs of a robot, and gravity."""

    joints: Joints
    bodies: Bodies
    imus: Imus
    up_m_s2: float


@compiled
def _into(a: Array, i: int, x: float, y: float, z: float) -> Vector:
    """Return the product of the matrix i of (m, 3, 3) with a vector."""
    return (
        a[i, 0, 0] * x + a[i, 0, 1] * y + a[i, 0, 2] * z,
        a[i, 1, 0] * x + a[i, 1, 1] * y + a[i, 1, 2] * z,
        a[i, 2, 0] * x + a[i, 2, 1] * y + a[i, 2, 2] * z,
    )


@compiled
def _cross(a0: float, a1: float, a2: float, b0: float, b1: float, b2: float) -> Vector:
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@compiled
def _swing(alpha: Array, omega: Array, i: int, r0: float, r1: float, r2: float) -> Vector:
    """Return alpha x r + omega x (omega x r), the acceleration of a point of body i against its origin."""
    w0, w1, w2 = omega[i, 0], omega[i, 1], omega[i, 2]
    t0, t1, t2 = _cross(w0, w1, w2, r0, r1, r2)
    c0, c1, c2 = _cross(w0, w1, w2, t0, t1, t2)
    a0, a1, a2 = _cross(alpha[i, 0], alpha[i, 1], alpha[i, 2], r0, r1, r2)
    return a0 + c0, a1 + c1, a2 + c2


@compiled
def _place(joints: Joints, q: Array, w: Work) -> None:
    """Fill in every body's orientation and its offset from its parent, `where` and `arm`."""
    parent, prismatic, sign, rotation, offset = joints
    where, arm = w.where, w.arm
    for i in range(len(parent)):
        p = parent[i]
        slide = sign[i] * q[i] if prismatic[i] else 0.0
        turn = 0.0 if prismatic[i] else sign[i] * q[i]
        co, si = np.cos(turn), np.sin(turn)
        for r in range(3):
            if p >= 0:
                h0, h1, h2 = where[p, r, 0], where[p, r, 1], where[p, r, 2]
            else:
                h0, h1, h2 = 1.0 if r == 0 else 0.0, 1.0 if r == 1 else 0.0, 1.0 if r == 2 else 0.0
            along = h0 * offset[i, 0] + h1 * offset[i, 1] + h2 * offset[i, 2]
            f0 = h0 * rotation[i, 0, 0] + h1 * rotation[i, 1, 0] + h2 * rotation[i, 2, 0]
            f1 = h0 * rotation[i, 0, 1] + h1 * rotation[i, 1, 1] + h2 * rotation[i, 2, 1]
            f2 = h0 * rotation[i, 0, 2] + h1 * rotation[i, 1, 2] + h2 * rotation[i, 2, 2]
            where[i, r, 0] = co * f0 + si * f1
            where[i, r, 1] = co * f1 - si * f0
            where[i, r, 2] = f2
            arm[i, r] = along + slide * f2


@compiled
def _move(joints: Joints, qd: Array, qdd: Array, up_m_s2: float, w: Work) -> None:
    """Fill in every body's angular rate and acceleration, and its origin's specific force; needs `_place`."""
    parent, prismatic, sign = joints[:3]
    where, arm, omega, alpha, accel = w.where, w.arm, w.omega, w.alpha, w.accel
    for i in range(len(parent)):
        p = parent[i]
        w0, w1, w2, al0, al1, al2, ac0, ac1, ac2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, up_m_s2
        if p >= 0:
            w0, w1, w2 = omega[p, 0], omega[p, 1], omega[p, 2]
            al0, al1, al2 = alpha[p, 0], alpha[p, 1], alpha[p, 2]
            s0, s1, s2 = _swing(alpha, omega, p, arm[i, 0], arm[i, 1], arm[i, 2])
            ac0, ac1, ac2 = accel[p, 0] + s0, accel[p, 1] + s1, accel[p, 2] + s2
        z0, z1, z2 = where[i, 0, 2] * sign[i], where[i, 1, 2] * sign[i], where[i, 2, 2] * sign[i]
        own0, own1, own2 = z0 * qd[i], z1 * qd[i], z2 * qd[i]
        c0, c1, c2 = _cross(w0, w1, w2, own0, own1, own2)
        if prismatic[i]:
            ac0 += 2.0 * c0 + z0 * qdd[i]
            ac1 += 2.0 * c1 + z1 * qdd[i]
            ac2 += 2.0 * c2 + z2 * qdd[i]
        else:
            w0, w1, w2 = w0 + own0, w1 + own1, w2 + own2
            al0 += c0 + z0 * qdd[i]
            al1 += c1 + z1 * qdd[i]
            al2 += c2 + z2 * qdd[i]
        omega[i, 0], omega[i, 1], omega[i, 2] = w0, w1, w2
        alpha[i, 0], alpha[i, 1], alpha[i, 2] = al0, al1, al2
        accel[i, 0], accel[i, 1], accel[i, 2] = ac0, ac1, ac2


@compiled
def _feel(imus: Imus, up_m_s2: float, w: Work, gyro: Array, force: Array) -> None:
    """Fill in the angular rates and specific forces (n, 3) in the axes of n IMUs; needs `_move`."""
    body, offset, rotation = imus
    where, omega, accel = w.where, w.omega, w.accel
    for i in range(len(body)):
        b = body[i]
        if b < 0:
            for k in range(3):
                gyro[i, k] = 0.0
                force[i, k] = rotation[i, 2, k] * up_m_s2
            continue
        r0, r1, r2 = _into(where, b, offset[i, 0], offset[i, 1], offset[i, 2])
        s0, s1, s2 = _swing(w.alpha, omega, b, r0, r1, r2)
        t0, t1, t2 = accel[b, 0] + s0, accel[b, 1] + s1, accel[b, 2] + s2
        for k in range(3):
            a0, a1, a2 = _into(where, b, rotation[i, 0, k], rotation[i, 1, k], rotation[i, 2, k])
            gyro[i, k] = a0 * omega[b, 0] + a1 * omega[b, 1] + a2 * omega[b, 2]
            force[i, k] = a0 * t0 + a1 * t1 + a2 * t2


@compiled
def imu_readings(tree: Tree, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
    """Return the angular rates and specific forces (n, 3) in the axes of n IMUs."""
    w, n = work_of(len(q)), len(tree.imus[0])
    gyro, force = np.empty((n, 3)), np.empty((n, 3))
    _place(tree.joints, q, w)
    feel(tree, qd, qdd, w, gyro, force)
    return gyro, force


@compiled
def put_bodies(tree: Tree, q: Array, w: Work) -> None:
    """Put the bodies to where `weigh` has them, for `feel`."""
    _place(tree.joints, q, w)


@compiled
def feel(tree: Tree, qd: Array, qdd: Array, w: Work, gyro: Array, force: Array) -> None:
    """Fill in the same for the positions of the last `weigh`."""
    _move(tree.joints, qd, qdd, tree.up_m_s2, w)
    _feel(tree.imus, tree.up_m_s2, w, gyro, force)


@compiled
def mass_and_biases(tree: Tree, q: Array, rates: Array) -> tuple[Array, Array]:
    """Return the mass matrix (m, m), and the bias forces (R, m) of gravity and each of R velocities (R, m).

    The matrix is computed by composite rigid bodies, the forces by recursive Newton-Euler.
    """
    m = len(q)
    matrix, biases = np.empty((m, m)), np.empty(rates.shape)
    weigh(tree, q, rates, work_of(m), matrix, biases)
    return matrix, biases


@compiled
def weigh(tree: Tree, q: Array, rates: Array, w: Work, matrix: Array, biases: Array) -> None:
    """Fill in what `mass_and_biases` returns."""
    joints, mass = tree.joints, tree.bodies[0]
    _place(joints, q, w)
    _twists(joints, w)
    _masses(tree.bodies, w)
    _composite(joints[0], mass, w, matrix)
    still = np.zeros(len(q))
    for k in range(len(rates)):
        _move(joints, rates[k], still, tree.up_m_s2, w)
        _loads(joints[0], mass, w, biases[k])


@compiled
def joint_loads(tree: Tree, q: Array, body: int, point: Array, force: Array, moment: Array) -> Array:
    """Return the joints' forces or torques (m,) of a wrench w on a body, J^T w.

    The force acts at `point` in the body's frame; force and moment are in world axes.
    """
    joints, w = tree.joints, work_of(len(q))
    _place(joints, q, w)
    _twists(joints, w)
    spin, travel = w.spin, w.travel
    r0, r1, r2 = _into(w.where, body, point[0], point[1], point[2])
    r0, r1, r2 = r0 + w.place[body, 0], r1 + w.place[body, 1], r2 + w.place[body, 2]
    about = _cross(r0, r1, r2, force[0], force[1], force[2])
    loads = np.zeros(len(q))
    i = body
    while i >= 0:
        for k in range(3):
            loads[i] += spin[i, k] * (about[k] + moment[k]) + travel[i, k] * force[k]
        i = joints[0][i]
    return loads


@compiled
def _twists(joints: Joints, w: Work) -> None:
    """Fill in the joints' unit twists, angular and linear at the world's origin, and the bodies' places."""
    parent, prismatic, sign = joints[:3]
    where, arm, spin, travel, at = w.where, w.arm, w.spin, w.travel, w.place
    for i in range(len(parent)):
        p = parent[i]
        for k in range(3):
            at[i, k] = arm[i, k] + (at[p, k] if p >= 0 else 0.0)
            travel[i, k] = sign[i] * where[i, k, 2]
            spin[i, k] = 0.0
        if not prismatic[i]:
            s0, s1, s2 = travel[i, 0], travel[i, 1], travel[i, 2]
            spin[i, 0], spin[i, 1], spin[i, 2] = s0, s1, s2
            travel[i, 0], travel[i, 1], travel[i, 2] = _cross(at[i, 0], at[i, 1], at[i, 2], s0, s1, s2)


@compiled
def _masses(bodies: Bodies, w: Work) -> None:
    """Fill in the centres' offsets and the inertia about the centres, R I R^T, in world axes."""
    _, com, inertia = bodies
    where, lever, central = w.where, w.lever, w.central
    for i in range(len(com)):
        lever[i, 0], lever[i, 1], lever[i, 2] = _into(where, i, com[i, 0], com[i, 1], com[i, 2])
        for r in range(3):
            h0, h1, h2 = where[i, r, 0], where[i, r, 1], where[i, r, 2]
            t0 = h0 * inertia[i, 0, 0] + h1 * inertia[i, 1, 0] + h2 * inertia[i, 2, 0]
            t1 = h0 * inertia[i, 0, 1] + h1 * inertia[i, 1, 1] + h2 * inertia[i, 2, 1]
            t2 = h0 * inertia[i, 0, 2] + h1 * inertia[i, 1, 2] + h2 * inertia[i, 2, 2]
            for c in range(3):
                central[i, r, c] = t0 * where[i, c, 0] + t1 * where[i, c, 1] + t2 * where[i, c, 2]


@compiled
def _composite(parent: Indices, mass: Array, w: Work, matrix: Array) -> None:
    """Fill in the mass matrix: distal inertia of every joint, projected on the joints' twists."""
    at, lever, spin, travel = w.place, w.lever, w.spin, w.travel
    total, first, whole = w.total, w.first, w.whole
    m = len(parent)
    for i in range(m):
        total[i] = mass[i]
        c0, c1, c2 = at[i, 0] + lever[i, 0], at[i, 1] + lever[i, 1], at[i, 2] + lever[i, 2]
        square = c0**2 + c1**2 + c2**2
        first[i, 0], first[i, 1], first[i, 2] = mass[i] * c0, mass[i] * c1, mass[i] * c2
        for a in range(3):
            moment = first[i, a]
            for b in range(3):
                whole[i, a, b] = w.central[i, a, b]
            whole[i, a, a] += mass[i] * square
            whole[i, a, 0] -= moment * c0
            whole[i, a, 1] -= moment * c1
            whole[i, a, 2] -= moment * c2
        for j in range(m):
            matrix[i, j] = 0.0
    for i in range(m - 1, -1, -1):
        # Momentum, linear and about the origin, of all that joint i carries at its unit rate.
        s0, s1, s2 = spin[i, 0], spin[i, 1], spin[i, 2]
        t0, t1, t2 = travel[i, 0], travel[i, 1], travel[i, 2]
        l0, l1, l2 = _cross(s0, s1, s2, first[i, 0], first[i, 1], first[i, 2])
        a0, a1, a2 = _cross(first[i, 0], first[i, 1], first[i, 2], t0, t1, t2)
        p0, p1, p2 = _into(whole, i, s0, s1, s2)
        l0, l1, l2 = l0 + total[i] * t0, l1 + total[i] * t1, l2 + total[i] * t2
        a0, a1, a2 = a0 + p0, a1 + p1, a2 + p2
        j = i
        while j >= 0:
            value = spin[j, 0] * a0 + travel[j, 0] * l0
            value += spin[j, 1] * a1 + travel[j, 1] * l1
            value += spin[j, 2] * a2 + travel[j, 2] * l2
            matrix[i, j] = value
            matrix[j, i] = value
            j = parent[j]
        p = parent[i]
        if p >= 0:
            total[p] += total[i]
            for a in range(3):
                first[p, a] += first[i, a]
                for b in range(3):
                    whole[p, a, b] += whole[i, a, b]


@compiled
def _loads(parent: Indices, mass: Array, w: Work, loads: Array) -> None:
    """Fill in the joints' loads (m,): m a and I alpha + omega x I omega of all that each of them carries."""
    spin, travel, lever, omega, alpha = w.spin, w.travel, w.lever, w.omega, w.alpha
    at, force, moment = w.place, w.force, w.moment
    m = len(parent)
    for i in range(m):
        s0, s1, s2 = _swing(alpha, omega, i, lever[i, 0], lever[i, 1], lever[i, 2])
        f0 = (w.accel[i, 0] + s0) * mass[i]
        f1 = (w.accel[i, 1] + s1) * mass[i]
        f2 = (w.accel[i, 2] + s2) * mass[i]
        r0, r1, r2 = at[i, 0] + lever[i, 0], at[i, 1] + lever[i, 1], at[i, 2] + lever[i, 2]
        m0, m1, m2 = _cross(r0, r1, r2, f0, f1, f2)
        w0, w1, w2 = omega[i, 0], omega[i, 1], omega[i, 2]
        c0, c1, c2 = _into(w.central, i, w0, w1, w2)
        x0, x1, x2 = _cross(w0, w1, w2, c0, c1, c2)
        c0, c1, c2 = _into(w.central, i, alpha[i, 0], alpha[i, 1], alpha[i, 2])
        force[i, 0], force[i, 1], force[i, 2] = f0, f1, f2
        moment[i, 0], moment[i, 1], moment[i, 2] = m0 + (c0 + x0), m1 + (c1 + x1), m2 + (c2 + x2)
    for i in range(m - 1, -1, -1):
        value = spin[i, 0] * moment[i, 0] + travel[i, 0] * force[i, 0]
        value += spin[i, 1] * moment[i, 1] + travel[i, 1] * force[i, 1]
        value += spin[i, 2] * moment[i, 2] + travel[i, 2] * force[i, 2]
        loads[i] = value
        p = parent[i]
        if p >= 0:
            for k in range(3):
                force[p, k] += force[i, k]
                moment[p, k] += moment[i, k]
