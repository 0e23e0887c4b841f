"""Commands are imported on demand, options are expanded from classes, and errors become exit codes."""

import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

import coordinator.main
import sim.main
from coordinator.runtime.command_line import fail, lazy_app, with_options
from module_agent.model.errors import LostError

PLACES = [
    f"{program.__name__.replace('main', 'commands')}.{place}"
    for program in (coordinator.main, sim.main)
    for place, _ in program.COMMANDS.values()
]


@dataclass(frozen=True)
class Options:
    subject: Annotated[str, typer.Argument(help="Which.")]
    count: Annotated[int, typer.Option(min=1)] = 1


@with_options
def count(settings: Options, loud: bool = False) -> None:
    """Count."""
    if settings.subject == "lost":
        raise LostError("module A: no feedback for 1.2 s")
    if settings.subject == "failed":
        fail("interrupted", 130)
    if settings.subject == "signal":
        raise KeyboardInterrupt
    if settings.subject == "file":
        Path("/no/such/file").read_text()
    typer.echo(f"{settings.count} {settings.subject} {loud}")


APP = lazy_app("program", "Test.", __name__, {"count": ("count", "Count things.")})


@pytest.mark.parametrize("program", ["coordinator.main", "sim.main"])
def test_the_help_of_a_program_imports_no_numerics(program: str) -> None:
    code = f"import sys, {program}; assert 'numpy' not in sys.modules and 'pydantic' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30.0)


@pytest.mark.parametrize("place", PLACES)
def test_every_command_of_the_tables_exists(place: str) -> None:
    module, _, function = place.rpartition(".")
    assert callable(getattr(import_module(module), function))


def test_the_help_lists_the_lines_of_the_table() -> None:
    assert "count  Count things." in CliRunner().invoke(APP, ["--help"]).output


def test_options_are_expanded_from_their_class() -> None:
    done = CliRunner().invoke(APP, ["count", "sheep", "--count", "3", "--loud"])
    assert done.output == "3 sheep True\n"
    assert CliRunner().invoke(APP, ["count", "sheep", "--count", "0"]).exit_code == 2
    assert CliRunner().invoke(APP, ["count"]).exit_code == 2


@pytest.mark.parametrize(("subject", "code"), [("lost", 3), ("failed", 130), ("signal", 130), ("file", 1)])
def test_an_error_of_the_domain_is_printed_and_ends_with_its_exit_code(subject: str, code: int) -> None:
    done = CliRunner().invoke(APP, ["count", subject])
    assert done.exit_code == code
    assert done.stderr.startswith("program: ")
    assert "Traceback" not in done.output


def test_a_mistyped_command_is_answered_with_the_nearest_one() -> None:
    done = CliRunner().invoke(APP, ["cuont"])
    assert done.exit_code == 2
    assert "Did you mean 'count'?" in done.output
