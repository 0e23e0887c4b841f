"""Which processes a fleet has, how its routers hang together, and what its table says."""

import math
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from module_agent.model.errors import UsageError
from sim.processes.fleet_figures import (
    FleetFigures,
    KindFigures,
    Limits,
    Reading,
    missed,
    near_limits,
    of_kind,
    read_limits,
    read_process,
    summary,
    table_rows,
)
from sim.processes.fleet_plan import plan_fleet, robot_file, router_tree
from sim.robot.robot_file import parse_robot


def test_routers_are_a_tree_of_two_branches() -> None:
    parents = [router.parent for router in router_tree(("a", "b", "c", "d", "e", "f"))]
    assert parents == [None, "a", "a", "b", "b", "c"]


def test_robots_are_shared_out_among_the_leaves_and_coordinators_connect_to_the_root() -> None:
    plan = plan_fleet(4, 16, ("a", "b", "c"), None)
    assert plan.root == "a"
    assert [robot.router for robot in plan.robots] == ["b", "c", "b", "c"]
    assert [robot.processes for robot in plan.robots] == [2] * 4
    assert plan.module_count == 64
    assert len({serial for robot in plan.robots for serial in robot.serials}) == 64


def test_one_router_serves_all() -> None:
    assert [robot.router for robot in plan_fleet(2, 2, ("a",), 2).robots] == ["a", "a"]


def test_a_plan_that_cannot_be_is_refused_with_what_can() -> None:
    with pytest.raises(UsageError, match="--modules 65: a robot has at most 64"):
        plan_fleet(1, 65, ("a",), None)
    with pytest.raises(UsageError, match="2 of them are for robots, but there are 1"):
        plan_fleet(1, 2, ("a", "b", "c"), None)


def test_a_planned_robot_is_a_chain() -> None:
    planned = plan_fleet(1, 3, ("a",), None).robots[0]
    robot = parse_robot(robot_file(planned), "planned")
    assert robot.name == planned.name
    assert robot.serials == planned.serials
    assert [module.parent for module in robot.modules] == ["base", *planned.serials[:-1]]


def test_a_kind_is_the_sum_of_its_processes_and_all_the_sum_of_the_kinds() -> None:
    before, after = [Reading(1.0, 9.0, 1, 1)] * 2, [Reading(2.0, 10.0, 3, 4), Reading(4.0, 30.0, 5, 6)]
    kind = of_kind(before, after, 10.0)
    assert kind == KindFigures(2, 40.0, 40.0, 8, 10, 22.0)
    figures = _figures(kinds={"agent": kind, "world": kind})
    assert table_rows(figures) == [
        ("agent", "2", "40", "40", "22.0", "8", "10"),
        ("world", "2", "40", "40", "22.0", "8", "10"),
        ("all", "4", "80", "80", "44.0", "16", "20"),
    ]


@pytest.mark.parametrize(
    ("measured", "words"),
    [
        ((1.0, 1.0, 0, 0), []),
        ((0.5, 0.5, 0, 0), []),
        ((0.8, 1.0, 0, 0), ["CPU: 0.80 times real time where 1 were asked for"]),
        ((0.8, 1.0, 5, 0), ["CPU: 0.80 times real time where 1 were asked for", "network: 5 rows lost"]),
        ((1.0, 1.0, 0, 2), ["network: 2 requests unanswered"]),
    ],
)
def test_what_did_not_hold_is_named(measured: tuple[float, float, int, int], words: list[str]) -> None:
    assert missed(*measured) == words


def test_what_comes_near_a_limit_of_the_machine_is_named_with_both() -> None:
    """Open files are of each process, memory and threads of all together."""
    readings, ample = [Reading(1.0, 50.0, 4, 90), Reading(1.0, 40.0, 6, 10)], Limits(200.0, 200.0, 20.0)
    assert near_limits(readings, ample) == {}
    tight = Limits(100.0, 110.0, 12.0)
    assert list(near_limits(readings, tight).values()) == [
        "sockets: 90 of 100 open files in one process",
        "memory: 90 of 110 MiB",
        "threads: 10 of 12",
    ]
    assert list(near_limits(readings, ample._replace(threads=12.0))) == ["threads"]
    assert near_limits(readings, Limits(math.inf, math.inf, math.inf)) == {}


def test_the_limits_of_this_machine_hold_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    own, limits = read_process(os.getpid(), os.sysconf("SC_CLK_TCK")), read_limits()
    assert near_limits([own], limits) == {}
    assert own.rss_mib < limits.memory_mib < 1e9
    monkeypatch.setattr(resource, "getrlimit", lambda what: (64, resource.RLIM_INFINITY))
    assert read_limits().open_files == 64
    assert read_limits().threads <= 64
    monkeypatch.setattr(resource, "getrlimit", lambda what: (resource.RLIM_INFINITY,) * 2)
    assert read_limits().open_files == math.inf


def test_a_process_that_has_ended_has_no_reading() -> None:
    """Also one that its parent has not waited for."""
    child = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    with pytest.raises(OSError, match=str(child.pid)):
        read_process(child.pid, 100)
    child.wait()
    with pytest.raises(OSError, match=str(child.pid)):
        read_process(child.pid, 100)


def test_the_summary_says_what_broke_first() -> None:
    assert summary(_figures()).endswith("broke first: nothing")
    assert summary(_figures(broke=("network: 5 rows lost", "other"))).endswith("first: network: 5 rows lost")


def test_lines_of_the_summary_stay_short(tmp_path: Path) -> None:
    assert max(map(len, summary(_figures()).splitlines())) <= 110


def _figures(kinds: dict[str, KindFigures] | None = None, broke: tuple[str, ...] = ()) -> FleetFigures:
    return FleetFigures(2, 4, 1, 10.0, 1.0, 1.0, 2000.0, 0, 0, 1.0, 2.0, 40.0, kinds or {}, broke)
