"""`x5-coordinator monitor`: all modules in a live table, or a moving robot compared with its baseline."""

import asyncio
import contextlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from coordinator.baseline.baseline_robot import load_baseline
from coordinator.commands.options import ConnectOptions, JsonFile, Speed
from coordinator.commands.views.module_table import ModuleScreen
from coordinator.commands.views.monitor import MonitorScreen
from coordinator.live_robot.connection import Place, new_sender, open_connection
from coordinator.live_robot.messenger import COALESCED_S, Messenger
from coordinator.monitoring.live import UPDATE_S, LiveMonitor, retained_rows
from coordinator.monitoring.live_states import LiveStates
from coordinator.monitoring.module_states import ModuleState, ModuleStates
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from coordinator.monitoring.reference import ALARMS_PER_HOUR, build_reference
from coordinator.monitoring.segments import SEGMENT_S
from coordinator.recording.recording import Entry, Recording
from coordinator.recording.run_folder import load_recording
from coordinator.recording.session_file import read_session
from coordinator.runtime.command_line import end_if_suspect, with_options
from coordinator.runtime.event_loop import ScaledLoop, attend
from coordinator.runtime.key_presses import key_presses
from coordinator.runtime.terminal import Terminal
from coordinator.synchronisation.round_trips import BootClocks
from module_agent.model.errors import EXIT_FINDING, DataError, RobotError, UsageError
from module_agent.wire.messages import Message
from module_agent.wire.refusal import WireError

# Modules that have sent nothing by then are taken to be absent.
_FIRST_FEEDBACK_S = 15.0


@with_options
def monitor_robot(
    at: ConnectOptions,
    baseline: Annotated[
        Path | None,
        typer.Argument(
            help="Folder of an earlier run of this robot with dynamics, its baseline [a table of any robot]."
        ),
    ] = None,
    recording: Annotated[
        Path | None, typer.Option(help="Monitor a recorded session.mcap; needs no robot.")
    ] = None,
    for_s: Annotated[
        float | None, typer.Option("--for", min=1.0, help="End after so many seconds [at Ctrl-C].")
    ] = None,
    alarms_per_hour: Annotated[
        float, typer.Option(min=1e-6, max=1e3, help="Accepted rate of false alarms [1/h].")
    ] = ALARMS_PER_HOUR,
    json_file: JsonFile = None,
    speed: Speed = 1.0,
) -> None:
    """Monitor a robot: all its modules in a live table, and, if it is known, what happens while it moves.

    Of a known robot collisions, payloads, friction and wear are reported, on a terminal below the table.
    Nothing is commanded and no lease is taken, but by the keys of the table: s stops all modules, h holds
    them where they are, l lights the next one's LED, q ends.
    Exit codes: 0 no findings, 4 findings, 5 no findings but a suspect baseline, others as of `run`.
    """
    if baseline is None:
        if alarms_per_hour != ALARMS_PER_HOUR:
            raise UsageError(
                "--alarms-per-hour is of findings, which need a baseline: give the folder of a run"
            )
        _show_modules(at, recording, for_s, json_file, speed)
        return
    if recording is not None and (for_s is not None or speed != 1.0):
        raise UsageError(
            "--for and --speed are of a robot that is monitored live: a --recording is read whole"
        )
    if recording is not None and not recording.is_file():
        raise UsageError(f"{recording}: there is no such file; give the session.mcap of a run")
    known = load_baseline(baseline)
    reference = build_reference(known)
    suspicions = known.kinematics.suspicions
    doubts = [f"{baseline} is not to be believed as usual: {why}" for why in suspicions]
    monitor = Monitor(reference, alarms_per_hour)
    screen = MonitorScreen(monitor, json_file, at.quiet, _keys())
    with screen:
        screen.report(MonitorUpdate((), (), (*doubts, *reference.remarks)))
        if recording is not None:
            _monitor_file(monitor, screen, recording)
        else:
            _monitor_live(monitor, screen, at.place(reference.name), for_s, speed)
        screen.show_summary()
    if monitor.finding_log.all:
        raise typer.Exit(EXIT_FINDING)
    end_if_suspect([f"{baseline}: {why}" for why in suspicions])


KEYS = "s stop all    h hold, or release    l light the next LED    q end"


def _keys() -> str:
    """Return the keys that can be pressed."""
    return KEYS if sys.stdin.isatty() else ""


def _actions(modules: LiveStates, end: Callable[[], None]) -> dict[str, Callable[[], None]]:
    """Return what the keys do."""
    return {"s": modules.stop, "h": modules.hold, "l": modules.light, "q": end}


