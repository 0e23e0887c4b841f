"""Many ticks of world and agents in one compiled call, while nothing happens but ticks.

The call ends at the first tick that Python has a part in: a module is not quiet, or a batch of its feedback
rows is complete. The rows before it wait in `QuietTicks`. A call is for no more ticks than there are before
something else happens, a message or a timer. One call for many ticks and one for each leave the same bits.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from module_agent.firmware import run_kernel, tick_kernel
from module_agent.firmware.quiet_ticks import QuietTicks
from module_agent.firmware.run_kernel import keep_rows, keep_times
from module_agent.firmware.tick_kernel import QUIET, ROW_DUE
from module_agent.model.compiled import compiled_with
from sim.geometry.pose import Array
from sim.sensors.sensors import used_up
from sim.world import world_kernel
from sim.world.truth import TruthLog
from sim.world.world import World
from sim.world.world_kernel import keep_truth, named, tick, work_of


class QuietRun:
    """The ticks of a world and of the agents of its modules, n places of `quiet`, many at a time."""

    def __init__(self, world: World, truth: TruthLog, quiet: QuietTicks):
        self._world, self._truth, self._quiet = world, truth, quiet
        self._alive = np.zeros(len(world.modules), np.uint8)

    def run(self, pwm: list[float], alive: list[int], busy: list[int], most: int) -> tuple[int, list[int]]:
        """Run at most so many ticks; return how many, and the results of the last one as `QuietTicks.run`.

        `pwm` is that of the first tick; places that are not `alive` keep theirs, and end no run.
        """
        world, quiet = self._world, self._quiet
        self._alive[:] = 0
        self._alive[alive] = 1
        state, number, u = world.begin_run(pwm)
        ticks = _run(
            state,
            number,
            most,
            u,
            self._alive,
            quiet.begin_run(busy),
            quiet.arrays,
            self._truth.begin_run(most),
        )
        world.end_run(ticks)
        return ticks, quiet.end_run()


@compiled_with(*world_kernel.PARTS, world_kernel, tick_kernel, run_kernel)
def _run(
    state: Any,
    number: int,
    most: int,
    pwm: Array,
    alive: NDArray[np.uint8],
    kept: Any,
    quiet: Any,
    truth: Any,
) -> int:
    own, done = named(state), 0
    work = work_of(own, 1)
    next_pwm, room, held, held_rows, rows, times, results = kept
    while True:
        tick(own, number + done, pwm, work)
        keep_truth(own.plant, (number + done) * own.tick_ns, truth)
        tick_kernel.tick(own.integers, own.floats, *quiet)
        done += 1
        keep_times(own.integers, times)
        ends = keep_rows(results, alive, rows, room, held, held_rows)
        if ends or done >= most or used_up(own.sensors):
            break
        for i in range(len(pwm)):
            if alive[i]:
                pwm[i] = min(max(next_pwm[i], -1.0), 1.0)
    for i in range(len(pwm)):
        if results[i] == QUIET and held[i] > 0:
            results[i] = ROW_DUE
    return done
