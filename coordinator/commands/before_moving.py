"""`x5-coordinator gains`, `identify`, `check-link`: what is looked at and set before a robot moves."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from coordinator.commands.options import ConnectOptions, Expect, JsonFile, Speed
from coordinator.live_robot.connection import Connection, Place, new_sender, open_connection
from coordinator.live_robot.discovery import AS_HUB_S, IS_IT_THERE, Search, described, light_led
from coordinator.live_robot.short_session import ShortSession
from coordinator.monitoring.module_states import full_name
from coordinator.runtime.command_line import in_a_folder, with_options
from coordinator.runtime.event_loop import ScaledLoop, attend
from coordinator.runtime.terminal import Terminal, new_table, print_table, write_result
from module_agent.control.gains_file import read_gains, write_gains
from module_agent.model.errors import RobotError, UsageError
from module_agent.wire.messages import Info

_SHOWN = {"serial", "family", "name", "module_type", "gains"}


def _distinct(serials: list[str] | None) -> list[str] | None:
    if serials is not None and (twice := {one for one in serials if serials.count(one) > 1}):
        raise UsageError(f"--module {', '.join(sorted(twice))}: is given twice")
    return serials


def _readable(file: Path) -> Path:
    if not file.is_file():
        raise UsageError(f"{file}: there is no such file")
    return file


Modules = Annotated[
    list[str] | None,
    typer.Option(
        "--module",
        help="Serial of a module; repeat in the order of the file [all, by serial].",
        callback=_distinct,
    ),
]

gains = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Show, load or save the modules' gains, as HEBI's gains files.",
)


@gains.command("show")
@with_options
def show(
    at: ConnectOptions, expect: Expect = None, module: Modules = None, json_file: JsonFile = None
) -> None:
    """Show strategy and kp of position, velocity and effort of every module.

    Exit codes: 0 all answer, 1 a module does not answer or too few do, 2 wrong usage.
    """
    infos = _modules(at, expect, module)
    if not write_result(json_file, [info.model_dump(include=_SHOWN) for info in infos]):
        return
    table = new_table("gains", "serial | family/name | type | strategy | kp: position, velocity, effort")
    for info in infos:
        loops = (info.gains.position, info.gains.velocity, info.gains.effort)
        kp = ", ".join(f"{loop.kp:g}" for loop in loops)
        table.add_row(info.serial, full_name(info) or "-", info.module_type, str(info.gains.strategy), kp)
    print_table(table)


@gains.command("save")
@with_options
def save(
    file: Annotated[Path, typer.Argument(help="File to write, XML.", callback=in_a_folder)],
    at: ConnectOptions,
    expect: Expect = None,
    module: Modules = None,
) -> None:
    """Save the gains that the modules have.

    Exit codes: 0 saved, 1 a module does not answer or too few do, 2 wrong usage.
    """
    infos = _modules(at, expect, module)
    write_gains(file, [info.gains for info in infos])
    Terminal(at.quiet).note(f"{file}: gains of {', '.join(info.serial for info in infos)}")


@gains.command("load")
@with_options
def load(
    file: Annotated[Path, typer.Argument(help="Gains file, XML.", callback=_readable)],
    at: ConnectOptions,
    expect: Expect = None,
    module: Modules = None,
) -> None:
    """Give the modules the gains of a file, until their agents end; they are armed for it, and do not move.

    Exit codes: 0 all have them, 1 a module is missing or refuses, 2 wrong usage.
    """
    note = Terminal(at.quiet).note
    chosen = read_gains(file, len(module) if module else None)
    loop = ScaledLoop()
    session = _session(at, loop, expect, module or ())
    loaded = attend(loop, session.load_gains(chosen.applied))
    note(f"{file}: loaded into {', '.join(loaded)}")


@with_options
def check_link(
    at: ConnectOptions,
    expect: Expect = None,
    seconds: Annotated[float, typer.Option("--for", min=0.1, max=600.0, help="How long [s].")] = 3.0,
    speed: Speed = 1.0,
) -> None:
    """Check the network to every module, as each run does before it moves: rates and round trips.

    Exit codes: 0 it is good enough, 1 it is not, or a module is missing, 2 wrong usage.
    """
    loop = ScaledLoop(speed)
    session = _session(at, loop, expect)
    attend(loop, session.check_link(seconds, Terminal(at.quiet).note))


@with_options
def identify(
    serial: Annotated[str, typer.Argument(help="Serial of the module.")],
    at: ConnectOptions,
    for_s: Annotated[float, typer.Option("--for", min=0.1, max=3600.0, help="How long [s].")] = 10.0,
) -> None:
    """Light the LED of one module, to see which one it is; needs no lease.

    Exit codes: 0 it was lit, 1 the module does not answer, 2 wrong usage.
    """
    place = at.place()
    connection = open_connection(place, Terminal(at.quiet).note)
    sender = new_sender().name
    try:
        light_led(connection.transport, place.robot, serial, sender, True, _search(connection, None))
        Terminal(at.quiet).note(f"{serial}: its LED is lit for {for_s:g} s")
        try:
            time.sleep(for_s)
        finally:
            light_led(connection.transport, place.robot, serial, sender, False, Search())
    finally:
        connection.transport.close()


def _session(
    at: ConnectOptions, loop: ScaledLoop, expect: int | None, serials: Sequence[str] = ()
) -> ShortSession:
    place = at.place()
    connection = open_connection(place, Terminal(at.quiet).note)
    return ShortSession(
        *(connection.transport, place.robot, loop.clock_ns, loop.call_soon_threadsafe, new_sender()),
        *(_search(connection, expect), serials),
    )


def _search(connection: Connection, expect: int | None) -> Search:
    return Search(min_s=AS_HUB_S if connection.is_hub else 0.0, expect=expect)


def _modules(at: ConnectOptions, expect: int | None, wanted: list[str] | None) -> list[Info]:
    """Return what modules tell of themselves, in the order wanted or by serial."""
    place: Place = at.place()
    connection = open_connection(place, Terminal(at.quiet).note)
    infos, silent = described(connection.transport, place.robot, _search(connection, expect))
    if silent:
        raise RobotError(f"no description from {', '.join(silent)}")
    known = {info.serial: info for info in infos}
    if not known:
        raise RobotError(f"no module of robot {place.robot!r} answers{IS_IT_THERE}")
    if missing := [serial for serial in wanted or () if serial not in known]:
        raise RobotError(f"no module {', '.join(missing)}; there are {', '.join(known)}")
    if expect is not None and len(known) < expect:
        raise RobotError(f"{len(known)} modules of robot {place.robot!r} answer, {expect} are expected")
    return [known[serial] for serial in wanted or sorted(known)]
