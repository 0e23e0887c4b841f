"""Check of a robot against its baseline: which links changed between two runs."""

from coordinator.baseline.baseline_robot import BaselineRobot, shortened_settings
from coordinator.baseline.change_detection import find_changes, tied_fits
from coordinator.baseline.check_report import CheckReport, Session, compared, other_robot
from coordinator.excitation.plan import Plan
from coordinator.topology.topology import Topology
from module_agent.model.errors import DataError
from module_agent.wire.messages import WindowedSine

BASE_NAME = "base"
# Of the windowed sine; a check of six joints then takes 50 s.
MAX_CENTRE_S, MAX_SIGMA_S = 2.3, 0.85


class CheckError(DataError):
    """The two runs cannot be compared; the message says why."""


def check_plan(baseline: BaselineRobot, plan: Plan) -> Plan:
    """Return a short plan with the motions of the baseline.

    Model errors cancel when the same motions are compared. A joint takes 8 s; optimised motions take as long
    as in the baseline (`joint_s`, `settle_s` and `travel_speed_rad_s` of the plan must be the same); a
    baseline with one motion of all joints is checked by that motion.
    """
    last = {
        e.purpose: e.motion.pattern for e in baseline.recording.journal if e.what == "motion" and e.motion
    }
    short = shortened_settings(plan, baseline) | {
        "sine_centre_s": min(plan.sine_centre_s, MAX_CENTRE_S),
        "sine_sigma_s": min(plan.sine_sigma_s, MAX_SIGMA_S),
    }
    sine = last.get("windowed_sine")
    if _designed(baseline):
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


def _designed(baseline: BaselineRobot) -> bool:
    """Return whether every joint was moved alone, and then all simultaneously, as optimised motions do."""
    moved = {(e.serial, e.purpose) for e in baseline.recording.journal if e.what == "motion"}
    ways = ("windowed_sine", "whole")
    return all((serial, way) in moved for serial in baseline.chain.serials for way in ways)


def check(baseline: BaselineRobot, later: BaselineRobot) -> CheckReport:
    """Compare the links of a robot in a later run with its baseline.

    Raises:
        CheckError: a recording has a hole, or too few samples.
    """
    journal = later.recording.journal
    times = [event.t_ns for event in journal]
    session = Session(
        robot=later.name,
        baseline=str(baseline.folder),
        robot_time_s=(max(times) - min(times)) / 1e9 if times else 0.0,
    )
    before, after = _mounted(baseline.kinematics.topology), _mounted(later.kinematics.topology)
    if before != after:
        return other_robot(
            session,
            missing=[s for s in before if s not in after],
            new=[s for s in after if s not in before],
            remounted=[s for s in before if s in after and before[s] != after[s]],
        )
    try:
        fits = tied_fits(baseline, later)
    except DataError as error:
        raise CheckError(f"{later.folder} cannot be compared with {baseline.folder}: {error}") from error
    return compared(session, fits.before.chain, fits.after.chain, find_changes(fits))


def _mounted(topology: Topology) -> dict[str, tuple[str, bool]]:
    """Return every module's parent, and whether it is mounted reversed."""
    names = (*topology.serials, BASE_NAME)
    return {
        serial: (names[parent], backwards)
        for serial, parent, backwards in zip(
            topology.serials, topology.parent, topology.reversed, strict=True
        )
    }
