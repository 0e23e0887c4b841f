"""`x5-sim fleet`: several robots with a coordinator each on Zenoh routers, and what they cost."""

import signal
import socket
import tempfile
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from coordinator.commands.options import JsonFile
from coordinator.runtime.command_line import fail
from coordinator.runtime.event_loop import SIGNALS, ignore_signals
from coordinator.runtime.terminal import new_table, print_table, write_result
from module_agent.model.errors import EXIT_FAILED, EXIT_INTERRUPTED
from sim.processes.fleet import FleetConfig, run_fleet
from sim.processes.fleet_figures import summary, table_rows
from sim.processes.fleet_plan import plan_fleet
from sim.processes.launcher import LaunchError

_note = partial(typer.echo, err=True)


def fleet(
    robots: Annotated[int, typer.Option(min=1, help="Robots, each with a world and a coordinator.")] = 2,
    modules: Annotated[int, typer.Option(min=1, help="Modules of each robot.")] = 8,
    routers: Annotated[int, typer.Option(min=1, help="Zenoh routers, in a tree of two branches.")] = 1,
    processes: Annotated[
        int | None, typer.Option(min=1, help="Agent processes of each robot [one for each 8 modules].")
    ] = None,
    seconds: Annotated[float, typer.Option(min=1.0, help="How long to measure [s].")] = 30.0,
    speed: Annotated[float, typer.Option(min=0.01, help="Simulated over real time.")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first robot's world.")] = 0,
    port: Annotated[
        int | None, typer.Option(min=1024, max=65000, help="First port of the routers [free ones].")
    ] = None,
    move: Annotated[
        bool, typer.Option("--move", help="Hold all joints and move one of each robot at a time.")
    ] = False,
    truth: Annotated[
        bool, typer.Option("--truth", help="Write each robot's truth.json and truth.npz.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for logs and truths [a temporary one].")] = None,
    json_file: JsonFile = None,
) -> None:
    """Run several robots with a coordinator each on Zenoh routers, and measure what they cost.

    Coordinators receive all rows and request each module's status in turn; the modules stand still, or with
    `--move` their joints move in turn while the others hold.

    Examples: `x5-sim fleet --robots 2 --modules 4 --seconds 10`;
    `x5-sim fleet --robots 8 --modules 16 --routers 3 --speed 0.2 --json runs/fleet.json`.

    Exit codes: 0 measured, 1 a process did not start or ended early, 2 wrong usage, 130 interrupted.
    """
    plan = plan_fleet(robots, modules, _endpoints(routers, port), processes)

    def stop(number: int, _frame: FrameType | None) -> None:
        ignore_signals()
        code = EXIT_INTERRUPTED if number == signal.SIGINT else 128 + number
        fail("interrupted, everything is stopped", code)

    for number in SIGNALS:
        signal.signal(number, stop)
    with ExitStack() as opened:
        folder = out or Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="x5-fleet-")))
        try:
            config = FleetConfig(plan, folder, seconds, speed, seed, move, truth)
            figures = run_fleet(config, _note)
        except LaunchError as error:
            fail(str(error), EXIT_FAILED)
    table = new_table(None, "process | number | CPU % | MiB | grown by MiB | threads | sockets")
    for row in table_rows(figures):
        table.add_row(*row)
    kinds = {kind: each._asdict() for kind, each in figures.kinds.items()}
    if write_result(json_file, {**figures._asdict(), "kinds": kinds}):
        print_table(table)
        typer.echo(summary(figures))


def _endpoints(count: int, first_port: int | None) -> tuple[str, ...]:
    if first_port is not None:
        return tuple(f"tcp/127.0.0.1:{first_port + i}" for i in range(count))
    with ExitStack() as opened:
        # All are open at the same time, so that they differ.
        probes = [opened.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return tuple(f"tcp/127.0.0.1:{probe.getsockname()[1]}" for probe in probes)
