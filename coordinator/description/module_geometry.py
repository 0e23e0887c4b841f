"""Where a chain's modules and links are: housings, outputs, and the straight lines between them.

Everything is in the root frame at q = 0 and is grouped by the body that carries it, so that a body's
displacement D_i(q) (`forward_kinematics.body_displacements`) moves all of it. The catalogue gives a
housing's envelope and output; how a link is shaped between two modules is not identified: it is taken as a
straight line.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from coordinator.kinematics.frames import housing_homes
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain

# Of a link, whose shape is not identified: the kit's tubes are 32 mm across.
LINK_RADIUS_M = 0.016


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


def placed_modules(chain: Chain, types: Sequence[ModuleType]) -> tuple[Module, ...]:
    """Return the geometry of every module of a chain of n joints; `types` (n,) as in the chain.

    Raises:
        ValueError: there is not one type per module.
    """
    housings = housing_homes(chain, types)
    placed = []
    for k, (made, housing) in enumerate(zip(types, housings, strict=True)):
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


def links(chain: Chain, placed: Sequence[Module]) -> tuple[Link, ...]:
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


def from_z(direction: Array) -> Rotation:
    """Return the smallest rotation that turns +z into the unit vector `direction` (3,)."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, direction[2]))
    # Along z the axis is not defined; any horizontal one serves for the half turn.
    unit = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    return Rotation.from_rotvec(angle * unit)
