"""The journal of a session: begin and end of every step, with its motions; part of the recording.

A crashed run resumes from it, and a replay reads from it the purpose of every motion.
"""

from collections.abc import Collection, Sequence
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from module_agent.model.catalogue import ImuKind, TorqueKind
from module_agent.model.model_faults import first_fault
from module_agent.wire.messages import MotionRecord
from module_agent.wire.refusal import Refusal, WireError

# Prefix of the steps of notes on excluded modules.
STEP = "left_out/"

What = Literal[
    "session", "begin", "done", "motion", "note", "anew", "explored", "settled", "failed", "finished"
]
Purpose = Literal["rest", "constant", "windowed_sine", "repeat", "whole", "dynamic", "held_out", "other"]


class JournalEvent(BaseModel):
    """One line of the journal; `what` says which of the other fields are set.

    `anew`: modules joined or left the robot, and motions before this event do not describe it. `explored`:
    topology and chain are identified from what was recorded before this event. `settled`: the clocks are
    mapped by the round trips before this event; later requests to the modules do not change them.
    `deaf`: modules that did not confirm the stop of a failed session; None in an older journal, which names
    them in its text. `by_limits`: an excluded module is well, but configured to refuse the motion; None in an
    older journal, which does not tell.
    `finished`: `cpu_us_per_message` is what receiving and recording a message cost.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    t_ns: int
    what: What
    step: str = ""
    serial: str = ""
    boot: Annotated[int, Field(ge=0)] = 0
    purpose: Purpose = "other"
    motion: MotionRecord | None = None
    text: str = ""
    deaf: tuple[str, ...] | None = None
    by_limits: bool | None = None
    robot: str = ""
    imu: ImuKind = "uncalibrated"
    torque: TorqueKind = "uncalibrated"
    wall_time_s: float | None = None
    cpu_us_per_message: float | None = None

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        """Return the event of some JSON.

        Raises:
            WireError: MALFORMED, it is none, or one of another version of this program.
        """
        try:
            return cls.model_validate_json(payload)
        except ValidationError as error:
            raise WireError(
                Refusal.MALFORMED, f"no event of a journal that this version knows: {first_fault(error)}"
            ) from error

    def encode(self) -> bytes:
        """Return the event as JSON."""
        return self.model_dump_json(exclude_none=True).encode()


def since_joined(journal: Sequence[JournalEvent]) -> Sequence[JournalEvent]:
    """Return the events since modules joined the robot last; all of them if none did."""
    begins = [place for place, event in enumerate(journal) if event.what == "anew"]
    return journal[begins[-1] :] if begins else journal


def standstill(journal: Sequence[JournalEvent]) -> str:
    """Return a sentence on whether the robot stands still after a session that failed."""
    if not journal or journal[-1].what != "failed":
        return "the robot was not moving"
    last = journal[-1]
    if last.deaf is None:
        return f"{last.text}: see that the robot stands still"
    if last.deaf:
        return f"{', '.join(last.deaf)} did not confirm to have stopped: see that the robot stands still"
    return "the robot is stopped"


def excluded_modules(journal: Sequence[JournalEvent]) -> dict[str, str]:
    """Return the excluded modules with the reason, without those that a resumed session has moved."""
    return {serial: event.text for serial, event in _exclusions(journal).items()}


def exclusion_notes(journal: Sequence[JournalEvent]) -> tuple[str, ...]:
    """Return a sentence on every excluded module."""
    return tuple(_took_no_part(serial, event) for serial, event in _exclusions(journal).items())


def missing_modules(journal: Sequence[JournalEvent], placed: Collection[str]) -> tuple[str, ...]:
    """Return a sentence on every module that is absent or at fault, so that the robot is not known whole.

    A module that is configured to refuse the motion is none of them if it is among the `placed` ones, of
    which the tree is known: that its joint was not moved is said. One of which an older journal does not tell
    why counts as missing.
    """
    well = refused_by_limits(journal) & set(placed)
    return tuple(_took_no_part(s, event) for s, event in _exclusions(journal).items() if s not in well)


def refused_by_limits(journal: Sequence[JournalEvent]) -> set[str]:
    """Return the excluded modules that are well, but configured to refuse the motion."""
    return {serial for serial, event in _exclusions(journal).items() if event.by_limits}


def exclusion_event(t_ns: int, serial: str, why: str, by_limits: bool) -> JournalEvent:
    """Return the journal's note on an excluded module; `by_limits` as of `JournalEvent`."""
    return JournalEvent(t_ns=t_ns, what="note", step=STEP + serial, text=why, by_limits=by_limits)


def _exclusions(journal: Sequence[JournalEvent]) -> dict[str, JournalEvent]:
    exclusions: dict[str, JournalEvent] = {}
    for event in journal:
        if event.what == "note" and event.step.startswith(STEP):
            exclusions[event.step.removeprefix(STEP)] = event
        elif event.what == "motion" and event.purpose in ("windowed_sine", "whole"):
            exclusions.pop(event.serial, None)
    return exclusions


def _took_no_part(serial: str, event: JournalEvent) -> str:
    return f"{serial} took no part: {event.text}"
