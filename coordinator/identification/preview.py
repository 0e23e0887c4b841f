"""Previews of a robot while its joints are being explored: assembled from own estimates, then refined.

Joints that have not moved yet count as locked: a module is mounted on the nearest explored joint that moves
it, and modules without a link to another one yet are excluded. The chain is assembled from the modules'
joint regressions (`kinematics.assembly`); the batch estimate follows at the end of the run. Every motion
is filtered once and its thinned samples retained as long as it is the latest of its kind, so that a preview
costs little more than its refinement.

While all joints move at once, the part of their motion that is over is regressed on all of them instead
(`kinematics.simultaneous_motion`): nothing is shown before the joints can be told apart and the topology is
beyond doubt, and then all of the robot at once.
"""

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.estimator import refine_chain
from coordinator.batch_estimation.link_compliance import compliance_jacobian, joined, loads_of
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.identification.topology_observations import respond, simultaneous_motion
from coordinator.kinematics.assembly import assemble
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.chain_observations import PairObservation, RestObservation, joint_observation
from coordinator.kinematics.simultaneous_motion import circle_observations, motion_observations
from coordinator.recording.journal import JournalEvent, Purpose
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import RATE_HZ, filtered, thinned, unbroken_windows
from coordinator.synchronisation.round_trips import map_clocks
from coordinator.topology.topology import MotionObservation, Topology, find_topology, likely_topology
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import IMU_PRIORS
from module_agent.signals.filtering import REFINEMENT_CUTOFF_HZ
from module_agent.wire.messages import Estimate, MotionRecord

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
    topology = _linked(forest)
    if not topology.serials:
        return None
    rest = recording.rest_observation(topology.serials)
    pairs = []
    for joint in [s for s in moved if s in topology.serials]:
        for observer in [s for s in topology.serials if s != joint]:
            pair = _pair(recording, joint, observer, topology, rest.q_rad)
            pairs += [] if pair is None else [pair]
    return _assembled(recording, topology, pairs, rest, moved)


def preview_of_all(recording: Recording, event: JournalEvent, serials: Sequence[str]) -> Preview | None:
    """Assemble the chain from a motion of all joints `serials` at once, as far as it is over.

    Args:
        recording: of everything up to now.
        event: the motion of any of them; its `end_row` is one past the newest row.
        serials: all modules that move.

    Raises:
        DataError: the joints cannot be told apart yet, the topology is in doubt, or rows are missing.
    """
    clocks = map_clocks({s: recording.modules[s].round_trips for s in serials})
    response = respond(recording, clocks, serials, event)
    topology = _linked(find_topology(motion_observations(serials, response)))
    if not topology.serials:
        return None
    at = [serials.index(s) for s in topology.serials]
    pairs = [
        pair._replace(q_rad=pair.q_rad[at])
        for pair in circle_observations(serials, response)
        if {pair.joint, pair.observer} <= set(topology.serials)
    ]
    return _assembled(recording, topology, pairs, recording.rest_observation(topology.serials), serials)


def _assembled(
    recording: Recording,
    topology: Topology,
    pairs: Sequence[PairObservation],
    rest: RestObservation,
    explored: Sequence[str],
) -> Preview:
    types = [recording.module_type(s) for s in topology.serials]
    try:
        fit = assemble(topology, types, pairs, [rest], MIN_GAIN).estimate
    except np.linalg.LinAlgError as error:
        raise DataError(
            f"no chain follows from the estimates, which contradict each other ({error})"
        ) from error
    return Preview(fit, tuple(explored), adjacent(fit.chain, explored))


def adjacent(chain: Chain, explored: Collection[str]) -> tuple[bool, ...]:
    """Return (n,) whether a module is known to be mounted directly on its parent.

    An unexplored joint may carry its siblings: they may then be its children.
    """
    unexplored = [s not in explored for s in chain.serials]
    return tuple(
        parent != BASE and not any(unexplored[other] for other in chain.children(parent) if other != k)
        for k, parent in enumerate(chain.parent)
    )


