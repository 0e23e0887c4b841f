"""What a known robot carries: one short motion of all joints, against the run that it is known from."""

from coordinator.baseline.known_robot import BaselineRobot, hurried
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

# A check of all joints at once takes some 11 s for six of them, and all around it 5 s.
_MOVING: tuple[Purpose, ...] = ("dynamic", "whole")


class PayloadError(DataError):
    """The two runs cannot be compared; the message says which of them lacks what."""


def payload_plan(known: BaselineRobot, plan: Plan) -> Plan:
    """Return a plan of one short motion of all joints at once, with all around it as short as it takes."""
    return plan.model_copy(update=hurried(plan, known) | {"mode": "simultaneous"})


def search_payload(known: BaselineRobot, later: BaselineRobot) -> PayloadReport:
    """Say what a robot carries in a later run and did not in the one that it is known from.

    The chain is the known one. The torques' noise is what is left of them in the known run, so that springs
    and friction, which the model has not, count as noise.

    Raises:
        PayloadError: other modules or links, no motion for inertia in the known run, or no motion in the
            later one.
    """
    chain = known.chain
    serials = later.kinematics.topology.serials
    if serials != chain.serials or later.kinematics.topology.parent != chain.parent:
        raise PayloadError(
            f"{later.folder} is of another robot than {known.folder}: modules {', '.join(serials)} in place "
            f"of {', '.join(chain.serials)}, or mounted otherwise; identify it again"
        )
    if not known.recording.motions("dynamic"):
        raise PayloadError(f"{known.folder} has no motions for inertia: it was run with --no-dynamics")
    try:
        before, moved = _motion(known, chain), _motion(later, chain)
        information = _information(chain, before)
        sigma = solve_weighted(information, INDEPENDENT_FRACTION).torque_sigma_nm
        later_said, places = _information(chain, moved), places_on_axes(chain)
        found, taken_off = find_payload(information, later_said, places, sigma, INDEPENDENT_FRACTION), False
        if not found.explains:
            # The other way round: with it before, and without it later.
            lost = find_payload(later_said, information, places, sigma, INDEPENDENT_FRACTION)
            found, taken_off = (lost, True) if lost.found else (found, False)
    except DataError as error:
        raise PayloadError(f"{later.folder} cannot be compared with {known.folder}: {error}") from error
    # All joints at once: one stretch without a gap.
    spent_s = 1e-9 * float(moved.t_ns[-1] - moved.t_ns[0])
    return payload_report(found, chain, later.name, str(known.folder), spent_s, taken_off)


def _motion(run: BaselineRobot, chain: Chain) -> JointMotion:
    return dynamic_motion(run.recording, run.kinematics.clocks, chain.serials, *_MOVING)


def _information(chain: Chain, motion: JointMotion) -> tuple[JointInformation, ...]:
    return gather(chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2, motion.tau_nm)
