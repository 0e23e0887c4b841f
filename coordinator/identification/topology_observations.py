"""Who moved with whom, out of a recording: every slow motion of every joint, as every IMU saw it.

Slow motion decides: near a resonance of the held joints a fast one shakes modules that it does not carry, and
holds others still that it does. The feedback of all modules at once tells more than each module's own view:
how much other joints gave way, and how far the stretches of the motion agree. What a module found itself
stands in where its feedback is missing, and makes less certain where it says otherwise.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import RATE_HZ, window
from coordinator.synchronisation.round_trips import map_clocks
from coordinator.topology.motion_evidence import MotionEvidence, NotMoved, motion_evidence
from coordinator.topology.topology import (
    DOUBTFUL_BELOW,
    MotionObservation,
    Observations,
    combined_observation,
)
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import TOPOLOGY_CUTOFF_HZ, filtered_signals, settling_samples
from module_agent.wire.messages import Estimate, MotionRecord

KEEP_EVERY = 5
# An axis that joints between have turned by less is still where it was seen: what is left of it is some
# tenths (`motion_evidence.RESIDUAL_GIVE`).
TURNED_RAD = 0.3
# Of a module's own finding nobody knows how far it may be wrong: held joints give by 20 to 30 %.
OWN_SIGMA = 0.2


class Seen(NamedTuple):
    """What a recording says of who moved with whom.

    observations: {(joint, observer): MotionObservation}, of what was seen.
    unmoved: joints that were told to move and did not, with the reason in words.
    blind: modules that saw no motion at all: no feedback, no clock, no findings.
    """

    observations: Observations
    unmoved: Mapping[str, str]
    blind: tuple[str, ...]


def observe(recording: Recording, serials: Sequence[str]) -> Seen:
    """Evaluate all slow motions of these modules; what is missing is left out rather than guessed.

    Twice: what the first look is sure of, whom a joint carries about which axis, tells the second what held
    joints that gave way did to the IMUs.
    """
    heard = [s for s in serials if recording.modules[s].round_trips and recording.modules[s].rows.end_row]
    clocks = map_clocks({s: recording.modules[s].round_trips for s in heard}) if heard else {}
    ear = _Ear(recording, clocks, {s: _gyro_offset(recording, s) for s in heard})
    heard_of = {joint: _heard(ear, joint) for joint in serials}
    first, _ = _look(recording, serials, heard_of, None)
    surely = {pair: _axis(seen) for pair, seen in first.items() if abs(seen.log_odds) > DOUBTFUL_BELOW}
    axes = Axes(surely, _usual_pose(heard_of))
    observations, unmoved = _look(recording, serials, heard_of, axes)
    watching = {observer for _, observer in observations}
    return Seen(observations, unmoved, tuple(s for s in serials if s not in watching))


def _usual_pose(heard_of: Mapping[str, Sequence["Heard"]]) -> dict[str, float]:
    """Return where every joint was in the median of all motions."""
    places: dict[str, list[float]] = {}
    for heard in (heard for motions in heard_of.values() for heard in motions):
        for serial, q in zip(heard.watchers, heard.q_mean_rad, strict=True):
            places.setdefault(serial, []).append(float(q))
    return {serial: float(np.median(found)) for serial, found in places.items()}


def _axis(seen: MotionObservation) -> Array | None:
    """Return the axis of a joint in the frame of an IMU, zero if it does not carry it."""
    return seen.axis if seen.moved else np.zeros(3)


def slow_motions(recording: Recording, joint: str) -> list[JournalEvent]:
    """Return the slow motions of a joint that were completed since its module's latest boot."""
    boot = recording.modules[joint].boot
    return [
        event
        for event in recording.journal
        if event.what == "motion"
        and event.purpose == "constant"
        and event.serial == joint
        and event.boot in (0, boot)
        and event.motion is not None
        and event.motion.end_row is not None
    ]


class _Ear(NamedTuple):
    """The recording, and of every module that was heard its clock and its gyro's offset."""

    recording: Recording
    clocks: Mapping[str, ClockMap]
    offsets: Mapping[str, Array]


class Heard(NamedTuple):
    """One motion of one joint, as all that have feedback of it read it: kept samples (m, n) and (m, n, 3)."""

    event: JournalEvent
    watchers: tuple[str, ...]
    q_mean_rad: Array
    qd_rad_s: Array
    gyro_rad_s: Array
    offset_rad_s: Array


def _heard(ear: _Ear, joint: str) -> list[Heard]:
    """Return the slow motions of a joint; without watchers, those of which its own feedback is missing."""
    return [_of_motion(ear, event) for event in slow_motions(ear.recording, joint)]


def _of_motion(ear: _Ear, event: JournalEvent) -> Heard:
    watchers = _watchers(ear, event)
    if event.serial not in watchers:
        return Heard(event, (), np.empty(0), np.empty((0, 0)), np.empty((0, 0, 3)), np.empty((0, 3)))
    edge = settling_samples(RATE_HZ, TOPOLOGY_CUTOFF_HZ)
    one = window(ear.recording, ear.clocks, watchers, event, edge / RATE_HZ)
    signals = filtered_signals(one.q_rad, [one.gyro_rad_s], RATE_HZ, TOPOLOGY_CUTOFF_HZ, KEEP_EVERY)
    q, qd, _, gyro = signals.settled()
    offset = np.array([ear.offsets[s] for s in watchers])
    mean = q.mean(axis=0)
    return Heard(event, tuple(watchers), mean, qd, gyro, offset)


