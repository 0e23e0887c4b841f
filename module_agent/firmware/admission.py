"""Admission of commands: the checks run in one fixed order, and the first failure is the reason.

Length, msgpack limits, version, types, finiteness, range (all in `codec`), then serial, boot, lease, sequence
and age. Age is the time since the newest feedback that the sender had received, so late, replayed and thawed
commands are refused without any clock in common.
"""

from module_agent.firmware.lease import Lease
from module_agent.wire.codec import decode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import GainsCommand, LeaseRequest, Message, MotionCommand, Setpoint
from module_agent.wire.refusal import Refusal, WireError
from module_agent.wire.topics import TOPICS

Command = LeaseRequest | MotionCommand | Setpoint | GainsCommand


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
        """Decode what arrived on a leaf and is meant for this module in this boot.

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

    def check_command(self, command: Command, lease: Lease, now_ns: int) -> None:
        """Check lease, sequence and age of a command.

        Raises:
            WireError: with the reason.
        """
        acquiring = isinstance(command, LeaseRequest) and command.action == "acquire"
        if not acquiring:
            lease.check(command.sender, command.token)
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
