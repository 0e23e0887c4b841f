"""One sender's commands to a robot's modules, under leases that are renewed until they are given back."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeVar

from coordinator.live_robot.errors import ModuleLost
from coordinator.live_robot.messenger import Clock, Messenger, NoAnswer, Refused, Sender, gather_all
from coordinator.recording.recording import Recording
from module_agent.model.errors import RobotError
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ack, LeaseRequest, Message
from module_agent.wire.proof import secret_for
from module_agent.wire.refusal import Refusal

POLL_S = 0.02
# Four keep-alives within the default lifetime of 250 ms.
KEEP_ALIVE_S = 0.06
# So many modules are asked to answer each keep-alive: a lost lease shows at once, and the answer is a round
# trip for the module's clock. Question and answer cost five times what a publication does, so that of more
# modules these are asked in turn, and all others are told.
ANSWERED = 8
# A renewal that takes longer, or is lost, marks the network as poor for a while.
LATE_NS = 100_000_000
POOR_NS = 10_000_000_000
LEASE_NS = 1_000_000_000
ATTEMPTS = 8
SILENT_NS = 1_000_000_000
# Refusals that the next attempt can resolve: it carries a newer echo and a newer sequence number.
PASSING = (Refusal.STALE.value, Refusal.SEQUENCE.value)

T = TypeVar("T")
M = TypeVar("M", bound=Message)
Make = Callable[[], Message]
"""Returns a command made anew: every attempt carries a newer echo and a newer sequence number."""


class Commander:
    """One sender's commands to modules of a robot.

    boots: of the modules that were met, which their commands name. check: raises when a module is lost, while
    an answer is awaited.
    """

    def __init__(
        self,
        messenger: Messenger,
        recording: Recording,
        clock: Clock,
        sender: Sender,
        check: Callable[[], None],
    ):
        self.boots: dict[str, int] = {}
        self.sender, self._secret = sender
        self._secrets: dict[str, bytes] = {}
        self._messenger = messenger
        self._recording = recording
        self._clock = clock
        self._check = check
        self._tokens: dict[str, int] = {}
        # In order: of many modules some answer in turn.
        self._renewed: dict[str, None] = {}
        self._armed_ns: dict[str, int] = {}
        self._taken_by: dict[str, str] = {}
        self._repeated: dict[str, tuple[Leaf, Make]] = {}
        self._keeper: asyncio.Task[None] | None = None
        self._renewals: set[asyncio.Task[None]] = set()
        self._turn = 0
        self._poor_until_ns = 0

    # ------------------------------------------------------------------ messages

    def request(self, kind: type[M], serial: str, **fields: Any) -> M:
        """Return a message that needs no lease, by default to whatever boot of the module is there."""
        head = {"serial": serial, "boot": 0, "seq": self._messenger.next_seq(), "sender": self.sender}
        return kind.model_validate(head | fields)

    def command(self, kind: type[M], serial: str, **fields: Any) -> M:
        """Return a command under the lease; it echoes the newest module time."""
        head = {
            "boot": self.boots[serial],
            "token": self._tokens.get(serial, 0),
            "echo_ns": self._recording.modules[serial].newest_ns,
        }
        return self.request(kind, serial, **head, **fields)

    def publish(self, serial: str, leaf: Leaf, command: Message) -> None:
        """Send a command that is not acknowledged, with the proof that it is this sender's."""
        self._messenger.publish(serial, leaf, command, self._secret_for(serial))

    async def achieve(self, serial: str, leaf: Leaf, make: Make) -> Ack:
        """Send commands until one is acknowledged."""
        return await self.persist(serial, lambda: self._commanded(serial, leaf, make()))

    async def persist(self, serial: str, attempt: Callable[[], Awaitable[T]]) -> T:
        """Try until answered; a network may lose requests and answers."""
        for left in reversed(range(ATTEMPTS)):
            try:
                return await attempt()
            except NoAnswer:
                self._check()
                if not left:
                    # Of an agent that has died the network says at once that none answers, many times before
                    # its silence shows.
                    await self._watch(SILENT_NS + int(1e9 * POLL_S))
                    raise
            except Refused as refused:
                if refused.ack.reason not in PASSING or not left:
                    raise
                # The echo is renewed by the next feedback.
                await asyncio.sleep(POLL_S)
        raise AssertionError("unreachable")

    async def _watch(self, time_ns: int) -> None:
        end_ns = self._clock() + time_ns
        while self._clock() < end_ns:
            self._check()
            await asyncio.sleep(POLL_S)

    async def _commanded(self, serial: str, leaf: Leaf, command: Message, timeout_s: float = 0.5) -> Ack:
        """Send a command with the proof that it is this sender's, and wait for its acknowledgement."""
        return await self._messenger.command(serial, leaf, command, timeout_s, self._secret_for(serial))

    def _lease(self, serial: str, action: str) -> LeaseRequest:
        # No other program hears an acquisition; renewals are proven like every other command.
        secret = self._secret_for(serial) if action == "acquire" else b""
        return self.command(LeaseRequest, serial, action=action, duration_ns=LEASE_NS, secret=secret)

    def _secret_for(self, serial: str) -> bytes:
        if serial not in self._secrets:
            self._secrets[serial] = secret_for(serial, self._secret)
        return self._secrets[serial]

    # ------------------------------------------------------------------ leases

    @property
    def held(self) -> tuple[str, ...]:
        """The modules whose leases this sender has."""
        return tuple(self._tokens)

    @property
    def is_poor(self) -> bool:
        """Whether renewals were late or lost within the last `POOR_NS`."""
        return self._clock() < self._poor_until_ns

    def armed_ns(self, serial: str) -> int | None:
        """Return the module's time when it was taken; None if it is not held."""
        return self._armed_ns[serial] if serial in self._tokens else None

    def check_lease(self, serial: str) -> None:
        """Check that no other sender has taken a module, and that renewals go on.

        Raises:
            ModuleLost: the message says who holds it.
        """
        if self._keeper is not None and self._keeper.done():
            self._keeper.result()
        if serial in self._taken_by:
            raise ModuleLost(serial, f"its lease was taken: {self._taken_by[serial]}")

    async def acquire(self, serial: str) -> None:
        """Take the lease of a module, which arms it; it is renewed until it is given back.

        Raises:
            Refused: another sender holds it; the message names the holder and the time left.
        """
        self._repeated.pop(serial, None)
        try:
            ack = await self.achieve(serial, Leaf.LEASE, lambda: self._lease(serial, "acquire"))
        except Refused as refused:
            # One that was this sender's must not be stopped as if it still were.
            if refused.ack.reason == Refusal.HELD.value and serial in self._tokens:
                self._taken_by[serial] = refused.ack.detail
            raise
        self._taken_by.pop(serial, None)
        self._tokens[serial], self._armed_ns[serial] = ack.token, ack.t_ns
        self._renewed[serial] = None
        # Its lifetime counts from the echo in the request: on a slow network little of it is left.
        self._send(self._renew(serial))
        # With the first lease: it must not expire while the next module is slow to answer.
        if self._keeper is None:
            self._keeper = asyncio.create_task(self._keep_alive())

    def forget(self, serial: str) -> None:
        """Renew the lease of a module no more, which lapses then."""
        self._tokens.pop(serial, None)
        self._renewed.pop(serial, None)

    def repeat(self, serial: str, leaf: Leaf, make: Make) -> None:
        """Send a command, which a module executes once, again and again while the network is poor.

        It renews the lease too: messages keep their order on one key, and are seldom late on two keys at the
        same time.
        """
        self._repeated[serial] = leaf, make

    def repeat_no_more(self, serial: str) -> None:
        """Send a module's command no more: another one replaces it."""
        self._repeated.pop(serial, None)

    async def _keep_alive(self) -> None:
        """Renew all leases until cancelled; a late answer does not hold up the next renewal."""
        while True:
            await asyncio.sleep(0.5 * KEEP_ALIVE_S)
            if self.is_poor:
                self.renew(by_commands=True)
            await asyncio.sleep(0.5 * KEEP_ALIVE_S)
            self._turn += ANSWERED
            self.renew()

    def renew(self, by_commands: bool = False) -> None:
        """Renew all leases once; `by_commands`: where one is to be repeated, by that."""
        ask = self._repeat_or_renew if by_commands else self._renew
        renewed = list(self._renewed)
        begin = self._turn % len(renewed) if len(renewed) > ANSWERED else 0
        in_turn = renewed[begin:] + renewed[:begin]
        for serial in in_turn[:ANSWERED]:
            self._send(ask(serial))
        for serial in in_turn[ANSWERED:]:
            # One that fails must not end those of the others, which follow for as long as the leases last.
            with contextlib.suppress(RobotError):
                self.publish(serial, Leaf.LEASE, self._lease(serial, "renew"))

    def _send(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.create_task(work)
        self._renewals.add(task)
        task.add_done_callback(self._renewals.discard)

    async def _renew(self, serial: str) -> None:
        sent_ns = self._clock()
        try:
            await self._commanded(serial, Leaf.LEASE, self._lease(serial, "renew"), timeout_s=0.3)
        except NoAnswer:
            pass  # lost; the next one follows, and missing feedback is noticed
        except Refused as refused:
            if refused.ack.reason == Refusal.HELD.value:
                self._taken_by[serial] = refused.ack.detail
        if self._clock() - sent_ns > LATE_NS:
            self._poor_until_ns = self._clock() + POOR_NS

    def _repeat_or_renew(self, serial: str) -> Coroutine[None, None, None]:
        return (self._repeat if serial in self._repeated else self._renew)(serial)

    async def _repeat(self, serial: str) -> None:
        # What replaces it may have been commanded since.
        if (repeated := self._repeated.get(serial)) is None:
            return
        leaf, make = repeated
        # Lost or refused: the next renewal follows.
        with contextlib.suppress(NoAnswer, Refused):
            await self._commanded(serial, leaf, make(), timeout_s=0.3)

    async def release_all(self) -> None:
        """Release all modules; their motors are off then. None is renewed any more, even if one fails."""
        try:
            await gather_all(self._release(serial) for serial in self.held)
        finally:
            self._renewed.clear()
            error = await self._stop_keeping()
        if error is not None:
            raise error

    async def _release(self, serial: str) -> None:
        try:
            await self.achieve(serial, Leaf.LEASE, lambda: self._lease(serial, "release"))
        except Refused as refused:
            # The first answer may have been lost: then there is nothing left to release.
            if refused.ack.reason not in (Refusal.NO_LEASE.value, Refusal.HELD.value):
                raise
        self.forget(serial)

    async def stop_all(self, why: str) -> list[str]:
        """Stop every module that this sender holds; return the serials that did not confirm."""
        # Not the modules whose lease another coordinator has taken.
        held = [serial for serial in self._tokens if serial not in self._taken_by]
        self._tokens.clear()
        self._renewed.clear()
        stops = (self._messenger.stop(serial, self.sender, why) for serial in held)
        try:
            done = await asyncio.gather(*stops, return_exceptions=True)
        finally:
            # Its error, if any, is what ends the session.
            await self._stop_keeping()
        return [s for s, r in zip(held, done, strict=True) if isinstance(r, BaseException)]

    async def _stop_keeping(self) -> Exception | None:
        """End the keep-alives; return the error that they had ended with."""
        keeper, self._keeper = self._keeper, None
        if keeper is None:
            return None
        keeper.cancel()
        (ended,) = await asyncio.gather(keeper, return_exceptions=True)
        return ended if isinstance(ended, Exception) else None
