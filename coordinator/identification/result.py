"""`result.json`: the results of an identification in a versioned schema; written whole or not at all."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from coordinator.dynamics.torque_prediction import error_in_words
from coordinator.parameter_fit.report_parts import BaseParameterPart, BodyPart, ImuPlacePart, Part
from module_agent.model.chain import Chain
from module_agent.model.files import write_json

SCHEMA = 2


class ChainPart(Part):
    """The chain as lists; see `chain.Chain` for frames and units."""

    serials: list[str]
    parent: list[int]
    reversed: list[bool]
    axis: list[list[float]]
    point: list[list[float]]
    imu_home: list[list[list[float]]]
    gravity: list[float]

    def chain(self) -> Chain:
        """Return the chain with arrays.

        Raises:
            ChainError: shapes that do not fit each other.
        """
        return Chain.from_dict(self.model_dump())


class LinkPart(Part):
    """The thesis' link length: perpendicular distance from the parent's axis to the child's IMU at q = 0.

    The sigma is None if nothing that was observed determines the length.
    """

    parent: str
    child: str
    link_length_mm: float
    link_length_sigma_mm: float | None


class UnknownPart(Part):
    """Unidentifiable parameters of one link (names as in `TransformPart.parameters`)."""

    parent: str
    child: str
    parameters: list[str]


class UnresolvedPart(Part):
    """Directions that the data do not determine: as a sentence, as parameters of links, and the remedy."""

    kind: str
    joint: str
    modules: list[str]
    summary: str
    resolved_by: str = ""
    links: list[UnknownPart] = Field(default_factory=list)


class TransformPart(Part):
    """The pose of a child's mounting face in its parent's moved face; see `kinematics.link_transforms`.

    values and covariance are in the units that `parameters` names. sigma is None for a parameter with an
    unobservable part; the covariance is that of the observable part.
    """

    parent: str
    child: str
    parent_face: str
    child_face: str
    parameters: list[str]
    values: list[float]
    sigma: list[float | None]
    covariance: list[list[float]]
    null_directions: list[list[float]]


class ScrewPart(Part):
    """A joint's screw axis [w, v] at q = 0 in the root frame, and its covariance (6, 6)."""

    serial: str
    screw: list[float]
    covariance: list[list[float]]


class TipPart(Part):
    """The end of a branch: M (4, 4) at q = 0, the joints that move it, the covariance of M's twist."""

    serial: str
    frame: str
    joints: list[str]
    home: list[list[float]]
    covariance: list[list[float]]


class ExponentialsPart(Part):
    """The product of exponentials, T = exp([S_1] q_1) ... exp([S_k] q_k) M of every tip."""

    screws: list[ScrewPart]
    tips: list[TipPart]


class MountingPart(Part):
    """Where a module is mounted (`parent` is None on the base) and which way round, with log-odds of both.

    Log-odds of 4.6 are 99 %, 0 is undecided, None: there is no alternative. A module whose joint did not move
    shows as a leaf, and its mounting direction is not known. The list is empty for a topology taken from a
    baseline.
    """

    serial: str
    parent: str | None
    parent_log_odds: float | None
    reversed: bool
    reversed_log_odds: float
    joint_moved: bool


class PairPart(Part):
    """The agent's estimate of one joint by one IMU: its regression, or its circle point analysis."""

    joint: str
    observer: str
    moved: bool
    rate_ratio: float
    distance_mm: float | None
    distance_sigma_mm: float | None
    axis: list[float] | None


class DhRowPart(Part):
    """One joint's parameters (thesis eq. 2); `theta_rad` is added to the joint's position.

    beta_rad: Hayati's, a last turn about y, where the next axis is parallel within 0.1 rad; 0 in older
    results, whose d_m is large then.
    """

    serial: str
    theta_rad: float
    d_m: float
    a_m: float
    alpha_rad: float
    beta_rad: float = 0.0


class DhPart(Part):
    """Denavit-Hartenberg parameters of one path from the base to a leaf, and the pose of frame 0."""

    base: list[list[float]]
    rows: list[DhRowPart]


class HeldOutPart(Part):
    """Relative torque error of held-out motions: |e| / |tau|, 2-norms; torque_rms_nm is |tau| per sample."""

    relative_error: float
    relative_error_per_joint: dict[str, float]
    mean_baseline: float
    samples: int
    torque_rms_nm: float | None = None

    def in_words(self, relative_error: float | None = None) -> str:
        """Return the error, or another relative one of the same motions, for people."""
        error = self.relative_error if relative_error is None else relative_error
        if self.torque_rms_nm is None:  # a result of an earlier version
            return f"{100.0 * error:.1f} %"
        return error_in_words(error * self.torque_rms_nm, self.torque_rms_nm)


