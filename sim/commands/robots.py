"""`x5-sim robots` and `show`: the shipped robots, and pictures of robots."""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.runtime.terminal import new_table, print_table
from module_agent.model.errors import UsageError
from sim.commands.options import RobotArgument, load
from sim.robot.robot_file import load_robot, shipped_robots


def robots() -> None:
    """List the robots that are shipped."""
    table = new_table(None, "robot | modules | types | mounting")
    for name in shipped_robots():
        robot = load_robot(name)
        kinds = [module.type for module in robot.modules]
        backwards = [m.serial for m in robot.modules if m.mounted == "reversed"]
        table.add_row(
            name,
            str(len(kinds)),
            ", ".join(f"{kinds.count(k)} {k}" for k in dict.fromkeys(kinds)),
            f"{', '.join(backwards)} reversed" if backwards else "forward",
        )
    print_table(table)


def show(
    robot: RobotArgument,
    out: Annotated[Path | None, typer.Option(help="PNG or SVG to write [ROBOT.png].")] = None,
) -> None:
    """Draw a robot at its zero position."""
    # matplotlib takes a second to import.
    from sim.robot.drawing import draw

    loaded = load(robot)
    path = out if out is not None else Path(f"{loaded.name}.png")
    try:
        draw(loaded, path)
    except (ValueError, OSError) as error:
        raise UsageError(f"cannot draw {path}: {error}") from error
    typer.echo(str(path))