def _observation(recording: Recording, joint: str, observer: str) -> MotionObservation | None:
    """Return whether a joint moved an observer, by the slow motion where there is one."""
    estimates = list(recording.estimates.get((joint, observer), {}).values())
    if not estimates:
        return None
    slow_ids = {motion.motion_id for purpose, motion in _motions(recording, joint) if purpose == "constant"}
    slow = [e for e in estimates if e.motion_ids[-1] in slow_ids]
    estimate, turned = (slow or estimates)[-1], _fitted(estimates)
    axis = np.array(turned.best.axis) if turned is not None and turned.best is not None else None
    return MotionObservation(estimate.moved, estimate.rate_ratio, axis)


def _fitted(estimates: Sequence[Estimate]) -> Estimate | None:
    fitted = [e for e in estimates if e.best is not None]
    return fitted[-1] if fitted else None


def _pair(
    recording: Recording, joint: str, observer: str, topology: Topology, q_rad: Array
) -> PairObservation | None:
    """Return an estimate as an observation."""
    estimate = _fitted(list(recording.estimates.get((joint, observer), {}).values()))
    if estimate is None:
        return None
    # The others hold where they rested.
    at = q_rad.copy()
    at[topology.serials.index(joint)] = _mean_position(recording, joint, estimate.motion_ids)
    return joint_observation(estimate, at)


def _motions(recording: Recording, serial: str) -> list[tuple[Purpose, MotionRecord]]:
    events = [e for e in recording.journal if e.what == "motion" and e.serial == serial]
    return [(e.purpose, e.motion) for e in events if e.motion is not None]


def _mean_position(recording: Recording, joint: str, motion_ids: Sequence[int]) -> float:
    rows = [
        recording.rows(joint, motion.start_row, motion.end_row)["position_rad"]
        for _, motion in _motions(recording, joint)
        if motion.end_row is not None and motion.motion_id == motion_ids[-1]
    ]
    if not rows or not len(rows[-1]):
        raise DataError(f"no rows of the motion of joint {joint} that was estimated")
    return float(rows[-1].mean())


def _linked(forest: Topology) -> Topology:
    """Return the trees with more than one module, in the order of the forest."""
    root: list[int] = []
    for k, parent in enumerate(forest.parent):
        root.append(k if parent == BASE else root[parent])
    linked = [k for k, r in enumerate(root) if root.count(r) > 1]
    place = {k: n for n, k in enumerate(linked)} | {BASE: BASE}
    return Topology(
        serials=tuple(forest.serials[k] for k in linked),
        parent=tuple(place[forest.parent[k]] for k in linked),
        reversed=tuple(forest.reversed[k] for k in linked),
        confidence=forest.confidence,
    )


# 50 samples per second of every motion are retained, for the loads of its links; the refinement uses a
# quarter of them: six per period of the windowed sine.
RETAINED_EVERY, FITTED_EVERY = 5, 4
# IMU samples that a preview is fitted to at most: those of all motions of seven modules. Without a bound the
# samples would grow with the square of the modules, and the time with their fourth power.
MAX_IMU_SAMPLES = 5_000
# A refinement that moves a module farther than this from its assembled position has diverged.
MAX_SHIFT_M = 0.15


