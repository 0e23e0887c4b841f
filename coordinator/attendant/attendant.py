"""What an attendant says and when it measures, as a state machine. No clock, no network, no robot.

It is told who is on the network and what the monitor holds to be so, and answers with sentences and, when
everything is ready for it, with a measurement. From a change to a measurement:

1. It must last: a module that is gone or new, a displaced link, a payload that stays, torques that nothing
   explains, a module that was off while others were not.
2. The robot is left alone: no module has come or gone for a while.
3. No program holds a module.
4. The notice has passed: it says that the robot is about to move, and for how long one can prevent it.

A change of 2 or 3 begins the notice anew. Without leave to move it ends at 1, with a sentence.
"""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from coordinator.monitoring.findings import SENSORS, Finding, Key
from coordinator.monitoring.findings import Kind as FindingKind

Aim = Literal["structure", "links", "load"]
"""What is measured: what came, went or was exchanged; all links; what the robot carries."""


class Patience(NamedTuple):
    """How long what must last, in seconds.

    gone_s: a module without its token; agents start again faster. came_s: a new one. still_s: since a module
    came or went. link_s, payload_s, unexplained_s: since a finding of the monitor. notice_s: between the
    announcement and the motion. retry_s: after a measurement that failed, of which there are `attempts`.
    again_s: after a measurement that confirmed the model, for the same finding.
    """

    gone_s: float = 5.0
    came_s: float = 2.0
    still_s: float = 8.0
    link_s: float = 3.0
    payload_s: float = 12.0
    unexplained_s: float = 12.0
    notice_s: float = 10.0
    retry_s: float = 60.0
    attempts: int = 3
    again_s: float = 3600.0


class Observation(NamedTuple):
    """What the attendant is told.

    present: modules on the network with the number of their boot, 0 if it is not known yet. findings: those
    of the monitor, also those that are over, in the order of time. holders: who holds which module, if it is
    held.
    """

    t_ns: int
    present: Mapping[str, int]
    findings: Sequence[Finding] = ()
    holders: Mapping[str, str] = {}


class Measurement(NamedTuple):
    """What to measure now, why, and with which modules."""

    aim: Aim
    why: tuple[str, ...]
    modules: tuple[str, ...]


class Step(NamedTuple):
    """What to say, and what to measure, if anything; `warn` is said last, also where all else is quiet.

    remarks: what is to be said too, though nothing has changed.
    """

    say: tuple[str, ...] = ()
    measure: Measurement | None = None
    warn: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


class Outcome(NamedTuple):
    """How a measurement ended: with a new model, with the model confirmed, or not at all; and in words."""

    what: Literal["replaced", "confirmed", "failed"]
    words: tuple[str, ...] = ()


class _Cause(NamedTuple):
    """What is to be measured, why, and of a finding its kind and module, and since when it counts."""

    aim: Aim
    text: str
    of: tuple[str, str] = ("", "")
    since_ns: int = 0


_AIMS: dict[FindingKind, Aim] = {"wear": "links", "unexplained": "links", "payload": "load"}
# A displacement that is known worse than that is no reason to move a robot: a limp arm that swings shows it.
MAX_LINK_SIGMA_MM = 5.0
_NEVER_NS = -(1 << 62)


