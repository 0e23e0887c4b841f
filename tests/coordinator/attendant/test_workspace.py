"""No motion leaves the space that a person gave the robot; what is forbidden is not commanded at all."""

from pathlib import Path

import numpy as np
import pytest

from coordinator.attendant.workspace import Box, Workspace, WorkspaceGate, load_workspace
from coordinator.excitation.plan import Plan
from coordinator.excitation.self_collision import link_axes
from coordinator.live_robot.errors import MotionForbidden
from module_agent.model.errors import UsageError
from module_agent.wire.messages import ConstantMotion, GoTo, Rest
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain

ARM = load_robot("a2085_03")
YAW, LIFT, ELBOW = ARM.serials
HOME = dict.fromkeys(ARM.serials, 0.0)
# The arm lies level at home, and is 0.7 m long with its tool.
WIDE = Box(low_m=(-1.5, -1.5, -1.5), high_m=(1.5, 1.5, 1.5))


def gate(
    box: Box = WIDE, present: tuple[str, ...] = ARM.serials, **joints: tuple[float, float]
) -> WorkspaceGate:
    ranges = {"all": (-1.2, 1.2), **{name.replace("_", "-"): each for name, each in joints.items()}}
    return WorkspaceGate(Workspace(box=box, joints=ranges), true_chain(ARM), 0.0, present)


def to(**targets_rad: float) -> dict[str, GoTo]:
    return {
        name.replace("_", "-"): GoTo(target_rad=q, max_speed_rad_s=1.0) for name, q in targets_rad.items()
    }


def test_a_joint_stays_in_its_range_along_the_whole_path() -> None:
    free = gate(elbow=(-0.4, 0.4))
    free.admit(to(elbow=0.4), HOME)
    with pytest.raises(MotionForbidden, match=r"elbow would go to 0\.50 rad.*-0\.40 to 0\.40"):
        free.admit(to(elbow=0.5), HOME)
    # In between, not at its end: a constant motion of 0.9 rad through home.
    with pytest.raises(MotionForbidden, match="elbow"):
        free.admit({ELBOW: ConstantMotion(velocity_rad_s=1.0, duration_s=0.75)}, HOME)


def test_what_a_joint_moves_stays_in_the_box() -> None:
    # The box fits the arm at home with 0.25 m to spare; turned by 1.1 rad its end is half a metre aside.
    ends = link_axes(true_chain(ARM)).ends.reshape(-1, 3)
    low, high = ends.min(axis=0) - 0.25, ends.max(axis=0) + 0.25
    fitting = gate(Box(low_m=_triple(low), high_m=_triple(high)))
    fitting.admit(to(shoulder_yaw=0.05), HOME)
    with pytest.raises(MotionForbidden, match=r"the body that elbow turns.*out of the box"):
        fitting.admit(to(shoulder_yaw=1.1), HOME)
    gate().admit(to(shoulder_yaw=1.1), HOME)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _admits(what: WorkspaceGate, motion: dict[str, GoTo]) -> bool:
    try:
        what.admit(motion, HOME)
    except MotionForbidden:
        return False
    return True


def test_a_floor_is_no_way_down_and_the_way_up_is_free() -> None:
    floor = gate(Box(low_m=(-1.5, -1.5, -0.25), high_m=(1.5, 1.5, 1.5)))
    down_up = [_admits(floor, to(shoulder_lift=q)) for q in (-0.9, 0.9)]
    assert sorted(down_up) == [False, True]


def test_a_limp_arm_that_hangs_outside_comes_in_and_returns_to_where_it_hung_and_no_further() -> None:
    hung = {**HOME, LIFT: -1.5}
    arm = gate()
    arm.admit(to(shoulder_lift=0.0), hung)
    with pytest.raises(MotionForbidden):
        arm.admit(to(shoulder_lift=-1.6), HOME)
    arm.admit(to(shoulder_lift=-1.5), HOME)
    # Another motion than the way back does not get there.
    with pytest.raises(MotionForbidden):
        arm.admit({LIFT: ConstantMotion(velocity_rad_s=-1.0, duration_s=1.2)}, HOME)


def test_links_do_not_come_near_each_other() -> None:
    arm = load_robot("arm6")
    # A-3 folds the forearm onto the upper arm; A-2 turns both together.
    folding, turning = arm.serials[2], arm.serials[1]
    home = dict.fromkeys(arm.serials, 0.0)
    free = Workspace(box=WIDE, joints={"all": (-3.1, 3.1)})
    clear = WorkspaceGate(free, true_chain(arm), 0.0, arm.serials)
    clear.admit({turning: GoTo(target_rad=2.8, max_speed_rad_s=1.0)}, home)
    with pytest.raises(MotionForbidden, match="nearer to each other"):
        clear.admit({folding: GoTo(target_rad=2.8, max_speed_rad_s=1.0)}, home)


