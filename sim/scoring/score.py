"""Errors of a run's result against the simulator's truth: `score.json`.

Modules are matched by serial number. Before tips are compared the estimate is moved along the directions that
the result lists as unidentifiable, and along no others.
"""

import json
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coordinator.identification.identified import Identified
from coordinator.identification.result import (
    SCHEMA,
    ChainPart,
    LinkPart,
    Result,
    TorqueTermPart,
    UnresolvedPart,
    migrate,
)
from module_agent.model.chain import Array, Chain, ChainError
from module_agent.model.errors import DataError, UsageError
from module_agent.model.model_faults import first_fault
from module_agent.signals.filtering import resample
from sim.scoring.chain_score import (
    gravity_error_deg,
    link_errors,
    link_length_m,
    link_spread,
    tip_errors,
    tip_spread,
    topology_differences,
)
from sim.world.truth import Motion, read_motion, read_truth

# A torque below the sensor's resolution gives no meaningful relative error: an unloaded output needs less.
MIN_TORQUE_NM = 0.02


class ScoreError(UsageError):
    """A run cannot be scored; the message names the file and what is wrong with it."""


class LinkScore(BaseModel):
    """One link; a value is None if the result has no such link.

    The length is the perpendicular distance from the parent's joint axis to the child's IMU at q = 0, its
    error is estimate - truth. The vector is that from the axis to the IMU, across the axis; its error and the
    angle between true and estimated axis are those in the child's IMU frame at q = 0. Sigmas are what the
    result claims: that of the length is None where it claims nothing, those of vector and axis are in the
    direction of their errors, and None if it has no covariance.
    """

    model_config = ConfigDict(frozen=True)

    parent: str
    child: str
    link_length_true_mm: float
    link_length_error_mm: float | None
    link_length_sigma_mm: float | None
    link_vector_error_mm: float | None
    axis_error_deg: float | None
    link_vector_sigma_mm: float | None = None
    axis_sigma_deg: float | None = None


class Score(BaseModel):
    """The contents of `score.json`; None where nothing could be compared.

    Tip errors are root mean squares over 1000 random poses of all leaf IMUs in the root frame, their sigmas
    what the result's covariance lets expect of them. The direction of gravity is that in the frame of the
    first module, if estimate and truth begin at the same one. Torque errors
    are |e| / |tau| on the held-out motion, against the true torque and against the measured one; None for a
    joint whose true torque is below `MIN_TORQUE_NM` (rms); its error in Nm is given nevertheless, as are the
    torques that the errors are relative to. A joint's error e is also split into that of a scale, s tau with
    s = <e, tau> / <tau, tau>, and the rest, the error of the shape. A scale of the torque sensor, which the
    result claims to know within its sigma (zero where it has none), explains the former alone.
    """

    model_config = ConfigDict(frozen=True)

    topology_correct: bool
    topology_differences: list[str]
    links: list[LinkScore]
    tip_position_rms_mm: float | None
    tip_orientation_rms_deg: float | None
    tip_position_sigma_mm: float | None = None
    tip_orientation_sigma_deg: float | None = None
    gravity_error_deg: float | None = None
    unidentifiable: list[str]
    torque_relative_error: float | None = None
    torque_relative_error_per_joint: dict[str, float | None] | None = None
    torque_rms_error_nm_per_joint: dict[str, float] | None = None
    torque_scale_error_per_joint: dict[str, float | None] | None = None
    torque_scale_sigma_per_joint: dict[str, float] | None = None
    torque_shape_error_nm_per_joint: dict[str, float] | None = None
    torque_relative_error_measured: float | None = None
    torque_rms_nm: float | None = None
    torque_rms_nm_per_joint: dict[str, float] | None = None
    measured_torque_rms_nm: float | None = None
    robot_time_s: float
    wall_time_s: float | None


class _DynamicsFile(BaseModel):
    """The part of the dynamics in `result.json` that scoring needs."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    held_out: dict[str, Any] | None = None
    torque_terms: list[TorqueTermPart] = []


class _ResultFile(BaseModel):
    """The part of `result.json` that scoring needs."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    schema_version: int = Field(alias="schema")
    serials: list[str]
    chain: ChainPart
    unresolved: list[UnresolvedPart]
    null_basis: list[list[float]]
    chain_covariance: list[list[float]] = []
    links: list[LinkPart]
    dynamics: _DynamicsFile | None
    robot_time_s: float
    wall_time_s: float | None


class _HeldOut(NamedTuple):
    """`held_out.npz`, columns in the order of the result's serials."""

    t_ns: NDArray[np.int64]
    tau_measured_nm: Array
    tau_predicted_nm: Array


