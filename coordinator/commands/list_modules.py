"""`x5-coordinator list`: the modules on the network, without moving or holding them."""

import typer
from rich.table import Table

from coordinator.commands.options import AsJson, ConnectOptions, Expect
from coordinator.live_robot.connection import Place, open_connection
from coordinator.live_robot.discovery import AS_HUB_S, Search, listed
from coordinator.runtime.command_line import with_options
from coordinator.runtime.terminal import Terminal
from module_agent.model.errors import RobotError
from module_agent.transport.transport import Transport


@with_options
def list_modules(at: ConnectOptions, expect: Expect = None, as_json: AsJson = False) -> None:
    """List the modules on the network: state, holder of the lease, refused messages.

    Exit codes: 0 all answer, 1 a module does not answer or too few do, 2 wrong usage.
    """
    place = at.place()
    transport, search = open_search(place, at.quiet, expect)
    statuses, silent = listed(transport, place.robot, search)
    if as_json:
        typer.echo("[" + ",\n ".join(status.model_dump_json() for status in statuses) + "]")
    else:
        table = Table("serial", "state", "holder", "expiries", "refused", title=place.robot)
        for status in statuses:
            table.add_row(
                status.serial,
                status.state,
                status.holder or "-",
                str(status.expiries),
                ", ".join(f"{k} {v}" for k, v in status.refusals.items()) or "-",
            )
        Terminal().console.print(table)
    if silent:
        raise RobotError(f"no status from {', '.join(silent)}")
    check_count(place.robot, len(statuses), expect)


def open_search(place: Place, quiet: bool, expect: int | None) -> tuple[Transport, Search]:
    """Join a robot's network to look for its modules; as its hub, wait for the agents to connect."""
    connection = open_connection(place, Terminal(quiet).note)
    return connection.transport, Search(min_s=AS_HUB_S if connection.is_hub else 0.0, expect=expect)


def check_count(robot: str, answering: int, expect: int | None) -> None:
    """Check how many modules answered.

    Raises:
        RobotError: none, or fewer than expected.
    """
    if not answering:
        raise RobotError(f"no module of robot {robot!r} answers")
    if expect is not None and answering < expect:
        raise RobotError(f"{answering} modules of robot {robot!r} answer, {expect} are expected")
