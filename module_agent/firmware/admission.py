"""Admission of commands: the checks run in one fixed order, and the first failure is the reason.

Length, msgpack limits, version, types, finiteness, range (all in `codec`), then serial, boot, lease, sequence
and age; with the lease the proof of its holder, if that has given a secret. Age is the time since the newest
feedback that the sender had received, so late, replayed and thawed commands are refused without any clock in
common.
"""

import hmac
from typing import Any

from module_agent.wire.codec import decode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import GainsCommand, LeaseRequest, Message, MotionCommand, Setpoint
from module_agent.wire.proof import is_proven
from module_agent.wire.refusal import Refusal, WireError
from module_agent.wire.topics import TOPICS

Command = LeaseRequest | MotionCommand | Setpoint | GainsCommand


# A copy is as old as the network can hold it, so a few past senders are enough.
SENDERS_REMEMBERED = 32
NEVER_NS = 2**63 - 1


class Lease:
    """The lease of one joint: one sender at a time, under a token that grows with every grant.

    Times are the module's own nanoseconds.
    """

    __slots__ = ("_granted", "_secret", "_until_ns", "holder", "token")

    def __init__(self) -> None:
        self.holder: str | None = None
        self.token = 0
        self._secret = b""
        self._until_ns = 0
        self._granted: dict[str, tuple[int, int]] = {}

    def state(self, now_ns: int) -> dict[str, Any]:
        """Return the fields of a message that describe the lease."""
        return {"holder": self.holder, "lease_left_ns": self.left_ns(now_ns), "token": self.token}

    def left_ns(self, now_ns: int) -> int:
        """Return the time until the lease lapses, 0 when it has no holder."""
        return max(0, self._until_ns - now_ns) if self.holder is not None else 0

    @property
    def until_ns(self) -> int:
        """When it lapses; never without a holder."""
        return NEVER_NS if self.holder is None else self._until_ns

    def lapsed(self, now_ns: int) -> bool:
        """Return whether the lease has a holder and has run out."""
        return self.holder is not None and now_ns >= self._until_ns

    def acquire(self, request: LeaseRequest, now_ns: int) -> bool:
        """Grant the lease under a new token; False for a copy of the request that was granted it.

        A network may deliver a request twice: a copy must neither take the token from the one who was granted
        it nor bring back a lease that was released.

        Raises:
            WireError: HELD, naming the holder and the time left; UNPROVEN, in the holder's name without its
                secret; SEQUENCE for a copy after release.
        """
        if self.holder == request.sender and not hmac.compare_digest(self._secret, request.secret):
            raise WireError(
                Refusal.UNPROVEN, f"{request.sender} holds the lease, and acquired it with another secret"
            )
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
        self.holder, self._secret = request.sender, request.secret
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
        self.holder, self._secret = None, b""

    def check(self, sender: str, token: int, payload: bytes) -> None:
        """Check that a command, `payload` on the wire, comes from the present holder under the present token.

        Raises:
            WireError: HELD, the lease has another holder; NO_LEASE, it has none or another token; UNPROVEN,
                the command does not end with the proof of the holder's secret.
        """
        if self.holder is None:
            raise WireError(Refusal.NO_LEASE, f"{sender} holds no lease: acquire it first")
        if self.holder != sender:
            raise WireError(Refusal.HELD, f"held by {self.holder}, not by {sender}")
        if token != self.token:
            raise WireError(Refusal.NO_LEASE, f"token {token} is not the lease's token {self.token}")
        if self._secret and not is_proven(payload, self._secret):
            raise WireError(
                Refusal.UNPROVEN, f"it does not prove that it is from {sender}, which holds the lease"
            )


class Admission:
    """Decodes and checks the messages to one module, and counts refusals by reason."""

    def __init__(self, serial: str, boot: int, lifetime_ns: int):
        self._serial = serial
        self._boot = boot
        self._lifetime_ns = lifetime_ns
        self._newest: dict[tuple[int, str], int] = {}
        self.refusals: dict[str, int] = {}

    def count(self, reason: Refusal) -> None:
        """Count one refusal."""
        self.refusals[reason.value] = self.refusals.get(reason.value, 0) + 1

    def read(self, leaf: Leaf, payload: bytes) -> Message:
        """Decode what arrived on a leaf and is meant for this module in this boot; from any thread.

        Raises:
            WireError: with the reason.
        """
        topic = TOPICS[leaf]
        if topic.to_module is None:
            raise WireError(Refusal.MALFORMED, f"{leaf.value} takes no message")
        message = decode(topic.to_module, payload, topic.max_bytes_to_module)
        if message.serial != self._serial:
            raise WireError(Refusal.WRONG_SERIAL, f"for {message.serial}, this is {self._serial}")
        if message.boot != self._boot and not (topic.any_boot and message.boot == 0):
            raise WireError(
                Refusal.WRONG_BOOT,
                f"for boot {message.boot:016x} of {self._serial}, which has booted anew as {self._boot:016x}",
            )
        return message

    def check_command(self, command: Command, payload: bytes, lease: Lease, now_ns: int) -> None:
        """Check lease, proof, sequence and age of a command that came as `payload`.

        Raises:
            WireError: with the reason.
        """
        if not (isinstance(command, LeaseRequest) and command.action == "acquire"):
            lease.check(command.sender, command.token, payload)
            self._check_sequence(command)
        self._check_age(command.echo_ns, now_ns)

    def _check_sequence(self, command: Command) -> None:
        # Each kind of command has its own order: a keep-alive that overtakes a motion must not refuse it.
        lane = (command.token, type(command).__name__)
        newest = self._newest.get(lane, -1)
        if command.seq <= newest:
            raise WireError(Refusal.SEQUENCE, f"sequence {command.seq} comes after {newest}")
        self._newest = {k: v for k, v in self._newest.items() if k[0] == command.token}
        self._newest[lane] = command.seq

    def _check_age(self, echo_ns: int, now_ns: int) -> None:
        age_ns = now_ns - echo_ns
        if age_ns > self._lifetime_ns:
            raise WireError(
                Refusal.STALE,
                f"its sender had last heard of this module {age_ns / 1e6:.0f} ms ago, "
                f"at most {self._lifetime_ns / 1e6:.0f} ms are accepted",
            )
        # A time that this module has not reached yet comes from no feedback of this boot.
        if age_ns < 0:
            raise WireError(Refusal.STALE, f"echoes a module time {-age_ns / 1e6:.0f} ms in the future")
