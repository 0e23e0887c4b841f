"""Which change explains what a window of motion shows: a drive, a link, a payload, or nothing known.

A link that is displaced changes torques too; so where IMUs say that one is, that explains them. Torques alone
that have changed are a payload's if one body explains them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from coordinator.dynamics.pseudo_inertia import parameter_scale
from coordinator.monitoring.likelihood_ratio import Change, WhitenedRows, joined, without_own
from coordinator.monitoring.reference import Reference
from coordinator.monitoring.residual_tests import (
    UNIT_PAYLOAD_KG,
    displacement,
    drive_window,
    imu_rows,
    information_of,
    torque_rows,
    whitened_drive_rows,
)
from coordinator.monitoring.segments import DataSegment
from coordinator.monitoring.thresholds import Thresholds
from coordinator.parameter_fit.payload import Payload, find_payload
from coordinator.parameter_fit.physically_consistent import NotSolvedError
from module_agent.model.chain import Array
from module_agent.model.forward_kinematics import places_on_axes
from module_agent.model.information import JointInformation, merge
from module_agent.model.regressor import PER_BODY

# Smaller displacements are no finding: IMUs move with their boards, and links bend, by as much.
MIN_SHIFT_M, MIN_TURN_RAD = 3e-3, 3e-3
# Under a payload links give by more than they did; what that is taken for is below.
LOADED_SHIFT_M, LOADED_TURN_RAD = 6e-3, 6e-3
# Friction changes by more than that with the weather.
MIN_FRICTION = 0.1
# A payload leaves no more of the misfit than chance does in one window of so many.
ONE_IN = 1e4


class SegmentInformation(NamedTuple):
    """What one stretch says: evidence of torques, IMUs (own parameters first) and every drive."""

    start_ns: int
    end_ns: int
    information: tuple[JointInformation, ...]
    imu: WhitenedRows
    drives: tuple[WhitenedRows | None, ...]


class LinkShift(NamedTuple):
    """A link that is displaced: index of its module, length [m] with its sigma, turn [rad], gain."""

    child: int
    shift_m: float
    sigma_m: float
    turn_rad: float
    gain: float


class DriveShift(NamedTuple):
    """A drive whose friction changed: index, its friction at half speed relative to before, sigma, gain."""

    joint: int
    change: float
    sigma: float
    gain: float


class LoadShift(NamedTuple):
    """Torques that have changed: index of the body that explains most of it, gain, what it leaves, and by
    how much the body's parameters (10,) change then."""

    carrier: int
    gain: float
    left: float
    change: Array

    @property
    def taken_off(self) -> bool:
        """Whether the body has become lighter."""
        return bool(self.change[0] < 0.0)


class Diagnosis(NamedTuple):
    """What a window shows; None of what has not changed."""

    drives: tuple[DriveShift, ...]
    link: LinkShift | None
    load: LoadShift | None


def segment_information(reference: Reference, segment: DataSegment) -> SegmentInformation:
    """Return what a stretch says."""
    drives = tuple(
        whitened_drive_rows(model, segment, joint) for joint, model in enumerate(reference.drive_models)
    )
    return SegmentInformation(
        int(segment.t_ns[0]),
        int(segment.t_ns[-1]),
        information_of(reference.chain, segment),
        imu_rows(reference.imu_model, segment),
        drives,
    )


def diagnose(
    reference: Reference, thresholds: Thresholds, window: Sequence[SegmentInformation], loaded: bool = False
) -> Diagnosis:
    """Judge a window of one piece at least, of stretches in which no blow met the robot.

    laden: whether the robot is known to carry a payload.
    """
    return Diagnosis(
        _drives(reference, thresholds, window),
        _link(reference, thresholds, window, loaded),
        _load(reference, thresholds, window),
    )


def information_in(window: Sequence[SegmentInformation]) -> tuple[JointInformation, ...]:
    """Return what all pieces say of the inertial parameters."""
    whole = window[0].information
    for segment in window[1:]:
        whole = merge(whole, segment.information)
    return whole


def weigh_payload(
    reference: Reference, window: Sequence[SegmentInformation], load: LoadShift
) -> Payload | None:
    """Return a payload that can exist on the body that carries it, or has lost it; None if there is none."""
    later, before = information_in(window), reference.information
    if load.taken_off:
        later, before = before, later
    try:
        return find_payload(
            before,
            later,
            places_on_axes(reference.chain),
            reference.torque_sigma_nm * np.sqrt(reference.torque.inflation),
            carriers=[load.carrier],
        )
    except NotSolvedError:
        return None


def _drives(
    reference: Reference, thresholds: Thresholds, window: Sequence[SegmentInformation]
) -> tuple[DriveShift, ...]:
    found = []
    for joint, (model, known) in enumerate(zip(reference.drive_models, reference.drives, strict=True)):
        parts = [segment.drives[joint] for segment in window]
        told = [part for part in parts if part is not None]
        if known is None or not told:
            continue
        change = known.test(drive_window(told)).changes[0]
        slope = np.array([1.0, model.typical_rad_s]) / model.friction_nm(model.typical_rad_s)
        scaled = model.change_of(np.ones(2)) * slope
        sigma, more = float(np.sqrt(scaled @ change.covariance @ scaled)), float(scaled @ change.size)
        if change.gain > thresholds.drive and abs(more) > MIN_FRICTION + 3.0 * sigma:
            found.append(DriveShift(joint, more, sigma, change.gain))
    return tuple(found)


def _link(
    reference: Reference, thresholds: Thresholds, window: Sequence[SegmentInformation], loaded: bool
) -> LinkShift | None:
    children = reference.chain.linked
    if not children:
        return None
    later = without_own(joined([segment.imu for segment in window]), reference.imu_model.own_sigma)
    found = reference.imu.test(later)
    best = found.changes[found.best]
    if best.gain < thresholds.link:
        return None
    child = children[found.best]
    shift_m, sigma_m, turn_rad = _length(reference, child, best)
    least = (LOADED_SHIFT_M, LOADED_TURN_RAD) if loaded else (MIN_SHIFT_M, MIN_TURN_RAD)
    if shift_m < least[0] + 2.0 * sigma_m and turn_rad < least[1]:
        return None
    return LinkShift(child, shift_m, sigma_m, turn_rad, best.gain)


def _length(reference: Reference, child: int, change: Change) -> tuple[float, float, float]:
    turn, shift = displacement(reference.chain, child, change.size)
    length = float(np.linalg.norm(shift))
    along = shift / max(length, 1e-9)
    unit = np.eye(change.size.size)
    slope = np.array([along @ displacement(reference.chain, child, column)[1] for column in unit])
    return length, float(np.sqrt(slope @ change.covariance @ slope)), float(np.linalg.norm(turn))


def _load(
    reference: Reference, thresholds: Thresholds, window: Sequence[SegmentInformation]
) -> LoadShift | None:
    later = torque_rows(information_in(window), reference.phi, reference.torque_sigma_nm)
    found = reference.torque.test(later)
    best: Change = found.changes[found.best]
    if best.gain < thresholds.payload:
        return None
    change = UNIT_PAYLOAD_KG * parameter_scale(1) * best.size
    return LoadShift(found.best, best.gain, found.misfit - best.gain, change)


def explains(reference: Reference, load: LoadShift) -> bool:
    """Return whether a payload on one body is all that has changed of the torques."""
    freedom = PER_BODY * max(len(reference.chain.serials) - 1, 1)
    return load.left < float(chi2.isf(1.0 / ONE_IN, freedom)) + 0.1 * load.gain
