"""Whether modules that are streamed set-points still execute them."""

from coordinator.live_robot.errors import ModuleLost, RobotStopped
from coordinator.live_robot.module_group import ModuleGroup
from module_agent.wire.feedback_rows import STATE_NAMES

_RELEASED_STATES = ("idle", "expired", "stopped", "fault")


class StreamedStates:
    """Checks the states of the modules of a group by their newest feedback."""

    def __init__(self, group: ModuleGroup):
        self._group = group
        self._held_all = False

    def check(self) -> None:
        """Check that every module executes set-points, once all have begun to.

        Raises:
            RobotStopped, ModuleLost: one does not any more.
        """
        states = {serial: self._state(serial) for serial in self._group.serials}
        self._held_all = self._held_all or set(states.values()) == {"streaming"}
        for serial, state in states.items():
            if self._held_all and state in _RELEASED_STATES:
                status = self._group.module(serial).status
                note = status.note if status is not None and status.state == state else ""
                if state == "stopped":
                    raise RobotStopped(serial, note or "stopped")
                raise ModuleLost(serial, f"its motor is off, {state}" + (f": {note}" if note else ""))

    def _state(self, serial: str) -> str:
        log = self._group.module(serial).rows
        return STATE_NAMES[int(log.rows(log.end_row - 1, log.end_row)["state"][0])]
