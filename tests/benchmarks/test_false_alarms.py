"""How often checks of an unchanged robot name a link, with modules unlike their catalogue: counts to read."""

from pathlib import Path

import pytest

from coordinator.baseline.check import check, check_plan
from coordinator.excitation.plan import Plan
from module_agent.network_emulation.profile import PROFILES
from sim.benchmark.cases.link_change import AT_ONCE, known_robot
from sim.imperfections.noise_profile import noise_profile, switched
from sim.robot.robot_file import load_robot
from sim.virtual_time.robot import VirtualSettings

pytestmark = pytest.mark.benchmark

UNLIKE = ("imu-place", "imu-mounting", "body-mass", "body-centre", "housing-axis")
ROBOTS, DAYS = 5, 20


def test_checks_of_unchanged_robots_whose_modules_differ_from_their_types(tmp_path: Path) -> None:
    robot, noise = load_robot("a2085_03"), switched(noise_profile("x5-uncalibrated"), on=UNLIKE)
    alarms: list[tuple[int, int, list[str]]] = []
    for number in range(ROBOTS):
        # The modules follow from the number, noise and network from the day.
        settings = VirtualSettings(robot, PROFILES["lan"], number, noise, noise_seed=0)
        known = known_robot(settings, AT_ONCE, 0)
        for day in range(1, DAYS + 1):
            plan = check_plan(known, Plan())
            report = check(known, known_robot(settings._replace(noise_seed=100 * number + day), plan, day))
            if report.changed:
                alarms.append((number, day, [link.child for link in report.links if link.changed]))
        checks = (number + 1) * DAYS
        print(f"\n{f'false alarms of {checks} checks of {number + 1} robots':.<70} {len(alarms)} {alarms}")
