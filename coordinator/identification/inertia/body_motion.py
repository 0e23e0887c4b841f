"""What the bodies of a robot do while joints move, as far as IMUs and the structure's springs tell.

Encoders see the joints alone, and their second derivative is noise for the most part where links are long.
The IMU of the first module sees the base; the links turn under what they carry as the refinement has found;
and what every other IMU reads beyond that is its body's own.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from coordinator.batch_estimation.estimator import Refinement
from coordinator.batch_estimation.imu_intrinsics import DELAY
from coordinator.batch_estimation.imu_prediction import (
    BodyMotion,
    LinkTurns,
    acceleration_at,
    body_motions,
    given,
)
from coordinator.batch_estimation.link_compliance import link_loads, turns_under, with_hinges_moved
from coordinator.batch_estimation.sensor_data import BaseMotion, NoiseFloor, outstanding
from coordinator.dynamics.body_regressor import BodyTrack, body_tracks
from coordinator.synchronisation.motion_windows import RATE_HZ, Window
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import cross
from module_agent.signals.filtering import differentiate, filtered_signals

MotionSource = Literal["encoders", "structure", "imus"]

# What gives is a load itself: the second round changes the turns by a percent.
_ROUNDS = 2


class Readings(NamedTuple):
    """One stretch of time, all through the same low-pass; joints (m, n), and IMUs (m, n, 3).

    The IMUs' known errors and delays are taken off.
    """

    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    gyro_rad_s: Array
    accel_m_s2: Array


def readings(one: Window, refined: Refinement, cutoff_hz: float) -> Readings:
    """Filter a window as `filtering.filtered_motion` does, and correct its IMUs by what they err."""
    others = [one.gyro_rad_s, one.accel_m_s2]
    q, qd, qdd, (gyro, accel), kept = filtered_signals(one.q_rad, others, RATE_HZ, cutoff_hz)
    imus = refined.intrinsics
    late_s = (refined.late_s + imus.errors[:, DELAY])[:, None]
    gyro, accel = (signal + late_s * differentiate(signal, RATE_HZ) for signal in (gyro, accel))
    force = _undone(imus.accel_matrix, accel - imus.accel_bias_m_s2)
    felt = np.einsum("nij,mnj->mni", imus.g_sensitivity_s_m, force)
    rate = _undone(imus.gyro_matrix, gyro - imus.gyro_bias_rad_s - felt)
    return Readings(*(signal[kept] for signal in (q, qd, qdd, rate, force)))


def body_motion_tracks(
    chain: Chain,
    kinds: Sequence[ModuleType],
    refined: Refinement,
    floor: NoiseFloor | None,
    seen: Readings,
    imus: bool,
) -> list[BodyTrack]:
    """Return how all bodies moved.

    Args:
        chain: n joints. kinds: their modules' types.
        refined: what the refinement of this robot has found of links, hinges and IMUs.
        floor: noise of the IMU that rides on the base; None if none does.
        seen: one stretch of time without a gap.
        imus: whether what the IMUs read beyond base and links is taken too.
    """
    joints = seen.q_rad, seen.qd_rad_s, seen.qdd_rad_s2
    base = None if floor is None else _base(seen, floor)
    turns = _turns(chain, kinds, refined, joints, base)
    bodies = body_motions(chain, *joints, base, turns)
    tracks = body_tracks(chain, seen.q_rad, bodies, turns)
    if not imus:
        return tracks
    return [
        track
        if (rider := _rider(chain, i)) is None
        else _corrected(chain=chain, bodies=bodies, turns=turns, seen=seen, track=track, rider=rider)
        for i, track in enumerate(tracks)
    ]


def _undone(matrix: Array, read: Array) -> Array:
    return np.asarray(np.einsum("nij,mnj->mni", np.linalg.inv(matrix), read))


def _base(seen: Readings, floor: NoiseFloor) -> BaseMotion:
    omega = outstanding(seen.gyro_rad_s[:, 0], floor.gyro, floor.cutoff_hz, RATE_HZ)
    force = outstanding(seen.accel_m_s2[:, 0], floor.accel, floor.cutoff_hz, RATE_HZ)
    return BaseMotion(omega, differentiate(omega, RATE_HZ), force)


def _turns(
    chain: Chain,
    kinds: Sequence[ModuleType],
    refined: Refinement,
    joints: tuple[Array, Array, Array],
    base: BaseMotion | None,
) -> LinkTurns:
    """Return how links turn; without any if the refinement has not looked for what gives."""
    links = list(chain.linked)
    turns: LinkTurns = {}
    if len(refined.compliance) != 5 * len(links):
        return turns
    compliance, hinges = np.split(refined.compliance, [2 * len(links)])
    for _ in range(_ROUNDS):
        bodies = body_motions(chain, *joints, base, turns)
        loads = link_loads(
            chain=chain, kinds=kinds, bodies=bodies, q_rad=joints[0], rate_hz=RATE_HZ, turns=turns
        )
        turns = turns_under(with_hinges_moved([loads], links, hinges)[0], links, compliance)
    return turns


def _rider(chain: Chain, body: int) -> int | None:
    """Return the module whose IMU rides on a body, None if none does."""
    return next((k for k in range(len(chain.serials)) if chain.carrier(k) == body), None)


def _corrected(
    chain: Chain,
    bodies: Sequence[BodyMotion],
    turns: LinkTurns,
    seen: Readings,
    track: BodyTrack,
    rider: int,
) -> BodyTrack:
    """Return a track with what an IMU on the body reads beyond it; means are the IMU's, not the body's."""
    expected = bodies[chain.carrier(rider)]
    if not chain.reversed[rider]:
        expected = given(expected, turns.get(rider, ()))
    turn, place = chain.imu_home[rider, :3, :3], chain.imu_home[rider, :3, 3, None]
    rate = seen.gyro_rad_s[:, rider] - expected.omega.T @ turn
    force = seen.accel_m_s2[:, rider] - acceleration_at(expected, place).T @ turn
    rate, force = rate - rate.mean(axis=0), force - force.mean(axis=0)
    motion = track.motion
    omega = motion.omega + turn @ rate.T
    alpha = motion.alpha + turn @ differentiate(rate, RATE_HZ).T
    at_imu = acceleration_at(motion, place) + turn @ force.T
    arm = np.broadcast_to(place, omega.shape)
    acceleration = at_imu - cross(alpha, arm) - cross(omega, cross(omega, arm))
    return track._replace(motion=BodyMotion(omega, alpha, acceleration))
