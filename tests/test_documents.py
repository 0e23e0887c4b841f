"""README and docs: commands do what they say, as a newcomer would type them, and tables agree with code."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from coordinator.attendant.workspace import load_workspace
from coordinator.excitation.plan import Plan
from module_agent.wire.feedback_rows import ROW
from module_agent.wire.topics import TOPICS
from sim.benchmark.cases.suites import (
    QUICK_DYNAMICS,
    chosen,
    dynamic_cases,
    full_kinematics,
    kinematic_cases,
)
from sim.robot.robot_file import load_robot

ROOT = Path(__file__).parents[1]
PAGES = {path.name: path.read_text() for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))}
PAGES_WITH_COMMANDS = [
    "guide.md",
    "benchmarks.md",
    "faults.md",
    "security.md",
    "safety.md",
    "scale.md",
    "export.md",
]
SCRIPTS = Path(sys.executable).parent
# No test waits this long unless it fails; each command takes well under a minute on two cores of their own.
PATIENCE_S = 900
# What is added to commands of pages to run them in small form; the last one of an option counts. CI runs the
# benchmarks and a whole run as they are.
SHORTER = {
    "x5-sim run": ("--plan", "shorter.toml"),
    "x5-coordinator run": ("--plan", "shorter.toml"),
    "x5-coordinator excite": ("--tries", "30"),
    "x5-sim benchmark kinematics": ("--trials", "1"),
    "x5-sim benchmark dynamics": ("--only", "regressor"),
    # Eighteen seconds of each robot, kept in one folder: no command lives again what one before it has lived.
    "x5-sim watch --robot": ("--hours", "0.005", "--trials", "0", "--out", "runs/watch"),
    "x5-sim watch --hours": ("--hours", "0.01", "--trials", "0", "--out", "runs/watch"),
}
SHORTER_PLAN = """
discover_s = 0.5
link_s = 0.5
settle_s = 0.3
rest_s = 1.0
travel_speed_rad_s = 1.5
sine_centre_s = 1.2
sine_sigma_s = 0.5
dynamic_repeats = 1
simultaneous_duration_s = 6.0
# On a machine that is busy with other things a keep-alive may come too late; that is tried again.
retries = 5
"""


def blocks(language: str, *pages: str) -> list[str]:
    pattern = re.compile(rf"^```{language}\n(.*?)^```", flags=re.DOTALL | re.MULTILINE)
    return [block for page in pages or PAGES for block in pattern.findall(PAGES[page])]


def commands(block: str) -> list[str]:
    return [shlex.join(shlex.split(line, comments=True)) for line in block.splitlines() if line.strip()]


@pytest.fixture
def background() -> Iterator[list["subprocess.Popen[bytes]"]]:
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for process in reversed(started):
        process.send_signal(signal.SIGTERM)
    for process in reversed(started):
        assert process.wait(120) == 0, f"{process.args!r} ended with {process.returncode}"


def environment() -> dict[str, str]:
    return {**os.environ, "PATH": f"{SCRIPTS}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}


@pytest.mark.integration
@pytest.mark.xdist_group("integration")
@pytest.mark.parametrize("page", PAGES_WITH_COMMANDS)
def test_all_commands_of_a_page_succeed_one_after_the_other(
    page: str, tmp_path: Path, background: "list[subprocess.Popen[bytes]]"
) -> None:
    (tmp_path / "runs").mkdir()
    (tmp_path / "shorter.toml").write_text(SHORTER_PLAN)
    (tmp_path / "limits.toml").write_text(blocks("toml", "safety.md")[0])
    for line in (line for block in blocks("sh", page) for line in commands(block)):
        words = shlex.split(line)
        if words[-1] == "&":
            background.append(subprocess.Popen(words[:-1], cwd=tmp_path, env=environment()))
            continue
        done = subprocess.run(
            shorter(words),
            cwd=tmp_path,
            env=environment(),
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    if page == "guide.md":
        check_promised_files(tmp_path / "runs" / "virtual")


def shorter(words: list[str]) -> list[str]:
    added = [more for start, more in SHORTER.items() if words[: len(start.split())] == start.split()]
    return [*words, *(word for more in added for word in more)]


def test_benchmarks_named_on_the_page_have_the_cases_that_they_name() -> None:
    """They are run above with fewer trials and cases than the page has."""
    suites = {
        "kinematics": kinematic_cases(full_kinematics(2), 0, "optimised"),
        "dynamics": dynamic_cases(QUICK_DYNAMICS, 0, None),
    }
    named = [shlex.split(line) for block in blocks("sh", "benchmarks.md") for line in commands(block)]
    named = [words for words in named if words[:2] == ["x5-sim", "benchmark"]]
    assert {words[2] for words in named} == suites.keys()
    for words in named:
        assert chosen(suites[words[2]], words[words.index("--only") + 1]), " ".join(words)


def check_promised_files(run: Path) -> None:
    promised = re.findall(r"^\| (`[a-z_.]+`(?:, `[a-z_.]+`)*) \|", PAGES["guide.md"], flags=re.MULTILINE)
    names = [name for cell in promised for name in re.findall(r"`([a-z_]+\.[a-z]+)`", cell)]
    assert len(names) >= 8
    for name in names:
        assert (run / name).stat().st_size > 0, f"{name} is missing"
    assert json.loads((run / "score.json").read_text())["topology_correct"] is True


def test_every_shell_block_is_run() -> None:
    """Blocks of other pages hold only `make` commands, which take minutes: CI runs each of them as it is."""
    ci = (ROOT / ".ci" / "run").read_text()
    for page in PAGES.keys() - set(PAGES_WITH_COMMANDS):
        for line in (line for block in blocks("sh", page) for line in commands(block)):
            assert re.search(rf"^{line}$", ci, flags=re.MULTILINE), f"{page}: CI does not run `{line}`"


@cache
def programs() -> dict[str, Any]:
    """Return the programs by name, as groups of commands or as single ones."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    places = {name: place.partition(":") for name, place in scripts.items()}
    return {
        name: typer.main.get_command(getattr(import_module(module), attribute))
        for name, (module, _, attribute) in places.items()
    }