class ModuleBodyPart(BodyPart):
    """A physically consistent body: all that the joint of the module `serial` moves, as in `robot.urdf`.

    It is in the frame of the link `body_<serial>`. mass_sigma_kg: of torques, systematic errors and prior.
    """

    serial: str
    mass_sigma_kg: float | None = None


class BodiesPart(Part):
    """Physically consistent bodies fitted to the torques, with the module types as prior.

    relative_error is |e| / |tau| of the fitted motions, least_squares_error that of the best parameters
    without the constraint. prior_weight is the weight of the prior.
    """

    bodies: list[ModuleBodyPart]
    relative_error: float
    least_squares_error: float
    prior_weight: float
    held_out_relative_error: float | None


class IdentifiabilityPart(Part):
    """Whether one inertial parameter is identifiable.

    identifiability: `identified` (by torques alone, within 10 %), `weak` (worse, or only with the prior of
    the module type) or `not identifiable`. base_parameters: the indices of the base parameters that it is
    part of; none if torques do not depend on it.
    """

    parameter: str
    serial: str
    identifiability: str
    value: float | None
    sigma: float | None
    base_parameters: list[int]


class TorqueTermPart(Part):
    """A term of one joint's torque reading besides the rigid bodies' torque (`signals.torque_terms`).

    significant: it is part of the model; else value and sigma are zero. gain: by how many variances of the
    torque's noise it reduces the joint's sum of squared residuals; None for the sensor's scale, which is
    estimated from all joints together (`parameter_fit.torque_sensor_scale`).
    """

    serial: str
    term: str
    unit: str
    significant: bool
    value: float
    sigma: float
    gain: float | None = None


class DynamicsPart(Part):
    """The inertial parameters; see `dynamics.regressor` for the order and frame of `phi`.

    `phi` predicts torques but need not be physically consistent: see `bodies`. summary: lines of text,
    body by body. frames are the poses (4, 4) at q = 0 in the root frame in which base parameters and
    identifiability are stated: z along the joint's axis, x towards the next joint; m, m c and I of body k
    (counted from 1 along the chain) are in frame k, about its origin. motion_source: the sensors from which
    the bodies' motion is computed; noise_nm: the torque residual with each motion source.

    gathered_by: who projected the encoders' rows, from which the motion measured by IMUs alone is subtracted;
    by_agents are the modules that projected their own. gathered_difference: the largest relative difference
    between their projections and the coordinator's.
    """

    phi: list[float]
    rank: int
    parameters: int
    condition: float
    sigma: list[float]
    identifiable: list[bool]
    residual_rms_nm: dict[str, float]
    held_out: HeldOutPart | None
    bodies: BodiesPart | None = None
    base_parameters: list[BaseParameterPart] = Field(default_factory=list)
    identifiability: list[IdentifiabilityPart] = Field(default_factory=list)
    summary: list[str] = Field(default_factory=list)
    frames: list[list[list[float]]] = Field(default_factory=list)
    motion_source: str = "encoders"
    noise_nm: dict[str, dict[str, float]] = Field(default_factory=dict)
    torque_terms: list[TorqueTermPart] = Field(default_factory=list)
    gathered_by: Literal["agents", "coordinator", "both"] = "coordinator"
    by_agents: list[str] = Field(default_factory=list)
    gathered_difference: float | None = None

    @property
    def undetermined(self) -> dict[str, tuple[str, ...]]:
        """The parameters of every module's body that torques alone do not determine, by its serial."""
        return undetermined(self.identifiability)


def undetermined(parts: Sequence[IdentifiabilityPart]) -> dict[str, tuple[str, ...]]:
    """Return the parameters that torques alone do not determine, by the serial of their body's module."""
    names: dict[str, list[str]] = {}
    for one in parts:
        if one.identifiability != "identified":
            names.setdefault(one.serial, []).append(one.parameter)
    return {serial: tuple(own) for serial, own in names.items()}


class SensorPart(Part):
    """A sensor that contradicts its catalogue or the others; measured and expected in `unit`.

    kind: what is wrong with which sensor, one of `finding.Sickness`; empty in older files. serious: because
    of it the result is not to be believed as usual, and the program ended with exit code 5.
    """

    serial: str
    motion: str
    what: str
    measured: float
    expected: float
    sigmas: float
    unit: str
    summary: str
    kind: str = ""
    serious: bool = False


