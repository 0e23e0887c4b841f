"""The work behind figures 52 to 61 of the thesis: an arm is identified in both ways, and follows motions."""

from collections.abc import Hashable
from typing import Literal, NamedTuple

import numpy as np

from module_agent.model.catalogue import module_type
from module_agent.model.chain import Array
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import GoTo, Pattern, Rest, WindowedSine
from sim.geometry.link_parts import FreePose
from sim.imperfections.noise_profile import NoiseProfile
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import Robot
from sim.robot.variants import loaded
from sim.test_bench.robot_bench import BenchRobot
from sim.thesis.dynamics.joint_identification import MARGIN_NS, identify_joint, joint_model
from sim.thesis.dynamics.load_identification import identify_load
from sim.thesis.dynamics.pattern_recording import dynamic_pattern, joint_samples
from sim.thesis.dynamics.torque_assistance import (
    TRAVEL_RAD_S,
    Delivery,
    Follow,
    Gains,
    InputMode,
    LoadModel,
    Stage,
    follow,
    standing_robot,
)
from sim.thesis.dynamics.torque_assistance_cases import ON_SINE, SINE, thesis_robot
from sim.thesis.published import (
    DYNAMIC_LENGTH_MM,
    DYNAMIC_MOTION,
    DYNAMIC_SEARCHES,
    Alignment,
    Reading,
    setting,
    thesis_length,
)

Values = tuple[float, ...]
# The input modes of 6.3.2, the third with A Phi alone, and ours: the same with the drive fed forward.
Way = Literal["1", "2", "3", "ours"]
WAYS: tuple[Way, ...] = ("1", "2", "3", "ours")

# The thesis' host commands the modules at 250 Hz.
HOST = Delivery("host, 250 Hz, lan", "lan", 250.0)
SLOW_HOST = Delivery("host, 250 Hz, wifi", "wifi", 250.0)
_MODES: dict[Way, InputMode] = {"1": 1, "2": 2, "3": 3, "ours": 3}
_REST_S, _SETTLE_S = 2.0, 1.0
# At the end of the arm, in the frame of its module's output.
_PAYLOAD = FreePose(mass_kg=0.5, inertia=(4e-4, 4e-4, 4e-4, 0.0, 0.0, 0.0))
# Trajectories are kept at 125 Hz.
_EVERY, SAMPLE_S = 2, 0.008


class Condition(NamedTuple):
    """What a setting is tried under; the defaults are what figures 52 to 61 are read as.

    effects: of the modules, on top of those of the run. payload: whether the arm carries 0.5 kg.
    """

    name: str
    reading: Reading = "per tick"
    effects: tuple[str, ...] = ()
    delivery: Delivery = HOST
    payload: bool = False
    table_3: bool = False


AS_READ = Condition("as read")
PER_SECOND = Condition("gains per second", reading="per second")
PLAY = Condition("with play in the gear", effects=("backlash",))
PLAY_AND_SPRING = Condition("with play, stiffening spring", effects=("backlash", "stiffening-spring"))
TABLE_3 = Condition("motion of table 3", table_3=True)
LATE = Condition("set-points late, wifi", delivery=SLOW_HOST)
LADEN = Condition("0.5 kg at the end", payload=True)
KEPT = (AS_READ, PLAY)


class Tracked(NamedTuple):
    """How one way followed: rms error [rad], None if it was broken off; why it is unstable, empty if stable.

    true_rad: (n,) every `SAMPLE_S`, where trajectories are kept.
    """

    error_rad: float | None
    unstable: str
    true_rad: Values


class Trial(NamedTuple):
    """A setting under a condition on one arm: all ways that were tried, in order.

    commanded_rad: (n,) as `Tracked.true_rad`. peak_rad: the largest deflection that is commanded.
    """

    setting: str
    condition: str
    commanded_rad: Values
    peak_rad: float
    ways: dict[Way, Tracked]


Trials = list[Trial]


class Attempt(NamedTuple):
    """A setting under a condition in some ways."""

    setting: str
    condition: Condition
    ways: tuple[Way, ...] = WAYS


def attempts(alignment: Alignment, tried: tuple[Attempt, ...], noise: NoiseChoice, seed: int) -> Trials:
    """Identify the arm of an alignment in both ways, and try settings on another day.

    Trajectories are kept under the conditions `KEPT`.

    Raises:
        what `identified_loads` raises.
    """
    robot = standing_robot(thesis_robot(alignment), seed)
    loads = identified_loads(robot, noise.of(robot), seed, DYNAMIC_SEARCHES[alignment].chosen_rad)
    known: dict[Hashable, Follow] = {}
    return [_trial(_Arm(robot, alignment, loads, noise, seed), attempt, known) for attempt in tried]


