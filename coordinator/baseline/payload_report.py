"""`payload.json`: the payload that a robot carries and did not carry in its baseline."""

from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from coordinator.description.urdf_writer import link_homes
from coordinator.dynamics.pseudo_inertia import Body, body
from coordinator.parameter_fit.payload import Payload
from module_agent.model.chain import Chain
from module_agent.model.files import write_json

SCHEMA = 2
# The next best carrier must explain that much less, in chi^2 of the torques, to be ruled out.
SURE_ABOVE = 25.0

Triple = tuple[float, float, float]


class PayloadReport(BaseModel):
    """A payload and its carrier, the module whose joint turns the body that it is on.

    taken_off: the payload was there in the baseline, and is not any more. explained: whether a payload on one
    body explains all that has changed; if not, the other figures are meaningless.
    com_mm and inertia_kg_m2 (ixx, ixy, ixz, iyy, iyz, izz, about the centre) are in that body's link frame of
    `robot.urdf`. rival: another possible carrier, if there is one. gain: decrease of the torques' chi^2
    by the payload.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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


def payload_report(
    found: Payload, chain: Chain, robot: str, baseline: str, motion_s: float, taken_off: bool = False
) -> PayloadReport:
    """Put a payload into figures and words; `baseline` names the run that the robot is known from."""
    into = np.linalg.inv(link_homes(chain)[found.carrier])
    own = body(into @ found.pseudo @ into.T)
    turn = into[:3, :3]
    com_sigma = np.sqrt(np.diagonal(turn @ found.com_covariance_m2 @ turn.T))
    carrier = chain.serials[found.carrier]
    unsure = found.rival_carrier is not None and found.gain - found.rival < SURE_ABOVE
    rival = chain.serials[found.rival_carrier] if unsure and found.rival_carrier is not None else None
    report = PayloadReport(
        robot=robot,
        baseline=baseline,
        found=found.found,
        taken_off=taken_off,
        explained=found.explains,
        carrier=carrier,
        rival=rival,
        mass_kg=found.mass_kg,
        mass_sigma_kg=found.mass_sigma_kg,
        com_mm=_triple(1e3 * own.com_m),
        com_sigma_mm=_triple(1e3 * com_sigma),
        inertia_kg_m2=_upper(own),
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


def _triple(values: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]") -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _upper(own: Body) -> tuple[float, float, float, float, float, float]:
    i = own.inertia_kg_m2
    return (
        float(i[0, 0]),
        float(i[0, 1]),
        float(i[0, 2]),
        float(i[1, 1]),
        float(i[1, 2]),
        float(i[2, 2]),
    )
