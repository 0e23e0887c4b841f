"""The report of a recording as tables for the terminal, and as a page."""

from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from coordinator.arm_fit.payload import MAX_INCONSISTENCY_SIGMA
from coordinator.arm_fit.predictions import Predictions
from coordinator.arm_fit.report import ErrorPart, FitReport, Model, PayloadPart, TermPart
from coordinator.parameter_fit.payload import EXPLAINED_BELOW
from coordinator.report import document
from coordinator.report.document import Document, Figure, Section
from coordinator.report.plots import torque_plot
from coordinator.runtime.terminal import figure, new_table

_MODEL_WORDS: dict[Model, str] = {
    "fitted": "least squares",
    "bodies": "consistent bodies near the URDF's",
    "fitted_urdf": "the fitted URDF alone",
    "urdf": "the given URDF alone",
    "drives_only": "friction and motors only",
    "mean": "constant mean",
}
_KINDS = (("filtered", "all"), ("filtered", "masked"), ("raw", "all"), ("raw", "masked"))


def tables(report: FitReport) -> Iterator[Table]:
    """Yield the tables, the most important first."""
    if report.payload:
        yield _payload(report.payload)
    yield _held_out(report)
    yield _joints(report)
    yield _lengths(report)
    if report.fit.drives:
        yield _gains(report)
        yield _drives(report)
    yield _base(report)
    yield _bodies(report)


def page(report: FitReport, torques: Predictions) -> Document:
    """Return a document with the notes, a plot of each joint's torque and the tables.

    Raises:
        MissingPlots: matplotlib is not installed.
    """
    plots = [
        Figure(
            caption=f"{joint}: torque, and its prediction by the half that was not fitted to.",
            alt=f"Measured and predicted torque of {joint} over time, with the residual below",
            svg=torque_plot(torques.t_s, torques.tau_nm[:, k], torques.held_out_nm[:, k]),
        )
        for k, joint in enumerate(torques.joints)
    ]
    return Document(
        title=report.data,
        subtitle="Dynamics of the arm, fitted to recorded torques",
        sections=(
            Section(title="Recording and fit", blocks=(document.Bullets(items=tuple(notes(report))),)),
            Section(title="Torques", blocks=tuple(plots)),
            Section(title="Results", blocks=tuple(map(_document_table, tables(report)))),
        ),
    )


def _document_table(table: Table) -> document.Table:
    """Return a table of the terminal as one of a document."""
    heads = [Text.from_markup(str(column.header)).plain for column in table.columns]
    cells = [[Text.from_markup(str(cell)).plain for cell in column.cells] for column in table.columns]
    right = [column.justify == "right" for column in table.columns]
    columns = [document.Column(name=head, right=end) for head, end in zip(heads, right, strict=True)]
    caption = Text.from_markup(str(table.title or "")).plain
    return document.Table.of(caption, columns, list(zip(*cells, strict=True)))


