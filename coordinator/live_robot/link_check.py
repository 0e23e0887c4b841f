"""Check of the network to a robot before anything moves: feedback rates and round trips of all modules."""

import asyncio
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from coordinator.live_robot.errors import UnfitLink
from coordinator.live_robot.messenger import Clock, gather_all
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.recording.recording import ModuleRecord

# This share of the round trips must take at most half a command's lifetime; the keep-alives bridge the rest.
FIT_FRACTION = 0.8
# Measurements at most, each as long as the plan says: a poor network may be worst during one of them.
MAX_MEASUREMENTS = 3
BETWEEN_S = 0.03


async def check_link(group: ModuleGroup, clock: Clock, seconds: float, note: Callable[[str], None]) -> None:
    """Measure rates and round trips of all modules and note them.

    Raises:
        UnfitLink: after `MAX_MEASUREMENTS`, feedback is lost, or commands would be too old on arrival.
    """
    # Of a session that is resumed there is what came before.
    before = {serial: _Received.of(group.module(serial)) for serial in group.serials}
    start_ns = clock()
    for number in range(1, MAX_MEASUREMENTS + 1):
        end_ns = start_ns + number * int(seconds * 1e9)
        await gather_all(_ask_until(group, serial, clock, end_ns) for serial in group.serials)
        span_s = (clock() - start_ns) / 1e9
        new = {s: before[s].since(group.module(s)) for s in group.serials}
        rates = {s: new[s].rows / span_s for s in group.serials}
        faults = [fault for s in group.serials if (fault := _fault(group, s, rates[s], new[s].trips_ms))]
        if not faults:
            break
    for serial in group.serials:
        if trips_ms := new[serial].trips_ms:
            median, most = (float(np.percentile(trips_ms, share)) for share in (50, 95))
            note(
                f"{serial} ({group.info(serial).module_type}): {rates[serial]:.0f} rows/s, round trip "
                f"{median:.2f} ms, 95 % {most:.2f} ms"
            )
    if faults:
        raise UnfitLink(faults[0])


async def _ask_until(group: ModuleGroup, serial: str, clock: Clock, end_ns: int) -> None:
    while clock() < end_ns:
        await group.ask_status(serial)
        await asyncio.sleep(BETWEEN_S)


class _Received(NamedTuple):
    """What has come of a boot of a module: how many rows, and its round trips [ms]."""

    boot: int
    rows: int
    trips_ms: list[float]

    @classmethod
    def of(cls, module: ModuleRecord) -> "_Received":
        trips_ms = [(trip.received_ns - trip.sent_ns) / 1e6 for trip in module.round_trips]
        return cls(module.boot, module.rows.count, trips_ms)

    def since(self, module: ModuleRecord) -> "_Received":
        """Return what has come since then; all of it, of another boot."""
        now = _Received.of(module)
        if now.boot != self.boot:
            return now
        return _Received(now.boot, now.rows - self.rows, now.trips_ms[len(self.trips_ms) :])


def _fault(group: ModuleGroup, serial: str, rate: float, trips_ms: list[float]) -> str:
    info = group.info(serial)
    if not trips_ms:
        return (
            f"unfit: module {serial} booted anew while the link was checked, or a second module has its "
            "serial: no answer is of the boot that was heard of last; look for a second agent, start again"
        )
    if rate < 0.5 * info.feedback_rate_hz:
        return (
            f"unfit: module {serial} delivers {rate:.0f} rows/s of {info.feedback_rate_hz:.0f}; "
            "check the network and the load of its machine"
        )
    slow_ms, life_ms = np.percentile(trips_ms, 100.0 * FIT_FRACTION), info.lifetime_ns / 1e6
    if slow_ms > 0.5 * life_ms:
        return (
            f"unfit: of the round trips to module {serial} one in five takes more than {slow_ms:.0f} ms, "
            f"commands live {life_ms:.0f} ms; check the network"
        )
    return ""
