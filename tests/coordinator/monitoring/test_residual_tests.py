"""What a motor's current says of its friction, where the reading of a spring lags behind its torque."""

import numpy as np
import pytest

from coordinator.monitoring.likelihood_ratio import Change, find_changes, joined
from coordinator.monitoring.residual_tests import (
    DriveModel,
    catalogued_drive,
    drive_evidence,
    drive_rows,
    drive_window,
    fitted_drive,
)
from coordinator.monitoring.segments import DataSegment
from module_agent.model.chain import Array
from tests.coordinator.monitoring.moving_arm import JOINTS, KINDS, RATE_HZ, segments

JOINT, KIND = 0, KINDS[0]
# A load that turns about an upright axis, and the lag of the reading of the spring that turns it.
INERTIA_KG_M2, LAG_S = 0.6, 4e-3
NOISE_NM = 0.06
# The motions that the drive is known from, and the quick one that is judged.
USUAL_RAD_S, QUICK_RAD_S = (2.0, 5.0), 12.0
PEAK_RAD_S = 0.8
# About what `gain_above` asks of six joints.
ALARM = 30.0


def turned(rad_s: float, phase_rad: float, friction: float = 1.0) -> DataSegment:
    """Return half a second in which the joint swings; `friction` is its drive's over the catalogue's.

    The spring transmits tau = reading + LAG_S reading'.
    """
    angle = rad_s * np.arange(125) / RATE_HZ + phase_rad
    speed, change = PEAK_RAD_S * np.cos(angle), -PEAK_RAD_S * rad_s * np.sin(angle)
    # What tau = -I W w sin(a) is behind a low-pass of the first order with the lag as its time constant.
    late = angle - np.arctan(LAG_S * rad_s)
    peak_nm = INERTIA_KG_M2 * PEAK_RAD_S * rad_s / np.hypot(1.0, LAG_S * rad_s)
    reading, rate = -peak_nm * np.sin(late), -peak_nm * rad_s * np.cos(late)
    drive, sign = catalogued_drive(KIND), np.sign(speed)
    motor = INERTIA_KG_M2 * change + friction * (drive[2] * sign + drive[3] * speed) + drive[4] * change
    per_amp = KIND.gear_ratio * KIND.motor.back_emf_v_s_rad
    driving = np.where(motor * speed > 0.0, motor, 0.0) / (per_amp * KIND.motor.efficiency)
    driven = np.where(motor * speed > 0.0, 0.0, motor) / per_amp
    seen = (driving, driven, sign * np.abs(reading), sign, KIND.gear_ratio * speed, KIND.gear_ratio * change)
    any_one = segments(0, 1)[0]
    return any_one._replace(
        raw=any_one.raw._replace(motor_rad_s=_of_all(KIND.gear_ratio * speed)),
        tau_nm=_of_all(reading),
        tau_rate_nm_s=_of_all(rate),
        drive=np.stack([_of_all(one) for one in seen], axis=2),
    )


def _of_all(column: Array) -> Array:
    return np.tile(column[:, None], JOINTS)


def usual() -> list[DataSegment]:
    """Return the motions that the drive is known from."""
    rng = np.random.default_rng(3)
    return [turned(rng.uniform(*USUAL_RAD_S), rng.uniform(0.0, 6.28)) for _ in range(40)]


def without_rate(one: DataSegment) -> DataSegment:
    """Return a stretch as a model without a lag sees it."""
    return one._replace(tau_rate_nm_s=np.zeros_like(one.tau_rate_nm_s))


def known_from(parts: list[DataSegment]) -> DriveModel:
    """Return the drive that explains motions best."""
    columns = zip(*(drive_rows(KIND, one, JOINT) for one in parts), strict=True)
    return DriveModel(KIND, fitted_drive(KIND, *map(np.concatenate, columns)), NOISE_NM)


def change_of(before: list[DataSegment], later: DataSegment) -> tuple[Change, float]:
    """Return the change of friction that a stretch shows, and by how much of itself it is more."""
    model = known_from(before)
    evidence = [drive_evidence(model, one, JOINT) for one in [*before, later]]
    *known, last = [drive_window([one]) for one in evidence if one is not None]
    change = find_changes(joined(known), last, model.prior_sigma, (model.change,))[0]
    return change, float(change.size @ model.relative_friction)


def test_the_lag_of_a_spring_is_found_beside_its_drives_friction() -> None:
    found = known_from([*usual(), turned(QUICK_RAD_S, 0.3)]).theta

    # The prior pulls a little.
    assert found[5] == pytest.approx(LAG_S, rel=0.02)
    assert found[2:4] == pytest.approx(catalogued_drive(KIND)[2:4], rel=0.01)


def test_one_quick_swing_on_a_spring_that_lags_is_no_change_of_friction() -> None:
    quick = turned(QUICK_RAD_S, -1.2)
    # A model without the lag takes it for less friction: the motion would be an alarm.
    blind, less = change_of([without_rate(one) for one in usual()], without_rate(quick))
    assert blind.gain > ALARM
    assert less < -0.5

    assert change_of(usual(), quick)[0].gain < 0.01 * ALARM
    worn, more = change_of(usual(), turned(QUICK_RAD_S, -1.2, friction=4.0))
    assert worn.gain > ALARM
    assert more > 1.0