class Previewer:
    """Computes previews of one robot from its growing recording, one at a time.

    The work of a preview is bounded by what it counts, samples and iterations, not by a clock: the same
    recording gives the same preview. Robots of more than `max_refined` modules are only assembled: the
    refinement's cost grows with the square of their number.
    """

    def __init__(self, recording: Recording, max_refined: float | None = None):
        self._recording = recording
        self._max_refined = np.inf if max_refined is None else max_refined
        self._parts: dict[tuple[str, int, tuple[str, ...]], SensorData] = {}

    def preview(self, explored: Collection[str]) -> Preview | None:
        """Return a preview from the explored joints; None as long as no module is linked to another.

        If all joints have moved at once, and not all by themselves, it is one from that motion. It is not
        refined if samples are missing or the refinement fails.

        Raises:
            DataError: see `preview`.
        """
        serials = sorted({event.serial for event in self._recording.latest_motions("rest")})
        whole = simultaneous_motion(self._recording, serials)
        if whole is not None:
            return self.preview_of_all(whole, serials)
        return self._or_refined(preview(self._recording, explored), self._parts_of)

    def preview_of_all(self, event: JournalEvent, serials: Sequence[str]) -> Preview | None:
        """Return a preview from a motion of all joints at once, which may go on: see `preview_of_all`."""
        assembled = preview_of_all(self._recording, event, serials)
        return self._or_refined(assembled, lambda of_chain: [self._filtered(event, of_chain)])

    def _or_refined(
        self, assembled: Preview | None, parts: Callable[[Sequence[str]], list[SensorData]]
    ) -> Preview | None:
        """Return an assembled preview, refined by the samples of its modules where that is possible."""
        if assembled is None or len(assembled.adjacent) > self._max_refined:
            return assembled
        try:
            return self._refined(assembled, parts(assembled.fit.chain.serials))
        except (DataError, np.linalg.LinAlgError):
            return assembled

    def _refined(self, assembled: Preview, parts: list[SensorData]) -> Preview:
        """Refine the rigid chain, then again with compliant links."""
        chain, prior = assembled.fit.chain, IMU_PRIORS[self._recording.imu]
        kinds = [self._recording.module_type(s) for s in chain.serials]
        every = max(FITTED_EVERY, -(-sum(part.q_rad.size for part in parts) // MAX_IMU_SAMPLES))
        data = thinned(parts, every)
        rigid = refine_chain(chain, data, prior)
        loads = joined(loads_of(rigid.chain, kinds, parts, RATE_HZ / RETAINED_EVERY), every)
        refined = refine_chain(rigid.chain, data, prior, compliance_jacobian(loads, len(data.q_rad)))
        off = refined.chain.imu_home[:, :3, 3] - chain.imu_home[:, :3, 3]
        # Of numbers that are not finite, too.
        diverged = not np.linalg.norm(off, axis=1).max() < MAX_SHIFT_M
        return assembled if diverged else assembled._replace(fit=refined.estimate)

    def _parts_of(self, serials: Sequence[str]) -> list[SensorData]:
        """Return the samples of every slow and fast motion of these modules so far."""
        motions = self._recording.latest_motions("constant", "windowed_sine")
        moved = [event for event in motions if event.serial in serials]
        if not moved:
            raise DataError("no motion of these modules is recorded")
        all_serials = tuple(sorted(self._recording.modules))
        # Of a motion that was repeated, or from before a module joined, nothing is needed any more.
        for stale in self._parts.keys() - {_key(event, all_serials) for event in motions}:
            del self._parts[stale]
        order = [all_serials.index(s) for s in serials]
        return [_columns(self._part(event, all_serials), order) for event in moved]

    def _part(self, event: JournalEvent, serials: tuple[str, ...]) -> SensorData:
        key = _key(event, serials)
        if key not in self._parts:
            self._parts[key] = self._filtered(event, serials)
        return self._parts[key]

    def _filtered(self, event: JournalEvent, serials: Sequence[str]) -> SensorData:
        clocks = map_clocks({s: self._recording.modules[s].round_trips for s in serials})
        windows = unbroken_windows(self._recording, clocks, serials, event, REFINEMENT_CUTOFF_HZ)
        return thinned([filtered(one, REFINEMENT_CUTOFF_HZ) for one in windows], RETAINED_EVERY)


def _key(event: JournalEvent, serials: tuple[str, ...]) -> tuple[str, int, tuple[str, ...]]:
    assert event.motion is not None
    return event.serial, event.motion.motion_id, serials


def _columns(part: SensorData, at: Sequence[int]) -> SensorData:
    """Return the columns of some modules, in another order."""
    q, qd, qdd, gyro, accel = (signal[:, at] for signal in part[:5])
    return SensorData(q, qd, qdd, gyro, accel, None if part.imu_rates is None else part.imu_rates[:, at])
