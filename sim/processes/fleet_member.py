"""The processes that only a fleet has: a router, and a coordinator that listens, asks, may move its robot.

`python -m sim.processes.fleet_member router ENDPOINT [PARENT]`
`python -m sim.processes.fleet_member coordinator ROBOT ROUTER MODULES SECONDS BEGIN [move]`
"""

import asyncio
import json
import signal
import sys
import time
from contextlib import suppress
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from coordinator.api import LiveRobot, connect
from module_agent.model.errors import RobotError
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh
from module_agent.wire.messages import WindowedSine
from module_agent.wire.row_log import RowLog

READY = "ready"
ASK_EVERY_S = 0.5
START_TIMEOUT_S = 120.0
# Of each module, ten seconds: the memory of a coordinator is flat, however long it listens.
RETAINED_ROWS = 2_500
# Of one joint, while all others hold; short, since a coordinator waits only 3 s beyond a motion's own time.
MOTION = WindowedSine(amplitude=0.05, centre_s=0.25, sigma_s=0.1)


class Heard(NamedTuple):
    """What a coordinator measured: rows, and round trips of a status request [ms].

    rows_lost: numbers that are missing between the first and the last row. unanswered: requests.
    real_time: least module time that passed, over the time here. motions: that came to their end, and that
    did not.
    """

    rows: int
    rows_lost: int
    unanswered: int
    round_trips_ms: tuple[float, ...]
    real_time: float
    seconds: float
    motions: int = 0
    motions_failed: int = 0


def route(endpoint: str, parent: str | None) -> None:
    """Relay until a signal comes."""
    stop = {signal.SIGTERM, signal.SIGINT}
    signal.pthread_sigmask(signal.SIG_BLOCK, stop)
    transport = open_zenoh(ZenohConfig(listen=(endpoint,), connect=(parent,) if parent else ()))
    print(READY, flush=True)
    signal.sigwait(stop)
    transport.close()


async def coordinate(robot: str, router: str, modules: int, seconds: float, begin: Path, moves: bool) -> None:
    """Meet the modules, wait for the file `begin`, listen and ask for `seconds`, print what was heard.

    A robot that `moves` is held, and its joints move in turn.
    """
    settings: Any = {"expect": modules, "timeout_s": START_TIMEOUT_S, "retained_rows": RETAINED_ROWS}
    async with connect(robot, routers=(router,), **settings) as arm:
        if moves:
            await arm.hold()
        print(READY, flush=True)
        while not begin.exists():
            await asyncio.sleep(0.05)
        done: list[bool] = []
        mover = asyncio.create_task(_move(arm, done)) if moves else None
        heard = await _listen(arm, seconds)
        if mover is not None:
            mover.cancel()
            with suppress(asyncio.CancelledError):
                await mover
    heard = heard._replace(motions=done.count(True), motions_failed=done.count(False))
    print(json.dumps(heard._asdict()), flush=True)


async def _move(arm: LiveRobot, done: list[bool]) -> None:
    """Move one joint after the other until cancelled; note of each motion whether it came to its end."""
    for serial in cycle(arm.serials):
        try:
            await arm.group.run({serial: MOTION})
        except RobotError:
            done.append(False)
            # It may have expired: what is too slow for its keep-alives is counted, and goes on.
            with suppress(RobotError):
                await arm.group.acquire(serial)
            await asyncio.sleep(ASK_EVERY_S)
        else:
            done.append(True)


class RowCount:
    """Counts the rows of a log from now on, come and lost, while old ones are forgotten.

    Of the rows so far only the newest is kept, so that one which comes late is not counted.
    """

    def __init__(self, log: RowLog):
        self._log, self._begin = log, log.end_row
        log.forget_before(self._begin - 1)
        self._lost = log.lost

    def __call__(self) -> tuple[int, int]:
        """Return how many rows have come, and how many of the numbers up to the newest are missing."""
        log = self._log
        missing = sum(end - first for first, end in log.missing(log.first_row, log.end_row))
        lost = missing + log.lost - self._lost
        return log.end_row - self._begin - lost, lost


async def _listen(arm: LiveRobot, seconds: float) -> Heard:
    logs = {serial: arm.group.module(serial).rows for serial in arm.serials}
    counts = [RowCount(log) for log in logs.values()]
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
    passed_s = min(1e-9 * (_newest_ns(arm, serial) - start_ns[serial]) for serial in logs)
    rows, lost = (sum(each) for each in zip(*(count() for count in counts), strict=True))
    return Heard(rows, lost, unanswered, tuple(np.round(trips_ms, 3)), passed_s / spent_s, spent_s)


def _newest_ns(arm: LiveRobot, serial: str) -> int:
    return int(arm.latest(serial)["t_ns"][-1])


def main(arguments: list[str]) -> None:
    """Run one of the two."""
    match arguments:
        case ["router", endpoint, *parent]:
            route(endpoint, parent[0] if parent else None)
        case ["coordinator", robot, router, modules, seconds, begin, *move]:
            moves = move == ["move"]
            asyncio.run(coordinate(robot, router, int(modules), float(seconds), Path(begin), moves))
        case _:
            raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
