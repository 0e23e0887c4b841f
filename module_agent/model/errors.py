"""Errors of the domain: their text is for the user, their exit code for the program that called.

A RobotError is raised for what may go wrong with a correct program. Everything else (ValueError, LinAlgError)
is a programming error and ends it with a traceback; a RobotError is therefore never a ValueError.
"""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

EXIT_FAILED, EXIT_USAGE, EXIT_LOST, EXIT_FINDING, EXIT_SUSPECT, EXIT_INTERRUPTED = 1, 2, 3, 4, 5, 130
# What the codes of all programs mean; 128 + n is the end by signal n.
EXIT_CODES = {
    0: "done",
    EXIT_FAILED: "failed: a line that begins with the program's name says why, and what is kept",
    EXIT_USAGE: "wrong usage: an option, a path or a file cannot be used; nothing was begun",
    EXIT_LOST: "a module was lost; it is named",
    EXIT_FINDING: "done, and found something: a change, a collision, a missed bar",
    EXIT_SUSPECT: "done, but a module is missing, sensors contradict each other, the recording is damaged, "
    "or an earlier run that was used ended so",
    EXIT_INTERRUPTED: "interrupted by Ctrl-C; the robot is stopped",
}


class RobotError(Exception):
    """The robot, its data or its network keep an operation from succeeding; the text says what to do."""

    exit_code: int = EXIT_FAILED


class UsageError(RobotError):
    """An option, a path or a file that the user gave cannot be used."""

    exit_code = EXIT_USAGE


class LostError(RobotError):
    """A module or its connection was lost during the operation."""

    exit_code = EXIT_LOST


class DataError(RobotError):
    """The measurements do not answer what is asked: they are too few, too weak, contradictory or damaged."""


# What the system says of paths that no program could use.
_OF_PATHS = {
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EEXIST,
    errno.EACCES,
    errno.EPERM,
    errno.ENAMETOOLONG,
    errno.ELOOP,
}


class FileError(RobotError):
    """A file or folder cannot be read or written; the message names it, and has the system's reason.

    Where its path cannot be used, that is wrong usage.
    """

    def __init__(self, error: OSError):
        super().__init__(f"cannot use {error.filename}: {error.strerror}")
        self.exit_code = EXIT_USAGE if error.errno in _OF_PATHS else EXIT_FAILED


@contextmanager
def named_files() -> Iterator[None]:
    """Raise errors of the system about a named file as `FileError`, for the block.

    Raises:
        FileError: a file or folder in the block cannot be used.
    """
    try:
        yield
    except OSError as error:
        if error.filename is None:
            raise
        raise FileError(error) from error
