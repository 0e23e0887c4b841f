"""Readings of all sensors of the modules from the true state: one sample per module and tick."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from module_agent.hardware.hardware import Readings
from module_agent.model.catalogue import ModuleType
from module_agent.model.compiled import compiled, compiled_with
from sim.geometry.pose import Array
from sim.imperfections.ageing import Ageing
from sim.imperfections.module_errors import SensorErrors, draw_sensor_errors, per_axis
from sim.imperfections.noise_profile import NoiseProfile
from sim.imperfections.random_streams import BLOCK, generator
from sim.sensors import imu, joint
from sim.sensors.imu import ImuArrays, Imus, follow_imus, read_imus
from sim.sensors.joint import JointArrays, JointSensors, read_joints
from sim.sensors.module_clock import ModuleClock, draw_clock

Integers = np.ndarray[Any, np.dtype[np.int64]]
NS_PER_S = 1_000_000_000


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


class SensorArrays(NamedTuple):
    """What the kernels know of the sensors of n modules.

    clocks (n, 2): offsets and drifts, see `ModuleClock`. imu_values (n, 6), imu_ns (n,): the last readings of
    the IMUs and their times. every_tick: whether the IMUs are followed between readings.
    """

    joint: JointArrays
    imu: ImuArrays
    clocks: Integers
    imu_values: Array
    imu_ns: Integers
    imu_ticks: int
    every_tick: bool


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
        noise = seed if noise_seed is None else noise_seed
        joints = JointSensors(noise, serials, types, profile, self.errors, tick_s)
        imus = Imus(noise, serials, types, profile, self.errors, tick_s, imu_ticks * tick_s)
        self._streams = (*joints.streams, *imus.streams)
        self.arrays = SensorArrays(
            joint=joints.arrays,
            imu=imus.arrays,
            clocks=np.array(self.clocks, dtype=np.int64),
            imu_values=np.zeros((len(types), 6)),
            imu_ns=np.zeros(len(types), dtype=np.int64),
            imu_ticks=imu_ticks,
            every_tick=imus.every_tick,
        )
        own = self.arrays
        self._built = own.imu.scale.copy(), own.imu.bias.copy(), own.joint.fixed.copy()

    def refill(self) -> None:
        """Draw the noise of the next ticks; kernels need it as soon as they are `used_up`."""
        for stream in self._streams:
            stream.refill()

    def age(self, module: int, ageing: Ageing) -> None:
        """Set the constants of one module's sensors to those that it was built with, and what was added."""
        imus, fixed = self.arrays.imu, self.arrays.joint.fixed
        scale, bias, row = self._built
        imus.scale[module] = scale[module] + per_axis(ageing.gyro_scale, ageing.accel_scale)
        imus.bias[module] = bias[module] + per_axis(ageing.gyro_bias_rad_s, ageing.accel_bias_m_s2)
        fixed[module, joint.EFFORT_SCALE] = row[module, joint.EFFORT_SCALE] + ageing.effort_scale
        fixed[module, joint.EFFORT_OFFSET] = row[module, joint.EFFORT_OFFSET] + ageing.effort_offset_nm
        fixed[module, joint.HALF_LOOP] = row[module, joint.HALF_LOOP] + ageing.hysteresis_nm / 2.0

    def read(self, tick: int, truth: Instant, readings: Readings) -> None:
        """Write one sample per module into `readings`. To be called once a tick, in order."""
        self.refill()
        if imus_due(self.arrays, tick):
            follow_imus(self.arrays.imu, truth.gyro_rad_s, truth.specific_force_m_s2)
        read_all(
            self.arrays,
            tick,
            truth.t_ns,
            truth.q_rad,
            truth.qd_rad_s,
            truth.motor_rad_s,
            truth.elastic_nm,
            truth.current_a,
            truth.winding_c,
            truth.voltage_v,
            readings.floats,
            readings.integers,
        )


@compiled_with(imu, joint)
def used_up(own: SensorArrays) -> bool:
    """Return whether the noise drawn in advance of some stream is used up."""
    joints, imus = own.joint, own.imu
    next_row = max(joints.noise.next[0], joints.jitter.next[0], imus.white.next[0])
    next_row = max(next_row, imus.vibration.next[0], imus.drifting.next[0], imus.jitter.next[0])
    return bool(next_row == BLOCK)


@compiled_with(imu, joint)
def imus_due(own: SensorArrays, tick: int) -> bool:
    """Return whether the IMUs are to be followed in this tick, with the truth of its instant."""
    return own.every_tick or tick % own.imu_ticks == 0


@compiled_with(imu, joint)
def read_all(
    own: SensorArrays,
    tick: int,
    t_ns: int,
    q: Array,
    qd: Array,
    motor_rad_s: Array,
    elastic_nm: Array,
    current_a: Array,
    winding_c: Array,
    voltage_v: float,
    floats: Array,
    integers: Integers,
) -> None:
    """Write samples (n, 17); arguments as in `Instant`, floats and integers as in `Readings`."""
    read_imu = tick % own.imu_ticks == 0
    if read_imu:
        read_imus(own.imu, motor_rad_s, own.imu_values)
    read_joints(own.joint, q, qd, motor_rad_s, elastic_nm, floats)
    for i in range(len(q)):
        now_ns = _module_time(own.clocks[i, 0], own.clocks[i, 1], t_ns)
        if read_imu:
            own.imu_ns[i] = now_ns
        integers[i, 0], integers[i, 1] = now_ns, own.imu_ns[i]
        floats[i, 7], floats[i, 8], floats[i, 9] = current_a[i], winding_c[i], voltage_v
        for k in range(6):
            floats[i, 10 + k] = own.imu_values[i, k]


@compiled
def _module_time(offset_ns: int, drift_ppb: int, world_ns: int) -> int:
    """Return `module_time`, whose products would not fit into 64 bits after some days."""
    seconds, rest_ns = world_ns // NS_PER_S, world_ns % NS_PER_S
    return offset_ns + world_ns + seconds * drift_ppb + rest_ns * drift_ppb // NS_PER_S
