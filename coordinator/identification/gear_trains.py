"""Gear trains against the catalogue: how far motors turn, over how far their side of the springs does.

A module that reports another type than it is has its IMU, its masses and its limits elsewhere. The place of a
leaf's IMU shows in no motion, nor does the sign of its encoder; its gear ratio does, where both types have
different ones.
"""

from collections.abc import Sequence

import numpy as np

from coordinator.identification.sensor_checks import EXPLORATION, NAMED_ABOVE, Finding
from coordinator.recording.recording import Recording
from module_agent.model.chain import Array
from module_agent.signals.filtering import NS_PER_S
from module_agent.wire.feedback_rows import Rows

# The rows resolve a percent or two. A module that does not send its spring's deflection is off by what the
# spring takes of the motion, up to a quarter. Gear trains of types differ by factors of 2.3 and more.
GEAR_SIGMA = 0.1
# The path of a joint that is enough to tell: exploring ones turn by half a radian, there and back.
MIN_PATH_RAD = 0.2
# Steps over more than this many median ones are holes.
HOLE_STEPS = 3.0
_OTHER_TYPE = "it seems to be of another type than it reports"
_OPPOSED = "its encoder or its motor counts backwards"


def gear_trains(recording: Recording, serials: Sequence[str]) -> list[Finding]:
    """Return the modules whose gear ratio is not that of their types; none of those without motor speeds."""
    findings = []
    alone = recording.latest_motions("constant", "windowed_sine", "whole")
    for serial in serials:
        steps = [np.zeros((2, 0))]
        for motion in (e.motion for e in alone if e.serial == serial):
            if motion is not None and motion.end_row is not None:
                steps.append(_steps(recording.rows(serial, motion.start_row, motion.end_row)))
        joint, motor = np.hstack(steps)
        if not motor.any() or float(np.abs(joint).sum()) < MIN_PATH_RAD:
            continue
        ratio, expected = float(motor @ joint / (joint @ joint)), recording.module_type(serial).gear_ratio
        off = abs(ratio / expected - 1.0) / GEAR_SIGMA
        if off > NAMED_ABOVE:
            what, remedy = "its motor's speed over its joint's", _OPPOSED if ratio < 0.0 else _OTHER_TYPE
            findings.append(Finding(serial, EXPLORATION, what, ratio, expected, off, "", remedy))
    return findings


def _steps(rows: Rows) -> Array:
    """Return how far the spring's motor side and the motor turned from row to row [rad], (2, k)."""
    t_s = rows["t_ns"].astype(np.int64) / NS_PER_S
    deflection = rows["deflection_rad"].astype(float)
    driven = rows["position_rad"] - np.where(np.isfinite(deflection), deflection, 0.0)
    speed, between = rows["motor_velocity_rad_s"].astype(float), np.diff(t_s)
    turned = 0.5 * (speed[1:] + speed[:-1]) * between
    kept = np.isfinite(turned) & (between <= HOLE_STEPS * np.median(between if len(between) else 0.0))
    return np.stack([np.diff(driven), turned])[:, kept]
