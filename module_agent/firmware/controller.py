"""Control strategies 0-4: how position, velocity and effort loops make one PWM (in [-1, 1], at 48 V).

    0 Off        pwm = 0
    1 DirectPWM  pwm = effort command
    2            pwm = T(effort command + P + V)
    3            pwm = clip(P + V + T(effort command))
    4            pwm = clip(V + T(effort command + P))

P outputs Nm under 2 and 4 and PWM under 3; V outputs Nm only under 2. An unset command disables its loop.
Feed-forward turns a target into the PWM that holds it in steady state: v N 30 / (pi Kv 48) for a velocity,
verified on a real log, and tau R / (48 Kt N efficiency) for an effort.
"""

import math
from typing import NamedTuple

from module_agent.catalogue import ModuleType
from module_agent.firmware.pid import Pid
from module_agent.wire.messages import GainSet

NOMINAL_VOLTAGE_V = 48.0


class Command(NamedTuple):
    """What the loops shall follow at one tick; None disables a loop."""

    position_rad: float | None
    velocity_rad_s: float | None
    effort_nm: float | None


UNSET = Command(None, None, None)


class Controller:
    """The three loops of one module."""

    def __init__(self, kind: ModuleType, gains: GainSet, dt_s: float):
        motor = kind.motor
        pwm_per_rad_s = kind.gear_ratio * 30.0 / (math.pi * motor.velocity_constant_rpm_v * NOMINAL_VOLTAGE_V)
        torque_at_full_pwm = (
            NOMINAL_VOLTAGE_V
            / motor.resistance_ohm
            * motor.torque_constant_nm_a
            * kind.gear_ratio
            * motor.efficiency
        )
        self.gains = gains
        self._strategy = gains.strategy
        self._position = Pid(gains.position, dt_s)
        self._velocity = Pid(gains.velocity, dt_s, 1.0 if gains.strategy == 2 else pwm_per_rad_s)
        self._effort = Pid(gains.effort, dt_s, 1.0 / torque_at_full_pwm)

    def reset(self) -> None:
        """Forget all loops' past."""
        self._position.reset()
        self._velocity.reset()
        self._effort.reset()

    def update(self, command: Command, position_rad: float, velocity_rad_s: float, effort_nm: float) -> float:
        """Return the PWM of this tick."""
        strategy = self._strategy
        if strategy == 0:
            return 0.0
        if strategy == 1:
            return _clip(command.effort_nm) if command.effort_nm is not None else 0.0
        p = self._loop(self._position, command.position_rad, position_rad)
        v = self._loop(self._velocity, command.velocity_rad_s, velocity_rad_s)
        if strategy == 3:
            return _clip(_sum(p, v, self._loop(self._effort, command.effort_nm, effort_nm)))
        if strategy == 4:
            target = None if p is None and command.effort_nm is None else _sum(p, command.effort_nm)
            return _clip(_sum(v, self._loop(self._effort, target, effort_nm)))
        unset = p is None and v is None and command.effort_nm is None
        target = None if unset else _sum(p, v, command.effort_nm)
        return _clip(_sum(self._loop(self._effort, target, effort_nm)))

    @staticmethod
    def _loop(loop: Pid, target: float | None, measured: float) -> float | None:
        if target is None:
            loop.reset()
            return None
        return loop.update(target, measured)


def _sum(*terms: float | None) -> float:
    return sum(term for term in terms if term is not None)


def _clip(pwm: float) -> float:
    return min(max(pwm, -1.0), 1.0)
