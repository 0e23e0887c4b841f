"""What must hold of every session, whatever happened in it."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from coordinator.identification.result import Result
from coordinator.recording.journal import refused_by_limits
from coordinator.recording.run_folder import RESULT, SESSION, load_recording
from coordinator.recording.session_file import MCAP0_MAGIC
from module_agent.model.errors import RobotError
from module_agent.model.model_faults import first_fault
from sim.faults.run import WITH_RESULT, Ending
from sim.faults.schedule import Schedule
from sim.scoring.score import LinkScore, Score, score

# Of thousands of intervals, all are to hold: five standard deviations, and the resolution of a short motion.
SIGMAS = 5.0
RESOLUTION_MM = 2.0
# So are those of axes and tips, or what short motions tell: of 95 sessions with the right robot axes err by
# half a degree at most, tips by 0.6 degrees and 7 mm. A jump of an encoder by 1.2 degrees is found by itself.
AXIS_DEG = 2.0
TIP_DEG, TIP_MM = 3.0, 20.0
# Nothing is claimed of it; an IMU's errors turn it by a degree or two.
GRAVITY_DEG = 3.0
# Predicted torques of a held-out motion, of every joint: of 13 sessions without faults they err by 0.017 Nm
# rms at most where torque sensors are right. A share of the true ones counts where it is larger. A sensor's
# scale is claimed within 3.5 % at best where sensors are good to 5 %: of 810977 torques are 5.6 % too small.
TORQUE_NM, TORQUE_SHARE = 0.05, 0.05

# A claim that is wider says little: no error would be beyond it.
VAGUE_MM, VAGUE_DEG = 5.0, 1.0
# Endings that leave a recording at least.
WITH_RECORDING = (*WITH_RESULT, "lost")
NO_LINK = "no link"


class Claim(NamedTuple):
    """The widest of the claims of a robot's links: of its length or way across the joint, and of its axis.

    link: which it is of, "no link" where none was compared with the truth. Standard deviations.
    """

    link: str
    mm: float
    deg: float

    @property
    def width(self) -> float:
        """How wide it is, over what counts as vague; infinite of no link at all."""
        return max(self.mm / VAGUE_MM, self.deg / VAGUE_DEG) if self.link != NO_LINK else math.inf

    @property
    def is_vague(self) -> bool:
        """Whether it says little."""
        return self.width > 1.0


class FolderCheck(NamedTuple):
    """What the folder of a session says about it.

    violations: by kind. claim: how wide the claims are of a result that is not called suspect, None of
    others. wrong: what is wrong with one that is, beyond all that it claims. is_explained: whether one of its
    suspicions concerns a module at the ends of the link that is wrong, or any module if the whole robot is.
    """

    violations: dict[str, str]
    claim: Claim | None = None
    wrong: str = ""
    is_explained: bool = False


class _Wrong(NamedTuple):
    """What is wrong with a result, and the modules next to it; none for the whole robot."""

    text: str
    modules: frozenset[str] = frozenset()


def check_folder(out: Path, ending: Ending, clock_sick: frozenset[str] = frozenset()) -> FolderCheck:
    """Return the violations of a session: of its recording, its result, and its time; and what it claims.

    clock_sick: modules whose predicted torques are not compared with the truth, as their clocks are sick.
    """
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
            # Where its writer was killed it has no end, which is no damage.
            if recording.damage:
                violations["unreadable recording"] = recording.damage[0]
            elif ending.name in WITH_RESULT and not _has_end(out / SESSION):
                violations["unreadable recording"] = f"{SESSION} is cut off"
    elif ending.name in WITH_RECORDING:
        violations["no recording"] = f"the session ended as {ending.name!r} and left no {SESSION}"
    if ending.name not in WITH_RESULT:
        return FolderCheck(violations)
    try:
        result = Result.model_validate_json((out / RESULT).read_bytes())
        unmoved = set() if recording is None else refused_by_limits(recording.journal)
        scored = score(out)
    except (OSError, ValidationError, RobotError) as error:
        text = first_fault(error) if isinstance(error, ValidationError) else str(error)
        return FolderCheck(violations | {"unreadable result": text})
    if ending.name == "result":
        wrong = _wrong(scored, ending.unheard, unmoved, clock_sick, believed=True)
        violations |= {"wrong robot": wrong.text} if wrong.text else {}
        return FolderCheck(violations, _widest(scored, ending.unheard, unmoved))
    # Modules that it says it is without are no errors of the rest.
    without = {s for s in _serials(scored) - set(result.serials) if _has_serial(ending.text, s)}
    wrong = _wrong(scored, ending.unheard | without, unmoved, clock_sick, believed=False)
    near = wrong.modules or _serials(scored)
    is_explained = any(_has_serial(ending.text, serial) for serial in near)
    return FolderCheck(violations, wrong=wrong.text, is_explained=is_explained)


def _has_end(recording: Path) -> bool:
    return recording.read_bytes().endswith(MCAP0_MAGIC)


def _serials(scored: Score) -> frozenset[str]:
    """Return the modules of the true robot: each is at an end of a link."""
    return frozenset(serial for link in scored.links for serial in (link.parent, link.child))


def _has_serial(text: str, serial: str) -> bool:
    return re.search(rf"(?<!\w){re.escape(serial)}(?!\w)", text) is not None


def _compared(scored: Score, unheard: frozenset[str] | set[str], unmoved: set[str]) -> Iterator[LinkScore]:
    """Yield the links that are compared with the truth; see `_wrong`."""
    for link in scored.links:
        if link.parent not in unheard | unmoved and link.child not in unheard:
            yield link


def _widest(scored: Score, unheard: frozenset[str], unmoved: set[str]) -> Claim:
    """Return the widest claim of the links that are compared."""
    claims = [
        Claim(
            f"{link.parent} - {link.child}",
            max(link.link_length_sigma_mm, link.link_vector_sigma_mm or 0.0),
            link.axis_sigma_deg or 0.0,
        )
        for link in _compared(scored, unheard, unmoved)
        if link.link_length_sigma_mm is not None
    ]
    return max(claims, key=lambda claim: claim.width, default=Claim(NO_LINK, 0.0, 0.0))


def is_misnamed(schedule: Schedule, ending: Ending) -> bool:
    """Return whether an ending accuses modules, and none of those that something happened to."""
    if ending.name in ("result", "lost", "unbounded") or not all(f.of_a_module for f in schedule.faults):
        return False
    serials = schedule.robot.serials
    sick = {serials[index] for fault in schedule.faults for index in fault.modules(len(serials))}
    accused = {serial for serial in serials if serial in ending.text}
    # How many were found, and which, says which were not.
    return bool(accused) and not accused & sick and "expected, found" not in ending.text


def _wrong(
    scored: Score,
    unheard: frozenset[str] | set[str],
    unmoved: set[str],
    clock_sick: frozenset[str],
    believed: bool,
) -> _Wrong:
    """Say what is wrong with the result, but for what nothing could show.

    unheard: modules that do not exist for the coordinator, whose neighbours are mounted on each other for it.
    unmoved: modules that refused to turn their joint by their own limits: how they are mounted, and what they
    carry, is not known. clock_sick: see `check_folder`. believed: whether its exit code says that it is
    right: then something is claimed of every link.
    """
    carried = {link.child for link in scored.links if link.parent in unheard | unmoved}
    unknown = (
        *(f"module {serial} was not found" for serial in unheard),
        *(f"module {serial} is mounted on" for serial in carried),
        *(f"module {serial} is mounted {way}" for serial in unmoved for way in ("forward", "reversed")),
    )
    differences = [text for text in scored.topology_differences if not text.startswith(unknown)]
    if differences:
        text = "; ".join(differences)
        return _Wrong(text, frozenset(s for s in _serials(scored) if _has_serial(text, s)))
    for link in _compared(scored, unheard, unmoved):
        is_claimed = believed or link.link_length_sigma_mm is not None
        wrong = _wrong_link(link) if is_claimed else ""
        if wrong:
            modules = frozenset((link.parent, link.child))
            return _Wrong(f"link {link.parent} - {link.child} {wrong}", modules)
    if unheard | unmoved:
        return _Wrong("")
    whole = _wrong_robot(scored)
    return _Wrong(whole) if whole else _wrong_torque(scored, clock_sick)


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


def _wrong_torque(scored: Score, clock_sick: frozenset[str]) -> _Wrong:
    """Say which joint's torques are predicted wrongly, in a motion that inertia was not identified from.

    What is claimed of the scale of a joint's torque sensor lets expect torques that are too large or too
    small by a common factor: what is left without one is judged as if nothing were claimed. Of a joint whose
    torque hardly varies a constant error looks like a factor, too.
    """
    sizes_nm, scales = scored.torque_rms_nm_per_joint or {}, scored.torque_scale_error_per_joint or {}
    sigmas = scored.torque_scale_sigma_per_joint or {}
    errors_nm = scored.torque_rms_error_nm_per_joint or {}
    for serial, shape_nm in (scored.torque_shape_error_nm_per_joint or {}).items():
        size_nm = sizes_nm[serial]
        most_nm = max(TORQUE_NM, TORQUE_SHARE * size_nm)
        if not sigmas[serial]:
            shape_nm = errors_nm[serial]
        scale_nm = (scales[serial] or 0.0) * size_nm
        text = _beyond("are predicted", shape_nm, None, most_nm, "Nm off") or _beyond(
            "are predicted too large by", scale_nm, sigmas[serial] * size_nm, most_nm, "Nm"
        )
        if text and serial not in clock_sick:
            return _Wrong(f"torques of {serial} {text}", frozenset((serial,)))
    return _Wrong("")


def _beyond(what: str, error: float | None, sigma: float | None, resolution: float, unit: str) -> str:
    """Say that an error is larger than five of the claimed sigmas and than the resolution, if it is."""
    most = max(SIGMAS * (sigma or 0.0), resolution)
    if error is None or abs(error) <= most:
        return ""
    return f"{what} {error:.2f} {unit}, expected at most {most:.2f}"
