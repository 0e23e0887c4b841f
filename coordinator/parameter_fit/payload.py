"""Identify a payload on a robot whose dynamics are known: mass, centre and inertia, and the body it is on.

A payload adds to the ten parameters of its body (Kubus, Kroeger and Wahl 2008, On-line estimation of inertial
parameters using a recursive total least-squares approach, identify it by a wrist sensor; here it comes from
the joints' torques). With the information of motions without it, and rows of later motions,

    [ R  0   ] [ phi ]   [ z  ]
    [ S  S_b ] [ psi ] = [ z' ],

S_b the columns of the body b that carries it. The robot's parameters are free within the information of both
motions, so that the payload's covariance contains their uncertainty. The payload is physically consistent.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import qr

from coordinator.dynamics.pseudo_inertia import parameter_scale, pseudo_inertia
from coordinator.parameter_fit.base_parameters import whitened
from coordinator.parameter_fit.physically_consistent import Solution, physically_consistent
from coordinator.parameter_fit.spectrum import RANK_TOLERANCE
from coordinator.parameter_fit.systematic_errors import decorrelation
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY

# Prior: some hundred grams, about as large as a fist, near the module that carries it. It counts as much as
# one torque reading.
LIKELY_KG, LIKELY_SIZE_M = 0.2, 0.05
PRIOR_WEIGHT = 1.0
# Of the decrease of the misfit: ten parameters fitted to noise take off about 10, and models have errors
# besides noise.
FOUND_ABOVE = 50.0
# With a payload the misfit is one variance a row, and a little more where springs give; several times that
# is another change of the robot.
EXPLAINED_BELOW = 10.0


class Payload(NamedTuple):
    """A payload; arrays are read-only, in the root frame at q = 0.

    carrier: index of the body that carries it. changed: whether the torques have changed at all. phi: (10,)
    its parameters. covariance: (10, 10). gain: decrease of the misfit, in variances of the torques' noise;
    rival: the same of the second best, `rival_carrier`, None if no other body may carry it. left: misfit with
    the payload per degree of freedom: about 1 if nothing else has changed. pseudo: (4, 4) its pseudo-inertia.
    """

    carrier: int
    changed: bool
    phi: Array
    covariance: Array
    pseudo: Array
    left: float
    gain: float
    rival: float
    rival_carrier: int | None

    @property
    def explains(self) -> bool:
        """Whether a payload on one body is all that has changed."""
        return self.left < EXPLAINED_BELOW

    @property
    def found(self) -> bool:
        """Whether there is a payload."""
        return self.changed and self.explains

    @property
    def mass_kg(self) -> float:
        """Its mass."""
        return float(self.phi[0])

    @property
    def mass_sigma_kg(self) -> float:
        """One standard deviation of the mass."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def com_m(self) -> Array:
        """(3,) its centre, root frame at q = 0."""
        return np.asarray(self.phi[1:4] / self.phi[0])

    @property
    def com_covariance_m2(self) -> Array:
        """(3, 3) covariance of the centre's coordinates."""
        slope = np.zeros((3, PER_BODY))
        slope[:, 0] = -self.com_m / self.mass_kg
        slope[:, 1:4] = np.eye(3) / self.mass_kg
        return np.asarray(slope @ self.covariance @ slope.T)


def find_payload(
    before: Sequence[JointInformation],
    later: Sequence[JointInformation],
    places_m: ArrayLike,
    sigma_nm: ArrayLike,
    independent_fraction: float = 1.0,
    carriers: Sequence[int] | None = None,
    scale_sigma: float = 0.0,
) -> Payload:
    """Identify the payload that was added to one body of a robot between two motions.

    Args:
        before: information of motions without the payload, per joint of n.
        later: information of motions with it.
        places_m: (n, 3) likely place of a payload on each body, in the root frame at q = 0.
        sigma_nm: (n,) noise of the torques, including model errors.
        independent_fraction: independent samples per sample, below 1 after a low-pass.
        carriers: the bodies that may carry it; all when None.
        scale_sigma: standard deviation of the torque sensors' relative scales, which are the same before and
            later. What such an error can imitate counts no more than it is likely.

    Raises:
        ValueError: shapes that do not fit.
        DataError: noise that is not positive, or no carrier.
        NotSolvedError: numerical trouble.
    """
    likely = np.asarray(places_m, dtype=float)
    known, known_target = whitened(before, sigma_nm, independent_fraction)
    rows, target = whitened(later, sigma_nm, independent_fraction)
    if likely.shape != (len(before), 3) or known.shape[1] != rows.shape[1]:
        raise ValueError(
            f"places {likely.shape}, {len(before)} joints before and {len(later)} later do not fit"
        )
    candidates = range(len(before)) if carriers is None else carriers
    if not len(candidates):
        raise DataError("no body may carry the payload")
    change = change_between(known, known_target, rows, target, parameter_scale(len(before)))
    columns = {b: rows[:, PER_BODY * b : PER_BODY * (b + 1)] for b in candidates}
    if scale_sigma > 0.0:
        joints = [np.repeat(np.arange(len(part)), [len(one.z) for one in part]) for part in (before, later)]
        change = _with_scale_errors(
            change,
            np.concatenate([known_target, target]),
            np.concatenate(joints),
            scale_sigma,
            columns,
            likely,
        )
    none, fits = change.target, _fits(change, columns, likely)
    gains = {b: float(none @ none) - misfit for b, (_, misfit) in fits.items()}
    best = max(gains, key=lambda b: gains[b])
    rival = max((b for b in gains if b != best), key=lambda b: gains[b], default=None)
    (one, misfit), pseudo = fits[best], pseudo_inertia(fits[best][0].x)
    make_read_only((one.x, one.covariance, pseudo))
    return Payload(
        carrier=best,
        changed=float(none @ none) > FOUND_ABOVE + EXPLAINED_BELOW * len(none) or gains[best] > FOUND_ABOVE,
        left=misfit / max(len(none) - PER_BODY, 1),
        phi=one.x,
        covariance=one.covariance,
        pseudo=pseudo,
        gain=gains[best],
        rival=gains[rival] if rival is not None else 0.0,
        rival_carrier=rival,
    )


