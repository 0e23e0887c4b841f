"""Many ticks on the physics bus in one compiled call, while nothing happens but ticks.

In a process that shares its cores with others, a tick costs what it has to fetch into cold caches: a few
kilobytes of machine code where Python needs hundreds. The call ends at the first tick that Python has a part
in: a module is not quiet, a batch of its feedback rows is complete, or the bell says that something has
arrived. A tick that is quiet for all modules is answered at once, before Python sends its rows.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from module_agent.firmware import run_kernel, tick_kernel
from module_agent.firmware.quiet_ticks import QuietTicks
from module_agent.firmware.run_kernel import keep_rows, keep_times, settle_rows
from module_agent.hardware import bus_client, packet_kernel
from module_agent.hardware.bus_client import BusClient, answer, receive
from module_agent.hardware.hardware import Readings
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.compiled import compiled_with

# A signal that another thread has taken is seen after so many ticks.
MANY_TICKS = 32

Bell = NDArray[np.uint8]


class BusRun:
    """The ticks of the modules of a bus, which have all places of `quiet`.

    Args:
        bell: (1,), not zero from when something arrives until Python takes it.
    """

    def __init__(self, loops: LoopInside, bus: BusClient, quiet: QuietTicks, bell: Bell):
        self._loops, self._bus, self._quiet, self._bell = loops, bus, quiet, bell
        self._alive = np.ones(len(bus.modules), np.uint8)
        # Machine code is loaded before the network knows of the modules: it may take a second.
        self._run([], 0)

    @property
    def readings(self) -> Readings:
        """The samples of the last tick."""
        return self._bus.readings

    def run(self, busy: list[int], most: int) -> list[int]:
        """Run at least one tick and at most so many; return the results of the last as `QuietTicks.run`.

        Raises:
            HardwareLost: no further tick will come.
        """
        quiet, ticks = self._quiet, self._run(busy, most)
        if not ticks:
            return quiet.run(self._loops.exchange(quiet.pwm.tolist()), busy)
        self._loops.count(ticks)
        return quiet.end_run()

    def _run(self, busy: list[int], most: int) -> int:
        quiet, readings, kept = self._quiet, self._bus.readings, self._quiet.begin_run(busy)
        samples = readings.integers, readings.floats
        return int(_run(self._bus.kernel_state, samples, self._bell, most, self._alive, kept, quiet.arrays))


@compiled_with(bus_client, packet_kernel, tick_kernel, run_kernel)
def _run(
    bus: Any, samples: Any, bell: Bell, most: int, alive: NDArray[np.uint8], kept: Any, quiet: Any
) -> int:
    """Run ticks and return how many: none if the first one is not had by system calls that succeed."""
    next_pwm, room, held, held_rows, rows, times, results = kept
    integers, floats = samples
    done = 0
    while done < most and answer(bus, next_pwm) and receive(bus):
        others = tick_kernel.tick(integers, floats, *quiet)
        done += 1
        keep_times(integers, times)
        ends = keep_rows(results, alive, rows, room, held, held_rows)
        if others:
            break
        if ends or bell[0]:
            answer(bus, next_pwm)
            break
    settle_rows(results, room, held)
    return done
