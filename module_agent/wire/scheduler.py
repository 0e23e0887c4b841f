"""Something that tells the time and calls a function later; `impaired_transport` delays messages with it."""

from collections.abc import Callable
from typing import Protocol


class Scheduler(Protocol):
    """Calls functions later: a thread in real time, the event loop in virtual time."""

    @property
    def now_s(self) -> float:
        """The time from any origin [s]; it never decreases."""
        ...

    def call_later(self, delay_s: float, call: Callable[[], None]) -> None:
        """Call `call` after `delay_s`; calls due at the same time run in the order of scheduling."""
        ...
