"""`x5-sim compare-log`: a real module's log against the simulated module."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from coordinator.commands.options import JsonFile
from coordinator.runtime.command_line import fail, with_options
from coordinator.runtime.terminal import new_table, print_table, write_result
from module_agent.hardware.hebi_library import log_loader
from module_agent.model.catalogue import CATALOGUE, UnknownModuleType, module_type
from module_agent.model.errors import EXIT_FAILED, UsageError
from module_agent.model.files import write_json
from sim.commands.experiment import ModuleOptions, ProfileName
from sim.real_module.comparison import CommandRefused, SignalRow, compare, simulate
from sim.real_module.real_log import read_hebilog, read_log


@dataclass(frozen=True, kw_only=True)
class IdealModule(ModuleOptions):
    """A module without noise, unless it is asked for."""

    noise: ProfileName = "ideal"


@with_options
def compare_log(
    log: Annotated[
        Path, typer.Argument(help="CSV log or .hebilog of one module alone, strategy 3, factory gains.")
    ],
    modules: IdealModule,
    kind: Annotated[str, typer.Option("--type", help=f"Module type: {', '.join(CATALOGUE)}.")] = "X5-1",
    out: Annotated[
        Path | None, typer.Option(help="Plot to write; its figures go next to it as JSON [LOG.png].")
    ] = None,
    module: Annotated[int, typer.Option(min=1, help="Which module of a .hebilog, in its order.")] = 1,
    json_file: JsonFile = None,
) -> None:
    """Run a real module's commands through the simulated module and compare what both did."""
    try:
        module_type(kind)
        is_hebis = log.suffix.lower() == ".hebilog"
        recorded = read_hebilog(log, module, log_loader()) if is_hebis else read_log(log)
    except UnknownModuleType as error:
        raise UsageError(f"--type: {error}") from error
    except OSError as error:
        raise UsageError(f"{log}: {error.strerror}") from error
    profile = modules.profile()
    try:
        simulated = simulate(recorded, kind, profile, modules.seed)
    except CommandRefused as error:
        fail(f"{log}: {error}", EXIT_FAILED)
    # Loaded here, since nothing else needs matplotlib.
    from sim.real_module.plot import plot

    rows = compare(recorded, simulated)
    picture = out if out is not None else Path(f"{log.stem}.png")
    signals = [row._asdict() for row in rows]
    document = {"log": log.name, "type": kind, "noise": modules.noise, "signals": signals}
    try:
        plot(recorded, simulated, f"{log.stem}: a real {kind} and the simulated one", picture)
        write_json(picture.with_suffix(".json"), document)
    except (ValueError, OSError) as error:
        raise UsageError(f"cannot write {picture}: {error}") from error
    if not write_result(json_file, document):
        return
    print_table(_table(rows))
    typer.echo(f"{picture}, {picture.with_suffix('.json')}")


def _table(rows: list[SignalRow]) -> Table:
    columns = "signal | unit | >rms recorded | >rms difference | >ratio | >ratio after 0.5 s"
    shown = new_table(None, columns)
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
