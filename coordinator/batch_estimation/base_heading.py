"""Turn a robot about a vertical axis until the measured motion of its base fits its other IMUs.

No motion of joints resolves the heading of a branch beyond an axis that is parallel to gravity. A shaking
base
does: the IMU on the base measures the direction of the shake, and so do the others. The heading is needed to
subtract the shake; no uncertainty of it is claimed.
"""

import numpy as np

from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.kinematics.null_space import name_null_space
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import apply_perturbation


def faced(chain: Chain, data: SensorData, null_basis: Array) -> Chain:
    """Return the chain with every unresolved heading estimated from the base's motion in `data`.

    The correlation of the gyros' readings with the predicted rates of the base is c0 + c1 cos + c2 sin of the
    heading; three headings give its maximum.
    """
    if data.base_motion is None or not data.base_motion.any():
        return chain
    for item in name_null_space(chain, null_basis):
        if item.kind == "rotation_about_axis":
            twist = item.directions[:, 0]
            ahead, aside, behind = (
                _agreement(apply_perturbation(chain, heading * twist), data)
                for heading in (0.0, 0.5 * np.pi, np.pi)
            )
            middle = 0.5 * (ahead + behind)
            heading = np.arctan2(aside - middle, ahead - middle)
            chain = apply_perturbation(chain, heading * twist)
    return chain


def _agreement(chain: Chain, data: SensorData) -> float:
    """Return the sum of products of the gyros' measured and predicted rates by the base's motion."""
    resting = readings_on(chain, body_motions(chain, *data.joints)).gyro_rad_s
    shaken = readings_on(chain, body_motions(chain, *data.joints, data.base)).gyro_rad_s
    seen = data.gyro_rad_s - resting
    return float(np.sum((seen - seen.mean(axis=0)) * (shaken - resting)))
