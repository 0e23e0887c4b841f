"""Errors of an identified chain against the true one: topology, links, tips.

Modules are matched by serial number. Before tips are compared the estimate is moved along its unidentifiable
directions, and along no others.
"""

from typing import NamedTuple

import numpy as np

from coordinator.baseline.difference import difference, mountings
from coordinator.topology.topology import Topology
from module_agent.model.chain import Array, Chain
from sim.scoring.gauge_alignment import align_gauge, move_root, reorder, reorder_basis, tip_error

POSES = 1000
_SEED = 1


class LinkErrors(NamedTuple):
    """Errors of a link: of its length, estimate - truth; of its vector and its axis, sizes.

    The length is the perpendicular distance from the parent's joint axis to the child's IMU at q = 0, the
    vector that distance with its direction; vector and axis are compared in the child's IMU frame at q = 0.
    """

    length_m: float
    vector_m: float
    axis_deg: float


def topology_differences(estimated: Topology | Chain, truth: Chain) -> list[str]:
    """List where parents or mounting differ, in the order of the truth; empty if all is right."""
    changes, result, actual = difference(estimated, truth), mountings(estimated), mountings(truth)
    lines = [f"module {s} was not found" for s in changes.new]
    lines += [f"module {s} does not exist" for s in changes.removed]
    for serial in changes.moved:
        (is_on, is_so), (result_on, result_so) = (
            (f"on {mount.parent or 'the base'}", "reversed" if mount.reversed else "forward")
            for mount in (actual[serial], result[serial])
        )
        for is_it, says in ((is_on, result_on), (is_so, result_so)):
            if is_it != says:
                lines.append(f"module {serial} is mounted {is_it}, the result says {says}")
    return lines


def link_length_m(chain: Chain, child: int) -> float:
    """Return the perpendicular distance from the axis of a module's parent to its IMU at q = 0."""
    parent = chain.parent[child]
    arm = chain.imu_home[child, :3, 3] - chain.point[parent]
    return float(np.linalg.norm(np.cross(chain.axis[parent], arm)))


def tip_errors(estimated: Chain, truth: Chain, basis: Array) -> tuple[float, float]:
    """Return rms errors of position [mm] and orientation [deg] of the leaves over random configurations.

    Args:
        estimated, truth: chains of the same modules with the same parents, in any order.
        basis: (6 n, k) directions of `estimated` that are unidentifiable.
    """
    root = estimated.parent.index(-1)
    basis = reorder_basis(estimated, basis, truth.serials)
    origin = truth.serials.index(estimated.serials[root])
    estimated = reorder(estimated, truth.serials)
    if origin != truth.parent.index(-1):
        # With several modules on the base the two chains may begin at different ones, and the root frame is
        # the first one's housing, in which the catalogue places the IMU.
        pose = truth.imu_home[origin] @ np.linalg.inv(estimated.imu_home[origin])
        estimated, basis = move_root(estimated, basis, pose)
    q = np.random.default_rng(_SEED).uniform(-np.pi, np.pi, (POSES, len(truth.serials)))
    error = tip_error(align_gauge(estimated, truth, basis, q), truth, q)
    return 1e3 * error.position_m, float(np.degrees(error.orientation_rad))


def link_errors(estimated: Chain, truth: Chain, child: int) -> LinkErrors | None:
    """Return the errors of the link to a child of the truth, by its index; None if there is no such link."""
    serial = truth.serials[child]
    if serial not in estimated.serials:
        return None
    own = estimated.serials.index(serial)
    if mountings(estimated)[serial].parent != mountings(truth)[serial].parent:
        return None
    axis, vector = _link_in_imu_frame(estimated, own)
    true_axis, true_vector = _link_in_imu_frame(truth, child)
    angle = np.arctan2(np.linalg.norm(np.cross(axis, true_axis)), axis @ true_axis)
    return LinkErrors(
        length_m=float(np.linalg.norm(vector) - np.linalg.norm(true_vector)),
        vector_m=float(np.linalg.norm(vector - true_vector)),
        axis_deg=float(np.degrees(angle)),
    )


def _link_in_imu_frame(chain: Chain, child: int) -> tuple[Array, Array]:
    """Return the parent's axis, and the vector from it to the child's IMU, in that IMU's frame at q = 0."""
    parent, home = chain.parent[child], chain.imu_home[child]
    arm = home[:3, 3] - chain.point[parent]
    axis = chain.axis[parent]
    turn = home[:3, :3].T
    return turn @ axis, turn @ (arm - axis * (axis @ arm))
