"""Liveliness across a partition: what an endpoint that is cut off sees, and what the others see of it.

As with a session whose peers fall silent: a partition shorter than the session's lease is not seen at all,
and what happened meanwhile is told at its end. After the lease either side takes the other for gone; when the
partition is over, who is still there comes back.
"""

import threading
from collections.abc import Callable

from module_agent.transport.transport import Liveness, Undeclare


class OwnToken:
    """A token of this endpoint, withdrawn while the endpoint is taken for gone."""

    def __init__(self, declare: Callable[[], Undeclare], forget: Callable[["OwnToken"], None]):
        self._declare: Callable[[], Undeclare] | None = declare
        self._forget = forget
        self._held: Undeclare | None = None
        self._lock = threading.Lock()

    def show(self) -> None:
        """Declare the token, unless it is declared or has been undeclared for good."""
        with self._lock:
            if self._declare is not None and self._held is None:
                self._held = self._declare()

    def hide(self) -> None:
        """Withdraw the token until it is shown again."""
        with self._lock:
            held, self._held = self._held, None
        if held is not None:
            held.undeclare()

    def undeclare(self) -> None:
        """End the token. May be called twice."""
        with self._lock:
            self._declare = None
        self._forget(self)
        self.hide()


class WatchedTokens:
    """The tokens of others as one watch of this endpoint sees them."""

    def __init__(self, tell: Callable[[Liveness], None]):
        self._tell = tell
        self._told: dict[str, None] = {}
        self._held: list[Liveness] = []
        self._gone = False

    def hear(self, event: Liveness, parted: bool) -> None:
        """Take in a change; it is told at once, or when the partition is over."""
        if parted:
            self._held.append(event)
        else:
            self._tell_of(event)

    def lapse(self) -> None:
        """Take everybody for gone: the partition has lasted longer than the lease."""
        self._gone = True
        for key in self._told:
            self._tell(Liveness(key, False))

    def heal(self) -> None:
        """Tell what has changed meanwhile; after a lapse, who is there."""
        held, self._held = self._held, []
        gone, self._gone = self._gone, False
        if not gone:
            for event in held:
                self._tell_of(event)
            return
        for event in held:
            self._note(event)
        for key in self._told:
            self._tell(Liveness(key, True))

    def _tell_of(self, event: Liveness) -> None:
        self._note(event)
        self._tell(event)

    def _note(self, event: Liveness) -> None:
        if event.alive:
            self._told[event.key] = None
        else:
            self._told.pop(event.key, None)
