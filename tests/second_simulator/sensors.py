"""What modules report of a motion: rows of feedback on clocks of their own.

An IMU reads y = (I + E) x + b, the gyro also a share of the specific force, late by a delay, with white
noise; x is pinocchio's rate and classical acceleration of the frame that the IMU has in the robot.
"""

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from module_agent.model.catalogue import ImuKind
from module_agent.wire.feedback_rows import ROW, STATE_NAMES, Rows
from tests.second_simulator.motion import RATE_HZ, Motion, torques
from tests.second_simulator.robot import Array, Robot

ROW_NS, NS = 4_000_000, 1e9
# White noise of an IMU at 250 Hz [rad/s, m/s^2], and its other errors, one standard deviation: scale and
# misalignment as delivered and as calibrated, bias of accelerometer, of gyro, and what the gyro reads of
# specific force [s/m].
WHITE = np.array([6e-4] * 3 + [0.011] * 3)
SCALE = {"uncalibrated": 0.01, "calibrated": 1e-4}
MISALIGNED_RAD = {"uncalibrated": np.radians(1.0), "calibrated": 1e-4}
ACCEL_BIAS_M_S2 = {"uncalibrated": 0.2, "calibrated": 0.02}
GYRO_BIAS_RAD_S, G_SENSITIVITY_S_M = 0.05, 1.8e-4
DELAY_S, DELAY_SIGMA_S, DELAY_SPREAD_S = 2.4e-3, 1.5e-3, 1e-4
ENCODER_STEP_RAD = 2.0 * np.pi / 2**16
VELOCITY_RAD_S, EFFORT_NM = 5e-3, 5e-3
CLOCK_OFFSET_S, CLOCK_DRIFT = (1.0, 100.0), 2e-5


class Clock(NamedTuple):
    """A module's clock: it shows offset_ns + (1 + drift) t at the session's time t."""

    offset_ns: int
    drift: float

    def module_ns(self, t_s: Any) -> Any:
        """Return what the clock shows, whole nanoseconds."""
        return self.offset_ns + np.round(NS * (1.0 + self.drift) * np.asarray(t_s)).astype(np.int64)

    def session_s(self, module_ns: Any) -> Array:
        """Return when the clock shows this."""
        return np.asarray(module_ns - self.offset_ns) / (NS * (1.0 + self.drift))


class Feedback(NamedTuple):
    """All rows of one module since its boot, and its clock."""

    clock: Clock
    rows: Rows


def feedback(robot: Robot, motion: Motion, seed: int, kind: ImuKind) -> list[Feedback]:
    """Return the rows of every module during a motion; noise and errors are of the seed."""
    late_s = abs(np.random.default_rng([seed, 3]).normal(DELAY_S, DELAY_SIGMA_S))
    return [
        _module(robot, motion, k, np.random.default_rng([seed, 4, k]), kind, late_s)
        for k in range(len(robot.serials))
    ]


def _module(
    robot: Robot, motion: Motion, k: int, rng: np.random.Generator, kind: ImuKind, late_s: float
) -> Feedback:
    clock = Clock(round(NS * rng.uniform(*CLOCK_OFFSET_S)), float(rng.normal(0.0, CLOCK_DRIFT)))
    first_ns = int(clock.module_ns(0.02)) + int(rng.integers(0, ROW_NS))
    t_ns = np.arange(first_ns, int(clock.module_ns(motion.end_s - 0.02)), ROW_NS, dtype=np.int64)
    imu_t_ns = t_ns - int(rng.integers(0, 1_000_000))
    t_s, read_s = clock.session_s(t_ns), clock.session_s(imu_t_ns)
    rows = np.zeros(len(t_ns), ROW)
    rows["t_ns"], rows["imu_t_ns"] = t_ns, imu_t_ns
    q, qd, _ = (signal[:, k] for signal in motion.at(t_s))
    rows["position_rad"] = ENCODER_STEP_RAD * np.round(q / ENCODER_STEP_RAD)
    rows["velocity_rad_s"] = qd + rng.normal(0.0, VELOCITY_RAD_S, len(q))
    rows["effort_nm"] = torques(robot, motion, t_s)[:, k] + rng.normal(0.0, EFFORT_NM, len(q))
    step = np.clip(np.round(t_s * RATE_HZ).astype(int), 0, len(motion.commands) - 1)
    rows["position_command_rad"] = motion.commands[step, k]
    rows["velocity_command_rad_s"] = rows["effort_command_nm"] = np.nan
    rows["winding_temperature_c"], rows["voltage_v"] = 30.0, 36.0
    rows["state"] = STATE_NAMES.index("armed")
    own_late_s = late_s + rng.normal(0.0, DELAY_SPREAD_S)
    readings = _imu(rng, ideal_readings(robot, motion, k, read_s - own_late_s), kind)
    rows["gyro_rad_s"], rows["accel_m_s2"] = readings[:, :3], readings[:, 3:]
    return Feedback(clock, rows)


def ideal_readings(robot: Robot, motion: Motion, k: int, t_s: Array) -> Array:
    """Return rate and specific force (m, 6) in the frame of a module's IMU."""
    model, data, frame = robot.model, robot.model.createData(), robot.imus[k]
    gravity, readings = model.gravity.linear, np.zeros((len(t_s), 6))
    for row, state in zip(readings, zip(*motion.at(t_s), strict=True), strict=True):
        pin.forwardKinematics(model, data, *state)
        turn = pin.updateFramePlacement(model, data, frame).rotation
        row[:3] = pin.getFrameVelocity(model, data, frame, pin.LOCAL).angular
        row[3:] = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL).linear - turn.T @ gravity
    return readings


def _imu(rng: np.random.Generator, ideal: Array, kind: ImuKind) -> Array:
    """Return the readings (m, 6) of an IMU whose errors are drawn as data sheets have them."""
    mixing = np.eye(6)
    for part in (slice(0, 3), slice(3, 6)):
        error = rng.normal(0.0, MISALIGNED_RAD[kind], (3, 3))
        np.fill_diagonal(error, rng.normal(0.0, SCALE[kind], 3))
        mixing[part, part] += error
    mixing[:3, 3:] = rng.normal(0.0, G_SENSITIVITY_S_M, (3, 3))
    bias = rng.normal(0.0, np.repeat([GYRO_BIAS_RAD_S, ACCEL_BIAS_M_S2[kind]], 3))
    return ideal @ mixing.T + bias + rng.normal(0.0, 1.0, ideal.shape) * WHITE
