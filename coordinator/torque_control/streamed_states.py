"""Whether modules that are streamed set-points execute them."""

from coordinator.live_robot.errors import ModuleLost, RobotStopped
from coordinator.live_robot.messenger import Clock
from coordinator.live_robot.module_group import ModuleGroup
from module_agent.wire.feedback_rows import STATE_NAMES

_RELEASED_STATES = ("idle", "expired", "stopped", "fault")
# From the first set-point until feedback must have shown that each module executes them: the newest feedback
# may be from before it was armed.
_BEGIN_NS = 1_000_000_000


class StreamedStates:
    """Checks the states of the modules of a group by their newest feedback; `check` first with the stream."""

    def __init__(self, group: ModuleGroup, clock: Clock):
        self._group, self._clock = group, clock
        self._began: set[str] = set()
        self._since_ns: int | None = None

    def check(self) -> None:
        """Check that every module executes set-points that has begun to, and that each begins in time.

        Raises:
            RobotStopped, ModuleLost: one does not any more, or not at all.
        """
        states = {serial: self._state(serial) for serial in self._group.serials}
        self._began.update(serial for serial, state in states.items() if state == "streaming")
        now_ns = self._clock()
        self._since_ns = now_ns if self._since_ns is None else self._since_ns
        is_late = now_ns - self._since_ns > _BEGIN_NS
        for serial, state in states.items():
            if is_late and serial not in self._began and state not in _RELEASED_STATES:
                raise ModuleLost(serial, f"it executes no set-points: its state is {state}")
            if state in _RELEASED_STATES and (serial in self._began or is_late):
                status = self._group.module(serial).status
                note = status.note if status is not None and status.state == state else ""
                if state == "stopped":
                    raise RobotStopped(serial, note or "stopped")
                raise ModuleLost(serial, f"its motor is off, {state}" + (f": {note}" if note else ""))

    def _state(self, serial: str) -> str:
        log = self._group.module(serial).rows
        return STATE_NAMES[int(log.rows(log.end_row - 1, log.end_row)["state"][0])]
