"""Random robots, and the observations of their IMUs by the displacement when a joint turns."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coordinator.batch_estimation.imu_jacobian import (
    Displacements,
    displaced_readings,
    kernel_displacements,
    kernel_motion,
)
from coordinator.batch_estimation.imu_prediction import body_motions
from coordinator.kinematics.chain_observations import PairObservation, RestObservation
from coordinator.kinematics.initial_guess import own_line
from coordinator.topology.topology import Topology
from module_agent.model.catalogue import CATALOGUE, GRAVITY_M_S2, ModuleType
from module_agent.model.chain import Chain
from module_agent.model.forward_kinematics import imu_poses

# Where the fit expects it: without noise nothing draws it elsewhere.
G = GRAVITY_M_S2


def build(
    parents: list[int], reverse: list[bool], homes: np.ndarray, types: list[ModuleType], up: np.ndarray
) -> Chain:
    """A chain from the poses of all IMUs at q = 0; the catalogue gives the axes."""
    lines = [own_line(t, r) for t, r in zip(types, reverse, strict=True)]
    return Chain(
        serials=tuple(f"M{i:02d}" for i in range(len(parents))),
        parent=tuple(parents),
        reversed=tuple(reverse),
        axis=np.array([h[:3, :3] @ axis for h, (axis, _) in zip(homes, lines, strict=True)]),
        point=np.array([h[:3, :3] @ p + h[:3, 3] for h, (_, p) in zip(homes, lines, strict=True)]),
        imu_home=homes,
        gravity=G * up / np.linalg.norm(up),
    )


def root_pose(kind: ModuleType) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = kind.imu_xyz
    return pose


def random_robot(seed: int, joints: int, roots: int = 1, serial: bool = False) -> Any:
    """Links of up to 0.3 m in any direction, mounted anyhow."""
    rng = np.random.default_rng(seed)
    types = [list(CATALOGUE.values())[i] for i in rng.integers(0, len(CATALOGUE), joints)]
    parents = [-1] * roots + [i - 1 if serial else int(rng.integers(0, i)) for i in range(roots, joints)]
    homes = np.tile(np.eye(4), (joints, 1, 1))
    homes[0] = root_pose(types[0])
    for k in range(1, joints):
        above = homes[max(parents[k], 0)]
        homes[k, :3, :3] = above[:3, :3] @ Rotation.random(rng=rng).as_matrix()
        homes[k, :3, 3] = above[:3, 3] + rng.uniform(-0.3, 0.3, 3)
    reverse = [bool(r) for r in rng.random(joints) < 0.4]
    return build(parents, reverse, homes, types, rng.normal(size=3)), types


def topology_of(chain: Chain) -> Topology:
    return Topology(chain.serials, chain.parent, chain.reversed, 0.5)


def circle(chain: Chain, joint: int, observer: int, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axis and radial vector in the frame of the observer, by the screw by which it moves with the joint."""
    after = q.copy()
    after[joint] += 1.0
    poses = imu_poses(chain, np.stack([q, after]))[:, observer]
    screw = poses[1] @ np.linalg.inv(poses[0])
    axis = Rotation.from_matrix(screw[:3, :3]).as_rotvec()
    centre = np.linalg.lstsq(np.eye(3) - screw[:3, :3], screw[:3, 3], rcond=None)[0]
    off = poses[0, :3, 3] - centre
    turn = poses[0, :3, :3]
    return turn.T @ axis, turn.T @ (off - axis * (axis @ off))


def rest_of(chain: Chain, q: np.ndarray, sigma: float = 0.0) -> RestObservation:
    turn = imu_poses(chain, q[None, :])[0, :, :3, :3]
    return RestObservation(np.einsum("kij,i->kj", turn, chain.gravity), sigma, q)


def observe(chain: Chain, positions: np.ndarray) -> list[PairObservation]:
    """Every circle that exists, joint i at `positions[i]` (n,)."""
    found = []
    for k, observer in enumerate(chain.serials):
        for i in chain.ancestors(chain.carrier(k)):
            q = positions[i]
            found.append(PairObservation(chain.serials[i], observer, *circle(chain, i, k, q), 0.0, 0.0, q))
    return found


def random_positions(chain: Chain, seed: int) -> np.ndarray:
    """Every joint moves in another pose of the robot: about a home that is not zero, all displaced."""
    rng = np.random.default_rng(1000 + seed)
    count = len(chain.serials)
    return rng.uniform(-1, 1, count) + rng.uniform(-0.5, 0.5, (count, count))


def displaced(
    chain: Chain, joints: tuple[np.ndarray, ...], some: Displacements, amounts: np.ndarray
) -> np.ndarray:
    """The change (n, 6, m) of all readings by displacements that vary with time, to first order."""
    motion = kernel_motion(body_motions(chain, *joints), *joints[:2])
    return displaced_readings(chain, motion, some, kernel_displacements(some), amounts)[..., : len(joints[0])]
