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
# A joint that swings by 0.4 rad at 0.5 Hz, sampled at 100 Hz.
T_S = np.arange(400) / 100.0
SWING = 0.4 * np.sin(np.pi * T_S)
SPEED = 0.4 * np.pi * np.cos(np.pi * T_S)


def _findings(
    joint: Array, motor: Array, reported: str = "X5-4", deflection: Array | None = None, lost: int = 0
) -> list[Any]:
    """Of one module A: its positions [rad], its motor's speeds over the true ratio, the type it reports."""
    rows: Rows = np.zeros(len(joint), ROW)
    rows["t_ns"] = (1e9 * T_S).astype(np.int64)[: len(joint)]
    rows["position_rad"], rows["motor_velocity_rad_s"] = joint, RATIO * motor
    rows["deflection_rad"] = np.nan if deflection is None else deflection
    rows = np.delete(rows, slice(50, 50 + lost))
    span = SimpleNamespace(start_row=0, end_row=len(rows))
    recording: Any = SimpleNamespace(
        latest_motions=lambda *_: [SimpleNamespace(serial="A", motion=span)],
        rows=lambda serial, first, end: rows[first:end],
        module_type=lambda serial: CATALOGUE[reported],
    )
    return gear_trains(recording, ["A"])


def test_a_motor_that_turns_as_its_type_says_has_no_finding() -> None:
    assert _findings(SWING, SPEED) == []
    # The spring adds as much motion again, which the module says.
    assert _findings(2.0 * SWING, SPEED, deflection=SWING) == []
    # Of a module that does not say it, a quarter is its spring's at most.
    assert _findings(1.25 * SWING, SPEED) == []


def test_lost_rows_are_no_other_gear_train() -> None:
    # A second is lost, in which the joint turns by 0.8 rad, from one turning point to the next.
    assert _findings(SWING, SPEED, lost=100) == []


@pytest.mark.parametrize("reported", ["X5-1", "X5-9"])
def test_a_module_with_another_gear_train_is_named(reported: str) -> None:
    (finding,) = _findings(SWING, SPEED, reported)
    assert (finding.serial, finding.measured) == ("A", pytest.approx(RATIO, rel=1e-3))
    assert finding.expected == CATALOGUE[reported].gear_ratio
    assert "of another type" in finding.summary


def test_an_encoder_that_turns_against_its_motor_is_named() -> None:
    (finding,) = _findings(-SWING, SPEED)
    assert finding.measured == pytest.approx(-RATIO, rel=1e-3)
    assert finding.summary.endswith("counts backwards")


def test_joints_that_are_stuck_and_modules_without_motor_speeds_tell_nothing() -> None:
    # The motor winds up the spring, and the joint gives by 8 mrad.
    assert _findings(0.02 * SWING, 0.1 * SPEED) == []
    assert _findings(SWING, 0.0 * SPEED) == []
    assert _findings(SWING, np.nan * SPEED) == []
    assert _findings(np.zeros(0), np.zeros(0)) == []
