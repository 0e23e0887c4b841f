"""The thesis' one-joint arm on the bench, and the motions and estimates of one trial.

A trial is what chapter 6.2.1 of the thesis prescribes: rest, constant motion, windowed sine motion. The
modules' feedback rows go through the agents' own estimator.
"""

from typing import NamedTuple

from coordinator.excitation.plan import Plan
from module_agent.estimate.circle_point_analysis import CircleFit, circle_point_analysis, rest_reading
from module_agent.estimate.clock_delay import clock_delay
from module_agent.estimate.gaussian_filter import TAPS
from module_agent.estimate.joint_regression import JointRegression, regress_joint
from module_agent.estimate.observed_motion import MotionWindows, observed_motions
from module_agent.estimate.observer import MARGIN_NS
from module_agent.estimate.windows import AlignedMotion, align, imu_window, joint_window
from module_agent.model.imu_prior import CALIBRATED, ImuPrior
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import GoTo, MotionRecord, Pattern, Rest
from sim.imperfections.noise_profile import NoiseProfile
from sim.robot.robot_file import Robot
from sim.test_bench.robot_bench import BenchRobot

JOINT, IMU = 0, 1


class MotionRows(NamedTuple):
    """One motion of the joint: its record, its own rows, and those of the IMU's module with a margin."""

    record: MotionRecord
    joint: Rows
    imu: Rows
    rough_offset_ns: int


class TrialRows(NamedTuple):
    """The rows of one trial: the IMU's module at rest, the constant and the windowed sine motion."""

    rest: Rows
    constant: MotionRows
    sine: MotionRows


class OneJointRig(BenchRobot):
    """An arm of two modules: the joint of the first moves the IMU of the second.

    Raises:
        ValueError: the robot is not two modules in a row.
        KeyError: unknown noise profile.
    """

    def __init__(self, robot: Robot, seed: int, noise: str | NoiseProfile | None = None):
        if robot.parents != (-1, 0):
            raise ValueError(
                f"robot {robot.name} has the parents {robot.parents}; this rig takes an arm of two modules"
            )
        self.robot = robot
        super().__init__(robot, seed, noise)

    def trial(self, plan: Plan) -> TrialRows:
        """Run rest, constant motion through home and windowed sine about home.

        Raises:
            ExperimentFailed: as `run`.
        """
        self._go(plan, plan.home_rad)
        rest = self.run(dict.fromkeys(self.by_serial, Rest(duration_s=plan.rest_s)))[IMU]
        still = self.modules[IMU].rows(rest.start_row, _end(rest))
        constant = plan.constant()
        travel = constant.velocity_rad_s * (constant.duration_s + constant.ramp_s)
        self._go(plan, plan.home_rad - 0.5 * travel)
        through = self._observe(constant)
        self._go(plan, plan.home_rad)
        return TrialRows(still, through, self._observe(plan.sine(self.modules[JOINT].firmware.config.kind)))

    def _go(self, plan: Plan, target_rad: float) -> None:
        self._move(GoTo(target_rad=target_rad, max_speed_rad_s=plan.travel_speed_rad_s))
        self.wait(plan.settle_s)

    def _move(self, pattern: Pattern) -> MotionRecord:
        return self.run({self.modules[JOINT].serial: pattern})[0]

    def _observe(self, pattern: Pattern) -> MotionRows:
        record = self._move(pattern)
        self.wait(MARGIN_NS * 1e-9)
        joint, imu = self.modules[JOINT], self.modules[IMU]
        rows = joint.rows(record.start_row, _end(record))
        # Both clocks read at the same tick; the motion itself then gives the offset to microseconds.
        offset_ns = imu.now_ns - joint.now_ns
        history = imu.firmware.history
        own = imu.rows(history.first_row, history.next_row)
        start = int(rows["t_ns"][0]) + offset_ns - MARGIN_NS
        end = int(rows["t_ns"][-1]) + offset_ns + MARGIN_NS
        return MotionRows(record, rows, own[(own["t_ns"] >= start) & (own["t_ns"] <= end)], offset_ns)


def analyse(trial: TrialRows, taps: int = TAPS) -> CircleFit:
    """Run the agents' circle point analysis on a trial; `taps` = 1 omits the thesis' filter.

    Raises:
        ValueError: too little motion, with what would be enough.
    """
    constant, sine = aligned(trial)
    return circle_point_analysis(imu_window(trial.rest), constant, sine, taps=taps)


def aligned(trial: TrialRows) -> tuple[AlignedMotion, AlignedMotion]:
    """Return constant and windowed sine motion, each on one time axis.

    Raises:
        ValueError: too few samples to estimate the offset of the clocks.
    """
    constant, sine = (align(one.imu, one.joint, one.offset_ns) for one in windows(trial))
    return constant, sine


def regress(trial: TrialRows, knowledge: ImuPrior = CALIBRATED) -> JointRegression:
    """Run the agents' joint regression on a trial.

    Raises:
        ValueError: too little motion, with what would be enough.
    """
    rest = rest_reading(imu_window(trial.rest))
    return regress_joint(observed_motions(windows(trial)), rest, knowledge, symmetric_load=True)


def windows(trial: TrialRows) -> list[MotionWindows]:
    """Return the trial's motions as the joint regression takes them.

    Raises:
        ValueError: too few samples to estimate the offset of the clocks.
    """
    return [_windows(motion) for motion in (trial.constant, trial.sine)]


def _windows(motion: MotionRows) -> MotionWindows:
    own, joint = imu_window(motion.imu), joint_window(motion.joint)
    offset_ns = clock_delay(own, joint, motion.rough_offset_ns).offset_ns
    return MotionWindows(own, joint, imu_window(motion.joint), offset_ns)


def _end(record: MotionRecord) -> int:
    if record.end_row is None:
        raise ValueError(f"motion {record.motion_id} has not ended")
    return record.end_row
