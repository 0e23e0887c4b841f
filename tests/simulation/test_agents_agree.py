"""What an agent claims of its own joint holds against the coordinator's chain of all joints.

Links bend and bases shake. Only the coordinator models all joints at once, so what an agent leaves out has to
be in its claim.
"""

from typing import NamedTuple

import numpy as np
import pytest

from coordinator.batch_estimation.estimator import with_placement
from module_agent.wire.messages import RegressionEstimate
from sim import simulate


class Difference(NamedTuple):
    """Between an agent's regression and the coordinator's chain, in the agent's standard deviations."""

    distance: float
    axis: float
    sigma_distance_m: float


def differences(noise: str, seed: int) -> list[Difference]:
    simulation = simulate("a2085_04", noise=noise, network="lan", seed=seed, dynamics=False)
    kinematics = simulation.identified.kinematics
    chain = with_placement(kinematics.fit.chain, kinematics.refinement.placement)
    found = []
    for child, parent in enumerate(chain.parent):
        if parent < 0:
            continue
        joint = chain.serials[parent]
        by_motion = simulation.recording.estimates[joint, chain.serials[child]]
        estimate = list(by_motion.values())[-1].best
        assert isinstance(estimate, RegressionEstimate)
        imu, axis = chain.imu_home[child], chain.axis[parent]
        arm = imu[:3, 3] - chain.point[parent]
        distance_m = np.linalg.norm(arm - axis * (axis @ arm))
        across = np.linalg.norm(np.cross(imu[:3, :3].T @ axis, estimate.axis))
        found.append(
            Difference(
                float(estimate.distance_m - distance_m) / estimate.sigma_distance_m,
                float(across) / estimate.sigma_axis_rad,
                estimate.sigma_distance_m,
            )
        )
    return found


# A bending tube leaves a millimetre open at 350 mm, an unknown scale of the accelerometer two to three.
@pytest.mark.parametrize(("noise", "most_m"), [("x5", 1.5e-3), ("x5-uncalibrated", 4e-3)])
def test_agents_and_coordinator_agree_within_what_the_agents_claim(noise: str, most_m: float) -> None:
    found = differences(noise, seed=2)
    assert len(found) == 3
    # One of 370 normal distances is beyond three sigmas, one of 460 directions across the axis beyond 3.5.
    assert max(abs(one.distance) for one in found) < 3.0
    assert max(one.axis for one in found) < 3.5
    assert max(one.sigma_distance_m for one in found) < most_m
