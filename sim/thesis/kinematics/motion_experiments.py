"""Figures 15, 16 and 19 to 22 of the thesis (motions, signals), 27, 28 and 33 to 35 (amplitudes compared)."""

from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from coordinator.report.document import Table
from module_agent.estimate.windows import Array
from sim.thesis.experiment import (
    Check,
    Column,
    Curve,
    Experiment,
    Findings,
    Panel,
    Plot,
    Scope,
    Unit,
)
from sim.thesis.kinematics.motion_signals import ImuSignals, JointSignals, TrialSignals, Vector, trial_signals
from sim.thesis.published import Alignment, thesis_length

_TRIAL_S = 2.0
# Figure 21 and 22: as printed.
PRINTED_AXIS = (0.0987, 0.0668, 0.9929)
PRINTED_TANGENT = (0.9811, 0.1933, 0.0017)
_TIME = "time [s]"
_SPEED_RAD_S = 1.0
_COMPONENTS = ("x", "y", "z")


def _signals(alignment: Alignment, length_mm: int, amplitude_rad: float, scope: Scope) -> Unit:
    arguments = (alignment, length_mm, amplitude_rad, scope.noise, scope.seed)
    name = f"{length_mm} mm {alignment}, {amplitude_rad} rad: signals"
    return Unit(name, trial_signals, arguments, TrialSignals, _TRIAL_S)


def _first(scope: Scope) -> tuple[Unit, ...]:
    """Return the trial of the figures that name no arm: 484 mm, horizontal, at the amplitude of table 4."""
    return (_signals("horizontal", 484, thesis_length("horizontal", 484).amplitude_rad, scope),)


def _rms(signal: Array) -> float:
    return float(np.sqrt(np.mean(np.square(signal))))


# ---------------------------------------------------------------------- motions


def _constant(measured: list[TrialSignals]) -> Findings:
    joint = measured[0].constant
    speed = np.abs(np.array(joint.velocity_rad_s))
    steady = float(np.mean(speed[speed > 0.8 * speed.max()]))
    plot = Plot(
        caption="Constant motion of the joint.",
        x_label=_TIME,
        panels=(
            Panel(y_label="velocity [rad/s]", curves=_commanded_and(joint, "velocity")),
            Panel(y_label="position [rad]", curves=_commanded_and(joint, "position")),
        ),
    )
    statement = f"the joint turns at {steady:.3f} rad/s, commanded {_SPEED_RAD_S:g} rad/s"
    reading = ("The motion ramps up and down, which eq. 13 does not; it lasts 0.75 s at 1 rad/s (6.2.1.1).",)
    return Findings((Check(statement, abs(steady - _SPEED_RAD_S) < 0.05),), (), (plot,), reading)


def _windowed_sine(measured: list[TrialSignals]) -> Findings:
    joint = measured[0].sine
    commanded = np.array(joint.position_command_rad)
    follows = _rms(np.array(joint.position_rad) - commanded) / _rms(commanded)
    top, last = float(np.abs(commanded).max()), float(np.abs(commanded[-1]))
    printed = thesis_length("horizontal", 484).amplitude_rad
    checks = (
        Check(
            f"the largest position is {top:.4f} rad, A = {printed:g} rad", abs(top - printed) < 0.05 * printed
        ),
        Check(f"the motion ends {1e3 * last:.2f} mrad from where it began", last < 0.01 * printed),
        Check(f"the joint follows within {100 * follows:.0f} % rms", follows < 0.25),
    )
    plot = Plot(
        caption="Windowed sine motion: f = 2 Hz, Tm = 2.8 s, Tsigma = 1 s (table 3).",
        x_label=_TIME,
        panels=(Panel(y_label="position [rad]", curves=_commanded_and(joint, "position")),),
    )
    reading = (
        "Eq. 14 calls the motion a velocity; amplitudes in rad and the speed at which figure 28 saturates "
        "fit a position. A is taken as that of the position.",
        "Table 3 lists 15 s of time steps; the motion lasts 2 Tm = 5.6 s, and is tapered to exactly zero.",
    )
    return Findings(checks, (), (plot,), reading)


