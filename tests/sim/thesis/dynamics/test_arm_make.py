"""What the thesis' arm weighs by its make, and what its printed parameters imply."""

import pytest

from module_agent.model.catalogue import module_type
from sim.robot.robot_file import load_robot
from sim.thesis.dynamics.arm_make import (
    as_designed,
    link_left,
    module_alone,
    printed,
    with_printed_module,
)

ROBOT = load_robot("thesis_484_vertical")
KIND = module_type("X5-9")
# The module's housing begins 459 mm from the axis; its centre of mass is 14.2 mm nearer.
CENTRE_M = 0.459 + KIND.com_xyz[0]
LINK_KG, LINK_M = 0.2836, 0.2295


def test_the_arm_is_the_sum_of_link_module_and_the_first_flange() -> None:
    arm = as_designed()
    assert arm.mass_kg == pytest.approx(KIND.mass_kg + LINK_KG + 0.030)
    assert arm.mcx_kg_m == pytest.approx(KIND.mass_kg * CENTRE_M + LINK_KG * LINK_M, abs=1e-6)
    assert arm.mcx_kg_m == pytest.approx(printed("6.3.2").mcx_kg_m, rel=0.01)


def test_the_module_of_table_2_is_lighter_by_its_share() -> None:
    lighter, module, arm = with_printed_module(), module_alone(), as_designed()
    assert module.mass_kg == pytest.approx(0.306)
    assert module.mcx_kg_m == pytest.approx(0.306 * CENTRE_M, abs=1e-6)
    assert lighter.mass_kg == pytest.approx((arm.mass_kg or 0.0) - KIND.mass_kg + 0.306)
    own = 0.306 * CENTRE_M**2
    assert own < module.izz_kg_m2 < 1.02 * own


def test_the_printed_inertia_is_too_small_for_the_printed_first_moment() -> None:
    thesis, arm = printed("6.3.2"), as_designed()
    assert thesis.least_kg == pytest.approx(0.2249**2 / 0.0725)
    assert thesis.least_kg > (arm.mass_kg or 0.0) > arm.least_kg
    left, module = link_left(), module_alone()
    assert left.mcx_kg_m + module.mcx_kg_m == pytest.approx(thesis.mcx_kg_m)
    # A point mass at the farthest place with the least mass has both moments.
    assert left.least_kg * left.farthest_m == pytest.approx(left.mcx_kg_m)
    assert left.least_kg * left.farthest_m**2 == pytest.approx(left.izz_kg_m2)
    assert left.farthest_m < LINK_M
