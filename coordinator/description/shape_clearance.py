"""Clearance of an arm from itself and a floor by the collision shapes of its URDF.

Two convex shapes are apart by at least the gap between their projections onto any direction. The largest gap
over the axes of both, their cross products (exact for boxes: Gottschalk, Lin and Manocha 1996, OBBTree), the
line between the centres and the lines across the axes of cylinders is a lower bound of the distance, so that
a motion that passes is clear.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.description.urdf_shapes import Shapes
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.forward_kinematics import body_displacements

# Pairs whose bounding spheres are further apart are not looked at more closely.
_FAR_M = 0.2
# Bounds the memory of the projections.
_BLOCK = 256
_DEGENERATE = 1e-6


class ClearanceCheck(NamedTuple):
    """The pairs of shapes (2, p) that may collide, and how near each may come (p,) [m].

    touching: pairs of links whose shapes overlap at home, which are not checked; neighbours are not either.
    """

    chain: Chain
    shapes: Shapes
    pairs: NDArray[np.int64]
    allowed_m: Array
    touching: tuple[tuple[str, str], ...]

    def clearance_m(self, q_rad: Array) -> Array:
        """Return how near the pairs come at positions (m, n): lower bounds (m, p) up to some 0.2 m."""
        blocks = range(0, len(q_rad), _BLOCK)
        parts = [separations(self.chain, self.shapes, self.pairs, q_rad[k : k + _BLOCK]) for k in blocks]
        return np.concatenate(parts)

    def is_clear(self, q_rad: Array) -> bool:
        """Tell whether all positions (m, n) are clear."""
        return bool((self.clearance_m(q_rad) >= self.allowed_m).all())


def clearance_check(chain: Chain, shapes: Shapes, home_rad: Array, clearance_m: float) -> ClearanceCheck:
    """Return the check of all pairs that are clear at home (n,).

    Pairs that are nearer there than `clearance_m` may come half as near as there.
    """
    one, other = np.triu_indices(len(shapes.body), 1)
    above = np.append(np.array(chain.parent), BASE)
    body, below = shapes.body[one], shapes.body[other]
    # The floor is no neighbour of what stands on the base.
    joined = (above[body] == below) & (body != BASE) | (above[below] == body) & (below != BASE)
    standing = np.array([link == "floor" for link in shapes.link], dtype=bool)
    considered = (body != below) & (~joined | standing[one] | standing[other])
    pairs = np.array([one, other])[:, considered]
    at_home = separations(chain, shapes, pairs, home_rad[None])[0]
    touching = [(shapes.link[a], shapes.link[b]) for a, b in pairs[:, at_home <= 0.0].T]
    pairs, at_home = pairs[:, at_home > 0.0], at_home[at_home > 0.0]
    allowed = np.where(at_home < clearance_m, 0.5 * at_home, clearance_m)
    return ClearanceCheck(chain, shapes, pairs, allowed, tuple(dict.fromkeys(touching)))


def separations(chain: Chain, shapes: Shapes, pairs: NDArray[np.int64], q_rad: Array) -> Array:
    """Return lower bounds (m, p) of the distances of pairs of shapes (2, p)."""
    displaced = np.concatenate(
        [body_displacements(chain, q_rad), np.broadcast_to(np.eye(4), (len(q_rad), 1, 4, 4))], axis=1
    )
    # `BASE` is the last.
    pose = displaced[:, shapes.body] @ shapes.pose
    reach = np.linalg.norm(shapes.half_m, axis=1) + shapes.disc_m + shapes.ball_m
    centre = pose[:, :, :3, 3]
    gap = np.linalg.norm(centre[:, pairs[0]] - centre[:, pairs[1]], axis=2) - reach[pairs].sum(axis=0)
    sample, pair = np.nonzero(gap < _FAR_M)
    one, other = pairs[:, pair]
    gap[sample, pair] = np.maximum(
        gap[sample, pair], projected_gap(shapes, one, other, pose[sample, one], pose[sample, other])
    )
    return np.asarray(gap)


def projected_gap(
    shapes: Shapes, one: NDArray[np.int64], other: NDArray[np.int64], pose: Array, there: Array
) -> Array:
    """Return the largest gap between projections (k,) of shapes at poses (k, 4, 4)."""
    axes, others = pose[:, :3, :3].transpose(0, 2, 1), there[:, :3, :3].transpose(0, 2, 1)
    between = there[:, None, :3, 3] - pose[:, None, :3, 3]
    across = [
        between - np.einsum("kdi,ki->kd", between, z)[..., None] * z[:, None]
        for z in (axes[:, 2], others[:, 2])
    ]
    crosses = np.cross(axes[:, :, None], others[:, None]).reshape(-1, 9, 3)
    directions = np.concatenate([axes, others, crosses, between, *across], axis=1)
    size = np.linalg.norm(directions, axis=2)
    usable = size > _DEGENERATE
    directions = directions / np.where(usable, size, 1.0)[..., None]
    gap = np.abs(np.einsum("kdi,ki->kd", directions, between[:, 0]))
    for shape, frame in ((one, axes), (other, others)):
        along = np.einsum("kdi,kji->kdj", directions, frame)
        gap = gap - np.einsum("kdj,kj->kd", np.abs(along), shapes.half_m[shape])
        gap = gap - shapes.disc_m[shape, None] * np.hypot(along[..., 0], along[..., 1])
        gap = gap - shapes.ball_m[shape, None]
    return np.asarray(np.where(usable, gap, -np.inf).max(axis=1))
