"""The frames in which a body's parameters read best: z along its joint's axis, x towards the next joint.

In them most of what torques show is a parameter of its own, and the rest are sums of few (Khalil and Dombre
2002, Modeling, identification and control of robots, section 3.2): along the common normal of two axes lies
the distance that lumps the masses beyond.
"""

import numpy as np

from module_agent.dynamics.chain import Array, Chain

# Axes closer to parallel have a common normal that an estimate turns anywhere.
_PARALLEL_BELOW = np.sin(np.radians(10.0))
# Nearer than this is no direction to point to: axes that meet are found to pass each other by a few
# millimetres, on either side.
_APART_M = 5e-3


def joint_frames(chain: Chain) -> Array:
    """Return the frames (n, 4, 4) at q = 0 in the root frame, read-only.

    z is the axis. If the body carries a joint, the first one counts: the origin is where the axis is nearest
    to that joint's, and x along their common normal towards it. Otherwise, and for joints on one line, the
    origin is nearest to the module's IMU and x points to it.
    """
    frames = np.tile(np.eye(4), (len(chain.serials), 1, 1))
    for i, frame in enumerate(frames):
        axis, point = chain.axis[i], chain.point[i]
        child = next((k for k, parent in enumerate(chain.parent) if parent == i), None)
        found = None if child is None else _towards(axis, point, chain.axis[child], chain.point[child])
        if found is None:
            found = _beside(axis, point, chain.imu_home[i, :3, 3]) or (_any_normal(axis), point)
        x, origin = found
        frame[:3, :3] = np.column_stack([x, np.cross(axis, x), axis])
        frame[:3, 3] = origin
    frames.flags.writeable = False
    return frames


def _towards(axis: Array, point: Array, other: Array, there: Array) -> tuple[Array, Array] | None:
    """Return the direction of the common normal, from the axis to another, and its foot."""
    normal = np.cross(axis, other)
    size = float(np.linalg.norm(normal))
    if size < _PARALLEL_BELOW:
        return _beside(axis, point, there)
    normal = normal / size
    # point + s axis + h normal = there + t other.
    along, _, apart = np.linalg.solve(np.column_stack([axis, -other, normal]), there - point)
    return (-normal if apart < -_APART_M else normal), point + along * axis


def _beside(axis: Array, point: Array, place: Array) -> tuple[Array, Array] | None:
    """Return the direction from the axis to a place beside it, and the foot; None for a place on the axis."""
    foot = point + axis * (axis @ (place - point))
    distance = float(np.linalg.norm(place - foot))
    return ((place - foot) / distance, foot) if distance > _APART_M else None


def _any_normal(axis: Array) -> Array:
    """Return a direction across an axis: along the root frame's axis that is the most across."""
    nearest = np.eye(3)[int(np.argmin(np.abs(axis)))]
    across = nearest - axis * (axis @ nearest)
    return np.asarray(across / np.linalg.norm(across))
