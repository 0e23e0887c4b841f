"""Which robots follow which motion under which gains: the thesis' figures 52 to 61; arms of six joints."""

from collections.abc import Mapping
from math import pi
from typing import Literal, NamedTuple

from module_agent.model.errors import UsageError
from module_agent.wire.messages import DynamicPattern, MultiSine, Pattern, Sine, WindowedSine
from sim.imperfections.noise_profile import NoiseProfile
from sim.thesis.dynamics.torque_assistance import (
    MODES,
    ON_MODULE,
    Delivery,
    Follow,
    Gains,
    Model,
    Stage,
    follow,
    standing_robot,
)
from sim.thesis.published import ALIGNMENTS, READINGS, SETTINGS, Alignment, Reading, thesis_length

Motion = Literal["windowed sine", "sine", "pattern", "all joints"]

# The thesis identifies and assists on its longest arm alone, chapter 6.3.
LENGTH_MM = 484
HOSTS = (
    Delivery("host, 250 Hz, lan", "lan", 250.0),
    Delivery("host, 100 Hz, lan", "lan", 100.0),
    Delivery("host, 250 Hz, wifi", "wifi", 250.0),
)
FACTORY = (Gains(3), Gains(4))
# Figure 53 and 54 have "a normal sine trajectory"; its size is not printed. This one asks for a peak of
# 0.63 rad/s, under half of what the module can do.
SINE = MultiSine(sines=(Sine(amplitude_rad=0.2, frequency_hz=0.5),), duration_s=8.0)
# Table 6. The amplitude of 2 that the horizontal arm was excited with asks for 12.6 rad/s, nine times what
# the module can do, so that no loop follows it; 0.2 is the vertical arm's.
_PATTERN = DynamicPattern(amplitude_rad=0.2)
# Which settings the thesis shows on a sine; the others on the windowed sine motion.
ON_SINE = ("#2", "#3")


# Where an integral follows as well by itself. Measured 0.92 to 1.16 times the error without torque.
ABOUT_AS_WELL = 1.25
# The required gain of an arm of six joints under torque control.
MIN_GAIN = 3.0


class Pose(NamedTuple):
    """The joint positions of an arm at the start of the motion [rad]; zero for joints without entry."""

    name: str
    robot: str
    start_rad: Mapping[str, float]


POSES = (
    Pose("home", "arm6", {}),
    Pose("upright", "a2085_06", {}),
    Pose("hanging", "a2085_06", {"shoulder-lift": pi}),
)


class Case(NamedTuple):
    """One combination, tried in all input modes; `pose` is for arms of six joints."""

    robot: str
    pose: str
    motion: Motion
    gains: Gains
    delivery: Delivery

    @property
    def alignment(self) -> Alignment | None:
        """How the thesis' arm stands; None for another robot."""
        return next((one for one in ALIGNMENTS if self.robot == thesis_robot(one)), None)


class Combination(NamedTuple):
    """The results of a case: one for every input mode, in their order."""

    case: Case
    follows: tuple[Follow, Follow, Follow]

    @property
    def is_stable(self) -> bool:
        """Whether input mode 3 is stable, which a bar presupposes."""
        return not self.follows[2].unstable

    @property
    def helps(self) -> bool:
        """Whether input mode 3 follows better than both others, stable or not; or about as well.

        About as well is enough for the thesis' settings of strategy 3, whose position loops integrate.
        """
        first, second, third = (each.rms_error_rad for each in self.follows)
        integrates = self.case.gains.strategy == 3 and self.case.gains.setting is not None
        return third < (ABOUT_AS_WELL if integrates else 1.0) * min(first, second)

    @property
    def gain(self) -> float:
        """By how much mode 3 is better than mode 2."""
        return self.follows[1].rms_error_rad / self.follows[2].rms_error_rad


def thesis_robot(alignment: Alignment) -> str:
    """Return the name of the thesis' arm of an alignment."""
    return f"thesis_{LENGTH_MM}_{alignment}"


