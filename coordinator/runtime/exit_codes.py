"""What a program says, and with which code it exits, when a run ends before its end."""

import asyncio
from typing import NamedTuple

from coordinator.identification.identified import IdentificationError
from coordinator.live_robot.errors import ModuleLost, MotionInterrupted, RobotStopped, UnfitLink
from coordinator.live_robot.messenger import NoAnswer, Refused
from coordinator.recording.run_folder import RunFolderError
from coordinator.recording.session_file import SessionFileError
from coordinator.session.session import NoModulesFound
from module_agent.model.catalogue import UnknownModuleType
from module_agent.model.errors import RobotError
from module_agent.transport.transport import TransportError

EXIT_FAILED, EXIT_USAGE, EXIT_LOST, EXIT_INTERRUPTED = 1, 2, 3, 130

_FAILED = (
    NoModulesFound,
    UnfitLink,
    NoAnswer,
    Refused,
    MotionInterrupted,
    RobotStopped,
    IdentificationError,
    SessionFileError,
    UnknownModuleType,
    TransportError,
)


class Failure(NamedTuple):
    """A sentence for the person at the terminal, and the exit code for the program that called."""

    text: str
    exit_code: int


def explain(error: BaseException) -> Failure | None:
    """Return what to say of an error that belongs to the life of a robot; None for a fault of the program."""
    if isinstance(error, asyncio.CancelledError | KeyboardInterrupt):
        return Failure("interrupted", EXIT_INTERRUPTED)
    if isinstance(error, RobotError):
        return Failure(str(error), error.exit_code)
    if isinstance(error, ModuleLost):
        return Failure(str(error), EXIT_LOST)
    if isinstance(error, RunFolderError):
        return Failure(str(error), EXIT_USAGE)
    if isinstance(error, _FAILED):
        return Failure(str(error), EXIT_FAILED)
    return None
