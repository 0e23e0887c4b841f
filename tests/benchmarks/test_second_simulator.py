"""Twenty random robots of the second simulator, with full motions (`pytest -m benchmark -s`, a minute)."""

from pathlib import Path

import pytest

from coordinator.excitation.plan import Plan
from module_agent.model.catalogue import ImuKind
from tests.second_simulator.comparison import (
    LinkError,
    lengths_covered,
    parameters_covered,
    transforms_covered,
)
from tests.second_simulator.trial import trial

pytestmark = pytest.mark.benchmark

ROBOTS = range(20)


@pytest.mark.parametrize("imu", ["uncalibrated", "calibrated"])
def test_topology_and_coverage_of_random_robots(tmp_path: Path, imu: ImuKind) -> None:
    plan, links, wrong = Plan(dynamics=False, imu=imu), list[LinkError](), dict[int, list[str]]()
    for seed in ROBOTS:
        found = trial(tmp_path / str(seed), seed, plan)
        links += found.links
        wrong |= {seed: found.wrong} if found.wrong else {}
    lengths, transforms = lengths_covered(links), transforms_covered(links)
    print(f"\n{imu}: topology right of {len(ROBOTS) - len(wrong)} of {len(ROBOTS)} robots")
    print(f"  lengths of links in their 95 % intervals: {lengths}")
    print(f"  transforms in their 95 % ellipsoids: {transforms}")
    print(f"  single parameters in their 95 % intervals: {parameters_covered(links)}")
    assert wrong == {}
    assert lengths.honest
    assert transforms.honest
