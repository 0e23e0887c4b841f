"""`x5-sim run`: the whole system on a simulated robot, in virtual time or as processes."""

import signal
import time
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from coordinator.commands.options import LiveViewer, PlanOptions, Quiet, ServePort
from coordinator.commands.view import live_page
from coordinator.live_robot.authority import make_credentials
from coordinator.recording.run_folder import REPORT, RESULT
from coordinator.runtime.command_line import ENDINGS, end_if_suspect, ending, fail, with_options
from coordinator.runtime.event_loop import SIGNALS, Interruption, ignore_signals
from coordinator.runtime.terminal import Terminal
from coordinator.viewer.targets import NATIVE_PORT, SERVE_PORT, proxy_url, viewer_choice
from module_agent.model.errors import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_SUSPECT, UsageError
from module_agent.transport.endpoint import DEFAULT_ENDPOINT
from sim.commands.options import LaunchOptions, WorldOptions, load
from sim.commands.score import score_run
from sim.processes.launcher import LOGS, LaunchConfig, Launcher, LaunchError, default_processes
from sim.robot.robot_file import RobotFileError
from sim.scoring.score import ScoreError
from sim.scoring.truth_recording import add_truth
from sim.virtual_time.run import VirtualConfig, run_virtual

_note = partial(typer.echo, err=True)
# Previews of larger robots are only assembled: their refinements would take longer than the run.
MAX_REFINED_MODULES = 8


@with_options
def run(
    settings: WorldOptions,
    launched: LaunchOptions,
    motions: PlanOptions,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="In one process, faster than real time.")
    ] = False,
    viewer: LiveViewer = "none",
    serve_port: ServePort = SERVE_PORT,
    quiet: Quiet = False,
) -> None:
    """Identify a simulated robot and score the result against the truth; Ctrl-C stops everything.

    World, agents and coordinator are processes, or with --virtual one process on a virtual clock. With
    --viewer serve the page is served on after the end, until Ctrl-C.
    """
    if not virtual:
        _launch(settings, launched, motions, viewer, serve_port, quiet)
        return
    if viewer != "none":
        raise UsageError(
            f"--viewer {viewer}: with --virtual there is nothing live; look at session.rrd after it"
        )
    robot = load(settings.robot)
    launched.check()
    unused = {
        "--secure": launched.secure is not None,
        "--processes": launched.processes is not None,
        "--listen": launched.listen != DEFAULT_ENDPOINT,
        "--speed": settings.speed != 1.0,
    }
    if any(unused.values()):
        names = ", ".join(name for name, given in unused.items() if given)
        _note(f"x5-sim: {names}: not used, since with --virtual all is in one process, without a network")
    config = VirtualConfig(
        robot=robot,
        seed=settings.seed,
        network=launched.network or robot.network,
        noise=settings.choice().of(robot),
        pushes=settings.pushes_on(robot),
        imu_rate_hz=settings.imu_rate_hz,
        physics=settings.physics,
        plan=motions.chosen(),
        refined_previews=MAX_REFINED_MODULES,
        out=launched.new_folder(robot),
        report=launched.report,
        safety=launched.limits_of(robot),
    )
    suspicions = _run_virtual(config, quiet)
    _score(config.out)
    _print_report(config.out)
    end_if_suspect(suspicions)


@with_options
def launch(
    settings: WorldOptions,
    launched: LaunchOptions,
    motions: PlanOptions,
    viewer: LiveViewer = "spawn",
    serve_port: ServePort = SERVE_PORT,
) -> None:
    """Do as `run --viewer spawn`, whose older name this is."""
    _launch(settings, launched, motions, viewer, serve_port, quiet=False)


