"""The barrier of the physics bus, compiled: the answers of all agents in, the samples of a tick out.

One call does a tick's system calls, or many whole ticks where the world's engine is compiled too. Whatever
is not in order (an agent that is late, gone, or answers wrongly) is left to `bus_server`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.hardware import packet_kernel as packets
from module_agent.hardware.hardware import Readings, SensorSample
from module_agent.hardware.packet_kernel import Words
from module_agent.model.compiled import compiled_with
from sim.geometry.pose import Array
from sim.sensors.sensors import used_up
from sim.world import world_kernel
from sim.world.truth import TruthLog
from sim.world.world_kernel import keep_truth, named, tick, work_of

_COLUMNS = len(SensorSample._fields)
# Of the pace: when the next tick is due, the period (0: as fast as it goes), what was given up; and by how
# much ticks may lag before that is given up [ns].
DUE, PERIOD, SLIPPED, MAX_LAG = range(4)
# No answer has been waited for; the length of one that has not come is -1.
NOT_ASKED = -2


class Progress(NamedTuple):
    """What a run of ticks has done: whole ticks, and where it stopped in the next one.

    answered: how many agents have answered a tick that is not stepped yet, None if there is no such tick.
    sent: how many have been sent the samples of the last one.
    """

    ticks: int
    answered: int | None
    sent: int


class Barrier:
    """The agents inside, in the order in which they are read.

    lengths (agents,): those of the answers in the last tick [bytes], 0 at an end, -1 where none came,
    `NOT_ASKED`. late (agents,): whether the world had to wait for it.

    Args:
        descriptors: of their connections.
        slots: of their modules.
        bound_s: how long all together are waited for.
        slow_s: from when on one is late.
    """

    def __init__(
        self, descriptors: Sequence[int], slots: Sequence[tuple[int, ...]], bound_s: float, slow_s: float
    ):
        counts = [len(own) for own in slots]
        self.size = len(counts)
        self.lengths, self.late = np.zeros(self.size, np.int64), np.zeros(self.size, np.uint8)
        self._answers = np.zeros((self.size, 1 + max(counts, default=0)))
        # When the time of the last tick's barrier was up.
        self._until = np.zeros(1, np.int64)
        self._arrays = (
            np.array(descriptors, np.int64),
            np.cumsum([0, *counts]),
            np.array([slot for own in slots for slot in own], np.int64),
            self._answers,
            self._answers.view(np.int64),
            np.zeros(1 + _COLUMNS * max(counts, default=0), np.int64),
            self.lengths,
            self.late,
            self._until,
            np.array([round(1e9 * bound_s), round(1e9 * slow_s)]),
            packets.work_space(),
        )

    @property
    def until_s(self) -> float:
        """When the time of the last tick's barrier is up, on the steady clock [s]."""
        return 1e-9 * float(self._until[0])

    def answer(self, agent: int) -> bytes | None:
        """Return the packet that an agent answered with, None if there is none yet."""
        length = int(self.lengths[agent])
        # Of one that was too long only the beginning is here.
        return None if length < 0 else self._answers[agent].tobytes()[:length].ljust(length, b"\0")

    def collect(self, tick_number: int, pwm: Array) -> int:
        """Write the PWM of the agents that answer well; return how many, up to the first that does not."""
        return int(_collect(self._arrays, tick_number, pwm))

    def distribute(self, tick_number: int, readings: Readings, begin: int) -> int:
        """Send the samples of a tick from an agent on; return how many have been sent to, up to a failure."""
        return int(_distribute(self._arrays, tick_number, readings.integers, begin))

    def run(self, truth: TruthLog, tick_number: int, most: int, pwm: Array, pace: Words) -> Progress:
        """Run at most so many ticks of a world that can run ahead, while all agents answer as they should."""
        world = truth.world
        state, number, _ = world.begin_run(pwm.tolist())
        progress = np.zeros(3, np.int64)
        _run(state, number, most, pwm, truth.begin_run(most), self._arrays, tick_number, pace, progress)
        ticks, answered, sent = progress.tolist()
        world.end_run(ticks)
        return Progress(ticks, None if answered < 0 else answered, sent)