def _commanded_and(joint: JointSignals, quantity: str) -> tuple[Curve, ...]:
    unit = "rad" if quantity == "position" else "rad_s"
    measured, commanded = f"{quantity}_{unit}", f"{quantity}_command_{unit}"
    return (
        Curve(label="commanded", x=joint.t_s, y=getattr(joint, commanded)),
        Curve(label="measured", x=joint.t_s, y=getattr(joint, measured)),
    )


# ---------------------------------------------------------------------- signals


def _gyro_plot(imu: ImuSignals, gyro: Array, caption: str) -> Plot:
    curves = tuple(
        Curve(label=name, x=imu.t_s, y=tuple(float(value) for value in gyro[:, column]))
        for column, name in enumerate(_COMPONENTS)
    )
    return Plot(caption=caption, x_label=_TIME, panels=(Panel(y_label="gyro [rad/s]", curves=curves),))


def _offset(measured: list[TrialSignals]) -> Findings:
    gyro = np.array(measured[0].rest.gyro_rad_s)
    offset = gyro.mean(axis=0)
    error = gyro.std(axis=0, ddof=1) / np.sqrt(len(gyro))
    sizes = ", ".join(f"{1e3 * value:+.2f}" for value in offset)
    each = bool(np.all(np.abs(offset) > 3.0 * error))
    some = bool(np.any(np.abs(offset) > 3.0 * error))
    checks = (
        Check(f"an axis has an offset beyond three times its error; x, y, z: {sizes} mrad/s", some),
        Check("every axis has one", each),
    )
    table = Table(
        caption="Mean of two seconds at rest (eq. 30).",
        columns=(Column(name="axis"), Column(name="offset", unit="mrad/s", form="+.3f"), _SCATTER),
        rows=tuple(
            (name, 1e3 * float(offset[k]), 1e3 * float(gyro[:, k].std(ddof=1)))
            for k, name in enumerate(_COMPONENTS)
        ),
    )
    plot = _gyro_plot(measured[0].rest, gyro, "Gyro at rest.")
    reading = ("The thesis prints the offsets as a curve, and no numbers.",)
    return Findings(checks, (table,), (plot,), reading)


_SCATTER = Column(name="scatter of a sample", unit="mrad/s", form=".3f")


def _offset_removed(measured: list[TrialSignals]) -> Findings:
    gyro = np.array(measured[0].rest.gyro_rad_s)
    half = len(gyro) // 2
    offset = gyro[:half].mean(axis=0)
    remains = float(np.linalg.norm(gyro[half:].mean(axis=0) - offset))
    before = float(np.linalg.norm(offset))
    statement = f"{1e3 * remains:.2f} mrad/s remain of {1e3 * before:.2f} mrad/s"
    plot = _gyro_plot(measured[0].rest, gyro - offset, "Gyro at rest less the offset of the first half.")
    reading = ("The offset is that of the first half of the rest, and is checked on the second half.",)
    return Findings((Check(statement, remains < 0.2 * before),), (), (plot,), reading)


