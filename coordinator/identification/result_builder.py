"""The result of an identification in the schema of `result.json`."""

from typing import Literal

import numpy as np

from coordinator.description.denavit_hartenberg import dh_paths
from coordinator.description.link_transforms import PARAMETERS, LinkTransform, link_transforms
from coordinator.description.product_of_exponentials import screw_model
from coordinator.identification.identified import HeldOutMotion, Kinematics
from coordinator.identification.inertia.agent_information import AgentInformation
from coordinator.identification.inertia.inertia import Inertia
from coordinator.identification.inertia.robot_bodies import RobotBodies
from coordinator.identification.result import (
    BodiesPart,
    ChainPart,
    DhPart,
    DhRowPart,
    DynamicsPart,
    ExponentialsPart,
    HeldOutPart,
    IdentifiabilityPart,
    LinkPart,
    ModuleBodyPart,
    MountingPart,
    PairPart,
    Result,
    ScrewPart,
    TipPart,
    TorqueTermPart,
    TransformPart,
    UnknownPart,
    UnresolvedPart,
)
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.null_space import Unresolved
from coordinator.parameter_fit.instrumental_variables import InstrumentalFit
from coordinator.parameter_fit.report_parts import base_parameter_parts, body_part
from coordinator.recording.recording import Recording
from coordinator.topology.topology import Topology
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.model.chain import Array
from module_agent.model.regressor import PER_BODY
from module_agent.signals.torque_terms import READING_TERMS, TERM_KINDS


def build_result(
    recording: Recording,
    kinematics: Kinematics,
    inertia: Inertia | None,
    held_out: HeldOutMotion | None,
    bodies: RobotBodies | None = None,
) -> Result:
    """Return the result of a session."""
    fit, topology = kinematics.fit, kinematics.topology
    named = {s: _type_name(recording, s) for s in topology.serials}
    types = [module_type(name) for name in named.values()]
    times = [e.t_ns for e in recording.journal]
    began = [e for e in recording.journal if e.what == "session"]
    finished = [e for e in recording.journal if e.what == "finished"]
    return Result(
        robot=began[-1].robot if began else "",
        serials=list(topology.serials),
        types=named,
        topology_confidence=topology.confidence,
        topology=_mountings(topology),
        chain=ChainPart.of(fit.chain),
        rank=fit.rank,
        condition=fit.condition,
        reduced_chi2=kinematics.first.reduced_chi2,
        unresolved=[_unresolved(fit, types, u) for u in fit.unresolved],
        null_basis=fit.null_basis.tolist(),
        chain_covariance=fit.covariance.tolist(),
        links=_links(kinematics),
        transforms=_transforms(fit, types),
        product_of_exponentials=_exponentials(fit, types),
        pairs=_pairs(recording),
        denavit_hartenberg=_dh(kinematics),
        dynamics=_dynamics(kinematics, inertia, held_out, bodies),
        notes=[*kinematics.notes, *_notes(inertia, bodies)],
        robot_time_s=(max(times) - min(times)) / 1e9 if times else 0.0,
        wall_time_s=finished[-1].wall_time_s if finished else None,
        trace_hash=recording.trace_hash,
    )


def _notes(inertia: Inertia | None, bodies: RobotBodies | None) -> list[str]:
    notes = [bodies.note] if bodies is not None else []
    if inertia is not None and inertia.gathered is not None:
        notes.append(inertia.gathered.note)
    return [note for note in notes if note]


def _mountings(topology: Topology) -> list[MountingPart]:
    if not topology.parent_log_odds:
        return []
    columns = zip(
        topology.serials,
        topology.parent,
        topology.parent_log_odds,
        topology.reversed,
        topology.reversed_log_odds,
        strict=True,
    )
    return [
        MountingPart(
            serial=serial,
            parent=topology.serials[p] if p >= 0 else None,
            parent_log_odds=on if np.isfinite(on) else None,
            reversed=turned,
            reversed_log_odds=how,
            joint_moved=serial not in topology.unmoved,
        )
        for serial, p, on, turned, how in columns
    ]


def _type_name(recording: Recording, serial: str) -> str:
    info = recording.modules[serial].info
    return info.module_type if info is not None else "unknown"


