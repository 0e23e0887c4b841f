"""What must hold of every session, whatever happened in it."""

import json
from pathlib import Path

from pydantic import ValidationError

from coordinator.identification.result import Result
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
# Nothing is claimed of it; an IMU's errors turn it by a degree or two.
GRAVITY_DEG = 3.0


def check_folder(out: Path, ending: Ending) -> dict[str, str]:
    """Return violations by kind: an unreadable recording or result, an unbounded run, a wrong result."""
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
        try:
            Result.model_validate_json((out / RESULT).read_bytes())
            wrong = _wrong(out, ending.unheard, refused_by_limits(recording.journal))
        except (ValidationError, RobotError) as error:
            violations["unreadable result"] = str(error)
        else:
            if wrong:
                violations["wrong robot"] = wrong
    return violations


def widest_claim_mm(out: Path) -> float | None:
    """Return the largest sigma that a result claims of the length of a link; None if it claims none.

    No error is beyond a claim that is wide enough: so the search reports how wide claims are.
    """
    sigmas = (link["link_length_sigma_mm"] for link in json.loads((out / RESULT).read_bytes())["links"])
    return max((sigma for sigma in sigmas if sigma is not None), default=None)


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
    for link in scored.links:
        if link.parent in unheard | unmoved or link.child in unheard:
            continue
        wrong = _wrong_link(link)
        if wrong:
            return f"link {link.parent} - {link.child} {wrong}"
    return "" if unheard | unmoved else _wrong_robot(scored)


def _wrong_link(link: LinkScore) -> str:
    """Say by how much a link is wrong: its way across the joint to the IMU, or its axis."""
    length_mm, vector_mm, axis_deg = link.link_length_error_mm, link.link_vector_error_mm, link.axis_error_deg
    if length_mm is None or vector_mm is None or axis_deg is None:
        return ""  # another topology, of which the differences tell
    if link.link_length_sigma_mm is None:
        return "has a length of which nothing is claimed, with exit code 0"
    return (
        _beyond("the length is", length_mm, link.link_length_sigma_mm, RESOLUTION_MM, "mm off")
        or _beyond("the way across is", vector_mm, link.link_vector_sigma_mm, RESOLUTION_MM, "mm off")
        or _beyond("the axis is", axis_deg, link.axis_sigma_deg, AXIS_DEG, "degrees off")
    )


def _wrong_robot(scored: Score) -> str:
    """Say what is wrong of the whole: gravity, and tips, by ways along axes and zeros of encoders as well."""
    return (
        _beyond("the tips are", scored.tip_position_rms_mm, scored.tip_position_sigma_mm, TIP_MM, "mm off")
        or _beyond(
            "the tips are turned by",
            scored.tip_orientation_rms_deg,
            scored.tip_orientation_sigma_deg,
            TIP_DEG,
            "degrees",
        )
        or _beyond("gravity is", scored.gravity_error_deg, None, GRAVITY_DEG, "degrees off")
    )


def _beyond(what: str, error: float | None, sigma: float | None, resolution: float, unit: str) -> str:
    """Say that an error is larger than five of the claimed sigmas and than the resolution, if it is."""
    most = max(SIGMAS * (sigma or 0.0), resolution)
    if error is None or abs(error) <= most:
        return ""
    return f"{what} {error:.2f} {unit}, expected at most {most:.2f}"
