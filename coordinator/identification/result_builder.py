"""The result of an identification in the schema of `result.json`."""

import numpy as np

from coordinator.description.denavit_hartenberg import dh_paths
from coordinator.description.link_transforms import PARAMETERS, link_transforms
from coordinator.description.product_of_exponentials import screw_model
from coordinator.identification.identified import HeldOutMotion, Kinematics
from coordinator.identification.inertia.inertia import Inertia
from coordinator.identification.inertia.robot_bodies import RobotBodies
from coordinator.identification.result import (
    BodiesPart,
    ChainPart,
    DelayPart,
    DhPart,
    DhRowPart,
    DynamicsPart,
    ExponentialsPart,
    HeldOutPart,
    IdentifiabilityPart,
    LinkPart,
    LossPart,
    ModuleBodyPart,
    MountingPart,
    PairPart,
    Result,
    ScrewPart,
    SensorPart,
    TipPart,
    TorqueTermPart,
    TransformPart,
    UnknownPart,
    UnresolvedPart,
)
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.null_space import Unresolved
from coordinator.parameter_fit.instrumental_variables import InstrumentalFit
from coordinator.parameter_fit.report_parts import base_parameter_parts, finite, imu_place_parts
from coordinator.recording.journal import exclusion_notes
from coordinator.recording.recording import Recording
from coordinator.synchronisation.feedback_delays import feedback_delays
from coordinator.topology.topology import Topology
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array
from module_agent.model.regressor import PER_BODY
from module_agent.signals.torque_terms import READING_TERMS, TERM_KINDS


def build_result(
    recording: Recording,
    kinematics: Kinematics,
    inertia: Inertia | None,
    held_out: HeldOutMotion | None,
    bodies: RobotBodies | None,
) -> Result:
    """Return the result of a session; without dynamic motions there are neither inertia nor bodies."""
    fit, topology = kinematics.fit, kinematics.topology
    types = [recording.module_type(s) for s in topology.serials]
    times = [e.t_ns for e in recording.journal]
    began = [e for e in recording.journal if e.what == "session"]
    finished = [e for e in recording.journal if e.what == "finished"]
    notes = [
        *exclusion_notes(recording.journal),
        bodies.note if bodies is not None else "",
        inertia.gathered.note if inertia is not None and inertia.gathered is not None else "",
    ]
    return Result(
        robot=began[-1].robot if began else "",
        serials=list(topology.serials),
        types={s: kind.name for s, kind in zip(topology.serials, types, strict=True)},
        topology_confidence=topology.confidence,
        topology=_mountings(topology),
        chain=ChainPart(**fit.chain.to_dict()),
        rank=fit.rank,
        condition=finite(fit.condition),
        reduced_chi2=finite(kinematics.first.reduced_chi2),
        unresolved=[_unresolved(fit, types, u) for u in fit.unresolved],
        null_basis=fit.null_basis.tolist(),
        chain_covariance=fit.covariance.tolist(),
        links=_links(fit),
        transforms=_transforms(fit, types),
        product_of_exponentials=_exponentials(fit, types),
        pairs=_pairs(recording),
        denavit_hartenberg=[
            DhPart.of(path, rows=[DhRowPart.of(row) for row in path.rows]) for path in dh_paths(fit.chain)
        ],
        dynamics=_dynamics(inertia, held_out, bodies) if inertia is not None and bodies is not None else None,
        notes=list(dict.fromkeys([*kinematics.notes, *filter(None, notes), *recording.remarks])),
        imu_places=imu_place_parts(kinematics.refinement.calibration),
        sensors=[SensorPart.of(one, summary=one.summary) for one in kinematics.findings],
        excluded=list(kinematics.excluded),
        suspicions=kinematics.suspicions,
        feedback_delays=[DelayPart(**one._asdict()) for one in feedback_delays(recording)],
        feedback_losses=[
            LossPart(**module.loss._asdict()) for _, module in sorted(recording.modules.items())
        ],
        robot_time_s=(max(times) - min(times)) / 1e9 if times else 0.0,
        wall_time_s=finished[-1].wall_time_s if finished else None,
        cpu_us_per_message=finished[-1].cpu_us_per_message if finished else None,
        trace_hash=recording.trace_hash,
    )


def _mountings(topology: Topology) -> list[MountingPart]:
    if not topology.parent_log_odds:
        return []
    return [
        MountingPart(
            serial=serial,
            parent=topology.serials[parent] if parent >= 0 else None,
            parent_log_odds=finite(topology.parent_log_odds[k]),
            reversed=topology.reversed[k],
            reversed_log_odds=topology.reversed_log_odds[k],
            joint_moved=serial not in topology.unmoved,
        )
        for k, (serial, parent) in enumerate(zip(topology.serials, topology.parent, strict=True))
    ]


def _links(fit: ChainEstimate) -> list[LinkPart]:
    chain = fit.chain
    return [
        LinkPart(
            parent=chain.serials[chain.parent[k]],
            child=chain.serials[k],
            link_length_mm=1e3 * float(fit.link_length_m[k]),
            link_length_sigma_mm=finite(1e3 * float(fit.link_length_sigma_m[k])),
        )
        for k in chain.linked
    ]


