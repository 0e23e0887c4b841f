"""Robots that share a network, or even a name, are told apart; the smallest robot is one module."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from coordinator.excitation.plan import Plan
from coordinator.identification.result import Result
from sim.scoring.score import score

Rigs = Callable[..., Any]


def _module(serial: str, kind: str, parent: str, *more: str) -> str:
    return "\n".join(
        ["[[module]]", f'serial = "{serial}"', f'type = "{kind}"', f'parent = "{parent}"', *more, ""]
    )


def _file(path: Path, name: str, mount: str, *modules: str) -> str:
    path.write_text(f'name = "{name}"\n[base]\nmount = "{mount}"\n' + "".join(modules))
    return str(path)


def _pair(path: Path, name: str, mount: str, letter: str, mounted: str) -> str:
    """Two modules and a tube between them."""
    first, second = f"{letter}1", f"{letter}2"
    link = ("link = { tube = { length_m = 0.2, twist_rad = 0.4 } }", f'mounted = "{mounted}"')
    modules = _module(first, "X5-9", "base"), _module(second, "X5-4", first, *link)
    return _file(path, name, mount, *modules)


def _mounting(result: Result) -> dict[str, tuple[str | None, bool]]:
    return {part.serial: (part.parent, part.reversed) for part in result.topology}


def test_two_robots_on_one_network_are_measured_at_the_same_time_each_by_its_name(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    one = rigs(_pair(tmp_path / "1.toml", "left", "floor", "A", "forward"), "lan", 1)
    two = rigs(_pair(tmp_path / "2.toml", "right", "wall", "B", "reversed"), "lan", 2, beside=one)
    left = one.begin(tmp_path / "left", quick_plan, sender="coordinator-left")
    right = two.begin(tmp_path / "right", quick_plan, sender="coordinator-right")

    async def both() -> list[Result]:
        return list(await asyncio.gather(left.run(), right.run()))

    found = one.run(both())
    assert _mounting(found[0]) == {"A1": (None, False), "A2": ("A1", False)}
    assert _mounting(found[1]) == {"B1": (None, False), "B2": ("B1", True)}
    for result in found:
        assert result.topology_confidence > 0.99


def test_two_robots_under_one_name_are_two_trees(rigs: Rigs, quick_plan: Plan, tmp_path: Path) -> None:
    """Nothing says that they do not stand on one base, and so neither does the result."""
    one = rigs(_pair(tmp_path / "1.toml", "both", "floor", "A", "forward"), "lan", 1)
    rigs(_pair(tmp_path / "2.toml", "both", "wall", "B", "reversed"), "lan", 2, beside=one)
    result = one.run(one.begin(tmp_path / "run", quick_plan, expect=4).run())
    assert _mounting(result) == {
        "A1": (None, False),
        "A2": ("A1", False),
        "B1": (None, False),
        "B2": ("B1", True),
    }
    assert result.topology_confidence > 0.99
    # The links are measured within each tree.
    lengths = {(link.parent, link.child): link.link_length_mm for link in result.links}
    assert set(lengths) == {("A1", "A2"), ("B1", "B2")}


@pytest.mark.parametrize("mounted", ["forward", "reversed"])
def test_a_robot_of_one_module_is_found(rigs: Rigs, quick_plan: Plan, tmp_path: Path, mounted: str) -> None:
    only = _module("only", "X5-4", "base", f'mounted = "{mounted}"')
    rig = rigs(_file(tmp_path / "one.toml", "one", "wall", only), "lan", 3)
    result = rig.session(tmp_path / "run", quick_plan)
    assert _mounting(result) == {"only": (None, mounted == "reversed")}
    assert result.topology[0].parent_log_odds is None
    assert score(tmp_path / "run").topology_differences == []
