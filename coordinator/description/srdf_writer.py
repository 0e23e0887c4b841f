"""What a motion planner asks for next to a URDF: an SRDF file, as MoveIt and pinocchio read it.

A group for every branch, from the base to its tip; `zero`, where all joints are at zero; and the pairs of
links that are not to be checked against each other, with MoveIt's reasons:

- Adjacent: parent and child, which meet in their joint;
- Default: their shapes overlap at zero;
- Always: they overlap at every one of `SAMPLES` random positions;
- Never: at none of them they come nearer than `NEVER_M`.

Distances are lower bounds (`shape_clearance`), so that what is called Never is clear at these positions by
the margin. The shapes are the URDF's, straight tubes for links; what else hangs on the robot is not in it.
Nothing is said of pairs from two trees of a robot: how these stand to each other is not identified.
"""

from collections.abc import Collection
from itertools import combinations
from pathlib import Path
from typing import Literal, NamedTuple
from xml.etree.ElementTree import Element, SubElement, parse

import numpy as np
from numpy.typing import NDArray

from coordinator.description.shape_clearance import separations
from coordinator.description.urdf_reader import URDF_JOINT, UrdfRobot, read_urdf
from coordinator.description.urdf_shapes import Shapes, read_shapes
from coordinator.description.urdf_writer import comment, write_xml
from module_agent.model.chain import BASE, Array, Chain

SAMPLES = 2000
# A link's shape is known by millimetres, and between two samples shapes come a few centimetres nearer.
NEVER_M = 0.05
_BLOCK = 250

Reason = Literal["Adjacent", "Default", "Always", "Never"]


class UncheckedPair(NamedTuple):
    """Two links that a planner need not check against each other, and why."""

    one: str
    other: str
    reason: Reason


def write_srdf(path: Path, urdf: Path) -> None:
    """Write the SRDF of a robot that `write_urdf` has written; the file is the complete old or the new one.

    Raises:
        UrdfError: the URDF cannot be read.
        OSError: a file cannot be read or written.
    """
    robot = read_urdf(urdf)
    chain = robot.chain
    root = Element("robot", name=parse(urdf).getroot().get("name", ""))
    comment(root, "For the shapes of the URDF, which are approximations: boxes and straight tubes.")
    serials = [name.removeprefix(URDF_JOINT) for name in chain.serials]
    for k in chain.leaves:
        name = "arm" if len(chain.leaves) == 1 else f"arm_{serials[k]}"
        tip = f"tip_{serials[k]}"
        group = SubElement(root, "group", name=name)
        SubElement(group, "chain", base_link="base", tip_link=tip if tip in robot.links else robot.bodies[k])
        zero = SubElement(root, "group_state", name="zero", group=name)
        for joint in chain.ancestors(k):
            SubElement(zero, "joint", name=chain.serials[joint], value="0")
    for pair in unchecked_pairs(robot, read_shapes(robot)):
        SubElement(root, "disable_collisions", link1=pair.one, link2=pair.other, reason=pair.reason)
    write_xml(path, root)


def unchecked_pairs(robot: UrdfRobot, shapes: Shapes, seed: int = 0) -> tuple[UncheckedPair, ...]:
    """Return the pairs of links that a planner need not check; random positions follow from `seed`."""
    chain = robot.chain
    reasons: dict[_Bodies, Reason] = {(parent, k): "Adjacent" for k, parent in enumerate(chain.parent)}
    reasons |= _by_distance(robot, shapes, reasons.keys(), np.random.default_rng(seed))
    names = {BASE: "base"} | dict(enumerate(robot.bodies))
    return tuple(UncheckedPair(names[i], names[k], why) for (i, k), why in sorted(reasons.items()))


_Bodies = tuple[int, int]


def _by_distance(
    robot: UrdfRobot, shapes: Shapes, adjacent: Collection[_Bodies], rng: np.random.Generator
) -> dict[_Bodies, Reason]:
    """Return the pairs of bodies that always, never or at zero touch, but for adjacent ones."""
    chain, pairs, bodies = robot.chain, *_shape_pairs(robot.chain, shapes, adjacent)
    if not bodies:
        return {}
    of = np.array([bodies.index(_ordered(*shapes.body[pair])) for pair in pairs.T])
    zero = np.zeros((1, len(chain.serials)))
    at_zero = _nearest(separations(chain, shapes, pairs, zero), of, len(bodies))[0]
    low, high = (
        np.where(np.isfinite(end), end, whole)
        for end, whole in zip(robot.limits.T[:2], (-np.pi, np.pi), strict=True)
    )
    least, most = np.full(len(bodies), np.inf), np.full(len(bodies), -np.inf)
    for _ in range(SAMPLES // _BLOCK):
        q = rng.uniform(low, high, (_BLOCK, len(chain.serials)))
        # What touched and was clear already needs no further look.
        open_ = (least >= NEVER_M) | (most <= 0.0)
        if not open_.any():
            break
        looked = open_[of]
        near = _nearest(separations(chain, shapes, pairs[:, looked], q), of[looked], len(bodies))
        least[open_] = np.minimum(least, near.min(axis=0))[open_]
        most[open_] = np.maximum(most, near.max(axis=0))[open_]
    found: dict[_Bodies, Reason] = {}
    for k, pair in enumerate(bodies):
        if most[k] <= 0.0:
            found[pair] = "Always"
        elif at_zero[k] <= 0.0:
            found[pair] = "Default"
        elif least[k] >= NEVER_M:
            found[pair] = "Never"
    return found


def _ordered(one: int, other: int) -> _Bodies:
    return min(int(one), int(other)), max(int(one), int(other))


def _shape_pairs(
    chain: Chain, shapes: Shapes, adjacent: Collection[_Bodies]
) -> tuple[NDArray[np.int64], list[_Bodies]]:
    """Return the pairs of shapes (2, p) of bodies that are not adjacent and of one tree, and their bodies."""
    # The first joint on the way to a body tells its tree; the base belongs to one only if there is one.
    tree = {k: chain.ancestors(k)[0] for k in range(len(chain.serials))}
    if len(chain.roots) == 1:
        tree[BASE] = chain.roots[0]
    body = shapes.body.tolist()
    chosen = [
        (i, k)
        for i, k in combinations([i for i, one in enumerate(body) if one in tree], 2)
        if body[i] != body[k]
        and _ordered(body[i], body[k]) not in adjacent
        and tree[body[i]] == tree[body[k]]
    ]
    bodies = sorted({_ordered(body[i], body[k]) for i, k in chosen})
    return np.array(chosen, dtype=np.int64).reshape(-1, 2).T, bodies


def _nearest(gaps: Array, of: NDArray[np.int64], count: int) -> Array:
    """Return the least (m, count) of the gaps (m, p) of shapes by pair of bodies `of` (p,), inf for none."""
    least = np.full((count, len(gaps)), np.inf)
    np.minimum.at(least, of, gaps.T)
    return least.T
