"""What the simulator's commands have in common: their options, and refusing what cannot work."""

from pathlib import Path
from typing import Annotated, NoReturn

import typer

from coordinator.excitation.plan import Excitation as PlanExcitation
from coordinator.excitation.plan import Mode as PlanMode
from coordinator.excitation.plan import Motions as PlanMotions
from coordinator.excitation.plan import Plan, PlanFileError, load_plan
from coordinator.recording.run_folder import RunFolderError, check_free
from coordinator.runtime.event_loop import check_speed
from coordinator.runtime.exit_codes import EXIT_USAGE
from module_agent.model.catalogue import ImuKind, TorqueKind
from module_agent.network_emulation.profile import PROFILES
from module_agent.network_emulation.profile_file import network as network_named
from module_agent.transport.endpoint import DEFAULT_ENDPOINT, check_endpoint
from sim.imperfections.noise_profile import NOISE_PROFILES
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import Robot, RobotFileError, load_robot
from sim.world.external_force import Push, check_pushed, parse_push

RobotArgument = Annotated[str, typer.Argument(help="Name of a shipped robot, or a TOML file.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all noise.")]
Noise = Annotated[str | None, typer.Option(help=f"Noise profile: {', '.join(NOISE_PROFILES)} [the robot's].")]
With = Annotated[
    list[str] | None, typer.Option("--with", help="Switch an effect on; repeat. `x5-sim effects` lists them.")
]
Without = Annotated[list[str] | None, typer.Option("--without", help="Switch an effect off; repeat.")]
Pushed = Annotated[
    list[str] | None,
    typer.Option("--push", help="Push a module: serial=S,force_n=[0,0,-10],from_s=2,for_s=0.5; repeat."),
]
Network = Annotated[
    str | None, typer.Option(help=f"Network: {', '.join(PROFILES)}, or a TOML file [the robot's].")
]
Speed = Annotated[float, typer.Option(help="Times real time; slower helps a busy machine.")]
PlanFile = Annotated[Path | None, typer.Option("--plan", help="TOML file with settings of the motions.")]
Dynamics = Annotated[
    bool | None, typer.Option("--dynamics/--no-dynamics", help="Identify inertial parameters too [yes].")
]
Imu = Annotated[ImuKind | None, typer.Option(help="How well the IMUs are known beforehand [uncalibrated].")]
Torque = Annotated[
    TorqueKind | None,
    typer.Option(help="How well the torque sensors' scales are known beforehand [uncalibrated]."),
]
Mode = Annotated[
    PlanMode | None, typer.Option(help="Move one joint after the other, or all joints at once [joint].")
]
Motions = Annotated[
    PlanMotions | None,
    typer.Option("--motions", help="Motions of one joint: standard, or optimised for each joint [standard]."),
]
Excitation = Annotated[
    PlanExcitation | None,
    typer.Option("--excitation", help="Motions for the inertial parameters [joint-by-joint]."),
]
Endpoint = Annotated[str, typer.Option(help="Zenoh endpoint of the coordinator.")]
Processes = Annotated[
    int | None, typer.Option(min=1, help="Agent processes that share the modules [one for each module].")
]
Out = Annotated[Path | None, typer.Option(help="Folder of the run [runs/ROBOT].")]


def fail(text: object, code: int) -> NoReturn:
    """Say on standard error what is wrong, and end the command with an exit code."""
    typer.echo(f"x5-sim: {text}", err=True)
    raise typer.Exit(code)


def load(name: str) -> Robot:
    """Load a robot, or end the command."""
    try:
        return load_robot(name)
    except (RobotFileError, OSError) as error:
        fail(error, EXIT_USAGE)


def check(network: str | None = None, speed: float = 1.0, endpoint: str = DEFAULT_ENDPOINT) -> None:
    """Refuse what cannot work before anything is started."""
    try:
        if network is not None:
            network_named(network)
        check_speed(speed)
        check_endpoint(endpoint)
    except ValueError as error:
        fail(error, EXIT_USAGE)


def noise_choice(robot: Robot, noise: str | None, on: list[str] | None, off: list[str] | None) -> NoiseChoice:
    """Return the noise asked for, or end the command if there is no such profile or effect."""
    choice = NoiseChoice(noise, tuple(on or ()), tuple(off or ()))
    try:
        choice.of(robot)
    except (KeyError, ValueError) as error:
        fail(error.args[0], EXIT_USAGE)
    return choice


def pushes(robot: Robot, texts: list[str] | None) -> tuple[Push, ...]:
    """Return the pushes asked for, or end the command if one is none, or on no module of the robot."""
    try:
        found = tuple(parse_push(text) for text in texts or ())
        for push in found:
            check_pushed(push, robot.serials)
    except ValueError as error:
        fail(error, EXIT_USAGE)
    return found


def free_folder(out: Path | None, robot: Robot) -> Path:
    """Return the folder of a run, which must not hold one: at its end the truth is written there as well."""
    folder = out if out is not None else Path("runs") / robot.name
    try:
        check_free(folder)
    except RunFolderError as error:
        # Another world's modules have booted since: there is nothing to go on from.
        fail(f"{error} with `x5-coordinator run`, if its modules are still up", EXIT_USAGE)
    return folder


def motions(path: Path | None, **given: object) -> Plan:
    """Return the plan of a file with the settings that are given (not None), or end the command."""
    try:
        found = load_plan(path) if path is not None else Plan()
    except PlanFileError as error:
        fail(error, EXIT_USAGE)
    return found.model_copy(update={name: value for name, value in given.items() if value is not None})


def motion_arguments(path: Path | None, plan: Plan) -> tuple[str, ...]:
    """Return a plan as arguments for the coordinator."""
    dynamics = "--dynamics" if plan.dynamics else "--no-dynamics"
    chosen = ("--mode", plan.mode, "--motions", plan.motions, "--excitation", plan.excitation)
    options = (dynamics, "--imu", plan.imu, "--torque", plan.torque, *chosen)
    return options if path is None else ("--plan", str(path), *options)
