"""What joint torques say of a change of the bodies' inertial parameters."""

from collections.abc import Sequence

import numpy as np

from coordinator.dynamics.base_parameters import whitened
from coordinator.dynamics.identification import parameter_scale
from coordinator.watching.evidence import Evidence, compressed
from coordinator.watching.stretch import Stretch
from module_agent.dynamics.chain import Array, Chain
from module_agent.dynamics.information import JointInformation, gather
from module_agent.dynamics.regressor import PER_BODY, inverse_dynamics

# How far parameters may be from where a fit has them, per `parameter_scale`: bodies weigh some hundred grams.
PRIOR_KG = 0.5
# Of a payload: a change of 1 is one of a kilogram at the body's place.
LARGE_KG = 1.0


def information_of(chain: Chain, stretch: Stretch) -> tuple[JointInformation, ...]:
    """Return the information of every joint."""
    return gather(chain, stretch.q_rad, stretch.qd_rad_s, stretch.qdd_rad_s2, stretch.tau_nm)


def torque_residual(chain: Chain, phi: Array, stretch: Stretch) -> Array:
    """Return what a model leaves of the torques, (m, n) [Nm]."""
    predicted = inverse_dynamics(chain, phi, stretch.q_rad, stretch.qd_rad_s, stretch.qdd_rad_s2)
    return np.asarray(stretch.tau_nm - predicted)


def torque_evidence(information: Sequence[JointInformation], phi: Array, sigma_nm: Array) -> Evidence:
    """Return the evidence (k, 10 n) about phi's deviation from `phi`, in kilograms by `parameter_scale`.

    sigma_nm: (n,) noise as if samples were independent.
    """
    rows, target = whitened(information, sigma_nm)
    return compressed(rows * parameter_scale(len(information)), target - rows @ phi)


def payload_changes(count: int) -> tuple[Array, ...]:
    """Return the hypotheses: all ten parameters of one body change."""
    unit = LARGE_KG * np.eye(PER_BODY * count)
    return tuple(unit[:, PER_BODY * b : PER_BODY * (b + 1)] for b in range(count))
