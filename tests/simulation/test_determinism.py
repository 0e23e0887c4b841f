"""The same seed is the same run, byte for byte and process by process; a replay computes what the run did."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify
from coordinator.recording.run_folder import load_recording
from coordinator.session.run import write_outputs
from sim.physics.engine import Physics
from tests.breadth import breadth

ROOT = Path(__file__).parents[2]


def _run(out: Path, plan: Plan, physics: str, seed: int, hash_seed: str) -> str:
    """Run in a process of its own; return the trace hash that it prints."""
    settings = out.with_suffix(".toml")
    durations = plan.model_dump(exclude_defaults=True, exclude={"dynamics"})
    settings.write_text("".join(f"{name} = {value}\n" for name, value in durations.items()))
    command = [sys.executable, "-m", "sim.main", "run", "thesis_171_horizontal", "--virtual", "--no-dynamics"]
    command += ["--no-report", "--physics", physics]
    done = subprocess.run(
        [
            *(*command, "--network", "wifi", "--seed", str(seed)),
            *("--plan", str(settings), "--out", str(out), "--quiet"),
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONHASHSEED": hash_seed},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("trace hash")]
    return line.split()[-1]


def _without_wall_time(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text())
    del found["wall_time_s"]
    return found


@pytest.mark.parametrize("physics", get_args(Physics))
@pytest.mark.xdist_group("determinism")
def test_two_processes_with_one_seed_do_the_same_and_another_seed_does_other(
    quick_plan: Plan, tmp_path: Path, physics: str
) -> None:
    one = _run(tmp_path / "one", quick_plan, physics, seed=3, hash_seed="1")
    two = _run(tmp_path / "two", quick_plan, physics, seed=3, hash_seed="2")
    other = _run(tmp_path / "other", quick_plan, physics, seed=4, hash_seed="1")
    assert one == two != other
    assert _without_wall_time(tmp_path / "one" / "result.json") == _without_wall_time(
        tmp_path / "two" / "result.json"
    )


@pytest.mark.parametrize("physics", ["compiled", *breadth("pybullet")])
@pytest.mark.parametrize(("robot", "dynamics"), [("thesis_171_vertical", True), ("a2085_03", False)])
def test_a_replay_of_the_recording_gives_the_same_result(
    rigs: Callable[..., Any], quick_plan: Plan, tmp_path: Path, robot: str, dynamics: bool
) -> None:
    plan = quick_plan.model_copy(update={"dynamics": dynamics, "dynamic_repeats": 2})
    rigs(robot, "wifi", 1).session(tmp_path / "run", plan)
    (tmp_path / "replay").mkdir()
    write_outputs(tmp_path / "replay", identify(load_recording(tmp_path / "run" / "session.mcap")))
    for name in ("result.json", "robot.urdf", "robot.srdf"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "replay" / name).read_bytes()
