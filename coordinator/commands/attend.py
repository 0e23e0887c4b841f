"""`x5-coordinator attend`: stay with a known robot, say when it has changed, and measure it again."""

import asyncio
import contextlib
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from coordinator.attendant.attend_session import AttendSession, Site
from coordinator.attendant.remeasure import Remeasurement
from coordinator.attendant.workspace import Workspace, load_workspace
from coordinator.commands.options import ConnectOptions, DynamicsFolder, JsonFile, PlanFile, Speed, planned
from coordinator.commands.views.attend import AttendScreen
from coordinator.live_robot.connection import new_sender, open_connection
from coordinator.monitoring.reference import ALARMS_PER_HOUR
from coordinator.recording.versions import Versions
from coordinator.runtime.command_line import with_options
from coordinator.runtime.event_loop import ScaledLoop
from coordinator.runtime.event_loop import attend as attend_loop
from coordinator.runtime.terminal import new_table, print_table
from coordinator.torque_control.gravity_model import read_result
from module_agent.model.errors import EXIT_FINDING, RobotError, UsageError


def utc_now() -> str:
    """Return the date and time, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@with_options
def attend(
    baseline: DynamicsFolder,
    at: ConnectOptions,
    may_move: Annotated[
        bool, typer.Option("--may-move", help="Move the robot to measure it again; needs --workspace.")
    ] = False,
    workspace: Annotated[
        Path | None, typer.Option(help="TOML file of what the robot may use when it is measured again.")
    ] = None,
    plan: PlanFile = None,
    history: Annotated[
        bool, typer.Option("--history", help="List the versions of the model, and end.")
    ] = False,
    use: Annotated[
        int | None, typer.Option(metavar="N", help="Make version N the current one again, and end.")
    ] = None,
    for_s: Annotated[
        float | None, typer.Option("--for", min=1.0, help="End after so many seconds [at Ctrl-C].")
    ] = None,
    alarms_per_hour: Annotated[
        float, typer.Option(min=1e-6, max=1e3, help="Accepted rate of the monitor's false alarms [1/h].")
    ] = ALARMS_PER_HOUR,
    json_file: JsonFile = None,
    speed: Speed = 1.0,
) -> None:
    """Stay with a known robot, say when it is not the known one any more, and measure it again if allowed to.

    Modules that come, go or are exchanged, links that are displaced, and payloads that stay are said. With
    --may-move the robot is then measured again, slowly at first and within the workspace, after a notice of
    10 s, and the new model is the current version of FOLDER; without it nothing is commanded. Ctrl-C stops
    all modules. Exit codes: 0 nothing changed, 4 something did, others as of `run`.
    """
    versions = Versions(baseline)
    if use is not None:
        versions.choose(use, utc_now())
    if history or use is not None:
        _print_history(versions)
        return
    room = _workspace(may_move, workspace)
    settings, known = planned(plan), read_result(baseline)
    if room is not None:
        # Refused now, and not when something has changed.
        room.check_joints(known.serials)
        room.plan(settings, known.serials)
        versions.check_writable()
    loop = ScaledLoop(speed)
    place, screen = at.place(known.robot), AttendScreen(json_file, at.quiet)
    # The hub of the agents, if there is no other, stays as long as this program.
    hub = open_connection(place, screen.note)
    site = Site(
        robot=place.robot,
        connect=lambda: open_connection(place, lambda text: None).transport,
        clock=loop.clock_ns,
        post=loop.call_soon_threadsafe,
        sender=new_sender(),
        utc=utc_now,
    )
    measurer = None if room is None else Remeasurement(site, versions, room, screen, settings)
    session = AttendSession(site, versions, screen, measurer, alarms_per_hour)
    until_ns = None if for_s is None else loop.clock_ns() + round(for_s * 1e9)
    try:
        # A signal ends it in order.
        with screen, contextlib.suppress(asyncio.CancelledError):
            attend_loop(loop, session.run(until_ns))
    finally:
        hub.transport.close()
    if not session.was_seen:
        raise RobotError(f"no module of robot {place.robot!r} was on the network: nothing was compared")
    if session.changed:
        raise typer.Exit(EXIT_FINDING)


def _workspace(may_move: bool, file: Path | None) -> Workspace | None:
    """Return the workspace in which the robot may be moved, None if it may not.

    Raises:
        UsageError: one of the two options is missing, or the file is no workspace.
    """
    if may_move != (file is not None):
        raise UsageError(
            "--may-move and --workspace FILE belong together: the file says where the robot may be when "
            "it is measured again"
        )
    return None if file is None else load_workspace(file)


def _print_history(versions: Versions) -> None:
    current = versions.current_number
    table = new_table(f"{versions.folder}: version {current} holds", "time | what | version | why | found")
    for entry in versions.history:
        why, found = "\n".join(entry.why), "\n".join(entry.found)
        table.add_row(entry.utc, entry.what, str(entry.version), why, found)
    print_table(table)
