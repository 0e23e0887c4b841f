"""Figures 44, 51 and 58 of the thesis: the dynamic pattern, and the parameters of 6.3.2 and 6.3.3."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from coordinator.report.document import Cell, Table
from module_agent.model.regressor import BODY_PARAMETERS
from sim.thesis.dynamics.amplitude_experiments import AMPLITUDE_EXPERIMENTS, TABLE_6
from sim.thesis.dynamics.arm_make import as_designed, link_left, module_alone, printed, with_printed_module
from sim.thesis.dynamics.identified_arms import (
    LINES_UP,
    Recorded,
    arm_units,
    first_unit,
    mean_of,
    rigid_base_unit,
    run_of,
    torque_plot,
)
from sim.thesis.dynamics.load_identification import IZZ, MCX, least_mass_kg
from sim.thesis.dynamics.pattern_recording import CheckRun, Estimate, PatternSeries, Torques, dynamic_pattern
from sim.thesis.experiment import Check, Column, Curve, Experiment, Findings, Panel, Plot, Scope, Unit
from sim.thesis.published import DYNAMIC_SEARCHES, Alignment

# Of a printed parameter.
_WITHIN = 0.10
_HALF_S = 0.5


# ---------------------------------------------------------------------- figure 44


def _pattern(measured: list[PatternSeries]) -> Findings:
    arm = measured[0]
    torques = run_of(arm, DYNAMIC_SEARCHES["vertical"].chosen_rad).torques
    commanded = np.array(torques.position_command_rad)
    used = dynamic_pattern(DYNAMIC_SEARCHES["vertical"].chosen_rad)
    joints = [k * 2.0 * used.half_width_s for k in range(used.repeats + 1)]
    off = max(float(np.abs(np.interp(at, torques.t_s, commanded))) for at in joints)
    pattern, whole = (_commanded_rms_rad_s2(one) for one in (torques, arm.whole.torques))
    moved, asked = (float(np.ptp(signal)) for signal in (torques.position_rad, commanded))
    checks = (
        Check(f"its {used.repeats} parts begin and end within {1e3 * off:.2f} mrad of rest", off < 1e-3),
        Check(
            f"its acceleration ({pattern:.1f} rad/s² rms) is above the whole motion's ({whole:.1f} rad/s²)",
            pattern > whole,
        ),
        Check(
            f"the joint's sweep ({moved:.3f} rad) is within 20 % of the commanded one ({asked:.3f} rad)",
            abs(moved / asked - 1.0) < 0.2,
        ),
    )
    reading = (
        "The text cuts the steep part out of the motion and repeats it: 1 s about Tm, from rest to rest, "
        "four times. The windowed sine is tapered to exactly zero at both ends of each.",
        "Eq. 14 calls the motion a velocity; as in table 3, A is taken as that of the position.",
    )
    return Findings(checks, (), (_motion_plot(torques),), reading)


def _commanded_rms_rad_s2(torques: Torques) -> float:
    acceleration = np.gradient(np.array(torques.velocity_command_rad_s), np.array(torques.t_s))
    return float(np.sqrt(np.mean(acceleration**2)))


def _motion_plot(torques: Torques) -> Plot:
    t_s = torques.t_s
    commanded = np.gradient(np.array(torques.velocity_command_rad_s), np.array(t_s))
    both = (
        ("position [rad]", torques.position_command_rad, torques.position_rad),
        ("velocity [rad/s]", torques.velocity_command_rad_s, torques.velocity_rad_s),
        ("acceleration [rad/s²]", tuple(commanded), torques.acceleration_rad_s2),
    )
    panels = tuple(
        Panel(
            y_label=label,
            curves=(
                Curve(label="commanded", x=t_s, y=asked),
                Curve(label="measured, acceleration filtered", x=t_s, y=done),
            ),
        )
        for label, asked, done in both
    )
    return Plot(caption="Dynamic pattern, A = 0.2, on the vertical arm.", x_label="time [s]", panels=panels)


# ---------------------------------------------------------------------- figures 51 and 58


class _Vector(NamedTuple):
    """A printed parameter vector and the figure of its torques."""

    number: int
    section: str
    alignment: Alignment
    start_nm: tuple[float, float]
    finding: str
    numbers: tuple[float | None, ...]
    reading: tuple[str, ...]


_MOTION_READING = (
    "The trajectory of the figure is not printed with its parameters: 6.3.1 says a windowed sine of table 6, "
    "the caption has its amplitude. That motion, whole, is in the plot and the checks; the table has the "
    "windowed sine of table 3 at the amplitude of tables 4 and 5, too. Nothing was fitted to them."
)
_NOT_SHOWN = (
    "The torque about z shows mcx, mcy and Izz; on a rocking base ours has a little of Ixz and Iyz, too. A 0 "
    "of a method means that it does not identify the parameter. Sigma is that of an arm, by noise alone: the "
    "link's bending, which adds a percent to Izz, is not in the model of one joint."
)
_NO_MASS = (
    "The printed mass of ±0.0001 is no estimate: the torque about the axis does not depend on it, and the "
    "pseudo-inverse gives 0. All six rows of eq. 25, with zero for what no joint measures, give a mass as "
    "small as the printed one, but half of the true mcx: the printed vector is not from there."
)
_VECTORS = (
    _Vector(
        51, "6.3.2", "vertical", (1.5, 2.5),
        "The thesis' parameters of the vertical arm, mcx 0.2249 and Izz 0.0725, gave a torque that starts at "
        "about 2 Nm and lines up with the measured one.",
        (-0.0001, 0.2249, 0, 0, 0, 0, 0, 0, None, 0.0725),
        (
            _MOTION_READING,
            _NOT_SHOWN,
            "Nine numbers are printed of ten parameters. By 6.3.3, which has ten, they are m, mcx, zeros and "
            "Izz, and a zero is missing.",
            _NO_MASS,
        ),
    ),
    _Vector(
        58, "6.3.3", "horizontal", (-0.2, 0.2),
        "The thesis' parameters of the horizontal arm, mcx -0.0083 and Izz 0.1680, gave a torque that starts "
        "at about zero and lines up with the measured one.",
        (0.0001, -0.0083, 0, 0, 0, 0, 0, 0, 0, 0.1680),
        (
            _MOTION_READING,
            _NOT_SHOWN,
            "About a vertical axis mcx has a torque by the axis' tilt alone: the printed -0.0083 kg m is "
            "then the torque's mean over that tilt, and says nothing of the arm. Here the tilt is smaller "
            "than the accelerometer's bias, and mcx by ours is as little the arm's.",
            "6.3.4 has smaller parameters in the horizontal for lack of gravity; Izz is printed 2.3 times as "
            "large there as for the same arm in the vertical, which no body can do.",
            "A = 2 asks for 12.6 rad/s: the motor saturates, and the joint does what it can.",
        ),
    ),
)  # fmt: skip


def _vector_units(alignment: Alignment, scope: Scope) -> tuple[Unit, ...]:
    rigid = (rigid_base_unit(scope),) if alignment == "vertical" else ()
    return (*arm_units(alignment, scope), *rigid)


def _torques_of(vector: _Vector, measured: list[PatternSeries]) -> Findings:
    upright = vector.alignment == "vertical"
    recorded = Recorded(tuple(measured[:-1]), measured[-1]) if upright else Recorded(tuple(measured))
    first = recorded.arms[0]
    checks = (*_torque_checks(vector, first.whole.torques, first.whole.relative_error),)
    checks += _parameter_checks(vector.alignment, recorded)
    amplitude = DYNAMIC_SEARCHES[vector.alignment].chosen_rad
    caption = (
        f"Calculated and measured torque, windowed sine of table 6, A = {amplitude:g}, {vector.alignment}."
    )
    tables = [_vector_table(vector, recorded), _motion_table(recorded)]
    reading = vector.reading
    if recorded.rigid is not None:
        tables.append(_make_table(recorded.rigid))
        reading = (*reading, *_make_reading(recorded.rigid))
    return Findings(
        checks, tuple(tables), (torque_plot(first.whole.torques, first.whole.our_torques, caption),), reading
    )


def _torque_checks(vector: _Vector, torques: Torques, relative_error: float) -> tuple[Check, ...]:
    t_s, measured = np.array(torques.t_s), np.array(torques.measured_nm)
    calculated = np.array(torques.calculated_nm)
    start = float(measured[t_s < _HALF_S].mean())
    low, high = vector.start_nm
    strength = float(calculated.std() / measured.std())
    return (
        Check(f"the torque starts between {low:g} and {high:g} Nm ({start:.2f} Nm)", low < start < high),
        Check(
            f"the calculated torque is as strong within 20 % ({strength:.2f} times)", abs(strength - 1) < 0.2
        ),
        Check(
            f"it lines up: the error is below a third of the torque ({100 * relative_error:.0f} %)",
            relative_error < LINES_UP,
        ),
    )


def _parameter_checks(alignment: Alignment, recorded: Recorded) -> tuple[Check, ...]:
    search = DYNAMIC_SEARCHES[alignment]
    thesis, true = _means(recorded, "thesis"), _truth(recorded)
    izz = _near("Izz by the thesis' method", thesis[IZZ], search.izz_kg_m2, "kg m²")
    if alignment == "vertical":
        return _near("mcx by the thesis' method", thesis[MCX], search.mcx_kg_m, "kg m"), izz
    each = [run_of(arm, search.chosen_rad).thesis.phi[MCX] for arm in recorded.arms]
    return (
        Check(
            f"mcx is hardly seen: {min(each):.4f} to {max(each):.4f} kg m, printed {search.mcx_kg_m:.4f}; "
            f"the arm has {true[MCX]:.4f} kg m",
            max(map(abs, each)) < 0.5 * true[MCX],
        ),
        izz,
    )


def _near(what: str, own: float, wanted: float, unit: str) -> Check:
    statement = f"{what} ({own:.4f} {unit}) is within {100 * _WITHIN:.0f} % of the printed {wanted:.4f}"
    return Check(statement, abs(own / wanted - 1.0) <= _WITHIN)


def _means(recorded: Recorded, estimate: str) -> list[float]:
    def component(k: int, one: Estimate) -> float:
        return one.phi[k]

    chosen = _chosen_rad(recorded)
    return [
        recorded.mean(chosen, mean_of(estimate, partial(component, k))) for k in range(len(BODY_PARAMETERS))
    ]


def _truth(recorded: Recorded) -> list[float]:
    return [float(value) for value in np.mean([arm.truth for arm in recorded.arms], axis=0)]


def _chosen_rad(recorded: Recorded) -> float:
    """Return the amplitude at which the parameters of an alignment are printed."""
    played = {run.amplitude_rad for run in recorded.arms[0].runs}
    return next(one.chosen_rad for one in DYNAMIC_SEARCHES.values() if one.chosen_rad in played)


def _vector_table(vector: _Vector, recorded: Recorded) -> Table:
    names = ("thesis", "six_rows", "unfiltered", "ours")
    columns = [_means(recorded, name) for name in names]
    chosen = _chosen_rad(recorded)
    sigma = np.mean([run_of(arm, chosen).our_sigma for arm in recorded.arms], axis=0)
    truth = _truth(recorded)
    rows: list[tuple[Cell, ...]] = [
        (parameter, vector.numbers[k], *(column[k] for column in columns), float(sigma[k]) or None, truth[k])
        for k, parameter in enumerate(BODY_PARAMETERS)
    ]
    headings = ("printed", "the thesis' method", "six rows", "unfiltered", "ours", "sigma of ours", "truth")
    return Table(
        caption=f"Parameters about the joint, mean of {recorded.arms_text} [kg, kg m, kg m²].",
        columns=(Column(name="parameter"), *(Column(name=name, form=".4f") for name in headings)),
        rows=tuple(rows),
    )


def _motion_table(recorded: Recorded) -> Table:
    def row(name: str, runs: Sequence[CheckRun]) -> tuple[Cell, ...]:
        errors = [100 * one.relative_error for one in runs], [100 * one.our_relative_error for one in runs]
        return (name, *(value for each in errors for value in (float(np.mean(each)), max(each))))

    return Table(
        caption="Error of the calculated torque, in parts of the torque's rms.",
        columns=(
            Column(name="motion"),
            *(
                Column(name=name, unit="%", form=".0f", group=group)
                for group in ("the thesis' method", "ours")
                for name in ("mean", "largest of all arms")
            ),
        ),
        rows=(
            row("windowed sine of table 6", [arm.whole for arm in recorded.arms]),
            row("windowed sine of table 3", [arm.usual for arm in recorded.arms]),
        ),
    )


def _make_table(rigid: PatternSeries) -> Table:
    makes = (printed("6.3.2"), printed("6.3.3"), as_designed(), with_printed_module(), module_alone())
    rows: list[tuple[Cell, ...]] = [
        (make.name, make.mass_kg, make.mcx_kg_m, make.izz_kg_m2, make.least_kg if make.mcx_kg_m > 0 else None)
        for make in makes
    ]
    phi = run_of(rigid, DYNAMIC_SEARCHES["vertical"].chosen_rad).thesis.phi
    rows.insert(2, ("the thesis' method, rigid base", None, phi[MCX], phi[IZZ], least_mass_kg(phi)))
    return Table(
        caption="What the joint carries by the arm's make, and mcx² / Izz, the least mass of a body with "
        "these moments.",
        columns=(
            Column(name="arm"),
            Column(name="mass", unit="kg", form=".3f"),
            Column(name="mcx", unit="kg m", form=".4f"),
            Column(name="Izz", unit="kg m²", form=".4f"),
            Column(name="least mass", unit="kg", form=".3f"),
        ),
        rows=tuple(rows),
    )


def _make_reading(rigid: PatternSeries) -> tuple[str, ...]:
    own, design, module, link = printed("6.3.2"), as_designed(), module_alone(), link_left()
    unfiltered = run_of(rigid, DYNAMIC_SEARCHES["vertical"].chosen_rad).unfiltered
    return (
        f"By the arm's make mcx is {design.mcx_kg_m:.4f} kg m, printed {own.mcx_kg_m:.4f}; Izz is "
        f"{design.izz_kg_m2:.4f} kg m², printed {own.izz_kg_m2:.4f}. The link's mass is that of the robot "
        "file, as none is printed.",
        f"The printed Izz is too small for the printed mcx: a body with both weighs {own.least_kg:.3f} kg or "
        f"more, ours {design.mass_kg:.3f} kg. The module of table 2 alone has {module.izz_kg_m2:.4f} kg m² "
        f"of it. That leaves {link.izz_kg_m2:.4f} kg m² with {link.mcx_kg_m:.4f} kg m for the link: "
        f"{link.least_kg:.2f} kg or more, centred {1e3 * link.farthest_m:.0f} mm from the axis or nearer, "
        "where a uniform link that reaches the module is centred at 230 mm.",
        "Not explained by noise: unfiltered accelerations make Izz small, "
        f"{unfiltered.phi[IZZ]:.4f} kg m² on a rigid base, but leave an error of "
        f"{unfiltered.squared_error_nm2:.0f} Nm², printed 2.0. A factor on all accelerations would do both, "
        f"as of samples {4.0 * design.izz_kg_m2 / own.izz_kg_m2:.1f} ms apart that are taken for 4 ms; that "
        "is a guess, and the horizontal Izz is too large.",
    )


def _first_vertical(scope: Scope) -> tuple[Unit, ...]:
    return first_unit("vertical", scope)


def _vector_experiment(vector: _Vector) -> Experiment:
    return Experiment(
        f"figure{vector.number}",
        f"Figure {vector.number}: calculated against measured torque, {vector.alignment} ({vector.section})",
        vector.finding,
        partial(_vector_units, vector.alignment),
        partial(_torques_of, vector),
    )


# In the order of the thesis.
PARAMETER_EXPERIMENTS: tuple[Experiment, ...] = (
    TABLE_6,
    Experiment(
        "figure44",
        "Figure 44: dynamic pattern",
        "The thesis cut the steep part out of a windowed sine and repeated it, for large accelerations.",
        _first_vertical,
        _pattern,
    ),
    *AMPLITUDE_EXPERIMENTS,
    *(_vector_experiment(vector) for vector in _VECTORS),
)
