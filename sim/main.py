"""`x5-sim`: the simulated world, and everything that needs it or its truth."""

import signal
import time
from pathlib import Path
from types import FrameType
from typing import Annotated, NamedTuple, NoReturn

import typer
from rich.table import Table

from coordinator.failure import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE, explain
from coordinator.interruption import SIGNALS, Interruption, ignore_signals
from coordinator.plan import Plan, PlanFileError, load_plan
from coordinator.run_folder import RunFolderError, check_free
from coordinator.scaled_loop import check_speed
from coordinator.terminal import Terminal
from coordinator.viewer_choice import viewer_choice
from module_agent.wire.endpoint import DEFAULT_ENDPOINT, check_endpoint
from module_agent.wire.network_profile import PROFILES
from sim.bus_server import BusServer
from sim.drawing import draw
from sim.launcher import LOGS, LaunchConfig, Launcher, LaunchError
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

# How long the world waits for an agent that a busy machine does not let run, before it goes on without it:
# the world's time is its own to stretch, while a motor that is let go in a motion spoils it. Agents that die
# are noticed at once all the same.
PATIENCE_S = 0.2

RobotArgument = Annotated[str, typer.Argument(help="Name of a shipped robot, or a TOML file.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all noise.")]
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


def _check(
    network: str | None = None, noise: str | None = None, speed: float = 1.0, endpoint: str = DEFAULT_ENDPOINT
) -> None:
    """Refuse what cannot work before anything is started."""
    if network is not None and network not in PROFILES:
        _fail(f"--network {network}: known are {', '.join(PROFILES)}", EXIT_USAGE)
    if noise is not None and noise not in NOISE_PROFILES:
        _fail(f"--noise {noise}: known are {', '.join(NOISE_PROFILES)}", EXIT_USAGE)
    try:
        check_speed(speed)
        check_endpoint(endpoint)
    except ValueError as error:
        _fail(error, EXIT_USAGE)


def _folder(out: Path | None, robot: Robot) -> Path:
    """Return the folder of a run, which must not hold one: at its end the truth is written there as well."""
    folder = out if out is not None else Path("runs") / robot.name
    try:
        check_free(folder)
    except RunFolderError as error:
        # Another world's modules have booted since: there is nothing to go on from.
        _fail(f"{error} with `x5-coordinator run`, if its modules are still up", EXIT_USAGE)
    return folder


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
    try:
        draw(found, path)
    except (ValueError, OSError) as error:
        _fail(f"cannot draw {path}: {error}", EXIT_USAGE)
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
    _check(noise=noise, speed=speed)
    stopping: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        stopping.append(number)

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    plant = World(found, seed, noise)
    logged = LoggedWorld(plant)
    try:
        server = BusServer(bus, logged, PATIENCE_S, report=lambda line: typer.echo(line, err=True))
    except OSError as error:
        _fail(error, EXIT_USAGE)
    typer.echo(f"{found.name}: {len(plant.modules)} modules on {bus}", err=True)
    with server:
        report = server.run(speed, lambda: bool(stopping))
    typer.echo(f"{report.simulated_s:.1f} s at {report.achieved_speed:.2f} times real time", err=True)
    if truth is not None:
        truth.mkdir(parents=True, exist_ok=True)
        write_truth(truth / "truth.json", found, plant)
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
    _check(network, noise, speed, endpoint)
    motions = _plan(plan, dynamics)
    folder = _folder(out, found)
    if virtual:
        _run_virtual(VirtualConfig(found, folder, seed, network or found.network, noise, motions), quiet)
    else:
        options = (*_motion_options(plan, motions), *(("--quiet",) if quiet else ()))
        place = _Place(folder, network or found.network, endpoint, processes)
        _run_processes(_launch(robot, found, place, seed, noise, speed, options))
    _score(folder)


class _Place(NamedTuple):
    """Where the processes of a run meet, and where they write."""

    out: Path
    network: str
    endpoint: str
    processes: int | None


def _launch(
    robot_file: str,
    robot: Robot,
    place: _Place,
    seed: int,
    noise: str | None,
    speed: float,
    options: tuple[str, ...],
) -> LaunchConfig:
    return LaunchConfig(
        robot_file=robot_file,
        robot_name=robot.name,
        serials=robot.serials,
        out=place.out,
        seed=seed,
        network=place.network,
        noise=noise,
        speed=speed,
        endpoint=place.endpoint,
        processes=place.processes,
        # The robot ends with this run, so that nothing is left to go on with.
        coordinator_options=("--no-advise", *options),
    )


def _run_virtual(config: VirtualConfig, quiet: bool) -> None:
    def on_signal(interruption: Interruption) -> None:
        def stop(_number: int, _frame: FrameType | None) -> None:
            ignore_signals()
            interruption()

        for number in SIGNALS:
            signal.signal(number, stop)

    started_s = time.monotonic()
    try:
        with Terminal(quiet) as terminal:
            result = run_virtual(config, terminal, on_signal=on_signal)
    except BaseException as error:
        failure = explain(error)
        if failure is None:
            raise
        _fail(f"{failure.text}; recorded up to here: {config.out}", failure.exit_code)
    wall_s = time.monotonic() - started_s
    typer.echo(f"trace hash {result.trace_hash}")
    typer.echo(
        f"{result.robot_time_s:.1f} s of robot time in {wall_s:.1f} s: {result.robot_time_s / wall_s:.1f} x"
    )


class _Stopped(Exception):
    """SIGINT or SIGTERM came; `number` says which."""

    def __init__(self, number: int):
        super().__init__(signal.strsignal(number))
        self.number = number


def _stop(number: int, _frame: FrameType | None) -> None:
    # Once: everything is then stopped in order, and a second signal would leave some of it behind.
    ignore_signals()
    raise _Stopped(number)


def _run_processes(config: LaunchConfig) -> None:
    for number in SIGNALS:
        signal.signal(number, _stop)
    try:
        with Launcher(config, lambda text: typer.echo(text, err=True)) as launcher:
            launcher.start_world()
            launcher.start_agents()
            code = launcher.watch(launcher.start_coordinator())
    except LaunchError as error:
        _fail(f"{error}; logs: {config.out / LOGS}", EXIT_FAILED)
    except _Stopped as stopped:
        code = EXIT_INTERRUPTED if stopped.number == signal.SIGINT else 128 + stopped.number
        _fail(f"interrupted, everything is stopped; recorded up to here: {config.out}", code)
    if code:
        _fail(f"the coordinator ended with {code}; logs of the others: {config.out / LOGS}", code)


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
    _check(network, noise, speed, endpoint)
    try:
        viewer_choice(viewer)
    except ValueError as error:
        _fail(error, EXIT_USAGE)
    options = ("--viewer", viewer, *_motion_options(plan, _plan(plan, dynamics)))
    place = _Place(_folder(out, found), network or found.network, endpoint, processes)
    _run_processes(_launch(robot, found, place, seed, noise, speed, options))
    _score(place.out)


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
