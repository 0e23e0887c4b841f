"""Observations of which joint moved which IMU, from every slow motion of every joint in a recording, and from
a motion of all joints at once.

Slow motions decide: near a resonance of the held joints a fast motion shakes modules that it does not carry,
and leaves others at rest that it does. The feedback of all modules together is more informative than each
module's own estimate: it shows how much other joints gave way, and whether the segments of the motion agree.
A module's own estimate replaces feedback that is missing, and increases the uncertainty where the two differ.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.kinematics.simultaneous_motion import (
    SimultaneousMotion,
    SimultaneousResponse,
    StillReading,
    simultaneous_response,
)
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import RATE_HZ, unbroken_windows, window
from coordinator.synchronisation.round_trips import map_clocks
from coordinator.topology.motion_evidence import NotMoved, motion_evidence
from coordinator.topology.topology import (
    DOUBTFUL_BELOW,
    MotionObservation,
    Observations,
    combined_observation,
)
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import SIMULTANEOUS_CUTOFF_HZ, TOPOLOGY_CUTOFF_HZ, filtered_signals
from module_agent.wire.feedback_rows import Rows

KEEP_EVERY = 5
# The longest hole in a motion of all joints at once that is bridged: a tenth of its fastest period is lost.
BRIDGED_NS = 100_000_000
# Up to this rotation of the joints in between, an axis counts as unchanged: the residual is some tenths of it
# (`motion_evidence.RESIDUAL_GIVE`).
TURNED_RAD = 0.3
# Sigma of a module's own rate ratio, which does not account for held joints that give by 20 to 30 %.
OWN_SIGMA = 0.2


def simultaneous_motion(recording: Recording, serials: Sequence[str]) -> JournalEvent | None:
    """Return the latest motion of all these joints at once, as the event of the first of them.

    None if not all took part, or if all were moved one by one as well: those motions are more informative.
    """
    latest = {e.serial: e for e in recording.motions("whole")}
    alone = {e.serial for e in recording.motions("windowed_sine")}
    if all(s in alone for s in serials):
        return None
    return latest[serials[0]] if serials and all(s in latest for s in serials) else None


def respond(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str], event: JournalEvent
) -> SimultaneousResponse:
    """Regress all IMUs' readings on all joints' motions; columns in the order of `serials`.

    Raises:
        DataError: see `simultaneous_response`; also a hole in the recording, or no rest.
    """
    # Gravity is followed from rest on, so that this motion cannot be split.
    one = window(recording, clocks, serials, event, SIMULTANEOUS_CUTOFF_HZ, BRIDGED_NS)
    others = [one.gyro_rad_s, one.accel_m_s2]
    signals = filtered_signals(one.q_rad, others, RATE_HZ, SIMULTANEOUS_CUTOFF_HZ)
    rests = [recording.rest_rows(serial) for serial in serials]
    missing = [serial for serial, rows in zip(serials, rests, strict=True) if not len(rows)]
    if missing:
        raise DataError(
            f"no rest of {', '.join(missing)} was recorded: the offsets of its gyro are not known"
        )
    fields = ("gyro_rad_s", "accel_m_s2")
    still = StillReading(*(np.array([_mean(rows, field) for rows in rests]) for field in fields))
    motion = SimultaneousMotion(*signals.settled())
    return simultaneous_response(serials, motion, still, RATE_HZ, SIMULTANEOUS_CUTOFF_HZ)


class ObservedMotions(NamedTuple):
    """Which joint moved which IMU, from a recording.

    observations: {(joint, observer): MotionObservation}.
    unmoved: joints that did not move although commanded, with the reason as text.
    silent: modules without any observation: no feedback, no clock, no estimates.
    """

    observations: Observations
    unmoved: Mapping[str, str]
    silent: tuple[str, ...]


def observe(recording: Recording, serials: Sequence[str]) -> ObservedMotions:
    """Evaluate all slow motions of these modules; missing observations are left out.

    In two passes: the first finds about which axes joints certainly carry IMUs; from these axes the second
    computes the contribution of held joints that gave way to the gyros' readings.
    """
    sources = [s for s in serials if recording.modules[s].round_trips and recording.modules[s].rows.end_row]
    clocks = map_clocks({s: recording.modules[s].round_trips for s in sources}) if sources else {}
    rests = {s: recording.rest_rows(s) for s in sources}
    offsets = {s: _mean(rows, "gyro_rad_s") if len(rows) else np.zeros(3) for s, rows in rests.items()}
    source = _Source(recording, clocks, offsets)
    # A motion without the feedback of its own joint has no observers.
    motions = {joint: [_of_motion(source, e) for e in slow_motions(recording, joint)] for joint in serials}
    first, _ = _evaluate(recording, serials, motions, None)
    certain = {
        pair: one.axis if one.moved else np.zeros(3)
        for pair, one in first.items()
        if abs(one.log_odds) > DOUBTFUL_BELOW
    }
    axes = Axes(certain, _usual_pose(motions))
    observations, unmoved = _evaluate(recording, serials, motions, axes)
    observing = {observer for _, observer in observations}
    return ObservedMotions(observations, unmoved, tuple(s for s in serials if s not in observing))


def _usual_pose(motions: Mapping[str, Sequence["MotionFeedback"]]) -> dict[str, float]:
    """Return the median position of every joint over all motions."""
    places: dict[str, list[float]] = {}
    for feedback in (feedback for of_joint in motions.values() for feedback in of_joint):
        for serial, q in zip(feedback.observers, feedback.q_mean_rad, strict=True):
            places.setdefault(serial, []).append(float(q))
    return {serial: float(np.median(positions)) for serial, positions in places.items()}


def slow_motions(recording: Recording, joint: str) -> list[JournalEvent]:
    """Return the slow motions of a joint that were completed since its module's latest boot."""
    slow = [(event, event.motion) for event in recording.motions("constant") if event.serial == joint]
    return [event for event, motion in slow if motion is not None and motion.end_row is not None]


