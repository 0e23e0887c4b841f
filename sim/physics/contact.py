"""Contact of a robot with obstacles and with itself, in PyBullet.

Contact is hard and without rebound; friction is Coulomb's. Bodies that a joint connects do not touch each
other, nor do those that overlap where the robot starts: envelopes are larger than what they envelop.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from module_agent.model.errors import UsageError
from sim.geometry.pose import Array
from sim.geometry.shape import Shape
from sim.physics.skeleton import Skeleton
from sim.robot.robot_file import Obstacle

# Bodies closer than this at the start count as overlapping.
_CLOSE_M = 1e-4
_WORLD = -1


def collision_text(shape: Shape, origin: str) -> str:
    """Return a shape as the collision element of a URDF's link."""
    numbers = [repr(size) for size in shape.size_m]
    match shape.kind:
        case "box":
            form = f'<box size="{" ".join(numbers)}"/>'
        case "cylinder":
            form = f'<cylinder radius="{numbers[0]}" length="{numbers[1]}"/>'
        case "sphere":
            form = f'<sphere radius="{numbers[0]}"/>'
        case "plane":
            raise ValueError("no body is a half-space")
    return f"<collision>{origin}<geometry>{form}</geometry></collision>"


def _added(engine: Any, client: int, obstacle: Obstacle) -> int:
    """Put an obstacle into a physics client; return its number there."""
    shape = obstacle.shape
    match shape.kind:
        case "box":
            size = {"shapeType": engine.GEOM_BOX, "halfExtents": [edge / 2.0 for edge in shape.size_m]}
        case "cylinder":
            size = {"shapeType": engine.GEOM_CYLINDER, "radius": shape.size_m[0], "height": shape.size_m[1]}
        case "sphere":
            size = {"shapeType": engine.GEOM_SPHERE, "radius": shape.size_m[0]}
        case "plane":
            size = {"shapeType": engine.GEOM_PLANE}
    number: int = engine.createMultiBody(
        baseMass=0.0,
        baseCollisionShapeIndex=engine.createCollisionShape(**size, physicsClientId=client),
        basePosition=shape.pose[:3, 3].tolist(),
        baseOrientation=Rotation.from_matrix(shape.pose[:3, :3]).as_quat().tolist(),
        physicsClientId=client,
    )
    engine.changeDynamics(number, -1, lateralFriction=obstacle.friction, physicsClientId=client)
    return number


class Contacts:
    """What may touch in a physics client: the robot's bodies each other, and all of them the obstacles."""

    def __init__(
        self, engine: Any, client: int, body: int, skeleton: Skeleton, obstacles: Sequence[Obstacle]
    ):
        self._engine, self._client, self._body = engine, client, body
        self._names = ("the base", *skeleton.names)
        self._obstacles = obstacles
        self._numbers = [_added(engine, client, obstacle) for obstacle in obstacles]
        # Friction of a pair is the product of both: the obstacle's alone shall count.
        for link in range(_WORLD, len(skeleton.names)):
            engine.changeDynamics(body, link, lateralFriction=1.0, physicsClientId=client)
        self._pairs = [
            (a, b)
            for b in range(len(skeleton.names))
            for a in range(_WORLD, b)
            if a not in _jointed(skeleton, b)
        ]
        allowed = set(self._pairs)
        for b in range(len(skeleton.names)):
            for a in range(_WORLD, b):
                self._let_touch(a, b, (a, b) in allowed)

    def check_start(self) -> None:
        """Let what overlaps within the robot pass through itself from now on.

        Raises:
            UsageError: the robot overlaps an obstacle.
        """
        for obstacle, number in zip(self._obstacles, self._numbers, strict=True):
            near = self._engine.getClosestPoints(self._body, number, 0.0, physicsClientId=self._client)
            # What is fixed to the world may stand on an obstacle.
            deepest = min(((row[8], row[3]) for row in near if row[3] != _WORLD), default=(0.0, _WORLD))
            if deepest[0] < -_CLOSE_M:
                raise UsageError(
                    f"obstacle {obstacle.name!r} and {self._names[deepest[1] + 1]} overlap by "
                    f"{-1e3 * deepest[0]:.0f} mm where the robot starts: move the obstacle, or set start_rad"
                )
        for a, b in self._pairs:
            near = self._engine.getClosestPoints(
                *(self._body, self._body, _CLOSE_M, a, b), physicsClientId=self._client
            )
            if near:
                self._let_touch(a, b, False)

    def force_n(self) -> Array:
        """Return the sum of the normal forces on every body (m,) in the last step [N]."""
        total = np.zeros(len(self._names) - 1)
        for row in self._engine.getContactPoints(bodyA=self._body, physicsClientId=self._client):
            for body, link in ((row[1], row[3]), (row[2], row[4])):
                if body == self._body and link >= 0:
                    total[link] += row[9]
        return total

    def _let_touch(self, a: int, b: int, touch: bool) -> None:
        self._engine.setCollisionFilterPair(
            self._body, self._body, a, b, int(touch), physicsClientId=self._client
        )


def _jointed(skeleton: Skeleton, body: int) -> set[int]:
    """Return the bodies from `body` towards the root that at most one module's joint separates from it.

    Passive joints in between do not separate bodies.
    """
    near: set[int] = set()
    joint = body
    for crossed in (False, True):
        if crossed and joint != _WORLD:
            joint = skeleton.parent[joint]
            near.add(joint)
        while joint != _WORLD and joint not in skeleton.module:
            joint = skeleton.parent[joint]
            near.add(joint)
    return near
