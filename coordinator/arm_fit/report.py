"""The report of fit-dynamics in a versioned schema; written whole or not at all."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from coordinator.parameter_fit.identifiability import Precision
from coordinator.parameter_fit.report_parts import BaseParameterPart, BodyPart, Part, Triple
from module_agent.model.files import write_json

SCHEMA = 3

Model = Literal["fitted", "bodies", "fitted_urdf", "urdf", "drives_only", "mean"]


class CutoffPart(Part):
    """The held-out errors, both ways together, all samples, behind a low-pass: filtered and raw torque."""

    cutoff_hz: float
    filtered: float
    raw: float


class DataPart(Part):
    """The recording, and how it was filtered.

    repeated_rows: rows like the one before, left out. bridged_holes: of up to 10 ms, interpolated. pieces:
    parts between longer holes; dropped_s: time in those that are too short for the low-pass. held: joints
    that are taken as fixed at a position [rad, m]. cutoff_curve: what the low-pass was chosen by, empty if it
    was given.
    noise: |raw - filtered| / |raw| of the torque, which no model of this bandwidth can predict. mask_rad_s:
    per joint the speed below which a sample is masked, and not fitted to.
    """

    joints: list[str]
    duration_s: float
    recorded_hz: float
    resampled: bool
    repeated_rows: int
    bridged_holes: int
    pieces: int
    held: dict[str, float]
    dropped_s: float
    cutoff_curve: list[CutoffPart]
    cutoff_hz: float
    kept_hz: float
    samples: int
    noise: float
    mask_rad_s: list[float]


class ErrorPart(Part):
    """A relative torque error |e| / |tau| on samples that were not fitted to; null where |tau| is zero.

    model: `fitted` (least squares), `bodies` (physically consistent bodies near the URDF's, and drives),
    `fitted_urdf` (what a URDF holds of these: see `not_in_urdf`), `urdf` (the given one), `drives_only`
    (friction, offset and motors without bodies), `mean` (the constant mean of the other half).
    """

    model: Model
    tried_on: Literal["second half", "first half", "both", "other recording"]
    torque: Literal["filtered", "raw"]
    samples: Literal["all", "masked"]
    overall: float | None
    per_joint: list[float | None]


class LengthPart(Part):
    """The held-out error, both ways together, filtered, after fitting to `seconds` of a half."""

    seconds: float
    all: float
    masked: float


class TermGainPart(Part):
    """The held-out error, both ways together, filtered, of the model without something."""

    without: str
    all: float
    masked: float


class TrialPart(Part):
    """A term of one joint that was tried, or a drive that two share, by its most significant term.

    joint: the last of two. f, chance: as in `TermPart`, before the choice. before, after: the joint's
    held-out error without and with it, filtered, all samples; after is null if it was not significant.
    """

    name: str
    joint: str
    f: float
    chance: float
    before: float
    after: float | None
    kept: bool


class TermPart(Part):
    """A parameter of a drive, and whether it is significant.

    f: (value / sigma)^2, the F-test of the model without it; only `independent_samples` of the residuals
    count. chance: the probability of an F as large if the parameter were zero. lumped_with: the bodies'
    parameters that are only determined in combination with it; then the test is of all of them together.
    with_bodies: the value next to the physically consistent bodies, where the URDF's divide combinations.
    """

    name: str
    term: str
    joints: list[str]
    unit: str
    value: float
    sigma: float
    with_bodies: float | None
    f: float
    chance: float
    significant: bool
    lumped_with: str


class ArmParameterPart(BaseParameterPart):
    """A base parameter, compared with the URDF.

    Bodies are numbered as the joints are, their frames are those of the URDF's links behind the joints, and
    their inertias are about the frames' origins. urdf: the value by the URDF, without the drives; null if
    only drives are in it. identifiability: `identified` with a standard deviation of up to a tenth of the
    value, `weak` up to the value.
    """

    urdf: float | None
    identifiability: Precision


class LinkBodyPart(Part):
    """A body: the link right behind a joint and all links that are fixed to it, in the link's frame.

    summary: which of its parameters are identified, weak, known only in combinations, or without effect.
    rigid_body: the physically consistent body that explains the torques, as in the URDF where these do not
    determine it; null if none were fitted. urdf_mass_kg: the mass by the URDF.
    """

    link: str
    joint: str
    summary: str
    rigid_body: BodyPart | None
    urdf_mass_kg: float | None


class JointNoisePart(Part):
    """The residual of a joint: its noise, samples that count as one, samples that were fitted.

    downweighted: the fraction of them that a robust fit takes for outliers.
    """

    joint: str
    sigma_nm: float
    correlation: float
    samples: int
    downweighted: float


class FitPart(Part):
    """The fit to the whole recording: rank and condition of the weighted regressor, parameters, residuals.

    bodies_note: why there are no physically consistent bodies, if there are none. not_in_urdf: the drives'
    parameters that a URDF has no place for. robust: by Huber's
    weights. instruments: by instrumental variables (`fit_weighted`).
    """

    parameters: int
    rank: int
    condition: float
    robust: bool
    instruments: bool
    terms: list[str]
    coupled: list[list[str]]
    independent_samples: float
    base_parameters: list[ArmParameterPart]
    bodies: list[LinkBodyPart]
    bodies_note: str
    not_in_urdf: list[str]
    drives: list[TermPart]
    residuals: list[JointNoisePart]


class JointPlacePart(Part):
    """A joint at q = 0 in the root frame: the link behind it, that link's origin, and the axis (unit)."""

    joint: str
    link: str
    origin_m: Triple
    axis: Triple


class InformationPart(Part):
    """What the torques say of bodies and rotors, as square-root information: rows @ x = target, whitened.

    The drives' other parameters (friction, offsets) are marginalised. columns: p names, the bodies' in the
    root frame. rows: r * p, target: r numbers, little-endian float64 in base64.
    """

    joints: list[JointPlacePart]
    columns: list[str]
    rows: str
    target: str


class PayloadPart(Part):
    """What was added to a body between the baseline and this recording, in the frame of `link`, with sigmas.

    By generalised least squares; sigmas are widened by the root of `misfit` where that is above 1. Null where
    the torques do not determine it (`undetermined`), the centre and inertia also where the mass is within
    three sigmas of zero. inertia_kg_m2: about the centre.
    misfit: of what is left, variances per degree of freedom; far above 1 something else has changed.
    consistent: whether the estimate is a physically consistent body. inconsistency_sigma: by how much the
        nearest one explains the torques worse, its chi^2 of ten degrees of freedom as sigmas of one; up to 3
        is noise. rigid_body: that body.
    """

    baseline: str
    link: str
    joint: str
    mass_kg: float | None
    mass_sigma_kg: float | None
    com_m: list[float | None]
    com_sigma_m: list[float | None]
    inertia_kg_m2: list[list[float]] | None
    inertia_sigma_kg_m2: list[list[float]] | None
    undetermined: list[str]
    misfit: float
    consistent: bool
    inconsistency_sigma: float
    rigid_body: BodyPart


class TorqueFactorPart(Part):
    """The factor from a joint's readings to torques by a known payload; null where it is not determined.

    `sigma` is null where the payload shows nothing of the joint.
    """

    joint: str
    factor: float | None
    sigma: float | None


class FitReport(Part):
    """Everything that `x5-coordinator fit-dynamics` reports; errors are fractions, SI units.

    information: for a later fit of the arm with a payload; `payload`, if this is such a fit. torque_factors:
    of all joints, if a known payload was given; the readings were multiplied by them.

    Schema 3 adds the choice of low-pass and drives, held joints, what a URDF cannot hold, the information and
    the payload; both may be null. Schema 2 names
    `summary`, `identifiability` and `rigid_body` (in schema 1 `words`, `verdict`, and the body's fields by
    themselves).
    """

    schema_version: int = SCHEMA
    urdf: str
    data: str
    held_out_data: str | None
    recording: DataPart
    held_out: list[ErrorPart]
    lengths: list[LengthPart]
    gains: list[TermGainPart]
    trials: list[TrialPart]
    fit: FitPart
    information: InformationPart | None = None
    payload: PayloadPart | None = None
    torque_factors: list[TorqueFactorPart] = Field(default_factory=list)

    def errors(self, model: Model, torque: str = "filtered") -> list[ErrorPart]:
        """Return a model's errors, in the order of the report."""
        return [e for e in self.held_out if e.model == model and e.torque == torque]

    def models(self) -> Sequence[Model]:
        """Return the models that were tested, the fitted one first."""
        return list(dict.fromkeys(e.model for e in self.held_out))


def write_report(path: Path, report: FitReport) -> None:
    """Write the report as JSON; the file is the complete old or the complete new one.

    Raises:
        OSError: the file cannot be written.
    """
    write_json(path, report)