def test_a_module_whose_place_is_unknown_needs_room_to_reach() -> None:
    tight = Box(low_m=(-0.9, -0.9, -0.6), high_m=(0.9, 0.9, 0.6))
    gate(tight).admit(to(shoulder_lift=0.3), HOME)
    with pytest.raises(MotionForbidden, match="unknown"):
        gate(tight, (*ARM.serials, "hand")).admit(to(shoulder_lift=0.3), HOME)
    # Once it is explored its place is known.
    explored = gate(tight, (*ARM.serials, "hand"))
    explored.learn(true_chain(ARM))
    explored.admit(to(shoulder_lift=0.3), HOME)


def test_a_robot_of_which_nothing_is_known_is_not_moved() -> None:
    with pytest.raises(MotionForbidden, match="identify it"):
        gate(present=("hand", LIFT, ELBOW))


def test_standing_still_is_always_allowed() -> None:
    gate().admit(dict.fromkeys(ARM.serials, Rest(duration_s=1.0)), {**HOME, LIFT: -2.0})


def test_designed_motions_are_judged_on_their_way_from_home() -> None:
    arm = gate()
    assert arm.allows(np.zeros((5, 3)))
    assert not arm.allows(np.array([[0.0, 0.0, 1.3]]))
    low = gate(Box(low_m=(-1.5, -1.5, -0.25), high_m=(1.5, 1.5, 1.5)))
    assert sorted(low.allows(np.array([[0.0, q, 0.0]])) for q in (-0.9, 0.9)) == [False, True]


def test_a_plan_keeps_to_the_room_of_the_joints_and_begins_slowly() -> None:
    room = Workspace(box=WIDE, joints={"all": (-1.2, 1.2), ELBOW: (-0.4, 0.6)})
    plan = room.plan(Plan(), ARM.serials)
    assert plan.excitation_reach_rad == pytest.approx(0.4)
    assert plan.trial_speed_rad_s == room.trial_speed_rad_s
    half_way = 0.5 * plan.constant_velocity_rad_s * (plan.constant_duration_s + 0.15)
    assert half_way < 0.4
    gate(elbow=(-0.4, 0.6)).admit({ELBOW: plan.constant()}, {**HOME, ELBOW: -half_way})
    with pytest.raises(UsageError, match="elbow"):
        Workspace(box=WIDE, joints={"all": (-1.2, 1.2), ELBOW: (-0.1, 0.6)}).plan(Plan(), ARM.serials)
    with pytest.raises(UsageError, match=r"0\.4 rad to either side of home: constant_duration_s: exp"):
        room.plan(Plan(constant_velocity_rad_s=6.0), ARM.serials)


def test_a_range_of_a_joint_that_is_misspelt_does_not_pass_for_one_of_all() -> None:
    Workspace(box=WIDE, joints={"all": (-1.2, 1.2), ELBOW: (-0.4, 0.6)}).check_joints(ARM.serials)
    wrong = Workspace(box=WIDE, joints={"all": (-1.2, 1.2), "elbw": (-0.4, 0.6)})
    with pytest.raises(UsageError, match=r"ranges of elbw, which the robot does not have: .*elbow"):
        wrong.check_joints(ARM.serials)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("box = ", "not TOML"),
        ("[joints]\nall = [-1, 1]", "box"),
        ("[box]\nlow_m = [0, 0, 0]\nhigh_m = [1, 1, 1]\n[joints]\nelbow = [-1, 1]", "joints.all is missing"),
        ("[box]\nlow_m = [0, 0, 0]\nhigh_m = [1, 0, 1]\n[joints]\nall = [-1, 1]", "below"),
        ("[box]\nlow_m = [0, 0, 0]\nhigh_m = [1, 1, 1]\n[joints]\nall = [1, -1]", "joints.all"),
        ("[box]\nlow_m = [0, 0, 0]\nhigh_m = [1, 1, nan]\n[joints]\nall = [-1, 1]", "high_m"),
        (
            "hurry = 1\n[box]\nlow_m = [0, 0, 0]\nhigh_m = [1, 1, 1]\n[joints]\nall = [-1, 1]",
            r"room.toml:1: hurry: unknown key",
        ),
    ],
)
def test_a_file_that_is_no_workspace_is_refused_with_its_key(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "room.toml"
    path.write_text(text)
    with pytest.raises(UsageError, match=words):
        load_workspace(path)
