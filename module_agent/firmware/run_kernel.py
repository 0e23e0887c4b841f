"""What runs of many quiet ticks keep of each: times, and the feedback rows that wait for Python."""

import numpy as np
from numpy.typing import NDArray

from module_agent.firmware import tick_kernel
from module_agent.firmware.tick_kernel import NOT_QUIET, QUIET, ROW_DUE, Integers
from module_agent.model.compiled import compiled_with


@compiled_with(tick_kernel)
def keep_times(integers: Integers, times: Integers) -> None:
    """Keep the modules' times in this tick and the one before, (2, n)."""
    for i in range(integers.shape[0]):
        times[0, i] = times[1, i]
        times[1, i] = integers[i, 0]


@compiled_with(tick_kernel)
def keep_rows(
    results: NDArray[np.uint8],
    alive: NDArray[np.uint8],
    rows: NDArray[np.uint8],
    room: Integers,
    held: Integers,
    held_rows: NDArray[np.uint8],
) -> bool:
    """Hold the rows of this tick; return whether Python has a part in it."""
    ends = False
    for i in range(len(results)):
        if results[i] == ROW_DUE:
            for k in range(rows.shape[1]):
                held_rows[i, held[i], k] = rows[i, k]
            held[i] += 1
            ends |= held[i] >= room[i]
        elif results[i] == NOT_QUIET and alive[i]:
            ends = True
    return ends


@compiled_with(tick_kernel)
def settle_rows(results: NDArray[np.uint8], room: Integers, held: Integers) -> None:
    """Let results say of rows whether they complete a batch, after the last tick of a run."""
    for i in range(len(results)):
        if results[i] == ROW_DUE and held[i] < room[i]:
            results[i] = QUIET
        elif results[i] == QUIET and held[i] >= room[i]:
            results[i] = ROW_DUE