@cache
def command_below(group: Any, name: str) -> Any:
    """Return a command or group of a group, or None; its module is imported only here."""
    return group.get_command(None, name) if hasattr(group, "get_command") else None


def options_of(command: Any) -> dict[str, Any]:
    """Return what defines each option of a command; every program has help."""
    defined = {word: each for each in command.params for word in (*each.opts, *each.secondary_opts)}
    return {"--help": None, **defined}


def wrong_in(words: list[str], command: Any) -> str:
    """Return the first command or option of a command line that does not exist, or nothing."""
    named, rest = [], [word for word in words if word != "..."]
    while rest and rest[0] not in (">", "|", "&"):
        word = rest.pop(0)
        options, name = options_of(command), word.partition("=")[0]
        if re.match("--?[a-z]", word):
            if name not in options:
                return f"{' '.join(named)} has no {name}".strip()
            takes_value = options[name] is not None and not getattr(options[name], "is_flag", False)
            # In a sentence an option may be named without its value.
            if takes_value and "=" not in word and rest and not rest[0].startswith("-"):
                rest.pop(0)
        elif hasattr(command, "get_command"):
            below = command_below(command, word)
            if below is None:
                return f"there is no {' '.join([*named, word])}"
            command = below
            named.append(word)
    return ""


def without_blocks(page: str) -> str:
    return re.sub(r"^```.*?^```", "", PAGES[page], flags=re.DOTALL | re.MULTILINE)


def inline(page: str) -> list[list[str]]:
    """Return what stands in back-quotes on a page, in words; quotes and brackets may be open there."""
    return [text.split() for text in re.findall(r"`([^`]+)`", without_blocks(page)) if text.strip()]


def test_commands_named_in_sentences_and_blocks_exist_with_their_options() -> None:
    """Blocks without a language are not run: their commands need what only a real robot gives."""
    checked = dict.fromkeys(programs(), 0)
    for page in PAGES:
        lines = [line for block in blocks(r"\w*", page) for line in block.splitlines() if line.strip()]
        for words in (*inline(page), *(line.partition(" # ")[0].split() for line in lines)):
            program = words[0].removeprefix(".venv/bin/")
            if program in programs():
                checked[program] += len(words) > 1
                wrong = wrong_in(words[1:], programs()[program])
                assert not wrong, f"{page}: `{' '.join(words)}`: {program}: {wrong}"
    assert checked["x5-coordinator"] > 30, checked
    assert checked["x5-sim"] > 20, checked
    assert checked["x5-agent"] >= 5, checked


def test_commands_named_without_their_program_exist_with_their_options() -> None:
    groups = [each for each in programs().values() if hasattr(each, "get_command")]
    checked = 0
    for page in PAGES:
        for words in inline(page):
            known = [group for group in groups if command_below(group, words[0]) is not None]
            if known and len(words) > 1:
                checked += 1
                wrong = [wrong_in(words, group) for group in known]
                assert not all(wrong), f"{page}: `{' '.join(words)}`: {wrong}"
    assert checked > 5


