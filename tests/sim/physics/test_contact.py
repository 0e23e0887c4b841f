"""A robot touches what stands around it, and itself; springs and IMUs feel it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from module_agent.model.errors import UsageError
from sim.geometry.pose import Array
from sim.robot.robot_file import Obstacle, Robot, RobotFileError, load_robot, parse_robot
from sim.robot.robot_tree import build_tree
from sim.world.world import World

FAR_FLOOR = Obstacle(name="floor", floor=True, xyz_m=(0.0, 0.0, -3.0))
# Its near face is 200 mm from the joint: a hanging arm's last housing meets it at 1.23 rad below level.
WALL = Obstacle(name="wall", box_m=(0.1, 1.0, 0.8), xyz_m=(0.25, 0.0, -0.45), friction=0.0)


def _with(robot: Robot, *obstacles: Obstacle) -> Robot:
    return robot.model_copy(update={"obstacles": obstacles})


def _corners_of_the_last_housing(robot: Robot, q_rad: float) -> Array:
    """The corners (8, 3) of the envelope of a one-joint arm's last housing in the world."""
    tree = build_tree(robot)
    low, high = np.array(tree.types[1].housing_min_xyz), np.array(tree.types[1].housing_max_xyz)
    at = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, 8).T
    home = at @ tree.housing[1][:3, :3].T + tree.housing[1][:3, 3] - tree.output[0][:3, 3]
    turn = Rotation.from_rotvec(q_rad * tree.output[0][:3, 2]).as_matrix()
    return np.asarray(home @ turn.T + tree.output[0][:3, 3])


def test_an_arm_that_swings_into_a_wall_rests_there_and_pushes_with_what_its_weight_does_not_take() -> None:
    arm = load_robot("thesis_484_vertical")
    free, held = World(arm, 1, "ideal"), World(_with(arm, WALL), 1, "ideal", imu_rate_hz=1000.0)
    weights: list[tuple[float, float]] = []
    shocks: list[float] = []
    for _ in range(2000):
        free.step([0.15, 0.0])
        weights.append((free.plant.q_rad[0], free.plant.spring_torque_nm[0]))
        sample = held.step([0.15, 0.0])[1]
        shocks.append(float(np.linalg.norm([sample.accel_x_m_s2, sample.accel_y_m_s2])))
    plant, push_n = held.plant, held.contact_n[0]
    assert free.contact_n.tolist() == [0.0, 0.0]
    corners = _corners_of_the_last_housing(arm, plant.q_rad[0])
    touching = corners[np.argmax(corners[:, 0])]
    # The face is where the box says it is, to the depth by which hard contact gives.
    assert touching[0] == pytest.approx(0.2, abs=5e-4)
    # Slowly, free motion is nearly static: its spring carries the weight alone.
    weight_nm = np.interp(plant.q_rad[0], *np.array(weights).T)
    lever_m = np.hypot(*touching[[0, 2]]) * np.sin(np.arctan2(-touching[2], touching[0]))
    assert plant.spring_torque_nm[0] - weight_nm == pytest.approx(push_n * lever_m, rel=0.02)
    # At half a radian per second 0.24 m/s end within one tick.
    assert max(shocks) > 100.0
    free.close()
    held.close()


def test_a_folding_arm_stops_at_itself_and_passes_through_without_anything_to_touch() -> None:
    arm = load_robot("a2085_04")
    ends = []
    for robot in (arm, _with(arm, FAR_FLOOR)):
        world, largest_n = World(robot, 1, "ideal", physics="pybullet"), 0.0
        for _ in range(3500):
            world.step([0.0, 0.0, 0.2, 0.0])
            largest_n = max(largest_n, world.contact_n.max())
        ends.append((world.plant.q_rad[2], largest_n))
        world.close()
    (through_rad, nothing_n), (stopped_rad, force_n) = ends
    assert (through_rad > 4.0, nothing_n) == (True, 0.0)
    assert 2.0 < stopped_rad < 3.2
    assert force_n > 5.0


@pytest.mark.parametrize("name", ["a2085_06", "arm7", "tree_y", "snake16"])
def test_robots_do_not_touch_themselves_where_they_start(name: str) -> None:
    robot = load_robot(name)
    world = World(_with(robot, FAR_FLOOR), 1, "ideal")
    for _ in range(50):
        world.step([0.0] * len(robot.modules))
        assert not world.contact_n.any()
    world.close()


def test_a_robot_that_starts_within_an_obstacle_is_refused_by_name_and_depth() -> None:
    inside = WALL.model_copy(update={"xyz_m": (0.0, 0.0, -0.45)})
    with pytest.raises(UsageError, match=r"'wall' and X-0.* overlap by \d+ mm where the robot starts"):
        World(_with(load_robot("thesis_484_vertical"), inside), 1, "ideal")


def test_physics_without_contact_is_refused_where_there_is_something_to_touch() -> None:
    with pytest.raises(UsageError, match="compiled physics knows no contact"):
        World(_with(load_robot("a2085_03"), FAR_FLOOR), 1, physics="compiled")


def test_a_file_states_obstacles_and_what_free_parts_touch_with() -> None:
    text = """name = "post"

[[obstacle]]
name = "table"
box_m = [1.0, 1.0, 0.05]
xyz_m = [0.0, 0.0, -0.5]

[[obstacle]]
name = "pole"
cylinder_m = [0.05, 2.0]
sphere_m = 0.1

[[module]]
serial = "one"
type = "X5-4"
parent = "base"
payload = { mass_kg = 0.2, box_m = [0.1, 0.1, 0.1] }
"""
    with pytest.raises(RobotFileError, match=r"post.toml:8: obstacle.1.: .* exactly one of: box_m"):
        parse_robot(text, "post.toml")
    robot = parse_robot(text.replace("sphere_m = 0.1\n", ""), "post.toml")
    assert [one.shape.kind for one in robot.obstacles] == ["box", "cylinder"]
    (carried,) = build_tree(robot).moved_shapes[0]
    assert carried.size_m == (0.1, 0.1, 0.1)
