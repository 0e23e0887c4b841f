"""A robot's bodies are sums of its modules' parts, as the simulator puts them together."""

import numpy as np
import pytest

from coordinator.parameter_fit.module_parts import bodies_from_parts, part_columns, parts_of
from module_agent.model.chain import Array
from sim.benchmark.cases.reassembly import assemblies, reordered
from sim.geometry.pose import inverse, pose
from sim.geometry.rigid_body import joined, moved, parameters
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia


def part_inertia(robot: Robot) -> dict[str, Array]:
    """Every part's ten parameters in the frame of its module's IMU, by its name."""
    tree = build_tree(robot)
    found = {}
    for i, serial in enumerate(tree.serials):
        into = inverse(tree.housing[i] @ pose(tree.types[i].imu_xyz))
        held = joined([segment.body for segment in tree.segments[i]])
        way = ", reversed" if tree.reversed[i] else ""
        found[f"{serial} turned{way}"] = parameters(moved(tree.moved[i], into))
        found[f"{serial} held{way}"] = parameters(moved(held, into))
    return found


@pytest.mark.parametrize("name", ["a2085_03", "a2085_06", "arm7", "tree_y", "snake16"])
def test_the_bodies_of_a_robot_are_the_sums_of_its_parts(name: str) -> None:
    robot = load_robot(name)
    chain = true_chain(robot)
    parts = parts_of([chain])
    inertia = part_inertia(robot)
    phi = np.concatenate([inertia[part.name] for part in parts])
    np.testing.assert_allclose(
        bodies_from_parts(chain, parts) @ phi, true_inertia(robot).ravel(), rtol=1e-12, atol=1e-12
    )


def test_parts_stay_as_they_are_however_modules_are_put_together() -> None:
    robot = load_robot("a2085_03")
    built = part_inertia(robot)
    for other in (*assemblies(robot).values(), reordered(robot, np.array([1, 0, 2]))):
        again = part_inertia(other)
        assert set(again) == set(built)
        for name, inertia in again.items():
            np.testing.assert_allclose(inertia, built[name], rtol=1e-12, atol=1e-12)


def test_what_the_first_module_rests_on_makes_no_torque() -> None:
    chain = true_chain(load_robot("a2085_03"))
    parts = parts_of([chain])
    into = bodies_from_parts(chain, parts)
    silent = {parts[k // 10].name for k in np.flatnonzero(~into.any(axis=0))}
    assert silent == {"shoulder-yaw held"}
    assert len(part_columns(parts).names) == into.shape[1]


def test_a_part_that_is_missing_is_named() -> None:
    chain = true_chain(load_robot("a2085_03"))
    with pytest.raises(ValueError, match="elbow held is not among the 5 parts"):
        bodies_from_parts(chain, [part for part in parts_of([chain]) if part.name != "elbow held"])
