"""Estimators of one joint's radial distance on the thesis' arms: the thesis' own, ours, and its variants."""

from collections.abc import Sequence

from coordinator.report.document import Table
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import load_robot
from sim.thesis.experiment import Check, Column, Curve, Experiment, Findings, Panel, Plot, Scope, Unit
from sim.thesis.kinematics.estimator_variants import (
    VARIANTS,
    Arm,
    Comparison,
    EstimatorRow,
    compare,
    estimator_rows,
)
from sim.thesis.published import ALIGNMENTS, LENGTHS_MM, Alignment

ARMS = tuple(Arm(alignment, length_mm) for alignment in ALIGNMENTS for length_mm in LENGTHS_MM)
_QUICK_ARMS = (Arm("horizontal", 171), Arm("vertical", 484))
_TRIALS, _QUICK_TRIALS = 6, 1
_TRIAL_S = 1.2
# Nominal, less what a few trials leave to chance.
_COVERED = 0.8
_THESIS, _OURS = "thesis", "encoder"


def arm_rows(arm: Arm, trials: int, noise: NoiseChoice, seed: int) -> list[EstimatorRow]:
    """Compare the estimators on an arm over some trials, each with other modules."""
    profile = noise.of(load_robot(f"thesis_{arm.length_mm}_{arm.alignment}"))
    comparisons: list[Comparison] = [
        compare(arm.length_mm, arm.alignment, profile, seed * 1000 + number) for number in range(trials)
    ]
    return estimator_rows(arm, comparisons)


def _units(scope: Scope) -> tuple[Unit, ...]:
    arms, trials = (_QUICK_ARMS, _QUICK_TRIALS) if scope.quick else (ARMS, _TRIALS)
    return tuple(
        Unit(
            f"estimators, {arm.length_mm} mm {arm.alignment}",
            arm_rows,
            (arm, trials, scope.noise, scope.seed),
            list[EstimatorRow],
            _TRIAL_S * trials,
        )
        for arm in arms
    )


def _examine(measured: list[list[EstimatorRow]]) -> Findings:
    rows = [row for rows in measured for row in rows]
    pairs = [(_of(rows, _THESIS), _of(rows, _OURS)) for rows in measured]
    known = [(thesis, ours) for thesis, ours in pairs if thesis is not None and ours is not None]
    better = sum(ours.rms_mm < thesis.rms_mm for thesis, ours in known)
    trials = sum(ours.trials for _, ours in known)
    covered = sum(ours.covered * ours.trials for _, ours in known) / trials if trials else 0.0
    checks = (
        Check(
            f"on {better} of {len(pairs)} arms the joint regression errs less than the thesis' method",
            better == len(pairs) > 0,
        ),
        Check(
            f"its 95 % intervals contain the truth in {100 * covered:.0f} % of {trials} trials: at least "
            f"{100 * _COVERED:.0f} %",
            covered >= _COVERED,
        ),
    )
    reading = (
        "All but the thesis' method solve the same equations (joint regression). The joint's angle is from "
        "the encoder, as in the agents; from the gyro's integral; from both; or by the command's instrument.",
        "The bound is that of any unbiased estimator, given the noise of the encoder and the IMU.",
    )
    return Findings(checks, (_table(rows),), (_plot(rows),), reading)


def _of(rows: Sequence[EstimatorRow], estimator: str) -> EstimatorRow | None:
    return next((row for row in rows if row.estimator == estimator), None)


def _table(rows: Sequence[EstimatorRow]) -> Table:
    columns = (
        Column(name="arm"),
        Column(name="estimator"),
        Column(name="trials", form="d"),
        *(Column(name=name, unit="mm", form=".3f") for name in ("mean |e|", "bias", "rms", "sigma", "bound")),
        Column(name="rms / bound", form=".2f"),
        Column(name="in 95 %", unit="%", form=".0f"),
    )
    return Table.of(
        "Errors of the radial distance.",
        columns,
        [
            (
                f"{row.length_mm} mm {row.alignment}",
                row.estimator,
                row.trials,
                *(row.mean_error_mm, row.bias_mm, row.rms_mm, row.sigma_mm, row.bound_mm),
                row.ratio,
                100.0 * row.covered,
            )
            for row in rows
        ],
    )


def _plot(rows: Sequence[EstimatorRow]) -> Plot:
    # The thesis' method errs by so much more that its variants need panels of their own.
    kinds = (
        ("", tuple(VARIANTS)),
        (", regressions alone", tuple(name for name in VARIANTS if name != _THESIS)),
    )
    panels = tuple(
        Panel(y_label="rms error [mm]", curves=curves, title=f"{alignment}{remark}")
        for alignment in ALIGNMENTS
        for remark, names in kinds
        if (curves := _curves(rows, alignment, names))
    )
    return Plot(
        caption="Rms error of the radial distance by estimator.", x_label="length [mm]", panels=panels
    )


def _curves(rows: Sequence[EstimatorRow], alignment: Alignment, names: Sequence[str]) -> tuple[Curve, ...]:
    curves = []
    for name in names:
        own = [row for row in rows if (row.alignment, row.estimator) == (alignment, name)]
        x, y = tuple(float(row.length_mm) for row in own), tuple(row.rms_mm for row in own)
        curves.append(Curve(label=name, x=x, y=y, style="points"))
    return tuple(curve for curve in curves if curve.x)


ESTIMATORS = Experiment(
    "estimators",
    "Estimators of the link length compared",
    "The thesis' method, circle point analysis, erred by 0.6 to 19.7 mm on its eight arms.",
    _units,
    _examine,
)