class _Source(NamedTuple):
    """The recording, and clock and gyro offset of every module with feedback."""

    recording: Recording
    clocks: Mapping[str, ClockMap]
    offsets: Mapping[str, Array]


class MotionFeedback(NamedTuple):
    """One motion of one joint in the feedback of n observers: joints (m, n), gyros (m, n, 3)."""

    event: JournalEvent
    observers: tuple[str, ...]
    q_mean_rad: Array
    qd_rad_s: Array
    gyro_rad_s: Array
    offset_rad_s: Array


def _of_motion(source: _Source, event: JournalEvent) -> MotionFeedback:
    observers = _observers(source, event)
    if event.serial not in observers:
        return MotionFeedback(event, (), np.empty(0), np.empty((0, 0)), np.empty((0, 0, 3)), np.empty((0, 3)))
    parts = [
        filtered_signals(one.q_rad, [one.gyro_rad_s], RATE_HZ, TOPOLOGY_CUTOFF_HZ, KEEP_EVERY).settled()
        for one in unbroken_windows(source.recording, source.clocks, observers, event, TOPOLOGY_CUTOFF_HZ)
    ]
    q, qd, _, gyro = (np.concatenate(signal) for signal in zip(*parts, strict=True))
    offset = np.array([source.offsets[s] for s in observers])
    return MotionFeedback(event, tuple(observers), q.mean(axis=0), qd, gyro, offset)


class Axes(NamedTuple):
    """The certain axes: {(joint, observer): axis in the observer's frame, zero if it is not carried}.

    pose_rad: median position of the joints over all motions.
    """

    certain: Mapping[tuple[str, str], Array | None]
    pose_rad: Mapping[str, float]

    def of(self, names: Sequence[str]) -> Array:
        """Return (n, n, 3) of all pairs, NaN where none is certain."""
        unknown = np.full(3, np.nan)
        rows = [[self.certain.get((o, k)) for k in names] for o in names]
        return np.array([[unknown if axis is None else axis for axis in row] for row in rows])

    def turned_away(self, feedback: MotionFeedback) -> bool:
        """Return whether the joints were too far from `pose_rad` for the axes to hold."""
        pairs = zip(feedback.observers, feedback.q_mean_rad, strict=True)
        others = [abs(q - self.pose_rad[s]) for s, q in pairs if s != feedback.event.serial]
        return bool(sum(others) > TURNED_RAD)


