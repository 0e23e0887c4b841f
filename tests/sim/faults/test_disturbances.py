"""Disturbances of the network that overlap end one by one."""

import asyncio
from pathlib import Path
from types import SimpleNamespace

from module_agent.wire.keys import Leaf, key
from sim.faults.fault import Fault
from sim.faults.plant_witness import PlantWitness
from sim.faults.run import COORDINATOR, DELAY_S, _Session
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

    def at(time_s: float) -> tuple[bool, int | None, int, float]:
        loop.run_until_complete(asyncio.sleep(time_s - loop.time()))
        state = session._cable
        return state.cut, state.flip, state.copies, state.delay_s

    assert at(0.55) == (True, None, 0, DELAY_S)  # the second partition goes on
    assert at(0.65) == (True, 1 << 15, 0, DELAY_S)
    assert at(0.95) == (False, None, 0, DELAY_S)
    assert at(1.2) == (False, None, 0, 0.0)
    loop.close()


def test_what_a_coordinator_commands_is_as_old_as_it_left_its_program() -> None:
    """A motor is to be off a lifetime after that, and not after what the cable made of it."""
    witness, robot = PlantWitness({COORDINATOR: COORDINATOR}), SimpleNamespace(loop=VirtualLoop())
    session = _Session(SimpleNamespace(), robot, Path(), [])  # type: ignore[arg-type]
    session._way = SimpleNamespace(given_ns=7)  # type: ignore[assignment]
    session.witnessed(witness, 100_000_007, COORDINATOR, "sample", key("arm", "A", Leaf.SETPOINT), b"")
    assert witness._sent_ns == {"A": 7}
    # One that was given before it and delayed for longer comes after it.
    session._way = SimpleNamespace(given_ns=5)  # type: ignore[assignment]
    session.witnessed(witness, 100_000_008, COORDINATOR, "sample", key("arm", "A", Leaf.SETPOINT), b"")
    assert witness._sent_ns == witness._accepted_ns == {"A": 7}
    robot.loop.close()
