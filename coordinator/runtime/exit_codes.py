"""Text and exit code of a program whose run fails or is interrupted."""

import asyncio
from typing import NamedTuple

from module_agent.model.errors import EXIT_INTERRUPTED, RobotError


class Failure(NamedTuple):
    """A sentence for the person at the terminal, and the exit code for the program that called."""

    text: str
    exit_code: int


def explain(error: BaseException) -> Failure | None:
    """Return the text and the exit code of a RobotError or an interruption; None for a programming error."""
    if isinstance(error, asyncio.CancelledError | KeyboardInterrupt):
        return Failure("interrupted", EXIT_INTERRUPTED)
    if isinstance(error, RobotError):
        return Failure(str(error), error.exit_code)
    return None