def _angle_deg(one: Vector, other: Vector) -> float:
    cosine = np.dot(one, other) / np.linalg.norm(one) / np.linalg.norm(other)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _joint_axis(measured: list[TrialSignals]) -> Findings:
    trial = measured[0]
    z: Vector = (0.0, 0.0, 1.0)
    axes: tuple[tuple[str, Vector, float | None], ...] = (
        ("printed", PRINTED_AXIS, None),
        ("the thesis' method", trial.thesis_axis, _angle_deg(trial.thesis_axis, trial.true_axis)),
        ("ours", trial.our_axis, _angle_deg(trial.our_axis, trial.true_axis)),
        ("truth", trial.true_axis, 0.0),
    )
    off = _angle_deg(trial.thesis_axis, trial.true_axis)
    tilt, printed_tilt = _angle_deg(trial.thesis_axis, z), _angle_deg(PRINTED_AXIS, z)
    checks = (
        Check(f"the thesis' axis is within 1 deg of the true one ({off:.2f} deg)", off < 1.0),
        Check(
            f"z is the rotation axis within {printed_tilt:.1f} deg, as printed ({tilt:.2f} deg)",
            tilt < printed_tilt,
        ),
    )
    table = Table(
        caption="Axis of the joint in the IMU's frame.",
        columns=(
            Column(name="axis"),
            *(Column(name=name, form="+.4f") for name in _COMPONENTS),
            Column(name="to z", unit="deg", form=".2f"),
            Column(name="to the truth", unit="deg", form=".2f"),
        ),
        rows=tuple((name, *axis, _angle_deg(axis, z), error) for name, axis, error in axes),
    )
    gyro = np.array(trial.constant_imu.gyro_rad_s) - np.mean(trial.rest.gyro_rad_s, axis=0)
    plot = _gyro_plot(trial.constant_imu, gyro, "Gyro during the constant motion, less its offset.")
    reading = ("What the mounting of the printed axis' IMU was is not known: its 6.9 deg are not an error.",)
    return Findings(checks, (table,), (plot,), reading)


def _filtered(measured: list[TrialSignals]) -> Findings:
    trial, joint = measured[0], measured[0].sine
    raw, smooth = np.array(joint.acceleration_rad_s2), np.array(joint.filtered_rad_s2)
    noise = _rms(raw - smooth) / _rms(smooth)
    short = trial.unfiltered_mm / trial.filtered_mm - 1.0
    checks = (
        Check(f"the filter takes away noise of {100 * noise:.0f} % of the signal", noise > 0.1),
        Check(f"without it the length is {100 * short:+.1f} % of that with it", short < -0.01),
    )
    table = Table(
        caption="Distance by the thesis' method.",
        columns=tuple(Column(name=name, unit="mm") for name in ("truth", "filtered", "unfiltered")),
        rows=((trial.true_mm, trial.filtered_mm, trial.unfiltered_mm),),
    )
    directions = Table(
        caption="Directions in the IMU's frame.",
        columns=(Column(name="direction"), *(Column(name=name, form="+.4f") for name in _COMPONENTS)),
        rows=(
            ("printed n (eq. 21)", *PRINTED_TANGENT),
            ("tangent n of our modules", *trial.tangent),
            ("radial direction of our modules", *trial.radial),
        ),
    )
    curves = (
        Curve(label="unfiltered", x=joint.t_s, y=joint.acceleration_rad_s2),
        Curve(label="filtered", x=joint.t_s, y=joint.filtered_rad_s2),
    )
    panel = Panel(y_label="acceleration [rad/s²]", curves=curves)
    plot = Plot(caption="Acceleration of the joint, differentiated.", x_label=_TIME, panels=(panel,))
    reading = (
        "The thesis calls the printed n a radial unit vector, along x as its setup has the radius; by eqs. "
        "20 and 21 n is the tangent. Both directions are listed.",
    )
    return Findings(checks, (table, directions), (plot,), reading)


# ---------------------------------------------------------------------- good and saturating amplitudes


