"""The motion of a robot's bodies from encoders, link compliance and IMUs.

Encoders measure the joints alone, and where links are long their second derivative is mostly noise. The IMU
of the first module measures the base; the links turn under their load by the refined compliance; and the
residual of every other IMU is a motion of its own body.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from coordinator.batch_estimation.estimator import Refinement, with_placement
from coordinator.batch_estimation.imu_intrinsics import DELAY, undone
from coordinator.batch_estimation.imu_prediction import (
    BodyMotion,
    LinkTurns,
    acceleration_at,
    body_motions,
    given,
)
from coordinator.batch_estimation.link_compliance import estimated_turns
from coordinator.batch_estimation.sensor_data import NoiseFloor, SensorData, measured_base_motion
from coordinator.dynamics.body_regressor import BodyTrack, body_tracks
from coordinator.synchronisation.motion_windows import RATE_HZ, Window
from module_agent.model.catalogue import ModuleType, TorqueKind
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import cross
from module_agent.signals.filtering import differentiate, filtered_signals

MotionSource = Literal["encoders", "structure", "imus"]


class Robot(NamedTuple):
    """The robot whose inertia is to be identified.

    chain: n joints. kinds: (n,) their modules' types. refined: the refinement of links and IMUs. covariance:
    (6 n, 6 n) of the chain's perturbation. floor: noise at rest of the IMU on the base, None without one.
    torque: whether the torque sensors are calibrated.
    """

    chain: Chain
    kinds: Sequence[ModuleType]
    refined: Refinement
    covariance: Array
    floor: NoiseFloor | None
    torque: TorqueKind = "uncalibrated"


def readings(one: Window, refined: Refinement, cutoff_hz: float) -> SensorData:
    """Filter a window as `filtered_motion` does; correct its IMUs for their estimated errors and delays."""
    others = [one.gyro_rad_s, one.accel_m_s2]
    q, qd, qdd, (gyro, accel), kept = filtered_signals(one.q_rad, others, RATE_HZ, cutoff_hz)
    imus = refined.intrinsics
    late_s = (refined.late_s + imus.errors[:, DELAY])[:, None]
    gyro, accel = (signal + late_s * differentiate(signal, RATE_HZ) for signal in (gyro, accel))
    force = undone(imus.accel_matrix, accel - imus.accel_bias_m_s2)
    from_acceleration = np.einsum("nij,mnj->mni", imus.g_sensitivity_s_m, force)
    rate = undone(imus.gyro_matrix, gyro - imus.gyro_bias_rad_s - from_acceleration)
    q, qd, qdd, rate, force = (signal[kept] for signal in (q, qd, qdd, rate, force))
    return SensorData(q, qd, qdd, rate, force)


def body_motion_tracks(robot: Robot, measured: SensorData, imus: bool) -> list[BodyTrack]:
    """Return the motion of all bodies.

    Args:
        robot: n joints, with the refinement of links, hinges and IMUs.
        measured: one stretch of time without a gap.
        imus: whether the residuals of the IMUs are used too.
    """
    base, gyro, accel = None, measured.gyro_rad_s, measured.accel_m_s2
    if robot.floor is not None:
        base = measured_base_motion(gyro[:, 0], accel[:, 0], robot.floor, RATE_HZ)
    turns = estimated_turns(
        robot.chain, robot.kinds, robot.refined.compliance, measured.joints, RATE_HZ, base
    )
    bodies = body_motions(robot.chain, *measured.joints, base, turns)
    tracks = body_tracks(robot.chain, measured.q_rad, bodies, turns)
    if not imus:
        return tracks
    # Of several IMUs on a body the first counts.
    riders = {robot.chain.carrier(k): k for k in reversed(range(len(tracks)))}
    measuring = with_placement(robot.chain, robot.refined.placement)
    return [
        _corrected(measuring, bodies, turns, measured, track, riders[i]) if i in riders else track
        for i, track in enumerate(tracks)
    ]


def _corrected(
    chain: Chain,
    bodies: Sequence[BodyMotion],
    turns: LinkTurns,
    measured: SensorData,
    track: BodyTrack,
    rider: int,
) -> BodyTrack:
    """Return a track corrected by the residual of an IMU on the body; its mean is a bias of the IMU."""
    expected = bodies[chain.carrier(rider)]
    if not chain.reversed[rider]:
        expected = given(expected, turns.get(rider, ()))
    turn, place = chain.imu_home[rider, :3, :3], chain.imu_home[rider, :3, 3, None]
    rate = measured.gyro_rad_s[:, rider] - expected.omega.T @ turn
    force = measured.accel_m_s2[:, rider] - acceleration_at(expected, place).T @ turn
    rate, force = rate - rate.mean(axis=0), force - force.mean(axis=0)
    motion = track.motion
    omega = motion.omega + turn @ rate.T
    alpha = motion.alpha + turn @ differentiate(rate, RATE_HZ).T
    at_imu = acceleration_at(motion, place) + turn @ force.T
    arm = np.broadcast_to(place, omega.shape)
    acceleration = at_imu - cross(alpha, arm) - cross(omega, cross(omega, arm))
    return track._replace(motion=BodyMotion(omega, alpha, acceleration))
