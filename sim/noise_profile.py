"""How imperfect the sensors and clocks are: named profiles."""

from math import pi
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Amount = Annotated[float, Field(ge=0.0, le=1e3)]


class NoiseProfile(BaseModel):
    """Errors of one module's sensors as standard deviations; biases and clocks are drawn once per module.

    The IMU's white noise is that of an output rate of 250 Hz and grows with the square root of the rate. The
    effort's is a fraction of the type's largest effort.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    accel_white_m_s2: Amount = 0.0
    gyro_white_rad_s: Amount = 0.0
    accel_bias_m_s2: Amount = 0.0
    gyro_bias_rad_s: Amount = 0.0
    position_step_rad: Amount = 0.0
    velocity_white_rad_s: Amount = 0.0
    effort_white_fraction: Amount = 0.0
    clock_offset_min_s: Amount = 0.0
    clock_offset_max_s: Amount = 0.0
    clock_drift_ppm: Amount = 0.0


NOISE_PROFILES: dict[str, NoiseProfile] = {
    p.name: p
    for p in (
        NoiseProfile(name="ideal"),
        # White noise and biases as read from a real X5-1's log; the encoder counts 16 bit per turn.
        NoiseProfile(
            name="x5",
            accel_white_m_s2=0.023,
            gyro_white_rad_s=1.2e-3,
            accel_bias_m_s2=0.020,
            gyro_bias_rad_s=0.020,
            position_step_rad=2.0 * pi / 2**16,
            velocity_white_rad_s=5e-3,
            effort_white_fraction=0.002,
            clock_offset_min_s=1.0,
            clock_offset_max_s=100.0,
            clock_drift_ppm=20.0,
        ),
    )
}


def noise_profile(name: str) -> NoiseProfile:
    """Look up a profile by name.

    Raises:
        KeyError: unknown profile; the message lists the known ones.
    """
    if name not in NOISE_PROFILES:
        raise KeyError(f"unknown noise profile {name!r}; known are {', '.join(NOISE_PROFILES)}")
    return NOISE_PROFILES[name]
