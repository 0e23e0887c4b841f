"""`check.json`: the change of every link of a robot against its baseline."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.stats import norm

from coordinator.baseline.change_detection import Findings, LinkChange
from module_agent.model.chain import Chain
from module_agent.model.files import write_json

SCHEMA = 2
BASE_NAME = "base"
# The accelerometer's bias may drift by 5 mg between two sessions, which is 0.3 deg.
TILT_ABOVE_DEG = 0.5


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LinkCheck(_Part):
    """Displacement and rotation of a child's IMU against its parent, in the IMU's frame at q = 0.

    For a changed link it is estimated with all others unchanged, for the others with all free.
    false_alarm_probability: of as large a change by chance, over all links. unseen: descriptions of
    the directions that no motion observes. would_find_mm: the smallest displacement that would have been
    detected for certain; None if there is none.
    """

    parent: str
    child: str
    changed: bool
    displacement_mm: tuple[float, float, float]
    displacement_sigma_mm: tuple[float, float, float]
    length_mm: float
    length_sigma_mm: float
    rotation_deg: tuple[float, float, float]
    rotation_sigma_deg: tuple[float, float, float]
    false_alarm_probability: float
    sigmas: float
    unseen: list[str]
    would_find_mm: float | None


class CheckReport(_Part):
    """The whole check. `changed`: a link changed, or modules were exchanged or moved."""

    robot: str
    baseline: str
    changed: bool
    modules_missing: list[str]
    modules_new: list[str]
    remounted: list[str]
    links: list[LinkCheck]
    false_alarm_probability: float
    base_tilt_deg: float | None
    robot_time_s: float
    summary: list[str]
    schema_version: int = Field(default=SCHEMA, alias="schema")


class Session(_Part):
    """The two sessions that are compared."""

    robot: str
    baseline: str
    robot_time_s: float


def compared(session: Session, before: Chain, after: Chain, found: Findings) -> CheckReport:
    """Report on a robot of the same modules, mounted as they were."""
    tilt = _tilt_deg(before, after)
    links = _links(before, found)
    return CheckReport(
        **session.model_dump(),
        changed=bool(found.changed),
        modules_missing=[],
        modules_new=[],
        remounted=[],
        links=links,
        false_alarm_probability=found.min_false_alarm,
        base_tilt_deg=tilt,
        summary=[*_summary(links), *_tilt_summary(tilt)],
    )


def other_robot(
    session: Session, missing: Sequence[str], new: Sequence[str], remounted: Sequence[str]
) -> CheckReport:
    """Report on a robot with other modules than the baseline, or mounted differently."""
    summary = [f"module {s} is missing" for s in missing]
    summary += [f"module {s} is new" for s in new]
    summary += [f"module {s} is mounted differently" for s in remounted]
    summary.append("links are compared only if all modules are as in the baseline: identify the robot again")
    return CheckReport(
        **session.model_dump(),
        changed=True,
        modules_missing=list(missing),
        modules_new=list(new),
        remounted=list(remounted),
        links=[],
        false_alarm_probability=0.0,
        base_tilt_deg=None,
        summary=summary,
    )


def _links(chain: Chain, found: Findings) -> list[LinkCheck]:
    alarms = {c.child: a for c, a in zip(found.changed, found.false_alarm, strict=True)}
    changed = {c.child: c for c in found.changed}
    parts = []
    for one in found.each:
        alarm = alarms.get(one.child, min(1.0, one.chance * len(found.each)))
        limit = float(found.would_find_m[one.child])
        parts.append(_link(chain, changed.get(one.child, one), one.child in changed, alarm, limit))
    return parts


def _link(chain: Chain, change: LinkChange, changed: bool, alarm: float, limit_m: float) -> LinkCheck:
    parent = chain.parent[change.child]
    sigma = np.sqrt(np.diag(change.covariance))
    return LinkCheck(
        parent=chain.serials[parent] if parent >= 0 else BASE_NAME,
        child=chain.serials[change.child],
        changed=changed,
        displacement_mm=_triple(1e3 * change.displacement_m),
        displacement_sigma_mm=_triple(1e3 * sigma[3:]),
        length_mm=1e3 * change.length_m,
        length_sigma_mm=1e3 * change.length_sigma_m,
        rotation_deg=_triple(np.degrees(change.rotation_rad)),
        rotation_sigma_deg=_triple(np.degrees(sigma[:3])),
        false_alarm_probability=alarm,
        sigmas=float(norm.isf(0.5 * max(alarm, 1e-300))),
        unseen=[_direction(row) for row in change.unseen],
        would_find_mm=1e3 * limit_m if np.isfinite(limit_m) else None,
    )


def _triple(values: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]") -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _direction(row: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]") -> str:
    """Describe a direction of [rotation, displacement] by its larger part; 1 rad counts as 1 m."""
    turn, shift = np.linalg.norm(row[:3]), np.linalg.norm(row[3:])
    kind, part = ("turn about", row[:3]) if turn > shift else ("displacement along", row[3:])
    unit = part / np.linalg.norm(part)
    unit = unit * (1.0 if unit[int(np.argmax(np.abs(unit)))] > 0.0 else -1.0)
    return f"{kind} ({', '.join(f'{v + 0.0:.2f}' for v in unit)})"


def _tilt_deg(before: Chain, after: Chain) -> float:
    up, then = before.gravity, after.gravity
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(up, then)), up @ then)))


def _tilt_summary(tilt_deg: float) -> list[str]:
    if tilt_deg < TILT_ABOVE_DEG:
        return []
    return [f"the base, or the first module on it, is tilted by {tilt_deg:.1f} deg against the baseline"]


def _summary(links: Sequence[LinkCheck]) -> list[str]:
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
    return lines


def _changed(link: LinkCheck) -> str:
    x, y, z = link.displacement_mm
    turn = float(np.linalg.norm(link.rotation_deg))
    return (
        f"the link {link.parent} - {link.child} has changed: its far end is displaced by "
        f"{link.length_mm:.2f} +- {link.length_sigma_mm:.2f} mm, ({x:+.2f}, {y:+.2f}, {z:+.2f}) mm in the "
        f"frame of {link.child}'s IMU, and turned by {turn:.2f} +- {max(link.rotation_sigma_deg):.2f} deg; "
        f"probability of a false alarm: {_odds(link.false_alarm_probability)} "
        f"({link.sigmas:.1f} sigma)"
    )


def _odds(probability: float) -> str:
    return f"1 of {1.0 / probability:.0e}" if probability > 1e-15 else "less than 1 of 1e+15"


def write_check(path: Path, report: CheckReport) -> None:
    """Write `check.json`; the file is the complete old or the complete new one."""
    write_json(path, report)
