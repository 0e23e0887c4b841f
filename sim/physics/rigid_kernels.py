"""Newton and Euler's equations of a tree of joints, compiled: motion, mass matrix, bias.

All vectors are in world axes, and wrenches and inertia are about the world's origin, so that those of several
bodies simply add up (Featherstone, Rigid Body Dynamics Algorithms, 2008, sections 5.3 and 6.2). Joints turn
about, or slide along, z of their frame.

Arrays are assigned element by element: assigning one to a slice takes five seconds more to compile, for the
message of the error that it might raise.
"""

from typing import Any

import numpy as np

from module_agent.model.compiled import compiled
from sim.geometry.pose import Array

Indices = np.ndarray[Any, np.dtype[np.int64]]
# Of m joints: parent (-1 for the world), whether it slides, and sign of its position along z, (m,) each;
# rotation (m, 3, 3) and offset (m, 3) of its frame in its parent's.
Joints = tuple[Indices, Indices, Array, Array, Array]
# Masses (m,), centres (m, 3) and inertia about them (m, 3, 3), each in its own frame.
Bodies = tuple[Array, Array, Array]
# Of n IMUs: the body (-1 for the world) and, in its frame, the offset (n, 3) and rotation (n, 3, 3).
Imus = tuple[Indices, Array, Array]


@compiled
def _into(a: Array, x: Array, out: Array) -> None:
    for r in range(3):
        out[r] = a[r, 0] * x[0] + a[r, 1] * x[1] + a[r, 2] * x[2]


@compiled
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@compiled
def _add_swing(alpha: Array, omega: Array, r: Array, work: Array, out: Array) -> None:
    """Add alpha x r + omega x (omega x r), the acceleration of a point of a body against its origin."""
    _cross(omega, r, work[0])
    _cross(omega, work[0], work[1])
    _cross(alpha, r, work[0])
    for k in range(3):
        out[k] += work[0, k] + work[1, k]


@compiled
def _turned(a: Array, b: Array, out: Array) -> None:
    for r in range(3):
        for c in range(3):
            out[r, c] = a[r, 0] * b[0, c] + a[r, 1] * b[1, c] + a[r, 2] * b[2, c]


@compiled
def _place(joints: Joints, q: Array) -> tuple[Array, Array]:
    """Return every body's orientation (m, 3, 3) and its offset from its parent in world axes (m, 3)."""
    parent, prismatic, sign, rotation, offset = joints
    m = len(parent)
    where, arm = np.empty((m, 3, 3)), np.empty((m, 3))
    world, fixed = np.eye(3), np.empty((3, 3))
    for i in range(m):
        held = where[parent[i]] if parent[i] >= 0 else world
        _into(held, offset[i], arm[i])
        _turned(held, rotation[i], fixed)
        slide = sign[i] * q[i] if prismatic[i] else 0.0
        turn = 0.0 if prismatic[i] else sign[i] * q[i]
        co, si = np.cos(turn), np.sin(turn)
        for r in range(3):
            where[i, r, 0] = co * fixed[r, 0] + si * fixed[r, 1]
            where[i, r, 1] = co * fixed[r, 1] - si * fixed[r, 0]
            where[i, r, 2] = fixed[r, 2]
            arm[i, r] += slide * fixed[r, 2]
    return where, arm


@compiled
def _move(
    joints: Joints, where: Array, arm: Array, qd: Array, qdd: Array, up_m_s2: float
) -> tuple[Array, Array, Array]:
    """Return every body's angular rate and acceleration, and its origin's specific force, (m, 3) each."""
    parent, prismatic, sign = joints[:3]
    m = len(parent)
    omega, alpha, accel = np.empty((m, 3)), np.empty((m, 3)), np.empty((m, 3))
    still, work, own = np.zeros(3), np.empty((2, 3)), np.empty(3)
    for i in range(m):
        p = parent[i]
        held = omega[p] if p >= 0 else still
        for k in range(3):
            omega[i, k] = held[k]
            alpha[i, k] = alpha[p, k] if p >= 0 else 0.0
            accel[i, k] = accel[p, k] if p >= 0 else (up_m_s2 if k == 2 else 0.0)
            own[k] = where[i, k, 2] * sign[i] * qd[i]
        if p >= 0:
            _add_swing(alpha[p], held, arm[i], work, accel[i])
        _cross(held, own, work[0])
        for k in range(3):
            change = where[i, k, 2] * sign[i] * qdd[i]
            if prismatic[i]:
                accel[i, k] += 2.0 * work[0, k] + change
            else:
                omega[i, k] += own[k]
                alpha[i, k] += work[0, k] + change
    return omega, alpha, accel


