"""`x5-coordinator keys`: a certificate authority for one robot, and the keys of everyone in it."""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.live_robot.authority import DAYS, make_credentials
from coordinator.runtime.terminal import Terminal, new_table, print_table
from module_agent.transport.credentials import AUTHORITY, COORDINATOR, FLEET, OBSERVER


def keys(
    serials: Annotated[list[str], typer.Argument(metavar="SERIAL...", help="Serials of the modules.")],
    out: Annotated[Path, typer.Option(help="Folder for the keys; one that has keys gets those it lacks.")],
    robot: Annotated[str, typer.Option(help="Name of the robot, part of every key expression.")] = "robot",
    together: Annotated[
        list[str] | None,
        typer.Option(metavar="A,B,...", help="Modules that one agent process runs; repeat for several."),
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option(help="Name or IP address at which the coordinator listens, besides 127.0.0.1; repeat."),
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=36500, help="How long they are valid [days].")] = DAYS,
) -> None:
    """Make the keys for `--secure`: of every module, of the coordinator, and of observers.

    A module's computer gets fleet.toml, authority.pem and its own two files, the coordinator's gets its own;
    authority.key stays where it is safe. `--secure DIR` then takes the folder on every program.
    """
    groups = [[serial.strip() for serial in group.split(",")] for group in together or []]
    made = make_credentials(out, robot, serials, groups, host or [], days)
    table = new_table(f"{robot}, keys in {out}", "party | may | files")
    for party in made.fleet.host:
        table.add_row(party.name, f"be {', '.join(party.serials)}", f"{party.name}.pem, {party.name}.key")
    table.add_row(COORDINATOR, "command; be the hub", f"{COORDINATOR}.pem, {COORDINATOR}.key")
    table.add_row(OBSERVER, "read; stop", f"{OBSERVER}.pem, {OBSERVER}.key")
    table.add_row("everybody", "", f"{FLEET}, {AUTHORITY}.pem")
    table.add_row("-", "certify", f"{AUTHORITY}.key: keep it away from the robot")
    print_table(table)
    Terminal().note(f"new: {', '.join(made.new) or 'nothing'}")
