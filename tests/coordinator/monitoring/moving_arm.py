"""Stretches of motion of an arm of three joints with white noise, whose bodies and sensors are known."""

import numpy as np
from numpy.random import Generator

from coordinator.batch_estimation.imu_intrinsics import perfect, read
from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.monitoring.residual_tests import ImuModel, catalogued_drive
from coordinator.monitoring.segments import Block, DataSegment
from module_agent.model.catalogue import module_type
from module_agent.model.chain import Array
from module_agent.model.imu_prior import IMU_PRIORS
from module_agent.model.regressor import inverse_dynamics
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain, true_inertia

ROBOT = load_robot("a2085_03")
CHAIN = true_chain(ROBOT)
PHI = true_inertia(ROBOT).reshape(-1)
JOINTS, RATE_HZ, SAMPLES = 3, 250.0, 125
KINDS = [module_type(one.type) for one in ROBOT.modules]
TORQUE_SIGMA, GYRO_SIGMA, ACCEL_SIGMA = 0.05, 0.01, 0.1
MODEL = ImuModel(
    CHAIN,
    tuple(KINDS),
    np.zeros(0),
    perfect(JOINTS),
    IMU_PRIORS["calibrated"],
    np.tile([GYRO_SIGMA] * 3 + [ACCEL_SIGMA] * 3, (JOINTS, 1)),
)


def segments(seed: int, count: int = 10) -> list[DataSegment]:
    """Return stretches of half a second of motions of all joints, with white noise; the robot is well."""
    rng = np.random.default_rng(seed)
    return [_segment(rng) for _ in range(count)]


def swings(
    samples: Array, start: Array, swing: Array, speed: Array, phase: Array
) -> tuple[Array, Array, Array]:
    """Return positions, velocities and accelerations (m, n) of joints that swing, at samples (m,)."""
    angle = samples[:, None] / RATE_HZ * speed + phase
    return (
        start + swing * np.sin(angle),
        swing * speed * np.cos(angle),
        -swing * speed**2 * np.sin(angle),
    )


def _segment(rng: Generator) -> DataSegment:
    speed, phase = rng.uniform(4.0, 8.0, JOINTS), rng.uniform(0.0, 6.28, JOINTS)
    start, swing = rng.uniform(-0.5, 0.5, JOINTS), rng.uniform(0.1, 0.3, JOINTS)
    q, qd, qdd = swings(np.arange(SAMPLES), start, swing, speed, phase)
    ideal = readings_on(CHAIN, body_motions(CHAIN, q, qd, qdd))
    gyro, accel = read(MODEL.intrinsics, ideal.gyro_rad_s, ideal.accel_m_s2, None)
    gyro, accel = (
        gyro + GYRO_SIGMA * rng.normal(size=gyro.shape),
        accel + ACCEL_SIGMA * rng.normal(size=accel.shape),
    )
    tau = inverse_dynamics(CHAIN, PHI, q, qd, qdd)
    motor = np.stack([kind.gear_ratio * rate for kind, rate in zip(KINDS, qd.T, strict=True)], axis=1)
    signs = np.sign(qd)
    drive = np.stack([_current(tau, qd, qdd), np.zeros_like(tau), signs * np.abs(tau), signs, motor], axis=2)
    drive = np.concatenate([drive, (qdd * motor / np.where(qd, qd, 1.0))[..., None]], axis=2)
    raw = Block(np.arange(SAMPLES), q, qd, tau, motor, drive[..., 0], gyro, accel)
    noisy = tau + TORQUE_SIGMA * rng.normal(size=tau.shape)
    rates, tau_rate = np.zeros((SAMPLES, JOINTS, 6)), np.gradient(tau, 0.004, axis=0)
    return DataSegment(raw, raw.t_ns, q, qd, qdd, noisy, tau_rate, gyro, accel, rates, drive)


def _current(tau: Array, qd: Array, qdd: Array) -> Array:
    """Return the currents with which the catalogue's motors drive these joints."""
    columns = []
    for joint, kind in enumerate(KINDS):
        c, _, coulomb, viscous, inertia, *_ = catalogued_drive(kind)
        torque = c * tau[:, joint] + coulomb * np.sign(qd[:, joint]) + viscous * qd[:, joint]
        torque += inertia * qdd[:, joint]
        columns.append(torque / (kind.gear_ratio * kind.motor.back_emf_v_s_rad * kind.motor.efficiency))
    return np.stack(columns, axis=1)
