"""What the watch found: of which kind, where, since when, how large and how sure."""

from typing import Literal

from pydantic import BaseModel, ConfigDict

Kind = Literal["collision", "payload", "friction", "wear", "unexplained"]
KINDS: tuple[Kind, ...] = ("collision", "payload", "friction", "wear", "unexplained")
# By what each kind's size is measured.
UNITS: dict[Kind, str] = {
    "collision": "Nm",
    "payload": "kg",
    "friction": "%",
    "wear": "mm",
    "unexplained": "Nm",
}


class Finding(BaseModel):
    """One thing that is other than it was.

    serial: the module: of a collision, the last joint that felt it, so that it was on what this turns, or
    beyond; of a payload, whose joint turns the body that carries it; of friction, whose drive; of wear, whose
    link to its parent. since_ns, found_ns, said_ns, until_ns: session time of its beginning, of the first and
    of the latest word on it, and of its end, None as long as it lasts.
    size, sigma: in `unit`, one standard deviation. gain: by how much it makes the misfit smaller, in
    variances of the noise, above the `level` that chance exceeds as seldom as asked for; of a collision, how
    many times its level the torque was.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Kind
    serial: str
    since_ns: int
    found_ns: int
    said_ns: int
    until_ns: int | None
    size: float
    sigma: float
    unit: str
    gain: float
    level: float
    words: str

    @property
    def key(self) -> tuple[str, str | int]:
        """What makes it the same finding as an earlier one: a later word on it replaces the earlier."""
        match self.kind:
            case "collision":
                return self.kind, self.since_ns
            case "friction":
                return self.kind, self.serial
            case "wear":
                return "structure", 0
            case _:
                return "load", 0
