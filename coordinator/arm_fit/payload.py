"""What was added to one body of an arm, from two recordings: a baseline without it and one with it.

Bodies and rotors are the same in both; friction and offsets change with temperature and load and are free in
each. With the square-root information of the two fits, their free terms marginalised,

    [ R  0   ] [ x   ]   [ z  ]
    [ S  S_b ] [ psi ] = [ z' ],

psi (10,) the payload and S_b the columns of the body b that carries it. Generalised least squares: the rows
are whitened, so that psi's covariance contains the uncertainty of the arm (`parameter_fit.payload`).
"""

from base64 import b64decode, b64encode
from binascii import Error as Base64Error
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError
from scipy.linalg import null_space
from scipy.special import chdtrc, ndtri

from coordinator.arm_fit.problem import Problem
from coordinator.arm_fit.recordings import STILL
from coordinator.arm_fit.report import FitReport, InformationPart, JointPlacePart, PayloadPart
from coordinator.description.urdf_reader import UrdfRobot
from coordinator.dynamics.pseudo_inertia import (
    REACH_M,
    body,
    is_consistent,
    parameter_scale,
    parameter_transform,
    parameters,
    pseudo_inertia,
)
from coordinator.parameter_fit.payload import LIKELY_KG, change_between, consistent_payload
from coordinator.parameter_fit.report_parts import body_part, triple
from coordinator.parameter_fit.robust_least_squares import WeightedFit
from coordinator.parameter_fit.torque_constants import TorqueFactors, torque_factors
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError
from module_agent.model.model_faults import first_fault
from module_agent.model.regressor import PER_BODY

# The URDF of the baseline may have been written with fewer digits.
_SAME = 1e-4
# Of the largest column of the payload: a smaller one is rounding.
_NO_EFFECT = 1e-9
_SHARE = 1e-5
_CERTAIN = 3.0
_SMALLEST_CHANCE = 1e-300
# An estimate is that much away from the consistent bodies by noise.
MAX_INCONSISTENCY_SIGMA = 3.0
_NAMES = (
    "mass",
    *(f"centre {axis}" for axis in "xyz"),
    *(f"inertia {pair}" for pair in ("xx", "xy", "xz", "yy", "yz", "zz")),
)


class Baseline(NamedTuple):
    """An earlier fit of the arm without the payload, and the link that carries it now.

    name: of the file. columns: p names. rows: (r, p) and target: (r,) whitened, in the root frame.
    """

    name: str
    columns: tuple[str, ...]
    rows: Array
    target: Array
    link: str


class KnownPayload(NamedTuple):
    """A payload of known mass [kg] and centre (3,) [m] in the frame of `link`, None for the last body's."""

    mass_kg: float
    com_m: tuple[float, float, float]
    link: str | None = None


class _Estimate(NamedTuple):
    """A payload (10,) in the frame of its link, its covariance, which parameters are determined, chi^2."""

    psi: Array
    covariance: Array
    determined: Array
    misfit: float
    freedom: int


def information_part(problem: Problem, fit: WeightedFit) -> InformationPart:
    """Return what a fit says of bodies and rotors, for a later fit of the arm with a payload."""
    columns, rows, target = _information(problem, fit)
    return InformationPart(
        joints=_places(problem.robot), columns=list(columns), rows=_encoded(rows), target=_encoded(target)
    )


