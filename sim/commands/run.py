"""`x5-sim world`, `run` and `launch`: a simulated robot lives, and the whole system runs on it."""

import gc
import signal
import time
from pathlib import Path
from types import FrameType
from typing import Annotated, NamedTuple

import typer

from coordinator.runtime.event_loop import SIGNALS, Interruption, ignore_signals
from coordinator.runtime.exit_codes import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE, explain
from coordinator.runtime.terminal import Terminal
from coordinator.viewer.targets import NATIVE_PORT, proxy_url, viewer_choice
from module_agent.transport.endpoint import DEFAULT_ENDPOINT
from sim.commands.options import (
    Dynamics,
    Endpoint,
    Excitation,
    Imu,
    Mode,
    Motions,
    Network,
    Noise,
    Out,
    PlanFile,
    Processes,
    Pushed,
    RobotArgument,
    Seed,
    Speed,
    Torque,
    With,
    Without,
    check,
    fail,
    free_folder,
    load,
    motion_arguments,
    motions,
    noise_choice,
    pushes,
)
from sim.commands.score import print_score
from sim.processes.launcher import LOGS, LaunchConfig, Launcher, LaunchError
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import Robot, RobotFileError
from sim.scoring.truth_recording import add_truth
from sim.virtual_time.run import VirtualConfig, run_virtual
from sim.world.bus_server import BusServer
from sim.world.truth import LoggedWorld, write_truth
from sim.world.world import World

# How long the world waits for an agent that a busy machine does not let run, before it goes on without it:
# the world's time is its own to stretch, while a motor that is let go in a motion spoils it. Agents that die
# are noticed at once all the same.
PATIENCE_S = 0.2
# Larger robots are only assembled while they are being explored: their refinements would take longer than the
# run.
REFINED_LOOKS = 8


def world(
    robot: RobotArgument,
    bus: Annotated[str, typer.Option(help="Path of the physics bus to open.")],
    seed: Seed = 0,
    noise: Noise = None,
    with_effects: With = None,
    without_effects: Without = None,
    push: Pushed = None,
    speed: Speed = 1.0,
    truth: Annotated[
        Path | None, typer.Option(help="Folder for truth.json and truth.npz at the end.")
    ] = None,
) -> None:
    """Run the world of one robot until a signal comes; agents attach to its bus."""
    found = load(robot)
    check(speed=speed)
    choice = noise_choice(found, noise, with_effects, without_effects)
    pushed = pushes(found, push)
    stopping: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        stopping.append(number)

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    try:
        plant = World(found, seed, choice.of(found), pushes=pushed)
    except RobotFileError as error:
        fail(error, EXIT_USAGE)
    logged = LoggedWorld(plant)
    try:
        server = BusServer(bus, logged, PATIENCE_S, report=lambda line: typer.echo(line, err=True))
    except OSError as error:
        fail(error, EXIT_USAGE)
    typer.echo(f"{found.name}: {len(plant.modules)} modules on {bus}", err=True)
    # What the imports have left is never looked at again: a full collection of it stops all modules' ticks.
    gc.collect()
    gc.freeze()
    with server:
        report = server.run(speed, lambda: bool(stopping))
    typer.echo(f"{report.simulated_s:.1f} s at {report.achieved_speed:.2f} times real time", err=True)
    if truth is not None:
        truth.mkdir(parents=True, exist_ok=True)
        write_truth(truth / "truth.json", found, plant)
        logged.log.save(truth / "truth.npz")
    plant.close()


def run(
    robot: RobotArgument,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="In one process, faster than real time.")
    ] = False,
    seed: Seed = 0,
    network: Network = None,
    noise: Noise = None,
    with_effects: With = None,
    without_effects: Without = None,
    push: Pushed = None,
    out: Out = None,
    plan: PlanFile = None,
    dynamics: Dynamics = None,
    imu: Imu = None,
    torque: Torque = None,
    mode: Mode = None,
    how: Motions = None,
    excitation: Excitation = None,
    speed: Speed = 1.0,
    processes: Processes = None,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Identify a simulated robot and score the result against the truth."""
    found = load(robot)
    check(network, speed, endpoint)
    choice = noise_choice(found, noise, with_effects, without_effects)
    pushed = pushes(found, push)
    planned = motions(
        plan,
        dynamics=dynamics,
        imu=imu,
        torque=torque,
        mode=mode,
        motions=how,
        excitation=excitation,
    )
    folder = free_folder(out, found)
    if virtual:
        _run_virtual(
            VirtualConfig(
                found,
                folder,
                seed,
                network or found.network,
                choice.of(found),
                planned,
                refined_previews=REFINED_LOOKS,
                pushes=pushed,
            ),
            quiet,
        )
    else:
        options = (*motion_arguments(plan, planned), *(("--quiet",) if quiet else ()))
        place = _Place(folder, network or found.network, endpoint, processes, tuple(push or ()))
        _run_processes(_launch(robot, found, place, seed, choice, speed, options))
        _add_truth(folder, None)
    print_score(folder)


def _add_truth(folder: Path, viewer: str | None) -> None:
    """Draw the true robot beside the identified one, which the coordinator could not do."""
    add_truth(folder, viewer, lambda text: typer.echo(text, err=True))


def _address(viewer: str) -> str | None:
    """Return where the viewer of a run can still be reached when the run is over."""
    choice = viewer_choice(viewer)
    return proxy_url(NATIVE_PORT) if choice.spawn else choice.connect


class _Place(NamedTuple):
    """Where the processes of a run meet, where they write, and what pushes their world."""

    out: Path
    network: str
    endpoint: str
    processes: int | None
    pushes: tuple[str, ...]


def _launch(
    robot_file: str,
    robot: Robot,
    place: _Place,
    seed: int,
    noise: NoiseChoice,
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
        pushes=place.pushes,
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
    except RobotFileError as error:
        fail(error, EXIT_USAGE)
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
        with Launcher(config, lambda text: typer.echo(text, err=True)) as launcher:
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


def launch(
    robot: RobotArgument,
    seed: Seed = 0,
    network: Network = None,
    noise: Noise = None,
    with_effects: With = None,
    without_effects: Without = None,
    push: Pushed = None,
    out: Out = None,
    plan: PlanFile = None,
    speed: Speed = 1.0,
    viewer: Annotated[str, typer.Option(help="Live viewer: none, spawn, serve, or an address.")] = "spawn",
    dynamics: Dynamics = None,
    imu: Imu = None,
    torque: Torque = None,
    mode: Mode = None,
    how: Motions = None,
    excitation: Excitation = None,
    processes: Processes = None,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
) -> None:
    """Start world, agents and coordinator as processes, with the live viewer; Ctrl-C stops everything."""
    found = load(robot)
    check(network, speed, endpoint)
    choice = noise_choice(found, noise, with_effects, without_effects)
    pushes(found, push)
    try:
        viewer_choice(viewer)
    except ValueError as error:
        fail(error, EXIT_USAGE)
    options = (
        "--viewer",
        viewer,
        *motion_arguments(
            plan,
            motions(
                plan,
                dynamics=dynamics,
                imu=imu,
                torque=torque,
                mode=mode,
                motions=how,
                excitation=excitation,
            ),
        ),
    )
    place = _Place(free_folder(out, found), network or found.network, endpoint, processes, tuple(push or ()))
    _run_processes(_launch(robot, found, place, seed, choice, speed, options))
    _add_truth(place.out, _address(viewer))
    print_score(place.out)
