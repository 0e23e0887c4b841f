"""Every invariant has a canary: a build that is broken on purpose, in which a seed finds the violation.

The same seeds find nothing in the build as it is.
"""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from coordinator.identification.result import Result, write_result
from coordinator.recording.session_file import SessionWriter
from coordinator.session.session import Session
from module_agent.firmware.firmware import Firmware
from module_agent.hardware.motor_guard import MotorGuard
from sim.faults import run
from sim.faults.report import run_seed

# The coordinator of two joints is killed in mid motion, and not started again.
KILLED = 83
# An agent dies before it is discovered: the shortest session there is.
LOST = 35
# Some messages of two joints arrive twice, which changes nothing.
HARMLESS = 111


def test_the_build_as_it_is_violates_nothing() -> None:
    report = run_seed(KILLED)
    assert report.violations == {}
    assert report.outcome == "stopped"


def test_firmware_that_does_not_expire_drives_too_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Firmware, "_expire", lambda firmware: None)
    monkeypatch.setattr("module_agent.firmware.firmware.Lease.lapsed", lambda lease, now_ns: False)
    assert set(run_seed(KILLED).violations) == {"driven too late"}


def test_a_guard_that_does_not_limit_lets_too_much_pwm_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MotorGuard, "limit", lambda guard, pwm, sample: 100.0 * pwm)
    assert "PWM out of range" in run_seed(KILLED).violations


def test_a_writer_that_loses_its_file_makes_it_unreadable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    close = SessionWriter.close

    def lose(writer: Any) -> None:
        close(writer)
        path = Path(writer._file.name)
        content = path.read_bytes()
        path.write_bytes(b"\0" * len(content))

    monkeypatch.setattr(SessionWriter, "close", lose)
    assert "unreadable recording" in run_seed(LOST).violations


def test_a_session_that_waits_for_ever_is_unbounded(monkeypatch: pytest.MonkeyPatch) -> None:
    async def wait(session: Session, expected: int) -> None:
        await asyncio.get_running_loop().create_future()

    monkeypatch.setattr(Session, "run", wait)
    monkeypatch.setattr(run, "LIMIT_S", 5.0)
    assert set(run_seed(LOST).violations) == {"unbounded"}


def test_a_result_with_a_displaced_link_is_a_wrong_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    def displace(path: Path, result: Result) -> None:
        write_result(path, result)
        written = json.loads(path.read_text())
        written["chain"]["imu_home"][1][0][3] += 0.1
        written["chain"]["imu_home"][1][1][3] += 0.1
        written["chain"]["imu_home"][1][2][3] += 0.1
        path.write_text(json.dumps(written))

    monkeypatch.setattr("coordinator.session.run.write_result", displace)
    assert set(run_seed(HARMLESS).violations) == {"wrong robot"}
