"""Modules that a session goes on without: they do not answer, refuse to move, or protect themselves.

What they are is kept in the journal, so that whoever evaluates the recording knows. A module that is lost in
the middle of a session is another matter: nobody knows what its joint does then, and the session ends.
"""

from collections.abc import Callable, Sequence

from coordinator.journal import JournalEvent
from coordinator.link_errors import MotionInterrupted
from coordinator.radio import NoAnswer, Refused
from coordinator.recording import Recording
from coordinator.robot_link import RobotLink
from module_agent.wire.refusal import Refusal

# Step of the journal's notes.
STEP = "left_out/"
# Feedback begins with the module; whoever has sent none for this long sends none.
FEEDBACK_WAIT_S = 1.0


class LeftOut:
    """The modules that a session goes on without, with the reason. `note` keeps and shows a journal event."""

    def __init__(self, link: RobotLink, note: Callable[[str, str], None]):
        self._link = link
        self._note = note
        self.why: dict[str, str] = {}

    def movers(self) -> tuple[str, ...]:
        """Return the modules that take part."""
        return tuple(s for s in self._link.serials if s not in self.why)

    async def meet(self, serials: Sequence[str]) -> None:
        """Meet all modules, but for those that announce themselves and do not answer, or send no feedback."""
        met = []
        for serial in serials:
            try:
                await self._link.meet([serial])
                met.append(serial)
            except NoAnswer as error:
                self._leave(serial, str(error))
        self._link.serials = tuple(met)
        await self._link.wait(lambda: not self._mute(), FEEDBACK_WAIT_S)
        mute = self._mute()
        self._link.serials = tuple(s for s in met if s not in mute)
        for serial in mute:
            self._leave(serial, f"module {serial} answers, but sends no feedback")

    def _mute(self) -> list[str]:
        return [s for s in self._link.serials if not self._link.module(s).arrivals]

    def without(self, error: Refused | MotionInterrupted) -> bool:
        """Leave the module of an error out if it will not move, whatever is tried; False if it might.

        A command beyond its limits is refused for good, and a module that protects itself needs minutes.
        """
        serial, status = error.serial, self._link.module(error.serial).status
        beyond = isinstance(error, Refused) and error.ack.reason == Refusal.LIMIT.value
        protects = status is not None and status.state == "fault"
        if serial in self.why or not (beyond or protects) or len(self.movers()) < 2:
            return False
        self._leave(serial, str(error))
        return True

    def _leave(self, serial: str, why: str) -> None:
        self.why[serial] = why
        self._note(serial, why)


def left_out(recording: Recording) -> dict[str, str]:
    """Return the modules that a session went on without, and that no later one has moved."""
    found: dict[str, str] = {}
    for event in recording.journal:
        if event.what == "note" and event.step.startswith(STEP):
            found[event.step.removeprefix(STEP)] = event.text
        elif event.what == "motion" and event.purpose in ("windowed_sine", "whole"):
            found.pop(event.serial, None)
    return found


def left_out_event(t_ns: int, serial: str, why: str) -> JournalEvent:
    """Return the journal's note on a module that is left out."""
    return JournalEvent(t_ns=t_ns, what="note", step=STEP + serial, text=why)
