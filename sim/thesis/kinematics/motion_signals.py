"""The signals of one trial, as the thesis shows them in figures 15, 16, 19 to 22, 27, 28 and 33 to 35."""

import numpy as np
from pydantic import BaseModel, ConfigDict

from coordinator.excitation.plan import Plan
from module_agent.estimate.gaussian_filter import gaussian_filter
from module_agent.estimate.windows import Array
from module_agent.model.imu_prior import IMU_PRIORS
from module_agent.wire.feedback_rows import Rows
from sim.imperfections.noise_profile import imu_kind
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import sensing_chain
from sim.scoring.chain_score import link_length_m
from sim.test_bench.one_joint_rig import IMU, JOINT, OneJointRig, analyse, regress
from sim.thesis.published import Alignment

Values = tuple[float, ...]
Vector = tuple[float, float, float]


class JointSignals(BaseModel):
    """A joint's motion from its own feedback rows, (n,) each: commanded, measured and differentiated."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    t_s: Values
    position_command_rad: Values
    velocity_command_rad_s: Values
    position_rad: Values
    velocity_rad_s: Values
    acceleration_rad_s2: Values
    filtered_rad_s2: Values


class ImuSignals(BaseModel):
    """The gyro's readings in its own frame, (n, 3), at `t_s` (n,)."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    t_s: Values
    gyro_rad_s: tuple[Vector, ...]


class TrialSignals(BaseModel):
    """One trial on one arm: its signals, and the directions and distances that follow from them.

    Directions are in the IMU's frame: `*_axis` of the joint, `tangent` and `radial` of the thesis' analysis.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    rest: ImuSignals
    constant: JointSignals
    constant_imu: ImuSignals
    sine: JointSignals
    velocity_clamp_rad_s: float
    true_axis: Vector
    thesis_axis: Vector
    our_axis: Vector
    tangent: Vector
    radial: Vector
    true_mm: float
    filtered_mm: float
    unfiltered_mm: float


def trial_signals(
    alignment: Alignment, length_mm: int, amplitude_rad: float, noise: NoiseChoice, seed: int
) -> TrialSignals:
    """Run one trial on the thesis' arm and return its signals.

    Raises:
        ExperimentFailed: a module refused a motion or broke it off.
        DataError: too little motion.
        KeyError, ValueError: no such noise profile or effect, no such robot.
    """
    robot = load_robot(f"thesis_{length_mm}_{alignment}")
    profile = noise.of(robot)
    with OneJointRig(robot, seed, profile) as rig:
        rows = rig.trial(Plan(sine_amplitude_rad=amplitude_rad))
        chain = sensing_chain(rig.world.robot)
        clamp_rad_s = rig.modules[JOINT].firmware.config.kind.velocity_clamp_rad_s
    fit = analyse(rows)
    true_axis = chain.imu_home[IMU, :3, :3].T @ chain.axis[JOINT]
    return TrialSignals(
        rest=_imu(rows.rest),
        constant=_joint(rows.constant.joint),
        constant_imu=_imu(rows.constant.imu),
        sine=_joint(rows.sine.joint),
        velocity_clamp_rad_s=clamp_rad_s,
        true_axis=_vector(true_axis),
        thesis_axis=_vector(fit.axis),
        our_axis=_vector(regress(rows, IMU_PRIORS[imu_kind(profile)]).axis),
        tangent=_vector(fit.tangent),
        radial=_vector(fit.radial_m / fit.distance_m),
        true_mm=1e3 * link_length_m(chain, child=IMU),
        filtered_mm=1e3 * fit.distance_m,
        unfiltered_mm=1e3 * analyse(rows, taps=1).distance_m,
    )


def _joint(rows: Rows) -> JointSignals:
    """Return the joint's signals while it was commanded."""
    own = rows[np.isfinite(rows["position_command_rad"])]
    t_s = 1e-9 * (own["t_ns"] - own["t_ns"][0]).astype(float)
    velocity = own["velocity_rad_s"].astype(float)
    acceleration = np.gradient(velocity, t_s)
    return JointSignals(
        t_s=_values(t_s),
        position_command_rad=_values(own["position_command_rad"]),
        velocity_command_rad_s=_values(np.nan_to_num(own["velocity_command_rad_s"])),
        position_rad=_values(own["position_rad"]),
        velocity_rad_s=_values(velocity),
        acceleration_rad_s2=_values(acceleration),
        filtered_rad_s2=_values(gaussian_filter(acceleration)),
    )


def _imu(rows: Rows) -> ImuSignals:
    times, first = np.unique(rows["imu_t_ns"], return_index=True)
    gyro = rows["gyro_rad_s"][first].astype(float)
    return ImuSignals(
        t_s=_values(1e-9 * (times - times[0]).astype(float)), gyro_rad_s=tuple(map(_vector, gyro))
    )


def _values(signal: Array) -> Values:
    # What JSON holds of a signal: six digits are finer than any sensor's step.
    return tuple(round(float(value), 6) for value in signal)


def _vector(direction: Array) -> Vector:
    x, y, z = (float(value) for value in direction)
    return x, y, z
