"""What the batch refinement works on: all joints and IMUs on one time base and through one low-pass."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.kinematics.base_motion import BaseMotion
from module_agent.dynamics.chain import Array


class SensorData(NamedTuple):
    """Samples of all joints and IMUs on one time base and through one low-pass, m samples of n modules.

    q_rad, qd_rad_s, qdd_rad_s2: (m, n). gyro_rad_s, accel_m_s2: (m, n, 3) in the IMU frames. imu_rates:
    (m, n, 6) how fast these two change [rad/s^2, m/s^3]; None if no IMU is late. base_motion: (m, 9) the
    base's rate, angular acceleration and acceleration beyond rest, as `BaseMotion` has them; None at rest.
    motion: (m,) the number of the motion that a sample belongs to, from 0 on; None if all belong to one. The
    samples of a motion are equally far apart, far enough for their errors to be independent.
    instrument: (m, 3 n) positions, velocities and accelerations without the encoders' noise, and without what
    is no larger; None if they are as measured.
    """

    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    imu_rates: Array | None = None
    base_motion: Array | None = None
    motion: NDArray[np.int64] | None = None
    instrument: Array | None = None

    @property
    def joints(self) -> tuple[Array, Array, Array]:
        """Positions, velocities and accelerations, (m, n) each."""
        return self.q_rad, self.qd_rad_s, self.qdd_rad_s2

    @property
    def smooth(self) -> tuple[Array, Array, Array]:
        """What the readings are differentiated by: noise in there would pass for motion, and bias the fit."""
        if self.instrument is None:
            return self.joints
        q, qd, qdd = np.split(self.instrument, 3, axis=1)
        return q, qd, qdd

    @property
    def base(self) -> BaseMotion | None:
        """How the base moved; None at rest."""
        if self.base_motion is None:
            return None
        omega, alpha, acceleration = np.split(self.base_motion, 3, axis=1)
        return BaseMotion(omega, alpha, acceleration)

    @property
    def motions(self) -> list[slice]:
        """The samples of every motion."""
        if self.motion is None:
            return [slice(0, len(self.q_rad))]
        ends = np.flatnonzero(np.diff(self.motion)) + 1
        return [slice(int(a), int(b)) for a, b in pairwise([0, *ends, len(self.motion)])]
