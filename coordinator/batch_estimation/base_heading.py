"""Turn a robot about a vertical axis until what its base does fits what its IMUs see of it.

Where no motion tells the heading of what lies beyond an axis that is parallel to gravity, a base that shakes
tells it all the same: the IMU on the base sees in which direction, and so do the others. The heading is
needed to subtract the shake; how well it is known is not claimed.
"""

import numpy as np

from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.kinematics.null_space import name_null_space
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import apply_perturbation


def faced(chain: Chain, data: SensorData, null_basis: Array) -> Chain:
    """Return the chain with every unknown heading as the base's motion in `data` shows it.

    What the gyros see correlates with what they should of the base's rates as c0 + c1 cos + c2 sin of the
    heading, whose maximum is known from three headings.
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
    """Return the product of the gyros' readings beyond those on a resting base, and the base's share."""
    resting = readings_on(chain, body_motions(chain, *data.joints)).gyro_rad_s
    shaken = readings_on(chain, body_motions(chain, *data.joints, data.base)).gyro_rad_s
    seen = data.gyro_rad_s - resting
    return float(np.sum((seen - seen.mean(axis=0)) * (shaken - resting)))
