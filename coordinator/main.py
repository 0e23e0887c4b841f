"""`x5-coordinator`: identify a robot, replay a recording, list, stop, picture."""

import asyncio
import os
import secrets
import signal
import socket
from pathlib import Path
from typing import Annotated, NoReturn

import numpy as np
import typer
from pydantic import ValidationError
from rich.table import Table

from coordinator.identify import IdentificationError, identify
from coordinator.inspect import listed, stop_robot
from coordinator.plan import Plan, PlanFileError, load_plan
from coordinator.radio import NoAnswer, Refused
from coordinator.recording import Recording
from coordinator.result import Result
from coordinator.robot_link import ModuleLost, MotionInterrupted, RobotStopped
from coordinator.run import Run, RunConfig, write_outputs
from coordinator.run_folder import load_recording
from coordinator.scaled_loop import ScaledLoop
from coordinator.session import NobodyThere, UnfitLink
from coordinator.session_file import SessionFileError
from coordinator.terminal import Terminal
from module_agent.wire.impaired_transport import ImpairedTransport
from module_agent.wire.keys import check_chunk
from module_agent.wire.network_profile import PROFILES, profile
from module_agent.wire.timer_thread import TimerThread
from module_agent.wire.transport import Transport, TransportError
from module_agent.wire.zenoh_transport import ZenohConfig, open_zenoh

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Let a robot measure its own body.",
)

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
JOIN_TIMEOUT_S = 5.0
EXIT_FAILED, EXIT_USAGE, EXIT_LOST, EXIT_INTERRUPTED = 1, 2, 3, 130

Robot = Annotated[str, typer.Option(help="Name of the robot, part of every key.")]
Listen = Annotated[str, typer.Option(help="Zenoh endpoint to listen on, the hub of the agents.")]
Connect = Annotated[
    list[str] | None,
    typer.Option(help="Zenoh router to connect to, instead of listening; repeat for several."),
]
Network = Annotated[str, typer.Option(help=f"Injected network: {', '.join(PROFILES)}.")]


def _fail(text: object, code: int) -> NoReturn:
    typer.echo(f"x5-coordinator: {text}", err=True)
    raise typer.Exit(code)


def _open(listen: str, connect: list[str] | None, terminal: Terminal) -> Transport:
    if connect:
        routers = ZenohConfig(mode="client", connect=tuple(connect), connect_timeout_s=JOIN_TIMEOUT_S)
        return open_zenoh(routers)
    try:
        return open_zenoh(ZenohConfig(mode="router", listen=(listen,)))
    except TransportError:
        # Somebody listens there already: another coordinator, or a router. Join it as a client.
        joining = ZenohConfig(mode="client", connect=(listen,), connect_timeout_s=JOIN_TIMEOUT_S)
        transport = open_zenoh(joining)
        terminal.note(f"{listen} is in use: joined the hub there")
        return transport


def _impaired(transport: Transport, network: str, seed: int) -> Transport:
    if network == "none":
        return transport
    return ImpairedTransport(transport, profile(network), np.random.default_rng(seed), TimerThread())


def _sender() -> str:
    return f"coordinator-{os.getpid()}@{socket.gethostname()}-{secrets.token_hex(2)}"[:64]


