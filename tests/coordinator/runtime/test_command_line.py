"""Commands are imported on demand, options are expanded from classes, and errors become exit codes."""

import errno
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

import coordinator.main
import sim.main
from coordinator.runtime.command_line import fail, lazy_app, with_options
from module_agent.main import app as agent
from module_agent.model import errors
from module_agent.model.errors import EXIT_CODES, LostError
from module_agent.model.settings import LOG_LEVELS

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
    if settings.subject == "disk":
        raise OSError(errno.ENOSPC, "No space left on device", "session.mcap")
    typer.echo(f"{settings.count} {settings.subject} {loud}")


def meet(
    robot: str = "robot",
    listen: str = "tcp/here:1",
    connect: Annotated[list[str] | None, typer.Option()] = None,
    secure: Annotated[Path | None, typer.Option()] = None,
) -> None:
    """Say where a robot is."""
    typer.echo(f"{robot} {listen} {connect} {secure}")


people = typer.Typer(no_args_is_help=True)
people.command("meet")(meet)


@people.command("leave")
def leave() -> None:
    """Say goodbye."""


APP = lazy_app(
    "program",
    "Test.",
    __name__,
    {"count": ("count", "Count things."), "meet": ("meet", "Meet."), "club": ("people", "People.")},
    {"count": "program count sheep --count 3"},
    aliases={"number": "count"},
)


@pytest.fixture(autouse=True)
def no_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in [name for name in os.environ if name.startswith("X5_")]:
        monkeypatch.delenv(name)


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


@pytest.mark.parametrize(
    ("subject", "code"), [("lost", 3), ("failed", 130), ("signal", 130), ("file", 2), ("disk", 1)]
)
def test_an_error_of_the_domain_is_printed_and_ends_with_its_exit_code(subject: str, code: int) -> None:
    done = CliRunner().invoke(APP, ["count", subject])
    assert done.exit_code == code
    assert done.stderr.startswith("program: ")
    assert "Traceback" not in done.output


def test_a_mistyped_command_is_answered_with_the_nearest_one() -> None:
    done = CliRunner().invoke(APP, ["cuont"])
    assert done.exit_code == 2
    assert "Did you mean 'count'?" in done.output


# ---------------------------------------------------------------------- settings


def met(*arguments: str, command: tuple[str, ...] = ("meet",)) -> str:
    done = CliRunner().invoke(APP, [*command, *arguments])
    assert done.exit_code == 0, done.output
    return str(done.output).strip()


def test_what_repeats_comes_from_a_file_then_a_variable_then_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert met() == "robot tcp/here:1 None None"
    (tmp_path / "x5.toml").write_text('robot = "a"\nconnect = "tcp/router:7"\nsecure = "keys"\n')
    assert met() == "a tcp/here:1 ['tcp/router:7'] keys"
    monkeypatch.setenv("X5_ROBOT", "b")
    monkeypatch.setenv("X5_CONNECT", "tcp/one:1 tcp/two:2")
    assert met() == "b tcp/here:1 ['tcp/one:1', 'tcp/two:2'] keys"
    assert met("--robot", "c") == "c tcp/here:1 ['tcp/one:1', 'tcp/two:2'] keys"


def test_commands_of_a_group_have_the_same_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x5.toml").write_text('robot = "a"\nconnect = ["tcp/router:7"]\nsecure = "keys"\n')
    assert met(command=("club", "meet")) == met()
    monkeypatch.setenv("X5_ROBOT", "b")
    assert met(command=("club", "meet")) == met() == "b tcp/here:1 ['tcp/router:7'] keys"
    routed = met("--listen", "tcp/there:2", command=("club", "meet"))
    assert routed == "b tcp/there:2 None keys"


@pytest.mark.parametrize(
    ("file", "variable", "words"),
    [("", "wran", "X5_LOG_LEVEL wran"), ('log_level = "debgu"', "", "log_level of x5.toml debgu")],
)
def test_a_wrong_level_is_said_with_where_it_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, variable: str, words: str
) -> None:
    (tmp_path / "x5.toml").write_text(file)
    monkeypatch.setenv("X5_LOG_LEVEL", variable)
    done = CliRunner().invoke(APP, ["meet"])
    assert done.exit_code == 2
    assert words in done.output


def test_an_endpoint_on_the_command_line_is_not_overruled_by_routers_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "x5.toml").write_text('connect = ["tcp/router:7"]\n')
    assert met("--listen", "tcp/there:2") == "robot tcp/there:2 None None"
    assert met("--listen", "tcp/there:2", "--connect", "tcp/x:1") == "robot tcp/there:2 ['tcp/x:1'] None"


def test_a_file_is_named_by_a_variable_and_its_folder_is_that_of_the_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x5.toml").write_text('robot = "here"\n')
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "mine.toml").write_text('secure = "keys"\n')
    monkeypatch.setenv("X5_SETTINGS", "lab/mine.toml")
    assert met() == "robot tcp/here:1 None lab/keys"
    monkeypatch.setenv("X5_SETTINGS", "")
    assert met() == "robot tcp/here:1 None None"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('robo = "a"', "there is no setting 'robo' (did you mean 'robot'?)"),
        ("robot = 3", "robot = 3; str is needed"),
        ("connect = [3]", "connect = [3]; str or list is needed"),
        ("robot", "not TOML"),
    ],
)
@pytest.mark.parametrize("program", [APP, agent])
def test_a_file_with_a_mistake_is_refused_by_name(
    tmp_path: Path, program: typer.Typer, text: str, words: str
) -> None:
    (tmp_path / "x5.toml").write_text(text)
    command = ["meet"] if program is APP else ["--bus", "bus", "--serial", "a"]
    done = CliRunner().invoke(program, command)
    assert done.exit_code == 2
    assert words in done.output.replace("\n", " ")


