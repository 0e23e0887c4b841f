"""The thesis' one-joint arm on the bench: world, firmware of both modules, and the motions of one trial.

A trial is what chapter 6.2.1 of the thesis prescribes: rest, constant motion, windowed sine motion. What the
modules' feedback rows say of it goes through the agents' own estimator.
"""

from collections.abc import Mapping
from types import TracebackType
from typing import NamedTuple

from coordinator.excitation.plan import Plan
from module_agent.estimate.circle_point_analysis import CircleFit, circle_point_analysis, rest_reading
from module_agent.estimate.clock_delay import clock_delay
from module_agent.estimate.gaussian_filter import TAPS
from module_agent.estimate.joint_regression import JointRegression, regress_joint
from module_agent.estimate.observed_motion import MotionWindows, observed_motions
from module_agent.estimate.observer import MARGIN_NS
from module_agent.estimate.windows import AlignedMotion, align, imu_window, joint_window
from module_agent.firmware.config import config_of
from module_agent.firmware.firmware import Firmware
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.imu_prior import CALIBRATED, ImuPrior
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import GoTo, MotionRecord, Pattern, Rest
from sim.imperfections.noise_profile import NoiseProfile
from sim.robot.robot_file import Robot
from sim.test_bench.module_bench import ModuleBench
from sim.world.world import TICK_NS, World, WorldWires

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


class OneJointRig:
    """An arm of two modules: the first one's joint moves the second one's IMU.

    Raises:
        ValueError: the robot has not two modules, one upon the other.
        KeyError: unknown noise profile.
    """

    def __init__(self, robot: Robot, seed: int, noise: str | NoiseProfile | None = None):
        if robot.parents != (-1, 0):
            raise ValueError(f"robot {robot.name} is no arm of two modules, one upon the other")
        self.robot = robot
        self.world = World(robot, seed, noise)
        self._hardware = LoopInside(WorldWires(self.world))
        self.modules = tuple(
            ModuleBench(Firmware(config_of(module, index + 1), self._hardware, index))
            for index, module in enumerate(self._hardware.information)
        )
        # In their first tick both modules are taken under command, and hold still.
        self.tick()

    def __enter__(self) -> "OneJointRig":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def tick(self) -> None:
        """Advance world and firmware by one tick; the PWM acts in the next, as on the bus."""
        samples = self._hardware.receive()
        commands = [module.step(sample) for module, sample in zip(self.modules, samples, strict=True)]
        for module, pwm in zip(self.modules, self._hardware.send(commands), strict=True):
            module.publish(pwm)

    def wait(self, duration_s: float) -> None:
        """Let time pass."""
        for _ in range(round(duration_s * 1e9 / TICK_NS)):
            self.tick()

    def run(self, patterns: Mapping[int, Pattern]) -> list[MotionRecord]:
        """Run one motion on each of some modules, by index, and return their records in that order.

        Raises:
            ExperimentFailed: a module refused its motion, or it was broken off.
        """
        for index, pattern in patterns.items():
            self.modules[index].start(pattern)
        running = [self.modules[index] for index in patterns]
        while True:
            self.tick()
            records = [record for module in running if (record := module.finished()) is not None]
            if len(records) == len(running):
                return records

    def trial(self, plan: Plan) -> TrialRows:
        """Run rest, constant motion through home and windowed sine about home.

        Raises:
            ExperimentFailed: as `run`.
        """
        self._go(plan, plan.home_rad)
        rest = self.run({JOINT: Rest(duration_s=plan.rest_s), IMU: Rest(duration_s=plan.rest_s)})[IMU]
        still = self.modules[IMU].rows(rest.start_row, _end(rest))
        constant = plan.constant()
        travel = constant.velocity_rad_s * (constant.duration_s + constant.ramp_s)
        self._go(plan, plan.home_rad - 0.5 * travel)
        through = self._observe(constant)
        self._go(plan, plan.home_rad)
        return TrialRows(still, through, self._observe(plan.sine(self.modules[JOINT].firmware.config.kind)))

    def close(self) -> None:
        """End the world."""
        self.world.close()

    def _go(self, plan: Plan, target_rad: float) -> None:
        self.run({JOINT: GoTo(target_rad=target_rad, max_speed_rad_s=plan.travel_speed_rad_s)})
        self.wait(plan.settle_s)

    def _observe(self, pattern: Pattern) -> MotionRows:
        record = self.run({JOINT: pattern})[0]
        self.wait(MARGIN_NS * 1e-9)
        joint, imu = self.modules[JOINT], self.modules[IMU]
        rows = joint.rows(record.start_row, _end(record))
        # Read off both clocks at the same tick; the motion itself then tells it to microseconds.
        offset_ns = imu.now_ns - joint.now_ns
        history = imu.firmware.history
        own = imu.rows(history.first_row, history.next_row)
        start = int(rows["t_ns"][0]) + offset_ns - MARGIN_NS
        end = int(rows["t_ns"][-1]) + offset_ns + MARGIN_NS
        return MotionRows(record, rows, own[(own["t_ns"] >= start) & (own["t_ns"] <= end)], offset_ns)


def analyse(trial: TrialRows, taps: int = TAPS) -> CircleFit:
    """Run the agents' circle point analysis on a trial; `taps` = 1 leaves the thesis' filter out.

    Raises:
        ValueError: too little motion, with what would be enough.
    """
    return circle_point_analysis(
        imu_window(trial.rest), _aligned(trial.constant), _aligned(trial.sine), taps=taps
    )


def regress(trial: TrialRows, knowledge: ImuPrior = CALIBRATED) -> JointRegression:
    """Run the agents' joint regression on a trial.

    Raises:
        ValueError: too little motion, with what would be enough.
    """
    return regress_joint(observed_motions(windows(trial)), rest_reading(imu_window(trial.rest)), knowledge)


def windows(trial: TrialRows) -> list[MotionWindows]:
    """Return the trial's motions as the joint regression takes them.

    Raises:
        ValueError: too few samples to tell the clocks apart.
    """
    found = []
    for motion in (trial.constant, trial.sine):
        own, joint = imu_window(motion.imu), joint_window(motion.joint)
        offset_ns = clock_delay(own, joint, motion.rough_offset_ns).offset_ns
        found.append(MotionWindows(own, joint, imu_window(motion.joint), offset_ns))
    return found


def _aligned(motion: MotionRows) -> AlignedMotion:
    own, joint = imu_window(motion.imu), joint_window(motion.joint)
    delay = clock_delay(own, joint, motion.rough_offset_ns)
    return align(own, joint, delay.offset_ns)


def _end(record: MotionRecord) -> int:
    if record.end_row is None:
        raise ValueError(f"motion {record.motion_id} has not ended")
    return record.end_row