def notes(report: FitReport) -> Iterator[str]:
    """Yield sentences about the recording, the filter and the fit."""
    data, fit = report.recording, report.fit
    evened = ", whose times were uneven" if data.resampled else ""
    yield (
        f"{data.duration_s:.2f} s at {data.recorded_hz:.6g} Hz{evened}; low-pass at {data.cutoff_hz:.3g} Hz, "
        f"{data.samples} samples kept at {data.kept_hz:.4g} Hz"
    )
    if data.repeated_rows:
        yield f"{data.repeated_rows} rows repeat the one before them and were left out"
    if data.bridged_holes:
        yield f"{data.bridged_holes} holes of up to 10 ms were interpolated"
    if data.pieces > 1:
        yield f"{data.pieces} pieces between holes or recordings; too short to filter: {data.dropped_s:.2f} s"
    for joint, position in data.held.items():
        yield f"{joint} is held at {position:.4g}: it does not move, slides or mimics; its torque is not used"
    if data.cutoff_curve:
        curve = ", ".join(f"{p.cutoff_hz:.3g} Hz {_percent(p.raw)} %" for p in data.cutoff_curve)
        yield f"low-pass chosen by the raw error of halves predicted by each other: {curve}"
    yield (
        f"the low-pass takes {_percent(data.noise)} % of the torque away, which is in every error called raw"
    )
    yield (
        f"rank {fit.rank} of {fit.parameters} parameters, condition {fit.condition:.3g}; "
        f"{fit.independent_samples:.0f} independent samples"
    )
    for trial in report.trials:
        if trial.after is not None:
            yield (
                f"{trial.name} is significant and {'kept' if trial.kept else 'left out'}: held-out error of "
                f"{trial.joint} {_percent(trial.before)} % without it, {_percent(trial.after)} % with it"
            )
    if fit.not_in_urdf:
        yield f"a URDF has no place for {', '.join(fit.not_in_urdf)}; the fitted URDF alone is without them"
    if report.payload:
        yield from _payload_notes(report.payload)
    for part in report.torque_factors:
        if part.factor is not None and part.sigma is not None:
            by = f"{part.factor:.4g} +- {part.sigma:.2g}"
            yield f"readings of {part.joint} were multiplied by {by}, which the known payload determines"
        else:
            why = (
                "does not load it"
                if part.sigma is None
                else f"determines its factor to {part.sigma:.2g} only"
            )
            yield f"readings of {part.joint} are as recorded: the known payload {why}"
    if fit.bodies_note:
        yield f"no physically consistent bodies: {fit.bodies_note}"


def _payload_notes(part: PayloadPart) -> Iterator[str]:
    if part.undetermined:
        yield f"payload: the torques do not determine {', '.join(part.undetermined)}"
    if part.mass_kg is not None and part.com_m == [None, None, None]:
        yield "payload: its mass is within three sigmas of zero; it has no centre"
    if part.misfit > EXPLAINED_BELOW:
        yield (
            f"payload: {part.misfit:.3g} variances per degree of freedom are left; more than a payload on "
            f"{part.link} has changed since {part.baseline}"
        )
    if part.inconsistency_sigma > MAX_INCONSISTENCY_SIGMA:
        yield (
            "payload: the estimate is no physically consistent body; the nearest one explains the torques "
            f"worse by {part.inconsistency_sigma:.1f} sigmas"
        )


def _payload(part: PayloadPart) -> Table:
    table = _table(
        f"Payload since {part.baseline}, in the frame of {part.link}; the inertia about its centre",
        ("",),
        ("value", "+-", "unit", "consistent body"),
    )
    body = part.rigid_body
    mass = figure(part.mass_kg, ".4g"), figure(part.mass_sigma_kg, ".2g")
    table.add_row("mass", *mass, "kg", f"{body.mass_kg:.4g}")
    for k, x in enumerate("xyz"):
        value, sigma = (None if three is None else three[k] for three in (part.com_m, part.com_sigma_m))
        table.add_row(f"centre {x}", figure(value, ".4g"), figure(sigma, ".2g"), "m", f"{body.com_m[k]:.4g}")
    for i, k in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        value, sigma = (
            None if matrix is None else matrix[i][k]
            for matrix in (part.inertia_kg_m2, part.inertia_sigma_kg_m2)
        )
        table.add_row(
            f"inertia {'xyz'[i]}{'xyz'[k]}",
            figure(value, ".4g"),
            figure(sigma, ".2g"),
            "kg m^2",
            f"{body.inertia_kg_m2[i][k]:.4g}",
        )
    return table


def _held_out(report: FitReport) -> Table:
    table = _table(
        "Held-out torque error |e| / |tau| [%]: fitted to one half, tried on the other"
        + (", and to the whole" if report.held_out_data else ""),
        ("model", "tried on"),
        [f"{torque}, {samples}" for torque, samples in _KINDS],
    )
    for model in report.models():
        for tried_on in dict.fromkeys(e.tried_on for e in report.errors(model)):
            errors = [_error(report, model, tried_on, *kind).overall for kind in _KINDS]
            table.add_row(_MODEL_WORDS[model], tried_on, *(_percent(error) for error in errors))
        table.add_section()
    return table


