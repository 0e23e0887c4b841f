"""The table of what the simulated module does as a real one: effect, model, typical size, source, switch.

The same table is `docs` in the README, the switches `--with` and `--without` of the command line, and the
material of the named profiles.
"""

from collections.abc import Mapping
from math import pi, radians
from typing import Literal, NamedTuple

Part = Literal["actuator", "IMU", "encoder and torque", "clock", "structure"]


class Effect(NamedTuple):
    """One effect: its switch's name, what the model is, its typical sizes by profile field, their source."""

    name: str
    part: Part
    model: str
    sizes: Mapping[str, float]
    source: str


_TABLE = (
    Effect(
        "friction",
        "actuator",
        "Coulomb and viscous friction at the motor, sticking when at rest",
        {"friction": 1.0},
        "real X5-1 log: 0.076 Nm + 0.017 Nm s/rad at the output; other types scaled by gear ratio",
    ),
    Effect(
        "gear-loss",
        "actuator",
        "a friction that grows with the torque transmitted",
        {"gear_loss": 1.0},
        "published efficiency 0.65",
    ),
    Effect(
        "heat",
        "actuator",
        "winding, housing and body as three heat capacities; copper's resistance grows with temperature",
        {"heat": 1.0},
        "published thermal constants; copper 0.393 %/K",
    ),
    Effect(
        "variation",
        "actuator",
        "every module's friction, motor and spring differ from its type's",
        {"friction_spread": 0.15, "motor_spread": 0.03, "spring_spread": 0.05},
        "thesis 6.1; resistance 8.9-10.1 ohm in a real X5-1 log",
    ),
    Effect(
        "backlash",
        "actuator",
        "a gap between motor and spring",
        {"backlash_rad": radians(0.1)},
        "an assumption: the X5's backlash is not published",
    ),
    Effect(
        "stiffening-spring",
        "actuator",
        "stiffness grows from a third near zero to several times at full load",
        {"spring_stiffening": 1.0},
        "published for modules since 2019: 30-70 Nm/rad rising to 300-1000",
    ),
    Effect(
        "imu-white",
        "IMU",
        "white noise on all axes, growing with the square root of the output rate",
        {"accel_white_m_s2": 0.023, "gyro_white_rad_s": 1.2e-3},
        "real X5-1 log at 100 Hz",
    ),
    Effect(
        "imu-bias",
        "IMU",
        "constant offset per axis",
        {"accel_bias_m_s2": 0.020, "gyro_bias_rad_s": 0.020},
        "real X5-1 log: gyro 9-43 mrad/s; accelerometer 2 mg after calibration",
    ),
    Effect(
        "imu-drift",
        "IMU",
        "first-order Gauss-Markov wandering of the biases",
        {"accel_drift_m_s2": 4e-4, "gyro_drift_rad_s": 5e-5, "drift_time_s": 100.0},
        "data sheets of the class",
    ),
    Effect(
        "imu-scale",
        "IMU",
        "scale error per axis",
        {"accel_scale": 0.01, "gyro_scale": 0.01},
        "data sheets of the class: 0.5-3 %",
    ),
    Effect(
        "imu-misalignment",
        "IMU",
        "a rotation of each sensor's axes against the housing",
        {"imu_misalignment_rad": radians(1.0)},
        "data sheets of the class",
    ),
    Effect(
        "g-sensitivity",
        "IMU",
        "the gyro reads part of the specific force",
        {"gyro_g_sensitivity_s_m": 1.8e-4},
        "data sheets of the class: 0.1 deg/s/g",
    ),
    Effect(
        "imu-bandwidth",
        "IMU",
        "second-order low-pass before sampling, the same for all axes",
        {"imu_bandwidth_hz": 92.0},
        "data sheets of the class: the filter setting below half of 250 Hz",
    ),
    Effect(
        "imu-range",
        "IMU",
        "readings saturate",
        {"accel_range_m_s2": 8.0 * 9.80665, "gyro_range_rad_s": radians(2000.0)},
        "data sheets of the class: 8 g, 2000 deg/s",
    ),
    Effect(
        "imu-steps",
        "IMU",
        "16 bit readings",
        {"accel_step_m_s2": 8.0 * 9.80665 / 2**15, "gyro_step_rad_s": radians(2000.0) / 2**15},
        "data sheets of the class: 16 bit over the range",
    ),
    Effect(
        "vibration",
        "IMU",
        "accelerometer noise that grows with the speed of the module's own gears; older modules three times",
        {"vibration_m_s2": 0.05},
        "thesis 6.1: older modules are more prone to vibration noise",
    ),
    Effect(
        "encoder",
        "encoder and torque",
        "position in steps of one count",
        {"position_step_rad": 2.0 * pi / 2**16},
        "real X5-1 log",
    ),
    Effect(
        "velocity-estimate",
        "encoder and torque",
        "the module's own: a first-order low-pass of the motor's speed, with noise",
        {"velocity_white_rad_s": 5e-3, "velocity_bandwidth_hz": 100.0},
        "real X5-1 log",
    ),
    Effect(
        "torque-noise",
        "encoder and torque",
        "white noise on the torque read from the spring, as a fraction of the largest",
        {"effort_white_fraction": 0.002},
        "real X5-1 log",
    ),
    Effect(
        "torque-calibration",
        "encoder and torque",
        "offset, as a fraction of the largest torque, and scale error of the torque sensor",
        {"effort_offset_fraction": 0.005, "effort_scale": 0.02},
        "thesis 6.3: measured and calculated torque differ",
    ),
    Effect(
        "torque-hysteresis",
        "encoder and torque",
        "the spring's inner friction: a Dahl element in parallel",
        {"effort_hysteresis_fraction": 0.005},
        "rubber in the spring",
    ),
    Effect(
        "clock",
        "clock",
        "started at some time before, runs fast or slow",
        {"clock_offset_min_s": 1.0, "clock_offset_max_s": 100.0, "clock_drift_ppm": 20.0},
        "data sheets of quartz oscillators",
    ),
    Effect(
        "sampling-jitter",
        "clock",
        "a reading is taken a little before or after its time stamp",
        {"sampling_jitter_s": 2e-5},
        "real X5-1 log",
    ),
    Effect(
        "base-shake",
        "structure",
        "the base gives as the robot file says: stiffness and damping in six directions",
        {"base_shake": 1.0},
        "thesis 6.1, figures 17 and 18",
    ),
    Effect(
        "link-flex",
        "structure",
        "links bend and twist about where they are held",
        {"link_flex": 1.0},
        "beam theory, tubes as drawn",
    ),
)

EFFECTS: dict[str, Effect] = {effect.name: effect for effect in _TABLE}
