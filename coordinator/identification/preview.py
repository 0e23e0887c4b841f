"""Previews of a robot while its joints are being explored: assembled from circles, refined by a few samples.

Joints that have not moved yet count as locked: a module is mounted on the nearest explored joint that moves
it, and modules without a link to another one yet are excluded. The chain is assembled from the modules'
circle point analyses (`kinematics.assembly`); the batch estimate follows at the end of the run. Every motion
is filtered once and its thinned samples retained, so that a preview costs little more than its refinement.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.estimator import Refinement, refine_chain
from coordinator.batch_estimation.link_compliance import compliance_jacobian, joined, loads_of
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.kinematics.assembly import assemble
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.chain_observations import PairObservation, circle_observation
from coordinator.recording.at_rest import rest_observation
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import RATE_HZ, filtered, thinned, window
from coordinator.synchronisation.round_trips import map_clocks
from coordinator.topology.topology import MotionObservation, Topology, likely_topology
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import IMU_PRIORS, ImuPrior
from module_agent.signals.filtering import REFINEMENT_CUTOFF_HZ, settling_samples
from module_agent.wire.messages import Estimate

# Least gain of the weighted sum of squares: far less than its noise.
MIN_GAIN = 1e-3


class Preview(NamedTuple):
    """A chain of the modules that are linked to others so far.

    explored: serials of the explored joints. adjacent: (n,) whether a module is mounted directly on its
    parent, with no unexplored joint possible in between.
    """

    fit: ChainEstimate
    explored: tuple[str, ...]
    adjacent: tuple[bool, ...]


def preview(recording: Recording, explored: Collection[str]) -> Preview | None:
    """Assemble the chain of the explored joints; None as long as no module is linked to another.

    Raises:
        DataError: the estimates contradict each other, or a module has no rows at rest.
    """
    serials = sorted({e.serial for e in recording.latest_motions("rest")})
    moved = sorted(set(explored) & set(serials))
    observations = {
        (i, k): e for i in moved for k in serials if (e := _observation(recording, i, k)) is not None
    }
    if not observations:
        return None
    forest = likely_topology(observations, [s for s in serials if s not in moved])
    linked = _linked(forest)
    if not linked:
        return None
    topology = _part(forest, linked)
    rest = rest_observation(recording, topology.serials)
    pairs = [
        pair
        for joint in moved
        for observer in topology.serials
        if joint in topology.serials
        and joint != observer
        and (pair := _pair(recording, joint, observer, topology, rest.q_rad)) is not None
    ]
    types = [recording.module_type(s) for s in topology.serials]
    fit = assemble(topology, types, pairs, [rest], MIN_GAIN).estimate
    return Preview(fit, tuple(moved), adjacent(fit.chain, moved))


def adjacent(chain: Chain, explored: Collection[str]) -> tuple[bool, ...]:
    """Return (n,) whether a module is known to be mounted directly on its parent.

    An unexplored joint may carry its siblings: they may then be its children.
    """
    unexplored = [s not in explored for s in chain.serials]
    return tuple(
        parent != BASE and not any(unexplored[other] for other in chain.children(parent) if other != k)
        for k, parent in enumerate(chain.parent)
    )


# ---------------------------------------------------------------------- observations


def _observation(recording: Recording, joint: str, observer: str) -> MotionObservation | None:
    """Return whether a joint moved an observer, by the slow motion where there is one."""
    estimates = list(recording.estimates.get((joint, observer), {}).values())
    if not estimates:
        return None
    slow_ids = {
        e.motion.motion_id for e in _motions(recording, joint) if e.purpose == "constant" and e.motion
    }
    slow = [e for e in estimates if e.motion_ids[-1] in slow_ids]
    estimate, turned = (slow or estimates)[-1], _circle(estimates)
    axis = np.array(turned.circle.axis) if turned is not None and turned.circle is not None else None
    return MotionObservation(estimate.moved, estimate.rate_ratio, axis)


def _circle(estimates: Sequence[Estimate]) -> Estimate | None:
    circles = [e for e in estimates if e.circle is not None]
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
        raise DataError(f"no rows of the motion of joint {joint} that was estimated")
    return float(rows[-1].mean())


# ---------------------------------------------------------------------- linked modules


def _linked(topology: Topology) -> list[int]:
    """Return the modules of all trees with more than one module."""
    root: list[int] = []
    for k, parent in enumerate(topology.parent):
        root.append(k if parent == BASE else root[parent])
    return [k for k, r in enumerate(root) if root.count(r) > 1]


def _part(topology: Topology, linked: Sequence[int]) -> Topology:
    """Return whole trees of a topology, in its order."""
    place = {k: n for n, k in enumerate(linked)} | {BASE: BASE}
    return Topology(
        serials=tuple(topology.serials[k] for k in linked),
        parent=tuple(place[topology.parent[k]] for k in linked),
        reversed=tuple(topology.reversed[k] for k in linked),
        confidence=topology.confidence,
    )


# 50 samples per second of every motion are retained, for the loads of its links; the refinement uses a
# quarter of them: six per period of the windowed sine.
RETAINED_EVERY, FITTED_EVERY = 5, 4
# A refinement that moves a module farther than this from its assembled position has diverged.
MAX_SHIFT_M = 0.15


class Previewer:
    """Computes previews of one robot from its growing recording, one at a time.

    Robots of more than `max_refined` modules are only assembled: a refinement of seven modules costs half a
    second, and the cost grows with the square of their number.
    """

    def __init__(self, recording: Recording, max_refined: int | None = None):
        self._recording = recording
        self._max_refined = max_refined
        self._parts: dict[tuple[str, int, tuple[str, ...]], SensorData] = {}

    def preview(self, explored: Collection[str]) -> Preview | None:
        """Return a preview from the explored joints; None as long as no module is linked to another.

        It is not refined if samples are missing or the refinement fails.

        Raises:
            DataError: see `preview`.
        """
        assembled = preview(self._recording, explored)
        if assembled is None or not self._is_refined(assembled):
            return assembled
        try:
            return _refined(assembled, self._kinds(assembled), self._parts_of(assembled), self._prior)
        except (DataError, np.linalg.LinAlgError):
            return assembled

    def _is_refined(self, assembled: Preview) -> bool:
        return self._max_refined is None or len(assembled.fit.chain.serials) <= self._max_refined

    @property
    def _prior(self) -> ImuPrior:
        return IMU_PRIORS[self._recording.imu]

    def _kinds(self, assembled: Preview) -> list[ModuleType]:
        return [self._recording.module_type(s) for s in assembled.fit.chain.serials]

    def _parts_of(self, assembled: Preview) -> list[SensorData]:
        """Return the samples of every slow and fast motion so far, modules as in the chain."""
        serials = assembled.fit.chain.serials
        events: dict[tuple[str, str], JournalEvent] = {}
        for event in self._recording.journal:
            if event.what == "motion" and event.purpose in ("constant", "windowed_sine"):
                events[event.serial, event.purpose] = event
        moved = [event for event in events.values() if event.serial in serials and event.motion is not None]
        if not moved:
            raise DataError("no motion of these modules is recorded")
        all_serials = tuple(sorted(self._recording.modules))
        order = [all_serials.index(s) for s in serials]
        return [_columns(self._part(event, all_serials), order) for event in moved]

    def _part(self, event: JournalEvent, serials: tuple[str, ...]) -> SensorData:
        assert event.motion is not None
        key = (event.serial, event.motion.motion_id, serials)
        if key not in self._parts:
            clocks = map_clocks({s: self._recording.modules[s].round_trips for s in serials})
            margin_s = settling_samples(RATE_HZ, REFINEMENT_CUTOFF_HZ) / RATE_HZ
            whole = filtered(window(self._recording, clocks, serials, event, margin_s), REFINEMENT_CUTOFF_HZ)
            self._parts[key] = thinned([whole], RETAINED_EVERY)
        return self._parts[key]


def _columns(part: SensorData, order: Sequence[int]) -> SensorData:
    """Return the columns of some modules, in another order."""
    at = np.array(order)
    rates = None if part.imu_rates is None else part.imu_rates[:, at]
    joints = (part.q_rad[:, at], part.qd_rad_s[:, at], part.qdd_rad_s2[:, at])
    return SensorData(*joints, part.gyro_rad_s[:, at], part.accel_m_s2[:, at], rates)


def _refined(
    assembled: Preview, kinds: Sequence[ModuleType], parts: Sequence[SensorData], prior: ImuPrior
) -> Preview:
    """Refine the rigid chain, then again with compliant links."""
    data = thinned(parts, FITTED_EVERY)
    rigid = refine_chain(assembled.fit.chain, data, prior)
    loads = joined(loads_of(rigid.chain, kinds, parts, RATE_HZ / RETAINED_EVERY), FITTED_EVERY)
    refined = refine_chain(rigid.chain, data, prior, compliance_jacobian(rigid.chain, data.joints, loads))
    return assembled if _has_diverged(assembled, refined) else assembled._replace(fit=refined.estimate)


def _has_diverged(assembled: Preview, refined: Refinement) -> bool:
    off = refined.chain.imu_home[:, :3, 3] - assembled.fit.chain.imu_home[:, :3, 3]
    return not bool(np.linalg.norm(off, axis=1).max() < MAX_SHIFT_M)
