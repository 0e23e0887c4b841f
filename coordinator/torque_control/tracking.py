"""Following a motion in the thesis' input modes (chapter 6.3.2): what is commanded, refused and measured.

Mode 1 commands positions, mode 2 positions and velocities, mode 3 adds the calculated torque
tau = Y(q, qd, qdd) phi (eq. 28), which the drive's own losses may be added to.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from coordinator.parameter_fit.report_parts import Part
from coordinator.torque_control.feed_forward import Reference, feed_forward
from coordinator.torque_control.gravity_model import GravityModel
from coordinator.torque_control.motor_compensation import with_motor_compensation
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.model.chain import Array
from module_agent.model.errors import RobotError
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import GainSet, Limits

InputMode = Literal[1, 2, 3]
MODES: tuple[InputMode, ...] = (1, 2, 3)
MODE_NAMES = {1: "position", 2: "position, velocity", 3: "position, velocity, torque"}
SCHEMA = 1
RESULT_NAME = "follow.json"


class MotionRefused(RobotError):
    """The robot cannot follow the motion; nothing has moved. The message names joint, time and limit."""


class JointTracking(Part):
    """Tracking error of a joint: measured position less its module's set-point at that time."""

    serial: str
    rms_rad: float
    worst_rad: float
    bias_rad: float


class ModeTracking(Part):
    """Tracking in an input mode, of the joints in the chain's order."""

    mode: InputMode
    joints: tuple[JointTracking, ...]
    rms_rad: float
    worst_rad: float


class FollowResult(Part):
    """What `x5-coordinator follow` measured, `follow.json`.

    drive: whether the torques of mode 3 had the motors' losses added. missed: set-points that were due and
    not sent. suspicions: why the model that the torques are of is not to be believed as usual.
    """

    schema_number: int = SCHEMA
    robot: str
    motion: str
    duration_s: float
    rate_hz: float
    drive: bool
    missed: int
    modes: tuple[ModeTracking, ...]
    suspicions: tuple[str, ...] = ()


def calculated_nm(
    model: GravityModel,
    reference: Reference,
    gains: Sequence[GainSet],
    winding_c: Sequence[float],
    drive: bool,
) -> Array:
    """Return the torque set-points (m, n) of mode 3 along a reference."""
    points = feed_forward(model.chain, model.phi, reference)
    if drive:
        kinds = [module_type(name) for name in model.types]
        points = with_motor_compensation(points, kinds, gains, winding_c)
    return points.effort_nm


def check_motion_limits(model: GravityModel, reference: Reference, limits: Sequence[Limits]) -> None:
    """Check position, speed and calculated torque of every joint against its module's limits and type.

    Raises:
        MotionRefused: one is exceeded.
    """
    kinds = [module_type(name) for name in model.types]
    torque = feed_forward(model.chain, model.phi, reference).effort_nm
    for column, (serial, own, kind) in enumerate(zip(model.chain.serials, limits, kinds, strict=True)):
        _check_joint(serial, own, kind, reference, torque[:, column], column)


def _check_joint(
    serial: str, limits: Limits, kind: ModuleType, reference: Reference, torque_nm: Array, column: int
) -> None:
    q = reference.q_rad[:, column]
    low, high = limits.min_position_rad, limits.max_position_rad
    speed = min(limits.max_speed_rad_s, kind.max_speed_rad_s)
    effort = min(limits.max_effort_nm, kind.max_effort_nm)
    checks = (
        ("position", q, low, -1.0, "rad"),
        ("position", q, high, 1.0, "rad"),
        ("speed", np.abs(reference.qd_rad_s[:, column]), speed, 1.0, "rad/s"),
        ("calculated torque", np.abs(torque_nm), effort, 1.0, "Nm"),
    )
    for what, values, limit, side, unit in checks:
        worst = int(np.argmax(side * values))
        if limit is not None and side * values[worst] > side * limit:
            raise MotionRefused(
                f"joint {serial} ({kind.name}): {what} {values[worst]:.2f} {unit} at "
                f"{reference.t_s[worst]:.2f} s of the motion, its limit is {limit:.2f} {unit}"
            )


def mode_tracking(mode: InputMode, rows: dict[str, Rows]) -> ModeTracking:
    """Return the tracking of one motion from the feedback of its time, by serial.

    Raises:
        RobotError: a module has sent no row with a set-point.
    """
    errors = {}
    for serial, own in rows.items():
        error = own["position_rad"] - own["position_command_rad"]
        errors[serial] = error[np.isfinite(error)]
        if not errors[serial].size:
            raise RobotError(f"module {serial} sent no feedback with a set-point during the motion")
    joints = tuple(
        JointTracking(
            serial=serial,
            rms_rad=float(np.sqrt(np.mean(error**2))),
            worst_rad=float(np.abs(error).max()),
            bias_rad=float(error.mean()),
        )
        for serial, error in errors.items()
    )
    rms = float(np.sqrt(np.mean([joint.rms_rad**2 for joint in joints])))
    return ModeTracking(mode=mode, joints=joints, rms_rad=rms, worst_rad=max(j.worst_rad for j in joints))


def result_path(folder: Path, out: Path | None) -> Path:
    """Return where the result is written: `out`, or `follow.json` in the folder of the run."""
    return folder / RESULT_NAME if out is None else out