def _launch(
    settings: WorldOptions,
    launched: LaunchOptions,
    motions: PlanOptions,
    viewer: str,
    serve_port: int,
    quiet: bool,
) -> None:
    """Run all processes, then score the result, and draw the truth in the recording and in the viewer."""
    choice = viewer_choice(viewer, serve_port)
    # Where the viewer can still be reached when the run is over.
    reachable = proxy_url(NATIVE_PORT) if choice.spawn else choice.connect
    # The page is this program's own: it stays when the coordinator has ended, and gets the truth, too.
    shown = ("--viewer", choice.connect or viewer, *(("--quiet",) if quiet else ()))
    robot = load(settings.robot)
    launched.check()
    # The noise, the plan and the pushes are checked here; coordinator and world read them again.
    settings.choice().of(robot)
    plan = motions.chosen()
    settings.pushes_on(robot)
    limits = launched.limits_of(robot)
    reported = () if launched.report else ("--no-report",)
    config = LaunchConfig(
        robot_file=settings.robot,
        robot_name=robot.name,
        serials=robot.serials,
        seed=settings.seed,
        network=launched.network or robot.network,
        noise=settings.choice(),
        speed=settings.speed,
        endpoint=launched.listen,
        processes=launched.processes or default_processes(len(robot.serials)),
        pushes=tuple(settings.push or ()),
        imu_rate_hz=settings.imu_rate_hz,
        physics=settings.physics or "pybullet",
        agent_options=("--imu", plan.imu),
        # The robot ends with this run, so that there is nothing to resume.
        coordinator_options=("--no-advise", *reported, *shown, *motions.arguments()),
        out=launched.new_folder(robot),
        secure=launched.secure,
        safety=limits,
    )
    if config.secure is not None:
        make_credentials(config.secure, robot.name, robot.serials, [s for s in config.shares if len(s) > 1])
    with live_page(viewer, serve_port) as stay:
        code = _run_processes(config)
        add_truth(config.out, reachable, _note)
        _score(config.out)
        _print_report(config.out)
        stay()
    if code:
        # The coordinator has said why.
        raise typer.Exit(code)


def _run_virtual(config: VirtualConfig, quiet: bool) -> list[str]:
    """Run in virtual time; return why the result is not to be believed as usual, if there is anything."""

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
    except RobotFileError:
        raise
    except ENDINGS as error:
        end = ending(error)
        fail(f"{end}; recorded up to here: {config.out}", end.exit_code)
    wall_s = time.monotonic() - started_s
    typer.echo(f"trace hash {result.trace_hash}")
    typer.echo(
        f"{result.robot_time_s:.1f} s of robot time in {wall_s:.1f} s: {result.robot_time_s / wall_s:.1f} x"
    )
    return result.suspicions


def _score(out: Path) -> None:
    """Score a run that has just ended; what is wrong with it then is no wrong usage."""
    try:
        score_run(out)
    except ScoreError as error:
        fail(str(error), EXIT_FAILED)


def _print_report(out: Path) -> None:
    if (out / REPORT).is_file():
        typer.echo(f"report: {out / REPORT}")


def _run_processes(config: LaunchConfig) -> int:
    """Run all processes; return 0, or `EXIT_SUSPECT` if there is a result that is not to be believed."""

    def stop(number: int, _frame: FrameType | None) -> None:
        # Once: everything is then stopped in order, and a second signal would leave some of it behind.
        ignore_signals()
        code = EXIT_INTERRUPTED if number == signal.SIGINT else 128 + number
        fail(f"interrupted, everything is stopped; recorded up to here: {config.out}", code)

    for number in SIGNALS:
        signal.signal(number, stop)
    try:
        with Launcher(config, _note) as launcher:
            launcher.start_world()
            launcher.start_agents()
            code = launcher.watch(launcher.start_coordinator())
    except LaunchError as error:
        fail(f"{error}; logs: {config.out / LOGS}", EXIT_FAILED)
    suspect = code == EXIT_SUSPECT and (config.out / RESULT).is_file()
    if code and not suspect:
        fail(f"the coordinator ended with {code}; logs of the others: {config.out / LOGS}", code)
    return code
