"""`result.json`: what a session found, in a versioned schema; written whole or not at all."""

import os
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from coordinator.parameter_fit.report_parts import BodyPart
from module_agent.model.chain import Chain

SCHEMA = 1


class Part(BaseModel):
    """A piece of the result."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class ChainPart(Part):
    """The chain as lists; see `chain.Chain` for frames and units."""

    serials: list[str]
    parent: list[int]
    reversed: list[bool]
    axis: list[list[float]]
    point: list[list[float]]
    imu_home: list[list[list[float]]]
    gravity: list[float]

    @classmethod
    def of(cls, chain: Chain) -> "ChainPart":
        """Return a chain as lists."""
        return cls(**chain.to_dict())

    def chain(self) -> Chain:
        """Return the chain with arrays.

        Raises:
            ChainError: shapes that do not fit each other.
        """
        return Chain.from_dict(self.model_dump())


class LinkPart(Part):
    """The thesis' link length: perpendicular distance from the parent's axis to the child's IMU at q = 0."""

    parent: str
    child: str
    link_length_mm: float
    link_length_sigma_mm: float


class UnknownPart(Part):
    """Which parameters of one link are not known (names as in `TransformPart.parameters`)."""

    parent: str
    child: str
    parameters: list[str]


class UnresolvedPart(Part):
    """What the data does not tell: in words, as parameters of links, and what would tell it."""

    kind: str
    joint: str
    modules: list[str]
    words: str
    resolved_by: str = ""
    links: list[UnknownPart] = []


class TransformPart(Part):
    """The pose of a child's mounting face in its parent's moved face; see `kinematics.link_transforms`.

    values and covariance are in the units that `parameters` names. sigma is None where a parameter takes part
    in what no observation tells; the covariance is that of what is known.
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

    Log-odds of 4.6 are 99 %, 0 is a toss-up, None says that nothing else is possible. A module whose joint
    did not move shows as a leaf, and its way round is not known. There is no such list of a topology that
    was known beforehand.
    """

    serial: str
    parent: str | None
    parent_log_odds: float | None
    reversed: bool
    reversed_log_odds: float
    joint_moved: bool


class PairPart(Part):
    """The agent's circle point analysis of one joint by one IMU."""

    joint: str
    observer: str
    moved: bool
    rate_ratio: float
    distance_mm: float | None
    distance_sigma_mm: float | None
    axis: list[float] | None


class DhRowPart(Part):
    """One joint's parameters (thesis eq. 2); `theta_rad` is added to the joint's position."""

    serial: str
    theta_rad: float
    d_m: float
    a_m: float
    alpha_rad: float


class DhPart(Part):
    """Denavit-Hartenberg parameters of one path from the base to a leaf, and the pose of frame 0."""

    base: list[list[float]]
    rows: list[DhRowPart]


class HeldOutPart(Part):
    """How well the model predicts torques of a motion that it was not fitted to: |e| / |tau|, 2-norms."""

    relative_error: float
    relative_error_per_joint: dict[str, float]
    mean_baseline: float
    samples: int


class ModuleBodyPart(BodyPart):
    """A physically consistent body: all that the joint of the module `serial` moves, as in `robot.urdf`.

    It is in the frame of the link `body_<serial>`.
    """

    serial: str


class BodiesPart(Part):
    """Real bodies that explain the torques; what these do not tell is what modules of the type have.

    relative_error is |e| / |tau| of the motions that were fitted, least_squares_error that of the best
    parameters, be they a body's or not. prior_weight is how much the modules' make counts.
    """

    bodies: list[ModuleBodyPart]
    relative_error: float
    least_squares_error: float
    prior_weight: float
    held_out_relative_error: float | None


class BaseParameterPart(Part):
    """A sum of parameters that torques show, "m2 c2x + 0.225 (m3 + m4)", in SI units.

    m, m c and I are of the bodies in the order of the chain, counted from 1, each in its own of
    `DynamicsPart.frames` and about that frame's origin. relative_sigma is None of a value of zero.
    """

    words: str
    value: float
    sigma: float
    relative_sigma: float | None


class IdentifiabilityPart(Part):
    """Whether one parameter is known: `identified` by torques alone, within 10 %; `weak` if worse, or by the
    modules' make; `not identifiable` else.

    sums are the places in `base_parameters` of those that it is in: none, if torques do not depend on it.
    """

    parameter: str
    serial: str
    verdict: str
    value: float | None
    sigma: float | None
    sums: list[int]


class TorqueTermPart(Part):
    """What one joint's torque reading holds beside the bodies' torque (`dynamics.torque_terms`).

    used: it earns its place; else value and sigma are zero. gain: by how many variances of the torque's noise
    it makes the joint's misfit smaller; None of the scale of the sensor, which the joints together tell
    (`dynamics.torque_scale`).
    """

    serial: str
    term: str
    unit: str
    used: bool
    value: float
    sigma: float
    gain: float | None = None


class DynamicsPart(Part):
    """The inertial parameters; see `dynamics.regressor` for the order and frame of `phi`.

    `phi` predicts torques but need not be of real bodies: those are `bodies`. words say what is known, body
    by body. frames are the poses (4, 4) at q = 0 in the root frame in which base parameters and verdicts are
    worded: z along the joint's axis, x towards the next joint (`dynamics.joint_frames`). seen_by: by what the
    bodies' motion was seen (`inertia`); noise_nm: what each way of seeing it leaves in the torques.

    gathered_by: whose the rows from encoders are, from which what IMUs saw beyond is taken off; by_agents are
    the modules that gathered their own. gathered_difference: how far those and the coordinator's are apart at
    most, relative.
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
    base_parameters: list[BaseParameterPart] = []
    identifiabilities: list[IdentifiabilityPart] = []
    words: list[str] = []
    frames: list[list[list[float]]] = []
    seen_by: str = "encoders"
    noise_nm: dict[str, dict[str, float]] = {}
    torque_terms: list[TorqueTermPart] = []
    gathered_by: Literal["agents", "coordinator", "both"] = "coordinator"
    by_agents: list[str] = []
    gathered_difference: float | None = None


class Result(Part):
    """Everything that one session found.

    chain_covariance and null_basis, (6 n, 6 n) and (6 n, k), are over the increments of
    `kinematics.increments`: per module of the chain a twist of its pose at q = 0 in the root frame.
    """

    robot: str
    serials: list[str]
    types: dict[str, str]
    topology_confidence: float
    topology: list[MountingPart] = []
    chain: ChainPart
    rank: int
    condition: float
    reduced_chi2: float
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
    robot_time_s: float
    wall_time_s: float | None
    trace_hash: str
    schema_version: int = Field(default=SCHEMA, alias="schema")


def write_result(path: Path, result: Result) -> None:
    """Write the result; the file is the complete old or the complete new one."""
    text = result.model_dump_json(indent=1, by_alias=True)
    temporary = path.with_suffix(".json.part")
    temporary.write_text(text + "\n")
    os.replace(temporary, path)
