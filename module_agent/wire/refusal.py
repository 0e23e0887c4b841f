"""Why a message was refused; the order is the order in which a module checks."""

from enum import StrEnum

from module_agent.model.errors import RobotError


class Refusal(StrEnum):
    """A reason that a module counts, publishes in its status and names in its answer."""

    TOO_LONG = "too_long"
    MALFORMED = "malformed"
    VERSION = "version"
    TYPES = "types"
    NOT_FINITE = "not_finite"
    RANGE = "range"
    WRONG_SERIAL = "wrong_serial"
    WRONG_BOOT = "wrong_boot"
    HELD = "held"
    NO_LEASE = "no_lease"
    UNPROVEN = "unproven"
    SEQUENCE = "sequence"
    STALE = "stale"
    NOT_ARMED = "not_armed"
    BUSY = "busy"
    LIMIT = "limit"
    GONE = "gone"
    UNFIT = "unfit"


class WireError(RobotError):
    """Bytes that are not a valid message; `reason` is what a module counts."""

    def __init__(self, reason: Refusal, detail: str):
        super().__init__(f"{reason.value}: {detail}")
        self.reason = reason
        self.detail = detail
