"""The monitor of one robot: takes new recorded data, returns new findings. No clock, no network.

Contacts are reported within some hundredths of a second and revised later: a contact after which the torques
stay changed was the moment at which a payload was added or a link slipped, and no collision.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.monitoring.contact import CollisionDetector, Contact
from coordinator.monitoring.diagnosis import (
    Diagnosis,
    SegmentInformation,
    collision,
    diagnose,
    explains,
    segment_information,
    unexplained,
    weighed,
)
from coordinator.monitoring.findings import IMU_SENSORS, STRUCTURAL, STRUCTURE, Finding, FindingLog, Key
from coordinator.monitoring.reference import ALARMS_PER_HOUR, SPANS, Reference, Thresholds, thresholds
from coordinator.monitoring.segments import (
    SEGMENT_S,
    Alignment,
    Block,
    DataSegment,
    Gap,
    Segmenter,
    without_offsets,
)
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import RATE_HZ
from module_agent.model.chain import Array
from module_agent.model.regressor import PER_BODY
from module_agent.signals.clock_map import ClockMap

# A contact that is felt longer than this is no blow: what is torque then is looked at.
MAX_COLLISION_NS = 1_000_000_000
# Contacts that follow on each other so soon are one.
MERGED_WITHIN_NS = 2_000_000_000
# Of a blow, what is not to be taken for a change: before, as the filter looks ahead, and after, as it rings.
BEFORE_NS, AFTER_NS = 200_000_000, 300_000_000
# With clocks of a larger standard deviation, samples of different instants would be compared: at 1 rad/s and
# 0.35 m a millisecond is 0.35 mm of a link, and 0.6 % of a torque that swings at 1 Hz.
WORST_CLOCK_NS = 1e6
# An encoder leaps that shows more than so many times the largest speed of its type.
LEAP = 3.0
# A change began with a contact, if there was one so shortly before it was first seen.
BEGAN_WITHIN_NS = 4_000_000_000
# A change is called by what explains it after so many stretches in a row; if nothing does, after more.
CONFIRMED, UNEXPLAINED_AFTER = 2, 10
# A payload that is held for longer is weighed as seldom.
SETTLED_AFTER = 12
# Stretches since a change after which contacts are judged by the changed robot: at once, and for good.
ADAPT_AFTER = (CONFIRMED, 8)


class MonitorUpdate(NamedTuple):
    """What is to be reported: findings, each new or in place of an earlier one with its key; the keys of
    those that no longer hold; and notes on what hinders monitoring."""

    findings: tuple[Finding, ...]
    withdrawn: tuple[Key, ...]
    notes: tuple[str, ...]


_Diagnosed = Sequence[tuple[Diagnosis, Sequence[SegmentInformation]]]


class _Hypothesis(NamedTuple):
    """What the newest windows show: the kind of change, the module that it is at, and by what."""

    kind: str
    serial: str
    diagnosis: Diagnosis
    window: Sequence[SegmentInformation]


class Monitor:
    """Compares one robot with its reference.

    finding_log: what it holds to be so. monitored_s: how long all modules were received together.
    """

    def __init__(self, reference: Reference, alarms_per_hour: float = ALARMS_PER_HOUR):
        self.reference = reference
        self.thresholds: Thresholds = thresholds(reference, alarms_per_hour)
        self.finding_log = FindingLog()
        self.monitored_s = 0.0
        self._alignment = Alignment(reference.chain.serials)
        self._segmenter = Segmenter()
        self._collisions = CollisionDetector(reference.chain, reference.phi, self.thresholds.contact_nm)
        self._pieces: deque[SegmentInformation] = deque(maxlen=max(SPANS))
        self._agreed: tuple[str, str] | None = None
        self._agreed_for = 0
        self._since_ns = 0
        self._silent: tuple[str, ...] = ()
        self._untimed: tuple[str, ...] = ()

    @property
    def outside_nm(self) -> Array | None:
        """The latest torques from outside (n,) [Nm], None before any."""
        return self._collisions.outside_nm

    def advance(self, recording: Recording, clocks: Mapping[str, ClockMap]) -> MonitorUpdate:
        """Look at what has been recorded since the last call."""
        notes: list[str] = []
        findings: list[Finding] = []
        withdrawn: list[Key] = []
        while True:
            aligned = self._alignment.advance(recording, clocks)
            notes += self._hindered(aligned.gaps, aligned.silent)
            notes += self._timed(clocks)
            if aligned.block is not None:
                block = without_offsets(aligned.block, self.reference.torque_offset_nm)
                found, dropped, said = self._look(block)
                findings += found
                withdrawn += dropped
                notes += said
            if not aligned.gaps:
                # A block ends with the newest rows.
                break
        return MonitorUpdate(tuple(findings), tuple(withdrawn), tuple(notes))

    def _look(self, block: Block) -> tuple[list[Finding], list[Key], list[str]]:
        now_ns = int(block.t_ns[-1])
        findings: list[Finding] = []
        withdrawn: list[Key] = []
        notes: list[str] = []
        self.monitored_s += len(block.t_ns) / RATE_HZ
        for contact in self._collisions.advance(block):
            if not self._untimed:
                detection = collision(self.reference, self.thresholds, contact)
                findings += self.finding_log.put(detection.finding(contact.start_ns, now_ns, contact.end_ns))
        for segment in self._segmenter.add(block):
            if leaps := self._leaps(segment):
                notes += leaps
                continue
            self._pieces.append(segment_information(self.reference, segment))
            diagnosed = self._diagnosed()
            findings += self._drives(diagnosed, now_ns)
            if self._untimed:
                continue
            findings += self._sick_imu(diagnosed, now_ns)
            hypothesis = self._hypothesis(diagnosed)
            if hypothesis is not None:
                findings += self._change(hypothesis, now_ns)
            withdrawn += self._withdrawn(findings, now_ns)
            if hypothesis is not None:
                withdrawn += self._adapted(hypothesis, now_ns)
            findings += self._ended(now_ns)
        return findings, withdrawn, notes

    def _leaps(self, segment: DataSegment) -> list[str]:
        """Note the encoders that leap in a segment: no motion of the robot makes such rows."""
        notes = []
        fastest = np.abs(segment.qd_rad_s).max(axis=0)
        for serial, model, speed in zip(
            self.reference.chain.serials, self.reference.drive_models, fastest, strict=True
        ):
            most = LEAP * model.kind.max_speed_rad_s
            if speed > most:
                notes.append(
                    f"module {serial}: its encoder leaps, by {speed:.3g} rad/s where its type has at most "
                    f"{model.kind.max_speed_rad_s:.3g}; {SEGMENT_S:g} s are left out"
                )
        return notes

    def _held(self, *kinds: str) -> bool:
        return any(finding.kind in kinds for finding in self.finding_log.held.values())

    # ------------------------------------------------------------------ judging

    def _diagnosed(self) -> _Diagnosed:
        """Diagnose the newest windows without the segments into which a collision falls."""
        spans = _collision_spans(self._collisions.contacts)
        calm = [p for p in self._pieces if not any(p.start_ns < b and a < p.end_ns for a, b in spans)]
        # A judgement that has been made already is not made again.
        if not calm or calm[-1] is not self._pieces[-1]:
            return []
        windows = [calm[-span:] for span in SPANS if len(calm) >= span]
        since = [p for p in calm if p.start_ns >= self._since_ns] if self._agreed is not None else []
        if len(since) >= CONFIRMED:
            windows.append(since)
        loaded = self._held("payload")
        return [(diagnose(self.reference, self.thresholds, window, loaded), window) for window in windows]

    def _drives(self, diagnosed: _Diagnosed, now_ns: int) -> list[Finding]:
        # Friction is in no hurry, and in a short window other things pass for it.
        long = [(one, window) for one, window in diagnosed if len(window) >= max(SPANS)]
        latest = {d.serial: d.finding(window[0].start_ns, now_ns) for one, window in long for d in one.drives}
        # What a torque sensor reads too much passes for friction.
        sick = [one.serial for one in self.finding_log.held.values() if one.kind == "torque-sensor"]
        credible = [one for one in latest.values() if one.kind == "torque-sensor" or one.serial not in sick]
        return [news for finding in credible for news in self.finding_log.put(finding)]

    def _is_sick_imu(self, one: Diagnosis) -> bool:
        """Return whether what IMUs show is the sick one that is held: it says nothing of torques."""
        held, seen = self.finding_log.held.get(STRUCTURE), one.structure
        if held is None or seen is None or held.kind not in IMU_SENSORS:
            return False
        return (held.kind, held.serial) == (seen.kind, seen.serial)

    def _sick_imu(self, diagnosed: _Diagnosed, now_ns: int) -> list[Finding]:
        """Go on with the sick IMU that is held, by the longest window that shows it."""
        for one, _ in reversed(diagnosed):
            if one.structure is not None and self._is_sick_imu(one):
                return self.finding_log.put(one.structure.finding(now_ns, now_ns))
        return []

    def _hypothesis(self, diagnosed: _Diagnosed) -> _Hypothesis | None:
        """Return what explains the newest windows; those since the change began come first."""
        found, serials = None, self.reference.chain.serials
        for one, window in reversed(diagnosed):
            if one.structure is not None and not self._is_sick_imu(one):
                found = _Hypothesis(one.structure.kind, one.structure.serial, one, window)
                break
            if found is not None or one.load is None:
                continue
            if one.load.sensor is not None:
                # A sensor that is off stays so; in a short window a blow passes for one.
                if len(window) >= max(SPANS):
                    found = _Hypothesis("torque-sensor", one.load.sensor.serial, one, window)
            elif explains(self.reference, one.load):
                found = _Hypothesis("payload", serials[one.load.carrier], one, window)
        if found is None:
            # What the newest segments do not show any more was too weak a blow to be detected as one.
            if not diagnosed or diagnosed[0][0].load is None:
                self._agreed, self._agreed_for = None, 0
                return None
            found = _Hypothesis("unexplained", "", *diagnosed[0])
        if self._agreed is None:
            self._since_ns = self._began(found.window[0].start_ns)
        same = self._agreed == (found.kind, found.serial)
        self._agreed, self._agreed_for = (found.kind, found.serial), self._agreed_for + 1 if same else 1
        return found

    def _began(self, seen_ns: int) -> int:
        """Return when a change began that was seen first in a window that begins at a time."""
        starts = [
            c.start_ns for c in self._collisions.contacts if -BEGAN_WITHIN_NS < c.start_ns - seen_ns < 2e9
        ]
        return min(starts, default=seen_ns)

    # ------------------------------------------------------------------ reporting

    def _change(self, hypothesis: _Hypothesis, now_ns: int) -> list[Finding]:
        kind, log = hypothesis.kind, self.finding_log
        if self._agreed_for < (UNEXPLAINED_AFTER if kind == "unexplained" else CONFIRMED):
            return []
        if kind not in STRUCTURAL and self._held("wear"):
            return []
        # By a torque sensor that is off nothing can be weighed.
        if kind in ("payload", "unexplained") and self._held("torque-sensor"):
            return []
        held = log.held.get(("load", 0))
        settled = self._agreed_for > SETTLED_AFTER and held is not None and held.kind == kind
        if settled and kind == "payload" and self._agreed_for % SETTLED_AFTER:
            # It takes a while to weigh it, and it will not be another.
            log.observe(("load", 0), now_ns)
            return []
        detection, load = hypothesis.diagnosis.structure, hypothesis.diagnosis.load
        if load is not None and kind == "torque-sensor":
            detection = load.sensor
        elif load is not None and kind == "unexplained":
            detection = unexplained(self.reference, self.thresholds, load)
        elif load is not None and kind == "payload":
            detection = weighed(self.reference, self.thresholds, hypothesis.window, load)
        return [] if detection is None else log.put(detection.finding(self._since_ns, now_ns))

    def _adapted(self, hypothesis: _Hypothesis, now_ns: int) -> list[Key]:
        """Detect contacts by the changed robot from now on; withdraw those that the change explains."""
        load = hypothesis.diagnosis.load
        if load is None or self._agreed_for not in ADAPT_AFTER or not self._held("payload", "wear"):
            return []
        phi = self.reference.phi.copy()
        phi[PER_BODY * load.carrier : PER_BODY * (load.carrier + 1)] += load.change
        self._collisions.adapt(phi)
        return self._without_collisions(self._since_ns, now_ns)

    def _without_collisions(self, since_ns: int, now_ns: int) -> list[Key]:
        return self.finding_log.withdraw(
            [
                key
                for key, finding in self.finding_log.held.items()
                if finding.kind == "collision" and since_ns <= finding.since_ns <= now_ns
            ]
        )

    def _withdrawn(self, findings: Sequence[Finding], now_ns: int) -> list[Key]:
        """Withdraw what a change explains: loads if a link is off, friction if the joint's torque sensor is,
        contacts of its beginning if torques have changed."""
        lasting = [f for f in findings if f.kind not in ("collision", "friction")]
        displaced = any(f.kind == "wear" for f in lasting)
        withdrawn = self.finding_log.withdraw([("load", 0)] if displaced else [])
        withdrawn += self.finding_log.withdraw(
            ("friction", f.serial) for f in lasting if f.kind == "torque-sensor"
        )
        for change in lasting:
            if change.kind in IMU_SENSORS:
                continue
            withdrawn += self._without_collisions(change.since_ns, now_ns)
        return withdrawn

    def _ended(self, now_ns: int) -> list[Finding]:
        findings = self.finding_log.end_unseen(now_ns)
        if any(f.kind != "friction" for f in findings):
            self._collisions.adapt(self.reference.phi)
        return findings

    # ------------------------------------------------------------------ what hinders

    def _timed(self, clocks: Mapping[str, ClockMap]) -> list[str]:
        """Note whose clock is not known well enough to compare its samples with those of the others."""
        sigmas = {s: clocks[s].sigma_ns for s in self.reference.chain.serials if s in clocks}
        poor = tuple(serial for serial, sigma_ns in sigmas.items() if sigma_ns > WORST_CLOCK_NS)
        if poor == self._untimed:
            return []
        self._untimed = poor
        if not poor:
            return ["all clocks are accurate again: the tests go on"]
        drives = any(self.reference.drives)
        left = "only friction is watched, each drive by itself" if drives else "nothing is watched"
        sigma_ms, needed_ms = 1e-6 * max(sigmas.values()), 1e-6 * WORST_CLOCK_NS
        return [
            f"the network is slow: when {', '.join(poor)} read what they say is known to "
            f"{sigma_ms:.1f} ms only, and {needed_ms:.1f} ms are needed; {left}"
        ]

    def _hindered(self, gaps: Sequence[Gap], silent: tuple[str, ...]) -> list[str]:
        notes = [
            f"module {gap.serial}: {1e-6 * (gap.to_ns - gap.from_ns):.0f} ms of its feedback are missing; "
            "monitoring restarts after them"
            for gap in gaps
        ]
        if gaps:
            self._segmenter.reset()
            self._collisions.reset()
            self._pieces.clear()
            self._agreed, self._agreed_for = None, 0
        before, self._silent = self._silent, silent
        return [
            *notes,
            *(f"module {s} sends no feedback: the tests are suspended" for s in silent if s not in before),
            *(f"module {s} sends feedback again" for s in before if s not in silent),
        ]


def _collision_spans(contacts: Sequence[Contact]) -> list[tuple[int, int]]:
    """Return when nothing is to be taken for a change; contacts soon after each other are one."""
    found: list[tuple[int, int]] = []
    for contact in sorted(contacts, key=lambda c: c.start_ns):
        end = contact.end_ns if contact.end_ns is not None else contact.start_ns + MAX_COLLISION_NS
        if found and contact.start_ns - found[-1][1] < MERGED_WITHIN_NS:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((contact.start_ns, end))
    # What lasts is more than a blow; only its beginning is left out.
    return [
        (start - BEFORE_NS, (start if end - start > MAX_COLLISION_NS else end) + AFTER_NS)
        for start, end in found
    ]
