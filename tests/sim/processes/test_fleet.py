"""A small fleet as processes over two routers: measured, and nothing left of it."""

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import pytest

from sim.world.truth import read_motion

ROBOTS = ("robot1", "robot2")
MARK = "X5_FLEET_TEST"
# Programs start one after the other, each in up to twenty seconds on a busy machine.
LIMIT_S = 400.0
pytestmark = [pytest.mark.integration, pytest.mark.xdist_group("integration")]


def command(*more: str) -> list[str]:
    return [
        sys.executable,
        "-m",
        "sim.main",
        "fleet",
        "--robots",
        "2",
        "--modules",
        "2",
        "--routers",
        "2",
        *more,
    ]


def living(mark: str) -> list[str]:
    """Return the processes with this mark in their environment."""
    marked = []
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdigit() and f"{MARK}={mark}".encode() in (folder / "environ").read_bytes():
                marked.append((folder / "cmdline").read_text())
        except OSError:
            continue  # It has ended meanwhile, or is another user's.
    return marked


@pytest.fixture
def mark(monkeypatch: pytest.MonkeyPatch) -> str:
    text = uuid.uuid4().hex
    monkeypatch.setenv(MARK, text)
    return text


def test_a_fleet_on_two_routers_is_measured_and_stopped(tmp_path: Path, mark: str) -> None:
    path = tmp_path / "fleet.json"
    # A fifth of real time, which a busy machine has as well.
    files = ("--truth", "--json", str(path), "--out", str(tmp_path / "out"))
    more = ("--seconds", "4", "--speed", "0.2", "--move", *files)
    done = subprocess.run(command(*more), capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "broke first" in done.stdout
    assert not living(mark)
    figures = json.loads(path.read_text())
    assert {kind: each["processes"] for kind, each in figures["kinds"].items()} == {
        "router": 2,
        "world": 2,
        "agent": 2,
        "coordinator": 2,
    }
    # 4 modules, 250 rows/s each of their own time.
    assert figures["rows_per_s"] == pytest.approx(1000.0 * figures["real_time"], rel=0.2)
    assert figures["rows_lost"] == 0
    assert figures["unanswered"] == 0
    # A joint moved, as the rows that its world has kept say; how many motions fit depends on the machine.
    moved = [np.ptp(read_motion(tmp_path / "out" / robot / "truth.npz").q_rad, axis=0) for robot in ROBOTS]
    assert min(travel.max() for travel in moved) > 0.02
    assert 0.0 < figures["round_trip_p50_ms"] <= figures["round_trip_p99_ms"]


def test_an_interrupted_fleet_leaves_no_process(tmp_path: Path, mark: str) -> None:
    log = tmp_path / "log"
    with open(log, "wb") as output:
        process = subprocess.Popen(command("--seconds", "60", "--out", str(tmp_path)), stderr=output)
    end_s = time.monotonic() + LIMIT_S
    while "measuring" not in log.read_text():
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < end_s, log.read_text()
        time.sleep(0.1)
    assert len(living(mark)) > 8
    os.kill(process.pid, signal.SIGINT)
    assert process.wait(LIMIT_S) == 130
    assert not living(mark)
    # Worlds keep no truth that was not asked for.
    assert not list(tmp_path.rglob("truth.*"))
    assert log.read_text().splitlines()[-1].endswith("interrupted, everything is stopped")