def score(run: Path) -> Score:
    """Compare the result in the folder `run` with the truth next to it.

    Raises:
        ScoreError: a file is missing, broken or does not fit the others; the message says which and how.
    """
    result = _read_result(run / "result.json")
    try:
        estimated = result.chain.chain()
    except ChainError as error:
        raise ScoreError(f"{run / 'result.json'}: chain.{error}") from error
    with _reading(run / "truth.json") as path:
        truth = read_truth(path).chain
    basis = _null_basis(result, run / "result.json")
    torque: dict[str, Any] = {}
    if result.dynamics is not None and result.dynamics.held_out is not None:
        held_out = _read_held_out(run / "held_out.npz", len(result.serials))
        with _reading(run / "truth.npz") as path:
            motion = read_motion(path)
        torque = _torque(tuple(result.serials), held_out, motion, str(run / "truth.npz"))
    return _compared(result, estimated, basis, truth, torque)


def score_identified(identified: Identified, truth: Chain, motion: Motion) -> Score:
    """Compare an identification with the true chain and the true motion, without files.

    Raises:
        ScoreError: the true motion does not cover the held-out motion.
    """
    fit, held_out, torque = identified.kinematics.fit, identified.held_out, {}
    if held_out is not None:
        torques = _HeldOut(held_out.module_ns, held_out.tau_measured_nm, held_out.tau_predicted_nm)
        torque = _torque(held_out.serials, torques, motion, "the true motion")
    return _compared(identified.result, fit.chain, fit.null_basis, truth, torque)


def _compared(
    result: "_ResultFile | Result", estimated: Chain, null_basis: Array, truth: Chain, torque: dict[str, Any]
) -> Score:
    differences = topology_differences(estimated, truth)
    tip = (None, None) if differences else tip_errors(estimated, truth, null_basis)
    covariance = np.array(result.chain_covariance) if result.chain_covariance else None
    spread = None if differences or covariance is None else tip_spread(estimated, covariance, null_basis)
    return Score(
        topology_correct=not differences,
        topology_differences=differences,
        links=_links(estimated, truth, result.links, covariance),
        tip_position_rms_mm=tip[0],
        tip_orientation_rms_deg=tip[1],
        tip_position_sigma_mm=None if spread is None else 1e3 * spread[0],
        tip_orientation_sigma_deg=None if spread is None else spread[1],
        gravity_error_deg=gravity_error_deg(estimated, truth),
        unidentifiable=[item.summary for item in result.unresolved],
        robot_time_s=result.robot_time_s,
        wall_time_s=result.wall_time_s,
        torque_scale_sigma_per_joint=_scale_sigma(result) if torque else None,
        **torque,
    )


def _links(
    estimated: Chain, truth: Chain, claimed: list[LinkPart], covariance: Array | None
) -> list[LinkScore]:
    sigma = {(link.parent, link.child): link.link_length_sigma_mm for link in claimed}
    scores = []
    for child, serial in enumerate(truth.serials):
        if truth.parent[child] < 0:
            continue
        parent = truth.serials[truth.parent[child]]
        error = link_errors(estimated, truth, child)
        spread = None if covariance is None else link_spread(estimated, truth, child, covariance)
        scores.append(
            LinkScore(
                parent=parent,
                child=serial,
                link_length_true_mm=1e3 * link_length_m(truth, child),
                link_length_error_mm=None if error is None else 1e3 * error.length_m,
                link_length_sigma_mm=sigma.get((parent, serial)),
                link_vector_error_mm=None if error is None else 1e3 * error.vector_m,
                axis_error_deg=None if error is None else error.axis_deg,
                link_vector_sigma_mm=None if spread is None else 1e3 * spread.vector_m,
                axis_sigma_deg=None if spread is None else spread.axis_deg,
            )
        )
    return scores


