"""How many processes a launch has, and which modules each of them hosts."""

from pathlib import Path

import pytest

from sim.processes.launcher import LaunchConfig, default_processes


@pytest.mark.parametrize(
    ("modules", "cores", "processes"),
    [(2, 4, 2), (4, 4, 4), (4, 2, 2), (16, 2, 2), (17, 2, 3), (64, 2, 8), (64, 16, 16)],
)
def test_processes_are_one_a_core_and_more_where_each_would_host_over_eight_modules(
    modules: int, cores: int, processes: int
) -> None:
    assert default_processes(modules, cores) == processes


@pytest.mark.parametrize("processes", [1, 3, 5, None])
def test_every_module_is_in_one_process(processes: int | None) -> None:
    serials = tuple("ABCDE")
    shares = LaunchConfig("file", "robot", serials, Path(), processes=processes).shares
    assert sorted("".join("".join(share) for share in shares)) == list(serials)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