def _evaluate(
    recording: Recording,
    serials: Sequence[str],
    motions: Mapping[str, list[MotionFeedback]],
    axes: Axes | None,
) -> tuple[dict[tuple[str, str], MotionObservation], dict[str, str]]:
    """Return the observations of all joints, and for joints without any the reason."""
    observations: dict[tuple[str, str], MotionObservation] = {}
    unmoved: dict[str, str] = {}
    for joint in serials:
        observed: dict[str, list[MotionObservation]] = {}
        why = "it was never commanded to move, or did not complete its motion"
        for feedback in motions[joint]:
            try:
                by_observer = by_feedback(feedback, axes)
            except NotMoved as error:
                why = str(error)
                continue
            for observer, observation in _with_own(recording, serials, feedback.event, by_observer):
                observed.setdefault(observer, []).append(observation)
            why = "no module observed its motion"
        observations |= {(joint, observer): combined_observation(many) for observer, many in observed.items()}
        if not observed:
            unmoved[joint] = why
    return observations, unmoved


def by_feedback(feedback: MotionFeedback, axes: Axes | None) -> dict[str, MotionObservation]:
    """Return the observations of one motion from all feedback; none without that of the joint.

    Raises:
        NotMoved: the joint hardly moved.
    """
    names = feedback.observers
    if not names:
        return {}
    joint = names.index(feedback.event.serial)
    known = axes.of(names) if axes is not None and not axes.turned_away(feedback) else None
    evidence = motion_evidence(joint, feedback.qd_rad_s, feedback.gyro_rad_s, feedback.offset_rad_s, known)
    observed = {}
    for k, name in enumerate(names):
        ratio, sigma, give = (
            float(of[k]) for of in (evidence.rate_ratio, evidence.ratio_sigma, evidence.give)
        )
        axis = evidence.coefficient[k] / ratio if ratio > 0.5 else None
        observed[name] = MotionObservation(ratio > 0.5, ratio, axis, sigma, give)
    return observed


def _observers(source: _Source, event: JournalEvent) -> list[str]:
    """Return the modules with feedback over a whole motion; a module may stop sending during it."""
    everyone = sorted(source.clocks)
    if event.serial not in everyone or _covered(source, everyone, event):
        return everyone
    return [s for s in everyone if _covered(source, [event.serial, s], event)]


def _covered(source: _Source, serials: Sequence[str], event: JournalEvent) -> bool:
    try:
        of_all, of_joint = (
            sum(
                len(one.t_ns)
                for one in unbroken_windows(source.recording, source.clocks, some, event, TOPOLOGY_CUTOFF_HZ)
            )
            for some in (serials, [event.serial])
        )
    except DataError:
        return False
    # A window is cut to the rows of all modules: one that stopped sending must not shorten the others'.
    return of_all > 0.8 * of_joint


def _with_own(
    recording: Recording,
    serials: Sequence[str],
    event: JournalEvent,
    by_observer: Mapping[str, MotionObservation],
) -> Iterator[tuple[str, MotionObservation]]:
    """Yield the observations of a motion, less certain where the module's own valid estimate differs."""
    assert event.motion is not None
    for observer in serials:
        observed = by_observer.get(observer)
        own = recording.estimates.get((event.serial, observer), {}).get((event.motion.motion_id,))
        if own is not None and not own.note:
            if observed is None:
                observed = MotionObservation(own.moved, own.rate_ratio, None, OWN_SIGMA)
            else:
                apart = max(0.0, abs(observed.rate_ratio - own.rate_ratio) - observed.sigma)
                observed = observed._replace(sigma=float(np.hypot(observed.sigma, apart)))
        if observed is not None:
            yield observer, observed


def _mean(rows: Rows, field: str) -> Array:
    return np.asarray(rows[field].astype(float).mean(axis=0))
