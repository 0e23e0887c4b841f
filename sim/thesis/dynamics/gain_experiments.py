"""Tables 7 to 9 of the thesis: the gains that its arms followed motions with."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

from coordinator.report.document import Cell, Table
from sim.thesis.dynamics.assistance_arms import (
    SMALL,
    THESIS_WAYS,
    WAY_NAMES,
    as_read,
    error_rad,
    setting_units,
    settings_of,
)
from sim.thesis.dynamics.assistance_runs import PER_SECOND, PLAY_AND_SPRING, WAYS, Trial, Trials
from sim.thesis.experiment import Check, Column, Curve, Experiment, Findings, Panel, Plot, Scope, Unit
from sim.thesis.published import TICK_S, Alignment, PidSetting, setting


class _Settings(NamedTuple):
    """A table of gains."""

    number: int
    alignment: Alignment
    strategy: int
    finding: str


_TABLES = (
    _Settings(
        7, "vertical", 3, "The thesis gives three settings of strategy 3 with which it ran the vertical arm."
    ),
    _Settings(
        8, "vertical", 4, "The thesis gives three settings of strategy 4 with which it ran the vertical arm."
    ),
    _Settings(9, "horizontal", 4, "The thesis ran the horizontal arm with the settings of table 8, too."),
)


def _table_units(table: _Settings, scope: Scope) -> tuple[Unit, ...]:
    return setting_units(table.alignment, table.strategy, scope)


def _examine_settings(table: _Settings, measured: list[Trials]) -> Findings:
    names = settings_of(table.strategy)
    checks = []
    for name in names:
        arms = as_read(measured, name)
        unstable = [way for way in THESIS_WAYS if any(trial.ways[way].unstable for trial in arms)]
        text = f"{name} is stable in all modes"
        checks.append(
            Check(f"{text}, but for mode {', '.join(unstable)}" if unstable else text, not unstable)
        )
    per_second = [trial for trial in measured[0] if trial.condition == PER_SECOND.name]
    reading = [
        "The thesis prints no units: integral and derivative gains are per second, or per tick of 1 ms. They "
        "are read per tick. Gains that are not printed are the factory's.",
    ]
    if per_second:
        reading.append(f"Read per second, {_unstable(per_second)} settings and modes are unstable.")
    if springy := [trial for trial in measured[0] if trial.condition == PLAY_AND_SPRING.name]:
        reading.append(
            f"Read per tick, with play in the gear and a stiffening spring, {_unstable(springy)} are: the "
            "module's play is not published, its spring's stiffening is."
        )
    gains = Table(
        caption="Gains as printed, and as the firmware has them: Ki per second, Kd in seconds.",
        columns=(
            Column(name="setting"),
            Column(name="loop"),
            *(Column(name=name, form=".4f", group="printed") for name in ("Kp", "Ki", "Kd")),
            *(Column(name=name, form=".4g", group="used") for name in ("Kp", "Ki", "Kd")),
        ),
        rows=tuple(row for name in names for row in _gain_rows(setting(name))),
    )
    return Findings(checks, (gains,), (_setting_plot(table, measured),), tuple(reading))


def _unstable(trials: Sequence[Trial]) -> str:
    reasons = [trial.ways[way].unstable for trial in trials for way in THESIS_WAYS]
    return f"{sum(map(bool, reasons))} of {len(reasons)}"


def _gain_rows(own: PidSetting) -> list[tuple[Cell, ...]]:
    loops = (("position", own.position), ("velocity", own.velocity), ("torque", own.effort))
    return [(own.name, loop, *terms, terms.kp, terms.ki / TICK_S, terms.kd * TICK_S) for loop, terms in loops]


def _setting_plot(table: _Settings, measured: list[Trials]) -> Plot:
    points = {
        way: [
            (float(name[1:]), 1e3 * error_rad(trial, way))
            for name in settings_of(table.strategy)
            for trial in as_read(measured, name)
            if trial.ways[way].error_rad is not None
        ]
        for way in WAYS
    }
    curves = {
        way: Curve(
            label=WAY_NAMES[way],
            x=tuple(at for at, _ in own),
            y=tuple(error for _, error in own),
            style="points",
        )
        for way, own in points.items()
        if own
    }
    largest = max((max(curve.y) for curve in curves.values()), default=0.0)
    small = tuple(curve for curve in curves.values() if max(curve.y) < SMALL * largest)
    panels = [Panel(y_label="rms error [mrad]", curves=tuple(curves.values()))]
    if small:
        panels.append(Panel(y_label="small errors [mrad]", curves=small))
    return Plot(
        caption=f"Tracking error by setting and input mode, {table.alignment}, strategy {table.strategy}.",
        x_label="setting",
        panels=tuple(panels),
    )


def _table_experiment(table: _Settings) -> Experiment:
    return Experiment(
        f"table{table.number}",
        f"Table {table.number}: gains of strategy {table.strategy}, {table.alignment}",
        table.finding,
        partial(_table_units, table),
        partial(_examine_settings, table),
    )


GAIN_EXPERIMENTS: tuple[Experiment, ...] = tuple(map(_table_experiment, _TABLES))
