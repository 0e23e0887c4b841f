"""`x5-sim world`: the world of one robot, which agents attach to."""

import signal
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from coordinator.runtime.command_line import with_options
from coordinator.runtime.event_loop import SIGNALS
from module_agent.model.errors import UsageError
from module_agent.model.garbage import leave_out_imports
from sim.commands.options import WorldOptions, load
from sim.world.bus_server import BusServer
from sim.world.truth import EVERY_TICKS, TruthLog, write_truth
from sim.world.world import World

# How long the world waits for an agent's command on a busy machine before it steps without it. A late step is
# harmless, while a motor without command spoils a motion. Agents that ended are noticed at once.
PATIENCE_S = 0.2


@with_options
def world(
    bus: Annotated[str, typer.Option(help="Path of the physics bus to open.")],
    settings: WorldOptions,
    truth: Annotated[
        Path | None, typer.Option(help="Folder for truth.json and truth.npz, written at the end.")
    ] = None,
) -> None:
    """Run the world of one robot until a signal comes; agents attach to its bus."""
    robot = load(settings.robot)
    noise, pushes = settings.choice().of(robot), settings.pushes_on(robot)
    stopping: list[int] = []
    for each in SIGNALS:
        signal.signal(each, lambda number, _: stopping.append(number))
    try:
        plant = World(
            robot,
            settings.seed,
            noise,
            pushes=pushes,
            imu_rate_hz=settings.imu_rate_hz,
            physics=settings.physics or "pybullet",
        )
        log = TruthLog(plant, None if truth is None else EVERY_TICKS)
        server = BusServer(bus, log, PATIENCE_S, report=_say)
    except OSError as error:
        raise UsageError(str(error)) from error
    _say(f"{robot.name}: {len(plant.modules)} modules on {bus}")
    leave_out_imports()
    with server:
        report = server.run(settings.speed, lambda: bool(stopping))
    _say(f"{report.simulated_s:.1f} s at {report.achieved_speed:.2f} times real time")
    if truth is not None:
        truth.mkdir(parents=True, exist_ok=True)
        write_truth(truth / "truth.json", robot, plant)
        log.save(truth / "truth.npz")
    plant.close()


def _say(text: str) -> None:
    """Print a line on standard error; a full disk or a closed terminal there does not end the world."""
    with suppress(OSError):
        typer.echo(text, err=True)
