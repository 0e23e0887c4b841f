"""Short dealings with a robot's modules that move none: the network is checked, or gains are given."""

from collections.abc import Callable, Sequence

from coordinator.live_robot import link_check
from coordinator.live_robot.discovery import IS_IT_THERE, MAX_S, Search, await_modules
from coordinator.live_robot.excluded_modules import FEEDBACK_WAIT_S
from coordinator.live_robot.messenger import Clock, Messenger, Post, Sender, gather_all
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.recording.recording import Recording
from module_agent.model.errors import RobotError
from module_agent.transport.transport import Transport
from module_agent.wire.messages import GainSet

Chosen = Callable[[Sequence[GainSet]], Sequence[GainSet]]


class ShortSession:
    """Dealings with modules of the robot `name`; `post` runs a function on the event loop.

    serials: which modules in which order; all, by serial, if empty. A session has one dealing.
    """

    def __init__(
        self,
        transport: Transport,
        name: str,
        clock: Clock,
        post: Post,
        sender: Sender,
        search: Search,
        serials: Sequence[str] = (),
    ):
        recording = Recording()
        self._messenger = Messenger(transport, name, clock, post, recording.accept)
        self._group = ModuleGroup(self._messenger, recording, clock, sender)
        self._name, self._clock, self._search, self._serials = name, clock, search, serials

    async def load_gains(self, chosen: Chosen) -> tuple[str, ...]:
        """Give the modules what `chosen` makes of their present gains; return their serials.

        Raises:
            RobotError: a module is not there.
            ModuleLost, NoAnswer, Refused: it does not take them; the leases are released.
        """
        self._messenger.start()
        try:
            await self._meet()
            group = self._group
            gains = chosen([group.info(serial).gains for serial in group.serials])
            try:
                await group.acquire_all()
                await gather_all(
                    group.set_gains(serial, own, keep=True)
                    for serial, own in zip(group.serials, gains, strict=True)
                )
            finally:
                await group.release_all()
            return group.serials
        finally:
            self._messenger.close()

    async def check_link(self, seconds: float, note: Callable[[str], None]) -> None:
        """Measure rates and round trips of the modules and note them, as every run does before it moves.

        Raises:
            RobotError: a module is not there.
            UnfitLink: the network to one is not good enough.
        """
        self._messenger.start()
        try:
            await self._meet()
            await link_check.check_link(self._group, self._clock, seconds, note)
        finally:
            self._messenger.close()

    async def _meet(self) -> None:
        serials, search, group = self._serials, self._search, self._group
        start_ns = self._clock()

        def complete(present: frozenset[str], quiet_s: float) -> bool:
            if serials or search.expect:
                return set(serials) <= present and len(present) >= (search.expect or 0)
            is_over = self._clock() - start_ns >= 1e9 * search.min_s
            return is_over and bool(present) and quiet_s >= search.quiet_s

        present = await await_modules(self._messenger, self._clock, complete, MAX_S)
        if not present or not set(serials) <= present or len(present) < (search.expect or 0):
            there = ", ".join(sorted(present)) or "none"
            missing = ", ".join(sorted(set(serials) - present))
            what = (
                f"{missing} of robot {self._name!r} is missing"
                if missing
                else (f"modules of robot {self._name!r} are missing")
            )
            wanted = f", {search.expect} are expected" if search.expect else ""
            question = "" if present else IS_IT_THERE
            raise RobotError(f"{what}{wanted}; there are {there}{question}")
        await group.meet(serials or sorted(present))
        if not await group.wait(lambda: not group.without_feedback(), FEEDBACK_WAIT_S):
            silent = ", ".join(sorted(group.without_feedback()))
            raise RobotError(f"no feedback comes from {silent}, which answers: restart its agent")