def rehearse(world: TruthLog | None) -> None:
    """Load the machine code, or compile it, which would stop a world for seconds."""
    nothing = Barrier((), (), 0.0, 0.0)
    pwm = np.zeros(0 if world is None else len(world.modules))
    nothing.distribute(0, Readings(1), nothing.collect(0, pwm))
    keep_pace(pace := new_pace(0, 0, 0), packets.work_space())
    if world is not None and world.ticks_ahead:
        nothing.run(world, 0, 0, pwm, pace)


def new_pace(now_ns: int, period_ns: int, max_lag_ns: int) -> Words:
    """Return a pace that begins now; a period of 0 is as fast as it goes."""
    return np.array([now_ns, period_ns, 0, max_lag_ns])


@compiled_with(packets)
def keep_pace(pace: Words, clock: Words) -> bool:
    """Wait until the next tick is due and set when the one after it is; return whether no signal came."""
    if pace[PERIOD] == 0:
        return True
    lag_ns = packets.now_ns(clock) - pace[DUE]
    if lag_ns < 0 and not packets.sleep_until(pace[DUE], clock):
        return False
    lost_ns = max(0, lag_ns - pace[MAX_LAG])
    pace[SLIPPED] += lost_ns
    pace[DUE] += lost_ns + pace[PERIOD]
    return True


@compiled_with(packets)
def _collect(barrier: Any, tick_number: int, pwm: Array) -> int:
    descriptors, first, slots, answers, words, _, lengths, late, until, bounds, clock = barrier
    before_ns = packets.now_ns(clock)
    until[0] = before_ns + bounds[0]
    lengths[:] = NOT_ASKED
    late[:] = 0
    for k in range(len(descriptors)):
        count = first[k + 1] - first[k]
        lengths[k] = packets.receive(descriptors[k], words[k], 1 + count)
        # Agents are read in turn: one that is not slower than those before it has answered already.
        now_ns = packets.now_ns(clock)
        late[k] = now_ns - before_ns > bounds[1]
        before_ns = now_ns
        if lengths[k] != 8 * (1 + count) or words[k, 0] != tick_number:
            return k
        for i in range(count):
            if not -1.0 <= answers[k, 1 + i] <= 1.0:
                return k
        for i in range(count):
            pwm[slots[first[k] + i]] = answers[k, 1 + i]
        if now_ns > until[0]:
            return k + 1
    return len(descriptors)


@compiled_with(packets)
def _distribute(barrier: Any, tick_number: int, integers: Words, begin: int) -> int:
    descriptors, first, slots, _, _, samples, _, _, _, _, _ = barrier
    samples[0] = tick_number
    for k in range(begin, len(descriptors)):
        count = first[k + 1] - first[k]
        for i in range(count):
            slot = slots[first[k] + i]
            for column in range(_COLUMNS):
                samples[1 + _COLUMNS * i + column] = integers[slot, column]
        if not packets.send(descriptors[k], samples, 1 + _COLUMNS * count, False):
            return k
    return len(descriptors)


@compiled_with(*world_kernel.PARTS, world_kernel, packets)
def _run(
    state: Any,
    number: int,
    most: int,
    pwm: Array,
    truth: Any,
    barrier: Any,
    tick_number: int,
    pace: Words,
    progress: NDArray[np.int64],
) -> None:
    """Run ticks as `Barrier.run` does; progress (3,) as `Progress`, with -1 for None."""
    own, done, agents = named(state), 0, len(barrier[0])
    work, late, clock = work_of(own, 1), barrier[7], barrier[10]
    answered, sent = -1, agents
    while done < most and sent == agents and not used_up(own.sensors):
        if not keep_pace(pace, clock):
            break
        answered = _collect(barrier, tick_number + done, pwm)
        if answered < agents or np.any(late):
            break
        answered = -1
        tick(own, number + done, pwm, work)
        keep_truth(own.plant, (number + done) * own.tick_ns, truth)
        done += 1
        sent = _distribute(barrier, tick_number + done, own.integers, 0)
    progress[0], progress[1], progress[2] = done, answered, sent
