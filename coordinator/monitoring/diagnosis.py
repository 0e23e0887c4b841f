"""Which change explains what a window shows: a drive, a link, a payload, a sensor, or nothing known.

A link that is displaced changes torques too; so where IMUs say that one is, that explains them. Torques alone
that have changed are a payload's if one body explains them. Both have a sensor's errors as rivals.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from coordinator.dynamics.pseudo_inertia import parameter_scale
from coordinator.monitoring.contact import Contact
from coordinator.monitoring.findings import Detection
from coordinator.monitoring.likelihood_ratio import Evidence, joined, most_of
from coordinator.monitoring.reference import Reference, Thresholds
from coordinator.monitoring.residual_tests import (
    LARGE,
    UNIT_PAYLOAD_KG,
    ImuModel,
    displacement,
    drive_evidence,
    imu_evidence,
    information_of,
    torque_evidence,
    torque_window,
)
from coordinator.monitoring.segments import DataSegment
from coordinator.monitoring.sensor_errors import LEAD, drive_offset, imu_error, torque_sensor_error
from coordinator.parameter_fit.payload import find_payload
from coordinator.parameter_fit.physically_consistent import NotSolvedError
from module_agent.model.chain import Array, Chain
from module_agent.model.forward_kinematics import places_on_axes
from module_agent.model.information import JointInformation, merge
from module_agent.model.regressor import PER_BODY

# Smaller displacements are no finding: IMUs move with their boards, and links bend, by as much.
MIN_SHIFT_M, MIN_TURN_RAD = 3e-3, 3e-3
# The same under a payload, under which links give by more.
LOADED_SHIFT_M, LOADED_TURN_RAD = 6e-3, 6e-3
# A robot is moved when one of its joints is faster than that.
MOVING_RAD_S = 0.02
# Friction changes by more than that with the weather.
MIN_FRICTION = 0.1
# Nor is an IMU's error that is not known to so many: how far biases drift is part of them.
MIN_IMU_SIGMAS = 3.0
# A change that is all there is leaves no more of the misfit than chance does in one window of so many.
ONE_IN = 1e4
# A mass that is not known to this many standard deviations is not said to be there.
MIN_SIGMAS = 5.0


@dataclass(frozen=True, eq=False)
class SegmentInformation:
    """What one stretch says: evidence of torques, of every drive, and of IMUs when it is asked for.

    moved: whether a joint moved in it.
    """

    start_ns: int
    end_ns: int
    moved: bool
    torque: Evidence
    drives: tuple[Evidence | None, ...]
    chain: Chain
    imu_model: ImuModel
    segment: DataSegment

    @cached_property
    def imu(self) -> Evidence:
        """The evidence of the IMUs, own parameters first; a robot at rest is not asked for it."""
        return imu_evidence(self.imu_model, self.segment)

    @cached_property
    def information(self) -> tuple[JointInformation, ...]:
        """What a payload is weighed by."""
        return information_of(self.chain, self.segment)


class LoadShift(NamedTuple):
    """Torques that have changed: index of the body that explains most of it, gain, what it leaves, and by
    how much the body's parameters (10,) change then.

    sensor: the torque sensor that explains more, if one does.
    """

    carrier: int
    gain: float
    left: float
    change: Array
    sensor: Detection | None


class Diagnosis(NamedTuple):
    """What a window shows; None of what has not changed. structure: a displaced link, or an IMU that reads
    other than it did."""

    drives: tuple[Detection, ...]
    structure: Detection | None
    load: LoadShift | None


def segment_information(reference: Reference, segment: DataSegment) -> SegmentInformation:
    """Return what a stretch says."""
    drives = tuple(
        None if test is None else drive_evidence(model, segment, joint)
        for joint, (model, test) in enumerate(zip(reference.drive_models, reference.drives, strict=True))
    )
    return SegmentInformation(
        int(segment.t_ns[0]),
        int(segment.t_ns[-1]),
        bool((np.abs(segment.qd_rad_s) > MOVING_RAD_S).any()),
        torque_evidence(reference.chain, reference.phi, reference.torque_sigma_nm, segment),
        drives,
        reference.chain,
        reference.imu_model,
        segment,
    )


def diagnose(
    reference: Reference, thresholds: Thresholds, window: Sequence[SegmentInformation], loaded: bool = False
) -> Diagnosis:
    """Judge a window of one segment at least, all without collisions.

    loaded: whether the robot is known to carry a payload.
    """
    return Diagnosis(
        _drives(reference, thresholds, window),
        _structure(reference, thresholds, window, loaded),
        _load(reference, thresholds, window),
    )


def _merged(window: Sequence[SegmentInformation]) -> tuple[JointInformation, ...]:
    return merge(*(segment.information for segment in window))


def _drives(
    reference: Reference, thresholds: Thresholds, window: Sequence[SegmentInformation]
) -> tuple[Detection, ...]:
    found = []
    for joint, (model, known) in enumerate(zip(reference.drive_models, reference.drives, strict=True)):
        parts = _drive_parts(window, joint)
        if known is None or not parts:
            continue
        later = joined(parts)
        change = known.find(later)[0]
        scaled = model.relative_friction
        sigma, more = float(np.sqrt(scaled @ change.covariance @ scaled)), float(scaled @ change.size)
        if change.gain > thresholds.drive and abs(more) > MIN_FRICTION + 3.0 * sigma:
            serial = reference.chain.serials[joint]
            offset = drive_offset(known, model, joint, later)
            if offset.gain > change.gain + LEAD and _is_all(
                offset.gain, known.misfit(later), len(model.theta)
            ):
                found.append(offset.detection(serial, thresholds.drive))
                continue
            summary = (
                f"the drive of {serial} has {abs(100.0 * more):.0f} +- {100.0 * sigma:.0f} % "
                f"{'more' if more > 0.0 else 'less'} friction at half its speed"
            )
            found.append(
                Detection(
                    "friction", serial, 100.0 * more, 100.0 * sigma, change.gain, thresholds.drive, summary
                )
            )
    return tuple(found)


def _structure(
    reference: Reference, thresholds: Thresholds, window: Sequence[SegmentInformation], loaded: bool
) -> Detection | None:
    chain, links = reference.chain, len(reference.chain.linked)
    # At rest an IMU shows which way is down, by its own errors and in whatever pose, and no length.
    if 2 * sum(segment.moved for segment in window) < len(window):
        return None
    later = joined([segment.imu for segment in window])
    found = reference.imu.find(later)
    gain = max((change.gain for change in found[:links]), default=0.0)
    sensor = imu_error(found[links:], later)
    if sensor.gain > max(gain + LEAD, thresholds.link):
        # An error that explains most and is hardly known itself rules out the link, and is not named.
        known = sensor.error > MIN_IMU_SIGMAS * sensor.sigma
        return sensor.detection(chain.serials[sensor.place], thresholds.link) if known else None
    if gain < thresholds.link:
        return None
    most = most_of(found[:links])
    best, child = found[most], chain.linked[most]
    turn, shift = displacement(best.size)
    length, angle = float(np.linalg.norm(shift)), float(np.linalg.norm(turn))
    along = LARGE * shift / max(length, 1e-9)
    sigma = float(np.sqrt(along @ best.covariance[3:, 3:] @ along))
    min_shift, min_turn = (LOADED_SHIFT_M, LOADED_TURN_RAD) if loaded else (MIN_SHIFT_M, MIN_TURN_RAD)
    if length < min_shift + 2.0 * sigma and angle < min_turn:
        return None
    serial, parent = chain.serials[child], chain.serials[chain.parent[child]]
    summary = (
        f"the link from {parent} to {serial} is displaced by {1e3 * length:.1f} +- {1e3 * sigma:.1f} mm "
        f"and turned by {1e3 * angle:.1f} mrad; `x5-coordinator check` measures it"
    )
    return Detection("wear", serial, 1e3 * length, 1e3 * sigma, best.gain, thresholds.link, summary)


def _load(
    reference: Reference, thresholds: Thresholds, window: Sequence[SegmentInformation]
) -> LoadShift | None:
    parts = [segment.torque for segment in window]
    later = torque_window(parts)
    found = reference.torque.find(later)
    carrier = most_of(found)
    best = found[carrier]
    if best.gain < thresholds.payload:
        return None
    change = UNIT_PAYLOAD_KG * parameter_scale(1) * best.size
    misfit = reference.torque.misfit(later)
    sensor = _torque_sensor(reference, thresholds, window, best.gain, misfit)
    return LoadShift(carrier, best.gain, misfit - best.gain, change, sensor)


def _torque_sensor(
    reference: Reference,
    thresholds: Thresholds,
    window: Sequence[SegmentInformation],
    gain: float,
    misfit: float,
) -> Detection | None:
    """Return the torque sensor that explains all of a misfit and more than a payload of some gain does, or
    whose drive shows it."""
    rival = torque_sensor_error(reference.torque, [segment.torque for segment in window])
    joint = rival.place
    found = rival.detection(reference.chain.serials[joint], thresholds.payload)
    if rival.gain > gain + LEAD and _is_all(rival.gain, misfit, _load_freedom(reference)):
        return found
    known, parts = reference.drives[joint], _drive_parts(window, joint)
    if known is None or not parts:
        return None
    model, later = reference.drive_models[joint], joined(parts)
    offset = drive_offset(known, model, joint, later)
    shown = offset.gain > thresholds.drive and _is_all(offset.gain, known.misfit(later), len(model.theta))
    return found if shown else None


def _drive_parts(window: Sequence[SegmentInformation], joint: int) -> list[Evidence]:
    return [rows for segment in window if (rows := segment.drives[joint]) is not None]


def explains(reference: Reference, load: LoadShift) -> bool:
    """Return whether a payload on one body is all that has changed of the torques."""
    return _is_all(load.gain, load.gain + load.left, _load_freedom(reference))


def _load_freedom(reference: Reference) -> int:
    return PER_BODY * max(len(reference.chain.serials) - 1, 1)


def _is_all(gain: float, misfit: float, freedom: int) -> bool:
    """Return whether what a change explains of a misfit leaves no more than chance and a tenth of itself.

    A window that begins before a change mixes two robots, and a wrong change may fit the mixture better.
    """
    return misfit - gain < float(chdtri(freedom, 1.0 / ONE_IN)) + 0.1 * gain


def weighed(
    reference: Reference, thresholds: Thresholds, window: Sequence[SegmentInformation], load: LoadShift
) -> Detection | None:
    """Weigh what was added to a body or removed from it; None if no payload that can exist explains it."""
    before, later, sign, verb = reference.information, _merged(window), 1.0, "added to"
    if load.change[0] < 0.0:
        before, later, sign, verb = later, before, -1.0, "removed from"
    sigma_nm = reference.torque_sigma_nm * np.sqrt(reference.torque.inflation)
    try:
        payload = find_payload(
            *(before, later, places_on_axes(reference.chain), sigma_nm),
            carriers=[load.carrier],
            scale_sigma=reference.torque_scale_sigma,
        )
    except NotSolvedError:
        return None
    mass, sigma, serial = payload.mass_kg, payload.mass_sigma_kg, reference.chain.serials[load.carrier]
    if not payload.explains or mass < MIN_SIGMAS * sigma:
        return None
    summary = f"{mass:.3f} +- {sigma:.3f} kg {verb} the body that {serial} turns"
    return Detection("payload", serial, sign * mass, sigma, load.gain, thresholds.payload, summary)


def unexplained(reference: Reference, thresholds: Thresholds, load: LoadShift) -> Detection:
    """Return torques that no payload on one body explains."""
    summary = (
        "the torques have changed in a way that no payload on one body explains: something holds the robot, "
        "several things were added, a link is displaced, or a joint's torque sensor is off"
    )
    serial = reference.chain.serials[load.carrier]
    return Detection("unexplained", serial, 0.0, 0.0, load.gain, thresholds.payload, summary)


def collision(reference: Reference, thresholds: Thresholds, contact: Contact) -> Detection:
    """Return a collision, with the joints that measured it."""
    strongest, strength = int(np.argmax(np.abs(contact.peak_nm))), contact.strength(thresholds.contact_nm)
    measured = [reference.chain.serials[k] for k in contact.joints or (strongest,)]
    peak_nm, sigma_nm = float(np.abs(contact.peak_nm).max()), float(reference.contact.sigma_nm[strongest])
    lasted = (
        "ongoing" if contact.end_ns is None else f"for {1e-6 * (contact.end_ns - contact.start_ns):.0f} ms"
    )
    summary = (
        f"external force on the body that {measured[-1]} turns, or beyond it, {lasted}: "
        f"measured by {', '.join(measured)}, up to {peak_nm:.2f} Nm, {strength:.1f} times the threshold"
    )
    return Detection("collision", measured[-1], peak_nm, sigma_nm, strength, 1.0, summary)
