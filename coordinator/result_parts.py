"""Putting what was identified into the schema of `result.json`."""

from typing import TYPE_CHECKING

from coordinator.kinematics.denavit_hartenberg import dh_paths
from coordinator.recording import Recording
from coordinator.result import (
    DhPart,
    DhRowPart,
    DynamicsPart,
    HeldOutPart,
    LinkPart,
    PairPart,
    Result,
    UnresolvedPart,
    chain_part,
)

if TYPE_CHECKING:
    from coordinator.dynamics.identification import InertialFit
    from coordinator.identify import HeldOutMotion, Kinematics


def build_result(
    recording: Recording,
    kinematics: "Kinematics",
    inertia: "InertialFit | None",
    held_out: "HeldOutMotion | None",
) -> Result:
    """Return the result of a session."""
    fit, topology = kinematics.fit, kinematics.topology
    times = [e.t_ns for e in recording.journal]
    began = [e for e in recording.journal if e.what == "session"]
    finished = [e for e in recording.journal if e.what == "finished"]
    return Result(
        robot=began[-1].robot if began else "",
        serials=list(topology.serials),
        types={s: _type_name(recording, s) for s in topology.serials},
        topology_confidence=topology.confidence,
        chain=chain_part(fit.chain),
        rank=fit.rank,
        condition=fit.condition,
        reduced_chi2=fit.reduced_chi2,
        unresolved=[
            UnresolvedPart(
                kind=u.kind, joint=u.joint, modules=list(u.modules), words=f"{u.text} ({u.resolved_by})"
            )
            for u in fit.unresolved
        ],
        null_basis=fit.null_basis.tolist(),
        links=_links(kinematics),
        pairs=_pairs(recording),
        denavit_hartenberg=_dh(kinematics),
        dynamics=_dynamics(kinematics, inertia, held_out),
        notes=list(kinematics.notes),
        robot_time_s=(max(times) - min(times)) / 1e9 if times else 0.0,
        wall_time_s=finished[-1].wall_time_s if finished else None,
        trace_hash=recording.trace_hash,
    )


def _type_name(recording: Recording, serial: str) -> str:
    info = recording.modules[serial].info
    return info.module_type if info is not None else "unknown"


def _links(kinematics: "Kinematics") -> list[LinkPart]:
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


def _pairs(recording: Recording) -> list[PairPart]:
    parts = []
    for (joint, observer), found in sorted(recording.estimates.items()):
        estimate = list(found.values())[-1]
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


def _dh(kinematics: "Kinematics") -> list[DhPart]:
    return [
        DhPart(base=path.base.tolist(), rows=[DhRowPart(**row._asdict()) for row in path.rows])
        for path in dh_paths(kinematics.fit.chain)
    ]


def _dynamics(
    kinematics: "Kinematics", inertia: "InertialFit | None", held_out: "HeldOutMotion | None"
) -> DynamicsPart | None:
    if inertia is None:
        return None
    serials = kinematics.topology.serials
    return DynamicsPart(
        phi=inertia.phi.tolist(),
        rank=inertia.rank,
        parameters=len(inertia.phi),
        condition=inertia.condition,
        sigma=(inertia.covariance.diagonal() ** 0.5).tolist(),
        identifiable=inertia.identifiable.tolist(),
        residual_rms_nm=dict(zip(serials, inertia.residual_rms_nm.tolist(), strict=True)),
        held_out=_held_out(serials, held_out) if held_out is not None else None,
    )


def _held_out(serials: tuple[str, ...], held_out: "HeldOutMotion") -> HeldOutPart:
    error = held_out.error
    return HeldOutPart(
        relative_error=error.overall,
        relative_error_per_joint={
            s: e for s, e in zip(serials, error.per_joint.tolist(), strict=True) if e == e
        },
        mean_baseline=error.mean_overall,
        samples=len(held_out.session_ns),
    )
