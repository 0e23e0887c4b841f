"""Both engines move the same robot: what is identified of it does not depend on which one did."""

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify_kinematics
from coordinator.kinematics.chain_estimate import ChainEstimate
from module_agent.network_emulation.profile import PROFILES
from sim.physics.engine import CompiledEngine, Physics
from sim.robot.robot_file import load_robot
from sim.scoring.gauge_alignment import tip_error
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from sim.virtual_time.session import record_session

# The engines differ by rounding, which the resolution of encoders and IMUs mostly hides. With play in the
# gears (`poor`) an impact amplifies it: there links differ by tenths of a millimetre.
SAME_M = 1e-6


def identified(physics: Physics, noise: str, plan: Plan) -> ChainEstimate:
    settings = VirtualSettings(load_robot("a2085_03"), PROFILES["lan"], 4, noise, physics=physics)

    def moved_by_it(robot: VirtualRobot) -> None:
        assert isinstance(robot.world._body, CompiledEngine) == (physics == "compiled")

    return identify_kinematics(record_session(settings, plan, moved_by_it)).fit


@pytest.mark.parametrize("noise", ["ideal", "x5"])
def test_links_and_tip_are_the_same_whichever_engine_moved_the_robot(noise: str, quick_plan: Plan) -> None:
    compiled, pybullet = (identified(physics, noise, quick_plan) for physics in ("compiled", "pybullet"))
    assert compiled.chain.parent == pybullet.chain.parent
    np.testing.assert_allclose(compiled.link_length_m[1:], pybullet.link_length_m[1:], rtol=0.0, atol=SAME_M)
    home = np.zeros((1, len(compiled.chain.serials)))
    assert tip_error(compiled.chain, pybullet.chain, home).position_m < SAME_M