def _links(kinematics: Kinematics) -> list[LinkPart]:
    topology, fit = kinematics.topology, kinematics.fit
    return [
        LinkPart(
            parent=topology.serials[parent],
            child=topology.serials[k],
            link_length_mm=1e3 * float(fit.link_length_m[k]),
            link_length_sigma_mm=1e3 * float(fit.link_length_sigma_m[k]),
        )
        for k, parent in enumerate(topology.parent)
        if parent >= 0
    ]


def _unresolved(fit: ChainEstimate, types: list[ModuleType], item: Unresolved) -> UnresolvedPart:
    links = [
        UnknownPart(parent=link.parent, child=link.child, parameters=_unknown(link))
        for link in link_transforms(fit.chain, types, np.zeros_like(fit.covariance), _columns(item))
        if any(link.unknown)
    ]
    return UnresolvedPart(
        kind=item.kind,
        joint=item.joint,
        modules=list(item.modules),
        summary=_summary(item, links),
        resolved_by=item.resolved_by,
        links=links,
    )


def _summary(item: Unresolved, links: list[UnknownPart]) -> str:
    """Describe which parameters of which links are unresolved, why, and what would resolve them."""
    short = [", ".join(name.split("_")[0] for name in link.parameters) for link in links]
    of = [
        f"{names} of the link {link.parent} - {link.child}" for names, link in zip(short, links, strict=True)
    ]
    where = f"{' and '.join(of)}: " if of else ""
    return f"{where}{item.text}. What would tell it: {item.resolved_by}"


def _unknown(link: LinkTransform) -> list[str]:
    return [name for name, unknown in zip(PARAMETERS, link.unknown, strict=True) if unknown]


def _columns(item: Unresolved) -> Array:
    return np.asarray(item.directions / np.linalg.norm(item.directions, axis=0))


def _transforms(fit: ChainEstimate, types: list[ModuleType]) -> list[TransformPart]:
    # The named gauge freedoms, not the null vectors of the fit, which are mixed and affected by its noise.
    no_directions = np.zeros((len(fit.covariance), 0))
    hidden = np.concatenate([no_directions, *(_columns(item) for item in fit.unresolved)], axis=1)
    return [_transform(link) for link in link_transforms(fit.chain, types, fit.covariance, hidden)]


def _transform(link: LinkTransform) -> TransformPart:
    sigma = np.sqrt(link.covariance.diagonal()).tolist()
    return TransformPart(
        parent=link.parent,
        child=link.child,
        parent_face=link.parent_face,
        child_face=link.child_face,
        parameters=list(PARAMETERS),
        values=link.values.tolist(),
        sigma=[None if unknown else s for s, unknown in zip(sigma, link.unknown, strict=True)],
        covariance=link.covariance.tolist(),
        null_directions=link.null_directions.tolist(),
    )


def _exponentials(fit: ChainEstimate, types: list[ModuleType]) -> ExponentialsPart:
    model = screw_model(fit.chain, types, fit.covariance)
    return ExponentialsPart(
        screws=[
            ScrewPart(serial=serial, screw=screw.tolist(), covariance=covariance.tolist())
            for serial, screw, covariance in zip(model.serials, model.screws, model.covariance, strict=True)
        ],
        tips=[
            TipPart(
                serial=tip.serial,
                frame=tip.frame,
                joints=list(tip.joints),
                home=tip.home.tolist(),
                covariance=tip.covariance.tolist(),
            )
            for tip in model.tips
        ],
    )


def _pairs(recording: Recording) -> list[PairPart]:
    parts = []
    for (joint, observer), estimates in sorted(recording.estimates.items()):
        estimate = list(estimates.values())[-1]
        circle = estimate.circle
        parts.append(
            PairPart(
                joint=joint,
                observer=observer,
                moved=estimate.moved,
                rate_ratio=estimate.rate_ratio,
                distance_mm=1e3 * circle.distance_m if circle else None,
                distance_sigma_mm=1e3 * circle.sigma_distance_m if circle else None,
                axis=list(circle.axis) if circle else None,
            )
        )
    return parts


