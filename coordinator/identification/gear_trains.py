"""Gear trains against the catalogue: how far joints turn, over how far their motors do.

A module that reports another type than it is has its IMU, its masses and its limits elsewhere. The place of a
leaf's IMU shows in no motion, nor does the sign of its encoder, nor the scale of a vertical joint's against
gyros that are not calibrated; the gear ratio does. Over a tenth of a second the joint turns by

    D q = a D theta + k D d

with theta the integral of the motor's speed over the gear ratio, and d the deflection of the spring between
them. a is 1 for a healthy module.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.identification.finding import Finding, Sickness
from coordinator.identification.sensor_checks import EXPLORATION, NAMED_ABOVE, SERIOUS_ABOVE
from coordinator.recording.recording import Recording
from module_agent.model.chain import Array
from module_agent.signals.filtering import NS_PER_S
from module_agent.wire.feedback_rows import Rows

# In a real X5-1's log the speeds of motor and joint agree to 0.1 %; clearance of 0.1 deg in gears is 0.22 %
# of a travel of 0.8 rad.
GEAR_SIGMA = 2.2e-3
# Without the deflection it is what springs add to the motion, up to 40 % of the fastest.
SPRINGLESS_SIGMA = 0.15
# Prior of k about 1: torque sensors as delivered.
DEFLECTION_SIGMA = 0.1
# How long the joint turns from sample to sample of the regression, and the error of such a turn.
TURN_S, TURN_SIGMA_RAD = 0.1, 3e-4
# Root of the sum of squares of independent steps that is enough to tell: exploring joints have 0.1 and more.
MIN_TURN_RAD = 0.02
# Steps over more than this many median ones are holes.
HOLE_STEPS = 3.0
# Types with other gear trains have ratios that differ by factors of 2.3 and more.
OTHER_TYPE = 0.4
_WHAT = "its motor's speed over its joint's"
_OTHER_TYPE = "it seems to be of another type than it reports"
_OPPOSED = "its encoder or its motor counts backwards"
_SCALED = "its encoder's scale is estimated; check its gear ratio and type"
_KINDS: Mapping[str, Sickness] = {
    _OTHER_TYPE: "type_mislabelled",
    _OPPOSED: "encoder_sign",
    _SCALED: "encoder_scale",
}


class GearDoubts(NamedTuple):
    """Gear ratios that are not those of their types.

    opposed: encoders against their motors. other_type, scaled: serials of modules of another gear train, and
    of encoders that are off in scale.
    """

    findings: tuple[Finding, ...]
    opposed: tuple[Finding, ...]
    other_type: tuple[str, ...]
    scaled: tuple[str, ...]


def gear_trains(recording: Recording, serials: Sequence[str]) -> GearDoubts:
    """Return the modules whose gear ratio is not that of their types; none of those without motor speeds."""
    findings = []
    alone = recording.latest_motions("constant", "windowed_sine", "whole")
    for serial in serials:
        gear_ratio, parts = recording.module_type(serial).gear_ratio, [np.zeros((4, 0))]
        for motion in (e.motion for e in alone if e.serial == serial):
            if motion is not None and motion.end_row is not None:
                parts += _turns(recording.rows(serial, motion.start_row, motion.end_row), gear_ratio)
        known = _turn_of_joint(np.hstack(parts))
        if known is None:
            continue
        turn, sigma = known
        off = (abs(float(np.log(turn))) if turn > 0.0 else 1.0 - turn) / sigma
        if off > NAMED_ABOVE:
            measured = gear_ratio / (turn or 1e-9)
            remedy = _SCALED if abs(measured / gear_ratio - 1.0) < OTHER_TYPE else _OTHER_TYPE
            remedy = _OPPOSED if turn < 0.0 else remedy
            kind, serious = _KINDS[remedy], off > SERIOUS_ABOVE
            findings.append(
                Finding(serial, EXPLORATION, _WHAT, measured, gear_ratio, off, "", remedy, kind, serious)
            )
    by = {remedy: [f for f in findings if f.remedy == remedy] for remedy in (_OPPOSED, _OTHER_TYPE, _SCALED)}
    other_type, scaled = (tuple(f.serial for f in by[remedy]) for remedy in (_OTHER_TYPE, _SCALED))
    return GearDoubts(tuple(findings), tuple(by[_OPPOSED]), other_type, scaled)


def _turns(rows: Rows, gear_ratio: float) -> list[Array]:
    """Return the steps of joint, integrated joint speed, motor and deflection, (4, k) a stretch.

    Steps are over `TURN_S`, which overlap, and as many fewer of them count as independent: all rows are
    divided by the root of that number. The motor's are over the gear ratio.
    """
    t_s = rows["t_ns"].astype(np.int64) / NS_PER_S
    speeds = rows["velocity_rad_s"].astype(float), rows["motor_velocity_rad_s"].astype(float) / gear_ratio
    signals = np.stack([rows["position_rad"], *speeds, rows["deflection_rad"].astype(float)])
    step_s = np.diff(t_s)
    typical = float(np.median(step_s)) if len(step_s) else TURN_S
    ends, lag = np.flatnonzero(step_s > HOLE_STEPS * typical) + 1, max(round(TURN_S / typical), 1)
    parts = []
    for t, part in zip(np.split(t_s, ends), np.split(signals, ends, axis=1), strict=True):
        q, joint, motor, deflection = part
        if len(t) > lag and np.isfinite(part[:3]).all():
            whole = np.stack([q, _integral(t, joint), _integral(t, motor), deflection])
            parts.append((whole[:, lag:] - whole[:, :-lag]) / lag**0.5)
    return parts


def _integral(t_s: Array, speed: Array) -> Array:
    return np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t_s)))


def _turn_of_joint(turns: Array) -> tuple[float, float] | None:
    """Return the joint's turn over the motor's, a, and its sigma, of steps (4, k); None if nothing moved.

    It is that by positions. By speeds it differs by what filters and clocks do to them: half of that counts.
    """
    joint, integrated, motor, deflection = turns
    if not motor.any() or float(np.linalg.norm(joint)) < MIN_TURN_RAD:
        return None
    sprung = bool(np.isfinite(deflection).all())
    columns = np.stack([motor, deflection if sprung else np.zeros(len(motor))], axis=1)
    prior, mean = np.array([0.0, DEFLECTION_SIGMA**-2.0]), np.array([0.0, 1.0])
    spread = np.linalg.inv(columns.T @ columns / TURN_SIGMA_RAD**2 + np.diag(prior))
    turn = float((spread @ (columns.T @ joint / TURN_SIGMA_RAD**2 + prior * mean))[0])
    apart = float(motor @ (integrated - joint) / (motor @ motor))
    return turn, float(np.hypot(GEAR_SIGMA if sprung else SPRINGLESS_SIGMA, 0.5 * apart))
