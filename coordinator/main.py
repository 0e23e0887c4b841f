"""`x5-coordinator`: identify a robot, replay a recording, list, stop, picture."""

import shlex
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from coordinator.baseline.known_robot import BaselineError, baseline_within
from coordinator.baseline.update import updated
from coordinator.commands.attended_run import Place, join, run_attended, sender_name
from coordinator.commands.check import check_robot
from coordinator.commands.compensate import compensate_robot
from coordinator.commands.fit_dynamics import fit_dynamics
from coordinator.commands.merge import merge
from coordinator.commands.monitor import monitor_robot
from coordinator.commands.options import Connect, Expect, Listen, Network, Robot, fail, planned
from coordinator.commands.payload import find_payload
from coordinator.excitation.plan import Excitation, Mode, Motions
from coordinator.identification.identified import IdentificationError
from coordinator.identification.identify import identify
from coordinator.identification.result import DynamicsPart, Result
from coordinator.live_robot.discovery import AS_HUB_S, Search, listed, stop_robot
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import load_recording
from coordinator.recording.session_file import SessionFileError
from coordinator.runtime.event_loop import check_speed
from coordinator.runtime.exit_codes import EXIT_FAILED, EXIT_USAGE
from coordinator.runtime.terminal import Terminal
from coordinator.session.run import RunConfig, write_outputs
from coordinator.viewer.targets import viewer_choice
from module_agent.model.catalogue import ImuKind, TorqueKind, UnknownModuleType
from module_agent.network_emulation.profile_file import network as network_named
from module_agent.transport.endpoint import DEFAULT_ENDPOINT
from module_agent.transport.transport import Transport, TransportError
from module_agent.wire.keys import check_chunk

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Let a robot measure its own body.",
)

Enough = Annotated[
    int | None, typer.Option(min=1, help="Search until so many are there; fewer is a failure.")
]


