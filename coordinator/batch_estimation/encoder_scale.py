"""Scales of encoders as nuisance parameters of the batch estimator, next to the links' compliances.

An encoder that reads too much or too little makes every IMU beyond its joint turn by more or by less than
predicted. Gyros with known scales and gravity tell; lengths of links follow the encoder otherwise.
"""

from collections.abc import Sequence

import numpy as np

from coordinator.batch_estimation.imu_jacobian import Displacements
from coordinator.batch_estimation.link_compliance import ComplianceJacobian
from module_agent.model.chain import Array, Chain

# Far more than any encoder is off; wrong gear ratios show as well.
ENCODER_SCALE_SIGMA = 0.05

JointTrack = tuple[Array, Array, Array]  # positions, velocities, accelerations, (m, n) each


def with_encoder_scales(
    flex: ComplianceJacobian, chain: Chain, joints: JointTrack, modules: Sequence[int]
) -> ComplianceJacobian:
    """Return the displacements by the links, then those by relative changes of some joints' motions.

    Args:
        flex: displacements by the links' compliances, for the same samples.
        chain: n joints.
        joints: positions, velocities and accelerations, (m, n) each.
        modules: k joints whose encoders' scales are free; the true motion about its mean is 1 + scale times
            the measured.
    """
    if not modules:
        return flex
    twists = []
    for module in modules:
        q, qd, qdd = (signal[:, module] for signal in joints)
        screw = np.r_[chain.axis[module], np.cross(chain.point[module], chain.axis[module])]
        twists.append(np.concatenate([np.outer(screw, signal) for signal in (q - q.mean(), qd, qdd)]))
    scales = Displacements.by_twists(tuple(modules), (True,) * len(modules), np.array(twists))
    return ComplianceJacobian(
        np.append(flex.sigmas, np.full(len(modules), ENCODER_SCALE_SIGMA)),
        flex.carried.joined(scales),
        np.append(flex.taken, np.zeros(len(modules))),
    )
