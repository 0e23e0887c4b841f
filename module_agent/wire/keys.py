"""Every key expression of the system; no key string is written elsewhere.

Keys are `x5/{robot}/{serial}/{leaf}`. A serial and a robot name are one key chunk each.
"""

import re
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

from module_agent.model.errors import UsageError
from module_agent.wire.refusal import Refusal, WireError

ROOT = "x5"
_CHUNK = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}\Z")


class Leaf(StrEnum):
    """The last chunk of a key; each carries one message type (see `messages`)."""

    ALIVE = "alive"
    INFO = "info"
    FEEDBACK = "feedback"
    HISTORY = "history"
    STATUS = "status"
    ESTIMATE = "estimate"
    MOTION = "motion"
    SETPOINT = "setpoint"
    LEASE = "lease"
    STOP = "stop"
    GAINS = "gains"
    IDENTIFY = "identify"
    COLLECT = "collect"
    INFORMATION = "information"


class KeyParts(NamedTuple):
    """A key taken apart."""

    robot: str
    serial: str
    leaf: Leaf


def check_chunk(what: str, name: str) -> str:
    """Return `name` if it can stand as one chunk of a key.

    Raises:
        UsageError: otherwise, saying what would be right.
    """
    if not _CHUNK.match(name):
        raise UsageError(
            f"{what} {name!r} cannot be part of a key: use 1-64 letters, digits, '_', '-' or '.', "
            "beginning with a letter or digit"
        )
    return name


def key(robot: str, serial: str, leaf: Leaf) -> str:
    """Return the key of one module's leaf."""
    return f"{ROOT}/{check_chunk('robot', robot)}/{check_chunk('serial', serial)}/{leaf.value}"


def every(robot: str, leaf: Leaf) -> str:
    """Return the key expression that matches this leaf of every module of the robot."""
    return f"{ROOT}/{check_chunk('robot', robot)}/*/{leaf.value}"


@lru_cache(maxsize=4096)
def parse(text: str) -> KeyParts:
    """Take a key apart.

    Raises:
        WireError: MALFORMED, not a key of this system.
    """
    chunks = text.split("/")
    named = len(chunks) == 4 and all(map(_CHUNK.match, chunks[1:3]))
    if not named or chunks[0] != ROOT or chunks[3] not in Leaf._value2member_map_:
        detail = f"{text[:200]!r} is not a key of the form {ROOT}/robot/serial/leaf"
        raise WireError(Refusal.MALFORMED, detail)
    return KeyParts(chunks[1], chunks[2], Leaf(chunks[3]))
