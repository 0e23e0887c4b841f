"""A motor's speed over its joint's is the type's gear ratio; another one names the module."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coordinator.identification.gear_trains import gear_trains
from module_agent.model.catalogue import CATALOGUE
from module_agent.model.chain import Array
from module_agent.wire.feedback_rows import ROW, Rows

RATIO = CATALOGUE["X5-4"].gear_ratio
# A joint that swings by 0.4 rad at 0.5 Hz.
SWING = 0.4 * np.pi * np.cos(np.pi * np.linspace(0.0, 4.0, 400))


def _findings(joint: Array, motor: Array, reported: str = "X5-4") -> list[Any]:
    """Of one module A that sends these speeds while it alone is moved, and reports a type."""
    rows: Rows = np.zeros(len(joint), ROW)
    rows["velocity_rad_s"], rows["motor_velocity_rad_s"] = joint, motor
    span = SimpleNamespace(start_row=0, end_row=len(rows))
    recording: Any = SimpleNamespace(
        latest_motions=lambda *_: [SimpleNamespace(serial="A", motion=span)],
        rows=lambda serial, first, end: rows[first:end],
        module_type=lambda serial: CATALOGUE[reported],
    )
    return gear_trains(recording, ["A"])


def test_a_motor_that_turns_as_its_type_says_has_no_finding() -> None:
    assert _findings(SWING, RATIO * SWING) == []
    # The spring takes a tenth of the motion away, as in the fastest ones.
    assert _findings(SWING, 0.9 * RATIO * SWING) == []


@pytest.mark.parametrize("reported", ["X5-1", "X5-9"])
def test_a_module_with_another_gear_train_is_named(reported: str) -> None:
    (finding,) = _findings(SWING, RATIO * SWING, reported)
    assert (finding.serial, finding.measured) == ("A", pytest.approx(RATIO, rel=1e-6))
    assert finding.expected == CATALOGUE[reported].gear_ratio
    assert "of another type" in finding.summary


def test_an_encoder_that_turns_against_its_motor_is_named() -> None:
    (finding,) = _findings(-SWING, RATIO * SWING)
    assert finding.measured == pytest.approx(-RATIO, rel=1e-6)
    assert finding.summary.endswith("counts backwards")


def test_joints_that_are_stuck_and_modules_without_motor_speeds_tell_nothing() -> None:
    # The motor winds up the spring by 0.03 rad.
    assert _findings(0.02 * SWING, 0.1 * RATIO * SWING) == []
    assert _findings(SWING, 0.0 * SWING) == []
    assert _findings(SWING, np.nan * SWING) == []
    assert _findings(np.zeros(0), np.zeros(0)) == []