def _joints(report: FitReport) -> Table:
    baselines = [model for model in report.models() if model != "fitted"]
    kinds = [f"{torque}, {samples}" for torque, samples in _KINDS]
    table = _table(
        "The same joint by joint, both halves; the baselines filtered, all samples",
        ("joint",),
        [*kinds, *(_MODEL_WORDS[model] for model in baselines), "noise", "correlated"],
    )
    for i, residual in enumerate(report.fit.residuals):
        fitted = [_both(report, "fitted", *kind).per_joint[i] for kind in _KINDS]
        others = [_both(report, model, "filtered", "all").per_joint[i] for model in baselines]
        cells = [_percent(error) for error in [*fitted, *others]]
        table.add_row(residual.joint, *cells, f"{residual.sigma_nm:.3g} Nm", f"{residual.correlation:.1f}")
    table.caption = "correlated: so many samples of the residual count as one"
    return table


def _lengths(report: FitReport) -> Table:
    table = _table("Held-out error [%] by the length fitted to", (), ("seconds", "all", "masked"))
    for point in report.lengths:
        table.add_row(f"{point.seconds:.2f}", _percent(point.all), _percent(point.masked))
    return table


def _gains(report: FitReport) -> Table:
    table = _table("Held-out error [%] without a kind of term", ("without",), ("all", "masked", ""))
    whole = [_both(report, "fitted", "filtered", samples).overall for samples in ("all", "masked")]
    table.add_row("nothing", *(_percent(error) for error in whole), "")
    for gain in report.gains:
        worse = whole[0] is not None and gain.all > whole[0]
        table.add_row(
            gain.without, _percent(gain.all), _percent(gain.masked), "needed" if worse else "not needed"
        )
    return table


def _drives(report: FitReport) -> Table:
    table = _table(
        "Drives: F-test of each parameter, with the number of independent residuals",
        ("parameter", "joint"),
        ("value", "+-", "unit", "F", "chance", ""),
    )
    for part in report.fit.drives:
        table.add_row(
            part.name,
            ", ".join(part.joints),
            f"{part.value:.4g}",
            f"{part.sigma:.2g}",
            part.unit,
            f"{part.f:.1f}",
            f"{part.chance:.1g}",
            _place(part),
        )
    return table


def _base(report: FitReport) -> Table:
    table = _table(
        "Base parameters that the torques determine, bodies in the frames of the URDF's links",
        ("base parameter",),
        ("value", "+-", "+- [%]", "URDF", ""),
    )
    drives = [part.name for part in report.fit.drives]
    for part in report.fit.base_parameters:
        if part.summary in drives:
            continue
        table.add_row(
            part.summary,
            f"{part.value:.4g}",
            f"{part.sigma:.2g}",
            _percent(part.relative_sigma),
            figure(part.urdf, ".4g"),
            part.identifiability,
        )
    return table


def _bodies(report: FitReport) -> Table:
    table = _table("Body by body", ("body", "turned by", "its parameters"), ("mass [kg]", "URDF"))
    for i, part in enumerate(report.fit.bodies, start=1):
        own = part.rigid_body.mass_kg if part.rigid_body else None
        masses = [figure(mass, ".3g") for mass in (own, part.urdf_mass_kg)]
        table.add_row(f"{i}: {part.link}", part.joint, part.summary, *masses)
    return table


def _both(report: FitReport, model: Model, torque: str, samples: str) -> ErrorPart:
    return _error(report, model, "both", torque, samples)


def _error(report: FitReport, model: Model, tried_on: str, torque: str, samples: str) -> ErrorPart:
    return next(e for e in report.errors(model, torque) if (e.tried_on, e.samples) == (tried_on, samples))


def _place(part: TermPart) -> str:
    if part.lumped_with:
        return "within the inertias"
    return "significant" if part.significant else "not significant"


def _percent(part: float | None) -> str:
    if part is None:
        return "-"
    # Beyond tenfold the figure says no more than that.
    return f"{100.0 * part:.1f}" if part < 10.0 else "> 1000"


def _table(title: str, words: tuple[str, ...], figures: "list[str] | tuple[str, ...]") -> Table:
    return new_table(title, " | ".join([*words, *(f">{name}" for name in figures)]))