def read_baseline(
    source: str | Path | FitReport | None, robot: UrdfRobot, link: str | None
) -> Baseline | None:
    """Return the baseline of an arm, None without one.

    Args:
        source: the report of a fit to the same arm without the payload, or its JSON file.
        robot: the arm. link: that carries the payload, None for the last body's.

    Raises:
        UsageError: no report of fit-dynamics, one of another arm or other joints, or a link that does not
            move; the message names file and joint.
        OSError: the file cannot be read.
    """
    if source is None:
        if link is not None:
            raise UsageError(f"payload body {link!r}: a payload needs the --baseline of the arm without it")
        return None
    name = "the baseline" if isinstance(source, FitReport) else str(source)
    if isinstance(source, FitReport):
        report = source
    else:
        try:
            report = FitReport.model_validate_json(Path(source).read_bytes())
        except ValidationError as error:
            raise UsageError(
                f"{name}: no report of fit-dynamics ({first_fault(error)}); give the file that --json "
                "wrote for the arm without the payload"
            ) from None
    part = report.information
    if part is None:
        raise UsageError(f"{name}: it was written without the information of its fit; fit it again")
    _check_same_arm(name, part, report.recording.held, robot)
    link = robot.bodies[-1] if link is None else link
    _check_carried(robot, link)
    target = _decoded(name, part.target)
    rows = _decoded(name, part.rows)
    if rows.size != len(target) * len(part.columns):
        raise UsageError(f"{name}: {rows.size} numbers of information for {len(part.columns)} columns")
    return Baseline(name, tuple(part.columns), rows.reshape(len(target), -1), target, link)


def factors_by_payload(unloaded: Problem, loaded: Problem, payload: KnownPayload) -> TorqueFactors:
    """Return the factors of the joints' readings by a payload that only `loaded` carries.

    Bodies and rotors are the same in both recordings, all other terms of the drives are free in each.

    Raises:
        UsageError: a link that does not move, or a mass that is not positive.
    """
    robot = unloaded.robot
    link = robot.bodies[-1] if payload.link is None else payload.link
    _check_carried(robot, link)
    if not (payload.mass_kg > 0.0 and np.isfinite([payload.mass_kg, *payload.com_m]).all()):
        raise UsageError(f"known payload {payload.mass_kg:g} kg at {payload.com_m}: the mass must be above 0")
    carrier, centre = robot.links[link].body, np.array(payload.com_m)
    own = slice(PER_BODY * carrier, PER_BODY * (carrier + 1))
    added = loaded.regressor[:, :, own] @ parameter_transform(robot.links[link].pose)
    point = np.zeros((4, 4))
    point[:3, :3], point[:3, 3], point[3, :3] = np.outer(centre, centre), centre, centre
    point[3, 3] = 1.0
    known = payload.mass_kg * (added @ parameters(point))
    shared = np.array([True] * unloaded.inertial + [d.term == "inertia" for d in unloaded.drives])
    parts = [one.regressor for one in (unloaded, loaded)]
    nothing = [np.zeros((*one.shape[:2], int((~shared).sum()) + 6)) for one in parts]
    drives = nothing[0].shape[2] - 6
    columns = [
        np.concatenate([parts[0], nothing[0]], axis=2),
        np.concatenate([np.where(shared, parts[1], 0.0), nothing[1][..., :drives], added[..., 4:]], axis=2),
    ]
    columns[1][..., len(shared) : len(shared) + drives] = parts[1][..., ~shared]
    return torque_factors(
        np.concatenate(columns),
        np.concatenate([np.zeros(parts[0].shape[:2]), known]),
        np.concatenate([unloaded.log.tau_nm, loaded.log.tau_nm]),
        np.concatenate([unloaded.moving, loaded.moving]),
    )


def added_payload(baseline: Baseline, problem: Problem, fit: WeightedFit) -> PayloadPart:
    """Return what was added to the baseline's link, from a fit to a recording with it."""
    robot, link = problem.robot, baseline.link
    columns, rows, target = _information(problem, fit)
    # A shared drive may have been kept in one of the two fits; the other says nothing of it.
    every = tuple(dict.fromkeys([*baseline.columns, *columns]))
    known = _spread(baseline.rows, baseline.columns, every)
    scale = np.concatenate([parameter_scale(len(robot.bodies)), np.ones(len(every) - problem.inertial)])
    change = change_between(known, baseline.target, _spread(rows, columns, every), target, scale)
    carrier = robot.links[link].body
    own = rows[:, PER_BODY * carrier : PER_BODY * (carrier + 1)] @ parameter_transform(robot.links[link].pose)
    along = change.along(own)
    estimate = _least_squares(along, change.target, float(np.linalg.norm(own * parameter_scale(1), 2)))
    return _payload_part(baseline, robot.chain.serials[carrier], estimate, along, change.target)


