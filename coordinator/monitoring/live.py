"""Monitor a robot that another program moves: subscribe to feedback, query status, hold no lease.

The monitor itself is `monitoring.monitor`; here is its place on a network and on a clock, real or virtual.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from coordinator.live_robot.messenger import Clock, Messenger, NoAnswer
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from coordinator.recording.recording import Entry, ModuleRecord, Recording
from coordinator.synchronisation.round_trips import map_clocks
from module_agent.signals.clock_map import ClockMap
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ask, Message

# Period of the updates, and so the additional latency of a finding.
UPDATE_S = 0.02
ASK_S, REMAP_S = 0.25, 5.0
# Round trips for a clock map: those of the last minute; the first map needs fewer.
MAX_TRIPS, MIN_TRIPS = 240, 6
# How long rows are kept; none that is needed is older than the cubic's and the filter's reach.
RETAINED_S = 8.0
# The newest rows, the time stamps of which tell their rate.
RATED_ROWS = 100

Report = Callable[[MonitorUpdate], None]


def retained_rows(record: ModuleRecord) -> int:
    """Return how many of the newest rows of a module are kept, by the rate of their time stamps."""
    log = record.rows
    t_ns = log.rows(max(log.first_row, log.end_row - RATED_ROWS), log.end_row)["t_ns"].astype(np.int64)
    step_ns = float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0.0
    return round(RETAINED_S * 1e9 / step_ns) if step_ns > 0.0 else log.end_row - log.first_row


class LiveMonitor:
    """Monitoring over one messenger, which is given `record` to record with."""

    def __init__(
        self, monitor: Monitor, clock: Clock, sender: str, report: Report, update_s: float = UPDATE_S
    ):
        self.recording = Recording()
        self._update_s = update_s
        self._monitor = monitor
        self._clock = clock
        self._sender = sender
        self._report = report
        self._serials: Sequence[str] = monitor.reference.chain.serials
        self._clocks: Mapping[str, ClockMap] | None = None
        self._mapped_ns = 0
        self._boots: dict[str, int] = {}
        self._left: tuple[str, ...] = ()

    def record(self, entry: Entry) -> Message | None:
        """Add a received message to the recording."""
        return self.recording.accept(entry)

    async def watch(
        self, messenger: Messenger, until_ns: int | None = None, enough: Callable[[], bool] = lambda: False
    ) -> None:
        """Watch until a time [ns], until it is enough, or until cancelled."""
        asking = asyncio.create_task(self._ask_all(messenger))
        try:
            while (until_ns is None or self._clock() < until_ns) and not enough():
                await asyncio.sleep(self._update_s)
                self._note_presence(messenger)
                self.look()
        finally:
            asking.cancel()
            await asyncio.gather(asking, return_exceptions=True)

    def look(self) -> None:
        """Look at what was recorded since the last look, by clocks that are mapped anew every `REMAP_S`."""
        if self._clocks is None or self._clock() - self._mapped_ns > REMAP_S * 1e9:
            self._map_clocks()
            self._mapped_ns = self._clock()
        if self._clocks is not None:
            update = self._monitor.advance(self.recording, self._clocks)
            if any(update):
                self._report(update)
        self._forget()

    def _forget(self) -> None:
        """Forget what was looked at, and what waits for modules that are not there."""
        for record in self.recording.modules.values():
            record.forget(retained_rows(record), MAX_TRIPS)
        for found in self.recording.estimates.values():
            found.clear()

    async def _ask_all(self, messenger: Messenger) -> None:
        while True:
            # At once: two modules that are asked at the same moment tell their clocks apart.
            asks = [self._ask(messenger, serial) for serial in self._serials if serial in messenger.alive]
            await asyncio.gather(*asks)
            await asyncio.sleep(ASK_S if self._clocks is not None else 0.2 * ASK_S)

    async def _ask(self, messenger: Messenger, serial: str) -> None:
        ask = Ask(serial=serial, boot=0, seq=messenger.next_seq(), sender=self._sender)
        try:
            await messenger.ask(serial, Leaf.STATUS, ask)
        except NoAnswer:
            return  # one of many; who is gone is noticed by its token and its silence

    def _map_clocks(self) -> None:
        records = {s: self.recording.modules[s] for s in self._serials if s in self.recording.modules}
        trips = {serial: record.round_trips for serial, record in records.items()}
        if len(trips) < len(self._serials) or any(len(own) < MIN_TRIPS for own in trips.values()):
            return
        boots = {serial: record.boot for serial, record in records.items()}
        self._note([f"module {s} has booted anew" for s, b in boots.items() if self._boots.get(s, b) != b])
        self._boots = boots
        self._clocks = map_clocks(trips)

    def _note_presence(self, messenger: Messenger) -> None:
        # Only of those that were there: at the beginning all are on their way.
        left = tuple(s for s in self._serials if s in self.recording.modules and s not in messenger.alive)
        before, self._left = self._left, left
        notes = [f"module {s} has left the network" for s in left if s not in before]
        self._note([*notes, *(f"module {s} is back" for s in before if s not in left)])

    def _note(self, notes: Sequence[str]) -> None:
        if notes:
            self._report(MonitorUpdate((), (), tuple(notes)))
