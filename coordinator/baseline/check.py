"""A check of a known robot: two runs, the one that it is known from and a later one, in one report."""

from coordinator.baseline.change_detection import find_changes, tied_fits
from coordinator.baseline.check_report import CheckReport, Session, compared, other_robot
from coordinator.baseline.known_robot import BaselineRobot, hurried
from coordinator.excitation.plan import Plan
from coordinator.topology.topology import Topology
from module_agent.model.errors import DataError
from module_agent.wire.messages import WindowedSine

BASE_NAME = "base"
# Of the windowed sine: six joints then take 50 s with everything.
LONGEST_CENTRE_S, LONGEST_SIGMA_S = 2.3, 0.85


class CheckError(DataError):
    """The two runs cannot be compared; the message says which of them lacks what."""


def check_plan(known: BaselineRobot, plan: Plan) -> Plan:
    """Return a plan as short as a check takes, with the motions that the robot is known from.

    What a model leaves out of a motion cancels where the same motion is compared. A joint takes 8 s; motions
    that are designed take what they took (`joint_s`, `settle_s` and `travel_speed_rad_s` of the plan must be
    as they were then); a robot that is known from a motion of all joints at once is checked by that motion.
    """
    last = {e.purpose: e.motion.pattern for e in known.recording.journal if e.what == "motion" and e.motion}
    short = hurried(plan, known) | {
        "sine_centre_s": min(plan.sine_centre_s, LONGEST_CENTRE_S),
        "sine_sigma_s": min(plan.sine_sigma_s, LONGEST_SIGMA_S),
    }
    sine = last.get("windowed_sine")
    if _designed(known):
        # The same are designed again, if they are given the same time for journeys and settling.
        same = {"settle_s": plan.settle_s, "travel_speed_rad_s": plan.travel_speed_rad_s}
        short |= same | {"mode": "joint", "motions": "optimised"}
    elif isinstance(sine, WindowedSine):
        short |= {
            "mode": "joint",
            "sine_frequency_hz": sine.frequency_hz,
            "sine_centre_s": min(sine.centre_s, LONGEST_CENTRE_S),
            "sine_sigma_s": min(sine.sigma_s, LONGEST_SIGMA_S),
        }
    elif "whole" in last:
        short["mode"] = "simultaneous"
    return plan.model_copy(update=short)


def _designed(known: BaselineRobot) -> bool:
    """Return whether every joint was moved by itself, and then all at once."""
    moved = {(e.serial, e.purpose) for e in known.recording.journal if e.what == "motion"}
    ways = ("windowed_sine", "whole")
    return all((serial, way) in moved for serial in known.chain.serials for way in ways)


def check(known: BaselineRobot, later: BaselineRobot) -> CheckReport:
    """Say which links of a robot changed from one run to a later one.

    Raises:
        CheckError: a recording has a hole, or too few samples.
    """
    journal = later.recording.journal
    times = [event.t_ns for event in journal]
    session = Session(
        robot=later.name,
        known=str(known.folder),
        robot_time_s=(max(times) - min(times)) / 1e9 if times else 0.0,
    )
    before, after = _mounted(known.kinematics.topology), _mounted(later.kinematics.topology)
    if before != after:
        return other_robot(
            session,
            missing=[s for s in before if s not in after],
            new=[s for s in after if s not in before],
            remounted=[s for s in before if s in after and before[s] != after[s]],
        )
    try:
        fits = tied_fits(known, later)
    except DataError as error:
        raise CheckError(f"{later.folder} cannot be compared with {known.folder}: {error}") from error
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
