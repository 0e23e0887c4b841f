"""Motor compensation: the torque that a motor needs beyond the torque of its spring.

The effort of a module is its spring's torque. To exert it while turning, the motor overcomes friction, gear
loss and its own rotor's inertia, which all act before the spring. The module's feed-forward models a constant
efficiency and the back-EMF; the loops compensate the rest, which shows as tracking error: in position control
(strategy 3) as PWM / P. Therefore the PWM that the motor needs is predicted from the catalogue,

    X = tau + Jr thdd + b thd + Tc s(thd)        th = q + tau / k, s: the sign, smoothed about rest
    K N i = X / eff where the motor drives, X where it is driven
    u = (R i + K N thd) / 48 V                   R at the winding's temperature

and the torque set-point is raised until the effort loop, whose response to a target is E + F (gain and
feed-forward), adds the missing PWM. A velocity loop that is closed on the motor takes the spring's own speed
tau' / k for an error, which is made up for too. The loops compensate what single modules deviate from the
catalogue.

Thermal model of R: winding, housing and body are three heat capacities in a row, the manufacturer's. Within
the seconds of a motion the winding follows its losses, the housing warms a little, and the body does not.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from coordinator.torque_control.feed_forward import RATE_HZ, SetPoints
from module_agent.control.controller import (
    NOMINAL_VOLTAGE_V,
    closes_on_motor,
    pwm_per_rad_s,
    torque_at_full_pwm_nm,
)
from module_agent.model.catalogue import AMBIENT_C, CAPACITIES_J_K, COPPER_PER_K, RESISTANCES_K_W, ModuleType
from module_agent.model.chain import Array
from module_agent.model.read_only import read_only
from module_agent.signals.filtering import differentiate
from module_agent.wire.messages import GainSet

Temperature = TypeVar("Temperature", float, Array)

_WINDING_J_K, _HOUSING_J_K, _ = CAPACITIES_J_K
_WINDING_K_W, _HOUSING_K_W, _ = RESISTANCES_K_W
# The sign of friction is smoothed within this speed, since it is undefined at rest.
_SLOW_RAD_S = 0.02
# The winding's temperature is computed at every tenth tick: it changes by far less within that time.
_WARMING_TICKS = 10
_STRATEGIES_WITH_EFFORT = (2, 3, 4)


def winding_c(cold_w: Array, step_s: float, start_c: float) -> Array:
    """Return the winding's temperature (m,) [deg C] from `start_c`, as measured, on.

    cold_w: (m,) losses i^2 R [W] of a winding at the ambient temperature, every `step_s`, which is much less
    than the winding's 1.7 s. The housing begins as warm as the first losses leave it.
    """
    found = np.empty(len(cold_w))
    winding = start_c
    warm_w = float(cold_w[0]) * resistance_factor(winding)
    body = housing = max(AMBIENT_C, winding - _WINDING_K_W * warm_w)
    for k, watt in enumerate(cold_w.tolist()):
        found[k] = winding
        into_housing_w = (winding - housing) / _WINDING_K_W
        winding += step_s * (watt * resistance_factor(winding) - into_housing_w) / _WINDING_J_K
        housing += step_s * (into_housing_w - (housing - body) / _HOUSING_K_W) / _HOUSING_J_K
    return found


def resistance_factor(temperature_c: Temperature) -> Temperature:
    """Return a winding's resistance over that at the ambient temperature."""
    return 1.0 + COPPER_PER_K * (temperature_c - AMBIENT_C)


def with_motor_compensation(
    points: SetPoints,
    kinds: Sequence[ModuleType],
    gains: Sequence[GainSet],
    winding_start_c: Sequence[float] | None = None,
) -> SetPoints:
    """Return set-points at 1 kHz whose efforts include the motors' losses, one type and gains per column.

    `winding_start_c`: the windings' temperatures at the start of the reference, by default the ambient's.
    A joint with an integrating loop is left unchanged: the loop compensates by itself, and would wind up.

    Raises:
        ValueError: another number of kinds or gains than columns.
    """
    effort = points.effort_nm.copy()
    start_c = [AMBIENT_C] * len(kinds) if winding_start_c is None else winding_start_c
    for column, (kind, own, begin_c) in enumerate(zip(kinds, gains, start_c, strict=True)):
        integrates = own.position.ki or own.velocity.ki or own.effort.ki
        if integrates or own.strategy not in _STRATEGIES_WITH_EFFORT:
            continue
        rate = points.reference.qd_rad_s[:, column]
        tau = points.effort_nm[:, column]
        known = own.effort.feed_forward / torque_at_full_pwm_nm(kind) * tau
        braking = _braking_by_spring(kind, own, tau)
        if own.strategy == 2:
            effort[:, column] += braking
        else:
            known = known + own.velocity.feed_forward * pwm_per_rad_s(kind) * rate - braking
        missing = motor_pwm(kind, tau, rate, begin_c) - known
        answer = own.effort.kp + own.effort.feed_forward / torque_at_full_pwm_nm(kind)
        effort[:, column] += missing / answer
    return SetPoints(points.reference, read_only(effort))


def _braking_by_spring(kind: ModuleType, gains: GainSet, tau_nm: Array) -> Array:
    """Return what the velocity loop subtracts (m,), in its unit, as the motor turns when the spring bends."""
    if not closes_on_motor(kind, gains.strategy):
        return np.zeros_like(tau_nm)
    bending = differentiate(tau_nm, RATE_HZ) / kind.spring_nm_rad
    loop = gains.velocity
    return np.asarray(loop.kp * bending + loop.kd * differentiate(bending, RATE_HZ))


def motor_pwm(kind: ModuleType, tau_nm: Array, qd_rad_s: Array, winding_start_c: float = AMBIENT_C) -> Array:
    """Return the PWM at 48 V (m,) under which a spring exerts `tau_nm` (m,) while it moves, at 1 kHz."""
    motor = kind.motor
    speed = qd_rad_s + differentiate(tau_nm, RATE_HZ) / kind.spring_nm_rad
    change = differentiate(speed, RATE_HZ)
    rotor = kind.gear_ratio**2 * motor.rotor_inertia_kg_m2
    sign = np.tanh(speed / _SLOW_RAD_S)
    net = tau_nm + rotor * change + motor.viscous_nm_s_rad * speed + motor.coulomb_nm * sign
    # Between driving and being driven the loss goes over as friction does.
    drives = 0.5 * (1.0 + np.sign(net) * sign)
    gross = net * (1.0 + drives * (1.0 / motor.efficiency - 1.0))
    per_amp = motor.back_emf_v_s_rad * kind.gear_ratio
    ampere = gross / per_amp
    ticks = np.arange(len(ampere))
    cold_w = motor.resistance_ohm * ampere[::_WARMING_TICKS] ** 2
    coarse_c = winding_c(cold_w, _WARMING_TICKS / RATE_HZ, winding_start_c)
    ohm = motor.resistance_ohm * resistance_factor(np.interp(ticks, ticks[::_WARMING_TICKS], coarse_c))
    return np.asarray((ohm * ampere + per_amp * speed) / NOMINAL_VOLTAGE_V)