@app.command()
def run(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder of the run, made new.")],
    robot: Robot = "robot",
    listen: Listen = DEFAULT_ENDPOINT,
    connect: Connect = None,
    network: Network = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the injected network.")] = 0,
    expect: Expect = None,
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
    imu: Annotated[
        ImuKind | None, typer.Option(help="How well the IMUs are known [uncalibrated, as delivered].")
    ] = None,
    torque: Annotated[
        TorqueKind | None,
        typer.Option(help="How well the torque sensors' scales are known [uncalibrated, as delivered]."),
    ] = None,
    mode: Annotated[
        Mode | None, typer.Option(help="Move one joint after the other, or all joints at once [joint].")
    ] = None,
    motions: Annotated[
        Motions | None,
        typer.Option(help="Motions of one joint: standard, or optimised for each joint [standard]."),
    ] = None,
    excitation: Annotated[
        Excitation | None,
        typer.Option(help="Motions for the inertial parameters [joint-by-joint]."),
    ] = None,
    baseline: Annotated[
        Path | None,
        typer.Option(
            help="Folder of an earlier run of this robot: only joints that differ are explored again."
        ),
    ] = None,
    viewer: Annotated[
        str, typer.Option(help="Live viewer: none, spawn, serve, or a rerun+http:// address.")
    ] = "none",
    serve_port: Annotated[
        int, typer.Option(min=1, max=65534, help="Port of the viewer served to a browser.")
    ] = 9090,
    resume: Annotated[bool, typer.Option(help="Go on with the crashed run in --out.")] = False,
    speed: Annotated[float, typer.Option(help="Speed of a simulated world.")] = 1.0,
    advise: Annotated[
        bool, typer.Option("--advise/--no-advise", hidden=True, help="Say how a run that ended is resumed.")
    ] = True,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Discover a robot, move it joint by joint, and identify topology, chain and inertia."""
    try:
        shown = viewer_choice(viewer)
        check_chunk("robot", robot)
        check_speed(speed)
        injected = network_named(network)
    except ValueError as error:
        fail(error, EXIT_USAGE)
    config = RunConfig(
        robot=robot,
        out=out,
        sender=sender_name(),
        plan=planned(
            plan,
            dynamics=dynamics,
            sine_amplitude_rad=amplitude,
            home_rad=home,
            imu=imu,
            torque=torque,
            mode=mode,
            motions=motions,
            excitation=excitation,
        ),
        expect=expect,
        resume=resume,
        spawn_viewer=shown.spawn,
        connect_viewer=shown.connect,
        serve_viewer=serve_port if shown.serve else None,
        baseline=baseline,
    )
    advice = f"to go on: {resuming(context)}" if advise else ""
    with Terminal(quiet) as terminal:
        result = run_attended(
            config, Place(listen, tuple(connect or ()), injected, seed), speed, terminal, advice
        )
    _print(result, terminal)
    terminal.console.print(f"written to {out}", markup=False, soft_wrap=True)


def resuming(context: typer.Context) -> str:
    """Return the command that goes on with a run: what was given, with `--resume`."""
    words = ["x5-coordinator", "run"]
    for option in context.command.params:
        name = option.name or ""
        source = context.get_parameter_source(name)
        if source is None or source.name != "COMMANDLINE" or name == "resume":
            continue
        value = context.params[name]
        if isinstance(value, bool):
            words.append((option.opts if value else option.secondary_opts)[0])
        else:
            for one in value if isinstance(value, list | tuple) else [value]:
                words += [option.opts[0], str(one)]
    return shlex.join([*words, "--resume"])


def _print(result: Result, terminal: Terminal) -> None:
    table = Table("parent", "child", "link length [mm]", "+-", title=f"{result.robot}: links")
    for link in result.links:
        table.add_row(
            link.parent, link.child, f"{link.link_length_mm:.1f}", f"{link.link_length_sigma_mm:.1f}"
        )
    terminal.console.print(table)
    for item in result.unresolved:
        terminal.note(f"not identifiable: {item.words}")
    if result.dynamics is not None:
        _print_inertia(result.dynamics, terminal)
    terminal.note(f"trace hash {result.trace_hash}")


def _print_inertia(dynamics: DynamicsPart, terminal: Terminal) -> None:
    for line in dynamics.words:
        terminal.note(line)
    if dynamics.held_out is None:
        return
    real = dynamics.bodies.held_out_relative_error if dynamics.bodies is not None else None
    terminal.note(
        f"inertia: {dynamics.rank} of {dynamics.parameters} parameters; torque on held-out "
        f"motions predicted to {100 * dynamics.held_out.relative_error:.1f} %"
        + ("" if real is None else f", by the real bodies in the URDF to {100 * real:.1f} %")
    )


@app.command()
def replay(
    session: Annotated[Path, typer.Argument(help="A session.mcap.")],
    out: Annotated[Path | None, typer.Option(help="Folder for result.json [folder of the session].")] = None,
) -> None:
    """Compute the same result again from a recording, without a robot."""
    folder = out if out is not None else session.parent
    try:
        recording: Recording = load_recording(session)
        before = baseline_within(session.parent)
        found = identify(recording, partial(updated, before) if before is not None else None)
    except (SessionFileError, IdentificationError, UnknownModuleType, BaselineError) as error:
        fail(error, EXIT_FAILED)
    folder.mkdir(parents=True, exist_ok=True)
    write_outputs(folder, found)
    _print(found.result, Terminal())


def _search(
    robot: str, listen: str, connect: list[str] | None, expect: int | None
) -> tuple[Transport, Search]:
    """Join a robot's network to look at it; whoever is its hub now waits for the agents to come."""
    try:
        check_chunk("robot", robot)
        joined = join(Place(listen, tuple(connect or ())), Terminal())
    except (ValueError, OSError, TransportError) as error:
        fail(error, EXIT_USAGE)
    return joined.transport, Search(least_s=AS_HUB_S if joined.is_hub else 0.0, expect=expect)


def _check_all(robot: str, found: int, expect: int | None) -> None:
    if not found:
        fail(f"no module of robot {robot!r} answers", EXIT_FAILED)
    if expect is not None and found < expect:
        fail(f"{found} modules of robot {robot!r} answer, {expect} are expected", EXIT_FAILED)


@app.command("list")
def list_modules(
    robot: Robot = "robot",
    listen: Listen = DEFAULT_ENDPOINT,
    connect: Connect = None,
    expect: Enough = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable.")] = False,
) -> None:
    """List the modules on the network: state, holder, refusals."""
    transport, search = _search(robot, listen, connect, expect)
    statuses, deaf = listed(transport, robot, search)
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
        Terminal().console.print(table)
    if deaf:
        fail(f"no status from {', '.join(deaf)}", EXIT_FAILED)
    _check_all(robot, len(statuses), expect)


@app.command()
def stop(
    robot: Robot = "robot", listen: Listen = DEFAULT_ENDPOINT, connect: Connect = None, expect: Enough = None
) -> None:
    """Stop every module of a robot at once, whoever holds it."""
    transport, search = _search(robot, listen, connect, expect)
    stopped, deaf = stop_robot(transport, robot, sender_name(), search)
    Terminal().note(f"stopped: {', '.join(stopped) or 'none'}")
    if deaf:
        fail(f"no confirmation from {', '.join(deaf)}", EXIT_FAILED)
    _check_all(robot, len(stopped), expect)


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
        fail(error, EXIT_FAILED)


app.command("check")(check_robot)
app.command("payload")(find_payload)
app.command("merge")(merge)
app.command("monitor")(monitor_robot)
app.command("fit-dynamics")(fit_dynamics)
app.command("compensate")(compensate_robot)


if __name__ == "__main__":
    app()