def cases(quick: bool = False) -> list[Case]:
    """Return all combinations; when quick only the thesis' figures and one arm of six joints."""
    combinations = []
    for alignment in ALIGNMENTS:
        readings: tuple[Reading, ...] = READINGS[:1] if quick else READINGS
        combinations += [case for reading in readings for case in _thesis_cases(alignment, reading, quick)]
        combinations += _factory_cases(alignment, quick)
    return combinations + _arm_cases(quick)


def robots_of(chosen: list[Case]) -> list[str]:
    """Return the robots of some cases, each once."""
    return list(dict.fromkeys(case.robot for case in chosen))


def try_case(case: Case, model: Model, noise: NoiseProfile, seed: int) -> Combination:
    """Try all input modes on a combination."""
    stage = stage_of(case, seed)
    first, second, third = (
        follow(stage, case.gains, mode=mode, delivery=case.delivery, model=model, noise=noise, seed=seed)
        for mode in MODES
    )
    return Combination(case, (first, second, third))


def stage_of(case: Case, seed: int) -> Stage:
    """Return robot and motion of a case, at the place that the seed draws.

    Raises:
        UsageError: an arm of six joints has no such pose.
    """
    robot = standing_robot(case.robot, seed)
    alignment = case.alignment
    if alignment is not None:
        joint = robot.serials[0]
        return Stage(robot, dict.fromkeys(robot.serials, 0.0), {joint: _pattern(case.motion, alignment)})
    poses = {(pose.robot, pose.name): pose for pose in POSES}
    if (case.robot, case.pose) not in poses:
        raise UsageError(f"no pose {case.pose!r} of {case.robot}")
    start = poses[case.robot, case.pose].start_rad
    # Every joint has a frequency of its own, so that all meet each other in all ways; 0.25 rad at 0.4 to
    # 0.9 Hz is at most 0.63 to 1.4 rad/s, which every type can do.
    patterns: dict[str, Pattern] = {
        serial: MultiSine(sines=(Sine(amplitude_rad=0.25, frequency_hz=0.4 + 0.1 * k),), duration_s=8.0)
        for k, serial in enumerate(robot.serials)
    }
    return Stage(robot, {serial: start.get(serial, 0.0) for serial in robot.serials}, patterns)


def _pattern(motion: Motion, alignment: Alignment) -> Pattern:
    if motion == "windowed sine":
        return WindowedSine(amplitude=thesis_length(alignment, LENGTH_MM).amplitude_rad)
    return SINE if motion == "sine" else _PATTERN


def _thesis_cases(alignment: Alignment, reading: Reading, quick: bool) -> list[Case]:
    combinations = []
    for each in SETTINGS:
        own: Motion = "sine" if each.name in ON_SINE else "windowed sine"
        motions: tuple[Motion, ...] = (own,) if quick else (own, "pattern")
        gains = Gains(each.strategy, each.name, reading)
        combinations += [Case(thesis_robot(alignment), "", motion, gains, ON_MODULE) for motion in motions]
    return combinations


def _factory_cases(alignment: Alignment, quick: bool) -> list[Case]:
    """Return the factory's gains on all motions, and streaming under them and under one of the thesis'."""
    motions: tuple[Motion, ...] = ("windowed sine",) if quick else ("windowed sine", "sine", "pattern")
    robot = thesis_robot(alignment)
    combinations = [Case(robot, "", motion, gains, ON_MODULE) for motion in motions for gains in FACTORY]
    streamed = (*FACTORY, Gains(4, "#4", READINGS[0]))
    return combinations + [
        Case(robot, "", "windowed sine", gains, host)
        for host in (HOSTS[:1] if quick else HOSTS)
        for gains in streamed
    ]


def _arm_cases(quick: bool) -> list[Case]:
    poses = POSES[:1] if quick else POSES
    deliveries = (ON_MODULE,) if quick else (ON_MODULE, *HOSTS)
    return [
        Case(pose.robot, pose.name, "all joints", gains, delivery)
        for pose in poses
        for gains in FACTORY
        for delivery in deliveries
    ]
