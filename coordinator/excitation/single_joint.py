"""The slow and the fast motion of one joint that leave the radius of an IMU's circle least uncertain.

Every candidate within the joint's limits and the time budget has a predicted variance of the radius: that of
the noise (`fisher_information`), and the square of the bias by compliant links and bases, which grows with
the square of the frequency at any amplitude. So slow and wide motions win, until the noise dominates.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.excitation.fisher_information import CircleSetting, JointPath, SensorNoise, circle_covariance
from coordinator.excitation.joint_limits import JointLimits, NoExcitation
from module_agent.control.waveform import duration_s, minimum_jerk_duration_s, waveform
from module_agent.model.catalogue import GRAVITY_M_S2
from module_agent.model.imu_prior import ImuPrior
from module_agent.wire.messages import ConstantMotion, Pattern, WindowedSine

# Before anything has moved, a link is taken to be as long as a kit's tube.
LIKELY_RADIUS_M = 0.3
# Compliant links and bases lengthen the radius that a motion of frequency f shows by (f / f_g)^2: by 0.6 % at
# 1 Hz on the simulated arms. The refinement, which estimates compliances, leaves a tenth of that.
GIVE_HZ = 40.0
SWEEPS_RAD = (0.3, 0.45, 0.7, 1.0)
FREQUENCIES_HZ = (0.6, 0.8, 1.0, 1.4, 2.0)
# The surroundings are not known yet: motions of a joint stay small.
SINE_RAD = 0.25
SWEEP_SPEED_RAD_S = 1.0
# Ramps that begin slowly do not ring links and bases: a cycle of 0.8 Hz.
RAMP_S = 0.6
MIN_LEVEL_S = 0.1
# The thesis' window: 2.8 s to its middle with 1 s of spread.
SIGMA_SHARE = 1.0 / 2.8
MIN_PERIODS = 2.0
MAX_SINE_S = 8.0
# Samples that a prediction is made of. `SensorNoise` is that of 250 readings a second, which is averaged over
# as many; of other rates the density is the same.
RATE_HZ = 50.0
NOISE_RATE_HZ = 250.0


class JointTask(NamedTuple):
    """The joint to be explored, and the limits.

    along: component of the specific force of rest along the joint's axis, over its size: 1 if the axis is
        upright, 0 if it is level. Seen by the module's own IMU before anything moves.
    radius_m: of the circle that is to be measured best.
    budget_s: for going to where the slow motion begins, both motions, and settling.
    """

    limits: JointLimits
    along: float
    prior: ImuPrior
    home_rad: float
    travel_speed_rad_s: float
    settle_s: float
    budget_s: float
    radius_m: float = LIKELY_RADIUS_M


class JointMotions(NamedTuple):
    """A slow motion through home and a fast one about it, their duration and the predicted errors.

    sigma_m: of the radius by the sensors' noise and errors. give_m: its bias by compliant links.
    """

    constant: ConstantMotion
    sine: WindowedSine
    time_s: float
    sigma_m: float
    give_m: float

    @property
    def error_m(self) -> float:
        """Both together."""
        return float(np.hypot(self.sigma_m, self.give_m))


def design_joint(task: JointTask, constant: ConstantMotion | None = None) -> JointMotions:
    """Return the motions that leave the radius least uncertain; the slow one is `constant`, if it is given.

    Raises:
        NoExcitation: nothing fits into range, limits and time, with all three.
    """
    slow = [constant] if constant is not None else _sweeps(task)
    candidates = [
        JointMotions(
            one,
            sine,
            _other_s(task, one) + 2.0 * sine.centre_s,
            predicted_sigma_m(task, [one, sine]),
            task.radius_m * (sine.frequency_hz / GIVE_HZ) ** 2,
        )
        for one in slow
        for sine in _sines(task, task.budget_s - _other_s(task, one))
    ]
    if not candidates:
        raise NoExcitation(
            f"no motion fits: {task.budget_s:.1f} s, {task.limits.room_rad(task.home_rad):.2f} rad to either "
            f"side, at most {task.limits.speed_rad_s:.2f} rad/s and {task.limits.accel_rad_s2:.2f} rad/s^2"
        )
    return min(candidates, key=lambda motions: motions.error_m)


def next_sine(task: JointTask, done: Sequence[Pattern], lasting_s: float) -> WindowedSine | None:
    """Return the fast motion that adds most information to those done; None if none fits."""
    candidates = _sines(task, lasting_s)
    return min(candidates, key=lambda sine: predicted_sigma_m(task, [*done, sine]), default=None)


def predicted_sigma_m(task: JointTask, patterns: Sequence[Pattern]) -> float:
    """Return the sigma of the radius after all these motions, each begun at home or through it.

    Where on its circle gravity finds the IMU is not known: the mean variance of two places a quarter apart.
    """
    paths = [_path(pattern) for pattern in patterns]
    fewer = np.sqrt(RATE_HZ / NOISE_RATE_HZ)
    noise = SensorNoise(*(sigma * fewer for sigma in SensorNoise()))
    variances = [circle_covariance(s, paths, noise, task.prior)[0, 0] for s in _settings(task)]
    return float(np.sqrt(np.mean(variances)))


def _settings(task: JointTask) -> list[CircleSetting]:
    up = np.clip(task.along, -1.0, 1.0)
    level = np.sqrt(1.0 - up**2)
    axis, radial = np.array([0.0, 0.0, 1.0]), np.array([task.radius_m, 0.0, 0.0])
    return [
        CircleSetting(
            axis, radial, GRAVITY_M_S2 * np.array([level * np.cos(phase), level * np.sin(phase), up])
        )
        for phase in (0.0, 0.5 * np.pi)
    ]


def _path(pattern: Pattern) -> JointPath:
    t_s = np.arange(0.0, duration_s(pattern, 0.0), 1.0 / RATE_HZ)
    wave = waveform(pattern, 0.0, t_s)
    # A slow motion passes home in its middle.
    middle = 0.5 * (wave.offset_rad[0] + wave.offset_rad[-1])
    acceleration = np.gradient(wave.velocity_rad_s, t_s)
    return JointPath(wave.offset_rad - middle, wave.velocity_rad_s, acceleration, RATE_HZ)


def _sweeps(task: JointTask) -> list[ConstantMotion]:
    limits, sweeps = task.limits, []
    for sweep_rad in SWEEPS_RAD:
        longest = 2.0 * sweep_rad / (RAMP_S + MIN_LEVEL_S)
        speed = min(SWEEP_SPEED_RAD_S, limits.speed_rad_s, limits.accel_rad_s2 * RAMP_S, longest)
        if sweep_rad > limits.room_rad(task.home_rad) or speed <= 0.0:
            continue
        level_s = 2.0 * sweep_rad / speed - RAMP_S
        if level_s < 60.0:
            sweeps.append(ConstantMotion(velocity_rad_s=speed, duration_s=level_s, ramp_s=RAMP_S))
    return sweeps


def _other_s(task: JointTask, constant: ConstantMotion) -> float:
    """Return how long going to the slow motion's start, it, going home and settling twice take."""
    travel_rad = 0.5 * constant.velocity_rad_s * (constant.duration_s + constant.ramp_s)
    journey_s = minimum_jerk_duration_s(travel_rad, task.travel_speed_rad_s)
    return duration_s(constant, 0.0) + 2.0 * (journey_s + task.settle_s)


def _sines(task: JointTask, lasting_s: float) -> list[WindowedSine]:
    room, half_s = task.limits.room_rad(task.home_rad), 0.5 * min(lasting_s, MAX_SINE_S)
    sines = []
    for frequency_hz in FREQUENCIES_HZ:
        if 2.0 * half_s < MIN_PERIODS / frequency_hz or room <= 0.0:
            continue
        full = WindowedSine(
            amplitude=min(SINE_RAD, room),
            frequency_hz=frequency_hz,
            centre_s=half_s,
            sigma_s=half_s * SIGMA_SHARE,
        )
        scale = task.limits.fitting_scale(full)
        if scale > 0.0:
            sines.append(full.model_copy(update={"amplitude": scale * full.amplitude}))
    return sines
