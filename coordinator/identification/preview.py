"""The robot as far as it is known while its joints are still being explored: cheap, to be looked at.

Joints that have not moved yet are as good as locked. So a module stands on the nearest joint that has been
explored and moves it, and modules that nothing ties to another one yet are left out. The chain is assembled
from the modules' own circle point analyses (`kinematics.assembly`); the batch refinement comes at the end.

Looks at a robot while its joints are being explored: assembled from circles, refined by a few samples.

Every motion is filtered once and kept thinned, so that a look costs little more than its refinement.
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

# Of the weighted squares: far less than their noise.
MIN_GAIN = 1e-3


class Preview(NamedTuple):
    """A chain of the modules that are tied to others by now.

    explored: serials of the joints that have been explored. beside: (n,) whether nothing that is still to be
    explored can lie between a module and its parent, so that what joins them is one link.
    """

    fit: ChainEstimate
    explored: tuple[str, ...]
    beside: tuple[bool, ...]


def preview(recording: Recording, explored: Collection[str]) -> Preview | None:
    """Assemble what the joints explored so far tell; None as long as they tie no module to another.

    Raises:
        DataError: the estimates contradict each other, or modules were not seen at rest.
    """
    serials = sorted({e.serial for e in recording.latest_motions("rest")})
    moved = sorted(set(explored) & set(serials))
    seen = {(i, k): e for i in moved for k in serials if (e := _seen(recording, i, k)) is not None}
    if not seen:
        return None
    found = likely_topology(seen, [s for s in serials if s not in moved])
    kept = _tied(found)
    if not kept:
        return None
    topology = _part(found, kept)
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
    return Preview(fit, tuple(moved), beside(fit.chain, moved))


def beside(chain: Chain, explored: Collection[str]) -> tuple[bool, ...]:
    """Return (n,) whether a module of a chain so far is known to be mounted on its parent and nothing else.

    A joint that is still to be explored may carry what now stands beside it.
    """
    open_ = [s not in explored for s in chain.serials]
    return tuple(
        parent != BASE and not any(open_[other] for other in chain.children(parent) if other != k)
        for k, parent in enumerate(chain.parent)
    )


# ---------------------------------------------------------------------- what was seen


def _seen(recording: Recording, joint: str, observer: str) -> MotionObservation | None:
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
    return MotionObservation(estimate.moved, estimate.rate_ratio, axis)


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
        raise DataError(f"no rows of the motion of joint {joint} that was estimated")
    return float(rows[-1].mean())


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


# 50 samples a second are kept of every motion, for the loads of its links; the refinement has a quarter of
# them: six of every period of the windowed sine.
KEPT_EVERY, FITTED_EVERY = 5, 4
# Farther from where the circles put a module the refinement has found something else than the robot.
LOST_ABOVE_M = 0.15


class Previewer:
    """The looks at one robot, one after the other, from its recording as it grows; one at a time.

    Robots of more than `most_refined` modules are only assembled: a refinement of seven costs half a second,
    and grows with the square.
    """

    def __init__(self, recording: Recording, most_refined: int | None = None):
        self._recording = recording
        self._most_refined = most_refined
        self._parts: dict[tuple[str, int, tuple[str, ...]], SensorData] = {}

    def look(self, explored: Collection[str]) -> Preview | None:
        """Return the robot as far as the joints `explored` tell; None as long as they tie nothing together.

        Where samples are missing, or do not fit, it is as assembled.

        Raises:
            DataError: see `preview`.
        """
        found = preview(self._recording, explored)
        if found is None or not self._is_refined(found):
            return found
        try:
            return _refined(found, self._kinds(found), self._parts_of(found), self._prior)
        except (DataError, np.linalg.LinAlgError):
            return found

    def _is_refined(self, found: Preview) -> bool:
        return self._most_refined is None or len(found.fit.chain.serials) <= self._most_refined

    @property
    def _prior(self) -> ImuPrior:
        return IMU_PRIORS[self._recording.imu]

    def _kinds(self, found: Preview) -> list[ModuleType]:
        return [self._recording.module_type(s) for s in found.fit.chain.serials]

    def _parts_of(self, found: Preview) -> list[SensorData]:
        """Return the samples of every slow and fast motion so far, modules as in the chain."""
        serials = found.fit.chain.serials
        events: dict[tuple[str, str], JournalEvent] = {}
        for event in self._recording.journal:
            if event.what == "motion" and event.purpose in ("constant", "windowed_sine"):
                events[event.serial, event.purpose] = event
        moved = [event for event in events.values() if event.serial in serials and event.motion is not None]
        if not moved:
            raise DataError("no motion of these modules is recorded")
        everybody = tuple(sorted(self._recording.modules))
        order = [everybody.index(s) for s in serials]
        return [_columns(self._part(event, everybody), order) for event in moved]

    def _part(self, event: JournalEvent, serials: tuple[str, ...]) -> SensorData:
        assert event.motion is not None
        key = (event.serial, event.motion.motion_id, serials)
        if key not in self._parts:
            clocks = map_clocks({s: self._recording.modules[s].round_trips for s in serials})
            margin_s = settling_samples(RATE_HZ, REFINEMENT_CUTOFF_HZ) / RATE_HZ
            whole = filtered(window(self._recording, clocks, serials, event, margin_s), REFINEMENT_CUTOFF_HZ)
            self._parts[key] = thinned([whole], KEPT_EVERY)
        return self._parts[key]


def _columns(part: SensorData, order: Sequence[int]) -> SensorData:
    """Return the columns of some modules, in another order."""
    at = np.array(order)
    rates = None if part.imu_rates is None else part.imu_rates[:, at]
    joints = (part.q_rad[:, at], part.qd_rad_s[:, at], part.qdd_rad_s2[:, at])
    return SensorData(*joints, part.gyro_rad_s[:, at], part.accel_m_s2[:, at], rates)


def _refined(
    found: Preview, kinds: Sequence[ModuleType], parts: Sequence[SensorData], prior: ImuPrior
) -> Preview:
    """Refine the robot as if it were rigid, and again with links that give under their loads."""
    data = thinned(parts, FITTED_EVERY)
    rigid = refine_chain(found.fit.chain, data, prior)
    loads = joined(loads_of(rigid.chain, kinds, parts, RATE_HZ / KEPT_EVERY), FITTED_EVERY)
    refined = refine_chain(rigid.chain, data, prior, compliance_jacobian(rigid.chain, data.joints, loads))
    return found if _is_lost(found, refined) else found._replace(fit=refined.estimate)


def _is_lost(found: Preview, refined: Refinement) -> bool:
    off = refined.chain.imu_home[:, :3, 3] - found.fit.chain.imu_home[:, :3, 3]
    return not bool(np.linalg.norm(off, axis=1).max() < LOST_ABOVE_M)
