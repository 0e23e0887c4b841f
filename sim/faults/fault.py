"""The faults that a simulated session can meet."""

from typing import Literal, NamedTuple, get_args

Kind = Literal[
    "agent crash",
    "agent freeze",
    "agent thaw",
    "agent reboot",
    "coordinator crash",
    "coordinator restart",
    "partition",
    "corrupted messages",
    "duplicated messages",
    "delayed messages",
]
KINDS: tuple[Kind, ...] = get_args(Kind)
OF_AN_AGENT: tuple[Kind, ...] = ("agent crash", "agent freeze", "agent thaw", "agent reboot")
# After these a run cannot go on: the module is gone for good.
LOSES_MODULE: tuple[Kind, ...] = ("agent crash", "agent freeze")


class Fault(NamedTuple):
    """One fault: it begins at `at_s` of virtual time and lasts `for_s`, where it ends at all [s].

    module: the index of the module whose agent it happens to. byte: which byte of a message is corrupted.
    """

    kind: Kind
    at_s: float
    for_s: float
    module: int = 0
    byte: int = 0

    def __str__(self) -> str:
        where = f" of module {self.module}" if self.kind in OF_AN_AGENT else ""
        return f"{self.kind}{where} at {self.at_s:.3f} s for {self.for_s:.3f} s"
