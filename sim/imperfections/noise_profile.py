"""Sizes of all imperfections of a simulated robot, and the named profiles.

A size of zero switches an imperfection off. The table of `sim.imperfections.effects` groups the sizes into
effects, with their sources and their switches on the command line.
"""

from math import pi, radians
from typing import Annotated

from pydantic import Field

from module_agent.model.catalogue import ImuKind
from module_agent.model.errors import UsageError
from module_agent.model.suggestion import did_you_mean
from sim.geometry.link_parts import Strict
from sim.imperfections.effects import EFFECTS, Effect

Amount = Annotated[float, Field(ge=0.0, le=1e4)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
STANDARD_GRAVITY_M_S2 = 9.80665


class NoiseProfile(Strict):
    """The sizes of all imperfections: standard deviations unless noted, constants drawn per module.

    Sensors: the IMU's white noise is that of an output rate of 250 Hz and grows with the square root of the
    rate. Biases wander around their drawn value as a Gauss-Markov process of the given sigma and correlation
    time. imu_bandwidth_hz is the corner of a low-pass that runs at the world's 1 kHz. Vibration is the extra
    noise of accelerometer and gyro at the type's full speed. The effort's errors are fractions of the type's
    largest effort, its scale error is relative; effort_hysteresis_fraction is the whole width of the loop.
    sampling_jitter_s is first order, and so at most a fifth of a tick. Both bandwidths of speeds belong to
    first-order low-passes.

    Actuators: friction, gear_loss and heat multiply the catalogue's figures (1 = as catalogued, 0 = none).
    The spreads are relative differences between modules of a type. spring_stiffening is the share of the
    spring that is of the stiffening kind (0 = linear, 1 = as in modules made since 2019).

    Modules: how each differs from its type's entry in the catalogue; body_mass is relative.

    Structure: base_shake and link_flex multiply the compliance of the robot's base and links (1 = as
    described by the robot file, 0 = rigid).
    """

    name: str
    # IMU
    accel_white_m_s2: Amount = 0.0
    gyro_white_rad_s: Amount = 0.0
    accel_bias_m_s2: Amount = 0.0
    gyro_bias_rad_s: Amount = 0.0
    accel_drift_m_s2: Amount = 0.0
    gyro_drift_rad_s: Amount = 0.0
    drift_time_s: Amount = 0.0
    accel_scale: Amount = 0.0
    gyro_scale: Amount = 0.0
    imu_misalignment_rad: Amount = 0.0
    imu_skew_rad: Amount = 0.0
    gyro_g_sensitivity_s_m: Amount = 0.0
    imu_bandwidth_hz: Annotated[float, Field(ge=0.0, le=450.0)] = 0.0
    accel_range_m_s2: Amount = 0.0
    gyro_range_rad_s: Amount = 0.0
    accel_step_m_s2: Amount = 0.0
    gyro_step_rad_s: Amount = 0.0
    vibration_m_s2: Amount = 0.0
    vibration_rad_s: Amount = 0.0
    # encoder and torque sensor
    position_step_rad: Amount = 0.0
    velocity_white_rad_s: Amount = 0.0
    velocity_bandwidth_hz: Amount = 0.0
    motor_velocity_bandwidth_hz: Amount = 0.0
    effort_white_fraction: Amount = 0.0
    effort_offset_fraction: Amount = 0.0
    effort_scale: Amount = 0.0
    effort_hysteresis_fraction: Annotated[float, Field(ge=0.0, le=0.05)] = 0.0
    # clock
    clock_offset_min_s: Amount = 0.0
    clock_offset_max_s: Amount = 0.0
    clock_drift_ppm: Amount = 0.0
    sampling_jitter_s: Annotated[float, Field(ge=0.0, le=2e-4)] = 0.0
    # actuator
    friction: Amount = 0.0
    gear_loss: Amount = 0.0
    heat: Amount = 0.0
    friction_spread: Share = 0.0
    motor_spread: Share = 0.0
    spring_spread: Share = 0.0
    backlash_rad: Amount = 0.0
    spring_stiffening: Share = 0.0
    # module
    imu_place_m: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    imu_mounting_rad: Amount = 0.0
    body_mass: Annotated[float, Field(ge=0.0, le=0.2)] = 0.0
    body_centre_m: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    housing_axis_m: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    housing_axis_rad: Amount = 0.0
    # structure
    base_shake: Amount = 0.0
    link_flex: Amount = 0.0


_BODY = ("friction", "gear-loss", "heat", "base-shake", "link-flex")
_BUILT = ("imu-place", "imu-mounting", "body-mass", "body-centre", "housing-axis")
_X5 = (
    *_BODY,
    *_BUILT,
    *("variation", "imu-white", "imu-bias", "imu-drift", "g-sensitivity", "imu-bandwidth", "imu-range"),
    *("imu-steps", "vibration", "encoder", "velocity-estimate", "torque-noise", "clock", "sampling-jitter"),
)
_UNCALIBRATED = (*_X5, "imu-scale", "imu-misalignment", "torque-calibration", "torque-hysteresis")


def _profile(name: str, effects: tuple[str, ...], **sizes: float) -> NoiseProfile:
    typical = {field: size for effect in effects for field, size in EFFECTS[effect].sizes.items()}
    return NoiseProfile(name=name, **(typical | sizes))


NOISE_PROFILES: dict[str, NoiseProfile] = {
    p.name: p
    for p in (
        # Perfect sensors on a rigid robot; its motors still have friction and get warm.
        _profile("ideal", ("friction", "gear-loss", "heat")),
        # A calibrated IMU: noise, biases and resolution as in a real X5-1's log and in data sheets.
        _profile("x5", _X5),
        # As delivered.
        _profile("x5-uncalibrated", _UNCALIBRATED, accel_bias_m_s2=0.020 * STANDARD_GRAVITY_M_S2),
        # Everything at once, and about three times as large.
        _profile(
            "poor",
            tuple(EFFECTS),
            accel_white_m_s2=0.035,
            gyro_white_rad_s=2e-3,
            accel_bias_m_s2=0.050 * STANDARD_GRAVITY_M_S2,
            gyro_bias_rad_s=0.080,
            accel_scale=0.03,
            gyro_scale=0.03,
            imu_misalignment_rad=radians(2.0),
            imu_skew_rad=0.01,
            vibration_m_s2=0.14,
            vibration_rad_s=6e-3,
            position_step_rad=2.0 * pi / 2**14,
            velocity_white_rad_s=0.015,
            effort_white_fraction=0.006,
            effort_scale=0.05,
            effort_hysteresis_fraction=0.015,
            clock_drift_ppm=100.0,
        ),
    )
}
DEFAULT_PROFILE = "x5-uncalibrated"


def noise_profile(name: str) -> NoiseProfile:
    """Look up a profile by name.

    Raises:
        UsageError: unknown profile; the message lists the known ones.
    """
    if name not in NOISE_PROFILES:
        raise UsageError(f"unknown noise profile {name!r}; known are {', '.join(NOISE_PROFILES)}")
    return NOISE_PROFILES[name]


def switched(profile: NoiseProfile, on: tuple[str, ...] = (), off: tuple[str, ...] = ()) -> NoiseProfile:
    """Return a profile with some effects switched on at their typical size, and others off.

    An effect that the profile has already keeps its size there.

    Raises:
        UsageError: unknown effect, or one that is switched both on and off.
    """
    if both := [name for name in on if name in off]:
        raise UsageError(f"effect {both[0]!r} is switched both on and off")
    sizes: dict[str, float] = {}
    for effect in map(_effect, on):
        if not any(getattr(profile, field) for field in effect.sizes):
            sizes |= effect.sizes
    for effect in map(_effect, off):
        sizes |= dict.fromkeys(effect.sizes, 0.0)
    return profile.model_copy(update=sizes)


def _effect(name: str) -> Effect:
    if name not in EFFECTS:
        raise UsageError(
            f"unknown effect {name!r}{did_you_mean(name, EFFECTS)}; known are {', '.join(EFFECTS)}"
        )
    return EFFECTS[name]


def imu_kind(noise: NoiseProfile) -> ImuKind:
    """Return the kind of IMU prior that fits a profile."""
    wrong = noise.accel_scale or noise.gyro_scale or noise.imu_misalignment_rad
    return "uncalibrated" if wrong else "calibrated"