def _show_modules(
    at: ConnectOptions, recording: Path | None, for_s: float | None, json_file: Path | None, speed: float
) -> None:
    """Show all modules of a robot until the time is up, a key ends it, or a signal comes.

    Raises:
        UsageError: a recording is given, which has no modules to show.
        RobotError: no module came.
    """
    if recording is not None:
        raise UsageError(
            "--recording needs a baseline: x5-coordinator monitor FOLDER --recording session.mcap"
        )
    place = at.place()
    loop, states = ScaledLoop(speed), ModuleStates()
    begin_ns = loop.clock_ns()
    screen = ModuleScreen(place.robot, json_file, at.quiet, _keys())
    transport = open_connection(place, screen.note).transport
    post = loop.call_soon_threadsafe
    messenger = Messenger(transport, place.robot, loop.clock_ns, post, states.record, coalesced_s=COALESCED_S)
    ended = False

    def report(modules: Sequence[ModuleState]) -> None:
        screen.show(modules, 1e-9 * (loop.clock_ns() - begin_ns))

    def end() -> None:
        nonlocal ended
        ended = True

    live = LiveStates(states, messenger, loop.clock_ns, new_sender(), report, screen.note)

    async def follow() -> None:
        messenger.start()
        try:
            first_ns = loop.clock_ns() + round(_FIRST_FEEDBACK_S * 1e9)
            await live.follow(first_ns, lambda: ended or bool(states.recording.modules))
            if states.recording.modules:
                until_ns = None if for_s is None else loop.clock_ns() + round(for_s * 1e9)
                await live.follow(until_ns, lambda: ended)
        finally:
            messenger.close()

    with screen, key_presses(loop, _actions(live, end)), contextlib.suppress(asyncio.CancelledError):
        attend(loop, follow())
    if not states.recording.modules and not ended:
        raise RobotError(f"no module of robot {place.robot!r} answers within {_FIRST_FEEDBACK_S:.0f} s")


def _monitor_file(monitor: Monitor, screen: MonitorScreen, path: Path) -> None:
    """Monitor a recorded session as if it were live."""
    serials = monitor.reference.chain.serials
    whole = load_recording(path)
    told = {serial for (serial, _), module in whole.past.items() if module.round_trips and module.rows.count}
    missing = [serial for serial in serials if serial not in told]
    if missing:
        raise DataError(f"{path} has no feedback or no round trips of {', '.join(missing)}")
    looked_ns, recording, clocks = 0, Recording(), BootClocks(whole, serials)

    boots: dict[str, int] = {}

    def look() -> None:
        now = {s: recording.modules[s].boot for s in serials if s in recording.modules}
        anew = [f"module {s} has booted anew" for s, boot in now.items() if boots.get(s, boot) != boot]
        boots.update(now)
        mapped = clocks.of(recording)
        if mapped is None and anew:
            anew.append("what follows is not compared: there is no round trip of every module since")
        if anew:
            screen.report(MonitorUpdate((), (), tuple(anew)))
        if mapped is not None:
            screen.report(monitor.advance(recording, mapped))

    for entry in read_session(path):
        if not screen.start_ns:
            screen.start_ns = entry.t_ns
        try:
            recording.add(entry)
        except WireError:
            continue  # counted by the recording, by reason
        if entry.t_ns - looked_ns > UPDATE_S * 1e9:
            looked_ns = entry.t_ns
            look()
            for module in recording.modules.values():
                module.rows.forget_before(module.rows.end_row - retained_rows(module))
    look()
    if monitor.monitored_s < SEGMENT_S:
        raise DataError(
            f"{path}: nothing was compared: for no {SEGMENT_S:g} s all of {', '.join(serials)} sent feedback"
        )


def _monitor_live(
    monitor: Monitor, screen: MonitorScreen, place: Place, for_s: float | None, speed: float
) -> None:
    """Monitor until the time is up, a key ends it, or a signal comes.

    Where there is a live table it has all modules, with the keys of the table of any robot.
    """
    transport = open_connection(place, Terminal().note).transport
    loop = ScaledLoop(speed)
    screen.start_ns = loop.clock_ns()
    sender, states, ended = new_sender(), ModuleStates(), False
    live = LiveMonitor(monitor, loop.clock_ns, sender.name, screen.report)

    def record(entry: Entry) -> Message | None:
        if screen.is_live:
            states.record(entry)
        return live.record(entry)

    post = loop.call_soon_threadsafe
    messenger = Messenger(transport, place.robot, loop.clock_ns, post, record, coalesced_s=COALESCED_S)
    modules = LiveStates(states, messenger, loop.clock_ns, sender, screen.show_modules, screen.note)

    def end() -> None:
        nonlocal ended
        ended = True

    def after_ns(seconds: float) -> int:
        return loop.clock_ns() + round(seconds * 1e9)

    async def watch() -> None:
        messenger.start()
        following = asyncio.create_task(modules.follow()) if screen.is_live else None
        try:
            first_ns = after_ns(_FIRST_FEEDBACK_S)
            await live.watch(messenger, first_ns, lambda: ended or monitor.monitored_s > 0.0)
            if monitor.monitored_s > 0.0:
                await live.watch(messenger, None if for_s is None else after_ns(for_s), lambda: ended)
        finally:
            if following is not None:
                # What is held is released before the network is left.
                following.cancel()
                await asyncio.gather(following, return_exceptions=True)
            messenger.close()

    actions = _actions(modules, end) if screen.is_live else {}
    # A signal cancels the task; the summary of the findings follows.
    with key_presses(loop, actions), contextlib.suppress(asyncio.CancelledError):
        attend(loop, watch())
    if not monitor.monitored_s and not ended:
        serials = ", ".join(monitor.reference.chain.serials)
        raise RobotError(
            f"not all modules of robot {place.robot!r} sent feedback within {_FIRST_FEEDBACK_S:.0f} s; "
            f"needed: {serials}"
        )
