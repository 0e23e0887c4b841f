"""Liveliness across a partition, as seen by the endpoint that is cut off and by the others.

A partition shorter than the session's lease is not noticed; changes during it are reported at its end. After
the lease each side's tokens vanish for the other; when the partition ends, the tokens that still exist
reappear.
"""

import threading
from collections.abc import Callable

from module_agent.transport.transport import Liveness, Undeclare


class OwnToken:
    """A token of this endpoint, withdrawn while the endpoint counts as lost."""

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
    """The tokens of others as one watch of this endpoint reports them."""

    def __init__(self, report: Callable[[Liveness], None]):
        self._report = report
        self._present: dict[str, None] = {}
        self._held: list[Liveness] = []
        self._lapsed = False

    def on_change(self, event: Liveness, parted: bool) -> None:
        """Report a change at once, or at the end of the partition."""
        if parted:
            self._held.append(event)
        else:
            self._note(event)
            self._report(event)

    def lapse(self) -> None:
        """Report all tokens as vanished: the partition has lasted longer than the lease."""
        self._lapsed = True
        for key in self._present:
            self._report(Liveness(key, False))

    def heal(self) -> None:
        """Report the changes meanwhile, after a lapse all tokens that exist."""
        held, self._held = self._held, []
        lapsed, self._lapsed = self._lapsed, False
        for event in held:
            self._note(event)
            if not lapsed:
                self._report(event)
        if lapsed:
            for key in self._present:
                self._report(Liveness(key, True))

    def _note(self, event: Liveness) -> None:
        if event.alive:
            self._present[event.key] = None
        else:
            self._present.pop(event.key, None)
