"""What moves the bodies by one step, semi-implicit Euler: compiled here, or PyBullet.

    qd+ = qd + dt M(q)^-1 (force - bias(q, v)),        q+ = q + dt qd+

with v the velocity at the instant of q (see `sim.world.world`). The accelerations are known when an engine is
asked: motors and springs need them, so they come with the forces. The compiled engine has nothing left to do
but to integrate. PyBullet computes everything again, from bodies of its own: it judges the other one, and it
knows contact.
"""

from typing import Literal, Protocol

import numpy as np

from module_agent.model.compiled import compiled
from sim.geometry.pose import Array
from sim.physics.skeleton import Skeleton

Physics = Literal["compiled", "pybullet"]


class Engine(Protocol):
    """A robot's bodies in motion; joint order is that of the skeleton.

    rates: how many rows of bias forces `step` needs: one for v, and a second one for qd.
    """

    closed: bool
    rates: int

    def place(self, q: Array, qd: Array | None = None) -> None:
        """Put the joints to the given positions (m,), at rest or with the given velocities (m,)."""
        ...

    def begin(self, q: Array) -> None:
        """Put the joints to where the robot starts, (m,), at rest.

        Raises:
            UsageError: the robot overlaps an obstacle there.
        """
        ...

    @property
    def contact_n(self) -> Array:
        """The sum of the normal forces of contact on every body in the last step, (m,) [N]."""
        ...

    def step(self, force: Array, qdd: Array, biases: Array) -> tuple[Array, Array]:
        """Return the new positions and velocities (m,).

        Args:
            force: (m,) of motors and springs on the joints [Nm, N].
            qdd: (m,) the accelerations M^-1 (force - biases[0]).
            biases: (rates, m) bias forces at v and qd, without external wrenches in the second row.
        """
        ...

    def close(self) -> None:
        """End the engine. May be called twice."""
        ...


@compiled
def integrate(q: Array, qd: Array, qdd: Array, dt_s: float, q_after: Array, qd_after: Array) -> None:
    """Fill in the positions and velocities (m,) after a step of the given accelerations (m,)."""
    for j in range(len(q)):
        qd_after[j] = qd[j] + dt_s * qdd[j]
        q_after[j] = q[j] + dt_s * qd_after[j]


class CompiledEngine:
    """Integrates the accelerations that come with the forces; it knows no contact.

    A world's ticks do so within one kernel, see `sim.world.world_kernel`.
    """

    rates = 1

    def __init__(self, skeleton: Skeleton, dt_s: float):
        self._dt_s = dt_s
        self.closed = False
        self.place(np.zeros(len(skeleton.names)))

    def begin(self, q: Array) -> None:
        """See `Engine.begin`."""
        self.place(q)

    @property
    def contact_n(self) -> Array:
        """See `Engine.contact_n`."""
        return np.zeros_like(self._q)

    def place(self, q: Array, qd: Array | None = None) -> None:
        """See `Engine.place`."""
        self._q, self._qd = q, np.zeros_like(q) if qd is None else qd

    def step(self, force: Array, qdd: Array, biases: Array) -> tuple[Array, Array]:
        """See `Engine.step`."""
        before = self._q, self._qd
        self._q, self._qd = np.empty_like(qdd), np.empty_like(qdd)
        integrate(*before, qdd, self._dt_s, self._q, self._qd)
        return self._q, self._qd

    def close(self) -> None:
        """See `Engine.close`."""
        self.closed = True
