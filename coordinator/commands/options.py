"""Options that several commands share, each declared once, and the connection that they describe."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from coordinator.excitation.plan import Excitation, Mode, Motions, Plan, load_plan
from coordinator.live_robot.connection import Place
from coordinator.runtime.command_line import in_a_folder
from coordinator.runtime.event_loop import check_speed
from module_agent.model.catalogue import ImuKind, TorqueKind
from module_agent.model.errors import UsageError
from module_agent.model.model_faults import faults_of
from module_agent.network_emulation.profile import PROFILES
from module_agent.network_emulation.profile_file import network as network_named
from module_agent.transport.credentials import COORDINATOR, OBSERVER, load_credentials
from module_agent.transport.endpoint import DEFAULT_ENDPOINT
from module_agent.wire.keys import check_chunk

BaselineFolder = Annotated[Path, typer.Argument(help="Folder of an earlier run of this robot, its baseline.")]
DynamicsFolder = Annotated[
    Path, typer.Argument(help="Folder of an earlier run of this robot with dynamics, its baseline.")
]
TakeSuspect = Annotated[
    bool, typer.Option("--suspect", help="Use the model even if its run ended with code 5.")
]
PlanFile = Annotated[Path | None, typer.Option("--plan", help="TOML file with settings of the motions.")]
Expect = Annotated[
    int | None, typer.Option(min=1, help="Wait until this many modules answer; fewer are a failure.")
]
Speed = Annotated[
    float, typer.Option(help="Speed of a simulated world, relative to real time.", callback=check_speed)
]
JsonFile = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Write the result as JSON to this file; - is standard output, in place of the table.",
        callback=in_a_folder,
    ),
]
WithReport = Annotated[
    bool, typer.Option("--report/--no-report", help="Write a page for people, report.html, into the folder.")
]
LiveViewer = Annotated[
    str, typer.Option(help="Live viewer: none, spawn, serve (to a browser), or a rerun+http:// address.")
]
ServePort = Annotated[
    int,
    typer.Option(min=1, max=65534, help="With --viewer serve, port of the page; the next one has the data."),
]
Secure = Annotated[
    Path | None,
    typer.Option(
        "--secure", metavar="DIR", help="Speak mutual TLS with the keys in this folder (`keys` makes it)."
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress.")]


@dataclass(frozen=True)
class ConnectOptions:
    """Where a robot is found on the network, and through which injected network."""

    robot: Annotated[
        str | None,
        typer.Option(
            help="Name of the robot, part of every key [that of the run that is given, else robot]."
        ),
    ] = None
    listen: Annotated[str, typer.Option(help="Zenoh endpoint to listen on, the hub of the agents.")] = (
        DEFAULT_ENDPOINT
    )
    connect: Annotated[
        list[str] | None,
        typer.Option(help="Zenoh router to connect to instead of listening; repeat for several."),
    ] = None
    network: Annotated[
        str, typer.Option(help=f"Injected network: {', '.join(PROFILES)}, or a TOML file.")
    ] = "none"
    seed: Annotated[int, typer.Option(min=0, help="Seed of the injected network.")] = 0
    secure: Secure = None
    quiet: Quiet = False

    def place(self, robot: str = "robot") -> Place:
        """Return where to connect to; `robot` is the name unless one is given.

        Raises:
            UsageError: the name or the network cannot be, or the folder of keys is not this robot's.
        """
        name = self.robot or robot
        check_chunk("robot", name)
        known = load_credentials(self.secure, name, [COORDINATOR, OBSERVER]) if self.secure else None
        network = network_named(self.network)
        return Place(name, self.listen, tuple(self.connect or ()), network, self.seed, known)


@dataclass(frozen=True)
class AgainOptions:
    """How the robot of a baseline is measured again: by a short run, or as a finished run measured it."""

    out: Annotated[Path | None, typer.Option(help="New folder for a short run, and the report.")] = None
    measured: Annotated[Path | None, typer.Option(help="Compare with this finished run; needs no robot.")] = (
        None
    )
    expect: Expect = None
    plan: PlanFile = None
    speed: Speed = 1.0


# Options that are not called as the settings of a plan that they are.
_SETTINGS = {"amplitude": "sine_amplitude_rad", "home": "home_rad"}


@dataclass(frozen=True)
class PlanOptions:
    """How a robot is identified: a plan's file, and settings that take precedence over it."""

    plan: PlanFile = None
    dynamics: Annotated[
        bool | None, typer.Option("--dynamics/--no-dynamics", help="Identify inertial parameters too [yes].")
    ] = None
    amplitude: Annotated[
        float | None, typer.Option(help="Amplitude of the windowed sine [rad]; by module type if not given.")
    ] = None
    home: Annotated[float | None, typer.Option(help="Home position of all joints [rad] [0].")] = None
    imu: Annotated[ImuKind | None, typer.Option(help="Prior of the IMUs' intrinsics [uncalibrated].")] = None
    torque: Annotated[
        TorqueKind | None, typer.Option(help="Prior of the torque sensors' scales [uncalibrated].")
    ] = None
    mode: Annotated[
        Mode | None, typer.Option(help="Explore one joint after the other, or all simultaneously [joint].")
    ] = None
    motions: Annotated[
        Motions | None,
        typer.Option(help="Exploring motions: the same for every joint, or optimised for each [standard]."),
    ] = None
    excitation: Annotated[
        Excitation | None, typer.Option(help="Motions for the inertial parameters [joint-by-joint].")
    ] = None

    def chosen(self) -> Plan:
        """Return the plan with these settings; see `planned`."""
        given = dataclasses.asdict(self)
        path = given.pop("plan")
        return planned(path, **{_SETTINGS.get(name, name): value for name, value in given.items()})

    def arguments(self) -> tuple[str, ...]:
        """Return these options as a command line has them."""
        words: list[str] = []
        for name, value in dataclasses.asdict(self).items():
            if isinstance(value, bool):
                words.append(f"--{name}" if value else f"--no-{name}")
            elif value is not None:
                words += [f"--{name}", str(value)]
        return tuple(words)


def planned(path: Path | None, **given: object) -> Plan:
    """Return the plan of a file, or the default one, with the settings that are given (not None).

    Raises:
        UsageError: the file is no plan, or a setting is out of range: it is named by its option.
    """
    base = load_plan(path) if path is not None else Plan()
    set_here = {name: value for name, value in given.items() if value is not None}
    try:
        # Validated again: an option can be out of range as well.
        return Plan.model_validate({**base.model_dump(), **set_here})
    except ValidationError as error:
        options = {setting: name for name, setting in _SETTINGS.items()}
        lines = []
        for location, reason in faults_of(error):
            name = ".".join(map(str, location))
            option = f"--{options.get(name, name)}" if name in set_here else name
            lines.append(f"{option}: {reason}" if name else reason)
        raise UsageError("\n".join(lines)) from error
