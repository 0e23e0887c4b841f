"""The faults that a simulated session can meet: one table says what each happens to, and how it is named."""

import math
import re
from typing import Literal, NamedTuple

from module_agent.model.errors import UsageError

Part = Literal[
    "agent", "coordinator", "holder", "clock", "encoder", "imu", "torque", "motor", "network", "disk"
]


class Nature(NamedTuple):
    """What a kind of fault happens to, and how.

    ends: a fault that is over after a time; "never" lasts to the end of the session, "either" is drawn.
    words: one of them, in any case and number, is in a sentence that names the fault; one that ends with *
        may begin a longer word. () where the module's serial names it.
    """

    part: Part
    ends: Literal["after", "never", "either"] = "after"
    words: tuple[str, ...] = ()


_NETWORK = (
    "answer*",
    "network",
    "slow",
    "late",
    "lost",
    "heard",
    "expired",
    "lease",
    "malformed",
    "expected, found",
)
_TIME = ("clock", "time", "expired", "lease")
_POSITION = ("position", "velocit*", "encoder", "move*", "turn*")
_IMU = ("gyro*", "accel*", "imu", "specific force", "gravity")
_TORQUE = ("effort*", "torque")

NATURES: dict[str, Nature] = {
    "agent crash": Nature("agent", "never"),
    "agent freeze": Nature("agent", "never"),
    "agent thaw": Nature("agent"),
    "agent reboot": Nature("agent"),
    "twin": Nature("agent", "either", ("twice", "twin", "boot*", "two")),
    "hot plug": Nature("agent", "never"),
    "hot unplug": Nature("agent", "never"),
    "coordinator crash": Nature("coordinator", "never"),
    "coordinator freeze": Nature("coordinator", "after", ("expired", "lease", "answer*", "lost", "slow")),
    "coordinator restart": Nature("coordinator", "never", ("lease", "held", "resume*")),
    "reckless holder": Nature(
        "holder", "after", ("gain", "busy", "move*", "motion", "set-point", "setpoint", "lease")
    ),
    "clock forward": Nature("clock", "never", _TIME),
    "clock back": Nature("clock", "never", _TIME),
    "clock stuck": Nature("clock", "after", _TIME),
    "clock drift": Nature("clock", "either", _TIME),
    "encoder stuck": Nature("encoder", "either", _POSITION),
    "encoder jump": Nature("encoder", "never", _POSITION),
    "encoder NaN": Nature("encoder", "either", _POSITION),
    "IMU dead": Nature("imu", "either", _IMU),
    "IMU stuck": Nature("imu", "either", _IMU),
    "IMU saturated": Nature("imu", "either", _IMU),
    "IMU NaN": Nature("imu", "either", _IMU),
    "IMU swapped": Nature("imu", "never", _IMU),
    "torque stuck": Nature("torque", "either", _TORQUE),
    "torque NaN": Nature("torque", "either", _TORQUE),
    "motor stall": Nature("motor", "either", ("move*", "motion", "stall*", "follow*")),
    "overheating": Nature("motor", "never", ("winding", "temperature")),
    "voltage sag": Nature("motor", "after", ("voltage", "move*", "motion", "follow*")),
    "partition": Nature("network", "after", _NETWORK),
    "corrupted messages": Nature("network", "after", _NETWORK),
    "duplicated messages": Nature("network", "after", _NETWORK),
    "delayed messages": Nature("network", "after", _NETWORK),
    "intruder": Nature("network", "after", (*_NETWORK, "GHOST")),
    "disk full": Nature("disk", "after", ("disk", "space", "file", "writ*")),
}
KINDS = tuple(NATURES)
OF_A_MODULE: tuple[Part, ...] = ("agent", "holder", "clock", "encoder", "imu", "torque", "motor")

_TEXT = re.compile(
    r"(?P<kind>.+?)(?: of module (?P<module>\d{1,3}))? "
    r"(?:at (?P<at>\d{1,4}\.\d{3}) s for (?P<lasts>\d{1,4}\.\d{3}) s|from (?P<since>\d{1,4}\.\d{3}) s on), "
    r"size (?P<size>0\.\d{3})\Z"
)


class Fault(NamedTuple):
    """One fault: it begins at `at_s` of virtual time and lasts `for_s`, infinite where it does not end [s].

    module: the index of the module that it happens to. size: how large it is of its kind, in [0, 1): a jump,
    a drop of the voltage, which byte is corrupted, which packets an intruder sends.
    """

    kind: str
    at_s: float
    for_s: float
    module: int = 0
    size: float = 0.0

    @property
    def nature(self) -> Nature:
        """The row of its kind in the table."""
        return NATURES[self.kind]

    @property
    def begins_s(self) -> float:
        """When it takes effect: a module that is plugged in later is missing until then."""
        return 0.0 if self.kind == "hot plug" else self.at_s

    @property
    def of_a_module(self) -> bool:
        """Whether it happens to one module."""
        return self.nature.part in OF_A_MODULE

    def __str__(self) -> str:
        where = f" of module {self.module}" if self.of_a_module else ""
        when = (
            f"from {self.at_s:.3f} s on"
            if math.isinf(self.for_s)
            else f"at {self.at_s:.3f} s for {self.for_s:.3f} s"
        )
        return f"{self.kind}{where} {when}, size {self.size:.3f}"

    def modules(self, count: int) -> tuple[int, ...]:
        """Return the indices of the modules, of `count`, that it happens to; IMUs of two are exchanged."""
        if not self.of_a_module:
            return ()
        return (self.module, (self.module + 1) % count) if self.kind == "IMU swapped" else (self.module,)

    def is_named(self, text: str, serials: tuple[str, ...]) -> bool:
        """Return whether a sentence names this fault: its words, and its module where it has one."""
        # How many modules are missing, and which are there, names those that are not.
        counts = self.nature.part == "agent" and "expected, found" in text
        sick = [serials[index] for index in self.modules(len(serials))]
        module = counts or any(re.search(rf"(?<!\w){re.escape(serial)}(?!\w)", text) for serial in sick)
        if not self.nature.words:
            return module
        return (module or not self.of_a_module) and any(_has(text, word) for word in self.nature.words)


def _has(text: str, word: str) -> bool:
    """Return whether a text has a word, or its plural; with * at its end, a word that begins with it."""
    end = "" if word.endswith("*") else r"s?\b"
    return re.search(rf"\b{re.escape(word.removesuffix('*'))}{end}", text, re.IGNORECASE) is not None


def fault_of(text: str) -> Fault:
    """Return the fault that `str` of it describes.

    Raises:
        UsageError: another text, no such kind, or one that never ends and does, or the other way about.
    """
    match = _TEXT.match(text)
    if match is None or match["kind"] not in NATURES:
        raise UsageError(
            f"fault {text!r}: expected KIND [of module N] (at S s for S s | from S s on), size X with three "
            f"decimals, such as {Fault('agent thaw', 4.2, 0.5, 1)}; kinds are {', '.join(KINDS)}"
        )
    ends = NATURES[match["kind"]].ends
    if (ends == "after" and match["since"]) or (ends == "never" and match["lasts"]):
        said = "ends: at S s for S s" if ends == "after" else "does not end: from S s on"
        raise UsageError(f"fault {text!r}: {match['kind']} {said}")
    at_s = float(match["at"] or match["since"])
    for_s = float(match["lasts"]) if match["lasts"] else math.inf
    return Fault(match["kind"], at_s, for_s, int(match["module"] or 0), float(match["size"]))
