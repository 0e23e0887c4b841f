"""The excitation of a robot respects its modules' types and the limits that they report."""

import numpy as np
import pytest

from coordinator.excitation.joint_limits import NoExcitation
from coordinator.excitation.plan import Plan
from coordinator.excitation.robot_excitation import END_RAD, RobotModule, excitation_task, robot_excitation
from module_agent.control.gains import catalogue_limits
from module_agent.control.waveform import waveform
from module_agent.model.catalogue import module_type
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain

ROBOT = load_robot("a2085_04")
CHAIN = true_chain(ROBOT)
PLAN = Plan(excitation="d-optimal", excitation_motions=2, excitation_s=4.0)


def modules(**changed: float) -> list[RobotModule]:
    """All modules as the catalogue has them, but for what is `changed` of all their limits."""
    kinds = {module.serial: module_type(module.type) for module in ROBOT.modules}
    return [
        RobotModule(kinds[serial], catalogue_limits(kinds[serial]).model_copy(update=changed))
        for serial in CHAIN.serials
    ]


def test_motions_stay_within_the_positions_that_modules_allow() -> None:
    low, high = -0.25, 0.4
    found = robot_excitation(CHAIN, modules(min_position_rad=low, max_position_rad=high), PLAN)
    assert len(found) == PLAN.excitation_motions + 1
    t_s = np.linspace(0.0, PLAN.excitation_s, 400)
    reached = []
    for motion in found:
        for serial, pattern in motion.patterns.items():
            reached.append(motion.pose_rad[serial] + waveform(pattern, 0.0, t_s).offset_rad)
    assert np.min(reached) >= low + END_RAD
    assert np.max(reached) <= high - END_RAD
    # They are used, too: the range is no more than it has to be.
    assert np.max(reached) - np.min(reached) > 0.3


def test_speed_and_torque_are_those_that_modules_say() -> None:
    limited = modules(max_speed_rad_s=0.5, max_effort_nm=1.5)
    task = excitation_task(CHAIN, limited, PLAN)
    assert all(limit.speed_rad_s <= 0.5 for limit in task.limits)
    assert (task.max_effort_nm <= 1.5).all()
    free = excitation_task(CHAIN, modules(), PLAN)
    assert (free.max_effort_nm > task.max_effort_nm).any()


def test_a_module_that_may_not_leave_home_is_not_excited() -> None:
    with pytest.raises(NoExcitation, match="no room"):
        robot_excitation(CHAIN, modules(min_position_rad=0.0, max_position_rad=1.0), PLAN)


def test_the_same_robot_gets_the_same_motions() -> None:
    assert robot_excitation(CHAIN, modules(), PLAN) == robot_excitation(CHAIN, modules(), PLAN)
