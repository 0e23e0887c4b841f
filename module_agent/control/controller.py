"""Control strategies 0-4: how position, velocity and effort loops make one PWM (in [-1, 1], at 48 V).

    0 Off        pwm = 0
    1 DirectPWM  pwm = effort command
    2            pwm = T(effort command + P + V)
    3            pwm = clip(P + V + T(effort command))
    4            pwm = clip(V + T(effort command + P))

P outputs Nm under 2 and 4 and PWM under 3; V outputs Nm only under 2. A target of NaN disables its loop.
Feed-forward turns a target into the PWM that holds it in steady state: v N 30 / (pi Kv 48) for a velocity,
verified on a real log, and tau R / (48 Kt N efficiency) for an effort.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from module_agent.control.pid import Pid
from module_agent.model.catalogue import ModuleType
from module_agent.wire.messages import GainSet

NOMINAL_VOLTAGE_V = 48.0


class Command(NamedTuple):
    """The targets of one module's loops: NaN switches a loop off, three times NaN is motor off.

    brake: damp the motor instead of following targets. A module that cannot follows the velocity 0 that comes
    with it.
    """

    position_rad: float
    velocity_rad_s: float
    effort_nm: float
    brake: bool = False


MOTOR_OFF = Command(math.nan, math.nan, math.nan)
BRAKE = Command(math.nan, 0.0, math.nan, brake=True)

Law = Callable[[Command, float, float, float], float]


def pwm_per_rad_s(kind: ModuleType) -> float:
    """Return the PWM per output speed that balances the back-EMF, by the motor's Kv."""
    return kind.gear_ratio * 30.0 / (math.pi * kind.motor.velocity_constant_rpm_v * NOMINAL_VOLTAGE_V)


def torque_at_full_pwm_nm(kind: ModuleType) -> float:
    """Return the output torque at full PWM and rest, behind a gear of constant efficiency."""
    motor = kind.motor
    stalled_a = NOMINAL_VOLTAGE_V / motor.resistance_ohm
    return stalled_a * motor.torque_constant_nm_a * kind.gear_ratio * motor.efficiency


def closes_on_motor(kind: ModuleType, strategy: int) -> bool:
    """Return whether the velocity loop of a strategy is closed on the motor's side of the spring."""
    return kind.velocity_loop == "motor" and strategy in (2, 3)


class Controller:
    """The three loops of one module under its control strategy.

    `follows_motor` is whether velocity_rad_s is to be the motor's, seen at the output, and not the output's.
    `update(command, position_rad, velocity_rad_s, effort_nm)` returns the PWM of this tick.
    """

    def __init__(self, kind: ModuleType, gains: GainSet, dt_s: float):
        self.gains = gains
        self.follows_motor = closes_on_motor(kind, gains.strategy)
        self.loops = (
            Pid(gains.position, dt_s),
            Pid(gains.velocity, dt_s, 1.0 if gains.strategy == 2 else pwm_per_rad_s(kind)),
            Pid(gains.effort, dt_s, 1.0 / torque_at_full_pwm_nm(kind)),
        )
        self.update: Law = partial(_LAWS[gains.strategy], *self.loops)

    def reset(self) -> None:
        """Forget all loops' past."""
        for loop in self.loops:
            loop.reset()


# The laws: from the loops of position, velocity and effort, the command and the three measured values to the
# PWM. A loop that is off contributes 0; a NaN is the only number that is not equal to itself.


def _direct_pwm(p: Pid, v: Pid, e: Pid, command: Command, q_rad: float, qd_rad_s: float, tau: float) -> float:
    return 0.0 if command.effort_nm != command.effort_nm else _clip(command.effort_nm)


def _all_through_effort(
    p: Pid, v: Pid, e: Pid, command: Command, q_rad: float, qd_rad_s: float, tau: float
) -> float:
    p_target, v_target, target, _ = command
    off = p_target != p_target and v_target != v_target and target != target
    through = p.follow(p_target, q_rad) + v.follow(v_target, qd_rad_s)
    if target == target:
        through += target
    return _clip(e.follow(math.nan if off else through, tau))


def _side_by_side(
    p: Pid, v: Pid, e: Pid, command: Command, q_rad: float, qd_rad_s: float, tau: float
) -> float:
    p_target, v_target, target, _ = command
    return _clip(p.follow(p_target, q_rad) + v.follow(v_target, qd_rad_s) + e.follow(target, tau))


def _position_through_effort(
    p: Pid, v: Pid, e: Pid, command: Command, q_rad: float, qd_rad_s: float, tau: float
) -> float:
    p_target, v_target, target, _ = command
    off = p_target != p_target and target != target
    through = p.follow(p_target, q_rad)
    if target == target:
        through += target
    return _clip(v.follow(v_target, qd_rad_s) + e.follow(math.nan if off else through, tau))


_LAWS: dict[int, Callable[..., float]] = {
    0: lambda *_: 0.0,
    1: _direct_pwm,
    2: _all_through_effort,
    3: _side_by_side,
    4: _position_through_effort,
}


def _clip(pwm: float) -> float:
    if pwm < -1.0:
        return -1.0
    return 1.0 if pwm > 1.0 else pwm