def _unresolved(fit: ChainEstimate, types: list[ModuleType], item: Unresolved) -> UnresolvedPart:
    """Describe which parameters of which links are unresolved, why, and what would resolve them."""
    transforms = link_transforms(fit.chain, types, np.zeros_like(fit.covariance), _columns(item))
    links = [
        UnknownPart.of(
            link, parameters=[p for p, unknown in zip(PARAMETERS, link.unknown, strict=True) if unknown]
        )
        for link in transforms
        if any(link.unknown)
    ]
    short = [", ".join(name.split("_")[0] for name in link.parameters) for link in links]
    of = [f"{names} of the link {p.parent} - {p.child}" for names, p in zip(short, links, strict=True)]
    count = item.directions.shape[1]
    named = sum(map(len, (link.parameters for link in links)))
    # One unknown rotation shows in several parameters, whose other combinations are known.
    together = (
        f" ({count} {'combination' if count == 1 else 'combinations'} of them)" if named > count else ""
    )
    where = f"{' and '.join(of)}{together}: " if of else ""
    summary = f"{where}{item.text}. What would tell it: {item.resolved_by}"
    return UnresolvedPart.of(item, summary=summary, links=links)


def _columns(item: Unresolved) -> Array:
    return np.asarray(item.directions / np.linalg.norm(item.directions, axis=0))


def _transforms(fit: ChainEstimate, types: list[ModuleType]) -> list[TransformPart]:
    # The named gauge freedoms, not the null vectors of the fit, which are mixed and affected by its noise.
    no_directions = np.zeros((len(fit.covariance), 0))
    hidden = np.concatenate([no_directions, *(_columns(item) for item in fit.unresolved)], axis=1)
    parts = []
    for link in link_transforms(fit.chain, types, fit.covariance, hidden):
        sigmas = zip(np.sqrt(link.covariance.diagonal()).tolist(), link.unknown, strict=True)
        known = [None if unknown else sigma for sigma, unknown in sigmas]
        parts.append(TransformPart.of(link, parameters=list(PARAMETERS), sigma=known))
    return parts


def _exponentials(fit: ChainEstimate, types: list[ModuleType]) -> ExponentialsPart:
    model = screw_model(fit.chain, types, fit.covariance)
    screws = zip(model.serials, model.screws.tolist(), model.covariance.tolist(), strict=True)
    return ExponentialsPart(
        screws=[ScrewPart(serial=s, screw=screw, covariance=spread) for s, screw, spread in screws],
        tips=[TipPart.of(tip) for tip in model.tips],
    )


def _pairs(recording: Recording) -> list[PairPart]:
    parts = []
    for (_, observer), estimates in sorted(recording.estimates.items()):
        estimate = list(estimates.values())[-1]
        fit = estimate.best
        parts.append(
            PairPart.of(
                estimate,
                observer=observer,
                distance_mm=1e3 * fit.distance_m if fit else None,
                distance_sigma_mm=1e3 * fit.sigma_distance_m if fit else None,
                axis=fit.axis if fit else None,
            )
        )
    return parts


def _dynamics(inertia: Inertia, held_out: HeldOutMotion | None, bodies: RobotBodies) -> DynamicsPart:
    serials, fit, gathered = bodies.serials, inertia.instrumental.fit, inertia.gathered
    by_agents = gathered.by_agents if gathered is not None else ()
    by_all = "agents" if len(by_agents) == len(serials) else "both"

    def by_joint(values: Array) -> dict[str, float]:
        return dict(zip(serials, values.tolist(), strict=True))

    return DynamicsPart.of(
        fit,
        parameters=len(fit.phi),
        sigma=(fit.covariance.diagonal() ** 0.5).tolist(),
        residual_rms_nm=by_joint(fit.residual_rms_nm),
        held_out=None if held_out is None else _held_out(held_out, by_joint(held_out.error.per_joint)),
        bodies=_bodies(bodies),
        base_parameters=base_parameter_parts(bodies.base),
        identifiability=_identifiability(bodies),
        summary=bodies.summary(),
        frames=bodies.frames.tolist(),
        motion_source=inertia.motion_source,
        gathered_by=by_all if by_agents else "coordinator",
        by_agents=by_agents,
        gathered_difference=gathered.difference if gathered is not None else None,
        noise_nm={source: by_joint(noise) for source, noise in inertia.noise_nm.items()},
        torque_terms=_torque_terms(serials, inertia.instrumental),
    )


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
            serial=serial, term="scale", unit="", significant=sigma > 0.0, value=value, sigma=sigma
        )
        for serial, value, sigma in zip(serials, scale.value.tolist(), scale.sigma.tolist(), strict=True)
    ]


def _bodies(robot: RobotBodies) -> BodiesPart | None:
    if robot.fit is None:
        return None
    sigma = np.sqrt(np.diagonal(robot.fit.covariance))[::PER_BODY].tolist()
    return BodiesPart.of(
        robot.fit,
        bodies=[
            ModuleBodyPart.of(one, serial=serial, mass_sigma_kg=own)
            for serial, one, own in zip(robot.serials, robot.bodies, sigma, strict=True)
        ],
        relative_error=robot.fit.error,
        prior_weight=robot.fit.weight,
        held_out_relative_error=robot.held_out_error,
    )


def _identifiability(robot: RobotBodies) -> list[IdentifiabilityPart]:
    return [
        IdentifiabilityPart.of(
            one, parameter=one.name, serial=robot.serials[k // PER_BODY], identifiability=one.kind
        )
        for k, one in enumerate(robot.identifiabilities)
    ]


def _held_out(held_out: HeldOutMotion, per_joint: dict[str, float]) -> HeldOutPart:
    return HeldOutPart(
        relative_error=held_out.error.overall,
        relative_error_per_joint={s: error for s, error in per_joint.items() if error == error},
        mean_baseline=held_out.error.mean_overall,
        samples=len(held_out.session_ns),
        torque_rms_nm=float(np.sqrt(np.mean(held_out.tau_measured_nm**2))),
    )
