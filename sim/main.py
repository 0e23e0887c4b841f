"""`x5-sim`: the simulated world, and everything that needs it or its truth."""

import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Annotated, NoReturn

import typer
from rich.table import Table

from coordinator.plan import Plan, PlanFileError, load_plan
from coordinator.run_folder import RunFolderError, check_free
from coordinator.terminal import Terminal
from module_agent.wire.network_profile import PROFILES
from sim.bus_server import BusServer
from sim.drawing import draw
from sim.launcher import LaunchConfig, Launcher, LaunchError
from sim.logged_world import LoggedWorld
from sim.noise_profile import NOISE_PROFILES
from sim.robot_file import Robot, RobotFileError, load_robot, shipped_robots
from sim.score import ScoreError, score, table, write_score
from sim.truth import write_truth
from sim.virtual_run import VirtualConfig, run_virtual
from sim.world import World

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Simulate modular robots, run the whole system on them, and score it.",
)

EXIT_FAILED, EXIT_USAGE = 1, 2
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

RobotArgument = Annotated[str, typer.Argument(help="Name of a shipped robot, or a TOML file.")]
Seed = Annotated[int, typer.Option(help="Seed of all noise.")]
Noise = Annotated[str | None, typer.Option(help=f"Noise profile: {', '.join(NOISE_PROFILES)} [the robot's].")]
Network = Annotated[str | None, typer.Option(help=f"Network profile: {', '.join(PROFILES)} [the robot's].")]
Speed = Annotated[float, typer.Option(help="Times real time; slower helps a busy machine.")]
PlanFile = Annotated[Path | None, typer.Option("--plan", help="TOML file with settings of the motions.")]
Dynamics = Annotated[
    bool | None, typer.Option("--dynamics/--no-dynamics", help="Identify inertial parameters too [yes].")
]
Endpoint = Annotated[str, typer.Option(help="Zenoh endpoint of the coordinator.")]
Processes = Annotated[
    int | None, typer.Option(min=1, help="Agent processes that share the modules [one for each module].")
]
Out = Annotated[Path | None, typer.Option(help="Folder of the run [runs/ROBOT].")]


def _fail(text: object, code: int) -> NoReturn:
    typer.echo(f"x5-sim: {text}", err=True)
    raise typer.Exit(code)


def _load(name: str) -> Robot:
    try:
        return load_robot(name)
    except (RobotFileError, OSError) as error:
        _fail(error, EXIT_USAGE)


def _check(network: str | None, noise: str | None) -> None:
    if network is not None and network not in PROFILES:
        _fail(f"--network {network}: known are {', '.join(PROFILES)}", EXIT_USAGE)
    if noise is not None and noise not in NOISE_PROFILES:
        _fail(f"--noise {noise}: known are {', '.join(NOISE_PROFILES)}", EXIT_USAGE)


def _plan(path: Path | None, dynamics: bool | None = None) -> Plan:
    try:
        found = load_plan(path) if path is not None else Plan()
    except PlanFileError as error:
        _fail(error, EXIT_USAGE)
    return found if dynamics is None else found.model_copy(update={"dynamics": dynamics})


def _motion_options(path: Path | None, plan: Plan) -> tuple[str, ...]:
    dynamics = "--dynamics" if plan.dynamics else "--no-dynamics"
    return (dynamics,) if path is None else ("--plan", str(path), dynamics)


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
    Terminal().console.print(shown)


@app.command()
def show(
    robot: RobotArgument,
    out: Annotated[Path | None, typer.Option(help="PNG or SVG to write [ROBOT.png].")] = None,
) -> None:
    """Draw a robot at its zero position."""
    found = _load(robot)
    path = out if out is not None else Path(f"{found.name}.png")
    draw(found, path)
    typer.echo(str(path))


@app.command()
def world(
    robot: RobotArgument,
    bus: Annotated[str, typer.Option(help="Path of the physics bus to open.")],
    seed: Seed = 0,
    noise: Noise = None,
    speed: Speed = 1.0,
    truth: Annotated[
        Path | None, typer.Option(help="Folder for truth.json and truth.npz at the end.")
    ] = None,
) -> None:
    """Run the world of one robot until a signal comes; agents attach to its bus."""
    found = _load(robot)
    _check(None, noise)
    stopping: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        stopping.append(number)

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    plant = World(found, seed, noise)
    logged = LoggedWorld(plant)
    try:
        server = BusServer(bus, logged)
    except OSError as error:
        _fail(error, EXIT_USAGE)
    typer.echo(f"{found.name}: {len(plant.modules)} modules on {bus}", err=True)
    report = server.run(speed, lambda: bool(stopping))
    typer.echo(f"{report.simulated_s:.1f} s at {report.achieved_speed:.2f} times real time", err=True)
    if truth is not None:
        truth.mkdir(parents=True, exist_ok=True)
        write_truth(truth / "truth.json", found)
        logged.log.save(truth / "truth.npz")
    plant.close()


