"""The journal of a session: which step began and ended, with which motions, kept inside the recording.

A crashed run resumes from it, and a replay knows from it which motion served which purpose.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from coordinator.dynamics.torque_scale import TorqueKind
from coordinator.kinematics.imu_intrinsics import ImuKind
from module_agent.wire.messages import MotionRecord

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
