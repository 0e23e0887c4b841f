"""Geometry of a drawn chain: poses of housings, outputs, links and axes.

Everything is in the root frame at q = 0 and is grouped by the body that carries it, so that a body's
displacement D_i(q) (`forward_kinematics.body_displacements`) moves all of it.

The trees of a chain of several are drawn apart, because their relative pose is not known.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from module_agent.model.catalogue import module_type
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.perturbation import apply_perturbation

# Distance between the trees of a chain.
GAP_M = 0.25


class Module(NamedTuple):
    """Geometry of one module of a chain.

    housing_body, output_body: the bodies that carry the housing and the output, `BASE` for the base.
    housing: (4, 4) pose of the housing frame.
    box_size, box_centre: (3,) edges and centre of the housing's outline, in its own frame [m].
    output: (3,) the point of the identified axis nearest to where the output is in the housing.
    axis: (3,) unit vector of the joint's axis.
    """

    housing_body: int
    output_body: int
    housing: Array
    box_size: Array
    box_centre: Array
    output: Array
    axis: Array


class Link(NamedTuple):
    """A straight line from `start` (3,) to `end` (3,) between two modules, carried by `body`."""

    body: int
    start: Array
    end: Array

    @property
    def length_m(self) -> float:
        """Its length [m]."""
        return float(np.linalg.norm(self.end - self.start))


def modules(chain: Chain, types: Mapping[str, str]) -> tuple[Module, ...]:
    """Return the geometry of every module of the chain.

    Args:
        chain: n joints.
        types: name of the module type by serial; it gives the IMU and output poses in the housing.

    Raises:
        KeyError: a serial of the chain is not in `types`, or its type is not in the catalogue.
    """
    placed = []
    for k, serial in enumerate(chain.serials):
        if serial not in types:
            known = ", ".join(types) or "none"
            raise KeyError(f"the type of module {serial!r} is not known; known are {known}")
        made = module_type(types[serial])
        housing = chain.imu_home[k].copy()
        housing[:3, 3] -= housing[:3, :3] @ made.imu_xyz
        corners = np.array([made.housing_min_xyz, made.housing_max_xyz])
        nominal = housing[:3, :3] @ made.output_xyz + housing[:3, 3]
        axis, point = chain.axis[k], chain.point[k]
        placed.append(
            Module(
                housing_body=chain.carrier(k),
                output_body=chain.parent[k] if chain.reversed[k] else k,
                housing=housing,
                box_size=corners[1] - corners[0],
                box_centre=corners.mean(axis=0),
                output=point + axis * float(axis @ (nominal - point)),
                axis=axis,
            )
        )
    return tuple(placed)


def links(chain: Chain, placed: tuple[Module, ...]) -> tuple[Link, ...]:
    """Return the link of each module to its parent, or to the origin of the base for a root module.

    A link runs from the parent's distal side (its output, or its housing if reversed) to the child's proximal
    side (its housing, or its output if reversed).
    """
    joined = []
    for k, parent in enumerate(chain.parent):
        child = placed[k]
        end = child.output if chain.reversed[k] else child.housing[:3, 3]
        if parent == BASE:
            start = np.zeros(3)
        else:
            above = placed[parent]
            start = above.housing[:3, 3] if chain.reversed[parent] else above.output
        joined.append(Link(parent, start, end))
    return tuple(joined)


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


def from_z(direction: Array) -> Rotation:
    """Return the smallest rotation that turns +z into the unit vector `direction` (3,)."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, direction[2]))
    # Along z the axis is not defined; any horizontal one serves for the half turn.
    unit = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    return Rotation.from_rotvec(angle * unit)


def reach_m(chain: Chain, placed: tuple[Module, ...]) -> float:
    """Return the largest distance of a module from the root along the links [m]; no posture exceeds it."""
    along: list[float] = []
    for k, link in enumerate(links(chain, placed)):
        parent = chain.parent[k]
        before = 0.0 if parent == BASE else along[parent]
        stacked = float(np.linalg.norm(placed[k].output - placed[k].housing[:3, 3]))
        along.append(before + link.length_m + stacked)
    return max(along, default=0.0)


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
