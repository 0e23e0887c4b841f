"""One module's local estimates from the motions of all joints, its own included.

`job` copies the samples that an estimate needs and returns the work as a function, so that it can run in
parallel to the firmware's ticks.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from module_agent.estimate.circle_point_analysis import (
    RestReading,
    circle_estimate,
    circle_point_analysis,
    rest_reading,
)
from module_agent.estimate.clock_delay import clock_delay
from module_agent.estimate.joint_regression import regress_joint, regression_estimate
from module_agent.estimate.motion_detection import detect_motion
from module_agent.estimate.observed_motion import MotionWindows, observed_motions
from module_agent.estimate.windows import AlignedMotion, ImuWindow, align, imu_window, joint_window
from module_agent.firmware.feedback import History
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import UNCALIBRATED, ImuPrior
from module_agent.peers.motion_listener import JointMotion
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import CircleEstimate, MotionRecord, RegressionEstimate, Vector3

# Own samples to either side of a motion: more than the rough clock mapping may be wrong by.
MARGIN_NS = 150_000_000


class Finding(NamedTuple):
    """A module's estimate of a joint: whether it moves with it, and the circle that its IMU describes."""

    joint: str
    motion_ids: tuple[int, ...]
    moved: bool
    rate_ratio: float
    gravity_m_s2: Vector3
    circle: CircleEstimate | None
    regression: RegressionEstimate | None
    note: str


class _Local(NamedTuple):
    """Both estimates of one joint, and the reason if there is no regression."""

    circle: CircleEstimate | None
    regression: RegressionEstimate | None
    note: str


class _Constant(NamedTuple):
    """The constant motion of a joint as this module measured it, and whether the module moved with it."""

    boot: int
    motion_id: int
    motion: AlignedMotion
    windows: MotionWindows
    moved: bool


class Observer:
    """Holds, per joint, the constant motion until the windowed sine follows, and the findings.

    `knowledge` is the prior of the module's own IMU.
    """

    def __init__(self, serial: str, boot: int, knowledge: ImuPrior = UNCALIBRATED):
        self.serial = serial
        self.boot = boot
        self.knowledge = knowledge
        self.findings: dict[str, Finding] = {}
        self._constant: dict[str, _Constant] = {}
        self._rest: tuple[int, Rows] | None = None

    def job(self, motion: JointMotion, history: History, rest: MotionRecord | None) -> Callable[[], Finding]:
        """Copy the needed rows of the own history; return the estimate as work to be done."""
        own = _own_rows(history, motion, motion.rough_offset_ns.get(self.serial, 0))
        still = self._rest_rows(history, rest)
        return lambda: self._analyse(motion, imu_window(own), imu_window(still))

    def _rest_rows(self, history: History, rest: MotionRecord | None) -> Rows:
        """Return the rows of the last rest, kept longer than the history keeps them; none before any rest."""
        if rest is None or rest.end_row is None:
            return history.rows(history.next_row, history.next_row)
        if self._rest is None or self._rest[0] != rest.motion_id:
            end = max(rest.end_row, history.first_row)
            self._rest = (rest.motion_id, history.rows(max(rest.start_row, history.first_row), end))
        return self._rest[1]

    def _analyse(self, motion: JointMotion, own: ImuWindow, rest: ImuWindow) -> Finding:
        numbers: tuple[int, ...] = (motion.record.motion_id,)
        gravity: Vector3 = (0.0, 0.0, 0.0)
        moved, ratio, local = False, 0.0, None
        try:
            still = rest_reading(rest)
            x, y, z = (float(value) for value in still.specific_force_m_s2)
            gravity = (x, y, z)
            joint = joint_window(motion.rows)
            rough = motion.rough_offset_ns.get(self.serial, 0)
            delay = clock_delay(own, joint, rough)
            aligned = align(own, joint, delay.offset_ns)
            windows = MotionWindows(own, joint, imu_window(motion.rows), delay.offset_ns)
            detection = detect_motion([aligned], still.gyro_offset_rad_s)
            moved, ratio = detection.moved, detection.rate_ratio
            if motion.record.pattern.kind == "constant":
                self._constant[motion.serial] = _Constant(
                    motion.boot, motion.record.motion_id, aligned, windows, moved
                )
            else:
                # Slow motion decides: near a resonance of the held joints the windowed sine shakes modules
                # that the joint does not carry, and keeps others still that it does carry.
                constant = self._constant_of(motion)
                numbers, moved = (constant.motion_id, *numbers), constant.moved
                if moved:
                    fit = circle_point_analysis(rest, constant.motion, aligned)
                    circle = circle_estimate(fit, delay.delay_s)
                    local = self._regress(circle, [constant.windows, windows], still)
            note = "" if local is None else local.note
        except (DataError, np.linalg.LinAlgError) as error:
            # Published as a finding: it explains why there is no estimate.
            note = str(error)
        if local is None:
            local = _Local(None, None, note)
        return Finding(
            motion.serial, numbers, moved, ratio, gravity, local.circle, local.regression, note[:512]
        )

    def _regress(self, circle: CircleEstimate, windows: list[MotionWindows], still: RestReading) -> _Local:
        try:
            regression = regress_joint(observed_motions(windows), still, self.knowledge)
        except (DataError, np.linalg.LinAlgError) as error:
            return _Local(circle, None, f"no joint regression: {error}")
        delay_s = circle.delay_s + regression.delays_s[-1]
        return _Local(circle, regression_estimate(regression, delay_s), "")

    def _constant_of(self, motion: JointMotion) -> _Constant:
        constant = self._constant.get(motion.serial)
        if constant is None or constant.boot != motion.boot:
            raise DataError(f"no constant motion of {motion.serial} was seen: its axis is not known")
        return constant


def _own_rows(history: History, motion: JointMotion, offset_ns: int) -> Rows:
    """Return the own rows within the motion's time and a margin; none for a motion shorter than a row."""
    if not len(motion.rows):
        return history.rows(history.next_row, history.next_row)
    start = int(motion.rows["t_ns"][0]) + offset_ns - MARGIN_NS
    end = int(motion.rows["t_ns"][-1]) + offset_ns + MARGIN_NS
    return history.between(start, end)
