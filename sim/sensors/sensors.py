"""Readings of all sensors of the modules from the true state: one sample per module and tick."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from module_agent.hardware.hardware import Readings
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

    def read(self, tick: int, truth: Instant, readings: Readings) -> None:
        """Write one sample per module into `readings`. To be called once a tick, in order."""
        now = [module_time(clock, truth.t_ns) for clock in self.clocks]
        if self.imu_due(tick):
            self._imus.advance(truth.gyro_rad_s, truth.specific_force_m_s2)
        if tick % self._imu_ticks == 0:
            self._imu_values = self._imus.read(truth.motor_rad_s)
            self._imu_ns = now
        joint = self._joints.read(truth.q_rad, truth.qd_rad_s, truth.motor_rad_s, truth.elastic_nm)
        readings.integers[:, 0] = now
        readings.integers[:, 1] = self._imu_ns
        _fill(
            readings.floats,
            joint,
            self._gear,
            truth.current_a,
            truth.winding_c,
            truth.voltage_v,
            self._imu_values,
        )


@compiled
def _fill(
    readings: Array,
    joint: Array,
    gear: Array,
    current_a: Array,
    winding_c: Array,
    voltage_v: float,
    imu: Array,
) -> None:
    """Write the values of samples (n, 17), in the order of a sample's fields, but for its times."""
    for i in range(joint.shape[0]):
        for k in range(4):
            readings[i, 2 + k] = joint[i, k]
        readings[i, 6], readings[i, 16] = joint[i, 4] * gear[i], joint[i, 5]
        readings[i, 7], readings[i, 8], readings[i, 9] = current_a[i], winding_c[i], voltage_v
        for k in range(6):
            readings[i, 10 + k] = imu[i, k]
