"""Pushes: external wrenches on a simulated robot, as of a hand or an obstacle, for a limited time."""

import re
from collections.abc import Sequence
from typing import Annotated

from pydantic import Field, ValidationError, model_validator

from module_agent.model.errors import UsageError
from module_agent.model.model_faults import faults_of
from module_agent.model.toml_location import parse_toml
from sim.geometry.link_parts import Strict, Xyz

_NOTHING = (0.0, 0.0, 0.0)
_EXAMPLE = "serial=X-00011,force_n=[0,0,-10],from_s=2,for_s=0.5"
# Serials may be given without quotation marks, which a command line would have to protect from the shell.
_UNQUOTED_SERIAL = re.compile(r"(?<![\w-])serial\s*=\s*(?![\s\"'])([^,\s]+)")

Load = Annotated[float, Field(ge=-1e4, le=1e4)]
Second = Annotated[float, Field(ge=0.0, le=1e6)]


class Push(Strict):
    """A wrench on the body that the joint of module `serial` turns, from `from_s` on for `for_s` [s, world].

    `force_n` and `torque_nm` are in world axes (z up) and keep their directions while the robot moves. The
    force acts at `at_m`: a point that moves with the body, in the body's frame of `sim.robot.robot_tree` (the
    output's frame of a module that is mounted forward).
    """

    serial: str
    force_n: tuple[Load, Load, Load] = _NOTHING
    torque_nm: tuple[Load, Load, Load] = _NOTHING
    at_m: Xyz = _NOTHING
    from_s: Second = 0.0
    for_s: Annotated[float, Field(gt=0.0, le=1e6)]

    @model_validator(mode="after")
    def _some_force(self) -> "Push":
        if not any((*self.force_n, *self.torque_nm)):
            raise ValueError("nothing pushes: give force_n, torque_nm or both")
        return self

    @property
    def lasts_ns(self) -> tuple[int, int]:
        """World time from which on the wrench acts, and at which it has ended [ns]."""
        return round(self.from_s * 1e9), round((self.from_s + self.for_s) * 1e9)

    def acts(self, t_ns: int) -> bool:
        """Return whether the wrench acts at a world time [ns]."""
        return self.lasts_ns[0] <= t_ns and not self.is_over(t_ns)

    def is_over(self, t_ns: int) -> bool:
        """Return whether the wrench has ended at a world time [ns]."""
        return t_ns >= self.lasts_ns[1]


def parse_push(text: str) -> Push:
    """Parse a push from `key=value` pairs as in an inline TOML table; every error shows an example.

    Raises:
        UsageError: the text is no push; the message names the key that is wrong.
    """
    quoted = _UNQUOTED_SERIAL.sub(r'serial="\1"', text)
    said = f"{text!r} is no push"
    table = parse_toml(f"push = {{{quoted}}}", said, lambda fault: UsageError(f"{fault}; one is {_EXAMPLE}"))
    try:
        return Push.model_validate(table["push"])
    except ValidationError as error:
        faults = "; ".join(f"{at[0]}: {reason}" if at else reason for at, reason in faults_of(error))
        raise UsageError(f"{said}: {faults}; one is {_EXAMPLE}") from error


def check_pushed(push: Push, serials: Sequence[str]) -> None:
    """Check that a push is on one of the modules.

    Raises:
        UsageError: it is not; the message lists them.
    """
    if push.serial not in serials:
        raise UsageError(
            f"a push on {push.serial!r}, which is no module here; there are {', '.join(serials)}"
        )
