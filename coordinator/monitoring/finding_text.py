"""Findings from the results of the tests, each with a summary sentence."""

import numpy as np

from coordinator.monitoring.contact import Contact
from coordinator.monitoring.diagnosis import DriveShift, LinkShift, LoadShift
from coordinator.monitoring.findings import UNITS, Finding
from coordinator.monitoring.reference import Reference
from coordinator.monitoring.thresholds import Thresholds
from coordinator.parameter_fit.payload import Payload


def collision_finding(reference: Reference, thresholds: Thresholds, contact: Contact, now_ns: int) -> Finding:
    """Return the finding of a collision, with the joints that measured it."""
    serials, strength = reference.chain.serials, contact.strength(thresholds.contact_nm)
    last = contact.joints[-1] if contact.joints else int(np.argmax(np.abs(contact.peak_nm)))
    strongest = float(np.abs(contact.peak_nm).max())
    felt = ", ".join(serials[k] for k in contact.joints) or serials[last]
    lasted = (
        "ongoing" if contact.end_ns is None else f"for {1e-6 * (contact.end_ns - contact.start_ns):.0f} ms"
    )
    return Finding(
        kind="collision",
        serial=serials[last],
        since_ns=contact.start_ns,
        detected_ns=now_ns,
        reported_ns=now_ns,
        until_ns=contact.end_ns,
        size=strongest,
        sigma=float(reference.contact.sigma_nm[int(np.argmax(np.abs(contact.peak_nm)))]),
        unit=UNITS["collision"],
        gain=strength,
        level=1.0,
        summary=f"external force on the body that {serials[last]} turns, or beyond it, {lasted}: "
        f"measured by {felt}, up to {strongest:.2f} Nm, {strength:.1f} times the threshold",
    )


def load_finding(
    reference: Reference,
    thresholds: Thresholds,
    load: LoadShift,
    found: Payload,
    since_ns: int,
    now_ns: int,
) -> Finding:
    """Return the finding of a payload that was added or removed."""
    serial, taken_off = reference.chain.serials[load.carrier], load.taken_off
    change = "removed from" if taken_off else "added to"
    mass = -found.mass_kg if taken_off else found.mass_kg
    return Finding(
        kind="payload",
        serial=serial,
        since_ns=since_ns,
        detected_ns=now_ns,
        reported_ns=now_ns,
        until_ns=None,
        size=mass,
        sigma=found.mass_sigma_kg,
        unit=UNITS["payload"],
        gain=load.gain,
        level=thresholds.payload,
        summary=f"{found.mass_kg:.3f} +- {found.mass_sigma_kg:.3f} kg {change} the body that {serial} turns",
    )


def wear_finding(
    reference: Reference, thresholds: Thresholds, link: LinkShift, since_ns: int, now_ns: int
) -> Finding:
    """Return the finding of a displaced link."""
    chain = reference.chain
    serial, parent = chain.serials[link.child], chain.serials[chain.parent[link.child]]
    return Finding(
        kind="wear",
        serial=serial,
        since_ns=since_ns,
        detected_ns=now_ns,
        reported_ns=now_ns,
        until_ns=None,
        size=1e3 * link.shift_m,
        sigma=1e3 * link.sigma_m,
        unit=UNITS["wear"],
        gain=link.gain,
        level=thresholds.link,
        summary=f"the link from {parent} to {serial} is displaced by {1e3 * link.shift_m:.1f} +- "
        f"{1e3 * link.sigma_m:.1f} mm and turned by {1e3 * link.turn_rad:.1f} mrad; `x5-coordinator check` "
        "measures it",
    )


def friction_finding(
    reference: Reference, thresholds: Thresholds, drive: DriveShift, since_ns: int, now_ns: int
) -> Finding:
    """Return the finding of a drive with changed friction."""
    serial = reference.chain.serials[drive.joint]
    more = "more" if drive.change > 0.0 else "less"
    return Finding(
        kind="friction",
        serial=serial,
        since_ns=since_ns,
        detected_ns=now_ns,
        reported_ns=now_ns,
        until_ns=None,
        size=100.0 * drive.change,
        sigma=100.0 * drive.sigma,
        unit=UNITS["friction"],
        gain=drive.gain,
        level=thresholds.drive,
        summary=f"the drive of {serial} has {abs(100.0 * drive.change):.0f} +- {100.0 * drive.sigma:.0f} % "
        f"{more} friction at half its speed",
    )


def unexplained_finding(
    reference: Reference, thresholds: Thresholds, load: LoadShift, since_ns: int, now_ns: int
) -> Finding:
    """Return the finding of torques that no payload on one body explains."""
    serial = reference.chain.serials[load.carrier]
    return Finding(
        kind="unexplained",
        serial=serial,
        since_ns=since_ns,
        detected_ns=now_ns,
        reported_ns=now_ns,
        until_ns=None,
        size=0.0,
        sigma=0.0,
        unit=UNITS["unexplained"],
        gain=load.gain,
        level=thresholds.payload,
        summary="the torques have changed in a way that no payload on one body explains: something holds the "
        "robot, several things were added, or a joint's torque sensor is off",
    )
