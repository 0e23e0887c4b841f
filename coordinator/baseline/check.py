"""Check of a robot against its baseline: which links changed between two runs, and `check.json`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import Field
from scipy.special import ndtri

from coordinator.baseline.baseline_robot import BaselineRobot, shortened_settings
from coordinator.baseline.change_detection import Findings, find_changes, tied_fits
from coordinator.baseline.difference import difference
from coordinator.excitation.plan import Plan
from coordinator.parameter_fit.report_parts import Part, Triple, triple
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.files import write_json
from module_agent.wire.messages import WindowedSine

SCHEMA = 2
BASE_NAME = "base"
# The accelerometer's bias may drift by 5 mg between two sessions, which is 0.3 deg.
TILT_ABOVE_DEG = 0.5
# Of the windowed sine; a check of six joints then takes 50 s.
MAX_CENTRE_S, MAX_SIGMA_S = 2.3, 0.85


class LinkCheck(Part):
    """Displacement and rotation of a child's IMU against its parent, in the IMU's frame at q = 0.

    For a changed link it is estimated with all others unchanged, for the others with all free.
    false_alarm_probability: of as large a change by chance, over all links. unseen: descriptions of
    the directions that no motion observes. would_find_mm: the smallest displacement that would have been
    detected for certain; None if there is none.
    """

    parent: str
    child: str
    changed: bool
    displacement_mm: Triple
    displacement_sigma_mm: Triple
    length_mm: float
    length_sigma_mm: float
    rotation_deg: Triple
    rotation_sigma_deg: Triple
    false_alarm_probability: float
    sigmas: float
    unseen: list[str]
    would_find_mm: float | None


class CheckReport(Part):
    """The whole check. `changed`: a link changed, or modules were exchanged or moved."""

    robot: str
    baseline: str
    changed: bool = False
    modules_missing: list[str] = Field(default_factory=list)
    modules_new: list[str] = Field(default_factory=list)
    remounted: list[str] = Field(default_factory=list)
    links: list[LinkCheck] = Field(default_factory=list)
    false_alarm_probability: float = 0.0
    base_tilt_deg: float | None = None
    robot_time_s: float
    summary: list[str] = Field(default_factory=list)
    schema_version: int = Field(default=SCHEMA, alias="schema")


class CheckError(DataError):
    """The two runs cannot be compared; the message says why."""


def check_plan(baseline: BaselineRobot, plan: Plan) -> Plan:
    """Return a short plan with the motions of the baseline.

    Model errors cancel when the same motions are compared. A joint takes 8 s; optimised motions take as long
    as in the baseline (`joint_s`, `settle_s` and `travel_speed_rad_s` of the plan must be the same); a
    baseline with one motion of all joints is checked by that motion.
    """
    motions = [event for event in baseline.recording.journal if event.what == "motion"]
    last = {event.purpose: event.motion.pattern for event in motions if event.motion}
    moved = {(event.serial, event.purpose) for event in motions}
    ways = ("windowed_sine", "whole")
    short = shortened_settings(plan, baseline) | {
        "sine_centre_s": min(plan.sine_centre_s, MAX_CENTRE_S),
        "sine_sigma_s": min(plan.sine_sigma_s, MAX_SIGMA_S),
    }
    sine = last.get("windowed_sine")
    # Optimised motions move every joint alone, and then all simultaneously.
    if all((serial, way) in moved for serial in baseline.chain.serials for way in ways):
        # The same motions result if travelling and settling take the same time.
        same = {"settle_s": plan.settle_s, "travel_speed_rad_s": plan.travel_speed_rad_s}
        short |= same | {"mode": "joint", "motions": "optimised"}
    elif isinstance(sine, WindowedSine):
        short |= {
            "mode": "joint",
            "sine_frequency_hz": sine.frequency_hz,
            "sine_centre_s": min(sine.centre_s, MAX_CENTRE_S),
            "sine_sigma_s": min(sine.sigma_s, MAX_SIGMA_S),
        }
    elif "whole" in last:
        short["mode"] = "simultaneous"
    return plan.model_copy(update=short)


def check(baseline: BaselineRobot, later: BaselineRobot) -> CheckReport:
    """Compare the links of a robot in a later run with its baseline.

    Raises:
        CheckError: a recording has a hole, or too few samples.
    """
    times = [event.t_ns for event in later.recording.journal]
    report = CheckReport(
        robot=later.name,
        baseline=str(baseline.folder),
        robot_time_s=(max(times) - min(times)) / 1e9 if times else 0.0,
    )
    before = baseline.kinematics.topology
    other = difference(before, later.kinematics.topology)
    if not other.nothing:
        moved = [s for s in before.serials if s in other.moved]
        changes = {"missing": other.removed, "new": other.new, "mounted differently": moved}
        return report.model_copy(
            update={
                "changed": True,
                "modules_missing": list(other.removed),
                "modules_new": list(other.new),
                "remounted": moved,
                "summary": [
                    *(f"module {s} is {how}" for how, serials in changes.items() for s in serials),
                    "links are compared only if all modules are as in the baseline: identify the robot again",
                ],
            }
        )
    try:
        fits = tied_fits(baseline, later)
    except DataError as error:
        raise CheckError(f"{later.folder} cannot be compared with {baseline.folder}: {error}") from error
    findings, chain = find_changes(fits), fits.before.chain
    links, up, then = _links(chain, findings), chain.gravity, fits.after.chain.gravity
    tilt_deg = float(np.degrees(np.arctan2(np.linalg.norm(np.cross(up, then)), up @ then)))
    return report.model_copy(
        update={
            "changed": bool(findings.changed),
            "links": links,
            "false_alarm_probability": findings.min_false_alarm,
            "base_tilt_deg": tilt_deg,
            "summary": _summary(links, tilt_deg),
        }
    )


def _links(chain: Chain, findings: Findings) -> list[LinkCheck]:
    alarms = {c.child: a for c, a in zip(findings.changed, findings.false_alarm, strict=True)}
    changed = {c.child: c for c in findings.changed}
    links = []
    for one in findings.each:
        child, change = one.child, changed.get(one.child, one)
        alarm = alarms.get(child, min(1.0, one.chance * len(findings.each)))
        sigma, limit_m = np.sqrt(np.diag(change.covariance)), float(findings.would_find_m[child])
        links.append(
            LinkCheck(
                parent=chain.serials[chain.parent[child]] if chain.parent[child] >= 0 else BASE_NAME,
                child=chain.serials[child],
                changed=child in changed,
                displacement_mm=triple(1e3 * change.displacement_m),
                displacement_sigma_mm=triple(1e3 * sigma[3:]),
                length_mm=1e3 * change.length_m,
                length_sigma_mm=1e3 * change.length_sigma_m,
                rotation_deg=triple(np.degrees(change.rotation_rad)),
                rotation_sigma_deg=triple(np.degrees(sigma[:3])),
                false_alarm_probability=alarm,
                sigmas=float(-ndtri(0.5 * max(alarm, 1e-300))),
                unseen=[_direction(row) for row in change.unseen],
                would_find_mm=1e3 * limit_m if np.isfinite(limit_m) else None,
            )
        )
    return links


def _direction(row: Array) -> str:
    """Describe a direction of [rotation, displacement] by its larger part; 1 rad counts as 1 m."""
    turn, shift = np.linalg.norm(row[:3]), np.linalg.norm(row[3:])
    kind, part = ("turn about", row[:3]) if turn > shift else ("displacement along", row[3:])
    unit = part / np.linalg.norm(part)
    unit = unit * (1.0 if unit[int(np.argmax(np.abs(unit)))] > 0.0 else -1.0)
    return f"{kind} ({', '.join(f'{v + 0.0:.2f}' for v in unit)})"


def _summary(links: Sequence[LinkCheck], tilt_deg: float) -> list[str]:
    changed = sorted((link for link in links if link.changed), key=lambda link: link.false_alarm_probability)
    lines = [_changed(link) for link in changed]
    if not changed and links:
        lines.append("no link has changed")
        limits = [link.would_find_mm for link in links if link.would_find_mm is not None]
        if limits:
            lines[-1] += f"; a displacement of {max(limits):.1f} mm of any link would have been detected"
    hidden = [f"{link.parent} - {link.child}: {', '.join(link.unseen)}" for link in links if link.unseen]
    if hidden:
        lines.append(f"not observable by any motion, in the IMU's frame: {'; '.join(hidden)}")
    if tilt_deg >= TILT_ABOVE_DEG:
        lines.append(
            f"the base, or the first module on it, is tilted by {tilt_deg:.1f} deg against the baseline"
        )
    return lines


def _changed(link: LinkCheck) -> str:
    x, y, z = link.displacement_mm
    turn, alarm = float(np.linalg.norm(link.rotation_deg)), link.false_alarm_probability
    odds = f"1 of {1.0 / alarm:.0e}" if alarm > 1e-15 else "less than 1 of 1e+15"
    return (
        f"the link {link.parent} - {link.child} has changed: its far end is displaced by "
        f"{link.length_mm:.2f} +- {link.length_sigma_mm:.2f} mm, ({x:+.2f}, {y:+.2f}, {z:+.2f}) mm in the "
        f"frame of {link.child}'s IMU, and turned by {turn:.2f} +- {max(link.rotation_sigma_deg):.2f} deg; "
        f"probability of a false alarm: {odds} "
        f"({link.sigmas:.1f} sigma)"
    )


def write_check(path: Path, report: CheckReport) -> None:
    """Write `check.json`; the file is the complete old or the complete new one."""
    write_json(path, report)
