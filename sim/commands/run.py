"""`x5-sim run` and `launch`: the whole system on a simulated robot, in virtual time or as processes."""

import signal
import time
from types import FrameType
from typing import Annotated

import typer

from coordinator.commands.options import PlanOptions, Quiet
from coordinator.runtime.command_line import fail, with_options
from coordinator.runtime.event_loop import SIGNALS, Interruption, ignore_signals
from coordinator.runtime.exit_codes import explain
from coordinator.runtime.terminal import Terminal
from coordinator.viewer.targets import NATIVE_PORT, proxy_url, viewer_choice
from module_agent.model.errors import EXIT_FAILED, EXIT_INTERRUPTED, UsageError
from sim.commands.options import LaunchOptions, WorldOptions, load
from sim.commands.score import print_score
from sim.processes.launcher import LOGS, LaunchConfig, Launcher, LaunchError
from sim.robot.robot_file import RobotFileError
from sim.scoring.truth_recording import add_truth
from sim.virtual_time.run import VirtualConfig, run_virtual

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
    quiet: Quiet = False,
) -> None:
    """Identify a simulated robot and score the result against the truth."""
    if not virtual:
        config = _launch_config(settings, launched, motions, *(("--quiet",) if quiet else ()))
        _run_processes(config)
        add_truth(config.out, None, _note)
        print_score(config.out)
        return
    robot = load(settings.robot)
    settings.check_speed()
    launched.check()
    noise, pushes = settings.noise_of(robot).of(robot), settings.pushes_on(robot)
    plan, out = motions.chosen(), launched.new_folder(robot)
    virtual_config = VirtualConfig(
        robot=robot,
        out=out,
        seed=settings.seed,
        network=launched.network or robot.network,
        noise=noise,
        plan=plan,
        refined_previews=MAX_REFINED_MODULES,
        pushes=pushes,
    )
    _run_virtual(virtual_config, quiet)
    print_score(out)


@with_options
def launch(
    settings: WorldOptions,
    launched: LaunchOptions,
    motions: PlanOptions,
    viewer: Annotated[str, typer.Option(help="Live viewer: none, spawn, serve, or an address.")] = "spawn",
) -> None:
    """Start world, agents and coordinator as processes, with the live viewer; Ctrl-C stops everything."""
    choice = viewer_choice(viewer)
    config = _launch_config(settings, launched, motions, "--viewer", viewer)
    _run_processes(config)
    # Where the viewer can still be reached when the run is over.
    add_truth(config.out, proxy_url(NATIVE_PORT) if choice.spawn else choice.connect, _note)
    print_score(config.out)


def _note(text: str) -> None:
    typer.echo(text, err=True)


def _launch_config(
    settings: WorldOptions, launched: LaunchOptions, motions: PlanOptions, *coordinator_options: str
) -> LaunchConfig:
    robot = load(settings.robot)
    launched.check()
    # The plan and the pushes are checked here; coordinator and world read them again.
    motions.chosen()
    settings.pushes_on(robot)
    return LaunchConfig(
        robot_file=settings.robot,
        robot_name=robot.name,
        serials=robot.serials,
        seed=settings.seed,
        network=launched.network or robot.network,
        noise=settings.noise_of(robot),
        speed=settings.check_speed(),
        endpoint=launched.endpoint,
        processes=launched.processes,
        pushes=tuple(settings.push or ()),
        # The robot ends with this run, so that there is nothing to resume.
        coordinator_options=("--no-advise", *coordinator_options, *motions.arguments()),
        out=launched.new_folder(robot),
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
    except RobotFileError as error:
        raise UsageError(str(error)) from error
    except BaseException as error:
        failure = explain(error)
        if failure is None:
            raise
        fail(f"{failure.text}; recorded up to here: {config.out}", failure.exit_code)
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
        with Launcher(config, _note) as launcher:
            launcher.start_world()
            launcher.start_agents()
            code = launcher.watch(launcher.start_coordinator())
    except LaunchError as error:
        fail(f"{error}; logs: {config.out / LOGS}", EXIT_FAILED)
    except _Stopped as stopped:
        code = EXIT_INTERRUPTED if stopped.number == signal.SIGINT else 128 + stopped.number
        fail(f"interrupted, everything is stopped; recorded up to here: {config.out}", code)
    if code:
        fail(f"the coordinator ended with {code}; logs of the others: {config.out / LOGS}", code)
