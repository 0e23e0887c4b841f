"""Identification of a payload by one short motion of all joints against the baseline, and `payload.json`."""

from functools import partial
from pathlib import Path

import numpy as np

from coordinator.baseline.baseline_robot import BaselineRobot, shortened_settings
from coordinator.description.urdf_writer import link_homes
from coordinator.dynamics.pseudo_inertia import body
from coordinator.excitation.plan import Plan
from coordinator.parameter_fit.least_squares import solve_weighted
from coordinator.parameter_fit.payload import Payload, find_payload
from coordinator.parameter_fit.report_parts import Part, Triple, triple
from coordinator.parameter_fit.torque_sensor_scale import SCALE_SIGMA
from coordinator.recording.journal import Purpose
from coordinator.synchronisation.motion_windows import INDEPENDENT_FRACTION, RATE_HZ, dynamic_motion
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.model.files import write_json
from module_agent.model.forward_kinematics import places_on_axes
from module_agent.model.information import JointInformation, gather
from module_agent.signals.filtering import JointMotion

SCHEMA = 2
# The next best carrier must explain that much less, in chi^2 of the torques, to be ruled out.
SURE_ABOVE = 25.0
_MOVING: tuple[Purpose, ...] = ("dynamic", "whole")


class PayloadReport(Part):
    """A payload and its carrier, the module whose joint turns the body that it is on.

    taken_off: the payload was there in the baseline, and is not any more. explained: whether a payload on one
    body explains all that has changed; if not, the other figures are meaningless.
    com_mm and inertia_kg_m2 (ixx, ixy, ixz, iyy, iyz, izz, about the centre) are in that body's link frame of
    `robot.urdf`. rival: another possible carrier, if there is one. gain: decrease of the torques' chi^2
    by the payload.
    """

    robot: str
    baseline: str
    found: bool
    taken_off: bool
    explained: bool
    carrier: str
    rival: str | None
    mass_kg: float
    mass_sigma_kg: float
    com_mm: Triple
    com_sigma_mm: Triple
    inertia_kg_m2: tuple[float, float, float, float, float, float]
    gain: float
    motion_s: float
    summary: list[str]
    schema_version: int = SCHEMA


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
            + "".join(f"; {one}" for one in later.kinematics.suspicions)
        )
    if not baseline.recording.motions("dynamic"):
        raise PayloadError(f"{baseline.folder} has no motions for inertia, since the run had --no-dynamics")
    try:
        before, moved = _motion(baseline, chain), _motion(later, chain)
        information = _information(chain, before)
        sigma = solve_weighted(information, INDEPENDENT_FRACTION).torque_sigma_nm
        further, places = _information(chain, moved), places_on_axes(chain)
        search = partial(
            find_payload,
            places_m=places,
            sigma_nm=sigma,
            independent_fraction=INDEPENDENT_FRACTION,
            scale_sigma=SCALE_SIGMA[baseline.recording.torque],
        )
        found = search(information, further)
        taken_off = False
        if not found.explains:
            # The reverse: with payload in the baseline, and without it later.
            lost = search(further, information)
            found, taken_off = (lost, True) if lost.found else (found, False)
    except DataError as error:
        raise PayloadError(f"{later.folder} cannot be compared with {baseline.folder}: {error}") from error
    # Of a finished run there may be several motions, with pauses that do not count.
    spent_s = len(moved.t_ns) / RATE_HZ
    return _report(found, chain, later.name, str(baseline.folder), spent_s, taken_off)


def _motion(run: BaselineRobot, chain: Chain) -> JointMotion:
    return dynamic_motion(run.recording, run.kinematics.clocks, chain.serials, *_MOVING)


def _information(chain: Chain, motion: JointMotion) -> tuple[JointInformation, ...]:
    return gather(chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2, motion.tau_nm)


def _report(
    found: Payload, chain: Chain, robot: str, baseline: str, motion_s: float, taken_off: bool
) -> PayloadReport:
    into = np.linalg.inv(link_homes(chain)[found.carrier])
    own = body(into @ found.pseudo @ into.T)
    ixx, ixy, ixz, iyy, iyz, izz = own.inertia_kg_m2[np.triu_indices(3)].tolist()
    turn = into[:3, :3]
    com_sigma = np.sqrt(np.diagonal(turn @ found.com_covariance_m2 @ turn.T))
    rival = None
    if found.rival_carrier is not None and found.gain - found.rival < SURE_ABOVE:
        rival = chain.serials[found.rival_carrier]
    report = PayloadReport(
        robot=robot,
        baseline=baseline,
        found=found.found,
        taken_off=taken_off,
        explained=found.explains,
        carrier=chain.serials[found.carrier],
        rival=rival,
        mass_kg=found.mass_kg,
        mass_sigma_kg=found.mass_sigma_kg,
        com_mm=triple(1e3 * own.com_m),
        com_sigma_mm=triple(1e3 * com_sigma),
        inertia_kg_m2=(ixx, ixy, ixz, iyy, iyz, izz),
        gain=found.gain,
        motion_s=motion_s,
        summary=[],
    )
    return report.model_copy(update={"summary": _summary(report)})


def write_payload(path: Path, report: PayloadReport) -> None:
    """Write `payload.json`; the file is the complete old or the complete new one."""
    write_json(path, report)


def _summary(report: PayloadReport) -> list[str]:
    if not report.explained:
        return [
            "the torques have changed in a way that no payload on one body explains: several payloads, a "
            "changed link, or contact with the environment"
        ]
    if not report.found:
        return [
            f"no payload detected: the best estimate, {1e3 * report.mass_kg:.0f} g on the body that "
            f"{report.carrier} turns, is not significant"
        ]
    x, y, z = report.com_mm
    change = "removed from" if report.taken_off else "added to"
    sx, sy, sz = report.com_sigma_mm
    lines = [
        f"{report.mass_kg:.3f} +- {report.mass_sigma_kg:.3f} kg were {change} the body that {report.carrier} "
        "turns",
        f"centre at ({x:.1f}, {y:.1f}, {z:.1f}) +- ({sx:.1f}, {sy:.1f}, {sz:.1f}) mm in its link's frame",
    ]
    if report.rival is not None:
        lines.append(
            f"the motion does not distinguish it from a payload on the body that {report.rival} turns"
        )
    return lines
