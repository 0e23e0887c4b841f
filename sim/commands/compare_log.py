"""`x5-sim compare-log`: a real module's log against the simulated module."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from coordinator.commands.options import AsJson
from coordinator.runtime.command_line import fail
from coordinator.runtime.terminal import print_table
from module_agent.model.catalogue import CATALOGUE, UnknownModuleType, module_type
from module_agent.model.errors import EXIT_FAILED, EXIT_USAGE, UsageError
from sim.commands.experiment import chosen_profile
from sim.commands.options import Seed, With, Without
from sim.imperfections.noise_profile import NOISE_PROFILES
from sim.real_module.comparison import CommandRefused, SignalRow, compare, simulate
from sim.real_module.real_log import LogFileError, read_log


def compare_log(
    log: Annotated[Path, typer.Argument(help="CSV log of one module alone, strategy 3, factory gains.")],
    kind: Annotated[str, typer.Option("--type", help=f"Module type: {', '.join(CATALOGUE)}.")] = "X5-1",
    out: Annotated[
        Path | None, typer.Option(help="Plot to write; its figures go next to it as JSON [LOG.png].")
    ] = None,
    noise: Annotated[str, typer.Option(help=f"Noise profile: {', '.join(NOISE_PROFILES)}.")] = "ideal",
    with_effects: With = None,
    without_effects: Without = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Run a real module's commands through the simulated module and compare what both did."""
    try:
        module_type(kind)
        profile = chosen_profile(noise, with_effects, without_effects)
    except UnknownModuleType as error:
        fail(f"--type: {error}", EXIT_USAGE)
    except UsageError as error:
        fail(error, EXIT_USAGE)
    try:
        recorded = read_log(log)
    except LogFileError as error:
        fail(error, EXIT_USAGE)
    except OSError as error:
        fail(f"{log}: {error.strerror}", EXIT_USAGE)
    try:
        simulated = simulate(recorded, kind, profile, seed)
    except CommandRefused as error:
        fail(f"{log}: {error}", EXIT_FAILED)
    # Loaded here, since nothing else needs matplotlib.
    from sim.real_module.plot import plot

    rows = compare(recorded, simulated)
    picture = out if out is not None else Path(f"{log.stem}.png")
    text = json.dumps({"log": log.name, "type": kind, "noise": noise, "signals": _records(rows)}, indent=2)
    try:
        plot(recorded, simulated, f"{log.stem}: a real {kind} and the simulated one", picture)
        picture.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    except (ValueError, OSError) as error:
        fail(f"cannot write {picture}: {error}", EXIT_USAGE)
    if as_json:
        typer.echo(text)
        return
    print_table(_table(rows))
    typer.echo(f"{picture}, {picture.with_suffix('.json')}")


def _records(rows: list[SignalRow]) -> list[dict[str, object]]:
    return [dict(row._asdict()) for row in rows]


def _table(rows: list[SignalRow]) -> Table:
    shown = Table("signal", "unit", "rms recorded", "rms difference", "ratio", "ratio after 0.5 s")
    for column in shown.columns[2:]:
        column.justify = "right"
    for row in rows:
        name, unit = _NAMES[row.signal]
        cells = (f"{row.recorded_rms:.4g}", f"{row.difference_rms:.4g}")
        shown.add_row(name, unit, *cells, _percent(row.ratio), _percent(row.settled_ratio))
    return shown


def _percent(ratio: float | None) -> str:
    return "-" if ratio is None else f"{100.0 * ratio:.1f} %"


_NAMES = {
    "position_rad": ("position", "rad"),
    "velocity_rad_s": ("velocity", "rad/s"),
    "pwm": ("PWM", "of the bus voltage"),
    "winding_current_a": ("winding current", "A"),
    "effort_nm": ("effort", "Nm"),
    "winding_temperature_c": ("winding temperature", "deg C"),
}