class Change(NamedTuple):
    """What two sets of whitened rows say that no parameters common to both explain.

    target: (j,) whitened, zero but for noise if nothing has changed. directions: (k + k', j) of it, of the
    earlier and the later rows; later: (k', j), those of the later rows.
    """

    target: Array
    directions: Array
    later: Array

    def along(self, columns: ArrayLike) -> Array:
        """Return the columns (j, c) of parameters that only the later rows have, of theirs (k', c)."""
        return np.asarray(self.later.T @ np.asarray(columns, dtype=float))


def change_between(known: Array, known_target: Array, rows: Array, target: Array, scale: Array) -> Change:
    """Project two sets of rows onto the complement of their common range.

    Args:
        known, known_target: (k, p) and (k,) whitened rows before. rows, target: (k', p) and (k',) later.
        scale: (p,) by which parameters are counted (`base_parameters.Columns`).
    """
    left, values, _ = np.linalg.svd(np.vstack([known, rows]) * scale)
    beyond = left[:, int((values > RANK_TOLERANCE * values[0]).sum()) :]
    return Change(beyond.T @ np.concatenate([known_target, target]), beyond, beyond[len(known) :])


def _fits(change: Change, columns: Mapping[int, Array], likely: Array) -> dict[int, tuple[Solution, float]]:
    """Return the payload on each body, and the misfit with it."""
    return {b: consistent_payload(change.along(own), change.target, likely[b]) for b, own in columns.items()}


def _with_scale_errors(
    change: Change,
    target: Array,
    joints: Array,
    scale_sigma: float,
    columns: Mapping[int, Array],
    likely: Array,
) -> Change:
    """Return a change as it counts where the joints' readings have errors of scale.

    An error of scale is relative to the torque that the model predicts with the payload. Relative to the
    measured one, small readings would count as surer than large ones, and the mass come out too small
    (Peelle's pertinent puzzle; D'Agostini 1994). The prediction is that of a fit with the measured ones.

    Args:
        target: (k + k',) whitened, of all rows. joints: (k + k',) the joint that each is of.
        columns: (k', 10) of a payload on each body that may carry it. likely: (n, 3) its centre on each.
    """
    first = _decorrelated(change, target, joints, scale_sigma)
    fits = _fits(first, columns, likely)
    best = min(fits, key=lambda b: fits[b][1])
    left = change.target - change.along(columns[best]) @ fits[best][0].x
    return _decorrelated(change, target - change.directions @ left, joints, scale_sigma)


def _decorrelated(change: Change, torque: Array, joints: Array, scale_sigma: float) -> Change:
    """Return a change as it counts with independent errors of the joints' scales, relative to `torque`."""
    by_joint = np.where(joints[:, None] == np.unique(joints), torque[:, None], 0.0)
    weight = decorrelation(scale_sigma * (change.directions.T @ by_joint))
    return Change(weight @ change.target, change.directions @ weight, change.later @ weight)


def consistent_payload(
    columns: Array, none: Array, place_m: Array, likely_kg: float = LIKELY_KG
) -> tuple[Solution, float]:
    """Return the physically consistent payload on one body, and the misfit with it.

    Args:
        columns: (j, 10) of the payload. none: (j,) what no parameters of the robot explain.
        place_m: (3,) its likely centre, in the frame of the columns. likely_kg: its likely mass.
    """
    triangle = qr(np.column_stack([columns, none]), mode="r", check_finite=False)[0][: PER_BODY + 1]
    rows, target = triangle[:, :-1], triangle[:, -1]
    centre = np.append(place_m, 1.0)
    prior = likely_kg * np.outer(centre, centre)
    prior[:3, :3] += likely_kg * LIKELY_SIZE_M**2 * np.eye(3)
    solution = physically_consistent(rows, target, prior[None], PRIOR_WEIGHT)
    off = rows @ solution.x - target
    return solution, float(off @ off)
