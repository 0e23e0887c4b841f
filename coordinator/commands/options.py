"""Options that several commands of `x5-coordinator` share, and how wrong ones are answered."""

from pathlib import Path
from typing import Annotated, NoReturn

import typer
from pydantic import ValidationError

from coordinator.excitation.plan import Plan, PlanFileError, load_plan
from coordinator.runtime.exit_codes import EXIT_USAGE
from module_agent.network_emulation.profile import PROFILES

Robot = Annotated[str, typer.Option(help="Name of the robot, part of every key.")]
Listen = Annotated[str, typer.Option(help="Zenoh endpoint to listen on, the hub of the agents.")]
Connect = Annotated[
    list[str] | None,
    typer.Option(help="Zenoh router to connect to, instead of listening; repeat for several."),
]
Network = Annotated[str, typer.Option(help=f"Injected network: {', '.join(PROFILES)}, or a TOML file.")]
Expect = Annotated[int | None, typer.Option(min=1, help="Wait for this many modules, no more and no fewer.")]


def fail(text: object, code: int) -> NoReturn:
    """End the command with a sentence on standard error and an exit code."""
    typer.echo(f"x5-coordinator: {text}", err=True)
    raise typer.Exit(code)


def planned(path: Path | None, **given: object) -> Plan:
    """Return the plan of a file, or the default one, with the settings that are given (not None)."""
    try:
        base = load_plan(path) if path is not None else Plan()
        # Validated again: an option can be out of range as well.
        return Plan.model_validate({**base.model_dump(), **{k: v for k, v in given.items() if v is not None}})
    except PlanFileError as error:
        fail(error, EXIT_USAGE)
    except ValidationError as error:
        first = error.errors()[0]
        fail(f"{first['loc'][0]} = {first['input']}: {first['msg']}", EXIT_USAGE)
