"""Requests to the modules to project their own torques: retain the rows of every motion, then sum them up.

Information that a module does not deliver is computed from the recording instead.
"""

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

from coordinator.identification.inertia.agent_information import dynamic_steps, question, rows_to_keep
from coordinator.live_robot.messenger import Clock, Messenger, NoAnswer, gather_all
from coordinator.recording.recording import Recording
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap
from module_agent.wire.information_messages import CollectRequest, Information, InformationRequest
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ack
from module_agent.wire.refusal import Refusal

ATTEMPTS = 10
POLL_S = 0.1
# An agent first loads its numerical libraries, and on a poor network requests rows repeatedly.
PATIENCE_NS = 40_000_000_000


class InformationRequests:
    """The information requests of one session; `note` shows a line of text."""

    def __init__(
        self,
        messenger: Messenger,
        recording: Recording,
        clock: Clock,
        sender: str,
        note: Callable[[str], None],
    ):
        self._messenger = messenger
        self._recording = recording
        self._clock = clock
        self._sender = sender
        self._note = note
        self._collected: set[int] = set()

    async def collect(self, serials: tuple[str, ...]) -> None:
        """Request that all modules retain the rows of the motions since the last call."""
        for event in dynamic_steps(self._recording):
            assert event.motion is not None
            number = event.motion.motion_id
            if number in self._collected:
                continue
            self._collected.add(number)
            try:
                rows = rows_to_keep(self._recording, serials, event)
            except DataError as error:
                self._note(f"the agents do not share motion {event.step}: {error}")
                continue
            await gather_all(
                self._collect_one(
                    CollectRequest(**self._head(serial), sender=self._sender, motion_id=number, rows=rows)
                )
                for serial in serials
            )

    def _head(self, serial: str) -> dict[str, Any]:
        boot = self._recording.modules[serial].boot
        return {"serial": serial, "boot": boot, "seq": self._messenger.next_seq()}

    async def _collect_one(self, request: CollectRequest) -> None:
        for _ in range(ATTEMPTS):
            try:
                answer = await self._messenger.ask(request.serial, Leaf.COLLECT, request)
            except NoAnswer:
                continue
            if isinstance(answer, Ack) and not answer.accepted:
                self._note(f"{request.serial} does not retain motion {request.motion_id}: {answer.detail}")
            return

    async def ask(self, chain: Chain, clocks: Mapping[str, ClockMap]) -> None:
        """Request every module's torque information; the answers are in the recording."""
        try:
            request = question(self._recording, chain, clocks, self._sender)
        except DataError as error:
            self._note(f"no torque information is requested from the agents: {error}")
            return
        await gather_all(self._ask_one(serial, request) for serial in chain.serials)

    async def _ask_one(self, serial: str, request: InformationRequest) -> None:
        end_ns = self._clock() + PATIENCE_NS
        silent, offset = 0, 0
        while silent < ATTEMPTS and self._clock() < end_ns:
            head = {**self._head(serial), "offset": offset}
            try:
                answer = await self._messenger.ask(serial, Leaf.INFORMATION, request.model_copy(update=head))
            except NoAnswer:
                silent += 1
                continue
            silent = 0
            if isinstance(answer, Information):
                if answer.offset != offset:
                    self._note(f"{serial} answers with another part of its information than was asked for")
                    return
                offset += len(answer.part)
                if offset >= answer.total_bytes:
                    return
            elif isinstance(answer, Ack) and answer.reason == Refusal.BUSY.value:
                await asyncio.sleep(POLL_S)
            else:
                why = answer.detail if isinstance(answer, Ack) else type(answer).__name__
                self._note(f"{serial} does not deliver torque information: {why}")
                return
        self._note(f"{serial} has not delivered its torque information in time")
