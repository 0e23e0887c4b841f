"""Name the null space of a fit: which parameter of which module is not resolved, and what would resolve it.

The null vectors are compared with the motions of the robot's parts that can be unobservable: a branch along
the axis of the joint that carries it or about it, and a second tree on the base against the first.
"""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from module_agent.model.chain import Array, Chain
from module_agent.model.read_only import frozen

Kind = Literal[
    "offset_along_axis", "rotation_about_axis", "rotation_about_gravity", "position", "combination"
]
# The cosine between a named motion and the null space above which they are taken for the same.
SAME_ABOVE = 0.995


class Unresolved(NamedTuple):
    """An unobservable change of the robot.

    joint: serial of the joint about or along whose axis it goes; empty for positions and combinations.
    modules: serials of the modules that it displaces, that next to the joint first.
    directions: (6 n, m) perturbations (`apply_perturbation`), one column each, in rad and m.
    resolved_by: the motion or measurement that would make it observable, or that nothing does.
    """

    kind: Kind
    joint: str
    modules: tuple[str, ...]
    text: str
    resolved_by: str
    directions: Array


def name_null_space(chain: Chain, null_basis: Array) -> tuple[Unresolved, ...]:
    """Name the null space of a fit, `null_basis` (6 n, k) with orthonormal columns, motion by motion.

    The rest of the null space is reported as combinations.
    """
    named = [item for item in _candidates(chain) if _hidden(item, null_basis)]
    left = null_basis
    if named:
        known, _ = np.linalg.qr(null_basis.T @ np.concatenate([u.directions for u in named], axis=1))
        rest = np.eye(null_basis.shape[1]) - known @ known.T
        vectors, size, _ = np.linalg.svd(rest)
        left = null_basis @ vectors[:, size > 0.5]
    return (*named, *(_combination(chain, left[:, c]) for c in range(left.shape[1])))


def _hidden(item: Unresolved, null_basis: Array) -> bool:
    columns = item.directions / np.linalg.norm(item.directions, axis=0)
    return bool(np.all(np.linalg.norm(null_basis.T @ columns, axis=0) > SAME_ABOVE))


def _candidates(chain: Chain) -> Iterator[Unresolved]:
    # Branch by branch: no observation ties two children of one joint, so each has its own freedom.
    for child in chain.linked:
        yield from _along_and_about(chain, chain.parent[child], child)
    up = chain.gravity / np.linalg.norm(chain.gravity)
    cure = "nothing: both stand on the base; measure it"
    for root in chain.roots[1:]:
        tree = chain.descendants(root)
        apart = f"of {chain.serials[root]}'s tree relative to {chain.serials[0]}"
        twists = np.concatenate([np.zeros((3, 3)), np.eye(3)])
        yield _item(chain, "position", "", tree, f"position {apart}: nothing moves both", cure, twists)
        twist = np.r_[up, np.cross(chain.imu_home[root, :3, 3], up)]
        text = f"heading {apart}: gravity does not tell it"
        yield _item(chain, "rotation_about_gravity", "", tree, text, cure, twist)


def _along_and_about(chain: Chain, joint: int, child: int) -> Iterator[Unresolved]:
    """Yield the offset of a branch along a joint's axis, and its rotation about it."""
    name, further, beyond = chain.serials[joint], chain.ancestors(joint)[:-1], chain.descendants(child)
    branch = chain.serials[child] + (" and everything beyond it" if len(beyond) > 1 else "")
    axis, point = chain.axis[joint], chain.point[joint]
    if further:
        others = f"every joint further up ({_names(chain, further)})"
        why = f": {others} is parallel to it"
        cure = f"moving a joint further up while {name}'s axis is not parallel to it"
    else:
        why = ": not observable from inertial sensors on a fixed base"
        cure = "nothing: no joint further up moves it; measure it, or take it from the drawing"
    text = f"offset of {branch} along {name}'s axis{why}"
    yield _item(chain, "offset_along_axis", name, beyond, text, cure, np.r_[np.zeros(3), axis])
    if further:
        why = f": the axis is parallel to gravity and to {others}"
        cure = f"resting, or moving a joint further up, while {name}'s axis is not parallel to it"
    else:
        why = " (base yaw): the axis is parallel to gravity and no joint further up moves it"
        cure = "tilting the base; on a level base nothing does"
    text = f"rotation of {branch} about {name}'s axis at {name}'s zero{why}"
    yield _item(chain, "rotation_about_axis", name, beyond, text, cure, np.r_[axis, np.cross(point, axis)])


def _item(
    chain: Chain, kind: Kind, joint: str, modules: tuple[int, ...], text: str, resolved_by: str, twists: Array
) -> Unresolved:
    columns = np.atleast_2d(twists.T).T.reshape(6, -1)
    directions = np.zeros((len(chain.serials), 6, columns.shape[1]))
    directions[list(modules)] = columns
    serials = tuple(chain.serials[k] for k in modules)
    flat = frozen(directions.reshape(-1, columns.shape[1]))
    return Unresolved(kind, joint, serials, text, resolved_by, flat)


def _combination(chain: Chain, direction: Array) -> Unresolved:
    size = np.linalg.norm(direction.reshape(-1, 6), axis=1)
    moved = tuple(int(k) for k in np.flatnonzero(size > 0.1 * size.max()))
    text = f"a combination of the poses of {_names(chain, moved)} that no observation tells apart"
    cure = "motions of the joints further up at other positions of the joints between"
    serials = tuple(chain.serials[k] for k in moved)
    return Unresolved("combination", "", serials, text, cure, frozen(direction[:, None]))


def _names(chain: Chain, modules: tuple[int, ...]) -> str:
    return ", ".join(chain.serials[k] for k in modules)
