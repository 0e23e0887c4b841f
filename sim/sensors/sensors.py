"""Readings of all sensors of the modules from the true state: one `SensorSample` per module and tick."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from module_agent.hardware.hardware import SensorSample
from module_agent.model.catalogue import ModuleType
from module_agent.model.compiled import compiled
from sim.geometry.pose import Array
from sim.imperfections.module_errors import SensorErrors, draw_sensor_errors
from sim.imperfections.noise_profile import NoiseProfile
from sim.imperfections.random_streams import generator
from sim.sensors.imu import Imus
from sim.sensors.joint import JointSensors
from sim.sensors.module_clock import ModuleClock, draw_clock, module_time


class Instant(NamedTuple):
    """The truth at one instant, arrays (n,) or (n, 3); read only.

    motor_rad_s is seen at the output, as motor positions are; elastic_nm is what the spring's elasticity
    exerts on the output. gyro_rad_s and specific_force_m_s2 are in IMU axes; they are those of an earlier
    instant where the IMU is not due.
    """

    t_ns: int
    q_rad: Array
    qd_rad_s: Array
    motor_rad_s: Array
    elastic_nm: Array
    current_a: Array
    winding_c: Array
    voltage_v: float
    gyro_rad_s: Array
    specific_force_m_s2: Array


class Sensors:
    """The sensors and clocks of n modules under one profile.

    The IMU is read every `imu_ticks` ticks; in between its last values are repeated with their own time.
    Sampling jitter moves a reading off its stamp, to first order and never the stamp itself, so the stamps of
    successive ticks stay a tick of the module's clock apart. A module's constants are drawn from `seed`, its
    noise from `noise_seed` (by default the same number).
    """

    def __init__(
        self,
        seed: int,
        serials: Sequence[str],
        types: Sequence[ModuleType],
        profile: NoiseProfile,
        imu_ticks: int,
        tick_s: float,
        noise_seed: int | None = None,
    ):
        self.clocks: tuple[ModuleClock, ...] = tuple(
            draw_clock(generator(seed, s, "clock"), profile) for s in serials
        )
        self.errors: SensorErrors = draw_sensor_errors(seed, serials, types, profile)
        self._imu_ticks = imu_ticks
        self._gear = np.array([t.gear_ratio for t in types])
        noise = seed if noise_seed is None else noise_seed
        self._joints = JointSensors(noise, serials, types, profile, self.errors, tick_s)
        self._imus = Imus(noise, serials, types, profile, self.errors, tick_s, imu_ticks * tick_s)
        self._imu_values = np.zeros((len(types), 6))
        self._imu_ns = [0] * len(types)

    def imu_due(self, tick: int) -> bool:
        """Whether `read` at this tick needs the IMU's truth of this instant."""
        return self._imus.every_tick or tick % self._imu_ticks == 0

    def read(self, tick: int, truth: Instant) -> list[SensorSample]:
        """Return one sample per module. To be called once a tick, in order."""
        now = [module_time(clock, truth.t_ns) for clock in self.clocks]
        if self.imu_due(tick):
            self._imus.advance(truth.gyro_rad_s, truth.specific_force_m_s2)
        if tick % self._imu_ticks == 0:
            self._imu_values = self._imus.read(truth.motor_rad_s)
            self._imu_ns = now
        joint = self._joints.read(truth.q_rad, truth.qd_rad_s, truth.motor_rad_s, truth.elastic_nm)
        rows = _rows(
            joint, self._gear, truth.current_a, truth.winding_c, truth.voltage_v, self._imu_values
        ).tolist()
        # As SensorSample(t, imu, *row), at half the time.
        make = tuple.__new__
        return [
            make(SensorSample, (t, imu, *row)) for t, imu, row in zip(now, self._imu_ns, rows, strict=True)
        ]


@compiled
def _rows(
    joint: Array, gear: Array, current_a: Array, winding_c: Array, voltage_v: float, imu: Array
) -> Array:
    """Return the values of samples (n, 15), in the order of a sample's fields after its times."""
    values = np.empty((joint.shape[0], 15))
    for i in range(joint.shape[0]):
        for k in range(4):
            values[i, k] = joint[i, k]
        values[i, 4], values[i, 14] = joint[i, 4] * gear[i], joint[i, 5]
        values[i, 5], values[i, 6], values[i, 7] = current_a[i], winding_c[i], voltage_v
        for k in range(6):
            values[i, 8 + k] = imu[i, k]
    return values