def test_a_settings_file_that_is_named_and_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("X5_SETTINGS", "nowhere.toml")
    done = CliRunner().invoke(APP, ["meet"])
    assert done.exit_code == 2
    assert "X5_SETTINGS names nowhere.toml" in done.output


# ---------------------------------------------------------------------- what every program has


def test_the_agent_takes_the_robots_name_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("X5_ROBOT", "a/b")
    done = CliRunner().invoke(agent, ["--bus", "bus", "--serial", "a"])
    assert done.exit_code == 2
    assert "robot 'a/b' cannot be part of a key" in done.output


@pytest.mark.parametrize("program", [coordinator.main.app, sim.main.app, agent])
def test_every_program_says_its_version_and_completes(program: typer.Typer) -> None:
    assert CliRunner().invoke(program, ["--version"]).output.strip()[0].isdigit()
    assert "--install-completion" in CliRunner().invoke(program, ["--help"]).output


def test_commands_are_completed_without_loading_them() -> None:
    code = "import coordinator.main, sys; coordinator.main.app(prog_name='x5-coordinator')"
    words = {
        "_X5_COORDINATOR_COMPLETE": "complete_bash",
        "COMP_WORDS": "x5-coordinator mo",
        "COMP_CWORD": "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **words},
        capture_output=True,
        text=True,
        timeout=60.0,
    )
    assert done.stdout.split() == ["monitor"]


def test_a_level_of_the_log_that_there_is_not_is_refused() -> None:
    done = CliRunner().invoke(APP, ["--log-level", "inf", "count", "sheep"])
    assert done.exit_code == 2
    assert all(level in done.output for level in LOG_LEVELS)
    assert "did you mean 'info'?" in done.output


def test_at_the_level_debug_it_is_said_where_an_error_came_from() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "coordinator.main", "-v", "debug", "list", "--robot", "a/b"],
        capture_output=True,
        text=True,
        timeout=60.0,
    )
    assert done.returncode == 2
    assert "Traceback" in done.stderr
    assert "check_chunk" in done.stderr


def test_old_names_of_commands_still_work_and_are_not_listed() -> None:
    assert CliRunner().invoke(APP, ["number", "sheep"]).output == "1 sheep False\n"
    assert "number" not in CliRunner().invoke(APP, ["--help"]).output


def test_help_ends_with_an_example() -> None:
    assert "Example: program count sheep --count 3" in CliRunner().invoke(APP, ["count", "--help"]).output


@pytest.mark.parametrize(
    ("program", "name"),
    [(p, name) for p in (coordinator.main, sim.main) for name in p.EXAMPLES],  # type: ignore[attr-defined]
)
def test_the_example_of_a_command_has_only_options_that_it_takes(
    program: Any, name: str, tmp_path: Path
) -> None:
    words = shlex.split(program.EXAMPLES[name])
    group: Any = typer.main.get_command(program.app)
    assert words[:2] == [group.name, name]
    (tmp_path / "runs").mkdir()
    with group.make_context(group.name, [name]) as context:
        command = group.get_command(context, name)
        # Raises if an option, its value or the number of arguments is wrong.
        command.make_context(name, words[2:], parent=context).close()


def test_codes_of_ending_are_in_the_help_and_in_one_table_of_the_guide() -> None:
    guide = (Path(__file__).parents[3] / "docs" / "guide.md").read_text()
    listed = re.findall(r"^\| (\d+) \| (.*) \|$", guide, flags=re.MULTILINE)
    assert {int(code): meaning for code, meaning in listed} == EXIT_CODES
    shown = " ".join(CliRunner().invoke(APP, ["--help"]).output.split())
    assert all(f"{code} {meaning}" in shown for code, meaning in EXIT_CODES.items())
    constants = {
        value for name, value in vars(errors).items() if name.startswith("EXIT_") and name != "EXIT_CODES"
    }
    assert constants <= EXIT_CODES.keys()


@pytest.mark.parametrize("given", [None, "3"])
def test_linear_algebra_of_a_command_uses_one_thread_unless_the_user_says_otherwise(
    given: str | None,
) -> None:
    program = (
        "import os, sys; from coordinator.main import app; from typer.testing import CliRunner\n"
        "assert 'numpy' not in sys.modules\n"
        "assert CliRunner().invoke(app, ['replay', '--help']).exit_code == 0\n"
        "assert 'numpy' in sys.modules\n"
        "print(os.environ['OPENBLAS_NUM_THREADS'], os.environ['OMP_NUM_THREADS'])"
    )
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    environment = {name: value for name, value in os.environ.items() if name not in names}
    environment |= {} if given is None else dict.fromkeys(names, given)
    command = [sys.executable, "-c", program]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert said.split() == [given or "1"] * 2
