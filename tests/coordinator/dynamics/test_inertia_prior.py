"""Before anything moves a robot is expected to be made of its modules and of links between them."""

from pathlib import Path

import numpy as np
import pytest

from coordinator.dynamics.inertia_prior import LINK_KG_M, MIN_LINK_KG, OUTPUT_SHARE, module_prior
from coordinator.dynamics.pseudo_inertia import body, is_consistent, pseudo_inertia
from sim.robot.random_robot import random_robot
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia

ROBOTS = Path(__file__).resolve().parents[3] / "sim" / "robots"


def robots() -> list[Robot]:
    return [load_robot(ROBOTS / f"{name}.toml") for name in ("a2085_04", "arm6", "tree_y")] + [
        random_robot(seed) for seed in range(12)
    ]


def test_every_expected_body_is_real_and_near_the_one_that_is_built() -> None:
    for robot in robots():
        tree = build_tree(robot)
        prior = module_prior(true_chain(robot), tree.types)
        for pseudo, phi in zip(prior, true_inertia(robot), strict=True):
            assert is_consistent(pseudo)
            expected, built = body(pseudo), body(pseudo_inertia(phi))
            # Links may be ten times as heavy as guessed, but they are not all of a body; a lone flange is
            # small either way.
            assert 0.25 * built.mass_kg - 0.03 < expected.mass_kg < 4.0 * built.mass_kg + 0.03
            # Half of the longest link that is drawn.
            assert np.linalg.norm(expected.com_m - built.com_m) < 0.17


def test_the_expected_mass_is_that_of_all_modules_but_for_what_stands_on_the_base() -> None:
    for robot in robots():
        tree, chain = build_tree(robot), true_chain(robot)
        expected = 0.0
        for i, (kind, parent) in enumerate(zip(tree.types, tree.parent, strict=True)):
            turned = OUTPUT_SHARE if not tree.reversed[i] else 1.0 - OUTPUT_SHARE
            expected += kind.mass_kg * (turned if parent < 0 else 1.0)
            if parent >= 0:
                enter = tree.output[i] if tree.reversed[i] else tree.housing[i]
                leave = tree.housing[parent] if tree.reversed[parent] else tree.output[parent]
                length = float(np.linalg.norm(enter[:3, 3] - leave[:3, 3]))
                expected += max(LINK_KG_M * length, MIN_LINK_KG)
        found = module_prior(chain, tree.types)[:, 3, 3].sum()
        assert found == pytest.approx(expected, rel=1e-9)


def test_a_reversed_module_turns_its_housing() -> None:
    robot = next(r for r in robots() if build_tree(r).reversed[-1] and len(r.modules) > 1)
    tree = build_tree(robot)
    last = module_prior(true_chain(robot), tree.types)[-1]
    kind = tree.types[-1]
    assert last[3, 3] == pytest.approx((1.0 - OUTPUT_SHARE) * kind.mass_kg)
    to_root = np.linalg.inv(tree.housing[0]) @ tree.housing[-1]
    np.testing.assert_allclose(body(last).com_m, (to_root @ [*kind.com_xyz, 1.0])[:3], atol=1e-12)


def test_a_robot_of_other_modules_is_refused() -> None:
    robot = load_robot(ROBOTS / "a2085_04.toml")
    with pytest.raises(ValueError, match="3 module types for a chain of 4 joints"):
        module_prior(true_chain(robot), build_tree(robot).types[:3])
