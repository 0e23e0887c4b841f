"""`x5-coordinator safety`: what a safety file says of each module, and the same in the other format."""

from collections.abc import Mapping
from math import isfinite, radians
from pathlib import Path
from typing import Annotated, Any

import typer

from coordinator.commands.options import JsonFile
from coordinator.runtime.command_line import in_a_folder
from coordinator.runtime.terminal import Terminal, new_table, print_table, write_result
from module_agent.control.safety import Safety
from module_agent.control.safety_file import read_safety, safety_toml, safety_xml
from module_agent.model.errors import UsageError
from module_agent.model.files import write_text

_COLUMNS = (
    "module | >position [deg] | at the limits | >speed [deg/s] | >effort [Nm] | >current [A] | "
    ">winding [°C] | M-stop"
)
_DEGREE = radians(1.0)


def safety(
    file: Annotated[Path, typer.Argument(help="Safety file: TOML, or HEBI's safety parameters in XML.")],
    serials: Annotated[
        list[str], typer.Argument(metavar="SERIAL...", help="The modules, in the order of an XML file.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write the same limits to this file, .toml or .xml [only show them].", callback=in_a_folder
        ),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Show the limits that a safety file gives to modules, and write them as TOML or as HEBI's XML.

    `--safety FILE` on an agent enforces them. Exit codes: 0 the file is right, 2 it is not, or the other
    format cannot say what it says.
    """
    if len(set(serials)) < len(serials):
        raise UsageError(f"SERIAL... {' '.join(serials)}: a module is given twice")
    known = read_safety(file, serials)
    if out is not None:
        if out.suffix.lower() not in (".toml", ".xml"):
            raise UsageError(f"--out {out}: it must end in .toml or .xml")
        as_xml = out.suffix.lower() == ".xml"
        write_text(out, safety_xml(list(known.values())) if as_xml else safety_toml(known))
    if write_result(json_file, [{"serial": s, **_limits(one.model_dump())} for s, one in known.items()]):
        table = new_table(str(file), _COLUMNS)
        for serial, one in known.items():
            table.add_row(serial, *_shown(one))
        print_table(table)
    if out is not None:
        Terminal().note(f"written: {out}")


def _limits(fields: Mapping[str, Any]) -> dict[str, object]:
    """Return limits for programs; None is the type's own, as an infinite one is no JSON."""

    def known(value: object) -> object:
        if isinstance(value, tuple):
            return [known(one) for one in value]
        return None if isinstance(value, float) and not isfinite(value) else value

    return {name: known(value) for name, value in fields.items()}


def _shown(one: Safety) -> tuple[str, ...]:
    """Return the limits of a module as they are shown; "-" is the type's own."""
    low, high = one.at_limit
    return (
        _between(one.range_rad, _DEGREE),
        low if low == high else f"{low}, {high}",
        _between(one.velocity_rad_s, _DEGREE),
        _between(one.effort_nm),
        f"{one.current_a:g}" if isfinite(one.current_a) else "-",
        f"{one.winding_c:g}",
        one.m_stop or "as on a stop",
    )


def _between(limits: tuple[float, float], unit: float = 1.0) -> str:
    low, high = (f"{limit / unit:.4g}" if isfinite(limit) else "-" for limit in limits)
    return "-" if low == high == "-" else f"{low} .. {high}"
