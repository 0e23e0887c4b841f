"""`x5-coordinator monitor`: is a known robot, while somebody moves it, still what it was?"""

import asyncio
import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from coordinator.commands.attended_run import Place, join, sender_name
from coordinator.commands.check import EXIT_CHANGED
from coordinator.commands.monitor_view import MonitorScreen
from coordinator.commands.options import Connect, Listen, Network, Robot, fail
from coordinator.commands.short_run import baseline_or_fail
from coordinator.live_robot.messenger import Messenger
from coordinator.monitoring.live import KEPT_ROWS, LOOK_S, LiveMonitor
from coordinator.monitoring.monitor import Watcher
from coordinator.monitoring.reference import NoReference, Reference, build_reference
from coordinator.monitoring.thresholds import ALARMS_PER_HOUR
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import load_recording
from coordinator.recording.session_file import SessionFileError, read_session
from coordinator.runtime.event_loop import SIGNALS, ScaledLoop, check_speed
from coordinator.runtime.exit_codes import EXIT_FAILED, EXIT_USAGE
from coordinator.runtime.terminal import Terminal
from coordinator.synchronisation.round_trips import map_clocks
from module_agent.network_emulation.profile_file import network as network_named
from module_agent.transport.endpoint import DEFAULT_ENDPOINT
from module_agent.transport.transport import TransportError
from module_agent.wire.keys import check_chunk
from module_agent.wire.refusal import WireError

# Whoever has not heard all modules by then hears nobody.
_FIRST_HEARD_S = 15.0


def monitor_robot(
    known: Annotated[
        Path, typer.Argument(help="Folder of the run that the robot is known from, inertia and all.")
    ],
    recording: Annotated[
        Path | None, typer.Option(help="Watch a session.mcap that is there already, without a robot.")
    ] = None,
    robot: Robot | None = None,
    listen: Listen = DEFAULT_ENDPOINT,
    connect: Connect = None,
    network: Network = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the injected network.")] = 0,
    for_s: Annotated[
        float | None, typer.Option("--for", min=1.0, help="End after so many seconds [at Ctrl-C].")
    ] = None,
    alarms_per_hour: Annotated[
        float, typer.Option(min=1e-6, max=1e3, help="False alarms that are taken into account.")
    ] = ALARMS_PER_HOUR,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write what is found, a line of JSON each.")
    ] = None,
    speed: Annotated[float, typer.Option(help="Speed of a simulated world.")] = 1.0,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing.")] = False,
) -> None:
    """Watch a known robot move: say when something hits it, when it carries something, and what wears.

    Moves nothing and takes no lease. Exit codes: 0 nothing was found, 4 something was, others as of `run`.
    """
    if json_file is not None and not json_file.parent.is_dir():
        fail(f"{json_file}: there is no folder {json_file.parent}", EXIT_USAGE)
    if recording is not None and not recording.is_file():
        fail(f"{recording}: there is no such file; give the session.mcap of a run", EXIT_USAGE)
    reference = _reference(known)
    watcher = Watcher(reference, alarms_per_hour)
    try:
        screen = MonitorScreen(watcher, json_file, quiet)
    except OSError as error:
        fail(f"{json_file}: {error.strerror or error}", EXIT_USAGE)
    with screen:
        if recording is not None:
            _watch_file(watcher, screen, recording)
        else:
            name = robot or reference.name
            try:
                check_chunk("robot", name)
                check_speed(speed)
                place = Place(listen, tuple(connect or ()), network_named(network), seed)
            except ValueError as error:
                fail(error, EXIT_USAGE)
            _watch_live(watcher, screen, name, place, for_s, speed)
        screen.sum_up()
    if watcher.ledger.all:
        raise typer.Exit(EXIT_CHANGED)


def _reference(folder: Path) -> Reference:
    try:
        return build_reference(baseline_or_fail(folder))
    except NoReference as error:
        fail(error, EXIT_USAGE)


def _watch_file(watcher: Watcher, screen: MonitorScreen, path: Path) -> None:
    """Watch what a session recorded, as if it happened now."""
    serials = watcher.reference.chain.serials
    try:
        whole = load_recording(path)
        missing = [s for s in serials if s not in whole.modules or not whole.modules[s].round_trips]
        if missing:
            fail(f"{path}: it holds no feedback, or no answers, of {', '.join(missing)}", EXIT_FAILED)
        clocks = map_clocks({s: whole.modules[s].round_trips for s in serials})
        looked_ns, recording = 0, Recording()
        for entry in read_session(path):
            if not screen.start_ns:
                screen.start_ns = entry.t_ns
            try:
                recording.add(entry)
            except WireError:
                continue  # counted by the recording, by reason
            if entry.t_ns - looked_ns > LOOK_S * 1e9:
                looked_ns = entry.t_ns
                screen.say(watcher.advance(recording, clocks))
                for module in recording.modules.values():
                    module.rows.forget_before(module.rows.end_row - KEPT_ROWS)
        screen.say(watcher.advance(recording, clocks))
    except SessionFileError as error:
        fail(error, EXIT_FAILED)


def _watch_live(
    watcher: Watcher, screen: MonitorScreen, robot: str, place: Place, for_s: float | None, speed: float
) -> None:
    """Watch until the time is up or a signal comes, which ends a watch in order."""
    loop = ScaledLoop(speed)
    try:
        transport = join(place, Terminal()).transport
    except (OSError, TransportError) as error:
        loop.close()
        fail(error, EXIT_USAGE)
    try:
        screen.start_ns = loop.clock_ns()
        live = LiveMonitor(watcher, loop.clock_ns, sender_name(), screen.say)
        radio = Messenger(transport, robot, loop.clock_ns, loop.call_soon_threadsafe, live.record)
        task = loop.create_task(_attend(live, radio, watcher, for_s, loop.clock_ns))
        for number in SIGNALS:
            loop.add_signal_handler(number, task.cancel)
        # Asked to end: what was found is summed up.
        with contextlib.suppress(asyncio.CancelledError):
            loop.run_until_complete(task)
    finally:
        loop.close()
    if not watcher.looked_s:
        serials = ", ".join(watcher.reference.chain.serials)
        fail(f"not all modules of robot {robot!r} were heard: {serials} are needed", EXIT_FAILED)


async def _attend(
    live: LiveMonitor, radio: Messenger, watcher: Watcher, for_s: float | None, clock: Callable[[], int]
) -> None:
    start_ns = clock()
    radio.start()
    try:
        await live.watch(radio, start_ns + round(_FIRST_HEARD_S * 1e9), lambda: watcher.looked_s > 0.0)
        if watcher.looked_s > 0.0:
            await live.watch(radio, None if for_s is None else clock() + round(for_s * 1e9))
    finally:
        radio.close()
