"""The journal of a session: which step began and ended, with which motions, kept inside the recording.

A crashed run resumes from it, and a replay knows from it which motion served which purpose.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from module_agent.model.catalogue import ImuKind, TorqueKind
from module_agent.wire.messages import MotionRecord

# Step of the notes that say which modules a session goes on without.
STEP = "left_out/"

Purpose = Literal["rest", "constant", "windowed_sine", "repeat", "whole", "dynamic", "held_out", "other"]


class JournalEvent(BaseModel):
    """One line of the journal; `what` says which of the other fields are set.

    `settled`: what follows is asked of the modules with what is known by then, and no later round trip may
    change that. `deaf` are the modules that did not confirm to have stopped, of a session that failed; None
    in an older journal, which names them in its text.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    t_ns: int
    what: Literal["session", "begin", "done", "motion", "note", "settled", "failed", "finished"]
    step: str = ""
    serial: str = ""
    boot: Annotated[int, Field(ge=0)] = 0
    purpose: Purpose = "other"
    motion: MotionRecord | None = None
    text: str = ""
    deaf: tuple[str, ...] | None = None
    robot: str = ""
    imu: ImuKind = "uncalibrated"
    torque: TorqueKind = "uncalibrated"
    wall_time_s: float | None = None

    def encode(self) -> bytes:
        """Return the event as JSON."""
        return self.model_dump_json(exclude_none=True).encode()


def standstill(journal: Sequence[JournalEvent]) -> str:
    """Return in words what is known of the robot after a session that ended before its end."""
    if not journal or journal[-1].what != "failed":
        return "the robot was not moving"
    last = journal[-1]
    if last.deaf is None:
        return f"{last.text}: see that the robot stands still"
    if last.deaf:
        return f"{', '.join(last.deaf)} did not confirm to have stopped: see that the robot stands still"
    return "the robot is stopped"


def excluded_modules(journal: Sequence[JournalEvent]) -> dict[str, str]:
    """Return the modules that a session went on without, and that no later one has moved."""
    found: dict[str, str] = {}
    for event in journal:
        if event.what == "note" and event.step.startswith(STEP):
            found[event.step.removeprefix(STEP)] = event.text
        elif event.what == "motion" and event.purpose in ("windowed_sine", "whole"):
            found.pop(event.serial, None)
    return found


def exclusion_event(t_ns: int, serial: str, why: str) -> JournalEvent:
    """Return the journal's note on a module that is left out."""
    return JournalEvent(t_ns=t_ns, what="note", step=STEP + serial, text=why)
