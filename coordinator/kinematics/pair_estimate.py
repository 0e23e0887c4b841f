"""What a module's local estimate of a joint is worth to the assembly of the chain."""

import numpy as np

from coordinator.kinematics.chain_observations import PairObservation
from module_agent.dynamics.chain import Array
from module_agent.wire.messages import Estimate


def circle_observation(estimate: Estimate, q_rad: Array) -> PairObservation | None:
    """Return the circle of an estimate as an observation; None without one.

    An IMU that turned by more or by less than the joint was moved by something else too: by held joints that
    give between the two, above all. By that share axis and distance are believed less.

    Args:
        estimate: what `serial` made of `joint`.
        q_rad: (n,) mean positions of all joints meanwhile.
    """
    circle = estimate.circle
    if circle is None:
        return None
    excess = abs(estimate.rate_ratio - 1.0)
    return PairObservation(
        estimate.joint,
        estimate.serial,
        np.array(circle.axis),
        np.array(circle.radial_m),
        circle.sigma_axis_rad + excess,
        circle.sigma_distance_m + excess * circle.distance_m,
        q_rad,
    )
