"""What a module reads is checked before any loop acts on it.

A value that is no number, or that no working module of the type can read, is replaced by the last good one:
a single bad sample then costs nothing. When it goes on for `MAX_HELD` samples, or when time and again one in
`GOOD_PER_BAD` is bad, it is a fault, which names the sensor, its value and what is possible; it lasts as long
as the sensor is bad.

So it is with the time of the IMU: it goes back only with the module's clock, and is never ahead of it.
Readings of an impossible time are held over with their time, as they would belong to another instant.
"""

import math
from operator import le

from module_agent.hardware.hardware import SensorSample
from module_agent.model.catalogue import AMBIENT_C, ModuleType

# Consecutive samples that are held over: 5 ms at 1 kHz.
MAX_HELD = 5
# So many good samples make up for a bad one. With more than `MAX_OWED` of them to come it is a loose contact,
# which is trusted again after as many good ones without a bad one: 0.2 s at 1 kHz.
GOOD_PER_BAD, MAX_OWED = 8, 200
# Wide bounds: in an impact a joint is faster than its motor, and an accelerometer without a range of its own
# reads 100 g. What is beyond them is a broken wire or a flipped bit.
_OVER_SPEED, _OVER_EFFORT = 50.0, 50.0
_TURNS_RAD, _DEFLECTION_RAD, _CURRENT_A, _VOLTAGE_V = 1e4, 10.0, 200.0, 100.0
_GYRO_RAD_S, _ACCELERATION_M_S2 = 500.0, 5e4
_HOT_C = 400.0
_TIMES = 2
_IMU_T_NS = SensorSample._fields.index("imu_t_ns")
_IMU = tuple(k for k, name in enumerate(SensorSample._fields) if name.startswith(("gyro", "accel")))


class SampleCheck:
    """Checks the samples of one module; `fault` says what is wrong with its sensors now, "" for nothing."""

    def __init__(self, kind: ModuleType):
        speed, effort = _OVER_SPEED * kind.max_speed_rad_s, _OVER_EFFORT * kind.max_effort_nm
        motor = speed * kind.gear_ratio
        # In the order of a sample's fields from the position on.
        self.most = (
            *(_TURNS_RAD, speed, effort, _DEFLECTION_RAD, motor, _CURRENT_A, _HOT_C, _VOLTAGE_V),
            *(_GYRO_RAD_S,) * 3,
            *(_ACCELERATION_M_S2,) * 3,
            speed,
        )
        self._last = SensorSample(0, 0, *_at_rest())
        # Before the first good sample there is none to hold.
        self._held, self._owed = MAX_HELD, 0
        self.fault = ""

    @property
    def is_clean(self) -> bool:
        """Whether samples have been good for so long that a good one changes nothing but the last."""
        return not (self._held or self._owed)

    def go_on(self, last: SensorSample) -> None:
        """Take a sample as the last one, which was good."""
        self._last = last

    def checked(self, sample: SensorSample) -> SensorSample:
        """Return the sample, with the last good value in place of each bad one."""
        # A comparison with NaN is false.
        if self._earliest_imu_ns(sample) <= sample.imu_t_ns <= sample.t_ns and all(
            map(le, map(abs, sample[_TIMES:]), self.most)
        ):
            self._last, self._held, self._owed = sample, 0, max(self._owed - 1, 0)
            if self._owed <= MAX_OWED:
                self.fault = ""
            return sample
        return self._replaced(sample)

    def _earliest_imu_ns(self, sample: SensorSample) -> float:
        """Return the earliest possible time of the IMU: any one when the module's clock has gone back."""
        return self._last.imu_t_ns if sample.t_ns > self._last.t_ns else -math.inf

    def _replaced(self, sample: SensorSample) -> SensorSample:
        values = list(sample)
        self._owed += GOOD_PER_BAD
        if self._owed > MAX_OWED:
            self._owed = 2 * MAX_OWED
        is_fault = self._held >= MAX_HELD or self._owed > MAX_OWED
        earliest_ns = self._earliest_imu_ns(sample)
        if not earliest_ns <= sample.imu_t_ns <= sample.t_ns:
            for index in _IMU:
                values[index] = self._last[index]
            values[_IMU_T_NS] = min(self._last.imu_t_ns, sample.t_ns)
            if is_fault:
                self.fault = f"imu_t_ns reads {sample.imu_t_ns}, possible are {earliest_ns} .. {sample.t_ns}"
        for index, most in enumerate(self.most, start=_TIMES):
            if not abs(values[index]) <= most:
                values[index] = self._last[index]
                if is_fault:
                    name = SensorSample._fields[index]
                    self.fault = f"{name} reads {sample[index]:g}, possible are -{most:g} .. {most:g}"
        self._held += 1
        self._last = SensorSample(*values)  # type: ignore[arg-type]
        return self._last


def _at_rest() -> tuple[float, ...]:
    """Return the values, from the position on, that stand in for bad ones before there was a good sample."""
    winding = SensorSample._fields.index("winding_temperature_c") - _TIMES
    return tuple(AMBIENT_C if k == winding else 0.0 for k in range(len(SensorSample._fields) - _TIMES))
