"""How a chain is drawn: its modules by the types' names, upright, its trees apart.

The trees of a chain of several are drawn apart, because their relative pose is not known.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from coordinator.description.module_geometry import Module, from_z, placed_modules
from module_agent.model.catalogue import module_type
from module_agent.model.chain import Array, Chain
from module_agent.model.forward_kinematics import body_displacements
from module_agent.model.perturbation import apply_perturbation

# Distance between the trees of a chain.
GAP_M = 0.25


def modules(chain: Chain, types: Mapping[str, str]) -> tuple[Module, ...]:
    """Return the geometry of every module of the chain.

    Args:
        chain: n joints.
        types: name of the module type by serial; it gives the IMU and output poses in the housing.

    Raises:
        KeyError: a serial of the chain is not in `types`, or its type is not in the catalogue.
    """
    for serial in chain.serials:
        if serial not in types:
            known = ", ".join(types) or "none"
            raise KeyError(f"the type of module {serial!r} is not known; known are {known}")
    return placed_modules(chain, [module_type(types[serial]) for serial in chain.serials])


def upright(gravity: Array) -> Rotation:
    """Return the smallest rotation of the root frame that turns the specific force at rest (3,) to +z.

    The heading about the vertical is not observable on a fixed base; the smallest rotation is chosen.

    Raises:
        ValueError: `gravity` has no direction.
    """
    length = float(np.linalg.norm(gravity))
    if not np.isfinite(length) or length < 1e-6:
        raise ValueError(f"gravity {gravity} has no direction, so the robot cannot be set upright")
    return from_z(gravity / length).inv()


class Ball(NamedTuple):
    """A ball that a drawn robot is in: its centre in the upright world [m], and its radius [m]."""

    centre_m: tuple[float, float, float]
    radius_m: float

    def holds(self, other: "Ball") -> bool:
        """Tell whether another ball is within this one."""
        apart = float(np.linalg.norm(np.subtract(other.centre_m, self.centre_m)))
        return apart + other.radius_m <= self.radius_m


def ball_around(chain: Chain, placed: Sequence[Module], q_rad: Array) -> Ball:
    """Return the ball around housings and outputs in postures (k, n), about the middle of their box."""
    moved = body_displacements(chain, q_rad)
    fixed = np.broadcast_to(np.eye(4), (len(q_rad), 1, 4, 4))
    moved = np.concatenate([moved, fixed], axis=1)
    corners = [
        moved[:, body, :3, :3] @ place + moved[:, body, :3, 3]
        for module in placed
        for body, place in (
            (module.housing_body, module.housing[:3, 3]),
            (module.output_body, module.output),
        )
    ]
    upright_corners = upright(chain.gravity).apply(np.vstack([*corners, np.zeros(3)]))
    centre = 0.5 * (upright_corners.min(axis=0) + upright_corners.max(axis=0))
    x, y, z = centre.tolist()
    return Ball((x, y, z), float(np.linalg.norm(upright_corners - centre, axis=1).max()))


def side_by_side(chain: Chain) -> Chain:
    """Return the chain with its trees in a horizontal row; the first one is not moved.

    The relative pose of two trees is not observable from sensors on a fixed base.
    """
    if len(chain.roots) == 1:
        return chain
    along = _horizontal(chain)
    shift, end = np.zeros((len(chain.serials), 6)), 0.0
    for number, root in enumerate(chain.roots):
        tree = list(chain.descendants(root))
        places = np.concatenate([chain.imu_home[tree, :3, 3], chain.point[tree]]) @ along
        if number > 0:
            shift[tree, 3:] = (end + GAP_M - places.min()) * along
        end = max(end, float((places + shift[root, 3:] @ along).max()))
    return apply_perturbation(chain, shift.ravel())


def _horizontal(chain: Chain) -> Array:
    """Return the horizontal direction (3,) nearest to the root frame's y, or to its x if y is vertical."""
    up = chain.gravity / np.linalg.norm(chain.gravity)
    for candidate in (np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])):
        level = candidate - up * (up @ candidate)
        size = float(np.linalg.norm(level))
        if size > 0.5:
            break
    return np.asarray(level / size)
