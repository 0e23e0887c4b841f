"""What a module's local estimate of a joint is worth to the assembly of the chain."""

from math import pi

import numpy as np

from coordinator.chain import Array
from coordinator.kinematics.chain_observations import PairObservation
from module_agent.wire.messages import CircleEstimate, Estimate, RegressionEstimate

# The usual windowed sine's. At it a structure that gives turns the IMU by c omega^2 more than the encoder
# says.
_OMEGA_RAD_S = 2.0 * pi * 2.0


def pair_observation(estimate: Estimate, q_rad: Array) -> PairObservation | None:
    """Return an estimate as an observation, by the joint regression where there is one; None without either.

    An IMU that turned by more or by less than the joint was moved by something else too: by held joints that
    give between the two, above all. By that share axis and distance are believed less.

    Args:
        estimate: what `serial` made of `joint`.
        q_rad: (n,) mean positions of all joints meanwhile.
    """
    found = estimate.regression or estimate.circle
    if found is None:
        return None
    excess = abs(estimate.rate_ratio - 1.0) + _given(found)
    return PairObservation(
        estimate.joint,
        estimate.serial,
        np.array(found.axis),
        np.array(found.radial_m),
        found.sigma_axis_rad + excess,
        found.sigma_distance_m + excess * found.distance_m,
        q_rad,
    )


def _given(found: CircleEstimate | RegressionEstimate) -> float:
    return abs(found.compliance_s2) * _OMEGA_RAD_S**2 if isinstance(found, RegressionEstimate) else 0.0