class Attendant:
    """Decides for one robot that is known by the serials of its modules."""

    def __init__(self, known: Sequence[str], may_move: bool, patience: Patience = Patience()):  # noqa: B008
        self.known = frozenset(known)
        self._may_move = may_move
        self._patience = patience
        self._lasts_s = {
            "wear": patience.link_s,
            "payload": patience.payload_s,
            "unexplained": patience.unexplained_s,
        }
        self._longest_s = max(patience.gone_s, patience.still_s)
        # Since when a module is there, or is not.
        self._since: dict[str, tuple[bool, int]] = {}
        self._present_ns: int | None = None
        self._boots: dict[str, int] = {}
        self._begin_ns: int | None = None
        self.was_seen = self._is_awaited = False
        self._off = False
        self._structure: tuple[str, ...] = ()
        self._lasting: dict[Key, _Cause] = {}
        self._sick: set[tuple[str, str]] = set()
        # Findings that a measurement did not confirm: until when they are no reason for another.
        self._answered_ns: dict[tuple[str, str], int] = {}
        self._announced: tuple[str, ...] = ()
        self._tried: set[str] = set()
        self._waits_for = ""
        self._clear_ns: int | None = None
        self._failures = 0
        self._not_before_ns = _NEVER_NS

    def look(self, seen: Observation) -> Step:
        """Take in what is there now; return what to say, and what to measure."""
        if not self.was_seen and (step := self._first(seen)) is not None:
            return step
        if self._present_ns is None or seen.present:
            self._present_ns = seen.t_ns
        since_ns = seen.t_ns if self._present_ns is None else self._present_ns
        off = self._lasts(seen.t_ns, since_ns, self._patience.gone_s)
        if not seen.present and not off:
            # All at once: a switch, or the network, and not one that is plugged.
            return Step()
        say = [*self._presence(seen, off), *self._boots_anew(seen), *self._findings(seen)]
        causes = self._causes()
        texts = tuple(cause.text for cause in causes)
        if texts != self._announced:
            self._announced, self._waits_for, self._clear_ns = texts, "", None
            if not set(texts) <= self._tried:
                # Something else: what was tried in vain before does not count.
                self._tried, self._failures, self._not_before_ns = set(texts), 0, _NEVER_NS
            if texts and not self._may_move:
                say.append(
                    "the model does not hold any more; with --may-move the robot would be measured again"
                )
        if not causes or not self._may_move or self._failures >= self._patience.attempts:
            return Step(tuple(say))
        if obstacle := self._obstacle(seen):
            news = [f"waits {obstacle}"] if obstacle != self._waits_for else []
            self._waits_for, self._clear_ns = obstacle, None
            return Step((*say, *news))
        self._waits_for = ""
        if self._clear_ns is None:
            self._clear_ns = seen.t_ns
            return Step(tuple(say), warn=(self._notice(),))
        if not self._lasts(seen.t_ns, self._clear_ns, self._patience.notice_s):
            return Step(tuple(say))
        return Step(tuple(say), Measurement(_aim(causes), texts, tuple(sorted(seen.present))))

    def ended(self, t_ns: int, measured: Measurement, outcome: Outcome) -> Step:
        """Take in how a measurement ended; the monitor begins anew with it, and so do its findings."""
        self._clear_ns, self._waits_for, self._present_ns = None, "", t_ns
        if outcome.what == "failed":
            self._failures += 1
            self._not_before_ns = t_ns + round(1e9 * self._patience.retry_s)
            left = self._patience.attempts - self._failures
            after = (
                f"again in {self._patience.retry_s:.0f} s" if left else "not again until something changes"
            )
            return Step((f"could not be measured, {after}: {'; '.join(outcome.words)}",))
        if outcome.what == "replaced":
            self.known, self._structure = frozenset(measured.modules), ()
            self._answered_ns.clear()
        else:
            until_ns = t_ns + round(1e9 * self._patience.again_s)
            self._answered_ns |= {cause.of: until_ns for cause in self._lasting.values()}
        self._lasting.clear()
        self._announced, self._tried = (), set()
        return Step(outcome.words)

    # ------------------------------------------------------------------ what has changed

    def _first(self, seen: Observation) -> Step | None:
        """Wait for the first module; None once there is one: a robot that was not there yet has not gone."""
        if seen.present:
            self.was_seen = True
            return None
        self._begin_ns = seen.t_ns if self._begin_ns is None else self._begin_ns
        if self._is_awaited or not self._lasts(seen.t_ns, self._begin_ns, self._patience.gone_s):
            return Step()
        self._is_awaited = True
        return Step(remarks=("waits for the robot: no module is on the network yet",))

    def _presence(self, seen: Observation, off: bool) -> list[str]:
        """Note who came and went; say it where it lasts."""
        say = []
        for serial in {*self.known, *seen.present, *self._since}:
            there = serial in seen.present
            was = self._since.get(serial)
            if was is None or was[0] != there:
                # Of those that never were there, nothing is known before the beginning.
                self._since[serial] = there, seen.t_ns
        self._forget_strangers(seen.t_ns)
        if off != self._off:
            self._off = off
            say.append("no module is on the network any more" if off else "modules are on the network again")
        if self._off:
            self._structure = ()
            return say
        gone = [s for s in sorted(self.known) if self._settled(s, False, seen.t_ns)]
        new = [s for s in sorted(seen.present) if s not in self.known and self._settled(s, True, seen.t_ns)]
        texts = _structure_texts(gone, new)
        say += [text for text in texts if text not in self._structure]
        if self._structure and not texts:
            say.append("all modules are as they are known again")
        self._structure = texts
        return say

    def _forget_strangers(self, now_ns: int) -> None:
        """Forget modules that are not of the robot and gone for so long that nothing waits for it."""
        for serial, (there, since_ns) in list(self._since.items()):
            if not there and serial not in self.known and self._lasts(now_ns, since_ns, self._longest_s):
                del self._since[serial]

    def _settled(self, serial: str, there: bool, now_ns: int) -> bool:
        state, since_ns = self._since[serial]
        return state == there and self._lasts(
            now_ns, since_ns, self._patience.came_s if there else self._patience.gone_s
        )

    @staticmethod
    def _lasts(now_ns: int, since_ns: int, seconds: float) -> bool:
        return now_ns - since_ns >= 1e9 * seconds

    def _still(self, now_ns: int) -> bool:
        newest = max((since for _, since in self._since.values()), default=now_ns)
        return self._lasts(now_ns, newest, self._patience.still_s)

    def _boots_anew(self, seen: Observation) -> list[str]:
        """Say which modules were off while others were not: they may be mounted in another way."""
        if not self._still(seen.t_ns) or not self.known <= seen.present.keys():
            return []
        now = {serial: seen.present[serial] for serial in self.known if seen.present[serial]}
        anew = sorted(s for s, boot in now.items() if self._boots.get(s, boot) != boot)
        self._boots |= now
        if not anew:
            return []
        if len(anew) == len(self.known):
            return ["the robot was off, and is as it is known"]
        # It is a cause like one that the monitor finds, for all modules together.
        text = f"{_named(anew)} was off: whether the links to it are as before only motions show"
        self._lasting["boot", ",".join(anew)] = _Cause("links", text)
        return [text]

    def _findings(self, seen: Observation) -> list[str]:
        """Take over what the monitor has found for long enough."""
        say = []
        # One that is well again, or is another, may be off once more.
        self._sick &= {
            (finding.kind, finding.serial) for finding in seen.findings if finding.until_ns is None
        }
        for finding in seen.findings:
            aim, of = _AIMS.get(finding.kind), (finding.kind, finding.serial)
            if finding.kind in SENSORS:
                say += self._sensor(seen.t_ns, finding)
                continue
            lasting = self._lasting.get(finding.key)
            if lasting is not None:
                # A link that is not seen any more is no link that is repaired: the robot may only rest.
                if lasting.aim == "load" and (finding.until_ns or _NEVER_NS) > lasting.since_ns:
                    del self._lasting[finding.key]
                    say.append("the payload is gone again")
                continue
            if aim is None or finding.until_ns is not None or _is_vague(finding):
                continue
            # Of a robot with other modules the monitor's model says nothing.
            if self._structure or seen.t_ns < self._answered_ns.get(of, _NEVER_NS):
                continue
            if self._lasts(seen.t_ns, finding.detected_ns, self._lasts_s[finding.kind]):
                self._lasting[finding.key] = _Cause(aim, finding.summary, of, seen.t_ns)
                say.append(f"it stays so: {finding.summary}")
        return say

    def _sensor(self, t_ns: int, finding: Finding) -> list[str]:
        """Say once that a sensor is off, and again after it was well.

        What it was taken for is no cause to measure any more.
        """
        of = finding.kind, finding.serial
        if finding.until_ns is not None or of in self._sick or self._structure:
            return []
        if not self._lasts(t_ns, finding.detected_ns, self._patience.unexplained_s):
            return []
        self._sick.add(of)
        self._lasting.pop(finding.key, None)
        return [f"it stays so: {finding.summary}; a measurement would believe it, so that none is made of it"]

    def _causes(self) -> list[_Cause]:
        structure = [_Cause("structure", text) for text in self._structure]
        return [*structure, *self._lasting.values()]

    # ------------------------------------------------------------------ when to measure

    def _notice(self) -> str:
        return (
            f"THE ROBOT MOVES in {self._patience.notice_s:.0f} s, slowly at first, to be measured again: "
            "keep clear of it, or end this program"
        )

    def _obstacle(self, seen: Observation) -> str:
        if not seen.present:
            return "until the robot is on the network"
        if not self._still(seen.t_ns):
            return "until no module comes or goes any more"
        if seen.holders:
            serial, holder = min(seen.holders.items())
            return f"until {holder} releases {serial}"
        if seen.t_ns < self._not_before_ns:
            return "before it tries again"
        return ""


def _aim(causes: Sequence[_Cause]) -> Aim:
    """Return the least that measures everything that has changed."""
    aims = {cause.aim for cause in causes}
    # All links are measured together with the modules that there are, and with their load.
    return "links" if "links" in aims else "structure" if "structure" in aims else "load"


def _structure_texts(gone: Sequence[str], new: Sequence[str]) -> tuple[str, ...]:
    if len(gone) == len(new) == 1:
        return (f"module {gone[0]} was exchanged for {new[0]}",)
    return (*(f"module {serial} has gone" for serial in gone), *(f"module {serial} is new" for serial in new))


def _is_vague(finding: Finding) -> bool:
    """Return whether motions have shown too little of a displaced link; errors of IMUs pass for it then."""
    return finding.kind == "wear" and finding.sigma > MAX_LINK_SIGMA_MM


def _named(serials: Sequence[str]) -> str:
    return f"module {serials[0]}" if len(serials) == 1 else f"modules {', '.join(serials)}"
