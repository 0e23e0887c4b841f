"""What must hold of every session, whatever happened in it."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.identification.result import ExponentialsPart, Result, TransformPart
from coordinator.recording.journal import refused_by_limits
from coordinator.recording.run_folder import RESULT, SESSION, load_recording
from module_agent.model.errors import RobotError
from sim.faults.run import Ending
from sim.faults.schedule import Schedule
from sim.scoring.score import LinkScore, Score, score

# Of thousands of intervals, all are to hold: five standard deviations, and the resolution of a short motion.
SIGMAS = 5.0
RESOLUTION_MM = 2.0
# So are those of axes and tips, or what short motions tell: of 95 sessions with the right robot axes err by
# half a degree at most, tips by 0.6 degrees and 7 mm. The least jump of an encoder is 6 degrees.
AXIS_DEG = 2.0
TIP_DEG, TIP_MM = 3.0, 20.0


def check_folder(out: Path, ending: Ending) -> dict[str, str]:
    """Return violations by kind: an unreadable recording, an unbounded run, a result that is wrong."""
    violations: dict[str, str] = {}
    if ending.name == "unbounded":
        violations["unbounded"] = ending.text
    recording = None
    if (out / SESSION).exists():
        try:
            recording = load_recording(out / SESSION)
        except RobotError as error:
            violations["unreadable recording"] = str(error)
        else:
            if recording.damage and ending.name != "lost":
                violations["unreadable recording"] = recording.damage[0]
    if ending.name == "result" and recording is not None:
        wrong = _wrong(out, ending.unheard, refused_by_limits(recording.journal))
        if wrong:
            violations["wrong robot"] = wrong
    return violations


def is_misnamed(schedule: Schedule, ending: Ending) -> bool:
    """Return whether an ending accuses modules, and none of those that something happened to."""
    if ending.name in ("result", "lost", "unbounded") or not all(f.of_a_module for f in schedule.faults):
        return False
    serials = schedule.robot.serials
    sick = {serials[index] for fault in schedule.faults for index in fault.modules(len(serials))}
    accused = {serial for serial in serials if serial in ending.text}
    # How many were found, and which, says which were not.
    return bool(accused) and not accused & sick and "expected, found" not in ending.text


def _wrong(out: Path, unheard: frozenset[str], unmoved: set[str]) -> str:
    """Say what is wrong with the result, but for what nothing could show.

    unheard: modules that do not exist for the coordinator, whose neighbours are mounted on each other for it.
    unmoved: modules that refused to turn their joint by their own limits: how they are mounted, and what they
    carry, is not known.
    """
    scored = score(out)
    carried = {link.child for link in scored.links if link.parent in unheard | unmoved}
    unknown = (
        *(f"module {serial} was not found" for serial in unheard),
        *(f"module {serial} is mounted on" for serial in carried),
        *(f"module {serial} is mounted {way}" for serial in unmoved for way in ("forward", "reversed")),
    )
    differences = [text for text in scored.topology_differences if not text.startswith(unknown)]
    if differences:
        return "; ".join(differences)
    result = Result.model_validate_json((out / RESULT).read_bytes())
    claims = {part.child: _claimed(part) for part in result.transforms}
    for link in scored.links:
        if link.parent in unheard | unmoved or link.child in unheard:
            continue
        wrong = _wrong_link(link, claims[link.child])
        if wrong:
            return f"link {link.parent} - {link.child} {wrong}"
    return "" if unheard | unmoved else _wrong_tip(scored, result.product_of_exponentials)


class _Claim(NamedTuple):
    """The largest standard deviations that a result has for the place and the orientation of a link's end."""

    place_mm: float
    turn_deg: float


def _claimed(part: TransformPart) -> _Claim:
    known = {name: sigma or 0.0 for name, sigma in zip(part.parameters, part.sigma, strict=True)}
    place, turn = (max(s for name, s in known.items() if name.endswith(unit)) for unit in ("_mm", "_deg"))
    return _Claim(place, turn)


def _wrong_link(link: LinkScore, claim: _Claim) -> str:
    """Say by how much a link is wrong: its way across the joint to the IMU, or its axis."""
    length_mm = link.link_length_sigma_mm or 0.0
    within_mm = max(SIGMAS * length_mm, RESOLUTION_MM)
    if link.link_length_error_mm is not None and not abs(link.link_length_error_mm) <= within_mm:
        return f"is {link.link_length_error_mm:+.2f} mm off, claimed sigma {length_mm:.2f} mm"
    within_mm = max(within_mm, SIGMAS * claim.place_mm)
    if link.link_vector_error_mm is not None and not link.link_vector_error_mm <= within_mm:
        return (
            f"errs by {link.link_vector_error_mm:.2f} mm across its joint, expected at most {within_mm:.2f}"
        )
    within_deg = max(SIGMAS * claim.turn_deg, AXIS_DEG)
    if link.axis_error_deg is not None and not link.axis_error_deg <= within_deg:
        return f"has its axis {link.axis_error_deg:.2f} degrees off, expected at most {within_deg:.2f}"
    return ""


def _wrong_tip(scored: Score, claimed: ExponentialsPart) -> str:
    """Say by how much the tips are wrong, by ways along axes and zeros of encoders as well."""
    spread = np.array([np.diag(tip.covariance) for tip in claimed.tips]).reshape(-1, 2, 3).sum(axis=2)
    turn_rad, place_m = np.sqrt(spread.max(axis=0, initial=0.0))
    within_deg, within_mm = max(SIGMAS * np.degrees(turn_rad), TIP_DEG), max(SIGMAS * 1e3 * place_m, TIP_MM)
    turned_deg, moved_mm = scored.tip_orientation_rms_deg, scored.tip_position_rms_mm
    if turned_deg is not None and not turned_deg <= within_deg:
        return f"the tips are turned by {turned_deg:.2f} degrees, expected at most {within_deg:.2f}"
    if moved_mm is not None and not moved_mm <= within_mm:
        return f"the tips are {moved_mm:.2f} mm off, expected at most {within_mm:.2f}"
    return ""
