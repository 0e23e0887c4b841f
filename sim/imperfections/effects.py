"""The table of imperfections of the simulated module: effect, model, typical size, source, switch.

The same table is the page `docs/effects.md`, the switches `--with` and `--without` of the command line, and
the material of the named profiles.
"""

from collections.abc import Mapping
from math import pi, radians
from typing import Literal, NamedTuple

Part = Literal["actuator", "IMU", "encoder and torque", "clock", "module", "structure"]


class Effect(NamedTuple):
    """One effect: its switch's name, what the model is, its typical sizes by profile field, their source."""

    name: str
    part: Part
    model: str
    sizes: Mapping[str, float]
    source: str


_TABLE: dict[Part, dict[str, tuple[str, dict[str, float], str]]] = {
    "actuator": {
        "friction": (
            "Coulomb and viscous friction of motor and gear, sticking when at rest",
            {"friction": 1.0},
            "real X5-1 log: 0.049 Nm + 0.011 Nm s/rad at the output; other types scaled by gear ratio",
        ),
        "gear-loss": (
            "a friction that grows with the torque transmitted: "
            "35 % loss when driving, none when driven back",
            {"gear_loss": 1.0},
            "published efficiency 0.65",
        ),
        "heat": (
            "winding, housing and body as three heat capacities; copper's resistance grows with temperature",
            {"heat": 1.0},
            "published thermal constants; copper 0.393 %/K",
        ),
        "variation": (
            "every module's friction, motor constant, winding and spring differ from its type's by factors",
            {"friction_spread": 0.15, "motor_spread": 0.03, "spring_spread": 0.05},
            "thesis 6.1: each module showed slightly different behaviour; sizes are an assumption",
        ),
        "backlash": (
            "a gap between gear and spring; flanks push and do not pull",
            {"backlash_rad": radians(0.1)},
            "an assumption: the X5's backlash is not published",
        ),
        "stiffening-spring": (
            "a cubic spring: 30-70 Nm/rad near zero, 300-1000 at full load, by the type's strength",
            {"spring_stiffening": 1.0},
            "published for modules since 2019",
        ),
    },
    "IMU": {
        "imu-white": (
            "white noise on all axes, growing with the square root of the output rate",
            {"accel_white_m_s2": 0.011, "gyro_white_rad_s": 6e-4},
            "real X5-1 log near standstill: 9-14 mm/s^2; gyro 0.61-0.68 mrad/s, of which 0.31 are its steps",
        ),
        "imu-bias": (
            "constant offset per axis",
            {"accel_bias_m_s2": 0.020, "gyro_bias_rad_s": 0.030},
            "real X5-1 log: gyro 9, 31 and 42 mrad/s; accelerometer 2 mg after calibration",
        ),
        "imu-drift": (
            "first-order Gauss-Markov wandering of the biases",
            {"accel_drift_m_s2": 4e-4, "gyro_drift_rad_s": 5e-5, "drift_time_s": 100.0},
            "data sheets of the class: bias instability 40 ug and 10 deg/h; the time is an assumption",
        ),
        "imu-scale": (
            "scale error per axis",
            {"accel_scale": 0.01, "gyro_scale": 0.01},
            "data sheets of the class: 0.5-3 %; gyro steps in a real X5-1 log were scaled by -0.7 to -2.2 %",
        ),
        "imu-misalignment": (
            "a rotation of gyro and of accelerometer against the housing, each its own",
            {"imu_misalignment_rad": radians(1.0)},
            "an assumption within the cross-axis sensitivity of 2 % in data sheets of the class",
        ),
        "imu-skew": (
            "the axes of gyro and of accelerometer are not at right angles",
            {"imu_skew_rad": 0.005},
            "an assumption within the cross-axis sensitivity of 2 % in data sheets of the class",
        ),
        "g-sensitivity": (
            "the gyro reads part of the specific force, by a matrix of 3 x 3 per module",
            {"gyro_g_sensitivity_s_m": 1.8e-4},
            "data sheets of the class: 0.1 deg/s/g",
        ),
        "imu-bandwidth": (
            "second-order Butterworth low-pass before sampling, the same for all axes; delays by 2.4 ms",
            {"imu_bandwidth_hz": 92.0},
            "data sheets of the class: the filter setting below half of 250 Hz",
        ),
        "imu-range": (
            "readings saturate",
            {"accel_range_m_s2": 8.0 * 9.80665, "gyro_range_rad_s": radians(2000.0)},
            "real X5-1 log: 2000 deg/s by the gyro's steps; accelerometer 8 g is an assumption",
        ),
        "imu-steps": (
            "16 bit readings",
            {"accel_step_m_s2": 8.0 * 9.80665 / 2**15, "gyro_step_rad_s": radians(2000.0) / 2**15},
            "real X5-1 log: gyro steps of 1.04-1.06 mrad/s under its calibration; accelerometer as the range",
        ),
        "vibration": (
            "noise that grows with the speed of the module's own gears; older modules three times as much",
            {"vibration_m_s2": 0.046, "vibration_rad_s": 2.1e-3},
            "real X5-1 log: 4.9 mm/s^2 and 0.19-0.27 mrad/s per rad/s; the factor 3 is assumed (thesis 6.1)",
        ),
    },
    "encoder and torque": {
        "encoder": (
            "position in steps of one count",
            {"position_step_rad": 2.0 * pi / 2**16},
            "an assumption: such encoders have 14-18 bit; a real X5-1 log hides the steps",
        ),
        "velocity-estimate": (
            "the module's own: a first-order low-pass of the encoder's differences, with noise",
            {"velocity_white_rad_s": 5e-3, "velocity_bandwidth_hz": 100.0},
            "real X5-1 log: 1.3-1.7 ms late; its noise is below 85 mrad/s, this size is an assumption",
        ),
        "motor-speed-estimate": (
            "a first-order low-pass of the motor's speed, in feedback alone: the velocity loop of "
            "strategies 2 and 3, on the motor's side of the spring (`velocity_loop`), has a faster one",
            {"motor_velocity_bandwidth_hz": 15.0},
            "real X5-1 log: 10.7 ms late. Its PWM answers to the deflection's velocity by 0.059 +- 0.004, "
            "where the velocity's kp is 0.05 (0 for a loop on the output's side), and to the late speed by "
            "at most 0.003. The thesis' figures 52 and 54 need the motor's side, the output's rings",
        ),
        "torque-noise": (
            "white noise on the torque read from the spring, as a fraction of the largest",
            {"effort_white_fraction": 0.002},
            "real X5-1 log: 5 mNm at slow speeds",
        ),
        "torque-calibration": (
            "offset, as a fraction of the largest torque, and scale error of the torque sensor",
            {"effort_offset_fraction": 0.005, "effort_scale": 0.02},
            "offset: real X5-1 log, 9 mNm; scale: an assumption (thesis 6.3: measured torque differs)",
        ),
        "torque-hysteresis": (
            "the spring's inner friction, which its deflection does not show: "
            "a Dahl element; width of the loop",
            {"effort_hysteresis_fraction": 0.005},
            "an assumption: rubber in the spring; a log cannot show it, "
            "as effort is computed from deflection",
        ),
    },
    "clock": {
        "clock": (
            "an offset, as modules start at different times, and a rate that is fast or slow",
            {"clock_offset_min_s": 1.0, "clock_offset_max_s": 100.0, "clock_drift_ppm": 20.0},
            "data sheets of quartz oscillators: 20 ppm; the start is an assumption",
        ),
        "sampling-jitter": (
            "a reading is taken a little before or after its time stamp",
            {"sampling_jitter_s": 2e-5},
            "an assumption: the growth of the velocity's noise with speed in a real X5-1 log allows 5e-5",
        ),
    },
    "module": {
        "imu-place": (
            "the IMU sits off its catalogued place in the housing, along all three axes",
            {"imu_place_m": 1e-3},
            "an assumption: the manufacturer gives the places as hints; a board's tolerances",
        ),
        "imu-mounting": (
            "gyro and accelerometer are turned together against the housing",
            {"imu_mounting_rad": radians(0.1)},
            "an assumption: how well a housing can be clamped on the rate table that calibrates its IMU",
        ),
        "body-mass": (
            "mass and moments of inertia differ from the catalogue's by a factor",
            {"body_mass": 0.02},
            "an assumption: published masses are rounded to 5 g, cables and screws weigh as much",
        ),
        "body-centre": (
            "the centre of mass is off its catalogued place, along all three axes",
            {"body_centre_m": 1e-3},
            "an assumption: published centres come from drawings without cables, grease and screws",
        ),
        "housing-axis": (
            "the joint's axis is tilted and displaced against the faces of the housing, across itself",
            {"housing_axis_m": 1e-4, "housing_axis_rad": radians(0.05)},
            "general tolerances for machined parts of this size (ISO 2768-m: 0.1 to 0.2 mm over 70 mm)",
        ),
    },
    "structure": {
        "base-shake": (
            "compliance of the base by the robot file: stiffness, damping, up to six directions",
            {"base_shake": 1.0},
            "thesis 6.1, figures 17 and 18; the stiffnesses in the robot files are assumptions",
        ),
        "link-flex": (
            "links bend and twist on hinges: tubes by a pseudo-rigid beam, others by the robot file",
            {"link_flex": 1.0},
            "beam theory (Howell 2001) with the tube's published mass and radius; 2 % damping at 40 Hz",
        ),
    },
}

EFFECTS: dict[str, Effect] = {
    name: Effect(name, part, *row) for part, rows in _TABLE.items() for name, row in rows.items()
}
