"""Options that several commands of the simulator share, each declared once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coordinator.commands.options import WithReport
from coordinator.recording.run_folder import RunFolderError, check_free
from coordinator.runtime.event_loop import check_speed
from module_agent.control.gains import catalogue_limits
from module_agent.control.safety import Safety
from module_agent.control.safety_file import read_safety
from module_agent.model.catalogue import module_type
from module_agent.model.errors import UsageError
from module_agent.network_emulation.profile import PROFILES
from module_agent.network_emulation.profile_file import network as network_named
from module_agent.transport.endpoint import DEFAULT_ENDPOINT, check_endpoint
from sim.imperfections.noise_profile import NOISE_PROFILES
from sim.physics.engine import Physics
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import Robot, load_robot
from sim.world.external_force import Push, check_pushed, parse_push
from sim.world.world import check_imu_rate

RobotArgument = Annotated[str, typer.Argument(help="Name of a shipped robot, or a TOML or HRDF file.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all noise.")]
With = Annotated[
    list[str] | None, typer.Option("--with", help="Switch an effect on; repeat. `x5-sim effects` lists them.")
]
Without = Annotated[list[str] | None, typer.Option("--without", help="Switch an effect off; repeat.")]


@dataclass(frozen=True, kw_only=True)
class NoiseOptions:
    """The noise of simulated modules, and its seed."""

    seed: Seed = 0
    noise: Annotated[
        str | None, typer.Option(help=f"Noise profile: {', '.join(NOISE_PROFILES)} [the robot's].")
    ] = None
    with_effects: With = None
    without_effects: Without = None

    def choice(self) -> NoiseChoice:
        """Return the noise profile and effects that were chosen."""
        return NoiseChoice(self.noise, tuple(self.with_effects or ()), tuple(self.without_effects or ()))


@dataclass(frozen=True, kw_only=True)
class WorldOptions(NoiseOptions):
    """A simulated robot and its world."""

    robot: RobotArgument
    push: Annotated[
        list[str] | None,
        typer.Option(help="Push a module: serial=S,force_n=[0,0,-10],from_s=2,for_s=0.5; repeat."),
    ] = None
    speed: Annotated[
        float, typer.Option(help="Times real time; slower helps a busy machine.", callback=check_speed)
    ] = 1.0
    imu_rate_hz: Annotated[
        float, typer.Option(help="Readings of an IMU per second.", callback=check_imu_rate)
    ] = 250.0
    physics: Annotated[
        Physics | None,
        typer.Option(help="What moves the bodies [pybullet in real time, compiled in virtual time]."),
    ] = None

    def pushes_on(self, robot: Robot) -> tuple[Push, ...]:
        """Return the external forces that were chosen.

        Raises:
            UsageError: a text describes none, or the robot has no such module.
        """
        pushes = tuple(parse_push(text) for text in self.push or ())
        for push in pushes:
            check_pushed(push, robot.serials)
        return pushes


@dataclass(frozen=True)
class LaunchOptions:
    """The folder of a run, and how its programs are started and connected."""

    out: Annotated[Path | None, typer.Option(help="Folder of the run; it must be new [runs/ROBOT].")] = None
    network: Annotated[
        str | None, typer.Option(help=f"Network: {', '.join(PROFILES)}, or a TOML file [the robot's].")
    ] = None
    processes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Agent processes that share the modules [one a core, or one for each 8 modules]."
        ),
    ] = None
    listen: Annotated[str, typer.Option(help="Zenoh endpoint that the coordinator listens on.")] = (
        DEFAULT_ENDPOINT
    )
    secure: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Speak mutual TLS, keys in this folder; makes what is missing."),
    ] = None
    safety: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Limits that the modules enforce, as TOML or HEBI safety XML."),
    ] = None
    report: WithReport = True

    def limits_of(self, robot: Robot) -> dict[str, Safety]:
        """Return the limits of the robot's modules by serial, none without a file.

        Raises:
            UsageError: the file is wrong, or leaves a module no position.
        """
        if self.safety is None:
            return {}
        limits = read_safety(self.safety, robot.serials, whole_robot=True)
        for module in robot.modules:
            try:
                limits[module.serial].tightened(catalogue_limits(module_type(module.type)))
            except UsageError as error:
                raise UsageError(f"{self.safety}: {module.serial}: {error}") from error
        return limits

    def check(self) -> None:
        """Check what is wrong before anything is started.

        Raises:
            UsageError: there is no such network, or no such endpoint.
        """
        if self.network is not None:
            network_named(self.network)
        check_endpoint(self.listen)

    def new_folder(self, robot: Robot) -> Path:
        """Return the folder of the run; it must not hold one, since the truth is written there as well.

        Raises:
            UsageError: it holds a run.
        """
        folder = self.out if self.out is not None else Path("runs") / robot.name
        try:
            check_free(folder)
        except RunFolderError as error:
            # The modules of a new world have booted since: there is nothing to resume.
            raise UsageError(f"{error} with `x5-coordinator run`, if its modules are still up") from error
        return folder


def load(name: str) -> Robot:
    """Load a robot.

    Raises:
        UsageError: there is no such robot, or its file is wrong.
    """
    try:
        return load_robot(name)
    except OSError as error:
        raise UsageError(str(error)) from error
