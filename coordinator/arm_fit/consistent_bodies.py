"""Physically consistent bodies that explain a recording, with the URDF's as the prior.

Where the torques do not determine a body it stays as in the URDF (`physically_consistent`).
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from coordinator.arm_fit.problem import Problem
from coordinator.description.urdf_reader import UrdfRobot
from coordinator.dynamics.pseudo_inertia import (
    Body,
    bodies_in_frames,
    is_consistent,
    nearest_consistent,
    pseudo_inertia,
)
from coordinator.parameter_fit.physically_consistent import physically_consistent
from coordinator.parameter_fit.robust_least_squares import WeightedFit
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY
from module_agent.signals.torque_terms import Term

# The belief that a link's mass distribution is known to about 30 % (`physically_consistent.WEIGHTS`).
USUAL_TRUST = 10.0
# Links are often given as points; no place of mass is known better than this.
SMEAR_M = 0.02
# What a URDF holds of a drive, in the order of `UrdfRobot.drives`.
URDF_TERMS: tuple[Term, ...] = ("inertia", "viscous", "coulomb")


class NoPriorError(DataError):
    """A body of the URDF has no mass, so that there is no prior for what the torques do not determine."""


class ConsistentBodies(NamedTuple):
    """Physically consistent bodies that explain the torques, and the parameters of the drives; read-only.

    phi: (10 n,) in the root frame, as in `torque_regressor`. bodies: (n,) the same in their links' frames.
    drives: (k,) parameters of the drives. divergence: (n,) from the prior (`physically_consistent`).
    """

    phi: Array
    bodies: tuple[Body, ...]
    drives: Array
    divergence: Array


def urdf_prior(robot: UrdfRobot) -> Array:
    """Return the pseudo-inertias (n, 4, 4) of a URDF in the root frame, made consistent if they are not.

    Raises:
        NoPriorError: a body has no mass.
    """
    phi = np.zeros(PER_BODY * len(robot.bodies)) if robot.phi is None else robot.phi
    prior = []
    for link, own in zip(robot.bodies, phi.reshape(-1, PER_BODY), strict=True):
        pseudo = pseudo_inertia(own)
        if not pseudo[3, 3] > 0.0:
            raise NoPriorError(f"the URDF gives no mass to {link!r}; only base parameters are fitted")
        pseudo[:3, :3] += pseudo[3, 3] * SMEAR_M**2 * np.eye(3)
        prior.append(pseudo if is_consistent(pseudo) else nearest_consistent(pseudo))
    return np.stack(prior)


def consistent_bodies(problem: Problem, fit: WeightedFit, prior: Array, trust: float) -> ConsistentBodies:
    """Return the consistent bodies that fit the rows of a fit best, with a prior (n, 4, 4) of weight `trust`.

    Raises:
        NotSolvedError: numerical trouble.
    """
    # So many rows count as one; the joints' weights among each other stay those of the fit.
    independent = 1.0 / np.sqrt(np.median(fit.correlation))
    solution = physically_consistent(fit.rows * independent, fit.target * independent, prior, trust)
    phi, drives = solution.x[: problem.inertial].copy(), solution.x[problem.inertial :].copy()
    pseudo = np.stack([pseudo_inertia(one) for one in phi.reshape(-1, PER_BODY)])
    make_read_only((phi, drives, solution.divergence))
    return ConsistentBodies(phi, bodies_in_frames(pseudo, problem.robot.homes), drives, solution.divergence)


def urdf_drives(problem: Problem, x: Array, some: slice) -> Array:
    """Return rotor inertia, damping and friction (n, 3), as a URDF has them, nearest to fitted drives.

    Where parameters x (p,) have nothing else these are the same; other terms of some samples are fitted by
    these three, none below zero, and an offset, which a URDF has no place for.
    """
    rigid = problem.regressor[some][..., : problem.inertial] @ x[: problem.inertial]
    further = problem.predicted(x, some) - rigid
    drives = np.zeros((len(problem.robot.bodies), len(URDF_TERMS)))
    for j, own in enumerate(drives):
        at = {
            URDF_TERMS.index(drive.term): problem.inertial + k
            for k, drive in enumerate(problem.drives)
            if drive.joints == (j,) and drive.term in URDF_TERMS
        }
        used = problem.moving[some][:, j]
        columns = problem.regressor[some][used][:, j][:, list(at.values())]
        sides = np.column_stack([columns, np.ones(used.sum()), -np.ones(used.sum())])
        own[list(at)] = nnls(sides, further[used, j])[0][: len(at)]
    return drives


def lacking(problem: Problem) -> tuple[str, ...]:
    """Return the names of the drives' parameters that a URDF has no place for."""
    return tuple(d.name for d in problem.drives if d.term not in URDF_TERMS or d.joints[1:])