def _torque(serials: tuple[str, ...], held_out: _HeldOut, motion: Motion, source: str) -> dict[str, Any]:
    """Return the fields of `Score` about torques."""
    measured = _ratio(held_out.tau_predicted_nm, held_out.tau_measured_nm)
    size_measured = float(np.sqrt(np.mean(held_out.tau_measured_nm**2)))
    known = [column for column, serial in enumerate(serials) if serial in motion.serials]
    if not known:
        return {"torque_relative_error_measured": measured, "measured_torque_rms_nm": size_measured}
    own = [serials[c] for c in known]
    true = np.column_stack([true_torque(motion, serials[c], held_out.t_ns[:, c], source) for c in known])
    predicted = held_out.tau_predicted_nm[:, known]
    size, error = _rms(true), _rms(predicted - true)
    relative = [e / s if s >= MIN_TORQUE_NM else None for e, s in zip(error, size, strict=True)]
    along = ((predicted - true) * true).mean(axis=0) / np.maximum(size, MIN_TORQUE_NM) ** 2
    scale = [float(a) if s >= MIN_TORQUE_NM else None for a, s in zip(along, size, strict=True)]
    shape = _rms(predicted - true * np.array([1.0 + (a or 0.0) for a in scale]))
    return {
        "torque_relative_error": _ratio(predicted, true),
        "torque_relative_error_per_joint": dict(zip(own, relative, strict=True)),
        "torque_rms_error_nm_per_joint": dict(zip(own, error, strict=True)),
        "torque_scale_error_per_joint": dict(zip(own, scale, strict=True)),
        "torque_shape_error_nm_per_joint": dict(zip(own, shape, strict=True)),
        "torque_relative_error_measured": measured,
        "torque_rms_nm": float(np.sqrt(np.mean(true**2))),
        "torque_rms_nm_per_joint": dict(zip(own, size, strict=True)),
        "measured_torque_rms_nm": size_measured,
    }


def _scale_sigma(result: "_ResultFile | Result") -> dict[str, float]:
    """Return the standard deviation that the result claims of the scale of each module's torque sensor."""
    terms = [] if result.dynamics is None else result.dynamics.torque_terms
    claimed = {term.serial: term.sigma for term in terms if term.term == "scale"}
    return {serial: claimed.get(serial, 0.0) for serial in result.serials}


def true_torque(motion: Motion, serial: str, t_ns: NDArray[np.int64], source: str) -> Array:
    """Interpolate a module's true torque (m,) at times (m,) of its own clock.

    Raises:
        ScoreError: the motion, which is from `source`, does not cover these times.
    """
    column = motion.serials.index(serial)
    try:
        torque = resample([motion.clock_ns[:, column]], [motion.spring_torque_nm[:, column]], t_ns)
    except DataError as error:
        raise ScoreError(
            f"{source} does not cover the held-out motion of module {serial}: {error}"
        ) from error
    return torque[:, 0]


def _ratio(predicted: Array, true: Array) -> float | None:
    size = float(np.linalg.norm(true))
    return float(np.linalg.norm(predicted - true)) / size if size > 0.0 else None


def _rms(columns: Array) -> list[float]:
    return [float(value) for value in np.sqrt((columns**2).mean(axis=0))]


# ---------------------------------------------------------------------- files


@contextmanager
def _reading(path: Path) -> Iterator[Path]:
    """Yield the path of a file to be read; say in a `ScoreError` if it is missing, broken or incomplete."""
    if not path.is_file():
        hints = {
            "result.json": "the run has not ended, or this is not the folder of a run",
            "held_out.npz": "result.json refers to a held-out motion",
        }
        raise ScoreError(f"{path} is missing: {hints.get(path.name, 'only simulated runs can be scored')}")
    try:
        yield path
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ScoreError(f"{path} is not JSON: {error}") from error
    except KeyError as error:
        raise ScoreError(f"{path} lacks {error}") from error
    except (ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile, zlib.error, DataError) as error:
        raise ScoreError(f"{path} is broken: {error}") from error


def _read_result(path: Path) -> _ResultFile:
    try:
        with _reading(path):
            document = migrate(json.loads(path.read_text(encoding="utf-8")))
        result = _ResultFile.model_validate(document)
    except ValidationError as error:
        raise ScoreError(f"{path}: {first_fault(error)}") from error
    if result.schema_version != SCHEMA:
        raise ScoreError(f"{path} has schema {result.schema_version}; this program scores schema {SCHEMA}")
    if result.serials != result.chain.serials:
        raise ScoreError(f"{path}: serials and chain.serials differ")
    return result


def _null_basis(result: _ResultFile, path: Path) -> Array:
    rows = 6 * len(result.serials)
    if not result.null_basis:
        return np.zeros((rows, 0))
    if len(result.null_basis) != rows or len({len(row) for row in result.null_basis}) != 1:
        raise ScoreError(f"{path}: null_basis must have {rows} rows of one length, 6 per module")
    return np.array(result.null_basis, dtype=float)


def _read_held_out(path: Path, joints: int) -> _HeldOut:
    with _reading(path), np.load(path, allow_pickle=False) as file:
        held_out = _HeldOut(*(np.asarray(file[name]) for name in _HeldOut._fields))
    for name, array in zip(_HeldOut._fields, held_out, strict=True):
        if array.shape != (len(held_out.t_ns), joints):
            raise ScoreError(f"{path}: {name} has shape {array.shape}, (samples, {joints}) is needed")
    return held_out
