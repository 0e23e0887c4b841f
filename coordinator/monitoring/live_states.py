"""Follow all modules of a robot on its network: hear them, ask them, stop, hold and light them."""

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress

from coordinator.live_robot.messenger import Clock, Messenger, NoAnswer, Sender, gather_all
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.monitoring.module_states import ModuleState, ModuleStates
from module_agent.model.errors import RobotError
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ask, Identify

# Period of the updates, and of the requests to every module, which are round trips for its clock as well.
UPDATE_S, ASK_S = 0.25, 0.5

Report = Callable[[Sequence[ModuleState]], None]
Note = Callable[[str], None]


class LiveStates:
    """Follows modules over one messenger, which is given `states.record` to record with."""

    def __init__(
        self,
        states: ModuleStates,
        messenger: Messenger,
        clock: Clock,
        sender: Sender,
        report: Report,
        note: Note,
    ):
        self._states = states
        self._messenger = messenger
        self._clock = clock
        self._sender = sender
        self._report = report
        self._note = note
        self._described: set[tuple[str, int]] = set()
        self._group: ModuleGroup | None = None
        self._lit: str | None = None
        self._work: set[asyncio.Task[None]] = set()
        self._holding: asyncio.Task[None] | None = None

    @property
    def holds(self) -> bool:
        """Whether this program holds the modules."""
        return self._group is not None

    async def follow(self, until_ns: int | None = None, enough: Callable[[], bool] = lambda: False) -> None:
        """Report all modules every `UPDATE_S` until a time [ns], until it is enough, or until cancelled.

        What is held is released at the end.
        """
        asking = asyncio.create_task(self._ask_all())
        try:
            while (until_ns is None or self._clock() < until_ns) and not enough():
                await asyncio.sleep(UPDATE_S)
                self._report(self._states.at(self._clock(), self._messenger.alive))
        finally:
            asking.cancel()
            await asyncio.gather(asking, *self._work, return_exceptions=True)
            await self._release()
            await self._give_back_led()

    def stop(self) -> None:
        """Stop every module at once; what is held, or is being taken, is released."""
        self._cancel_holding()
        self._do(self._stop())

    def hold(self) -> None:
        """Take the leases, so that every module holds its position; the second time, release them."""
        if self.holds:
            self._cancel_holding()
            self._do(self._release())
        else:
            self._holding = self._do(self._hold())

    def _cancel_holding(self) -> None:
        """End an acquisition that is under way: later than a stop it would arm its module again."""
        if self._holding is not None:
            self._holding.cancel()

    def light(self) -> None:
        """Light the LED of the next module by serial, so that it is found; after the last one none is lit."""
        self._do(self._light_next())

    def _do(self, work: Coroutine[None, None, None]) -> asyncio.Task[None]:
        async def attempt() -> None:
            try:
                await work
            except RobotError as error:
                self._note(str(error))

        task = asyncio.create_task(attempt())
        self._work.add(task)
        task.add_done_callback(self._work.discard)
        return task

    async def _stop(self) -> None:
        serials = sorted(self._messenger.alive)
        try:
            await gather_all(self._messenger.stop(s, self._sender.name, "asked to") for s in serials)
            self._note(f"stopped: {', '.join(serials) or 'no module is there'}")
        finally:
            await self._release()

    async def _hold(self) -> None:
        group = self._group = ModuleGroup(self._messenger, self._states.recording, self._clock, self._sender)
        try:
            await group.meet(sorted(self._messenger.alive))
            await group.acquire_all()
        except RobotError:
            await self._release()
            raise
        self._note(f"held: {', '.join(group.serials)}")

    async def _light_next(self) -> None:
        before = self._lit
        later = [serial for serial in sorted(self._messenger.alive) if before is None or serial > before]
        await self._give_back_led()
        if not later:
            self._note("no LED is lit")
            return
        self._lit = later[0]
        await self._set_led(later[0], on=True)
        self._note(f"the LED of {later[0]} is lit")

    async def _give_back_led(self) -> None:
        lit, self._lit = self._lit, None
        # One that left keeps its LED by itself at most until it boots.
        with suppress(RobotError):
            if lit is not None and lit in self._messenger.alive:
                await self._set_led(lit, on=False)

    async def _set_led(self, serial: str, on: bool) -> None:
        head = {"serial": serial, "boot": 0, "seq": self._messenger.next_seq(), "sender": self._sender.name}
        await self._messenger.command(serial, Leaf.IDENTIFY, Identify.model_validate({**head, "on": on}))

    async def _release(self) -> None:
        group, self._group = self._group, None
        if group is None:
            return
        await group.release_all()
        self._note("released")

    async def _ask_all(self) -> None:
        while True:
            await asyncio.gather(*(self._ask(serial) for serial in sorted(self._messenger.alive)))
            await asyncio.sleep(ASK_S)

    async def _ask(self, serial: str) -> None:
        # One that does not answer is seen by its silence.
        with suppress(NoAnswer):
            module = self._states.recording.modules.get(serial)
            if module is None or module.info is None:
                await self._messenger.ask(serial, Leaf.INFO, self._question(serial))
            await self._messenger.ask(serial, Leaf.STATUS, self._question(serial))

    def _question(self, serial: str) -> Ask:
        return Ask(serial=serial, boot=0, seq=self._messenger.next_seq(), sender=self._sender.name)
