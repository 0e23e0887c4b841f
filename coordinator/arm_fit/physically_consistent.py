"""Real bodies that explain a recording, drawn towards those that the URDF claims where torques say little."""

from typing import NamedTuple

import numpy as np

from coordinator.arm_fit.cross_validation import Predictor, fit_part
from coordinator.arm_fit.problem import Problem
from coordinator.description.urdf_reader import UrdfRobot
from coordinator.dynamics.pseudo_inertia import (
    Body,
    body,
    is_consistent,
    nearest_consistent,
    parameter_transform,
    pseudo_inertia,
)
from coordinator.parameter_fit.physically_consistent import physically_consistent
from coordinator.parameter_fit.robust_least_squares import WeightedFit
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY

# The belief that a link's distribution of mass is as claimed to about 30 % (`physical_fit.WEIGHTS`).
USUAL_TRUST = 10.0
# Links are often given as points; no place of mass is known better than this.
SMEAR_M = 0.02


class RealBodies(NamedTuple):
    """Bodies that can exist and explain the torques, and the drives' parameters beside them; read-only.

    phi: (10 n,) in the root frame, as in `torque_regressor`. bodies: (n,) the same in their links' frames.
    drives: (k,) parameters of the drives. divergence: (n,) from what the URDF claims (`physical_fit`).
    """

    phi: Array
    bodies: tuple[Body, ...]
    drives: Array
    divergence: Array


def claimed_bodies(robot: UrdfRobot) -> Array:
    """Return the pseudo-inertias (n, 4, 4) that a URDF claims, in the root frame, made real if they are not.

    Raises:
        DataError: a body has no mass, so that nothing is known of it beforehand.
    """
    phi = np.zeros(PER_BODY * len(robot.bodies)) if robot.phi is None else robot.phi
    found = []
    for link, own in zip(robot.bodies, phi.reshape(-1, PER_BODY), strict=True):
        pseudo = pseudo_inertia(own)
        if not pseudo[3, 3] > 0.0:
            raise DataError(f"the URDF gives no mass to {link!r}; only sums of parameters are fitted")
        pseudo[:3, :3] += pseudo[3, 3] * SMEAR_M**2 * np.eye(3)
        found.append(pseudo if is_consistent(pseudo) else nearest_consistent(pseudo))
    return np.stack(found)


def real_bodies(problem: Problem, fit: WeightedFit, prior: Array, trust: float) -> RealBodies:
    """Return the real bodies nearest to the torques of a fit and to the prior (n, 4, 4).

    Raises:
        DataError: a trust that is not positive.
        NotSolvedError: numerical trouble.
    """
    # So many rows count as one; the joints' weights among each other stay those of the fit.
    alike = 1.0 / np.sqrt(np.median(fit.correlation))
    solution = physically_consistent(fit.rows * alike, fit.target * alike, prior, trust)
    phi, drives = solution.x[: problem.inertial].copy(), solution.x[problem.inertial :].copy()
    back = [parameter_transform(np.linalg.inv(home)) for home in problem.robot.homes]
    own = [turn @ one for turn, one in zip(back, phi.reshape(-1, PER_BODY), strict=True)]
    make_read_only((phi, drives, solution.divergence))
    return RealBodies(phi, tuple(body(pseudo_inertia(one)) for one in own), drives, solution.divergence)


def by_real_bodies(problem: Problem, prior: Array, trust: float) -> Predictor:
    """Return the predictor that fits real bodies."""

    def predict(seen: slice, tried: slice) -> Array:
        found = real_bodies(problem, fit_part(problem, seen), prior, trust)
        predicted: Array = problem.regressor[tried] @ np.concatenate([found.phi, found.drives])
        return predicted

    return predict
