"""Windows must count every sample once, and mean the same instant on both sides."""

import numpy as np

from module_agent.estimate.windows import imu_window, joint_window
from module_agent.wire.feedback_rows import ROW


def test_rows_that_repeat_an_imu_sample_count_once() -> None:
    rows = np.zeros(6, dtype=ROW)
    rows["t_ns"] = [0, 1, 2, 3, 3, 2]  # the last two came again, to fill a gap
    rows["imu_t_ns"] = [0, 0, 2, 2, 2, 2]
    rows["gyro_rad_s"][:, 2] = [5, 5, 7, 7, 7, 7]
    rows["position_rad"] = [0.0, 0.1, 0.2, 0.3, 0.3, 0.2]
    imu, joint = imu_window(rows), joint_window(rows)
    np.testing.assert_array_equal(imu.t_ns, [0, 2])
    np.testing.assert_array_equal(imu.gyro_rad_s[:, 2], [5, 7])
    np.testing.assert_array_equal(joint.position_rad, [0.0, 0.1, 0.2, 0.3])
