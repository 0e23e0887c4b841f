"""Static equilibrium of a compliant robot: passive joints deflect until their springs carry the weight."""

import numpy as np

from sim.geometry.pose import Array
from sim.physics.rigid_tree import RigidTree
from sim.physics.skeleton import Skeleton
from sim.robot.robot_file import RobotFileError

_STEP = 1e-6
_ROUNDS = 30
# The rest position's force error, relative to the largest load: far below what a tick can show.
_TOLERANCE = 1e-12


class FallsOver(RobotFileError):
    """The base or the links of a robot are too soft to carry its weight."""


def equilibrium(name: str, tree: RigidTree, skeleton: Skeleton, module_rad: Array) -> tuple[Array, Array]:
    """Return all joints' positions at rest (m,), the modules' held at `module_rad`, and these' loads (n,).

    Newton's method on k q + bias(q) = 0 over the passive joints.

    Raises:
        FallsOver: the springs are too soft to carry the weight.
        RuntimeError: Newton's method did not converge.
    """
    q = np.zeros(len(skeleton.names))
    q[list(skeleton.module)] = module_rad
    passive = list(skeleton.passive)
    still = np.zeros_like(q)

    def unbalanced(at: Array) -> Array:
        return skeleton.stiffness * at[passive] + tree.mass_and_bias(at, still)[1][passive]

    for _ in range(_ROUNDS if passive else 0):
        residual = unbalanced(q)
        slope = np.empty((len(passive), len(passive)))
        for column, joint in enumerate(passive):
            nudged = q.copy()
            nudged[joint] += _STEP
            slope[:, column] = (unbalanced(nudged) - residual) / _STEP
        if np.linalg.eigvalsh((slope + slope.T) / 2.0)[0] <= 0.0:
            raise FallsOver(
                f"robot {name!r} falls over: its base or links are too soft to carry its weight; raise the "
                "stiffness in the robot file, or switch them off: --without base-shake --without link-flex"
            )
        q[passive] -= np.linalg.solve(slope, residual)
        load = tree.mass_and_bias(q, still)[1]
        if np.abs(unbalanced(q)).max() <= _TOLERANCE * max(1.0, float(np.abs(load).max())):
            break
    else:
        if passive:
            raise RuntimeError(
                f"equilibrium of robot {name!r}: Newton's method did not converge in {_ROUNDS} iterations"
            )
    return q, tree.mass_and_bias(q, still)[1][list(skeleton.module)]
