"""Mass matrix, bias forces and IMU readings of a skeleton at one instant.

IMU readings need position, velocity and acceleration of one instant: with semi-implicit Euler that is
(q_n, (qd_n + qd_{n+1})/2, (qd_{n+1} - qd_n)/dt). Measured on a 2 Hz motion: the specific force is then wrong
by less than 1e-4 m/s^2, with other combinations by 3e-2.
"""

import numpy as np

from sim.geometry.pose import Array
from sim.physics.rigid_kernels import Tree, imu_readings, joint_loads, mass_and_biases
from sim.physics.skeleton import Skeleton


class RigidTree:
    """The bodies and IMUs of a skeleton, (m,) joint coordinates in its order.

    `arrays` is what the kernels know of them.
    """

    def __init__(self, skeleton: Skeleton):
        # Copies, all writable and contiguous: a kernel is compiled once for every kind of array it meets.
        joints = (
            np.array(skeleton.parent, dtype=np.int64),
            np.array(skeleton.prismatic, dtype=np.int64),
            np.array(skeleton.axis_sign),
            np.array(skeleton.origin[:, :3, :3], order="C"),
            np.array(skeleton.origin[:, :3, 3], order="C"),
        )
        bodies = (
            np.array([b.mass_kg for b in skeleton.bodies]),
            np.array([b.com_m for b in skeleton.bodies]),
            np.array([b.inertia_kg_m2 for b in skeleton.bodies]),
        )
        imus = (
            np.array(skeleton.imu_body, dtype=np.int64),
            np.array(skeleton.imu_pose[:, :3, 3], order="C"),
            np.array(skeleton.imu_pose[:, :3, :3], order="C"),
        )
        self.arrays = Tree(joints, bodies, imus, skeleton.gravity_m_s2)

    def mass_and_bias(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Return the mass matrix M (m, m) and the bias forces (m,) of gravity and velocities.

        The joints' forces or torques are M qdd + bias.
        """
        mass, biases = self.mass_and_biases(q, qd[None])
        return mass, biases[0]

    def mass_and_biases(self, q: Array, rates: Array) -> tuple[Array, Array]:
        """Return the same, with one row of biases (R, m) for each of several velocities (R, m)."""
        return mass_and_biases(self.arrays, q, rates)

    def imu_readings(self, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
        """Return the angular rates and specific forces (n, 3) in the IMUs' frames [rad/s, m/s^2]."""
        return imu_readings(self.arrays, q, qd, qdd)

    def joint_loads(self, q: Array, body: int, point_m: Array, force_n: Array, moment_nm: Array) -> Array:
        """Return the forces or torques (m,) on the joints of a wrench on one body.

        The force acts at `point_m` in the body's frame; force and moment are in world axes, (3,) each.
        """
        return joint_loads(self.arrays, q, body, point_m, force_n, moment_nm)