class DelayPart(Part):
    """The delay of a module's feedback from sample to coordinator; see `synchronisation.feedback_delays`."""

    serial: str
    messages: int
    p50_ms: float
    p99_ms: float
    max_ms: float
    clock_sigma_ms: float


class LossPart(Part):
    """How many rows of a module's feedback came; see `recording.FeedbackLoss`."""

    serial: str
    received: int
    lost: int
    missing: int


class Result(Part):
    """All results of one session.

    feedback_delays, feedback_losses: by serial. cpu_us_per_message: processor time of the coordinator's event
    loop for a message received, its recording and display included; None in virtual time and in older
    recordings.

    chain_covariance and null_basis, (6 n, 6 n) and (6 n, k), are over the perturbations of
    `model.perturbation`: per module of the chain a twist of its pose at q = 0 in the root frame.
    excluded: modules without which the robot was identified, as their sensors are sick. suspicions: why the
    result is not to be believed as usual; none of healthy robots.
    """

    robot: str
    serials: list[str]
    types: dict[str, str]
    topology_confidence: float
    topology: list[MountingPart] = Field(default_factory=list)
    chain: ChainPart
    rank: int
    condition: float | None
    reduced_chi2: float | None
    unresolved: list[UnresolvedPart]
    null_basis: list[list[float]]
    chain_covariance: list[list[float]]
    links: list[LinkPart]
    transforms: list[TransformPart]
    product_of_exponentials: ExponentialsPart
    pairs: list[PairPart]
    denavit_hartenberg: list[DhPart]
    dynamics: DynamicsPart | None
    notes: list[str]
    sensors: list[SensorPart] = Field(default_factory=list)
    excluded: list[str] = Field(default_factory=list)
    suspicions: list[str] = Field(default_factory=list)
    imu_places: list[ImuPlacePart] = Field(default_factory=list)
    feedback_delays: list[DelayPart] = Field(default_factory=list)
    feedback_losses: list[LossPart] = Field(default_factory=list)
    robot_time_s: float
    wall_time_s: float | None
    cpu_us_per_message: float | None = None
    trace_hash: str
    schema_version: int = Field(default=SCHEMA, alias="schema")

    @property
    def unknown_links(self) -> dict[str, tuple[str, ...]]:
        """The parameters of every link with an unobservable part, by the child's serial; those with any."""
        names = {
            one.child: tuple(n for n, sigma in zip(one.parameters, one.sigma, strict=True) if sigma is None)
            for one in self.transforms
        }
        return {child: parameters for child, parameters in names.items() if parameters}

    @model_validator(mode="before")
    @classmethod
    def _of_any_schema(cls, document: Any) -> Any:
        return migrate(document)


# Fields of schema 1 that were renamed, by the path of the part that holds them; [] stands for a list.
_RENAMED: dict[tuple[str, ...], dict[str, str]] = {
    ("unresolved", "[]"): {"words": "summary"},
    ("dynamics", "base_parameters", "[]"): {"words": "summary"},
    ("dynamics", "verdicts", "[]"): {"verdict": "identifiability", "sums": "base_parameters"},
    ("dynamics", "torque_terms", "[]"): {"used": "significant"},
    ("dynamics",): {"verdicts": "identifiability", "words": "summary", "seen_by": "motion_source"},
}


def migrate(document: Any) -> Any:
    """Return a `result.json` of schema 1, as parsed, in this schema; any other document unchanged."""
    if not isinstance(document, dict) or document.get("schema") != 1:
        return document
    migrated: dict[str, Any] = {**document, "schema": SCHEMA}
    for path, names in _RENAMED.items():
        migrated = _renamed(migrated, path, names)
    return migrated


def _renamed(value: Any, path: Sequence[str], names: Mapping[str, str]) -> Any:
    """Return a copy with the keys of the parts at a path renamed; a part that is missing is left out."""
    if path and path[0] == "[]":
        return [_renamed(item, path[1:], names) for item in value] if isinstance(value, list) else value
    if not isinstance(value, dict):
        return value
    if path:
        return value | {path[0]: _renamed(value[path[0]], path[1:], names)} if path[0] in value else value
    return {names.get(key, key): item for key, item in value.items()}


def write_result(path: Path, result: Result) -> None:
    """Write the result; the file is the complete old or the complete new one."""
    write_json(path, result)
