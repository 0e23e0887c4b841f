"""Sick sensors and clocks: what modules read, between the world and their firmware, as a schedule says."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.hardware.hardware import Readings, SensorSample
from sim.faults.fault import Fault
from sim.sensors.alteration import TIMES, Alteration, alter, unaltered

_FIELDS = SensorSample._fields
_POSITION, _VELOCITY, _EFFORT = (
    _FIELDS.index(f"{name}") for name in ("position_rad", "velocity_rad_s", "effort_nm")
)
_IMU = slice(_FIELDS.index("gyro_x_rad_s"), _FIELDS.index("accel_z_m_s2") + 1)
# Largest sizes: jumps of clock and encoder, and a drift; what is smallest is a hundredth of it.
JUMP_S, JUMP_RAD, DRIFT = 2.0, 1.0, 4e-3
# Ends of the range that a saturated gyro or accelerometer is stuck at [rad/s, m/s^2].
FULL_SCALE = (34.9, 156.9)


class _Sickness(NamedTuple):
    """A fault in ticks of the world, and what its module's sensors gave as it began."""

    fault: Fault
    begin_ns: int
    end_ns: float
    held: NDArray[np.int64]


class SickSensors:
    """Alters the readings of a robot's modules while faults of its sensors and clocks last.

    What it does follows from the faults and the times of the readings alone. Faults of other kinds are
    ignored. `alteration` is what the last reading was altered by, as plain tuples, None if by nothing.
    """

    def __init__(self, faults: Sequence[Fault], modules: int):
        self._waiting = sorted((f for f in faults if f.kind in _EFFECTS), key=lambda fault: fault.at_s)
        self._present: list[_Sickness] = []
        self._changes_ns = self._next_change_ns(-1)
        self.alteration: Any = None
        self.own = Readings(modules)

    def read(self, t_ns: int, readings: Readings) -> Readings:
        """Return what the modules read at a world time [ns]: `readings`, or an altered copy of them."""
        if t_ns >= self._changes_ns:
            self._change(t_ns, readings)
        if self.alteration is None:
            return readings
        own = self.own
        alter(t_ns, readings.integers, readings.floats, self.alteration, own.integers, own.floats)
        return own

    def spare_ns(self, t_ns: int) -> float:
        """Return for how long from a world time on `alteration` stays as it is [ns], infinite if for ever."""
        return self._changes_ns - t_ns

    def _change(self, t_ns: int, readings: Readings) -> None:
        while self._waiting and 1e9 * self._waiting[0].at_s <= t_ns:
            fault = self._waiting.pop(0)
            begin_ns = round(1e9 * fault.at_s)
            end_ns = math.inf if math.isinf(fault.for_s) else begin_ns + round(1e9 * fault.for_s)
            held = readings.integers[fault.module].copy()
            self._present.append(_Sickness(fault, begin_ns, end_ns, held))
        self._present = [one for one in self._present if t_ns < one.end_ns or one.fault.kind in _LASTING]
        self._changes_ns = self._next_change_ns(t_ns)
        altered = unaltered(len(readings))._replace(drifts=np.zeros((len(self._present), 3)))
        for place, one in enumerate(self._present):
            _EFFECTS[one.fault.kind](altered, one, t_ns, place)
        self.alteration = tuple(altered) if self._present else None

    def _next_change_ns(self, t_ns: int) -> float:
        begins = [math.ceil(1e9 * fault.at_s) for fault in self._waiting[:1]]
        return min((*begins, *(one.end_ns for one in self._present if one.end_ns > t_ns)), default=math.inf)


def _sized(fault: Fault, largest: float) -> float:
    """Return a size from a hundredth of the largest on: as many of one order of magnitude as of the other."""
    return float(largest * 10.0 ** (2.0 * fault.size - 2.0))


def _clock_forward(own: Alteration, one: _Sickness, t_ns: int, place: int) -> None:
    own.added_ns[one.fault.module] += round(1e9 * _sized(one.fault, JUMP_S))


