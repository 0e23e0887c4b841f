"""The tree must come out of who moved with whom, and impossible observations must be named."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.kinematics.topology import MotionSeen, Topology, TopologyError, find_topology

MINUS_Z = np.array([0.0, 0.0, -1.0])


@st.composite
def forests(draw: st.DrawFn) -> tuple[dict[str, str | None], dict[str, bool]]:
    names = draw(st.permutations([f"S{i:02d}" for i in range(draw(st.integers(1, 16)))]))
    parent = {name: draw(st.sampled_from([None, *names[:i]])) if i else None for i, name in enumerate(names)}
    return parent, {name: draw(st.booleans()) for name in names}


def movers(name: str | None, parent: dict[str, str | None]) -> list[str]:
    return [] if name is None else [*movers(parent[name], parent), name]


def watch(parent: dict[str, str | None], reverse: dict[str, bool]) -> dict[tuple[str, str], MotionSeen]:
    """Every IMU is carried by the joints between it and the base, and by its own if mounted by the output."""
    seen = {}
    for k in parent:
        carried = movers(parent[k], parent) + [k] * reverse[k]
        for i in parent:
            axis = MINUS_Z if i == k else np.array([1.0, 0.0, 0.0])
            seen[i, k] = MotionSeen(True, 0.98, axis) if i in carried else MotionSeen(False, 0.03)
    return seen


@given(forests())
def test_every_forest_is_recovered_from_who_moved_with_whom(
    forest: tuple[dict[str, str | None], dict[str, bool]],
) -> None:
    parent, reverse = forest
    found = find_topology(watch(parent, reverse))
    assert sorted(found.serials) == sorted(parent)
    for k, serial in enumerate(found.serials):
        above = found.parent[k]
        assert (found.serials[above] if above >= 0 else None) == parent[serial]
        assert above < k
        assert found.reversed[k] == reverse[serial]
    depths = [(len(movers(s, parent)), s) for s in found.serials]
    assert depths == sorted(depths)
    assert found.roots == tuple(sorted(s for s in parent if parent[s] is None))


def topology_or_error(seen: dict[tuple[str, str], MotionSeen]) -> Topology | TopologyError:
    try:
        return find_topology(seen)
    except TopologyError as error:
        return error


@given(forests(), st.data())
def test_one_wrong_observation_gives_another_forest_or_an_error_that_names_it(
    forest: tuple[dict[str, str | None], dict[str, bool]], data: st.DataObject
) -> None:
    """Never a tree that the observations contradict: what comes out predicts exactly what was seen."""
    seen = watch(*forest)
    pair = data.draw(st.sampled_from(sorted(seen)))
    seen[pair] = MotionSeen(not seen[pair].moved, 0.51, MINUS_Z if pair[0] == pair[1] else None)
    found = topology_or_error(seen)
    if isinstance(found, TopologyError):
        assert set(pair) <= set(found.serials)
        assert f"what {pair[1]} saw of joint {pair[0]}" in str(found)
        return
    above = {
        s: found.serials[p] if p >= 0 else None for s, p in zip(found.serials, found.parent, strict=True)
    }
    again = watch(above, dict(zip(found.serials, found.reversed, strict=True)))
    assert {p: o.moved for p, o in again.items()} == {p: o.moved for p, o in seen.items()}


CHAIN: dict[str, str | None] = {"A": None, "B": "A", "C": "B"}
FORWARD = {"A": False, "B": False, "C": False}


def test_the_confidence_is_the_margin_of_the_least_certain_observation() -> None:
    seen = watch(CHAIN, FORWARD)
    assert find_topology(seen).confidence == pytest.approx(0.47)
    seen["A", "C"] = MotionSeen(True, 0.62)
    assert find_topology(seen).confidence == pytest.approx(0.12)


def test_a_cycle_is_named() -> None:
    seen = watch(CHAIN, FORWARD)
    seen["B", "A"] = MotionSeen(True, 0.55)
    with pytest.raises(TopologyError, match=r"A moves B and B moves A|B moves A and A moves B"):
        find_topology(seen)


def test_two_movers_of_which_neither_moves_the_other_are_named() -> None:
    seen = watch({"A": None, "B": None, "C": "A"}, FORWARD)
    seen["B", "C"] = MotionSeen(True, 0.6)
    with pytest.raises(TopologyError, match="A and B both move C, but neither moves the other") as caught:
        find_topology(seen)
    assert caught.value.serials == ("A", "C", "B")


def test_a_joint_that_skips_a_generation_is_named() -> None:
    seen = watch(CHAIN, FORWARD)
    seen["A", "C"] = MotionSeen(False, 0.45)
    with pytest.raises(
        TopologyError, match=r"A moves B and B moves C, but A does not move C.*rate ratio 0.45"
    ):
        find_topology(seen)


def test_modules_that_did_not_answer_are_named_once() -> None:
    seen = {pair: o for pair, o in watch(CHAIN, FORWARD).items() if pair[1] != "B"}
    with pytest.raises(TopologyError, match="module B reported on no joint") as caught:
        find_topology(seen)
    assert caught.value.serials == ("B",)
    single = watch(CHAIN, FORWARD)
    del single["A", "C"]
    with pytest.raises(TopologyError, match="module C did not report on joint A"):
        find_topology(single)


def test_a_housing_that_turns_the_wrong_way_about_its_own_axis_is_named() -> None:
    seen = watch(CHAIN, {"A": False, "B": True, "C": False})
    assert find_topology(seen).reversed == (False, True, False)
    seen["B", "B"] = MotionSeen(True, 1.0, -MINUS_Z)
    with pytest.raises(TopologyError, match="encoder's sign"):
        find_topology(seen)