def _least_squares(columns: Array, target: Array, size: float) -> _Estimate:
    scale = parameter_scale(1)
    left, values, directions = np.linalg.svd(columns * scale, full_matrices=False)
    kept = values > _NO_EFFECT * size
    inverse = scale[:, None] * directions[kept].T / values[kept]
    psi = inverse @ (left[:, kept].T @ target)
    off = columns @ psi - target
    freedom = max(len(target) - int(kept.sum()), 1)
    misfit = float(off @ off)
    share = np.sum(directions[kept] ** 2, axis=0)
    # What two fits to different samples disagree about beyond their noise is in both of them.
    widened = max(misfit / freedom, 1.0)
    return _Estimate(psi, widened * inverse @ inverse.T, share > 1.0 - _SHARE, misfit, freedom)


def _payload_part(
    baseline: Baseline, joint: str, estimate: _Estimate, columns: Array, target: Array
) -> PayloadPart:
    psi, sigma = estimate.psi, np.sqrt(np.diagonal(estimate.covariance))
    known = estimate.determined
    heavy = bool(known[0] and abs(psi[0]) > _CERTAIN * sigma[0])
    whole = heavy and bool(known.all())
    centre = [heavy and bool(one) for one in known[1:4]]
    about, slope = _about_centre(psi) if heavy else (np.zeros(9), np.zeros((9, PER_BODY)))
    spread = np.sqrt(np.einsum("ij,jk,ik->i", slope, estimate.covariance, slope))
    likely_kg = max(float(psi[0]), 0.1 * LIKELY_KG) if known[0] else LIKELY_KG
    solution, misfit = consistent_payload(columns, target, np.where(centre, about[:3], 0.0), likely_kg)
    worse = max(misfit - estimate.misfit, 0.0) / max(estimate.misfit / estimate.freedom, 1.0)
    return PayloadPart(
        baseline=baseline.name,
        link=baseline.link,
        joint=joint,
        mass_kg=float(psi[0]) if known[0] else None,
        mass_sigma_kg=float(sigma[0]) if known[0] else None,
        com_m=[v if one else None for v, one in zip(about[:3].tolist(), centre, strict=True)],
        com_sigma_m=[v if one else None for v, one in zip(spread[:3].tolist(), centre, strict=True)],
        inertia_kg_m2=_symmetric(about[3:]) if whole else None,
        inertia_sigma_kg_m2=_symmetric(spread[3:]) if whole else None,
        undetermined=[name for name, one in zip(_NAMES, known, strict=True) if not one],
        misfit=estimate.misfit / estimate.freedom,
        consistent=is_consistent(pseudo_inertia(psi)),
        inconsistency_sigma=float(-ndtri(0.5 * max(chdtrc(PER_BODY, worse), _SMALLEST_CHANCE))),
        rigid_body=body_part(body(pseudo_inertia(solution.x))),
    )


def _about_centre(psi: Array) -> tuple[Array, Array]:
    """Return centre and inertia about it, xx xy xz yy yz zz, (9,) of ten parameters; derivatives (9, 10).

    c = h / m, and I_c = I - (h h^T trace - h h^T) / m, whose derivatives are those of its products.
    """
    mass, first = psi[0], psi[1:4]
    upper = np.triu_indices(3)

    def turned(a: Array, b: Array) -> Array:
        return np.asarray((a @ b * np.eye(3) - 0.5 * (np.outer(a, b) + np.outer(b, a)))[upper])

    slope = np.zeros((9, PER_BODY))
    slope[:3, 0], slope[:3, 1:4] = -first / mass**2, np.eye(3) / mass
    slope[3:, 0] = turned(first, first) / mass**2
    slope[3:, 1:4] = np.stack([-2.0 * turned(first, unit) / mass for unit in np.eye(3)], axis=1)
    slope[3:, 4:] = np.eye(6)
    return np.concatenate([first / mass, psi[4:] - turned(first, first) / mass]), slope