class Axes(NamedTuple):
    """What a first look is sure of: {(joint, observer): axis in the observer's frame, zero if not carried}.

    pose_rad: where the joints were, in the median of all motions.
    """

    found: Mapping[tuple[str, str], Array | None]
    pose_rad: Mapping[str, float]

    def of(self, names: Sequence[str]) -> Array:
        """Return (n, n, 3) of all pairs, NaN where nothing is sure."""
        unknown = np.full(3, np.nan)
        rows = [[self.found.get((o, k)) for k in names] for o in names]
        return np.array([[unknown if axis is None else axis for axis in row] for row in rows])

    def turned_away(self, heard: Heard) -> bool:
        """Return whether joints were elsewhere than where the axes were seen, so that these are others."""
        pairs = zip(heard.watchers, heard.q_mean_rad, strict=True)
        others = [abs(q - self.pose_rad[s]) for s, q in pairs if s != heard.event.serial]
        return bool(sum(others) > TURNED_RAD)


def _look(
    recording: Recording, serials: Sequence[str], heard_of: Mapping[str, list[Heard]], axes: Axes | None
) -> tuple[dict[tuple[str, str], MotionObservation], dict[str, str]]:
    """Return what was seen of all joints, and of those of which nothing was, why not."""
    observations: dict[tuple[str, str], MotionObservation] = {}
    unmoved: dict[str, str] = {}
    for joint in serials:
        found, why = _of_joint(recording, serials, heard_of[joint], axes)
        observations |= {(joint, observer): combined_observation(many) for observer, many in found.items()}
        if not found:
            unmoved[joint] = why
    return observations, unmoved


def _of_joint(
    recording: Recording, serials: Sequence[str], motions: Sequence[Heard], axes: Axes | None
) -> tuple[dict[str, list[MotionObservation]], str]:
    """Return what everyone saw of all motions of a joint; without any, why not."""
    found: dict[str, list[MotionObservation]] = {}
    why = "it was never told to move, or never came to the end of its motion"
    for heard in motions:
        assert heard.event.motion is not None
        try:
            seen_by = by_feedback(heard, axes)
        except NotMoved as error:
            why = str(error)
            continue
        for observer in serials:
            finding = _finding(recording, heard.event.motion, heard.event.serial, observer)
            seen = _checked(seen_by.get(observer), finding)
            if seen is not None:
                found.setdefault(observer, []).append(seen)
        why = "nobody saw its motion"
    return found, why


def by_feedback(heard: Heard, axes: Axes | None) -> dict[str, MotionObservation]:
    """Return what the feedback of all modules says of one motion; nothing without that of the joint.

    Raises:
        NotMoved: the joint hardly moved.
    """
    names = heard.watchers
    if not names:
        return {}
    joint = names.index(heard.event.serial)
    known = axes.of(names) if axes is not None and not axes.turned_away(heard) else None
    seen = motion_evidence(joint, heard.qd_rad_s, heard.gyro_rad_s, heard.offset_rad_s, known)
    return {s: _motion_seen(seen, k) for k, s in enumerate(names)}


def _watchers(ear: _Ear, event: JournalEvent) -> list[str]:
    """Return the modules that have feedback of all of a motion; a module may fall silent in between."""
    everyone = sorted(ear.clocks)
    if event.serial not in everyone or _covered(ear, everyone, event):
        return everyone
    return [s for s in everyone if _covered(ear, [event.serial, s], event)]


def _covered(ear: _Ear, serials: Sequence[str], event: JournalEvent) -> bool:
    margin_s = settling_samples(RATE_HZ, TOPOLOGY_CUTOFF_HZ) / RATE_HZ
    try:
        found = window(ear.recording, ear.clocks, serials, event, margin_s)
    except DataError:
        return False
    # A window is cut to what all modules have: one that fell silent early must not cut the others short.
    whole = window(ear.recording, ear.clocks, [event.serial], event, margin_s)
    return len(found.t_ns) > 0.9 * len(whole.t_ns)


def _motion_seen(seen: MotionEvidence, k: int) -> MotionObservation:
    ratio = float(seen.rate_ratio[k])
    moved = ratio > 0.5
    axis = seen.coefficient[k] / ratio if moved else None
    return MotionObservation(moved, ratio, axis, float(seen.ratio_sigma[k]), float(seen.give[k]))


def _finding(recording: Recording, motion: MotionRecord, joint: str, observer: str) -> Estimate | None:
    """Return what a module itself found of one slow motion, if it found anything."""
    found = recording.estimates.get((joint, observer), {}).get((motion.motion_id,))
    return found if found is not None and not found.note else None


def _checked(seen: MotionObservation | None, finding: Estimate | None) -> MotionObservation | None:
    """Return what the feedback says, less certain if the module itself found otherwise."""
    if finding is None:
        return seen
    if seen is None:
        return MotionObservation(finding.moved, finding.rate_ratio, None, OWN_SIGMA)
    apart = abs(seen.rate_ratio - finding.rate_ratio)
    return seen._replace(sigma=float(np.hypot(seen.sigma, max(0.0, apart - seen.sigma))))


def _gyro_offset(recording: Recording, serial: str) -> Array:
    """Average the gyro over the module's last rest; zero if it was never seen at rest."""
    rows = recording.rest_rows(serial)
    return np.asarray(rows["gyro_rad_s"].astype(float).mean(axis=0)) if len(rows) else np.zeros(3)
