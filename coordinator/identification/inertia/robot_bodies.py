"""A robot's bodies from torques and the catalogue: physically consistent, with their identifiability.

Base parameters and identifiability come from the torques alone. The bodies explain the torques too, and are
those of the catalogue where torques do not determine them. Parameters are those of `joint_frames`, in which
combinations are short; the bodies are in the frames of the URDF's links.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from coordinator.description.urdf_writer import link_homes
from coordinator.dynamics.inertia_prior import module_prior
from coordinator.dynamics.pseudo_inertia import Body, bodies_in_frames, parameter_transform
from coordinator.parameter_fit.base_parameters import (
    BaseParameters,
    base_parameters,
    inertial_columns,
    inertial_units,
    into_frames,
    joint_frames,
    whitened,
)
from coordinator.parameter_fit.identifiability import (
    Identifiability,
    base_summary,
    body_summary,
    identifiabilities,
)
from coordinator.parameter_fit.least_squares import InertialFit
from coordinator.parameter_fit.physically_consistent import NotSolvedError, PhysicalFit, fit_physical
from coordinator.parameter_fit.spectrum import ESTIMATED_CHAIN_TOLERANCE, MAX_SIGMA_KG
from coordinator.parameter_fit.systematic_errors import whitened_effects
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.information import JointInformation
from module_agent.model.regressor import PER_BODY

# Simulated torques without noise would have infinite weight.
_MIN_SIGMA_NM = 1e-9


class RobotBodies(NamedTuple):
    """The bodies of a robot of n joints.

    frames: (n, 4, 4) frames of the parameters, in the root frame at q = 0. base: the base parameters.
    identifiabilities: (10 n,) of every parameter. fit: the physically consistent bodies, None if the solver
    did not converge. bodies: (n,) the same in the links' frames; empty without. note: why.
    held_out_error: relative torque error of `fit` on motions that were not fitted, None without any.
    """

    serials: tuple[str, ...]
    frames: Array
    base: BaseParameters
    identifiabilities: tuple[Identifiability, ...]
    fit: PhysicalFit | None
    bodies: tuple[Body, ...]
    note: str
    held_out_error: float | None = None

    def summary(self) -> list[str]:
        """Return lines about the base parameters and the identifiability of each body's parameters."""
        lines = [base_summary(self.base)]
        for i, serial in enumerate(self.serials):
            own = self.identifiabilities[PER_BODY * i : PER_BODY * (i + 1)]
            lines.append(f"body {i + 1}, turned by {serial}: {body_summary(own)}")
        return lines


def robot_bodies(
    information: Sequence[JointInformation],
    chain: Chain,
    types: Sequence[ModuleType],
    least_squares: InertialFit,
    independent_fraction: float,
    effects: Sequence[Array] | None = None,
) -> RobotBodies:
    """Return the bodies that a robot's joints move.

    Args:
        information, chain, types: of n joints.
        least_squares: its noise weighs the joints.
        independent_fraction: independent samples per sample, below 1 after a low-pass.
        effects: (k_i, j) of every joint: effects of systematic errors on its rows (`systematic_errors`).

    Raises:
        ValueError: shapes that do not fit, or torques that say nothing.
    """
    joints = len(chain.serials)
    frames = joint_frames(chain)
    sigma = np.maximum(least_squares.torque_sigma_nm, _MIN_SIGMA_NM)
    rows, target = whitened(information, sigma, independent_fraction)
    common = None if effects is None else whitened_effects(effects, sigma, independent_fraction)
    base = base_parameters(
        into_frames(rows, frames),
        target,
        inertial_columns(joints),
        max_sigma=MAX_SIGMA_KG,
        common_errors=common,
        tolerance=ESTIMATED_CHAIN_TOLERANCE,
    )
    fit, note, bodies = None, "", tuple[Body, ...]()
    informed: tuple[Array, Array] | tuple[()] = ()
    try:
        prior = module_prior(chain, types)
        fit = fit_physical(information, prior, least_squares, independent_fraction, effects=effects)
    except NotSolvedError as error:
        note = f"{error}; the files have the consistent bodies nearest to the least-squares parameters"
    if fit is not None:
        into = block_diag(*(parameter_transform(np.linalg.inv(frame)) for frame in frames))
        informed = into @ fit.phi, np.sqrt(np.diagonal(into @ fit.covariance @ into.T))
        bodies = bodies_in_frames(fit.pseudo, link_homes(chain))
    results = identifiabilities(base, inertial_units(joints), *informed)
    return RobotBodies(chain.serials, frames, base, results, fit, bodies, note)
