"""The robot as far as it is known while its joints are still being explored: cheap, to be looked at.

Joints that have not moved yet are as good as locked. So a module stands on the nearest joint that has been
explored and moves it, and modules that nothing ties to another one yet are left out. The chain is assembled
from the modules' own circle point analyses (`kinematics.assembly`); the batch refinement comes at the end.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.journal import JournalEvent
from coordinator.kinematics.assembly import ChainFit, assemble
from coordinator.kinematics.chain_observations import PairObservation, RestObservation
from coordinator.kinematics.forward import BASE
from coordinator.kinematics.pair_estimate import circle_observation
from coordinator.kinematics.topology import MotionSeen, Topology, likely_topology
from coordinator.recording import Recording
from module_agent.catalogue import module_type
from module_agent.dynamics.chain import Array, Chain
from module_agent.wire.messages import Estimate

# Of the weighted squares: far less than their noise.
LEAST_GAIN = 1e-3


class RobotSoFar(NamedTuple):
    """A chain of the modules that are tied to others by now.

    explored: serials of the joints that have been explored. beside: (n,) whether nothing that is still to be
    explored can lie between a module and its parent, so that what joins them is one link.
    """

    fit: ChainFit
    explored: tuple[str, ...]
    beside: tuple[bool, ...]


def robot_so_far(recording: Recording, explored: Collection[str]) -> RobotSoFar | None:
    """Assemble what the joints explored so far tell; None as long as they tie no module to another.

    Raises:
        ValueError: the estimates contradict each other, or modules were not seen at rest.
    """
    rests = _rests(recording)
    serials = sorted(rests)
    moved = sorted(set(explored) & set(serials))
    seen = {(i, k): e for i in moved for k in serials if (e := _seen(recording, i, k)) is not None}
    if not seen:
        return None
    found = likely_topology(seen, [s for s in serials if s not in moved])
    kept = _tied(found)
    if not kept:
        return None
    topology = _part(found, kept)
    rest = _rest(recording, rests, topology.serials)
    pairs = [
        pair
        for joint in moved
        for observer in topology.serials
        if joint in topology.serials
        and joint != observer
        and (pair := _pair(recording, joint, observer, topology, rest.q_rad)) is not None
    ]
    types = [module_type(_type(recording, s)) for s in topology.serials]
    fit = assemble(topology, types, pairs, [rest], LEAST_GAIN)
    return RobotSoFar(fit, tuple(moved), beside(fit.chain, moved))


def beside(chain: Chain, explored: Collection[str]) -> tuple[bool, ...]:
    """Return (n,) whether a module of a chain so far is known to be mounted on its parent and nothing else.

    A joint that is still to be explored may carry what now stands beside it.
    """
    open_ = [s not in explored for s in chain.serials]
    return tuple(
        parent != BASE
        and not any(open_[other] for other, p in enumerate(chain.parent) if p == parent and other != k)
        for k, parent in enumerate(chain.parent)
    )


# ---------------------------------------------------------------------- what was seen


def _seen(recording: Recording, joint: str, observer: str) -> MotionSeen | None:
    """Return who moved with whom, by the slow motion where there is one (see `estimate.observer`)."""
    found = list(recording.estimates.get((joint, observer), {}).values())
    if not found:
        return None
    slow_ids = {
        e.motion.motion_id for e in _motions(recording, joint) if e.purpose == "constant" and e.motion
    }
    slow = [e for e in found if e.motion_ids[-1] in slow_ids]
    estimate, turned = (slow or found)[-1], _circle(found)
    axis = np.array(turned.circle.axis) if turned is not None and turned.circle is not None else None
    return MotionSeen(estimate.moved, estimate.rate_ratio, axis)


def _circle(found: Sequence[Estimate]) -> Estimate | None:
    circles = [e for e in found if e.circle is not None]
    return circles[-1] if circles else None


def _pair(
    recording: Recording, joint: str, observer: str, topology: Topology, q_rad: Array
) -> PairObservation | None:
    """Return a circle as an observation."""
    estimate = _circle(list(recording.estimates.get((joint, observer), {}).values()))
    if estimate is None:
        return None
    # The others hold where they rested.
    at = q_rad.copy()
    at[topology.serials.index(joint)] = _mean_position(recording, joint, estimate.motion_ids)
    return circle_observation(estimate, at)


def _motions(recording: Recording, serial: str) -> list[JournalEvent]:
    return [
        e for e in recording.journal if e.what == "motion" and e.serial == serial and e.motion is not None
    ]


def _mean_position(recording: Recording, joint: str, motion_ids: Sequence[int]) -> float:
    rows = [
        recording.rows(joint, e.motion.start_row, e.motion.end_row)["position_rad"]
        for e in _motions(recording, joint)
        if e.motion is not None and e.motion.end_row is not None and e.motion.motion_id == motion_ids[-1]
    ]
    if not rows or not len(rows[-1]):
        raise ValueError(f"no rows of the motion of joint {joint} that was estimated")
    return float(rows[-1].mean())


def _rests(recording: Recording) -> dict[str, tuple[int, int]]:
    """Return the rows (first, end) of every module's last rest."""
    serials = sorted({e.serial for e in recording.journal if e.purpose == "rest"})
    found = {s: [e.motion for e in _motions(recording, s) if e.purpose == "rest"][-1:] for s in serials}
    return {
        s: (motion.start_row, motion.end_row)
        for s, motions in found.items()
        for motion in motions
        if motion is not None and motion.end_row is not None
    }


def _rest(recording: Recording, rests: dict[str, tuple[int, int]], serials: Sequence[str]) -> RestObservation:
    rows = [recording.rows(s, *rests[s]) for s in serials]
    bare = [s for s, one in zip(serials, rows, strict=True) if not len(one)]
    if bare:
        raise ValueError(f"no rows at rest of {', '.join(bare)}")
    force = np.array([one["accel_m_s2"].astype(float).mean(axis=0) for one in rows])
    scatter = [float(one["accel_m_s2"].std(axis=0).max()) / np.sqrt(len(one)) for one in rows]
    position = np.array([float(one["position_rad"].mean()) for one in rows])
    return RestObservation(force, max(scatter), position)


def _type(recording: Recording, serial: str) -> str:
    info = recording.modules[serial].info
    if info is None:
        raise ValueError(f"module {serial} has not told its type")
    return info.module_type


# ---------------------------------------------------------------------- what hangs together


def _tied(topology: Topology) -> list[int]:
    """Return the modules of all trees of more than one."""
    root: list[int] = []
    for k, parent in enumerate(topology.parent):
        root.append(k if parent == BASE else root[parent])
    return [k for k, r in enumerate(root) if root.count(r) > 1]


def _part(topology: Topology, kept: Sequence[int]) -> Topology:
    """Return whole trees of a topology, in its order."""
    place = {k: n for n, k in enumerate(kept)} | {BASE: BASE}
    return Topology(
        serials=tuple(topology.serials[k] for k in kept),
        parent=tuple(place[topology.parent[k]] for k in kept),
        reversed=tuple(topology.reversed[k] for k in kept),
        confidence=topology.confidence,
    )
