"""Sick sensors and clocks: what modules read, between the world and their firmware, as a schedule says."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.hardware.hardware import Readings, SensorSample
from sim.faults.fault import Fault

_FIELDS = SensorSample._fields
_POSITION, _VELOCITY, _EFFORT = (
    _FIELDS.index(f"{name}") for name in ("position_rad", "velocity_rad_s", "effort_nm")
)
_IMU = slice(_FIELDS.index("gyro_x_rad_s"), _FIELDS.index("accel_z_m_s2") + 1)
_TIMES = slice(0, 2)
# Largest sizes: jumps of clock and encoder, and a drift; what is smallest is a tenth of it.
JUMP_S, JUMP_RAD, DRIFT = 2.0, 1.0, 4e-3
# Ends of the range that a saturated gyro or accelerometer is stuck at [rad/s, m/s^2].
FULL_SCALE = (34.9, 156.9)


class _Sickness(NamedTuple):
    """A fault in ticks of the world, and what its module read as it began."""

    fault: Fault
    begin_ns: int
    end_ns: float
    held: NDArray[np.int64]


class SickSensors:
    """Alters the readings of a robot's modules while faults of its sensors and clocks last.

    What it does follows from the faults and the times of the readings alone. Faults of other kinds are
    ignored.
    """

    def __init__(self, faults: Sequence[Fault], modules: int):
        self._waiting = sorted((f for f in faults if f.kind in _EFFECTS), key=lambda fault: fault.at_s)
        self._present: list[_Sickness] = []
        self._own = Readings(modules)

    def read(self, t_ns: int, readings: Readings) -> Readings:
        """Return what the modules read at a world time [ns]: `readings`, or an altered copy of them."""
        while self._waiting and 1e9 * self._waiting[0].at_s <= t_ns:
            fault = self._waiting.pop(0)
            begin_ns = round(1e9 * fault.at_s)
            end_ns = math.inf if math.isinf(fault.for_s) else begin_ns + round(1e9 * fault.for_s)
            held = readings.integers[fault.module].copy()
            self._present.append(_Sickness(fault, begin_ns, end_ns, held))
        if not self._present:
            return readings
        own = self._own
        own.integers[:] = readings.integers
        for one in self._present:
            _EFFECTS[one.fault.kind](own, one, t_ns)
        return own


def _sized(fault: Fault, largest: float) -> float:
    """Return a size between a tenth of the largest and the largest."""
    return largest * (0.1 + 0.9 * fault.size)


def _clock_forward(own: Readings, one: _Sickness, t_ns: int) -> None:
    own.integers[one.fault.module, _TIMES] += round(1e9 * _sized(one.fault, JUMP_S))


def _clock_back(own: Readings, one: _Sickness, t_ns: int) -> None:
    # No clock reads less than zero.
    jump_ns = min(round(1e9 * _sized(one.fault, JUMP_S)), int(one.held[1]))
    own.integers[one.fault.module, _TIMES] -= jump_ns


def _clock_stuck(own: Readings, one: _Sickness, t_ns: int) -> None:
    if t_ns < one.end_ns:
        own.integers[one.fault.module, _TIMES] = one.held[_TIMES]
    else:
        # It goes on from where it stood.
        own.integers[one.fault.module, _TIMES] -= round(one.end_ns) - one.begin_ns


def _clock_drift(own: Readings, one: _Sickness, t_ns: int) -> None:
    sign = 1.0 if one.fault.size < 0.5 else -1.0
    gained = sign * _sized(one.fault, DRIFT) * (min(t_ns, one.end_ns) - one.begin_ns)
    own.integers[one.fault.module, _TIMES] += round(gained)


def _encoder_jump(own: Readings, one: _Sickness, t_ns: int) -> None:
    own.floats[one.fault.module, _POSITION] += _sized(one.fault, JUMP_RAD)


def _imu_swapped(own: Readings, one: _Sickness, t_ns: int) -> None:
    pair = [one.fault.module, (one.fault.module + 1) % len(own)]
    own.floats[pair, _IMU] = own.floats[pair[::-1], _IMU]


def _while_it_lasts(
    alter: Callable[[NDArray[np.float64], _Sickness], None],
) -> Callable[[Readings, _Sickness, int], None]:
    """Return the effect that alters the row of the module as long as the fault lasts."""

    def effect(own: Readings, one: _Sickness, t_ns: int) -> None:
        if t_ns < one.end_ns:
            alter(own.floats[one.fault.module], one)

    return effect


def _encoder_stuck(row: NDArray[np.float64], one: _Sickness) -> None:
    row[_POSITION] = one.held.view(np.float64)[_POSITION]
    row[_VELOCITY] = 0.0


def _encoder_nan(row: NDArray[np.float64], one: _Sickness) -> None:
    row[[_POSITION, _VELOCITY]] = np.nan


def _imu_dead(row: NDArray[np.float64], one: _Sickness) -> None:
    row[_IMU] = 0.0


def _imu_stuck(row: NDArray[np.float64], one: _Sickness) -> None:
    row[_IMU] = one.held.view(np.float64)[_IMU]


def _imu_saturated(row: NDArray[np.float64], one: _Sickness) -> None:
    axis = int(6 * one.fault.size)
    row[_IMU.start + axis] = FULL_SCALE[axis // 3]


def _imu_nan(row: NDArray[np.float64], one: _Sickness) -> None:
    row[_IMU] = np.nan


def _torque_stuck(row: NDArray[np.float64], one: _Sickness) -> None:
    row[_EFFORT] = one.held.view(np.float64)[_EFFORT]


def _torque_nan(row: NDArray[np.float64], one: _Sickness) -> None:
    row[_EFFORT] = np.nan


_EFFECTS: dict[str, Callable[[Readings, _Sickness, int], Any]] = {
    "clock forward": _clock_forward,
    "clock back": _clock_back,
    "clock stuck": _clock_stuck,
    "clock drift": _clock_drift,
    "encoder stuck": _while_it_lasts(_encoder_stuck),
    "encoder jump": _encoder_jump,
    "encoder NaN": _while_it_lasts(_encoder_nan),
    "IMU dead": _while_it_lasts(_imu_dead),
    "IMU stuck": _while_it_lasts(_imu_stuck),
    "IMU saturated": _while_it_lasts(_imu_saturated),
    "IMU NaN": _while_it_lasts(_imu_nan),
    "IMU swapped": _imu_swapped,
    "torque stuck": _while_it_lasts(_torque_stuck),
    "torque NaN": _while_it_lasts(_torque_nan),
}
