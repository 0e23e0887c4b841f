"""The compiled engine moves bodies as PyBullet does: over random trees, alone and as a whole world."""

import numpy as np
import pytest

from sim.imperfections.noise_profile import noise_profile, switched
from sim.physics.engine import CompiledEngine
from sim.physics.multibody import Multibody
from sim.physics.rigid_tree import RigidTree
from sim.physics.skeleton import build_skeleton
from sim.robot.random_robot import random_robot
from sim.robot.robot_file import load_robot
from sim.world.external_force import Push
from sim.world.world import TICK_S, World


@pytest.mark.parametrize("seed", range(6))
def test_a_random_tree_under_random_forces_moves_alike_in_both_engines(seed: int) -> None:
    skeleton = build_skeleton(random_robot(seed), 1.0, 1.0)
    tree, m = RigidTree(skeleton), len(skeleton.names)
    rng = np.random.default_rng(seed)
    q, qd = rng.uniform(-1.0, 1.0, m), rng.uniform(-1.0, 1.0, m)
    q[list(skeleton.passive)] *= 0.01
    qd[list(skeleton.passive)] *= 0.01
    compiled, bullet = CompiledEngine(skeleton, TICK_S), Multibody("random", skeleton, TICK_S)
    for _ in range(20):
        mass, bias = tree.mass_and_bias(q, qd)
        qdd = rng.uniform(-10.0, 10.0, m)
        # Forces that give moderate accelerations: random ones would throw the lightest bodies about.
        force = mass @ qdd + bias
        compiled.place(q, qd)
        bullet.place(q, qd)
        ours = compiled.step(force, qdd, bias[None])
        theirs = bullet.step(force, qdd, np.stack([bias, bias]))
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-9)
        q, qd = theirs
    bullet.close()


@pytest.mark.parametrize("name", ["a2085_04", "tree_y", "arm7"])
def test_a_world_with_every_effect_goes_the_same_way_in_both_engines(name: str) -> None:
    # With a gap in the gears rounding decides at times whether flanks touch, and the ways part.
    robot, noise = load_robot(name), switched(noise_profile("poor"), off=("backlash",))
    push = Push(serial=robot.serials[-1], force_n=(3.0, -2.0, 5.0), from_s=0.1, for_s=0.2)
    ways = []
    for physics in ("compiled", "pybullet"):
        world = World(robot, 3, noise, pushes=(push,), physics=physics)
        phase = np.arange(len(robot.serials))
        rows = []
        for k in range(400):
            world.step((0.2 * np.sin(6.0 * k * TICK_S + phase)).tolist())
            rows.append((world.plant.q_rad, world.plant.qd_rad_s, world.plant.spring_torque_nm))
        ways.append(np.array(rows))
        world.close()
    np.testing.assert_allclose(ways[0], ways[1], rtol=0.0, atol=1e-9)
    assert np.ptp(ways[0][:, 0], axis=0).min() > 1e-3