@compiled
def imu_readings(
    joints: Joints, imus: Imus, q: Array, qd: Array, qdd: Array, up_m_s2: float
) -> tuple[Array, Array]:
    """Return angular rate and specific force (n, 3) in the axes of n IMUs."""
    body, imu_offset, imu_rotation = imus
    n = len(body)
    where, arm = _place(joints, q)
    omega, alpha, accel = _move(joints, where, arm, qd, qdd, up_m_s2)
    gyro, force = np.zeros((n, 3)), np.zeros((n, 3))
    work, r, total, axes = np.empty((2, 3)), np.empty(3), np.empty(3), np.empty((3, 3))
    for i in range(n):
        b = body[i]
        if b < 0:
            for k in range(3):
                force[i, k] = imu_rotation[i, 2, k] * up_m_s2
            continue
        _into(where[b], imu_offset[i], r)
        for k in range(3):
            total[k] = accel[b, k]
        _add_swing(alpha[b], omega[b], r, work, total)
        _turned(where[b], imu_rotation[i], axes)
        for k in range(3):
            for row in range(3):
                gyro[i, k] += axes[row, k] * omega[b, row]
                force[i, k] += axes[row, k] * total[row]
    return gyro, force


@compiled
def mass_and_biases(
    joints: Joints, bodies: Bodies, q: Array, rates: Array, up_m_s2: float
) -> tuple[Array, Array]:
    """Return the mass matrix (m, m), and the bias forces (R, m) of gravity and each of R velocities (R, m).

    The matrix is computed by composite rigid bodies, the forces by recursive Newton-Euler.
    """
    parent, mass = joints[0], bodies[0]
    where, arm = _place(joints, q)
    twists = _twists(joints, where, arm)
    lever, central = _masses(bodies, where)
    matrix = _composite(parent, twists, mass, lever, central)
    biases, still = np.empty(rates.shape), np.zeros(len(q))
    for k in range(len(rates)):
        motion = _move(joints, where, arm, rates[k], still, up_m_s2)
        loads = _loads(parent, twists, mass, lever, central, motion)
        for i in range(len(q)):
            biases[k, i] = loads[i]
    return matrix, biases


@compiled
def joint_loads(joints: Joints, q: Array, body: int, point: Array, force: Array, moment: Array) -> Array:
    """Return the joints' forces or torques (m,) of a wrench w on a body, J^T w.

    The force acts at `point` in the body's frame; force and moment are in world axes.
    """
    where, arm = _place(joints, q)
    spin, travel, place = _twists(joints, where, arm)
    at, about = np.empty(3), np.empty(3)
    _into(where[body], point, at)
    for k in range(3):
        at[k] += place[body, k]
    _cross(at, force, about)
    loads = np.zeros(len(q))
    i = body
    while i >= 0:
        for k in range(3):
            loads[i] += spin[i, k] * (about[k] + moment[k]) + travel[i, k] * force[k]
        i = joints[0][i]
    return loads


