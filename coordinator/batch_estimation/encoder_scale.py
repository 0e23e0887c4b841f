"""Scales of encoders as nuisance parameters of the batch estimator, next to the links' compliances.

An encoder that reads too much or too little makes every IMU beyond its joint turn by more or by less than
predicted. Gyros with known scales and gravity tell; lengths of links follow the encoder otherwise.
"""

from collections.abc import Sequence

import numpy as np

from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.batch_estimation.link_compliance import ComplianceJacobian, JointTrack
from module_agent.model.chain import Chain

# Far more than any encoder is off; wrong gear ratios show as well.
ENCODER_SCALE_SIGMA = 0.05
_STEP = 1e-4


def with_encoder_scales(
    flex: ComplianceJacobian, chain: Chain, joints: JointTrack, modules: Sequence[int]
) -> ComplianceJacobian:
    """Return the slopes and those by relative changes of some joints' motions about their means, in the end.

    Args:
        flex: slopes by the links' compliances, for the same samples.
        chain: n joints.
        joints: positions, velocities and accelerations, (m, n) each.
        modules: k joints whose encoders' scales are free; the true motion is 1 + scale times the measured.
    """
    if not modules:
        return flex
    still, slopes = readings_on(chain, body_motions(chain, *joints)), []
    mean = joints[0].mean(axis=0)
    for module in modules:
        factor = np.ones(joints[0].shape[1])
        factor[module] += _STEP
        q, qd, qdd = mean + factor * (joints[0] - mean), factor * joints[1], factor * joints[2]
        moved = readings_on(chain, body_motions(chain, q, qd, qdd))
        change = [moved.gyro_rad_s - still.gyro_rad_s, moved.accel_m_s2 - still.accel_m_s2]
        slopes.append(np.concatenate(change, axis=2).transpose(2, 0, 1) / _STEP)
    return ComplianceJacobian(
        (*flex.links, *modules),
        np.append(flex.sigmas, np.full(len(modules), ENCODER_SCALE_SIGMA)),
        np.concatenate([flex.slopes, np.array(slopes)]),
        np.append(flex.taken, np.zeros(len(modules))),
    )
