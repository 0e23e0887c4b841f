"""Where things are drawn, against what the chain says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.description.module_geometry import from_z, links
from coordinator.viewer.scene import robot_scene
from coordinator.viewer.scene.robot_geometry import ball_around, modules, side_by_side, upright
from coordinator.viewer.scene.topology_graph import as_topology, extent, positions
from module_agent.model.chain import Chain
from module_agent.model.forward_kinematics import body_displacements, imu_poses

directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)


@given(directions)
def test_the_robot_is_drawn_with_gravity_straight_down(specific_force: tuple[float, ...]) -> None:
    gravity = 9.81 * np.array(specific_force) / np.linalg.norm(specific_force)
    np.testing.assert_allclose(upright(gravity).apply(gravity), [0.0, 0.0, 9.81], atol=1e-9)


@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
def test_straight_up_and_upside_down_are_rotations_too(axis: list[float]) -> None:
    np.testing.assert_allclose(from_z(np.array(axis)).apply([0.0, 0.0, 1.0]), axis, atol=1e-12)
    assert np.linalg.det(from_z(np.array(axis)).as_matrix()) == pytest.approx(1.0)


def test_a_gravity_without_direction_is_refused() -> None:
    with pytest.raises(ValueError, match="no direction"):
        upright(np.zeros(3))


def test_a_reversed_module_has_its_output_on_the_parent_and_its_housing_on_itself(
    arm: Chain, types: dict[str, str]
) -> None:
    forward, mirrored = modules(arm, types)
    assert (forward.housing_body, forward.output_body) == (-1, 0)
    assert (mirrored.housing_body, mirrored.output_body) == (1, 0)


def test_housings_are_where_the_imus_say_and_outputs_on_the_axes(arm: Chain, types: dict[str, str]) -> None:
    first, second = modules(arm, types)
    np.testing.assert_allclose(first.housing, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(first.output, [0.0, 0.0, 0.03105], atol=1e-12)
    # The second housing's z is the root's y, and its output is 31 mm along it from its origin at 0.3 m.
    np.testing.assert_allclose(second.housing[:3, 3], [0.0, 0.0, 0.3], atol=1e-12)
    np.testing.assert_allclose(second.output, [0.0, 0.03105, 0.3], atol=1e-12)


def test_a_link_runs_from_output_to_output_of_a_reversed_module(arm: Chain, types: dict[str, str]) -> None:
    _, link = links(arm, modules(arm, types))
    assert link.body == 0
    np.testing.assert_allclose(link.start, [0.0, 0.0, 0.03105], atol=1e-12)
    np.testing.assert_allclose(link.end, [0.0, 0.03105, 0.3], atol=1e-12)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_both_ends_of_a_link_stay_on_their_axes_in_every_posture(q0: float, q1: float) -> None:
    arm, types = _arm()
    placed = modules(arm, types)
    motion = body_displacements(arm, np.array([[q0, q1]]))[0]
    output = motion[placed[1].output_body] @ [*placed[1].output, 1.0]
    # Seen from the reversed housing, its own output stays where it was built.
    from_housing = np.linalg.inv(motion[1] @ placed[1].housing) @ output
    np.testing.assert_allclose(from_housing[:3], [0.0, 0.0, 0.03105], atol=1e-9)


def _arm() -> tuple[Chain, dict[str, str]]:
    imu_home = np.tile(np.eye(4), (2, 1, 1))
    imu_home[0, :3, 3] = (0.025, 0.0, 0.003)
    imu_home[1, :3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    imu_home[1, :3, 3] = (0.025, 0.003, 0.3)
    axis = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    point = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3]])
    gravity = np.array([0.0, 0.0, 9.81])
    chain = Chain(("a", "b"), (-1, 0), (False, True), axis, point, imu_home, gravity)
    return chain, {"a": "X5-9", "b": "X5-4"}


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)), min_size=1, max_size=4))
def test_the_camera_is_set_for_a_ball_that_holds_all_modules_in_all_postures(
    postures: list[tuple[float, float]],
) -> None:
    arm, types = _arm()
    q = np.array(postures)
    ball = ball_around(arm, modules(arm, types), q)
    for moved in body_displacements(arm, q):
        for module, motion in zip(modules(arm, types), moved, strict=True):
            output = (motion @ [*module.output, 1.0])[:3]
            assert np.linalg.norm(output - ball.centre_m) <= ball.radius_m + 1e-9
    # And is no larger than the box around them.
    assert ball.radius_m <= 0.5 * np.linalg.norm([0.4, 0.4, 0.5])
    assert ball._replace(radius_m=1.1 * ball.radius_m).holds(ball)
    assert not ball.holds(ball._replace(centre_m=(1.0, 0.0, 0.0)))


def test_sigmas_of_another_robot_are_refused(arm: Chain, types: dict[str, str]) -> None:
    colours = dict.fromkeys(arm.serials, (1, 2, 3, 255))
    with pytest.raises(ValueError, match="3 sigmas for a chain of 2 joints"):
        robot_scene.build_scene(arm, types, colours, [0.1, 0.1, 0.1])


trees = st.integers(1, 20).flatmap(lambda n: st.tuples(*(st.integers(-1, k - 1) for k in range(n))))


@given(trees)
def test_children_are_below_their_parents_and_no_two_modules_overlap(parent: tuple[int, ...]) -> None:
    serials = [f"m{k}" for k in range(len(parent))]
    topology = as_topology(serials, parent, [False] * len(parent))
    base, *places = positions(topology)
    assert len(dict.fromkeys([base, *places])) == len(parent) + 1
    for k, above in enumerate(parent):
        assert places[k][1] > (base if above == -1 else places[above])[1]
    x_min, x_max, y_min, y_max = extent(topology)
    assert all(x_min < x < x_max and y_min < y < y_max for x, y in [base, *places])


def test_a_chain_of_sixty_four_modules_is_one_straight_line() -> None:
    serials = [f"m{k}" for k in range(64)]
    places = positions(as_topology(serials, range(-1, 63), [False] * 64))
    assert len(dict.fromkeys(x for x, _ in places)) == 1


def three(arm: Chain) -> Chain:
    """Return three arms at one place, on a tilted base."""
    arrays = {name: np.concatenate([getattr(arm, name)] * 3) for name in ("axis", "point", "imu_home")}
    return Chain(
        serials=tuple(f"{s}{n}" for n in range(3) for s in arm.serials),
        parent=(-1, 0, -1, 2, -1, 4),
        reversed=arm.reversed * 3,
        gravity=np.array([3.0, 5.0, 7.9]),
        **arrays,
    )


def test_a_single_tree_is_not_moved(arm: Chain) -> None:
    assert side_by_side(arm) is arm


def test_trees_are_moved_apart_horizontally_and_not_changed(arm: Chain) -> None:
    chain = three(arm)
    apart = side_by_side(chain)
    q = np.array([[0.3, -0.8] * 3])
    before, after = imu_poses(chain, q)[0], imu_poses(apart, q)[0]
    np.testing.assert_array_equal(after[:2], before[:2])
    shift = after[:, :3, 3] - before[:, :3, 3]
    np.testing.assert_allclose(shift @ chain.gravity, 0.0, atol=1e-12)
    np.testing.assert_allclose(after[:, :3, :3], before[:, :3, :3], atol=1e-12)
    for tree in (2, 4):
        np.testing.assert_allclose(shift[tree], shift[tree + 1], atol=1e-12)
    along = shift[2] / np.linalg.norm(shift[2])
    reach = [(p @ along).tolist() for p in apart.imu_home[:, :3, 3].reshape(3, 2, 3)]
    assert max(reach[0]) + 0.2 < min(reach[1])
    assert max(reach[1]) + 0.2 < min(reach[2])
