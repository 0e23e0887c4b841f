"""Errors of the connection to a robot, before and during a session; the messages name the module."""

from collections.abc import Sequence

from module_agent.model.errors import LostError, RobotError


class UnfitLink(RobotError):
    """The network is too slow for a session; nothing has moved. The message gives the measurement."""


class ModuleLost(LostError):
    """The module `serial` was lost during the session."""

    def __init__(self, serial: str, why: str):
        super().__init__(f"module {serial} is lost: {why}")
        self.serial = serial


class ModulesJoined(RobotError):
    """Modules came in the middle of a session that began without them; the message names them."""

    def __init__(self, serials: Sequence[str], present: Sequence[str]):
        names = f"module {serials[0]}" if len(serials) == 1 else f"modules {', '.join(serials)}"
        super().__init__(f"{names} came in the middle of a session of {', '.join(present)}")
        self.serials = tuple(serials)


class RobotStopped(RobotError):
    """A stop command came during the session; the session does not override it."""

    def __init__(self, serial: str, note: str):
        super().__init__(f"module {serial} was {note}")
        self.serial = serial


class MotionForbidden(RobotError):
    """A motion would leave what the robot may use; nothing of it was commanded. The message says where."""


class MotionInterrupted(RobotError):
    """A motion did not complete; it can be tried again after re-arming."""

    def __init__(self, serial: str, outcome: str):
        super().__init__(f"the motion of module {serial} was {outcome}")
        self.serial = serial
