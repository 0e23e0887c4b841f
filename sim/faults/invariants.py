"""What must hold of every session, whatever happened in it."""

from pathlib import Path

from coordinator.recording.run_folder import SESSION, load_recording
from module_agent.model.errors import RobotError
from sim.faults.run import Ending
from sim.faults.schedule import Schedule
from sim.scoring.score import score

# Of thousands of intervals, all are to hold: five standard deviations, and the resolution of a short motion.
SIGMAS = 5.0
RESOLUTION_MM = 2.0


def check_folder(out: Path, ending: Ending) -> dict[str, str]:
    """Return violations by kind: an unreadable recording, an unbounded run, a result that is wrong."""
    violations = {}
    if ending.name == "unbounded":
        violations["unbounded"] = ending.text
    if (out / SESSION).exists():
        try:
            damage = load_recording(out / SESSION).damage
        except RobotError as error:
            violations["unreadable recording"] = str(error)
        else:
            if damage and ending.name != "lost":
                violations["unreadable recording"] = damage[0]
    if ending.name == "result":
        wrong = _wrong(out)
        if wrong:
            violations["wrong robot"] = wrong
    return violations


def check_cause(schedule: Schedule, ending: Ending) -> dict[str, str]:
    """Return a violation where an ending accuses modules, and none of those that something happened to."""
    if ending.name in ("result", "suspect", "lost", "unbounded") or not all(
        f.of_a_module for f in schedule.faults
    ):
        return {}
    serials, modules = schedule.robot.serials, len(schedule.robot.modules)
    sick = {serials[fault.module] for fault in schedule.faults}
    # The IMUs of two modules are exchanged.
    sick |= {serials[(f.module + 1) % modules] for f in schedule.faults if f.kind == "IMU swapped"}
    accused = {serial for serial in serials if serial in ending.text}
    # How many were found, and which, says which were not.
    if not accused or accused & sick or "expected, found" in ending.text:
        return {}
    return {"wrong cause": f"{ending.text} (it happened to {', '.join(sorted(sick))})"}


def _wrong(out: Path) -> str:
    scored = score(out)
    if scored.topology_differences:
        return "; ".join(scored.topology_differences)
    for link in scored.links:
        error, sigma = link.link_length_error_mm, link.link_length_sigma_mm or 0.0
        if error is not None and not abs(error) <= max(SIGMAS * sigma, RESOLUTION_MM):
            return f"link {link.parent} - {link.child} is {error:+.2f} mm off, claimed sigma {sigma:.2f} mm"
    return ""
