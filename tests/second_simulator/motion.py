"""What a coordinator's plan commands of a robot, joint after joint, and how the robot really moves.

Shapes of motions are written out here (eqs 13 and 14, table 6: docs/theory.md), not taken from the firmware's
code. A joint follows its command late and smoothed, and gives way under its load like a spring.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d

from coordinator.excitation.plan import Plan
from coordinator.recording.journal import Purpose
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.wire.messages import ConstantMotion, DynamicPattern, GoTo, Pattern, Rest, WindowedSine
from tests.second_simulator.robot import Array, Robot

RATE_HZ = 500.0
# A joint's response: as late as this, with the corners of its command rounded over 12 ms, and as stiff.
LATE_S, ROUNDED_S, STIFFNESS_NM_RAD = 0.02, 0.012, (40.0, 150.0)
# Discovery and link check at the beginning; the end of the recording.
BEFORE_S, AFTER_S = 1.5, 0.5


class Move(NamedTuple):
    """A motion of one joint: begins at `start_s` from a position, and lasts until `end_s`."""

    joint: int
    purpose: Purpose
    pattern: Pattern
    origin_rad: float
    start_s: float
    end_s: float


class Motion(NamedTuple):
    """The true motion of a robot of n joints from 0 to `end_s`: positions as splines of time.

    moves: in the order of their beginning, travel included as "other". commands: (m, n) at `RATE_HZ`.
    """

    moves: tuple[Move, ...]
    commands: Array
    position: BSpline
    end_s: float

    def at(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations (m, n)."""
        return self.position(t_s), self.position(t_s, 1), self.position(t_s, 2)


def planned_motion(robot: Robot, plan: Plan, seed: int) -> Motion:
    """Return the motion of a session: rest, then every joint slowly through home and fast about it."""
    moves = _moves(robot, plan)
    end_s = moves[-1].end_s + AFTER_S
    t_s = np.arange(0.0, end_s, 1.0 / RATE_HZ)
    commands = np.zeros((len(t_s), len(robot.serials)))
    for move in moves:
        inside, after = (t_s >= move.start_s) & (t_s < move.end_s), t_s >= move.end_s
        commands[inside, move.joint] = move.origin_rad + _shape(move, t_s[inside] - move.start_s)
        commands[after, move.joint] = move.origin_rad + _shape(move, np.array([move.end_s - move.start_s]))
    late = np.array([np.interp(t_s - LATE_S, t_s, column) for column in commands.T]).T
    followed = gaussian_filter1d(late, ROUNDED_S * RATE_HZ, axis=0, mode="nearest")
    stiffness = np.random.default_rng([seed, 2]).uniform(*STIFFNESS_NM_RAD, len(robot.serials))
    load = torques(robot, Motion(moves, commands, make_interp_spline(t_s, followed, 5), end_s), t_s)
    # Position loops take out what the load is at rest.
    given = gaussian_filter1d(load - load[0], ROUNDED_S * RATE_HZ, axis=0, mode="nearest") / stiffness
    return Motion(moves, commands, make_interp_spline(t_s, followed - given, 5), end_s)


def torques(robot: Robot, motion: Motion, t_s: Array) -> Array:
    """Return the torques (m, n) of all joints by pinocchio's recursive Newton-Euler algorithm."""
    data = robot.model.createData()
    states = zip(*motion.at(t_s), strict=True)
    return np.array([pin.rnea(robot.model, data, *state) for state in states])


