"""The lease of a joint: one sender may command it at a time, under a token that grows with every grant."""

from typing import Any

from module_agent.wire.messages import LeaseRequest
from module_agent.wire.refusal import Refusal, WireError

# A copy is as old as the network can hold it, so a few past senders are enough.
SENDERS_REMEMBERED = 32


class Lease:
    """The lease of one joint; times are the module's own nanoseconds."""

    __slots__ = ("_granted", "_until_ns", "holder", "token")

    def __init__(self) -> None:
        self.holder: str | None = None
        self.token = 0
        self._until_ns = 0
        self._granted: dict[str, tuple[int, int]] = {}

    def state(self, now_ns: int) -> dict[str, Any]:
        """Return the fields of a message that describe the lease."""
        return {"holder": self.holder, "lease_left_ns": self.left_ns(now_ns), "token": self.token}

    def left_ns(self, now_ns: int) -> int:
        """Return the time until the lease lapses, 0 when it has no holder."""
        return max(0, self._until_ns - now_ns) if self.holder is not None else 0

    def lapsed(self, now_ns: int) -> bool:
        """Return whether the lease has a holder and has run out."""
        return self.holder is not None and now_ns >= self._until_ns

    def acquire(self, request: LeaseRequest, now_ns: int) -> bool:
        """Grant the lease under a new token; False for a copy of the request that was granted it.

        A network may deliver a request twice: a copy must neither take the token from the one who was granted
        it nor bring back a lease that was released.

        Raises:
            WireError: HELD, naming the holder and the time left; SEQUENCE for a copy after release.
        """
        granted = self._granted.get(request.sender)
        if granted is not None and request.seq <= granted[0]:
            if granted == (request.seq, self.token) and self.holder == request.sender:
                return False
            raise WireError(
                Refusal.SEQUENCE, f"{request.sender} was granted {granted[0]} before it asked {request.seq}"
            )
        if self.holder not in (None, request.sender):
            left_s = self.left_ns(now_ns) / 1e9
            raise WireError(Refusal.HELD, f"held by {self.holder} for another {left_s:.2f} s")
        self.holder = request.sender
        self.token += 1
        self._until_ns = now_ns + request.duration_ns
        self._granted.pop(request.sender, None)
        self._granted[request.sender] = (request.seq, self.token)
        if len(self._granted) > SENDERS_REMEMBERED:
            del self._granted[next(iter(self._granted))]
        return True

    def extend(self, duration_ns: int, now_ns: int) -> None:
        """Let the present holder's lease run for `duration_ns` from now."""
        self._until_ns = max(self._until_ns, now_ns + duration_ns)

    def release(self) -> None:
        """End the lease; the token stays, so that old commands stay refused."""
        self.holder = None
        self._until_ns = 0

    def check(self, sender: str, token: int) -> None:
        """Check that a command comes from the present holder under the present token.

        Raises:
            WireError: HELD, the lease has another holder; NO_LEASE, it has none or another token.
        """
        if self.holder is None:
            raise WireError(Refusal.NO_LEASE, f"{sender} holds no lease: acquire it first")
        if self.holder != sender:
            raise WireError(Refusal.HELD, f"held by {self.holder}, not by {sender}")
        if token != self.token:
            raise WireError(Refusal.NO_LEASE, f"token {token} is not the lease's token {self.token}")