class Loads(NamedTuple):
    """The load of a joint, identified from the same recording by the thesis' method and by ours."""

    thesis: LoadModel
    ours: LoadModel


def identified_loads(robot: Robot, noise: NoiseProfile, seed: int, amplitude_rad: float) -> Loads:
    """Identify the load of the arm's joint by the dynamic pattern of table 6.

    Raises:
        ExperimentFailed: the module refused a motion or broke it off.
        DataError: too little motion.
    """
    with BenchRobot(robot, seed, noise, noise_seed=0) as bench:
        joint = bench.modules[0]

        def run(pattern: Pattern) -> tuple[Rows, Rows]:
            bench.run({joint.serial: GoTo(target_rad=0.0, max_speed_rad_s=TRAVEL_RAD_S)})
            bench.wait(_SETTLE_S)
            record = bench.run({joint.serial: pattern})[0]
            bench.wait(2e-9 * MARGIN_NS)
            assert record.end_row is not None
            own = joint.rows(record.start_row, record.end_row)
            ends = int(own["t_ns"][0]) - MARGIN_NS, int(own["t_ns"][-1]) + MARGIN_NS
            return own, joint.firmware.history.between(*ends)

        rest, _ = run(Rest(duration_s=_REST_S))
        rows, wide = run(dynamic_pattern(amplitude_rad))
    known = joint_model(module_type(robot.modules[0].type), joint.serial, rest)
    force = known.chain.gravity
    thesis = LoadModel(robot.serials, identify_load(joint_samples(rows), force).phi, force)
    ours = identify_joint(known, wide).phi
    return Loads(thesis, LoadModel(robot.serials, ours, force, "with the link", compensates=True))


def motion_of(alignment: Alignment, name: str, condition: Condition) -> Pattern:
    """Return the motion of a setting: the windowed sine of table 6, or the sine of figures 53 and 54."""
    if name in ON_SINE:
        return SINE
    if condition.table_3:
        return WindowedSine(amplitude=thesis_length(alignment, DYNAMIC_LENGTH_MM).amplitude_rad)
    return WindowedSine(amplitude=DYNAMIC_SEARCHES["vertical"].chosen_rad, **DYNAMIC_MOTION._asdict())


class _Arm(NamedTuple):
    robot: Robot
    alignment: Alignment
    loads: Loads
    noise: NoiseChoice
    seed: int


def _trial(arm: _Arm, attempt: Attempt, known: dict[Hashable, Follow]) -> Trial:
    """Try a setting in some ways; what is known of ways in which settings are alike is not tried again."""
    condition = attempt.condition
    own = setting(attempt.setting)
    follows = {}
    for way in attempt.ways:
        # Strategy 3 has no torque loop where no torque is supplied.
        loops = own.position, own.velocity, own.effort if own.strategy == 4 or _MODES[way] == 3 else None
        alike = way, condition, attempt.setting in ON_SINE, own.strategy, loops
        if alike not in known:
            known[alike] = _followed(arm, attempt, way)
        follows[way] = known[alike]
    longest = max(follows.values(), key=lambda each: len(each.commanded_rad))
    keep = condition in KEPT
    return Trial(
        setting=attempt.setting,
        condition=condition.name,
        commanded_rad=_kept(longest.commanded_rad) if keep else (),
        peak_rad=float(np.abs(longest.commanded_rad).max(initial=0.0)),
        ways={way: _tracked(each, keep) for way, each in follows.items()},
    )


def _followed(arm: _Arm, attempt: Attempt, way: Way) -> Follow:
    condition, robot = attempt.condition, arm.robot
    on = tuple(dict.fromkeys((*arm.noise.on, *condition.effects)))
    off = tuple(name for name in arm.noise.off if name not in condition.effects)
    profile = arm.noise._replace(on=on, off=off).of(robot)
    motion = motion_of(arm.alignment, attempt.setting, condition)
    carrier = loaded(robot, robot.serials[-1], _PAYLOAD) if condition.payload else robot
    stage = Stage(carrier, dict.fromkeys(robot.serials, 0.0), {robot.serials[0]: motion})
    gains = Gains(setting(attempt.setting).strategy, attempt.setting, condition.reading)
    load = arm.loads.ours if way == "ours" else arm.loads.thesis
    return follow(stage, gains, _MODES[way], condition.delivery, load, profile, arm.seed)


def _tracked(one: Follow, keep: bool) -> Tracked:
    error = one.rms_error_rad if np.isfinite(one.rms_error_rad) else None
    return Tracked(error, one.unstable, _kept(one.true_rad) if keep else ())


def _kept(signal: Array) -> Values:
    return tuple(round(float(value), 5) for value in signal[::_EVERY, 0])
