"""How the hold on a robot is not to be had, or lost in the middle of a session; each names the module."""

from module_agent.model.errors import LostError, RobotError


class UnfitLink(RobotError):
    """The network cannot carry a session; nothing has moved. The message says what was measured."""


class ModuleLost(LostError):
    """A module left in the middle of the session; `serial` says which."""

    def __init__(self, serial: str, why: str):
        super().__init__(f"module {serial} is lost: {why}")
        self.serial = serial


class RobotStopped(RobotError):
    """Somebody said stop in the middle of the session; a program does not overrule that."""

    def __init__(self, serial: str, note: str):
        super().__init__(f"module {serial} was {note}")
        self.serial = serial


class MotionInterrupted(RobotError):
    """A motion ended before its end; it can be tried again after re-arming."""

    def __init__(self, serial: str, outcome: str):
        super().__init__(f"the motion of module {serial} was {outcome}")
        self.serial = serial
