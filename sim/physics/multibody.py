"""PyBullet's articulated-body dynamics: semi-implicit Euler, without damping or clamped velocities.

PyBullet is imported without the greeting that its C code prints: standard output belongs to results, some of
them machine-readable, and standard error to messages for the user.
"""

import ctypes
import importlib
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim.geometry.pose import Array
from sim.physics.contact import Contacts
from sim.physics.skeleton import Skeleton
from sim.physics.skeleton_urdf import joint_name, urdf_text
from sim.robot.robot_file import Obstacle


def _imported_quietly() -> Any:
    streams = (1, 2)
    sys.stdout.flush()
    sys.stderr.flush()
    saved, null = [os.dup(n) for n in streams], os.open(os.devnull, os.O_WRONLY)
    try:
        for number in streams:
            os.dup2(null, number)
        return importlib.import_module("pybullet")
    finally:
        # The greeting waits in the C library's buffer.
        ctypes.CDLL(None).fflush(None)
        for number, copy in zip(streams, saved, strict=True):
            os.dup2(copy, number)
            os.close(copy)
        os.close(null)


pybullet: Any = _imported_quietly()


class Multibody:
    """A robot's joints in one private physics client: an `Engine` of `sim.physics.engine`."""

    # PyBullet takes the velocity forces at qd, which is half a step before q; those at q are put instead.
    rates = 2

    def __init__(self, name: str, skeleton: Skeleton, dt_s: float, obstacles: Sequence[Obstacle] = ()):
        n = len(skeleton.names)
        self._indices = list(range(n))
        self.closed = False
        self._client: int = pybullet.connect(pybullet.DIRECT)
        self._body = _load(self._client, urdf_text(name, skeleton, bool(obstacles)), bool(obstacles))
        _configure(self._client, self._body, skeleton, dt_s)
        _check(self._client, self._body, skeleton)
        self._contacts = None
        if obstacles:
            self._contacts = Contacts(pybullet, self._client, self._body, skeleton, obstacles)

    def begin(self, q: Array) -> None:
        """See `Engine.begin`."""
        self.place(q)
        if self._contacts is not None:
            self._contacts.check_start()

    @property
    def contact_n(self) -> Array:
        """See `Engine.contact_n`."""
        return np.zeros(len(self._indices)) if self._contacts is None else self._contacts.force_n()

    def place(self, q: Array, qd: Array | None = None) -> None:
        """See `Engine.place`."""
        rates = np.zeros_like(q) if qd is None else qd
        for i in self._indices:
            pybullet.resetJointState(
                self._body, i, float(q[i]), float(rates[i]), physicsClientId=self._client
            )

    def step(self, force: Array, qdd: Array, biases: Array) -> tuple[Array, Array]:
        """See `Engine.step`."""
        pybullet.setJointMotorControlArray(
            self._body,
            self._indices,
            pybullet.TORQUE_CONTROL,
            forces=(force - biases[0] + biases[1]).tolist(),
            physicsClientId=self._client,
        )
        pybullet.stepSimulation(physicsClientId=self._client)
        states = pybullet.getJointStates(self._body, self._indices, physicsClientId=self._client)
        positions, velocities, *_ = zip(*states, strict=True)
        return np.array(positions), np.array(velocities)

    def close(self) -> None:
        """See `Engine.close`."""
        if not self.closed:
            self.closed = True
            pybullet.disconnect(physicsClientId=self._client)


def _load(client: int, urdf: str, touches_itself: bool) -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(urdf)
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        if touches_itself:
            flags |= pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
        body: int = pybullet.loadURDF(str(path), useFixedBase=True, flags=flags, physicsClientId=client)
    return body


def _configure(client: int, body: int, skeleton: Skeleton, dt_s: float) -> None:
    n = len(skeleton.names)
    pybullet.setGravity(0.0, 0.0, -skeleton.gravity_m_s2, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(fixedTimeStep=dt_s, numSubSteps=0, physicsClientId=client)
    for i in range(-1, n):
        pybullet.changeDynamics(
            body, i, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, physicsClientId=client
        )
    # The default clamps at 100 rad/s. It needs a call of its own: in a common one the other arguments would
    # be applied to the base.
    pybullet.changeDynamics(body, -1, maxJointVelocity=1e4, physicsClientId=client)
    # Switch the default velocity motors off.
    pybullet.setJointMotorControlArray(
        body, list(range(n)), pybullet.VELOCITY_CONTROL, forces=[0.0] * n, physicsClientId=client
    )


def _check(client: int, body: int, skeleton: Skeleton) -> None:
    """Check that the engine has the joints in the skeleton's order, and every inertia unchanged.

    Raises:
        RuntimeError: it has not (it zeroes an impossible inertia tensor with no more than a warning).
    """
    for i, (body_name, wanted) in enumerate(zip(skeleton.names, skeleton.bodies, strict=True)):
        name = pybullet.getJointInfo(body, i, physicsClientId=client)[1].decode()
        info = pybullet.getDynamicsInfo(body, i, physicsClientId=client)
        moments = np.linalg.eigvalsh(wanted.inertia_kg_m2)
        same = np.allclose(np.sort(info[2]), moments, rtol=1e-9, atol=0.0)
        if name != joint_name(body_name) or not same or not np.isclose(info[0], wanted.mass_kg):
            raise RuntimeError(
                f"the physics engine's joint {i} is {name} with {info[0]} kg and moments {info[2]}; "
                f"expected {joint_name(body_name)} with {wanted.mass_kg} kg and moments {moments}"
            )
