"""Identification of a payload: one short motion of all joints against the baseline."""

from coordinator.baseline.baseline_robot import BaselineRobot, shortened_settings
from coordinator.baseline.payload_report import PayloadReport, payload_report
from coordinator.excitation.plan import Plan
from coordinator.parameter_fit.least_squares import solve_weighted
from coordinator.parameter_fit.payload import find_payload
from coordinator.recording.journal import Purpose
from coordinator.synchronisation.motion_windows import INDEPENDENT_FRACTION, dynamic_motion
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.model.forward_kinematics import places_on_axes
from module_agent.model.information import JointInformation, gather
from module_agent.signals.filtering import JointMotion

_MOVING: tuple[Purpose, ...] = ("dynamic", "whole")


class PayloadError(DataError):
    """The two runs cannot be compared; the message says why."""


def payload_plan(baseline: BaselineRobot, plan: Plan) -> Plan:
    """Return the plan of a run with one short motion of all joints: about 16 s for six joints."""
    return plan.model_copy(update=shortened_settings(plan, baseline) | {"mode": "simultaneous"})


def search_payload(baseline: BaselineRobot, later: BaselineRobot) -> PayloadReport:
    """Identify the payload that a robot carries in a later run and not in its baseline, or the reverse.

    The chain is the baseline's. The torque noise is the residual of the baseline, so that springs and
    friction, which are not modelled, count as noise.

    Raises:
        PayloadError: other modules or links, no motion for inertia in the baseline, or no motion in the later
            run.
    """
    chain = baseline.chain
    serials = later.kinematics.topology.serials
    if serials != chain.serials or later.kinematics.topology.parent != chain.parent:
        raise PayloadError(
            f"{later.folder} is of another robot than {baseline.folder}: modules {', '.join(serials)} in "
            f"place of {', '.join(chain.serials)}, or mounted differently; identify it again"
        )
    if not baseline.recording.motions("dynamic"):
        raise PayloadError(f"{baseline.folder} has no motions for inertia, since the run had --no-dynamics")
    try:
        before, moved = _motion(baseline, chain), _motion(later, chain)
        information = _information(chain, before)
        sigma = solve_weighted(information, INDEPENDENT_FRACTION).torque_sigma_nm
        later_said, places = _information(chain, moved), places_on_axes(chain)
        found, taken_off = find_payload(information, later_said, places, sigma, INDEPENDENT_FRACTION), False
        if not found.explains:
            # The reverse: with payload in the baseline, and without it later.
            lost = find_payload(later_said, information, places, sigma, INDEPENDENT_FRACTION)
            found, taken_off = (lost, True) if lost.found else (found, False)
    except DataError as error:
        raise PayloadError(f"{later.folder} cannot be compared with {baseline.folder}: {error}") from error
    # All joints move simultaneously: one segment without a gap.
    spent_s = 1e-9 * float(moved.t_ns[-1] - moved.t_ns[0])
    return payload_report(found, chain, later.name, str(baseline.folder), spent_s, taken_off)


def _motion(run: BaselineRobot, chain: Chain) -> JointMotion:
    return dynamic_motion(run.recording, run.kinematics.clocks, chain.serials, *_MOVING)


def _information(chain: Chain, motion: JointMotion) -> tuple[JointInformation, ...]:
    return gather(chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2, motion.tau_nm)
