"""Modules that a session goes on without: they do not answer, refuse to move, or protect themselves.

What they are is kept in the journal, so that whoever evaluates the recording knows. A module that is lost in
the middle of a session is another matter: nobody knows what its joint does then, and the session ends.
"""

from collections.abc import Callable, Sequence

from coordinator.live_robot.errors import MotionInterrupted
from coordinator.live_robot.messenger import NoAnswer, Refused
from coordinator.live_robot.module_group import ModuleGroup
from module_agent.wire.refusal import Refusal

# Feedback begins with the module; whoever has sent none for this long sends none.
FEEDBACK_WAIT_S = 1.0


class ExcludedModules:
    """The modules that a session goes on without, with the reason. `note` keeps and shows a journal event."""

    def __init__(self, group: ModuleGroup, note: Callable[[str, str], None]):
        self._group = group
        self._note = note
        self.why: dict[str, str] = {}

    def movers(self) -> tuple[str, ...]:
        """Return the modules that take part."""
        return tuple(s for s in self._group.serials if s not in self.why)

    async def meet(self, serials: Sequence[str]) -> None:
        """Meet all modules, but for those that announce themselves and do not answer, or send no feedback."""
        met = []
        for serial in serials:
            try:
                await self._group.meet([serial])
                met.append(serial)
            except NoAnswer as error:
                self._leave(serial, str(error))
        self._group.serials = tuple(met)
        await self._group.wait(lambda: not self._mute(), FEEDBACK_WAIT_S)
        mute = self._mute()
        self._group.serials = tuple(s for s in met if s not in mute)
        for serial in mute:
            self._leave(serial, f"module {serial} answers, but sends no feedback")

    def _mute(self) -> list[str]:
        return [s for s in self._group.serials if self._group.module(s).feedback_ns is None]

    def without(self, error: Refused | MotionInterrupted) -> bool:
        """Leave the module of an error out if it will not move, whatever is tried; False if it might.

        A command beyond its limits is refused for good, and a module that protects itself needs minutes.
        """
        serial, status = error.serial, self._group.module(error.serial).status
        beyond = isinstance(error, Refused) and error.ack.reason == Refusal.LIMIT.value
        protects = status is not None and status.state == "fault"
        if serial in self.why or not (beyond or protects) or len(self.movers()) < 2:
            return False
        self._leave(serial, str(error))
        return True

    def _leave(self, serial: str, why: str) -> None:
        self.why[serial] = why
        self._note(serial, why)
