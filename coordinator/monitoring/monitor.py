"""The watch itself: takes what was recorded since, returns what there is to say. No clock, no network.

Contacts are said within some hundredths of a second, and are looked at again: one that leaves the torques
changed was the moment in which a load was put on, or a link slipped, and no collision.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from coordinator.monitoring.collision_detector import CollisionDetector
from coordinator.monitoring.contact import Contact
from coordinator.monitoring.diagnosis import Diagnosis, Piece, explains, judge, piece_of, weigh
from coordinator.monitoring.finding_text import (
    collision_finding,
    friction_finding,
    load_finding,
    unexplained_finding,
    wear_finding,
)
from coordinator.monitoring.findings import Finding, FindingLog, Key
from coordinator.monitoring.reference import Reference
from coordinator.monitoring.segments import Alignment, Block, Hole, Segmenter
from coordinator.monitoring.thresholds import ALARMS_PER_HOUR, SPANS, Thresholds, thresholds
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import RATE_HZ
from module_agent.model.chain import Array
from module_agent.model.regressor import PER_BODY
from module_agent.signals.clock_map import ClockMap

# A contact that is felt longer than this is no blow: what is torque then is looked at.
LONGEST_BLOW_NS = 1_000_000_000
# Contacts that follow on each other so soon are one.
AGAIN_NS = 2_000_000_000
# Of a blow, what is not to be taken for a change: before, as the filter looks ahead, and after, as it rings.
BEFORE_NS, AFTER_NS = 200_000_000, 300_000_000
# Clocks that are known worse than this set samples of different instants beside each other: at 1 rad/s and
# 0.35 m a millisecond is 0.35 mm of a link, and 0.6 % of a torque that swings at 1 Hz.
WORST_CLOCK_NS = 1e6
# A change began with a contact, if there was one so shortly before it was first seen.
BEGAN_WITHIN_NS = 4_000_000_000
# A change is called by what explains it after so many stretches in a row; if nothing does, after more.
CONFIRMED, UNEXPLAINED_AFTER = 2, 10
# A mass that is not known to this many standard deviations is not said to be there.
MIN_SIGMAS = 5.0
# A payload that is held for longer is weighed as seldom.
SETTLED_AFTER = 12
# Stretches since a change after which contacts are judged by the changed robot: at once, and for good.
ADAPT_AFTER = (CONFIRMED, 8)


class Heard(NamedTuple):
    """What is to be said: findings, each new or in place of an earlier one with its key; what is no longer
    held, by key; and notes on what hinders the watch."""

    findings: tuple[Finding, ...]
    withdrawn: tuple[Key, ...]
    notes: tuple[str, ...]


class _Verdict(NamedTuple):
    """What the newest windows show: the kind of change and the module it is at, by what, and since when."""

    kind: str
    where: int
    judged: Diagnosis
    pieces: Sequence[Piece]
    since_ns: int


class Watcher:
    """Watches one robot.

    ledger: what it holds to be so. looked_s: how long all modules were heard together.
    """

    def __init__(self, reference: Reference, alarms_per_hour: float = ALARMS_PER_HOUR):
        self.reference = reference
        self.thresholds: Thresholds = thresholds(reference, alarms_per_hour)
        self.ledger = FindingLog()
        self.looked_s = 0.0
        self._alignment = Alignment(reference.chain.serials)
        self._stretches = Segmenter()
        self._touch = CollisionDetector(reference, self.thresholds.contact_nm)
        self._pieces: deque[Piece] = deque(maxlen=max(SPANS))
        self._agreed: tuple[str, int] | None = None
        self._agreed_for = 0
        self._since_ns = 0
        self._silent: tuple[str, ...] = ()
        self._untimed: tuple[str, ...] = ()

    @property
    def outside_nm(self) -> Array | None:
        """The latest torques from outside (n,) [Nm], None before any."""
        return self._touch.outside_nm

    def advance(self, recording: Recording, clocks: Mapping[str, ClockMap]) -> Heard:
        """Look at what has been recorded since the last call."""
        notes: list[str] = []
        said: list[Finding] = []
        gone: list[Key] = []
        while True:
            aligned = self._alignment.advance(recording, clocks)
            notes += self._hindered(aligned.holes, aligned.silent)
            notes += self._timed(clocks)
            if aligned.block is not None:
                found, dropped = self._look(aligned.block)
                said += found
                gone += dropped
            elif not aligned.holes:
                break
        return Heard(tuple(said), tuple(gone), tuple(notes))

    def _look(self, block: Block) -> tuple[list[Finding], list[Key]]:
        now_ns = int(block.t_ns[-1])
        said: list[Finding] = []
        gone: list[Key] = []
        self.looked_s += len(block.t_ns) / RATE_HZ
        for contact in self._touch.advance(block):
            if not self._untimed:
                said += self.ledger.put(collision_finding(self.reference, self.thresholds, contact, now_ns))
        for stretch in self._stretches.add(block):
            self._pieces.append(piece_of(self.reference, stretch))
            judged = self._judged()
            said += self._drives(judged, now_ns)
            if self._untimed:
                continue
            verdict = self._verdict(judged)
            said += self._change(verdict, now_ns)
            gone += self._withdrawn(said, now_ns)
            gone += self._adapted(verdict, now_ns)
            said += self._ended(now_ns)
        return said, gone

    # ------------------------------------------------------------------ judging

    def _calm(self) -> list[Piece]:
        """Return the pieces into which no blow falls."""
        blows = [_blow(start, end) for start, end in _together(self._touch.contacts)]
        return [p for p in self._pieces if not any(p.start_ns < b and a < p.end_ns for a, b in blows)]

    def _judged(self) -> list[tuple[Diagnosis, Sequence[Piece]]]:
        calm = self._calm()
        newest = self._pieces[-1]
        # A judgement that has been made already is not made again.
        if not calm or calm[-1] is not newest:
            return []
        windows = [calm[-span:] for span in SPANS if len(calm) >= span]
        since = [p for p in calm if p.start_ns >= self._since_ns] if self._agreed is not None else []
        if len(since) >= CONFIRMED:
            windows.append(since)
        laden = any(finding.kind == "payload" for finding in self.ledger.held.values())
        return [(judge(self.reference, self.thresholds, window, laden), window) for window in windows]

    def _drives(self, judged: Sequence[tuple[Diagnosis, Sequence[Piece]]], now_ns: int) -> list[Finding]:
        # Friction is in no hurry, and in a short window other things pass for it.
        long = [(one, window) for one, window in judged if len(window) >= max(SPANS)]
        found = {d.joint: (d, window[0].start_ns) for one, window in long for d in one.drives}
        return [
            said
            for shift, since_ns in found.values()
            for said in self.ledger.put(
                friction_finding(self.reference, self.thresholds, shift, since_ns, now_ns)
            )
        ]

    def _verdict(self, judged: Sequence[tuple[Diagnosis, Sequence[Piece]]]) -> _Verdict | None:
        """Return what explains the newest windows; those since the change began come first."""
        found = None
        for one, window in reversed(judged):
            load = one.load
            if one.link is not None:
                found = _Verdict("wear", one.link.child, one, window, 0)
            elif load is not None and explains(self.reference, load) and found is None:
                found = _Verdict("payload", load.carrier, one, window, 0)
            if found is not None and found.kind == "wear":
                break
        if found is None:
            # What the newest stretches do not show any more was a blow too weak to be felt as one.
            if not judged or judged[0][0].load is None:
                self._agreed, self._agreed_for = None, 0
                return None
            found = _Verdict("unexplained", 0, *judged[0], 0)
        if self._agreed is None:
            self._since_ns = self._began(found.pieces[0].start_ns)
        same = self._agreed == (found.kind, found.where)
        self._agreed, self._agreed_for = (found.kind, found.where), self._agreed_for + 1 if same else 1
        return found._replace(since_ns=self._since_ns)

    def _began(self, seen_ns: int) -> int:
        """Return when a change began that was seen first in a window that begins at a time."""
        starts = [c.start_ns for c in self._touch.contacts if -BEGAN_WITHIN_NS < c.start_ns - seen_ns < 2e9]
        return min(starts, default=seen_ns)

    # ------------------------------------------------------------------ saying

    def _change(self, verdict: _Verdict | None, now_ns: int) -> list[Finding]:
        if verdict is None:
            return []
        needed = UNEXPLAINED_AFTER if verdict.kind == "unexplained" else CONFIRMED
        if self._agreed_for < needed:
            return []
        if verdict.kind != "wear" and any(f.kind == "wear" for f in self.ledger.held.values()):
            return []
        held = self.ledger.held.get(("load", 0))
        settled = self._agreed_for > SETTLED_AFTER and held is not None and held.kind == verdict.kind
        if settled and verdict.kind == "payload" and self._agreed_for % SETTLED_AFTER:
            # It takes a while to weigh it, and it will not be another.
            self.ledger.see(("load", 0), now_ns)
            return []
        finding = self._finding(verdict, now_ns)
        return [] if finding is None else self.ledger.put(finding)

    def _finding(self, verdict: _Verdict, now_ns: int) -> Finding | None:
        reference, link, load = self.reference, verdict.judged.link, verdict.judged.load
        if verdict.kind == "wear" and link is not None:
            return wear_finding(reference, self.thresholds, link, verdict.since_ns, now_ns)
        if load is None:
            return None
        if verdict.kind == "unexplained":
            return unexplained_finding(reference, self.thresholds, load, verdict.since_ns, now_ns)
        found = weigh(reference, verdict.pieces, load)
        if found is None or not found.explains or found.mass_kg < MIN_SIGMAS * found.mass_sigma_kg:
            return None
        return load_finding(reference, self.thresholds, load, found, verdict.since_ns, now_ns)

    def _adapted(self, verdict: _Verdict | None, now_ns: int) -> list[Key]:
        """Tell contacts from torques as they are since a change; take back those that were told otherwise."""
        if verdict is None or verdict.judged.load is None or self._agreed_for not in ADAPT_AFTER:
            return []
        if not any(finding.kind in ("payload", "wear") for finding in self.ledger.held.values()):
            return []
        load, phi = verdict.judged.load, self.reference.phi.copy()
        phi[PER_BODY * load.carrier : PER_BODY * (load.carrier + 1)] += load.change
        self._touch.adapt(phi)
        return self._without_collisions(verdict.since_ns, now_ns)

    def _without_collisions(self, since_ns: int, now_ns: int) -> list[Key]:
        return self.ledger.withdraw(
            [
                key
                for key, finding in self.ledger.held.items()
                if finding.kind == "collision" and since_ns <= finding.since_ns <= now_ns
            ]
        )

    def _withdrawn(self, said: Sequence[Finding], now_ns: int) -> list[Key]:
        """Take back what a change explains: loads if a link is displaced, contacts of its beginning."""
        lasting = [f for f in said if f.kind in ("payload", "wear", "unexplained")]
        gone: list[Key] = []
        if any(f.kind == "wear" for f in lasting):
            gone += self.ledger.withdraw([("load", 0)])
        for change in lasting:
            gone += self._without_collisions(change.since_ns, now_ns)
        return gone

    def _ended(self, now_ns: int) -> list[Finding]:
        said = self.ledger.end_unseen(now_ns)
        if any(f.kind != "friction" for f in said):
            self._touch.adapt(self.reference.phi)
        return said

    # ------------------------------------------------------------------ what hinders

    def _timed(self, clocks: Mapping[str, ClockMap]) -> list[str]:
        """Note whose clock is not known well enough to compare its samples with those of the others."""
        poor = tuple(s for s in self.reference.chain.serials if _is_poor(clocks.get(s)))
        if poor == self._untimed:
            return []
        self._untimed = poor
        if not poor:
            return ["all clocks are known well again: everything is watched"]
        worst = max(clocks[s].sigma_ns for s in poor)
        return [
            f"the network is slow: when {', '.join(poor)} read what they say is known to "
            f"{1e-6 * worst:.1f} ms only, and {1e-6 * WORST_CLOCK_NS:.1f} ms are needed; only friction is "
            "watched, each drive by itself"
        ]

    def _hindered(self, holes: Sequence[Hole], silent: tuple[str, ...]) -> list[str]:
        notes = [
            f"module {hole.serial}: {1e-6 * (hole.to_ns - hole.from_ns):.0f} ms of its feedback are missing; "
            "the watch begins anew after them"
            for hole in holes
        ]
        if holes:
            self._stretches.reset()
            self._touch.reset()
            self._pieces.clear()
            self._agreed, self._agreed_for = None, 0
        if silent != self._silent:
            notes += [
                f"module {s} is silent: nothing is judged without it" for s in silent if s not in self._silent
            ]
            notes += [f"module {s} is heard again" for s in self._silent if s not in silent]
            self._silent = silent
        return notes


def _is_poor(clock: ClockMap | None) -> bool:
    return clock is not None and clock.sigma_ns > WORST_CLOCK_NS


def _together(contacts: Sequence[Contact]) -> list[tuple[int, int]]:
    """Return from when to when something touched the robot, contacts soon after each other as one."""
    found: list[tuple[int, int]] = []
    for contact in sorted(contacts, key=lambda c: c.start_ns):
        end = contact.end_ns if contact.end_ns is not None else contact.start_ns + LONGEST_BLOW_NS
        if found and contact.start_ns - found[-1][1] < AGAIN_NS:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((contact.start_ns, end))
    return found


def _blow(start_ns: int, end_ns: int) -> tuple[int, int]:
    """Return from when to when nothing is to be taken for a change."""
    # What lasts is more than a blow; only its beginning is left out.
    end = start_ns if end_ns - start_ns > LONGEST_BLOW_NS else end_ns
    return start_ns - BEFORE_NS, end + AFTER_NS
