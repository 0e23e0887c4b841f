"""Clearance of a robot from itself: its links as capsules, of which only the axes are known.

A link is the straight line from a joint to the next module's housing; a tool on the last module is not known.
Links that are near to each other at home are built that close, and may come only a little nearer. Neighbours
meet in their joint and are not checked: it takes more than 2 rad to fold one onto the other.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.forward_kinematics import body_displacements, places_on_axes

# An X5's housing is 31 mm deep and 110 mm long, its tubes are of 32 mm; two of them, and the cables.
CLEARANCE_M = 0.10
# Links that stand nearer than that may come nearer still by so much: cables give.
NEARER_M = 0.02
# Links nearer than that at home are joined.
TOUCHING_M = 0.01
# The last module's own output reaches about that far beyond its axis' nearest point to its IMU.
TIP_M = 0.06


class LinkAxes(NamedTuple):
    """The capsules' axes at q = 0: body (k,), both ends (k, 2, 3) in the root frame."""

    body: NDArray[np.int64]
    ends: Array


def link_axes(chain: Chain) -> LinkAxes:
    """Return the axes of all links; the modules on the base stand on links that do not move."""
    bodies, ends, places = [], [], places_on_axes(chain)
    for k, parent in enumerate(chain.parent):
        near = places[k]
        if parent != BASE:
            bodies.append(parent)
            ends.append((places[parent], near))
        if k not in chain.parent:
            bodies.append(k)
            ends.append((near, near + TIP_M * chain.axis[k]))
    return LinkAxes(np.array(bodies, dtype=np.int64), np.array(ends))


def clearance_m(chain: Chain, q_rad: Array, home_rad: Array) -> Array:
    """Return how near any two links come at positions (m, n): (m,), inf without a pair that can collide.

    home_rad: (n,) where the robot is known to stand clear of itself: for pairs nearer than `CLEARANCE_M`
    there, coming `NEARER_M` nearer counts as `CLEARANCE_M`; those that meet are left out.
    """
    axes = link_axes(chain)
    pairs = np.array(np.triu_indices(len(axes.body), 1))
    at_home = _distances(chain, axes, home_rad[None], pairs)[0]
    apart = at_home > TOUCHING_M
    if not apart.any():
        return np.full(len(q_rad), np.inf)
    allowed = np.minimum(CLEARANCE_M, at_home[apart] - NEARER_M)
    spare = _distances(chain, axes, q_rad, pairs[:, apart]) - allowed
    return np.asarray(CLEARANCE_M + spare.min(axis=1))


def _distances(chain: Chain, axes: LinkAxes, q_rad: Array, pairs: NDArray[np.int64]) -> Array:
    """Return (m, k) distances of the links' axes of pairs (2, k)."""
    displaced = body_displacements(chain, q_rad)[:, axes.body]
    ends = np.einsum("mkij,kej->mkei", displaced[..., :3, :3], axes.ends) + displaced[:, :, None, :3, 3]
    return segment_distances(ends[:, pairs[0]], ends[:, pairs[1]])


def segment_distances(one: Array, other: Array) -> Array:
    """Return the distances (...) of two segments each, given by their ends (..., 2, 3).

    Ericson, Real-Time Collision Detection, section 5.1.9, for all pairs at once.
    """
    along, across = one[..., 1, :] - one[..., 0, :], other[..., 1, :] - other[..., 0, :]
    between = one[..., 0, :] - other[..., 0, :]
    a, e = (np.maximum(np.einsum("...i,...i", v, v), 1e-12) for v in (along, across))
    b, c, f = (
        np.einsum("...i,...i", u, v) for u, v in ((along, across), (along, between), (across, between))
    )
    denominator = a * e - b * b
    # Parallel ones: any place will do, the other's is found for it.
    s = np.where(
        denominator > 1e-9 * a * e, (b * f - c * e) / np.where(denominator > 0.0, denominator, 1.0), 0.5
    )
    t = np.clip((b * np.clip(s, 0.0, 1.0) + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / a, 0.0, 1.0)
    t = np.clip((b * s + f) / e, 0.0, 1.0)
    gap = between + s[..., None] * along - t[..., None] * across
    return np.asarray(np.linalg.norm(gap, axis=-1))
