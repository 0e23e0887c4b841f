"""Who moved with whom, out of a recording: every slow motion of every joint, as every IMU saw it.

Slow motion decides: near a resonance of the held joints a fast one shakes modules that it does not carry, and
holds others still that it does.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.chain import Array
from coordinator.clock_map import ClockMap, map_clocks
from coordinator.dynamics.differentiation import differentiate, settling_samples, zero_phase_low_pass
from coordinator.journal import JournalEvent
from coordinator.kinematics.motion_evidence import MotionEvidence, NotMoved, combined, motion_evidence
from coordinator.kinematics.topology import MotionSeen, Observations
from coordinator.motion_window import RATE_HZ, window
from coordinator.recording import Recording

# Joints that give ring at 3 to 20 Hz; the slow motion itself is over in about a second.
CUTOFF_HZ = 10.0
KEEP_EVERY = 5


class Seen(NamedTuple):
    """What a recording says of who moved with whom.

    observations: {(joint, observer): MotionSeen}, of what was seen.
    unmoved: joints that were told to move and did not, with how much they did in words.
    blind: modules without feedback during any motion, and those whose clocks cannot be mapped.
    """

    observations: Observations
    unmoved: Mapping[str, str]
    blind: tuple[str, ...]


def observe(recording: Recording, serials: Sequence[str]) -> Seen:
    """Evaluate all slow motions of these modules; what is missing is left out rather than guessed."""
    timed = [s for s in serials if recording.modules[s].round_trips and len(_all_rows(recording, s))]
    clocks = map_clocks({s: recording.modules[s].round_trips for s in timed}) if timed else {}
    offsets = {s: _gyro_offset(recording, s) for s in timed}
    observations: dict[tuple[str, str], MotionSeen] = {}
    unmoved: dict[str, str] = {}
    for joint in timed:
        found: dict[str, list[MotionEvidence]] = {}
        for event in slow_motions(recording, joint):
            watchers = _watchers(recording, clocks, timed, event)
            if joint not in watchers:
                continue
            try:
                seen = _evaluate(recording, clocks, watchers, offsets, event)
            except NotMoved as error:
                unmoved[joint] = str(error)
                continue
            for k, watcher in enumerate(watchers):
                found.setdefault(watcher, []).append(_of_one(seen, k))
        if found:
            unmoved.pop(joint, None)
        observations |= {(joint, watcher): _motion_seen(combined(many)) for watcher, many in found.items()}
    watching = {observer for _, observer in observations}
    moved_any = bool(observations)
    blind = tuple(s for s in serials if s not in timed or (moved_any and s not in watching))
    return Seen(observations, unmoved, blind)


def slow_motions(recording: Recording, joint: str) -> list[JournalEvent]:
    """Return the constant motions of a joint that were completed since its module's latest boot."""
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


def _all_rows(recording: Recording, serial: str) -> range:
    rows = recording.modules[serial].rows
    return range(rows.first_row, rows.end_row)


def _gyro_offset(recording: Recording, serial: str) -> Array:
    """Average the gyro over the module's last rest; zero if it was never seen at rest."""
    rests = [
        e.motion
        for e in recording.journal
        if e.what == "motion" and e.purpose == "rest" and e.serial == serial and e.motion is not None
    ]
    if not rests or rests[-1].end_row is None:
        return np.zeros(3)
    rows = recording.rows(serial, rests[-1].start_row, rests[-1].end_row)
    return np.asarray(rows["gyro_rad_s"].astype(float).mean(axis=0)) if len(rows) else np.zeros(3)


def _watchers(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str], event: JournalEvent
) -> list[str]:
    """Return the modules that have feedback of all of a motion; a module may fall silent in between."""
    return [s for s in serials if _covers(recording, clocks, s, event)]


def _covers(recording: Recording, clocks: Mapping[str, ClockMap], serial: str, event: JournalEvent) -> bool:
    try:
        window(recording, clocks, [event.serial, serial], event)
    except ValueError:
        return False
    return True


def _evaluate(
    recording: Recording,
    clocks: Mapping[str, ClockMap],
    watchers: Sequence[str],
    offsets: Mapping[str, Array],
    event: JournalEvent,
) -> MotionEvidence:
    edge = settling_samples(RATE_HZ, CUTOFF_HZ)
    one = window(recording, clocks, watchers, event, edge / RATE_HZ)
    q, gyro = (zero_phase_low_pass(signal, RATE_HZ, CUTOFF_HZ) for signal in (one.q_rad, one.gyro_rad_s))
    kept = slice(edge, len(one.t_ns) - edge, KEEP_EVERY)
    offset = np.array([offsets[s] for s in watchers])
    rate = differentiate(q, RATE_HZ)[kept]
    return motion_evidence(watchers.index(event.serial), rate, gyro[kept], offset)


def _of_one(seen: MotionEvidence, k: int) -> MotionEvidence:
    return MotionEvidence(seen.coefficient[k : k + 1], seen.sigma[k : k + 1], seen.give)


def _motion_seen(seen: MotionEvidence) -> MotionSeen:
    ratio = float(seen.rate_ratio[0])
    moved = ratio > 0.5
    axis = seen.coefficient[0] / ratio if moved else None
    return MotionSeen(moved, ratio, axis, float(seen.ratio_sigma[0]), seen.give)