@app.command()
def run(
    robot: RobotArgument,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="In one process, faster than real time.")
    ] = False,
    seed: Seed = 0,
    network: Network = None,
    noise: Noise = None,
    out: Out = None,
    plan: PlanFile = None,
    dynamics: Dynamics = None,
    speed: Speed = 1.0,
    processes: Processes = None,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Identify a simulated robot and score the result against the truth."""
    found = _load(robot)
    _check(network, noise)
    motions = _plan(plan, dynamics)
    folder = out if out is not None else Path("runs") / found.name
    if virtual:
        _run_virtual(found, folder, seed, network, noise, motions, quiet)
    else:
        options = (*_motion_options(plan, motions), *(("--quiet",) if quiet else ()))
        _run_processes(
            LaunchConfig(
                robot_file=robot,
                robot_name=found.name,
                serials=tuple(module.serial for module in found.modules),
                out=folder,
                seed=seed,
                network=network or found.network,
                noise=noise,
                speed=speed,
                endpoint=endpoint,
                coordinator_options=options,
            )
        )
    _score(folder)


def _run_virtual(
    robot: Robot, out: Path, seed: int, network: str | None, noise: str | None, plan: Plan, quiet: bool
) -> None:
    config = VirtualConfig(robot, out, seed, network or robot.network, noise, plan)
    started_s = time.monotonic()
    try:
        with Terminal(quiet) as terminal:
            result = run_virtual(config, terminal)
    except RunFolderError as error:
        _fail(error, EXIT_USAGE)
    except KeyboardInterrupt:
        _fail(f"interrupted; recorded up to here: {out}", 130)
    wall_s = time.monotonic() - started_s
    typer.echo(f"trace hash {result.trace_hash}")
    typer.echo(
        f"{result.robot_time_s:.1f} s of robot time in {wall_s:.1f} s: {result.robot_time_s / wall_s:.1f} x"
    )


def _run_processes(config: LaunchConfig) -> None:
    try:
        # Here, before the world starts: at its end it writes the truth into this folder.
        check_free(config.out)
    except RunFolderError as error:
        _fail(error, EXIT_USAGE)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        with Launcher(config, lambda text: typer.echo(text, err=True)) as launcher:
            _drive(launcher)
    except LaunchError as error:
        _fail(error, EXIT_FAILED)
    except KeyboardInterrupt:
        _fail(f"interrupted, everything is stopped; recorded up to here: {config.out}", 130)


def _drive(launcher: Launcher) -> None:
    launcher.start_world()
    launcher.start_agents()
    coordinator = launcher.start_coordinator()
    while coordinator.process.poll() is None:
        time.sleep(0.1)
    if coordinator.process.returncode:
        raise LaunchError(f"the coordinator ended with {coordinator.process.returncode}")


@app.command()
def launch(
    robot: RobotArgument,
    seed: Seed = 0,
    network: Network = None,
    noise: Noise = None,
    out: Out = None,
    plan: PlanFile = None,
    speed: Speed = 1.0,
    viewer: Annotated[str, typer.Option(help="Live viewer: none, spawn, serve, or an address.")] = "spawn",
    dynamics: Dynamics = None,
    processes: Processes = None,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
) -> None:
    """Start world, agents and coordinator as processes, with the live viewer; Ctrl-C stops everything."""
    found = _load(robot)
    _check(network, noise)
    options = ("--viewer", viewer, *_motion_options(plan, _plan(plan, dynamics)))
    folder = out if out is not None else Path("runs") / found.name
    _run_processes(
        LaunchConfig(
            robot_file=robot,
            robot_name=found.name,
            serials=tuple(module.serial for module in found.modules),
            out=folder,
            seed=seed,
            network=network or found.network,
            noise=noise,
            speed=speed,
            processes=processes,
            endpoint=endpoint,
            coordinator_options=options,
        )
    )
    _score(folder)


@app.command("score")
def score_run(
    folder: Annotated[Path, typer.Argument(help="Folder of a run.")],
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable.")] = False,
) -> None:
    """Compare a run's result with the simulator's truth."""
    _score(folder, as_json)


def _score(folder: Path, as_json: bool = False) -> None:
    try:
        found = score(folder)
    except ScoreError as error:
        _fail(error, EXIT_FAILED)
    write_score(folder / "score.json", found)
    if as_json:
        typer.echo((folder / "score.json").read_text())
    else:
        Terminal().console.print(table(found))


if __name__ == "__main__":
    app()