class _Motion:
    """Figures of how a joint moved in a windowed sine."""

    def __init__(self, trial: TrialSignals):
        joint = trial.sine
        commanded, reached = np.array(joint.velocity_command_rad_s), np.array(joint.velocity_rad_s)
        self.commanded_rad_s = float(np.abs(commanded).max())
        self.clamp_rad_s = trial.velocity_clamp_rad_s
        self.error = _rms(reached - commanded) / _rms(commanded)
        self.peak_rad_s2 = float(np.abs(joint.filtered_rad_s2).max())
        self.noise = _rms(np.array(joint.acceleration_rad_s2) - joint.filtered_rad_s2) / _rms(
            np.array(joint.filtered_rad_s2)
        )

    @property
    def saturates(self) -> Check:
        """Whether the velocity is cut off."""
        return Check(
            f"the velocity is cut off: {self.commanded_rad_s:.2f} rad/s are commanded, "
            f"{self.clamp_rad_s:.2f} rad/s is the limit",
            self.commanded_rad_s > self.clamp_rad_s,
        )

    @property
    def follows(self) -> Check:
        """Whether the velocity stays below its limit and follows."""
        return Check(
            f"the velocity follows ({self.commanded_rad_s:.2f} of at most {self.clamp_rad_s:.2f} rad/s, "
            f"rms error {100 * self.error:.0f} %)",
            self.commanded_rad_s <= self.clamp_rad_s and self.error < 0.35,
        )


def _motion_table(labels: tuple[str, ...], motions: tuple[_Motion, ...]) -> Table:
    return Table(
        caption="The motions compared.",
        columns=(
            Column(name="motion"),
            Column(name="largest commanded velocity", unit="rad/s", form=".2f"),
            Column(name="limit", unit="rad/s", form=".2f"),
            Column(name="rms error of the velocity", unit="%", form=".0f"),
            Column(name="largest acceleration", unit="rad/s²", form=".1f"),
            Column(name="noise that the filter removes", unit="%", form=".0f"),
        ),
        rows=tuple(
            (label, m.commanded_rad_s, m.clamp_rad_s, 100 * m.error, m.peak_rad_s2, 100 * m.noise)
            for label, m in zip(labels, motions, strict=True)
        ),
    )


def _motion_plot(trial: TrialSignals, label: str) -> Plot:
    joint = trial.sine
    acceleration = (Curve(label="filtered", x=joint.t_s, y=joint.filtered_rad_s2),)
    return Plot(
        caption=f"Windowed sine motion, {label}.",
        x_label=_TIME,
        panels=(
            Panel(y_label="position [rad]", curves=_commanded_and(joint, "position")),
            Panel(y_label="velocity [rad/s]", curves=_commanded_and(joint, "velocity")),
            Panel(y_label="acceleration [rad/s²]", curves=acceleration),
        ),
    )


class _Shown(NamedTuple):
    """A figure of one motion: arm, amplitude, what is checked of it, and which reading was taken."""

    number: int
    arm: tuple[Alignment, int]
    amplitude_rad: float
    finding: str
    property: Literal["follows", "saturates", "worse", "small"]
    reading: tuple[str, ...] = ()
    caption_arm: tuple[Alignment, int] | None = None


_SHOWN = (
    _Shown(
        27, ("horizontal", 484), 0.08,
        "At 0.08 rad the thesis saw a smooth position, and a fairly smooth velocity and acceleration.",
        "follows",
    ),
    _Shown(
        28, ("horizontal", 484), 0.3,
        "At 0.3 rad the thesis saw the velocity cut off at its maximum, and an abnormal acceleration.",
        "saturates",
        (
            "The text compares two horizontal motions, the caption says vertical: the text's reading is "
            "decisive, the caption's arm is shown too.",
        ),
        ("vertical", 484),
    ),
    _Shown(
        33, ("vertical", 484), 0.13,
        "At 0.13 rad on the vertical 484 mm arm the thesis saw an actuator that has trouble with the motion.",
        "worse",
        ("The text has an amplitude of 1.3, the caption 0.13: 0.13 rad, as 1.3 rad would need 16 rad/s.",),
    ),
    _Shown(
        34, ("vertical", 245), 0.03,
        "At 0.03 rad on the vertical 245 mm arm the thesis saw accelerations too low to trust the estimate.",
        "small",
        ("The text speaks of figure 27; arm and amplitude are those of the caption of figure 34.",),
    ),
    _Shown(
        35, ("vertical", 245), 0.2,
        "At 0.2 rad on the vertical 245 mm arm the thesis saw the velocity capped.",
        "saturates",
        ("The text speaks of figure 28; arm and amplitude are those of the caption of figure 35.",),
    ),
)  # fmt: skip
_SMOOTH = _SHOWN[0]