def _clock_back(own: Alteration, one: _Sickness, t_ns: int, place: int) -> None:
    # No clock reads less than zero.
    own.added_ns[one.fault.module] -= min(round(1e9 * _sized(one.fault, JUMP_S)), int(one.held[1]))


def _clock_stuck(own: Alteration, one: _Sickness, t_ns: int, place: int) -> None:
    module = one.fault.module
    if t_ns < one.end_ns:
        own.keeps[module, :TIMES] = False
        own.added_ns[module] = one.held[:TIMES]
        own.drifts[own.drifts[:, 0] == module, 1] = 0.0
    else:
        # It goes on from where it stood.
        own.added_ns[module] -= round(one.end_ns) - one.begin_ns


def _clock_drift(own: Alteration, one: _Sickness, t_ns: int, place: int) -> None:
    # Small and large ones are both fast and slow.
    rate = (1.0 if round(1e3 * one.fault.size) % 2 else -1.0) * _sized(one.fault, DRIFT)
    if t_ns < one.end_ns:
        own.drifts[place] = one.fault.module, rate, one.begin_ns
    else:
        own.added_ns[one.fault.module] += round(rate * (one.end_ns - one.begin_ns))


def _encoder_jump(own: Alteration, one: _Sickness, t_ns: int, place: int) -> None:
    own.added[one.fault.module, _POSITION] += _sized(one.fault, JUMP_RAD)


def _imu_swapped(own: Alteration, one: _Sickness, t_ns: int, place: int) -> None:
    pair = [one.fault.module, (one.fault.module + 1) % len(own.keeps)]
    for each in (own.source, own.keeps, own.added):
        each[pair, _IMU] = each[pair[::-1], _IMU]


def _reads(
    columns: Sequence[int] | slice, value: Callable[[_Sickness], float | NDArray[np.float64]]
) -> Callable[[Alteration, _Sickness, int, int], None]:
    """Return the effect that a module reads a value in some columns, whatever its sensors give."""

    def effect(own: Alteration, one: _Sickness, t_ns: int, place: int) -> None:
        own.keeps[one.fault.module, columns] = False
        own.added[one.fault.module, columns] = value(one)

    return effect


def _held(columns: Sequence[int] | slice) -> Callable[[_Sickness], NDArray[np.float64]]:
    return lambda one: one.held.view(np.float64)[columns]


def _encoder_stuck(own: Alteration, one: _Sickness, t_ns: int, place: int) -> None:
    _reads([_POSITION], _held([_POSITION]))(own, one, t_ns, place)
    _reads([_VELOCITY], lambda one: 0.0)(own, one, t_ns, place)


def _imu_saturated(own: Alteration, one: _Sickness, t_ns: int, place: int) -> None:
    axis = int(6 * one.fault.size)
    _reads([_IMU.start + axis], lambda one: FULL_SCALE[axis // 3])(own, one, t_ns, place)


_EFFECTS: dict[str, Callable[[Alteration, _Sickness, int, int], None]] = {
    "clock forward": _clock_forward,
    "clock back": _clock_back,
    "clock stuck": _clock_stuck,
    "clock drift": _clock_drift,
    "encoder stuck": _encoder_stuck,
    "encoder jump": _encoder_jump,
    "encoder NaN": _reads([_POSITION, _VELOCITY], lambda one: math.nan),
    "IMU dead": _reads(_IMU, lambda one: 0.0),
    "IMU stuck": _reads(_IMU, _held(_IMU)),
    "IMU saturated": _imu_saturated,
    "IMU NaN": _reads(_IMU, lambda one: math.nan),
    "IMU swapped": _imu_swapped,
    "torque stuck": _reads([_EFFORT], _held([_EFFORT])),
    "torque NaN": _reads([_EFFORT], lambda one: math.nan),
}
# They have an effect after their end, too.
_LASTING = ("clock forward", "clock back", "clock stuck", "clock drift", "encoder jump", "IMU swapped")
