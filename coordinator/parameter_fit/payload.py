"""Identify a payload on a robot whose dynamics are known: mass, centre and inertia, and the body it is on.

A payload adds to the ten parameters of its body (Kubus, Kroeger and Wahl 2008, On-line estimation of inertial
parameters using a recursive total least-squares approach, identify it by a wrist sensor; here it comes from
the joints' torques). With the information of motions without it, and rows of later motions,

    [ R  0   ] [ phi ]   [ z  ]
    [ S  S_b ] [ psi ] = [ z' ],

S_b the columns of the body b that carries it. The robot's parameters are free within the information of both
motions, so that the payload's covariance contains their uncertainty. The payload is physically consistent.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import qr

from coordinator.dynamics.pseudo_inertia import parameter_scale, pseudo_inertia
from coordinator.parameter_fit.base_parameters import whitened
from coordinator.parameter_fit.physically_consistent import Solution, physically_consistent
from coordinator.parameter_fit.spectrum import RANK_TOLERANCE
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
) -> Payload:
    """Identify the payload that was added to one body of a robot between two motions.

    Args:
        before: information of motions without the payload, per joint of n.
        later: information of motions with it.
        places_m: (n, 3) likely place of a payload on each body, in the root frame at q = 0.
        sigma_nm: (n,) noise of the torques, including model errors.
        independent_fraction: independent samples per sample, below 1 after a low-pass.
        carriers: the bodies that may carry it; all when None.

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
    stacked = np.vstack([known, rows])
    none, beyond = _complement(stacked, np.concatenate([known_target, target]))
    fits: dict[int, tuple[Solution, float]] = {}
    for b in candidates:
        added = np.vstack([np.zeros((len(known), PER_BODY)), rows[:, PER_BODY * b : PER_BODY * (b + 1)]])
        fits[b] = _on(beyond.T @ added, none, likely[b])
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


def _complement(rows: Array, target: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis (k, j) of the complement of the rows' range, and the target (j,) in it.

    It is what no parameters of the robot explain.
    """
    scale = parameter_scale(rows.shape[1] // PER_BODY)
    left, values, _ = np.linalg.svd(rows * scale)
    rank = int((values > RANK_TOLERANCE * values[0]).sum())
    beyond = left[:, rank:]
    return beyond.T @ target, beyond


def _on(columns: Array, none: Array, place_m: Array) -> tuple[Solution, float]:
    """Return the payload on one body, likely at a place, and the misfit with it."""
    triangle = qr(np.column_stack([columns, none]), mode="r", check_finite=False)[0][: PER_BODY + 1]
    rows, target = triangle[:, :-1], triangle[:, -1]
    centre = np.append(place_m, 1.0)
    prior = LIKELY_KG * np.outer(centre, centre)
    prior[:3, :3] += LIKELY_KG * LIKELY_SIZE_M**2 * np.eye(3)
    solution = physically_consistent(rows, target, prior[None], PRIOR_WEIGHT)
    off = rows @ solution.x - target
    return solution, float(off @ off)
