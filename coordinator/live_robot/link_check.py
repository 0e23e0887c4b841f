"""Check of the network to a robot before anything moves: feedback rates and round trips of all modules."""

import asyncio
from collections.abc import Callable

import numpy as np

from coordinator.live_robot.errors import UnfitLink
from coordinator.live_robot.messenger import Clock, gather_all
from coordinator.live_robot.module_group import ModuleGroup

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
    before = {serial: group.module(serial).rows.end_row for serial in group.serials}
    start_ns = clock()
    for number in range(1, MAX_MEASUREMENTS + 1):
        end_ns = start_ns + number * int(seconds * 1e9)
        await gather_all(_ask_until(group, serial, clock, end_ns) for serial in group.serials)
        span_s = (clock() - start_ns) / 1e9
        rates = {s: (group.module(s).rows.end_row - before[s]) / span_s for s in group.serials}
        faults = [fault for s in group.serials if (fault := _fault(group, s, rates[s]))]
        if not faults:
            break
    for serial in group.serials:
        if trips_ms := _trips_ms(group, serial):
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


def _trips_ms(group: ModuleGroup, serial: str) -> list[float]:
    return [(trip.received_ns - trip.sent_ns) / 1e6 for trip in group.module(serial).round_trips]


def _fault(group: ModuleGroup, serial: str, rate: float) -> str:
    info = group.info(serial)
    trips_ms = _trips_ms(group, serial)
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
