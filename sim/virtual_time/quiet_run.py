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
from module_agent.firmware.run_kernel import keep_rows, keep_times, settle_rows
from module_agent.model.compiled import compiled_with
from sim.geometry.pose import Array
from sim.sensors import alteration
from sim.sensors.alteration import alter, unaltered
from sim.sensors.sensors import used_up
from sim.world import world_kernel
from sim.world.truth import MANY_TICKS, TruthLog
from sim.world.world import World
from sim.world.world_kernel import PLANT_ROWS, keep_truth, named, tick, work_of

# Rows of `QuietRun.seen`: those of a plant, and the PWM that was asked for, whatever it was.
ASKED = PLANT_ROWS
SEEN_ROWS = PLANT_ROWS + 1


class QuietRun:
    """The ticks of a world and of the agents of its modules, n places of `quiet`, many at a time.

    seen (MANY_TICKS, SEEN_ROWS, n) has what truly happened in each tick of the last call.
    """

    def __init__(self, world: World, truth: TruthLog, quiet: QuietTicks):
        modules = len(world.modules)
        self._world, self._truth, self._quiet = world, truth, quiet
        self._alive = np.zeros(modules, np.uint8)
        self._nothing = tuple(unaltered(modules))
        self.seen = np.zeros((MANY_TICKS, SEEN_ROWS, modules))

    def run(self, pwm: list[float], alive: list[int], busy: list[int], most: int) -> tuple[int, list[int]]:
        """Run at most so many ticks; return how many, and the results of the last one as `QuietTicks.run`.

        `pwm` is that of the first tick; places that are not `alive` keep theirs, and end no run.
        """
        world, quiet, truth = self._world, self._quiet, self._truth
        self._alive[:] = 0
        self._alive[alive] = 1
        self.seen[0, ASKED] = pwm
        state, number, u = world.begin_run(pwm)
        altered, read = truth.alteration, truth.readings
        ticks = _run(
            state,
            number,
            most,
            u,
            self._alive,
            quiet.begin_run(busy),
            quiet.arrays,
            truth.begin_run(most),
            self.seen,
            altered is not None,
            self._nothing if altered is None else altered,
            (read.integers, read.floats),
        )
        world.end_run(ticks)
        return ticks, quiet.end_run()

    def see(self, pwm: list[float]) -> None:
        """Take note of one tick that was run by itself, after it, and of the PWM that was asked for."""
        self.seen[0, :PLANT_ROWS] = self._world.plant_rows
        self.seen[0, ASKED] = pwm


@compiled_with(*world_kernel.PARTS, world_kernel, tick_kernel, run_kernel, alteration)
def _run(
    state: Any,
    number: int,
    most: int,
    pwm: Array,
    alive: NDArray[np.uint8],
    kept: Any,
    quiet: Any,
    truth: Any,
    seen: Array,
    is_altered: bool,
    altered: Any,
    read: Any,
) -> int:
    own, done = named(state), 0
    work = work_of(own, 1)
    next_pwm, room, held, held_rows, rows, times, results = kept
    integers, floats = read
    while True:
        tick(own, number + done, pwm, work)
        t_ns = (number + done) * own.tick_ns
        keep_truth(own.plant, t_ns, truth)
        for row in range(PLANT_ROWS):
            for i in range(len(pwm)):
                seen[done, row, i] = own.plant[row, i]
        if is_altered:
            alter(t_ns, own.integers, own.floats, altered, integers, floats)
        tick_kernel.tick(integers, floats, *quiet)
        done += 1
        keep_times(integers, times)
        ends = keep_rows(results, alive, rows, room, held, held_rows)
        if ends or done >= most or used_up(own.sensors):
            break
        for i in range(len(pwm)):
            seen[done, ASKED, i] = next_pwm[i] if alive[i] else pwm[i]
            if alive[i]:
                pwm[i] = min(max(next_pwm[i], -1.0), 1.0)
    settle_rows(results, room, held)
    return done