def _shown_units(shown: _Shown, scope: Scope) -> tuple[Unit, ...]:
    compared = [(shown.arm, shown.amplitude_rad)]
    if shown.caption_arm is not None:
        compared.append((shown.caption_arm, shown.amplitude_rad))
    if shown is not _SMOOTH:
        compared.append((_SMOOTH.arm, _SMOOTH.amplitude_rad))
    return tuple(_signals(*arm, amplitude_rad, scope) for arm, amplitude_rad in compared)


def _examine(shown: _Shown, measured: list[TrialSignals]) -> Findings:
    arms = [shown.arm] if shown.caption_arm is None else [shown.arm, shown.caption_arm]
    labels = [f"{length} mm {alignment}, {shown.amplitude_rad:g} rad" for alignment, length in arms]
    plots = tuple(_motion_plot(*each) for each in zip(measured[: len(arms)], labels, strict=True))
    motions = tuple(_Motion(trial) for trial in measured)
    if shown is not _SMOOTH:
        labels.append(f"figure 27: 484 mm horizontal, {_SMOOTH.amplitude_rad:g} rad")
    own, smooth = motions[0], motions[-1]
    checks = {
        "follows": (own.follows,),
        "saturates": (own.saturates, _worse(own, smooth)),
        "worse": (_worse(own, smooth),),
        "small": (
            Check(
                f"accelerations reach {own.peak_rad_s2:.1f} rad/s², "
                f"in figure 27 {smooth.peak_rad_s2:.1f} rad/s²",
                own.peak_rad_s2 < 0.5 * smooth.peak_rad_s2,
            ),
        ),
    }
    return Findings(checks[shown.property], (_motion_table(tuple(labels), motions),), plots, shown.reading)


def _worse(own: _Motion, smooth: _Motion) -> Check:
    statement = (
        f"the velocity follows worse than in figure 27: rms error {100 * own.error:.0f} % "
        f"against {100 * smooth.error:.0f} %"
    )
    return Check(statement, own.error > smooth.error)


MOTION_EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(
        "figure15",
        "Figure 15: constant motion",
        "The thesis turns the joint at a constant velocity to find its axis.",
        _first,
        _constant,
    ),
    Experiment(
        "figure16",
        "Figure 16: windowed sine motion",
        "The thesis uses a sine under a Gaussian window for large accelerations on a short path.",
        _first,
        _windowed_sine,
    ),
    Experiment(
        "figure19",
        "Figure 19: gyro offset",
        "Each axis of the gyro had an offset at rest.",
        _first,
        _offset,
    ),
    Experiment(
        "figure20",
        "Figure 20: gyro after the offset is subtracted",
        "Less the mean of two seconds of rest, the gyro read about zero.",
        _first,
        _offset_removed,
    ),
    Experiment(
        "figure21",
        "Figure 21: gyro during the constant motion",
        "The constant motion gave z as the axis of rotation, within 7 deg.",
        _first,
        _joint_axis,
    ),
    Experiment(
        "figure22",
        "Figure 22: acceleration unfiltered and filtered",
        "Differentiation made the acceleration noisy, and lengths too short unless it was filtered.",
        _first,
        _filtered,
    ),
    *(
        Experiment(
            f"figure{shown.number}",
            f"Figure {shown.number}: {shown.arm[1]} mm {shown.arm[0]}, amplitude {shown.amplitude_rad:g} rad",
            shown.finding,
            partial(_shown_units, shown),
            partial(_examine, shown),
        )
        for shown in _SHOWN
    ),
)
