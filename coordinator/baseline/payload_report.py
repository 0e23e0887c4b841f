"""`payload.json`: what a robot carries that it did not carry when it was identified."""

from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from coordinator.description.urdf_writer import link_homes
from coordinator.dynamics.pseudo_inertia import Body, body
from coordinator.parameter_fit.payload import Payload
from module_agent.model.chain import Chain
from module_agent.model.files import write_json

SCHEMA = 1
# The next best carrier must explain that much less, in variances of the torques' noise, to be ruled out.
SURE_ABOVE = 25.0

Triple = tuple[float, float, float]


class PayloadReport(BaseModel):
    """What was added, and on which body: that of the module whose joint turns it.

    taken_off: the same was there when the robot was identified, and is not any more. explained: whether a
    payload on one body is all that has changed; the other figures mean nothing if it is not.
    com_mm and inertia_kg_m2 (ixx, ixy, ixz, iyy, iyz, izz, about the centre) are in that body's link frame of
    `robot.urdf`. rival: another module that may as well carry it, if one may. gain: by how much the payload
    makes the misfit of the torques smaller, in variances of their noise.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: str
    known: str
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
    words: list[str]
    schema_version: int = SCHEMA


def payload_report(
    found: Payload, chain: Chain, robot: str, known: str, motion_s: float, taken_off: bool = False
) -> PayloadReport:
    """Put a payload into figures and words; `known` names the run that the robot is known from."""
    into = np.linalg.inv(link_homes(chain)[found.carrier])
    own = body(into @ found.pseudo @ into.T)
    turn = into[:3, :3]
    com_sigma = np.sqrt(np.diagonal(turn @ found.com_covariance_m2 @ turn.T))
    carrier = chain.serials[found.carrier]
    unsure = found.rival_carrier is not None and found.gain - found.rival < SURE_ABOVE
    rival = chain.serials[found.rival_carrier] if unsure and found.rival_carrier is not None else None
    report = PayloadReport(
        robot=robot,
        known=known,
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
        words=[],
    )
    return report.model_copy(update={"words": _words(report)})


def write_payload(path: Path, report: PayloadReport) -> None:
    """Write `payload.json`; the file is the complete old or the complete new one."""
    write_json(path, report)


def _words(report: PayloadReport) -> list[str]:
    if not report.explained:
        return [
            "the torques are others than when the robot was identified, in a way that no payload on one body "
            "explains: several were added, a link has changed, or something holds the robot"
        ]
    if not report.found:
        return [
            f"nothing was added that the torques show: the best guess, {1e3 * report.mass_kg:.0f} g on what "
            f"{report.carrier} turns, explains no more of them than chance does"
        ]
    x, y, z = report.com_mm
    done = "taken off" if report.taken_off else "added to"
    sx, sy, sz = report.com_sigma_mm
    words = [
        f"{report.mass_kg:.3f} +- {report.mass_sigma_kg:.3f} kg were {done} what {report.carrier} turns",
        f"centre at ({x:.1f}, {y:.1f}, {z:.1f}) +- ({sx:.1f}, {sy:.1f}, {sz:.1f}) mm in its link's frame",
    ]
    if report.rival is not None:
        words.append(f"it may as well be on what {report.rival} turns: the motion does not tell them apart")
    return words


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