def _dh(kinematics: Kinematics) -> list[DhPart]:
    return [
        DhPart(base=path.base.tolist(), rows=[DhRowPart(**row._asdict()) for row in path.rows])
        for path in dh_paths(kinematics.fit.chain)
    ]


def _dynamics(
    kinematics: Kinematics,
    inertia: Inertia | None,
    held_out: HeldOutMotion | None,
    bodies: RobotBodies | None,
) -> DynamicsPart | None:
    if inertia is None:
        return None
    serials, fit = kinematics.topology.serials, inertia.instrumental.fit
    return DynamicsPart(
        phi=fit.phi.tolist(),
        rank=fit.rank,
        parameters=len(fit.phi),
        condition=fit.condition,
        sigma=(fit.covariance.diagonal() ** 0.5).tolist(),
        identifiable=fit.identifiable.tolist(),
        residual_rms_nm=dict(zip(serials, fit.residual_rms_nm.tolist(), strict=True)),
        held_out=_held_out(serials, held_out) if held_out is not None else None,
        bodies=_bodies(bodies) if bodies is not None else None,
        base_parameters=base_parameter_parts(bodies.base) if bodies is not None else [],
        identifiability=_identifiability(bodies) if bodies is not None else [],
        summary=bodies.summary() if bodies is not None else [],
        frames=bodies.frames.tolist() if bodies is not None else [],
        motion_source=inertia.motion_source,
        gathered_by=_gathered_by(inertia.gathered, len(serials)),
        by_agents=list(inertia.gathered.by_agents) if inertia.gathered is not None else [],
        gathered_difference=inertia.gathered.difference if inertia.gathered is not None else None,
        noise_nm={
            source: dict(zip(serials, noise.tolist(), strict=True))
            for source, noise in inertia.noise_nm.items()
        },
        torque_terms=_torque_terms(serials, inertia.instrumental),
    )


def _gathered_by(shared: AgentInformation | None, joints: int) -> Literal["agents", "coordinator", "both"]:
    if shared is None or not shared.by_agents:
        return "coordinator"
    return "agents" if len(shared.by_agents) == joints else "both"


def _torque_terms(serials: tuple[str, ...], estimate: InstrumentalFit) -> list[TorqueTermPart]:
    terms, scale = estimate.terms, estimate.scale
    return [
        TorqueTermPart(
            serial=serial,
            term=term,
            unit=TERM_KINDS[term].unit,
            significant=bool(terms.used[i, k]),
            value=float(terms.value[i, k]),
            sigma=float(terms.sigma[i, k]),
            gain=float(terms.gain[i, k]),
        )
        for i, serial in enumerate(serials)
        for k, term in enumerate(READING_TERMS)
    ] + [
        TorqueTermPart(
            serial=serial,
            term="scale",
            unit="",
            significant=bool(scale.sigma[i] > 0.0),
            value=float(scale.value[i]),
            sigma=float(scale.sigma[i]),
        )
        for i, serial in enumerate(serials)
    ]


def _bodies(robot: RobotBodies) -> BodiesPart | None:
    if robot.fit is None:
        return None
    return BodiesPart(
        bodies=[
            ModuleBodyPart(**dict(body_part(one)), serial=serial)
            for serial, one in zip(robot.serials, robot.bodies, strict=True)
        ],
        relative_error=robot.fit.error,
        least_squares_error=robot.fit.least_squares_error,
        prior_weight=robot.fit.weight,
        held_out_relative_error=robot.held_out_error,
    )


def _identifiability(robot: RobotBodies) -> list[IdentifiabilityPart]:
    return [
        IdentifiabilityPart(
            parameter=one.name,
            serial=robot.serials[k // PER_BODY],
            identifiability=one.kind,
            value=one.value,
            sigma=one.sigma,
            base_parameters=list(one.base_parameters),
        )
        for k, one in enumerate(robot.identifiabilities)
    ]


def _held_out(serials: tuple[str, ...], held_out: HeldOutMotion) -> HeldOutPart:
    error = held_out.error
    return HeldOutPart(
        relative_error=error.overall,
        relative_error_per_joint={
            s: e for s, e in zip(serials, error.per_joint.tolist(), strict=True) if e == e
        },
        mean_baseline=error.mean_overall,
        samples=len(held_out.session_ns),
    )
