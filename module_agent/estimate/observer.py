"""One module's local estimates from the motions of all joints, its own included."""

from collections.abc import Callable
from typing import NamedTuple

from module_agent.estimate.circle_point_analysis import circle_estimate, circle_point_analysis, rest_reading
from module_agent.estimate.clock_delay import clock_delay
from module_agent.estimate.joint_regression import regress_joint, regression_estimate
from module_agent.estimate.motion_detection import detect_motion
from module_agent.estimate.observed_motion import MotionWindows, observed_motions
from module_agent.estimate.windows import AlignedMotion, ImuWindow, align, even, imu_window, joint_window
from module_agent.firmware.feedback import History
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import UNCALIBRATED, ImuPrior
from module_agent.peers.motion_listener import MAX_MODULES, JointMotion
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import (
    MAX_ROWS_PER_MOTION,
    CircleEstimate,
    MotionRecord,
    RegressionEstimate,
    Vector3,
    cut,
)

# Own samples to either side of a motion: more than the rough clock mapping may be wrong by.
MARGIN_NS = 150_000_000
# Of all constant motions that wait for their windowed sines: the two longest ones that can be, or 4 s at
# 250 Hz of 200 joints, in 40 MB. A joint makes both after each other; others may be made up.
MAX_CONSTANT_ROWS = 2 * MAX_ROWS_PER_MOTION


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


class _Constant(NamedTuple):
    """The constant motion of a joint as this module measured it, and whether the module moved with it."""

    boot: int
    motion_id: int
    motion: AlignedMotion
    windows: MotionWindows
    moved: bool


class Observer:
    """Holds, per joint, the constant motion until the windowed sine follows, and the findings.

    Of as many joints as a robot has modules; those that moved longest ago give way. `knowledge` is the prior
    of the module's own IMU.
    """

    def __init__(self, serial: str, boot: int, knowledge: ImuPrior = UNCALIBRATED):
        self.serial = serial
        self.boot = boot
        self.knowledge = knowledge
        self.findings: dict[str, Finding] = {}
        self._constant: dict[str, _Constant] = {}
        self._rest: tuple[int, Rows] | None = None

    def job(self, motion: JointMotion, history: History, rest: MotionRecord | None) -> Callable[[], Finding]:
        """Copy the needed rows of the own history; return the estimate as work to do in parallel."""
        own = _own_rows(history, motion, motion.rough_offset_ns.get(self.serial, 0))
        still = self._rest_rows(history, rest)
        return lambda: self._analyse(motion, imu_window(own), imu_window(still))

    def keep(self, finding: Finding) -> None:
        """Keep a finding as the latest of its joint."""
        self.findings.pop(finding.joint, None)
        self.findings[finding.joint] = finding
        if len(self.findings) > MAX_MODULES:
            del self.findings[next(iter(self.findings))]

    def _keep_constant(self, joint: str, constant: _Constant) -> None:
        self._constant.pop(joint, None)
        self._constant[joint] = constant
        rows = sum(len(each.windows.joint.t_ns) for each in self._constant.values())
        while rows > MAX_CONSTANT_ROWS or len(self._constant) > MAX_MODULES:
            rows -= len(self._constant.pop(next(iter(self._constant))).windows.joint.t_ns)

    def _rest_rows(self, history: History, rest: MotionRecord | None) -> Rows:
        """Return the rows of the last rest, kept longer than the history keeps them; none before any rest."""
        if rest is None or rest.end_row is None:
            return history.rows(history.next_row, history.next_row)
        if self._rest is None or self._rest[0] != rest.motion_id:
            end = max(rest.end_row, history.first_row)
            self._rest = (rest.motion_id, history.rows(max(rest.start_row, history.first_row), end))
        return self._rest[1]

    def _analyse(self, motion: JointMotion, own: ImuWindow, rest: ImuWindow) -> Finding:
        number = motion.record.motion_id
        found = Finding(motion.serial, (number,), False, 0.0, (0.0, 0.0, 0.0), None, None, "")
        try:
            still = rest_reading(rest)
            x, y, z = still.specific_force_m_s2.tolist()
            found = found._replace(gravity_m_s2=(x, y, z))
            joint = joint_window(motion.rows)
            smooth = even(own), even(joint)
            delay = clock_delay(*smooth, motion.rough_offset_ns.get(self.serial, 0))
            aligned = align(*smooth, delay.offset_ns)
            windows = MotionWindows(own, joint, imu_window(motion.rows), delay.offset_ns)
            moved, ratio, *_ = detect_motion([aligned], still.gyro_offset_rad_s)
            found = found._replace(moved=moved, rate_ratio=ratio)
            if motion.record.pattern.kind == "constant":
                self._keep_constant(motion.serial, _Constant(motion.boot, number, aligned, windows, moved))
                return found
            # Slow motion decides: near a resonance of the held joints the windowed sine shakes modules that
            # the joint does not carry, and keeps others still that it does carry.
            constant = self._constant.get(motion.serial)
            if constant is None or constant.boot != motion.boot:
                raise DataError(f"no constant motion of {motion.serial} was seen: its axis is not known")
            found = found._replace(motion_ids=(constant.motion_id, number), moved=constant.moved)
            if found.moved:
                fit = circle_point_analysis(rest, constant.motion, aligned)
                found = found._replace(circle=circle_estimate(fit, delay.delay_s))
                motions = observed_motions([constant.windows, windows])
                regression = regress_joint(motions, still, self.knowledge)
                delay_s = delay.delay_s + regression.delays_s[-1]
                found = found._replace(regression=regression_estimate(regression, delay_s))
        except (DataError, ValueError, ArithmeticError, MemoryError) as error:
            # Published as a finding: it explains why there is no estimate. The rows of others may be anything
            # such as times that no spline takes, and must not end this process. LinAlgErrors are ValueErrors.
            why = str(error) if found.circle is None else f"no joint regression: {error}"
            found = found._replace(note=cut(why))
        return found


def _own_rows(history: History, motion: JointMotion, offset_ns: int) -> Rows:
    """Return the own rows within the motion's time and a margin; none for a motion shorter than a row."""
    if not len(motion.rows):
        return history.rows(history.next_row, history.next_row)
    start = int(motion.rows["t_ns"][0]) + offset_ns - MARGIN_NS
    end = int(motion.rows["t_ns"][-1]) + offset_ns + MARGIN_NS
    return history.between(start, end)