def _moves(robot: Robot, plan: Plan) -> tuple[Move, ...]:
    moves: list[Move] = []
    now_s, at = BEFORE_S, [0.0] * len(robot.serials)

    def add(joint: int, purpose: Purpose, pattern: Pattern, to_rad: float) -> None:
        nonlocal now_s
        begins = Move(joint, purpose, pattern, at[joint], now_s, now_s + _lasting_s(pattern, at[joint]))
        moves.append(begins)
        now_s, at[joint] = begins.end_s + 0.05, to_rad

    def go(joint: int, to_rad: float) -> None:
        nonlocal now_s
        add(joint, "other", GoTo(target_rad=to_rad, max_speed_rad_s=plan.travel_speed_rad_s), to_rad)
        now_s += plan.settle_s

    for joint in range(len(robot.serials)):
        moves.append(Move(joint, "rest", Rest(duration_s=plan.rest_s), 0.0, now_s, now_s + plan.rest_s))
    now_s = moves[-1].end_s
    for joint, name in enumerate(robot.types):
        constant, sine = plan.constant(), plan.sine(module_type(name))
        half_rad = 0.5 * constant.velocity_rad_s * (constant.duration_s + constant.ramp_s)
        go(joint, -half_rad)
        add(joint, "constant", constant, half_rad)
        go(joint, 0.0)
        add(joint, "windowed_sine", sine, 0.0)
        now_s += plan.settle_s
    excitations: tuple[tuple[Purpose, Callable[[ModuleType], DynamicPattern]], ...]
    excitations = (("dynamic", plan.dynamic), ("held_out", plan.held_out)) if plan.dynamics else ()
    for purpose, pattern in excitations:
        for joint, name in enumerate(robot.types):
            add(joint, purpose, pattern(module_type(name)), 0.0)
            now_s += plan.settle_s
    return tuple(moves)


def _lasting_s(pattern: Pattern, origin_rad: float) -> float:
    match pattern:
        case GoTo():
            return max(1.875 * abs(pattern.target_rad - origin_rad) / pattern.max_speed_rad_s, 0.2)
        case ConstantMotion():
            return pattern.duration_s + 2.0 * pattern.ramp_s
        case WindowedSine():
            return 2.0 * pattern.centre_s
        case DynamicPattern():
            return 2.0 * pattern.half_width_s * pattern.repeats
    raise NotImplementedError(pattern.kind)


def _shape(move: Move, t_s: Array) -> Array:
    """Return the commanded travel (m,) at times since the beginning of a motion."""
    lasting_s, pattern = move.end_s - move.start_s, move.pattern
    match pattern:
        case GoTo():
            share = np.clip(t_s / lasting_s, 0.0, 1.0)
            return (pattern.target_rad - move.origin_rad) * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        case ConstantMotion():
            up, down = pattern.ramp_s, lasting_s - pattern.ramp_s
            rising = 0.5 * np.minimum(t_s, up) ** 2 / up
            level = np.clip(t_s, up, down) - up
            falling = np.clip(t_s - down, 0.0, up)
            return pattern.velocity_rad_s * (rising + level + falling - 0.5 * falling**2 / up)
        case WindowedSine():
            window = np.exp(-0.5 * ((t_s - pattern.centre_s) / pattern.sigma_s) ** 2)
            wave = pattern.amplitude * np.sin(2.0 * np.pi * pattern.frequency_hz * t_s)
            return _raised_cosine(t_s, lasting_s) * window * wave
        case DynamicPattern():
            width_s = 2.0 * pattern.half_width_s
            number = np.minimum(t_s // width_s, pattern.repeats - 1)
            within_s = t_s - number * width_s
            since_s = within_s - pattern.half_width_s
            sign = np.where((number % 2 == 1) & pattern.alternate, -1.0, 1.0)
            window = sign * np.exp(-0.5 * (since_s / pattern.sigma_s) ** 2)
            wave = pattern.amplitude_rad * np.sin(2.0 * np.pi * pattern.frequency_hz * since_s)
            return _raised_cosine(within_s, width_s) * window * wave
    return np.zeros_like(t_s)


def _raised_cosine(t_s: Array, lasting_s: float) -> Array:
    """Return a window that rises from 0 and falls to 0 over a sixth of its duration at either end."""
    edge = np.clip(np.minimum(t_s, lasting_s - t_s) / (lasting_s / 6.0), 0.0, 1.0)
    return 0.5 - 0.5 * np.cos(np.pi * edge)
