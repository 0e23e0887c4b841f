"""A first chain in closed form, down the tree: directions by aligning vectors, places by least squares.

Every module is placed against its parent's body by the axes further up and gravity, as its IMU observed them.
Unresolved directions keep the values of a neutral mounting: straight on, in the plane of the parent's output
face.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from coordinator.kinematics.chain_observations import ChainObservations
from coordinator.topology.topology import Topology
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.forward_kinematics import body_displacements, screw_motion
from module_agent.model.read_only import frozen

# Sigma of a mounting about neutral, in rad and m. It only fills in directions that no observation resolves
# better; the refinement that follows does not use it.
NEUTRAL_SIGMA = 0.25
# What a neutral direction counts against the poorest that was seen. Mountings are often half a turn from
# neutral: even a direction seen through a joint that swung along must outweigh it.
NEUTRAL_SHARE = 1e-3


def initial_chain(
    topology: Topology, types: Sequence[ModuleType], observations: ChainObservations, gravity_m_s2: float
) -> Chain:
    """Return a chain near the observations; `types` in the order of the topology, gravity's size [m/s^2]."""
    count = len(topology.serials)
    lines = [own_line(kind, turned) for kind, turned in zip(types, topology.reversed, strict=True)]
    chain = Chain(
        serials=topology.serials,
        parent=topology.parent,
        reversed=topology.reversed,
        axis=np.array([direction for direction, _ in lines]),
        point=np.array([point for _, point in lines]),
        imu_home=np.tile(np.eye(4), (count, 1, 1)),
        gravity=np.array([0.0, 0.0, gravity_m_s2]),
    )
    chain = _placed(chain, 0, types[0], np.eye(3), np.array(types[0].imu_xyz))
    # Gravity in the root frame, by the first module's IMU.
    rows = observations.rest_module == 0
    own = _own_motion(chain, 0, observations.positions[observations.rest_pose[rows]])
    up = np.einsum("vij,vj->i", own[:, :3, :3], observations.gravity[rows])
    chain = chain._replace(gravity=frozen(gravity_m_s2 * (up / np.linalg.norm(up))))
    for k in range(1, count):
        evidence = _evidence(chain, k, observations)
        turn, place = _neutral(chain, k, types)
        turn = _align(evidence, turn)
        chain = _placed(chain, k, types[k], turn, _locate(evidence, turn, place))
    return chain


class _Evidence(NamedTuple):
    """What IMU k saw, against the body that carries module k at home.

    own: (v, 4, 4) how the IMU stood against where it is at q = 0, in its own frame (a reversed module's joint
        turns it). there: (v, 3) unit directions in the root frame, here: the same as seen by the IMU at home.
    points: (p, 3) on the axes of the first p directions. radial_m: (p, 3) seen from the IMU's own frame.
    """

    own: Array
    there: Array
    here: Array
    weight: Array
    points: Array
    radial_m: Array
    radial_weight: Array


def _placed(chain: Chain, k: int, kind: ModuleType, turn: Array, place: Array) -> Chain:
    """Return the chain with module k's IMU at a pose, and with it the axis that the catalogue ties to it."""
    home, axis, point = chain.imu_home.copy(), chain.axis.copy(), chain.point.copy()
    home[k, :3, :3], home[k, :3, 3] = turn, place
    direction, on_axis = own_line(kind, chain.reversed[k])
    axis[k], point[k] = turn @ direction, turn @ on_axis + place
    return chain._replace(axis=frozen(axis), point=frozen(point), imu_home=frozen(home))


def own_line(kind: ModuleType, mounted_reversed: bool) -> tuple[Array, Array]:
    """Return the direction of a module's axis and a point on it in its own IMU frame, from the catalogue.

    The distal side of a reversed module is its housing, which turns about -z when the position grows.
    """
    direction = np.array([0.0, 0.0, -1.0 if mounted_reversed else 1.0])
    return direction, np.array(kind.output_xyz) - np.array(kind.imu_xyz)


def _own_motion(chain: Chain, k: int, positions: Array) -> Array:
    """Return (v, 4, 4): how module k's own joint has moved its IMU, in the frame of the IMU at home."""
    if not chain.reversed[k]:
        return np.tile(np.eye(4), (len(positions), 1, 1))
    inverse = np.linalg.inv(chain.imu_home[k])
    axis = inverse[:3, :3] @ chain.axis[k]
    return screw_motion(axis, inverse[:3, :3] @ chain.point[k] + inverse[:3, 3], positions[:, k])