def all_options(command: Any) -> set[str]:
    below = command.list_commands(None) if hasattr(command, "list_commands") else []
    return set(options_of(command)).union(*(all_options(command_below(command, name)) for name in below))


def test_options_named_alone_are_those_of_some_command() -> None:
    known = set().union(*map(all_options, programs().values()))
    named = [(page, words[0]) for page in PAGES for words in inline(page) if words[0].startswith("--")]
    assert len(named) > 50
    for page, word in named:
        assert word.partition("=")[0] in known, f"{page}: no command has {word}"


def test_links_lead_somewhere() -> None:
    for page, text in PAGES.items():
        folder = ROOT if page == "README.md" else ROOT / "docs"
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", text):
            assert (folder / target).exists(), f"{page} links to {target}, which is not there"


def test_files_named_on_the_pages_exist() -> None:
    for page in ("architecture.md", "theory.md", "wire.md"):
        for name in re.findall(
            r"`((?:module_agent|coordinator|sim|tests)/[a-z_/0-9]+(?:\.[a-z]+)?)`", PAGES[page]
        ):
            assert (ROOT / name).exists(), f"{page} names {name}, which is not there"


def test_the_floors_of_the_architecture_are_those_that_the_linter_holds() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    held = {
        c["containers"][0]: [re.findall(r"\w+", x) for x in c["layers"]]
        for c in contracts
        if "containers" in c
    }
    table = PAGES["architecture.md"].partition("| module_agent | coordinator | sim |\n|---|---|---|\n")[2]
    rows = [
        [re.findall(r"\w+", cell) for cell in row.split("|")[1:-1]]
        for row in re.findall(r"^\|.*", table, re.M)
    ]
    for column, package in enumerate(("module_agent", "coordinator", "sim")):
        assert [row[column] for row in rows if row[column]] == held[package][::-1], package


def test_the_readme_fits_on_a_first_screen_and_a_bit() -> None:
    assert len(PAGES["README.md"].splitlines()) <= 150


def test_the_robot_file_of_the_guide_is_a_robot(tmp_path: Path) -> None:
    path = tmp_path / "my_arm.toml"
    path.write_text("\n".join(blocks("toml", "guide.md")))
    robot = load_robot(path)
    assert [module.serial for module in robot.modules] == ["shoulder", "elbow"]
    assert [obstacle.name for obstacle in robot.obstacles] == ["table"]


def test_the_workspace_of_the_guide_is_one(tmp_path: Path) -> None:
    path = tmp_path / "room.toml"
    (text,) = [block for block in blocks("ini", "guide.md") if "[box]" in block]
    path.write_text(text)
    workspace = load_workspace(path)
    assert workspace.range_rad("elbow") == (-0.8, 1.0)
    assert workspace.tool_m == 0.1


def test_the_guide_has_every_setting_of_a_plan_with_its_default() -> None:
    part = PAGES["guide.md"].partition("`--plan FILE`")[2].partition("When it is in doubt")[0]
    told: dict[str, object] = {}
    for names, defaults in re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| (.*?) \|", part, flags=re.MULTILINE):
        keys, values = re.findall(r"`(\w+)`", names), defaults.split(", ")
        # One for all, or each its own.
        told |= {name: values[min(k, len(values) - 1)].strip("`") for k, name in enumerate(keys)}
    assert told.keys() == Plan.model_fields.keys()
    for name, value in Plan():
        if value is None:
            assert str(told[name]).startswith(("none", "by "))
        else:
            assert json.loads(str(told[name])) == value, name


def test_the_wire_page_has_every_topic_with_its_messages() -> None:
    page = PAGES["wire.md"].partition("## A feedback row")[0]
    rows = dict(re.findall(r"^\| `([a-z]+)` \| (.*?) \|", page, flags=re.MULTILINE))
    assert rows.keys() == {leaf.value for leaf in TOPICS}
    for leaf, topic in TOPICS.items():
        for message in {topic.publication, topic.request, topic.request and topic.reply} - {None}:
            assert message is not None
            assert f"`{message.__name__}`" in rows[leaf.value], f"{leaf.value}: {message.__name__} is missing"


def test_the_wire_page_has_the_fields_of_a_row_in_order() -> None:
    shown = re.findall(
        r"^\| `([a-z0-9_]+)` \| ((?:3 × )?[iuf][0-9]) \|", PAGES["wire.md"], flags=re.MULTILINE
    )
    assert [name for name, _ in shown] == list(ROW.names or ())
    widths = [int(kind[-1]) * (3 if kind.startswith("3") else 1) for _, kind in shown]
    assert sum(widths) == ROW.itemsize
    assert f"{np.dtype(ROW).itemsize} bytes" in PAGES["wire.md"]
