"""The processes that only a fleet has: a router, and a coordinator that listens and asks but moves nothing.

`python -m sim.processes.fleet_member router ENDPOINT [PARENT]`
`python -m sim.processes.fleet_member coordinator ROBOT ROUTER MODULES SECONDS BEGIN`
"""

import asyncio
import json
import signal
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.api import LiveRobot, connect
from module_agent.model.errors import RobotError
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh

READY = "ready"
ASK_EVERY_S = 0.5
START_TIMEOUT_S = 120.0


class Heard(NamedTuple):
    """What a coordinator measured: rows, and round trips of a status request [ms].

    rows_lost: numbers that are missing between the first and the last row. unanswered: requests.
    real_time: least module time that passed, over the time here.
    """

    rows: int
    rows_lost: int
    unanswered: int
    round_trips_ms: tuple[float, ...]
    real_time: float
    seconds: float


def route(endpoint: str, parent: str | None) -> None:
    """Relay until a signal comes."""
    stop = {signal.SIGTERM, signal.SIGINT}
    signal.pthread_sigmask(signal.SIG_BLOCK, stop)
    transport = open_zenoh(ZenohConfig(listen=(endpoint,), connect=(parent,) if parent else ()))
    print(READY, flush=True)
    signal.sigwait(stop)
    transport.close()


async def coordinate(robot: str, router: str, modules: int, seconds: float, begin: Path) -> None:
    """Meet the modules, wait for the file `begin`, listen and ask for `seconds`, print what was heard."""
    async with connect(robot, routers=(router,), expect=modules, timeout_s=START_TIMEOUT_S) as arm:
        print(READY, flush=True)
        while not begin.exists():
            await asyncio.sleep(0.05)
        heard = await _listen(arm, seconds)
    print(json.dumps(heard._asdict()), flush=True)


async def _listen(arm: LiveRobot, seconds: float) -> Heard:
    logs = {serial: arm.group.module(serial).rows for serial in arm.serials}
    first = {serial: log.end_row for serial, log in logs.items()}
    start_ns = {serial: _newest_ns(arm, serial) for serial in logs}
    trips_ms: list[float] = []
    unanswered, start_s = 0, time.monotonic()

    async def ask(serial: str) -> None:
        nonlocal unanswered
        asked_s = time.monotonic()
        try:
            await arm.group.ask_status(serial)
        except RobotError:
            unanswered += 1
        else:
            trips_ms.append(1e3 * (time.monotonic() - asked_s))

    while time.monotonic() < start_s + seconds:
        # One after the other: all at once would measure how they queue here.
        for serial in logs:
            if time.monotonic() < start_s + seconds:
                await ask(serial)
        await asyncio.sleep(ASK_EVERY_S)
    spent_s = time.monotonic() - start_s
    ranges = [(log, first[serial], log.end_row) for serial, log in logs.items()]
    lost = sum(b - a for log, low, high in ranges for a, b in log.missing(low, high))
    passed_s = min(1e-9 * (_newest_ns(arm, serial) - start_ns[serial]) for serial in logs)
    rows = sum(high - low for _, low, high in ranges) - lost
    return Heard(rows, lost, unanswered, tuple(np.round(trips_ms, 3)), passed_s / spent_s, spent_s)


def _newest_ns(arm: LiveRobot, serial: str) -> int:
    return int(arm.latest(serial)["t_ns"][-1])


def main(arguments: list[str]) -> None:
    """Run one of the two."""
    match arguments:
        case ["router", endpoint, *parent]:
            route(endpoint, parent[0] if parent else None)
        case ["coordinator", robot, router, modules, seconds, begin]:
            asyncio.run(coordinate(robot, router, int(modules), float(seconds), Path(begin)))
        case _:
            raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
