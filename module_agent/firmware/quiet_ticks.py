"""The modules of a process in quiet ticks: their state as arrays, which one compiled call advances.

Most ticks are quiet: nothing has arrived, no time is up, no state changes. Then all modules are advanced by
`tick_kernel.tick`; each of the others is run by its Python objects, which are the definition: `load` gives
them what quiet ticks have changed, `store` takes what the kernel needs. What only Python changes (lease,
state, motion, gains) is in the objects alone. Renewals of the lease, the most frequent messages to a module,
need no more of them than `read_renewals`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from module_agent.firmware import tick_kernel as kernel
from module_agent.firmware.firmware import Firmware, Incoming, Outgoing
from module_agent.firmware.run_kernel import settle_rows
from module_agent.firmware.tick_kernel import NOT_QUIET, QUIET, ROW_DUE, Floats
from module_agent.hardware.hardware import Readings
from module_agent.hardware.loop_inside import LoopInside
from module_agent.wire.feedback_rows import ROW

__all__ = ["NOT_QUIET", "QUIET", "ROW_DUE", "QuietTicks"]

# Milliseconds of motion; a longer one makes more room.
_SAMPLES = 8192
# Feedback rows that can wait for Python: as many as are sent in one message, or more.
_HELD_ROWS = 64


class _Module(NamedTuple):
    """The objects of one module, which define its tick."""

    firmware: Firmware
    loops: LoopInside
    number: int


class QuietTicks:
    """The quiet ticks of up to n modules, each in a place of its own.

    now_ns and before_ns (n,) are the modules' times in the last tick that was run, and in the one before.
    """

    def __init__(self, modules: int):
        self._objects: list[_Module | None] = [None] * modules
        # What the arrays below were last made of: gains and motions seldom change.
        self._stored: list[tuple[object, object]] = [(None, None)] * modules
        self._modules = np.zeros(modules, kernel.MODULE)
        self._most = np.zeros((modules, kernel.COLUMNS - 2))
        self._loops = np.zeros((modules, 3), kernel.LOOP)
        self._memory = np.zeros((modules, 3, kernel.MEMORY))
        self._motion = np.zeros((modules, 3, _SAMPLES))
        self._floats = np.zeros((modules, 4))
        self._integers = np.zeros((modules, kernel.INTEGERS), np.int64)
        self._last = Readings(modules)
        self._rows = np.zeros(modules, kernel.FLAT_ROW)
        # The rows of several ticks, of each module as many as `_held` says, and as `_room` says at most.
        self._held_rows = np.zeros((modules, _HELD_ROWS, ROW.itemsize), np.uint8)
        self._held = np.zeros(modules, np.int64)
        self._room = np.ones(modules, np.int64)
        self._times = np.zeros((2, modules), np.int64)
        self._results = np.zeros(modules, np.uint8)
        self.pwm = self._floats[:, kernel.PWM]
        # The time of the last tick that a module's objects have run.
        self._run_ns = [0] * modules
        self.before_ns: list[int] = [0] * modules
        self.now_ns: list[int] = [0] * modules

    def attach(self, place: int, firmware: Firmware, loops: LoopInside, index: int) -> None:
        """Give a place to a module: its firmware, and which of the modules of `loops` it is.

        Its first tick is not quiet.
        """
        self._objects[place] = _Module(firmware, loops, index)
        self._stored[place] = (None, None)
        self._modules[place]["ready"] = 0
        self._integers[place] = self._run_ns[place] = self._held[place] = 0
        self._most[place] = loops.most(index)

    def detach(self, place: int) -> None:
        """Let the module of a place be quiet no more; its PWM is zero."""
        self._modules[place]["ready"] = 0
        self.pwm[place] = 0.0

    def run(self, readings: Readings, busy: list[int]) -> list[int]:
        """Run a tick of all places but the `busy` ones; return the result of each, see `tick_kernel`."""
        self.begin_run(busy)
        self._times[0], self._times[1] = self._times[1], readings.integers[:, 0]
        kernel.tick(readings.integers, readings.floats, *self.arrays)
        for place in np.flatnonzero(self._results == ROW_DUE).tolist():
            self._held_rows[place, self._held[place]] = self._rows[place : place + 1].view(np.uint8)
            self._held[place] += 1
        settle_rows(self._results, self._room, self._held)
        return self.end_run()

    @property
    def arrays(self) -> tuple[Any, ...]:
        """The arguments of `tick_kernel.tick` after the readings."""
        return (
            self._last.floats,
            self._modules,
            self._most,
            self._loops,
            self._memory,
            self._motion,
            self._floats,
            self._integers,
            self._rows,
            self._results,
        )

    def begin_run(self, busy: list[int]) -> tuple[Any, ...]:
        """Begin one or more ticks of all places but the `busy` ones; return what a kernel keeps of them.

        That is: the next PWM (n,); how many rows a module may hold (n,), and holds (n,), and those as bytes
        (n, rows, bytes); the rows of a tick as bytes (n, bytes); the modules' times in the tick before the
        last and in the last one (2, n); the results of the last (n,).
        """
        for place in busy:
            self._modules[place]["ready"] = 0
        rows = self._rows.view(np.uint8).reshape(len(self._rows), -1)
        return self.pwm, self._room, self._held, self._held_rows, rows, self._times, self._results

    def end_run(self) -> list[int]:
        """End the ticks of a run; return the result of the last for each place, see `tick_kernel`.

        `ROW_DUE` says that the rows of a place complete a batch; others are held, see `keep_held`.
        """
        self.before_ns, self.now_ns = self._times.tolist()
        results: list[int] = self._results.tolist()
        return results

    def keep_rows(self, place: int) -> list[Outgoing]:
        """Give a module the feedback rows that it holds; return what it sends."""
        module, count = self._objects[place], self._held[place]
        assert module is not None
        out = module.firmware.keep_rows(self._held_rows[place, :count].reshape(-1).data)
        self._held[place], self._room[place] = 0, min(module.firmware.rows_to_batch, _HELD_ROWS)
        return out

    def read_renewals(self, place: int, renewals: Sequence[Incoming]) -> list[Outgoing]:
        """Give a module the renewals of its lease that came for a quiet tick; return the answers."""
        module = self._objects[place]
        assert module is not None
        out = module.firmware.read_renewals(self.now_ns[place], renewals)
        fresh_ns, lease_until_ns = module.firmware.validity_ns
        self._modules["fresh_ns"][place], self._modules["lease_until_ns"][place] = fresh_ns, lease_until_ns
        return out

    def keep_held(self, places: range) -> None:
        """Give modules the rows that they hold of earlier ticks, where these complete no batch."""
        for place in places:
            if 0 < self._held[place] < self._room[place]:
                self.keep_rows(place)

    def load(self, place: int) -> None:
        """Let the objects of a module go on from where its quiet ticks ended."""
        module = self._objects[place]
        assert module is not None
        due_ns, imu_ns, running, limit, now_ns, limited, behind_ns = self._integers[place].tolist()
        if now_ns == self._run_ns[place]:
            # The objects have run the last tick.
            return
        if self._held[place]:
            self.keep_rows(place)
        floats = self._floats[place].tolist()
        module.firmware.go_on(now_ns, floats[:3], due_ns, imu_ns, limited, behind_ns)
        pwm, memory = floats[kernel.PWM], self._memory[place].tolist()
        module.loops.go_on(module.number, self._last[place], pwm, bool(running), limit, memory)

    def store(self, place: int) -> None:
        """Take what quiet ticks need of a module whose objects have run a tick."""
        module = self._objects[place]
        assert module is not None
        firmware, drive = module.firmware.quiet_state(), module.loops.quiet_state(module.number)
        controller, motion = drive.controller, firmware.motion
        gains_before, motion_before = self._stored[place]
        if controller is not gains_before:
            for k, loop in enumerate(controller.loops):
                self._loops[place, k] = loop.record
        if motion is not motion_before and motion is not None:
            self._store_motion(place, motion.targets)
        self._stored[place] = controller, motion
        self._modules[place] = (
            drive.clean,
            firmware.source,
            firmware.commanded,
            firmware.in_fault,
            firmware.fresh_ns,
            firmware.lifetime_ns,
            firmware.lease_until_ns,
            firmware.status_due_ns,
            *((0, 0) if motion is None else motion.span_ns),
            firmware.motion_id,
            firmware.state_number,
            controller.gains.strategy,
            controller.follows_motor,
            *firmware.row_periods,
            firmware.winding_c,
            *drive.bounds,
        )
        self._floats[place] = (*firmware.targets, drive.pwm)
        own = drive.running, drive.limit, firmware.now_ns, firmware.limited, firmware.behind_ns
        self._integers[place] = (*firmware.row_times, *own)
        self._memory[place] = [loop.memory for loop in controller.loops]
        self._run_ns[place] = firmware.now_ns
        self._room[place] = min(module.firmware.rows_to_batch, _HELD_ROWS)

    def _store_motion(self, place: int, targets: Floats) -> None:
        samples = targets.shape[1]
        if samples > self._motion.shape[2]:
            grown = np.zeros((*self._motion.shape[:2], 2 * samples))
            grown[:, :, : self._motion.shape[2]] = self._motion
            self._motion = grown
        self._motion[place, :, :samples] = targets