def _symmetric(six: Array) -> list[list[float]]:
    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)] = six
    return (matrix + np.triu(matrix, 1).T).tolist()  # type: ignore[no-any-return]


def _information(problem: Problem, fit: WeightedFit) -> tuple[tuple[str, ...], Array, Array]:
    """Return names (p,), whitened rows (r, p) and target (r,) of bodies and rotors, from a fit's covariance.

    The covariance, unlike the fit's rows, counts how alike the residuals are. The free terms are marginalised
    by the complement of their columns' range.
    """
    scale = problem.columns.scale
    values, vectors = np.linalg.eigh(fit.covariance / np.outer(scale, scale))
    kept = slice(len(values) - fit.rank, len(values))
    rows = (vectors[:, kept] / np.sqrt(values[kept])).T / scale
    shared = np.array(
        [True] * problem.inertial + [drive.term == "inertia" for drive in problem.drives], dtype=bool
    )
    without = null_space(rows[:, ~shared].T) if not shared.all() else np.eye(len(rows))
    names = tuple(name for name, one in zip(problem.columns.names, shared, strict=True) if one)
    return names, without.T @ rows[:, shared], without.T @ (rows @ fit.parameters)


def _spread(rows: Array, columns: tuple[str, ...], every: tuple[str, ...]) -> Array:
    spread = np.zeros((len(rows), len(every)))
    spread[:, [every.index(name) for name in columns]] = rows
    return spread


def _places(robot: UrdfRobot) -> list[JointPlacePart]:
    return [
        JointPlacePart(joint=joint, link=link, origin_m=triple(home[:3, 3]), axis=triple(axis))
        for joint, link, home, axis in zip(
            robot.chain.serials, robot.bodies, robot.homes, robot.chain.axis, strict=True
        )
    ]


def _check_carried(robot: UrdfRobot, link: str) -> None:
    if link not in robot.carried:
        raise UsageError(
            f"payload body {link!r}: no joint moves a link of this name; {', '.join(sorted(robot.carried))}"
        )


def _check_same_arm(name: str, part: InformationPart, held: Mapping[str, float], robot: UrdfRobot) -> None:
    there, here = [p.joint for p in part.joints], list(robot.chain.serials)
    if there != here:
        raise UsageError(
            f"{name}: a fit of the joints {', '.join(there)}; those that move in this recording are "
            f"{', '.join(here)}; a baseline is a fit of the same joints"
        )
    for joint, position in robot.held.items():
        if abs(position - held.get(joint, 0.0)) > STILL:
            raise UsageError(
                f"{name}: joint {joint!r} stood at {held.get(joint, 0.0):.3g} (rad or m), and stands at "
                f"{position:.3g} in this recording: what it carries would count as payload; record both "
                "with it at the same position"
            )
    for old, new in zip(part.joints, _places(robot), strict=True):
        moved = float(np.linalg.norm(np.subtract(old.origin_m, new.origin_m)))
        turned = float(np.linalg.norm(np.subtract(old.axis, new.axis)))
        if max(moved / REACH_M, turned) > _SAME:
            raise UsageError(
                f"{name}: a fit of another arm: joint {new.joint!r} is {moved:.3g} m and its axis "
                f"{turned:.3g} rad from where {robot.path} has it; fit the recording without the payload "
                "with this URDF"
            )


def _encoded(values: Array) -> str:
    return b64encode(np.asarray(values, dtype="<f8").tobytes()).decode()


def _decoded(name: str, text: str) -> Array:
    try:
        values = np.frombuffer(b64decode(text, validate=True), dtype="<f8")
    except (Base64Error, ValueError):
        values = np.full(1, np.nan)
    if not np.isfinite(values).all():
        raise UsageError(f"{name}: its information is damaged; fit the recording again")
    return values
