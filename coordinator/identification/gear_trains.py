"""Gear trains against the catalogue: how fast motors turn, over how fast their joints do.

A module that reports another type than it is has its IMU, its masses and its limits elsewhere. The place of a
leaf's IMU shows in no motion; its gear ratio does, where both types have different ones.
"""

from collections.abc import Sequence

import numpy as np

from coordinator.identification.sensor_checks import EXPLORATION, NAMED_ABOVE, Finding
from coordinator.recording.recording import Recording

# Springs between motor and joint turn along, by up to a tenth in the fastest motions of the exploration. Gear
# trains of the catalogue's types differ by factors of 2.3 and more.
GEAR_SIGMA = 0.1
# Joints that move less (rms) tell nothing: motors that wind up the springs of stuck joints turn as well.
MIN_SPEED_RAD_S = 0.05
_OTHER_TYPE = "it seems to be of another type than it reports"
_OPPOSED = "its encoder or its motor counts backwards"


def gear_trains(recording: Recording, serials: Sequence[str]) -> list[Finding]:
    """Return the modules whose gear ratio is not that of their types; none of those without motor speeds."""
    findings = []
    for serial in serials:
        alone = recording.latest_motions("constant", "windowed_sine", "whole")
        motions = [e.motion for e in alone if e.serial == serial and e.motion is not None]
        parts = [
            recording.rows(serial, motion.start_row, motion.end_row)
            for motion in motions
            if motion.end_row is not None
        ]
        joint, motor = (
            np.concatenate([np.zeros(0), *(part[field].astype(float) for part in parts)])
            for field in ("velocity_rad_s", "motor_velocity_rad_s")
        )
        finite = np.isfinite(joint) & np.isfinite(motor)
        joint, motor = joint[finite], motor[finite]
        if not motor.any() or float(np.sqrt(np.mean(joint**2))) < MIN_SPEED_RAD_S:
            continue
        ratio, expected = float(motor @ joint / (joint @ joint)), recording.module_type(serial).gear_ratio
        off = abs(ratio / expected - 1.0) / GEAR_SIGMA
        if off > NAMED_ABOVE:
            what, remedy = "its motor's speed over its joint's", _OPPOSED if ratio < 0.0 else _OTHER_TYPE
            findings.append(Finding(serial, EXPLORATION, what, ratio, expected, off, "", remedy))
    return findings