@app.command()
def run(
    out: Annotated[Path, typer.Option(help="Folder of the run, made new.")],
    robot: Robot = "robot",
    listen: Listen = DEFAULT_ENDPOINT,
    connect: Connect = None,
    network: Network = "none",
    seed: Annotated[int, typer.Option(help="Seed of the injected network.")] = 0,
    expect: Annotated[int | None, typer.Option(help="Wait for this many modules.")] = None,
    plan: Annotated[
        Path | None,
        typer.Option(help="TOML file with settings of the motions; the options below go before it."),
    ] = None,
    dynamics: Annotated[
        bool | None, typer.Option("--dynamics/--no-dynamics", help="Identify inertial parameters too [yes].")
    ] = None,
    amplitude: Annotated[
        float | None, typer.Option(help="Amplitude of the windowed sine [rad]; by module type if not given.")
    ] = None,
    home: Annotated[float | None, typer.Option(help="Home position of all joints [rad] [0].")] = None,
    viewer: Annotated[
        str, typer.Option(help="Live viewer: none, spawn, serve, or a rerun+http:// address.")
    ] = "none",
    serve_port: Annotated[int, typer.Option(help="Port of the viewer served to a browser.")] = 9090,
    resume: Annotated[bool, typer.Option(help="Go on with the crashed run in --out.")] = False,
    speed: Annotated[float, typer.Option(help="Speed of a simulated world.")] = 1.0,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Discover a robot, move it joint by joint, and identify topology, chain and inertia."""
    if viewer not in ("none", "spawn", "serve") and "://" not in viewer:
        _fail(
            f"--viewer {viewer}: it must be none, spawn, serve or an address like rerun+http://...",
            EXIT_USAGE,
        )
    config = RunConfig(
        robot=robot,
        out=out,
        sender=_sender(),
        plan=_plan(plan, dynamics, amplitude, home),
        expect=expect,
        resume=resume,
        spawn_viewer=viewer == "spawn",
        connect_viewer=viewer if "://" in viewer else None,
        serve_viewer=serve_port if viewer == "serve" else None,
    )
    with Terminal(quiet) as terminal:
        result = _run(config, listen, connect, network, seed, speed, terminal)
    _print(result, terminal)
    terminal.console.print(f"written to {out}", markup=False, soft_wrap=True)


def _plan(path: Path | None, dynamics: bool | None, amplitude: float | None, home: float | None) -> Plan:
    given = {"dynamics": dynamics, "sine_amplitude_rad": amplitude, "home_rad": home}
    try:
        base = load_plan(path) if path is not None else Plan()
        # Validated again: an option can be out of range as well.
        return Plan.model_validate({**base.model_dump(), **{k: v for k, v in given.items() if v is not None}})
    except PlanFileError as error:
        _fail(error, EXIT_USAGE)
    except ValidationError as error:
        first = error.errors()[0]
        _fail(f"{first['loc'][0]} = {first['input']}: {first['msg']}", EXIT_USAGE)


def _run(
    config: RunConfig,
    listen: str,
    connect: list[str] | None,
    network: str,
    seed: int,
    speed: float,
    terminal: Terminal,
) -> Result:
    loop = ScaledLoop(speed)
    try:
        check_chunk("robot", config.robot)
        transport = _impaired(_open(listen, connect, terminal), network, seed)
        work = Run(config, transport, loop.clock_ns, loop.call_soon_threadsafe, terminal)
    except (ValueError, KeyError, OSError, TransportError) as error:
        loop.close()
        _fail(error.args[0] if isinstance(error, KeyError) else error, EXIT_USAGE)
    kept = f"recorded up to here: {config.out}; `x5-coordinator run --resume --out {config.out}` goes on"
    task = loop.create_task(work.run())
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    try:
        return loop.run_until_complete(task)
    except asyncio.CancelledError:
        _fail(f"interrupted, the robot is stopped; {kept}", EXIT_INTERRUPTED)
    except ModuleLost as error:
        _fail(f"{error}; {kept}", EXIT_LOST)
    except (
        NobodyThere,
        UnfitLink,
        NoAnswer,
        Refused,
        MotionInterrupted,
        RobotStopped,
        IdentificationError,
    ) as error:
        _fail(f"{error}; {kept}", EXIT_FAILED)
    finally:
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()


def _print(result: Result, terminal: Terminal) -> None:
    table = Table("parent", "child", "link length [mm]", "+-", title=f"{result.robot}: links")
    for link in result.links:
        table.add_row(
            link.parent, link.child, f"{link.link_length_mm:.1f}", f"{link.link_length_sigma_mm:.1f}"
        )
    terminal.console.print(table)
    for item in result.unresolved:
        terminal.note(f"not identifiable: {item.words}")
    if result.dynamics is not None and result.dynamics.held_out is not None:
        terminal.note(
            f"inertia: {result.dynamics.rank} of {result.dynamics.parameters} parameters; torque on held-out "
            f"motions predicted to {100 * result.dynamics.held_out.relative_error:.1f} %"
        )
    terminal.note(f"trace hash {result.trace_hash}")


@app.command()
def replay(
    session: Annotated[Path, typer.Argument(help="A session.mcap.")],
    out: Annotated[Path | None, typer.Option(help="Folder for result.json [folder of the session].")] = None,
) -> None:
    """Compute the same result again from a recording, without a robot."""
    folder = out if out is not None else session.parent
    try:
        recording: Recording = load_recording(session)
        found = identify(recording)
    except (SessionFileError, IdentificationError) as error:
        _fail(error, EXIT_FAILED)
    folder.mkdir(parents=True, exist_ok=True)
    write_outputs(folder, found)
    _print(found.result, Terminal())


@app.command("list")
def list_modules(
    robot: Robot = "robot",
    listen: Listen = DEFAULT_ENDPOINT,
    connect: Connect = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable.")] = False,
) -> None:
    """List the modules on the network: state, holder, refusals."""
    terminal = Terminal()
    try:
        transport = _open(listen, connect, terminal)
    except TransportError as error:
        _fail(error, EXIT_USAGE)
    statuses = listed(transport, robot)
    if as_json:
        typer.echo("[" + ",\n ".join(status.model_dump_json() for status in statuses) + "]")
    else:
        table = Table("serial", "state", "holder", "expiries", "refused", title=robot)
        for status in statuses:
            table.add_row(
                status.serial,
                status.state,
                status.holder or "-",
                str(status.expiries),
                ", ".join(f"{k} {v}" for k, v in status.refusals.items()) or "-",
            )
        terminal.console.print(table)
    if not statuses:
        _fail(f"no module of robot {robot!r} answers", EXIT_FAILED)


@app.command()
def stop(robot: Robot = "robot", listen: Listen = DEFAULT_ENDPOINT, connect: Connect = None) -> None:
    """Stop every module of a robot at once, whoever holds it."""
    terminal = Terminal()
    try:
        transport = _open(listen, connect, terminal)
    except TransportError as error:
        _fail(error, EXIT_USAGE)
    stopped, deaf = stop_robot(transport, robot, _sender())
    terminal.note(f"stopped: {', '.join(stopped) or 'none'}")
    if deaf or not stopped:
        _fail(f"no confirmation from {', '.join(deaf) or 'any module'}", EXIT_FAILED)


@app.command()
def screenshot(
    recording: Annotated[Path, typer.Argument(help="A session.rrd.")],
    out: Annotated[Path, typer.Option(help="PNG file to write.")],
    tab: Annotated[str | None, typer.Option(help="Tab to show.")] = None,
) -> None:
    """Picture a recording as the viewer shows it, without a screen."""
    from coordinator.viewer.screenshot import ScreenshotFailed
    from coordinator.viewer.screenshot import screenshot as picture

    try:
        picture(recording, out, tab)
    except (ScreenshotFailed, ValueError, OSError) as error:
        _fail(error, EXIT_FAILED)


if __name__ == "__main__":
    app()