def _evidence(chain: Chain, k: int, observations: ChainObservations) -> _Evidence:
    pairs = np.flatnonzero(observations.observer == k)
    rests = np.flatnonzero(observations.rest_module == k)
    poses = np.concatenate([observations.pair_pose[pairs], observations.rest_pose[rests]])
    positions = observations.positions[poses]
    body = np.tile(np.eye(4), (len(positions), len(chain.serials) + 1, 1, 1))
    body[:, :-1] = body_displacements(chain, positions)  # of the ancestors; the others are not placed yet
    back = np.linalg.inv(body[:, chain.parent[k]])
    joints = observations.joint[pairs]
    line = back[: pairs.size] @ body[np.arange(pairs.size), np.array(chain.parent)[joints]]
    axes = np.einsum("pij,pj->pi", line[:, :3, :3], chain.axis[joints])
    up = back[pairs.size :, :3, :3] @ (chain.gravity / np.linalg.norm(chain.gravity))
    own = _own_motion(chain, k, positions)
    seen = np.concatenate([observations.axis[pairs], observations.gravity[rests]])
    sigma = np.concatenate([observations.sigma_axis_rad[pairs], observations.sigma_gravity_rad[rests]])
    return _Evidence(
        own=own,
        there=np.concatenate([axes, up]),
        here=np.einsum("vij,vj->vi", own[:, :3, :3], seen),
        weight=sigma**-2,
        points=np.einsum("pij,pj->pi", line[:, :3, :3], chain.point[joints]) + line[:, :3, 3],
        radial_m=observations.radial_m[pairs],
        radial_weight=1.0 / observations.sigma_radial_m[pairs],
    )


def _neutral(chain: Chain, k: int, types: Sequence[ModuleType]) -> tuple[Array, Array]:
    """Return the pose of IMU k mounted straight on the parent's distal face, or at the root for a root."""
    parent = chain.parent[k]
    if parent == BASE:
        return chain.imu_home[0, :3, :3], chain.imu_home[0, :3, 3]
    turn = chain.imu_home[parent, :3, :3]
    face = np.zeros(3) if chain.reversed[parent] else np.array(types[parent].output_xyz)
    place = turn @ (face - np.array(types[parent].imu_xyz)) + chain.imu_home[parent, :3, 3]
    # A link that joins output to output, or housing to housing, turns the axis.
    if chain.reversed[k] != chain.reversed[parent]:
        turn = turn @ np.diag([1.0, -1.0, -1.0])
    return turn, place


def _align(evidence: _Evidence, neutral: Array) -> Array:
    """Return the IMU's orientation at home by the observed directions; neutral where unresolved."""
    there = np.concatenate([evidence.there, neutral.T])
    here = np.concatenate([evidence.here, np.eye(3)])
    least = evidence.weight.min(initial=NEUTRAL_SIGMA**-2)
    weight = np.concatenate([evidence.weight, np.full(3, NEUTRAL_SHARE * least)])
    rotation, _ = Rotation.align_vectors(there, here, weights=weight)
    return np.asarray(rotation.as_matrix())


def _locate(evidence: _Evidence, turn: Array, neutral: Array) -> Array:
    """Return the IMU's place at home by the radial vectors; neutral where unresolved."""
    count = len(evidence.points)
    axis, own = evidence.there[:count], evidence.own[:count]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    radial = np.einsum("ij,pjk,pk->pi", turn, own[:, :3, :3], evidence.radial_m)
    # The IMU is at place + turn @ (own motion's shift); its distance across the axis is the radial vector.
    aim = np.einsum("pij,pj->pi", across, evidence.points - own[:, :3, 3] @ turn.T + radial)
    rows = (across * evidence.radial_weight[:, None, None]).reshape(-1, 3)
    goal = (aim * evidence.radial_weight[:, None]).ravel()
    prior = np.eye(3) / NEUTRAL_SIGMA
    place, *_ = np.linalg.lstsq(
        np.concatenate([rows, prior]), np.concatenate([goal, prior @ neutral]), rcond=None
    )
    return np.asarray(place)
