"""Modules excluded from a session: they do not answer, refuse to move, or are in a fault state.

The journal records them with the reason, for the evaluation. A module that is lost during a session ends the
session instead, because the state of its joint is then unknown.
"""

from collections.abc import Callable, Sequence

from coordinator.live_robot.errors import MotionInterrupted
from coordinator.live_robot.messenger import NoAnswer, Refused
from coordinator.live_robot.module_group import ModuleGroup
from module_agent.wire.refusal import Refusal

# A module sends feedback as soon as it runs; one that has sent none for this long is excluded.
FEEDBACK_WAIT_S = 1.0


class ExcludedModules:
    """The excluded modules in `why`, with the reason.

    note: records an exclusion, by serial, reason, and whether the module's own limits are the reason.
    """

    def __init__(self, group: ModuleGroup, note: Callable[[str, str, bool], None]):
        self._group = group
        self._note = note
        self.why: dict[str, str] = {}
        self._well: set[str] = set()

    def movers(self) -> tuple[str, ...]:
        """Return the modules that take part."""
        return tuple(s for s in self._group.serials if s not in self.why)

    @property
    def missing(self) -> tuple[str, ...]:
        """The modules that are absent or at fault, without which the robot is not known whole."""
        return tuple(s for s in sorted(self.why) if s not in self._well)

    async def meet(self, serials: Sequence[str]) -> None:
        """Register more modules; exclude those that are present but do not answer or send no feedback."""
        met = list(self._group.serials)
        for serial in serials:
            try:
                await self._group.meet([serial])
                met.append(serial)
            except NoAnswer as error:
                self._exclude(serial, str(error))
        self._group.serials = tuple(sorted(met))
        await self._group.wait(lambda: not self._group.without_feedback(), FEEDBACK_WAIT_S)
        for serial in self._group.without_feedback():
            self._exclude(serial, f"module {serial} answers, but sends no feedback")
        self._group.serials = tuple(s for s in sorted(met) if s not in self.why)

    def without(self, error: Refused | MotionInterrupted) -> bool:
        """Exclude the module of an error if repeating cannot help; return whether it was excluded.

        A command beyond the limits is refused every time, and a module in protection needs minutes.
        """
        serial, status = error.serial, self._group.module(error.serial).status
        beyond = isinstance(error, Refused) and error.ack.reason == Refusal.LIMIT.value
        protects = status is not None and status.state == "fault"
        if serial in self.why or not (beyond or protects) or len(self.movers()) < 2:
            return False
        self._exclude(serial, str(error), by_limits=beyond)
        return True

    def look_again(self) -> list[str]:
        """Note and return the modules refused by their limits that hold their joint no longer.

        It may have swung.
        """
        gone = []
        for serial in sorted(self._well):
            status = self._group.status_under_lease(serial)
            if status is not None and status.state in ("fault", "expired"):
                reason = f": {status.note}" if status.note else ""
                text = f"it did not hold its joint to the end: its state is {status.state}{reason}"
                self._exclude(serial, text)
                gone.append(serial)
        return gone

    def _exclude(self, serial: str, why: str, by_limits: bool = False) -> None:
        self.why[serial] = why
        self._well = self._well | {serial} if by_limits else self._well - {serial}
        self._note(serial, why, by_limits)
