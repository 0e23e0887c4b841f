"""Every command of the README does what it says, as a newcomer would type it."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim.robot.robot_file import load_robot

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SCRIPTS = Path(sys.executable).parent
# What a first-time user waits for at most; each of these takes well under a minute on two cores.
PATIENCE_S = 240


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)


def commands(block: str) -> list[str]:
    return [shlex.join(shlex.split(line, comments=True)) for line in block.splitlines() if line.strip()]


SHELL_BLOCKS = [b for b in blocks("sh") if not b.startswith("make ")]


@pytest.fixture
def background() -> Iterator[list["subprocess.Popen[bytes]"]]:
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for process in reversed(started):
        process.send_signal(signal.SIGTERM)
    for process in reversed(started):
        assert process.wait(30) == 0, f"{process.args} ended with {process.returncode}"


def environment() -> dict[str, str]:
    return {**os.environ, "PATH": f"{SCRIPTS}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}


@pytest.mark.integration
@pytest.mark.xdist_group("integration")
def test_all_commands_succeed_one_after_the_other_and_leave_the_promised_files(
    tmp_path: Path, background: "list[subprocess.Popen[bytes]]"
) -> None:
    folder = tmp_path
    (folder / "runs").mkdir()
    for line in (line for block in SHELL_BLOCKS for line in commands(block)):
        words = shlex.split(line)
        if words[-1] == "&":
            process = subprocess.Popen(words[:-1], cwd=folder, env=environment())
            background.append(process)
            continue
        done = subprocess.run(
            words, cwd=folder, env=environment(), capture_output=True, text=True, timeout=PATIENCE_S
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    run = folder / "runs" / "virtual"
    promised = re.findall(r"^\| (`[a-z_.]+`(?:, `[a-z_.]+`)*) \|", README, flags=re.MULTILINE)
    names = [name for cell in promised for name in re.findall(r"`([a-z_]+\.[a-z]+)`", cell)]
    assert len(names) >= 8
    for name in names:
        assert (run / name).stat().st_size > 0, f"{name} is missing"
    assert json.loads((run / "score.json").read_text())["topology_correct"] is True


def test_the_make_commands_are_those_that_ci_runs() -> None:
    """`make demo` and `make test` take minutes and cannot run inside a test: CI runs both as they are."""
    ci = (ROOT / ".ci" / "run").read_text()
    for block in blocks("sh"):
        for line in commands(block):
            if line.startswith("make "):
                assert re.search(rf"^{line}$", ci, flags=re.MULTILINE), f"CI does not run `{line}`"


def test_commands_named_in_sentences_exist_with_their_options() -> None:
    helps: dict[tuple[str, str], str] = {}
    for inline in re.findall(r"`((?:\.venv/bin/)?x5-[a-z]+ [a-z]+[^`]*)`", README):
        program, command, *rest = shlex.split(inline.removeprefix(".venv/bin/"))
        if (program, command) not in helps:
            shown = subprocess.run(
                [program, command, "--help"], env=environment(), capture_output=True, text=True, check=True
            )
            helps[program, command] = shown.stdout
        for word in rest:
            if word.startswith("--"):
                assert word in helps[program, command], f"{program} {command} has no {word}"


def test_the_robot_file_of_the_readme_is_a_robot(tmp_path: Path) -> None:
    (text,) = blocks("toml")
    path = tmp_path / "my_arm.toml"
    path.write_text(text)
    robot = load_robot(path)
    assert [module.serial for module in robot.modules] == ["shoulder", "elbow"]
