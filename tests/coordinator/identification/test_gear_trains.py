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
# A joint that swings by 0.4 rad at 0.5 Hz, sampled at 250 Hz.
T_S = np.arange(1000) / 250.0
SWING = 0.4 * np.sin(np.pi * T_S)
SPEED = 0.4 * np.pi * np.cos(np.pi * T_S)
# What its spring gives under its load and by friction, and how fast.
DEFLECTION = 0.06 * np.sin(np.pi * T_S) + 0.04 * np.sin(2.0 * np.pi * T_S)
GIVING = 0.06 * np.pi * np.cos(np.pi * T_S) + 0.08 * np.pi * np.cos(2.0 * np.pi * T_S)


def _doubts(
    joint: Array,
    motor: Array,
    reported: str = "X5-4",
    deflection: Any = 0.0,
    lost: int = 0,
    stretched: float = 1.0,
) -> Any:
    """Of one module A: speeds of its joint and, over the true ratio, of its motor; the type it reports."""
    rows: Rows = np.zeros(len(joint), ROW)
    rows["t_ns"] = (1e9 * T_S).astype(np.int64)[: len(joint)]
    rows["velocity_rad_s"], rows["motor_velocity_rad_s"] = joint, RATIO * motor
    rows["position_rad"] = stretched * np.cumsum(joint) / 250.0
    rows["deflection_rad"] = deflection
    rows = np.delete(rows, slice(188, 188 + lost))
    span = SimpleNamespace(start_row=0, end_row=len(rows))
    recording: Any = SimpleNamespace(
        latest_motions=lambda *_: [SimpleNamespace(serial="A", motion=span)],
        rows=lambda serial, first, end: rows[first:end],
        module_type=lambda serial: CATALOGUE[reported],
    )
    return gear_trains(recording, ["A"])


def test_a_motor_that_turns_as_its_type_says_is_not_doubted() -> None:
    assert _doubts(SPEED, SPEED).findings == ()
    assert _doubts(SPEED + GIVING, SPEED, deflection=DEFLECTION).findings == ()
    # The torque sensor's scale, and the deflection's with it, is wrong by a tenth as delivered.
    assert _doubts(SPEED + GIVING, SPEED, deflection=1.1 * DEFLECTION).findings == ()


def test_positions_and_speeds_that_disagree_by_a_percent_are_no_scale() -> None:
    # As in a real module's log, where its motor agrees with its speed.
    doubts = _doubts(SPEED, SPEED, stretched=0.99)
    assert doubts.findings == ()


def test_a_spring_that_is_not_reported_is_no_scale() -> None:
    assert _doubts(1.3 * SPEED, SPEED, deflection=np.nan).findings == ()


@pytest.mark.parametrize("deflection", [0.0, np.nan])
@pytest.mark.parametrize("reported", ["X5-1", "X5-9"])
def test_a_module_with_another_gear_train_is_named(reported: str, deflection: float) -> None:
    doubts = _doubts(SPEED, SPEED, reported, deflection)
    (finding,) = doubts.findings
    assert (finding.serial, finding.measured) == ("A", pytest.approx(RATIO, rel=1e-3))
    assert finding.expected == CATALOGUE[reported].gear_ratio
    assert "of another type" in finding.summary
    assert (doubts.opposed, doubts.other_type, doubts.scaled) == ((), ("A",), ())


@pytest.mark.parametrize("scale", [0.99, 1.01])
@pytest.mark.parametrize("lost", [0, 125])
def test_an_encoder_that_is_off_in_scale_by_a_percent_is_named(scale: float, lost: int) -> None:
    # Lost rows: half a second in which the joint is faster than before and after.
    doubts = _doubts(scale * (SPEED + GIVING), SPEED, deflection=DEFLECTION, lost=lost)
    (finding,) = doubts.findings
    assert finding.measured == pytest.approx(RATIO / scale, rel=1e-3)
    assert (doubts.opposed, doubts.other_type, doubts.scaled) == ((), (), ("A",))


def test_an_encoder_that_turns_against_its_motor_is_opposed() -> None:
    doubts = _doubts(-SPEED, SPEED)
    (finding,) = doubts.findings
    assert finding.measured == pytest.approx(-RATIO, rel=1e-3)
    assert (doubts.opposed, doubts.other_type, doubts.scaled) == ((finding,), (), ())


def test_joints_that_are_stuck_and_modules_without_motor_speeds_tell_nothing() -> None:
    # The motor winds up the spring, and the joint gives by 8 mrad.
    assert _doubts(0.02 * SPEED, 0.1 * SPEED).findings == ()
    assert _doubts(SPEED, 0.0 * SPEED).findings == ()
    assert _doubts(SPEED, np.nan * SPEED).findings == ()
    assert _doubts(np.zeros(0), np.zeros(0)).findings == ()
