"""`x5-sim`: the simulated world, and everything that needs it or its truth."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from coordinator.runtime.exit_codes import EXIT_USAGE
from coordinator.runtime.terminal import print_table
from sim.commands.amplitudes import amplitudes
from sim.commands.assistance import assistance
from sim.commands.benchmark import app as benchmark
from sim.commands.compare_log import compare_log
from sim.commands.effects_page import OFF, default_size, page, sizes
from sim.commands.estimators import estimators
from sim.commands.monitoring import monitoring
from sim.commands.options import RobotArgument, fail, load
from sim.commands.run import launch, run, world
from sim.commands.score import score_run
from sim.imperfections.effects import EFFECTS
from sim.imperfections.noise_profile import NOISE_PROFILES
from sim.robot.robot_file import load_robot, shipped_robots

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Simulate modular robots, run the whole system on them, and score it.",
)


@app.command()
def robots() -> None:
    """List the robots that are shipped."""
    shown = Table("robot", "modules", "types", "mounting")
    for name in shipped_robots():
        robot = load_robot(name)
        kinds = [module.type for module in robot.modules]
        backwards = [m.serial for m in robot.modules if m.mounted == "reversed"]
        shown.add_row(
            name,
            str(len(kinds)),
            ", ".join(f"{kinds.count(k)} {k}" for k in dict.fromkeys(kinds)),
            f"{', '.join(backwards)} reversed" if backwards else "forward",
        )
    print_table(shown)


@app.command()
def show(
    robot: RobotArgument,
    out: Annotated[Path | None, typer.Option(help="PNG or SVG to write [ROBOT.png].")] = None,
) -> None:
    """Draw a robot at its zero position."""
    # Loaded here, since nothing else needs matplotlib.
    from sim.robot.drawing import draw

    found = load(robot)
    path = out if out is not None else Path(f"{found.name}.png")
    try:
        draw(found, path)
    except (ValueError, OSError) as error:
        fail(f"cannot draw {path}: {error}", EXIT_USAGE)
    typer.echo(str(path))


@app.command()
def effects(
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable.")] = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="As a page of Markdown.")] = False,
) -> None:
    """List what a simulated module does as a real one: what `--with` and `--without` switch."""
    if markdown:
        typer.echo(page(), nl=False)
        return
    having = {
        name: [p.name for p in NOISE_PROFILES.values() if sizes(effect, p) != OFF]
        for name, effect in EFFECTS.items()
    }
    if as_json:
        rows = [effect._asdict() | {"profiles": having[name]} for name, effect in EFFECTS.items()]
        typer.echo(json.dumps(rows, indent=2))
        return
    shown = Table("effect", "part", "model", "size", "in the profiles", show_lines=True)
    for name, effect in EFFECTS.items():
        shown.add_row(name, effect.part, effect.model, default_size(effect), ", ".join(having[name]))
    print_table(shown)


app.command()(world)
app.command()(run)
app.command()(launch)
app.command("score")(score_run)
app.command()(amplitudes)
app.command()(estimators)
app.command()(assistance)
app.command()(monitoring)
app.command()(compare_log)
app.add_typer(benchmark, name="benchmark")

if __name__ == "__main__":
    app()