@compiled
def _twists(joints: Joints, where: Array, arm: Array) -> tuple[Array, Array, Array]:
    """Return the joints' unit twists, angular and linear at the world's origin, and the bodies' places."""
    parent, prismatic, sign = joints[:3]
    m = len(parent)
    spin, travel, place = np.zeros((m, 3)), np.empty((m, 3)), np.empty((m, 3))
    for i in range(m):
        for k in range(3):
            place[i, k] = arm[i, k] + (place[parent[i], k] if parent[i] >= 0 else 0.0)
            travel[i, k] = sign[i] * where[i, k, 2]
        if not prismatic[i]:
            for k in range(3):
                spin[i, k] = travel[i, k]
            _cross(place[i], spin[i], travel[i])
    return spin, travel, place


@compiled
def _masses(bodies: Bodies, where: Array) -> tuple[Array, Array]:
    """Return the centres' arms (m, 3) and the inertia about the centres, R I R^T, in world axes (m, 3, 3)."""
    _, com, inertia = bodies
    m = len(com)
    lever, central, turned = np.empty((m, 3)), np.empty((m, 3, 3)), np.empty((3, 3))
    for i in range(m):
        _into(where[i], com[i], lever[i])
        _turned(where[i], inertia[i], turned)
        _turned(turned, where[i].T, central[i])
    return lever, central


@compiled
def _composite(
    parent: Indices, twists: tuple[Array, Array, Array], mass: Array, lever: Array, central: Array
) -> Array:
    """Return the mass matrix: distal inertia of every joint, projected on the joints' twists."""
    spin, travel, place = twists
    m, centre = len(parent), place + lever
    matrix, total = np.zeros((m, m)), mass.copy()
    first, whole = np.empty((m, 3)), central.copy()
    linear, angular, part = np.empty(3), np.empty(3), np.empty(3)
    for i in range(m):
        square = centre[i, 0] ** 2 + centre[i, 1] ** 2 + centre[i, 2] ** 2
        for a in range(3):
            first[i, a] = mass[i] * centre[i, a]
            whole[i, a, a] += mass[i] * square
            for b in range(3):
                whole[i, a, b] -= mass[i] * centre[i, a] * centre[i, b]
    for i in range(m - 1, -1, -1):
        # Momentum, linear and about the origin, of all that joint i carries at its unit rate.
        _cross(spin[i], first[i], linear)
        _cross(first[i], travel[i], angular)
        _into(whole[i], spin[i], part)
        for k in range(3):
            linear[k] += total[i] * travel[i, k]
            angular[k] += part[k]
        j = i
        while j >= 0:
            for k in range(3):
                matrix[i, j] += spin[j, k] * angular[k] + travel[j, k] * linear[k]
            matrix[j, i] = matrix[i, j]
            j = parent[j]
        p = parent[i]
        if p >= 0:
            total[p] += total[i]
            for a in range(3):
                first[p, a] += first[i, a]
                for b in range(3):
                    whole[p, a, b] += whole[i, a, b]
    return matrix


@compiled
def _loads(
    parent: Indices,
    twists: tuple[Array, Array, Array],
    mass: Array,
    lever: Array,
    central: Array,
    motion: tuple[Array, Array, Array],
) -> Array:
    """Return the joints' loads (m,): m a and I alpha + omega x I omega of all that each of them carries."""
    spin, travel, place = twists
    omega, alpha, accel = motion
    m = len(parent)
    loads, force, moment = np.zeros(m), accel.copy(), np.empty((m, 3))
    work, change, swirl = np.empty((2, 3)), np.empty(3), np.empty(3)
    for i in range(m):
        _add_swing(alpha[i], omega[i], lever[i], work, force[i])
        for k in range(3):
            force[i, k] *= mass[i]
            work[0, k] = place[i, k] + lever[i, k]
        _cross(work[0], force[i], moment[i])
        _into(central[i], omega[i], change)
        _cross(omega[i], change, swirl)
        _into(central[i], alpha[i], change)
        for k in range(3):
            moment[i, k] += change[k] + swirl[k]
    for i in range(m - 1, -1, -1):
        for k in range(3):
            loads[i] += spin[i, k] * moment[i, k] + travel[i, k] * force[i, k]
            if parent[i] >= 0:
                force[parent[i], k] += force[i, k]
                moment[parent[i], k] += moment[i, k]
    return loads
