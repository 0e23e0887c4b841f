"""Sections of a run's report on what was identified, from its `result.json`."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from coordinator.identification.result import DynamicsPart, LinkPart, MountingPart, Result
from coordinator.report.document import Block, Cell, Column, Figure, Paragraph, Section, Table
from coordinator.report.plots import torque_plot
from module_agent.model.chain import Array

# Half the width of a 95 % interval in standard deviations.
HALF_95 = 1.96
# Plots beyond this cost more than a report may; of the joints that fit worst.
MAX_TORQUE_PLOTS = 12


class HeldOutTorques(NamedTuple):
    """Torques of the held-out motions, columns as `serials`: t_s (m,), measured, predicted (m, n) [Nm]."""

    serials: tuple[str, ...]
    t_s: Array
    measured_nm: Array
    predicted_nm: Array


def result_sections(result: Result, held_out: HeldOutTorques | None) -> list[Section]:
    """Return what was identified, with intervals, and what cannot be known."""
    return [
        _topology(result),
        _links(result),
        _axes(result),
        _imus(result),
        _torques(result.dynamics, held_out),
        _unknown(result),
    ]


def sure_topology(result: Result) -> str:
    """Return how sure the topology is, as a sentence, and beyond which joints nothing is known of it."""
    sure = f"Topology: {100 * result.topology_confidence:.3f} % sure"
    held = [one.serial for one in result.topology if not one.joint_moved]
    if not held:
        return f"{sure}."
    if len(held) == 1:
        return f"{sure}, but not what {held[0]} carries: the joint did not move by itself."
    return f"{sure}, but not what {', '.join(held)} carry: the joints did not move by themselves."


def _topology(result: Result) -> Section:
    note = Paragraph(
        text="Log-odds of 4.6 are 99 %, 0 is undecided; a dash: there is no alternative. "
        f"{sure_topology(result)}"
    )
    columns = (
        Column(name="module"),
        Column(name="type"),
        Column(name="mounted on"),
        Column(name="log-odds of that", form=".1f"),
        Column(name="way round"),
        Column(name="log-odds of that", form=".1f"),
    )
    if result.topology:
        rows = [_mounting(result, one) for one in result.topology]
    else:
        parents = result.chain.parent
        rows = [
            (
                serial,
                result.types[serial],
                result.chain.serials[parents[k]] if parents[k] >= 0 else "the base",
                None,
                "reversed" if result.chain.reversed[k] else "forward",
                None,
            )
            for k, serial in enumerate(result.chain.serials)
        ]
    return Section(title="Topology", blocks=(note, Table.of("Which module is on which", columns, rows)))


def _mounting(result: Result, one: MountingPart) -> tuple[str | float | None, ...]:
    way = "reversed" if one.reversed else "forward"
    return (
        one.serial,
        result.types[one.serial],
        one.parent if one.parent is not None else "the base",
        one.parent_log_odds,
        way if one.joint_moved else f"{way}, its joint did not move",
        one.reversed_log_odds,
    )


def _links(result: Result) -> Section:
    lengths = Table.of(
        "Link lengths: from the parent's axis to the child's IMU, perpendicular, at q = 0",
        (
            Column(name="from"),
            Column(name="to"),
            Column(name="length", unit="mm", form=".2f"),
            Column(name="± 95 %", unit="mm", form=".2f"),
        ),
        [(link.parent, link.child, *_length(link)) for link in result.links],
    )
    names = result.transforms[0].parameters if result.transforms else []
    columns = [Column(name="from"), Column(name="to")]
    for name in names:
        quantity, _, unit = name.rpartition("_")
        group = f"{quantity} [{unit}]"
        columns += [
            Column(name="value", form=".2f", group=group),
            Column(name="± 95 %", form=".2f", group=group),
        ]
    rows: list[list[Cell]] = []
    for one in result.transforms:
        rows.append([one.parent, one.child])
        for value, sigma in zip(one.values, one.sigma, strict=True):
            rows[-1] += [value, _half_95(sigma)]
    poses = Table.of("Pose of the child's mounting face in the parent's moved face", columns, rows)
    dash = Paragraph(text="A dash: no motion tells this figure, or a part of it, see below.")
    if not result.links:
        return Section(title="Links", blocks=(Paragraph(text="A single module has no links."),))
    return Section(title="Links", blocks=(lengths, poses, dash))


def _length(link: LinkPart) -> tuple[float | None, float | None]:
    """Return a length and its interval; what stands for an unknown one is where the fit began."""
    sigma = link.link_length_sigma_mm
    return None if sigma is None else link.link_length_mm, _half_95(sigma)


def _half_95(sigma: float | None) -> float | None:
    return None if sigma is None else HALF_95 * sigma


def _axes(result: Result) -> Section:
    chain = result.chain
    sigmas = {
        one.serial: np.sqrt(np.maximum(np.diag(np.asarray(one.covariance))[:3], 0.0))
        for one in result.product_of_exponentials.screws
    }
    rows = []
    for k, serial in enumerate(chain.serials):
        half_deg = np.degrees(HALF_95 * float(sigmas[serial].max())) if serial in sigmas else None
        rows.append((serial, *chain.axis[k], half_deg, *(1e3 * float(x) for x in chain.point[k])))
    columns = (
        Column(name="joint"),
        *(Column(name=x, form=".5f", group="axis, root frame") for x in "xyz"),
        Column(name="± 95 %", unit="deg", form=".3f"),
        *(Column(name=x, unit="mm", form=".2f", group="a point on it") for x in "xyz"),
    )
    note = Paragraph(
        text="The root frame is that of the first module's housing at q = 0. The interval is the largest of "
        "the three components', of what can be known; it is zero where the frame is defined by the axis."
    )
    return Section(title="Axes", blocks=(note, Table.of("Axes of the joints at q = 0", columns, rows)))


def _imus(result: Result) -> Section:
    if not result.imu_places:
        text = Paragraph(text="This result does not estimate where IMUs sit in their housings.")
        return Section(title="IMUs", blocks=(text,))
    kinds = (("turned", "deg", ".3f", float(np.degrees(1.0))), ("displaced", "mm", ".2f", 1e3))
    columns = [Column(name="module")]
    for what, unit, form, _ in kinds:
        for axis in "xyz":
            group = f"{what} {axis} [{unit}]"
            columns += [Column(name=name, form=form, group=group) for name in ("value", "± 95 %")]
    rows: list[list[Cell]] = []
    for one in result.imu_places:
        sigma = np.sqrt(np.maximum(np.diag(np.asarray(one.covariance)), 0.0))
        rows.append([one.serial])
        for k, value in enumerate((*one.turn_rad, *one.displacement_m)):
            scale = kinds[k // 3][3]
            rows[-1] += [scale * value, HALF_95 * scale * float(sigma[k])]
    note = Paragraph(
        text="Against the place in the catalogue, in the IMU's own axes. Where an interval is as wide as the "
        "catalogue's, as in most single runs, the run tells nothing about this direction."
    )
    return Section(title="IMUs", blocks=(note, Table.of("Places of the IMUs", columns, rows)))


# ---------------------------------------------------------------------- torques, and what is not known


def _torques(dynamics: DynamicsPart | None, held_out: HeldOutTorques | None) -> Section:
    if dynamics is None:
        text = "Inertial parameters were not identified."
        return Section(title="Torques", blocks=(Paragraph(text=text),))
    check = dynamics.held_out
    own = check.relative_error_per_joint if check is not None else {}
    levels: dict[str, tuple[float | None, float | None]] = {}
    if held_out is not None:
        error = held_out.measured_nm - held_out.predicted_nm
        for k, serial in enumerate(held_out.serials):
            levels[serial] = (_rms(held_out.measured_nm[:, k]), _rms(error[:, k]))
    rows = [
        (
            serial,
            residual,
            *levels.get(serial, (None, None)),
            100.0 * own[serial] if own.get(serial) is not None else None,
        )
        for serial, residual in dynamics.residual_rms_nm.items()
    ]
    columns = (
        Column(name="joint"),
        Column(name="residual, rms", unit="Nm", group="fitted motions", form=".4f"),
        Column(name="torque, rms", unit="Nm", group="held-out motions", form=".4f"),
        Column(name="residual, rms", unit="Nm", group="held-out motions", form=".4f"),
        Column(name="residual / torque", unit="%", group="held-out motions", form=".2f"),
    )
    blocks: list[Block] = [
        Paragraph(
            text="Nothing was fitted to the held-out motions. A joint that carries almost no torque has a "
            "large relative residual; its absolute one says how well it is known."
        ),
        Table.of("Torque residuals", columns, rows),
    ]
    blocks += _torque_figures(held_out)
    return Section(title="Torques", blocks=tuple(blocks))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _torque_figures(held_out: HeldOutTorques | None) -> Iterator[Block]:
    if held_out is None:
        yield Paragraph(
            text="There are no held-out motions to compare with, or a sensor or joint failed in them."
        )
        return
    residual = np.sqrt(np.mean((held_out.measured_nm - held_out.predicted_nm) ** 2, axis=0))
    drawn = sorted(np.argsort(-residual)[:MAX_TORQUE_PLOTS])
    if len(drawn) < len(held_out.serials):
        yield Paragraph(
            text=f"Drawn are the {len(drawn)} of {len(held_out.serials)} joints with the largest residuals."
        )
    for k in drawn:
        serial = held_out.serials[k]
        yield Figure(
            caption=f"{serial}: torque on held-out motions, residual {residual[k]:.3g} Nm rms.",
            alt=f"Measured and predicted torque of {serial} over time, with the residual below",
            svg=torque_plot(held_out.t_s, held_out.measured_nm[:, k], held_out.predicted_nm[:, k]),
        )


def _unknown(result: Result) -> Section:
    blocks: list[Block] = []
    if result.unresolved:
        kinds: dict[tuple[str, str, str], list[str]] = {}
        for one in result.unresolved:
            names = [f"{link.parent} – {link.child}: {', '.join(link.parameters)}" for link in one.links]
            what = one.summary.split(". What would tell it")[0].split(": ", 1)[-1] if names else one.summary
            kinds.setdefault((one.joint, what, one.resolved_by or "–"), []).extend(names or [one.joint])
        rows = [(joint, what, "; ".join(names), remedy) for (joint, what, remedy), names in kinds.items()]
        heads = ("joint", "what cannot be known", "parameters of links", "what would tell it")
        columns = [Column(name=name) for name in heads]
        blocks.append(Table.of("Displacements of the chain that leave every reading the same", columns, rows))
    else:
        blocks.append(Paragraph(text="All parameters of the chain are determined."))
    if result.dynamics is not None:
        blocks += _unknown_inertia(result.dynamics)
    return Section(title="What cannot be known", blocks=tuple(blocks))


def _unknown_inertia(dynamics: DynamicsPart) -> Iterator[Block]:
    parts: dict[str, dict[str, list[str]]] = {}
    for one in dynamics.identifiability:
        kind = one.identifiability
        if kind == "not identifiable" and one.base_parameters:
            kind = "combination"
        parts.setdefault(one.serial, {}).setdefault(kind, []).append(one.parameter)
    kinds = ("identified", "weak", "combination", "not identifiable")
    rows = [
        (serial, *(", ".join(own.get(kind, ())) or None for kind in kinds)) for serial, own in parts.items()
    ]
    if rows:
        heads = (
            "body of",
            "identified within 10 %",
            "weakly",
            "only in combinations",
            "without effect on torques",
        )
        yield Table.of("Inertial parameters by torques alone", [Column(name=name) for name in heads], rows)
        yield Paragraph(
            text="What torques do not determine has no influence on the torques that were measured. In "
            "robot.urdf it has the value of the module type's catalogue; other poses, a tilted base or "
            "faster motions of several joints at once tell more of it."
        )
