"""Disturbances of the network that overlap end one by one."""

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from sim.faults.fault import Fault
from sim.faults.run import DELAY_S, _Session
from sim.virtual_time.cable import CableState
from sim.virtual_time.loop import VirtualLoop


def test_a_disturbance_that_ends_leaves_those_that_go_on() -> None:
    loop = VirtualLoop()
    session = _Session(SimpleNamespace(), SimpleNamespace(loop=loop), Path(), [])  # type: ignore[arg-type]
    faults = (
        Fault("delayed messages", 0.1, 1.0),
        Fault("partition", 0.2, 0.3),
        Fault("partition", 0.4, 0.5),
        Fault("corrupted messages", 0.6, 0.1, size=0.5),
    )
    for fault in faults:
        loop.call_at(fault.at_s, session._begin, fault)

    def at(time_s: float) -> dict[str, Any]:
        loop.run_until_complete(asyncio.sleep(time_s - loop.time()))
        return vars(session._cable)

    assert at(0.55) == vars(CableState(cut=True, delay_s=DELAY_S))  # the second partition goes on
    assert at(0.65) == vars(CableState(cut=True, flip=1 << 15, delay_s=DELAY_S))
    assert at(0.95) == vars(CableState(delay_s=DELAY_S))
    assert at(1.2) == vars(CableState())
    loop.close()
