"""The tree follows from which IMU moved with which joint, with calibrated odds; contradictions are named."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.topology.topology import (
    MotionObservation,
    Topology,
    TopologyError,
    find_topology,
    likely_topology,
)

MINUS_Z = np.array([0.0, 0.0, -1.0])


@st.composite
def forests(draw: st.DrawFn) -> tuple[dict[str, str | None], dict[str, bool]]:
    names = draw(st.permutations([f"S{i:02d}" for i in range(draw(st.integers(1, 16)))]))
    parent = {name: draw(st.sampled_from([None, *names[:i]])) if i else None for i, name in enumerate(names)}
    return parent, {name: draw(st.booleans()) for name in names}


def movers(name: str | None, parent: dict[str, str | None]) -> list[str]:
    return [] if name is None else [*movers(parent[name], parent), name]


def watch(
    parent: dict[str, str | None], reverse: dict[str, bool]
) -> dict[tuple[str, str], MotionObservation]:
    """Every IMU is carried by the joints between it and the base, and by its own if mounted by the output."""
    seen = {}
    for k in parent:
        carried = movers(parent[k], parent) + [k] * reverse[k]
        for i in parent:
            axis = MINUS_Z if i == k else np.array([1.0, 0.0, 0.0])
            seen[i, k] = (
                MotionObservation(True, 0.98, axis) if i in carried else MotionObservation(False, 0.03)
            )
    return seen


@given(forests())
def test_every_forest_is_recovered_from_which_imu_moved_with_which_joint(
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
    roots = tuple(s for s, p in zip(found.serials, found.parent, strict=True) if p < 0)
    assert roots == tuple(sorted(s for s in parent if parent[s] is None))


@given(forests(), st.integers(0, 2**32))
@settings(deadline=None)
def test_noise_within_its_own_sigma_leaves_every_forest_certain(
    forest: tuple[dict[str, str | None], dict[str, bool]], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    seen = {
        pair: o._replace(
            rate_ratio=abs(float(o.moved) + 0.05 * float(np.clip(rng.normal(), -3, 3))), sigma=0.1
        )
        for pair, o in watch(*forest).items()
    }
    found = find_topology(seen)
    on = {s: found.serials[p] if p >= 0 else None for s, p in zip(found.serials, found.parent, strict=True)}
    assert on == forest[0]
    assert dict(zip(found.serials, found.reversed, strict=True)) == forest[1]
    assert found.doubts == ()
    # A ratio three sigma off, of which there may be several among 256, still has log-odds of 7 or more.
    assert found.confidence > 0.99


def topology_or_error(seen: dict[tuple[str, str], MotionObservation]) -> Topology | TopologyError:
    try:
        return find_topology(seen)
    except TopologyError as error:
        return error


def predicted(found: Topology) -> dict[tuple[str, str], bool]:
    on = {s: found.serials[p] if p >= 0 else None for s, p in zip(found.serials, found.parent, strict=True)}
    again = watch(on, dict(zip(found.serials, found.reversed, strict=True)))
    return {pair: o.moved for pair, o in again.items()}


@given(forests(), st.data())
@settings(deadline=None)
def test_one_wrong_observation_that_looks_sure_gives_another_forest_or_an_error_that_names_it(
    forest: tuple[dict[str, str | None], dict[str, bool]], data: st.DataObject
) -> None:
    """Never a tree that the observations contradict: what comes out predicts exactly what was seen."""
    seen = watch(*forest)
    pair = data.draw(st.sampled_from(sorted(seen)))
    moved = not seen[pair].moved
    seen[pair] = MotionObservation(moved, float(moved), MINUS_Z if pair[0] == pair[1] else None)
    found = topology_or_error(seen)
    if isinstance(found, TopologyError):
        assert set(pair) <= set(found.serials)
        return
    assert predicted(found) == {p: o.moved for p, o in seen.items()}


@given(forests(), st.data(), st.floats(0.35, 0.65))
@settings(deadline=None)
def test_one_unclear_observation_is_a_doubt_or_an_error_that_names_it_and_never_more(
    forest: tuple[dict[str, str | None], dict[str, bool]], data: st.DataObject, ratio: float
) -> None:
    seen = watch(*forest)
    pair = data.draw(st.sampled_from(sorted(seen)))
    seen[pair] = MotionObservation(ratio > 0.5, ratio, MINUS_Z if pair[0] == pair[1] else None)
    found = topology_or_error(seen)
    if isinstance(found, TopologyError):
        assert f"{pair[1]} saw joint {pair[0]} with a rate ratio of {ratio:.2f}" in str(found)
        return
    named = {(d.joint, d.observer) for d in found.doubts}
    if named:
        assert named == {pair}
        return
    # Only where all the others say it anyway, and it agrees with them.
    assert predicted(found) == {p: o.moved for p, o in watch(*forest).items()}
    assert seen[pair].moved == watch(*forest)[pair].moved


CHAIN: dict[str, str | None] = {"A": None, "B": "A", "C": "B"}
FORWARD = {"A": False, "B": False, "C": False}


def test_the_confidence_is_the_probability_of_the_least_certain_answer() -> None:
    seen = watch(CHAIN, FORWARD)
    assert find_topology(seen).confidence > 0.999
    # Whether C is on B or next to it, only C's observation of joint B decides.
    seen["B", "C"] = MotionObservation(True, 0.6, sigma=0.15)
    found = find_topology(seen)
    expected = 1.0 / (1.0 + np.exp(-seen["B", "C"].log_odds))
    assert found.confidence == pytest.approx(expected, abs=2e-3)
    assert found.parent_log_odds[2] == pytest.approx(seen["B", "C"].log_odds, abs=0.02)
    (doubt,) = found.doubts
    assert (doubt.kind, doubt.module, doubt.joint, doubt.observer) == ("parent", "C", "B", "C")
    assert "whether C is mounted on B or on A is not certain" in doubt.text


@given(st.floats(0.0, 1.0), st.floats(0.02, 0.5))
def test_a_ratio_as_far_from_being_carried_as_from_not_is_a_toss_up(off: float, sigma: float) -> None:
    above, below = (MotionObservation(r > 0.5, r, sigma=sigma).log_odds for r in (0.5 + off, 0.5 - off))
    assert above == pytest.approx(-below, abs=1e-9)
    assert abs(above) < 12.0


def test_a_larger_sigma_makes_less_certain_of_the_same_ratio() -> None:
    odds = [MotionObservation(True, 1.0, sigma=sigma).log_odds for sigma in (0.05, 0.15, 0.25, 0.5)]
    assert odds == sorted(odds, reverse=True)


def test_two_observations_that_agree_are_surer_than_one() -> None:
    """Whether B is on A, both IMUs beyond it decide; whether C is on B, C alone."""
    unclear = MotionObservation(True, 0.75, sigma=0.25)
    seen = {pair: unclear if o.moved else o for pair, o in watch(CHAIN, FORWARD).items()}
    found = likely_topology(seen)
    assert found.parent_log_odds[1] > found.parent_log_odds[2] + 0.5


def test_a_ring_that_looks_sure_is_named() -> None:
    seen = watch(CHAIN, FORWARD)
    seen["B", "A"] = MotionObservation(True, 1.0)
    with pytest.raises(TopologyError, match=r"A moves B and B moves A|B moves A and A moves B"):
        find_topology(seen)


def test_an_unclear_observation_that_no_tree_allows_is_outvoted_and_named() -> None:
    seen = watch(CHAIN, FORWARD)
    seen["B", "A"] = MotionObservation(True, 0.55)
    found = find_topology(seen)
    assert found.parent == (-1, 0, 1)
    assert [(d.kind, d.joint, d.observer) for d in found.doubts] == [("contradiction", "B", "A")]


def test_two_movers_of_which_neither_moves_the_other_are_named() -> None:
    seen = watch({"A": None, "B": None, "C": "A"}, FORWARD)
    seen["B", "C"] = MotionObservation(True, 1.0)
    with pytest.raises(TopologyError, match="A and B both move C, but neither moves the other") as caught:
        find_topology(seen)
    assert set(caught.value.serials) == {"A", "B", "C"}


def test_a_joint_that_skips_a_generation_is_named() -> None:
    seen = watch(CHAIN, FORWARD)
    seen["A", "C"] = MotionObservation(False, 0.0)
    with pytest.raises(TopologyError, match="A moves B and B moves C, but A does not move C") as caught:
        find_topology(seen)
    assert set(caught.value.serials) == {"A", "B", "C"}
    # Any one of the three may be the wrong one: all of them are worth repeating.
    doubted = {(d.joint, d.observer) for d in likely_topology(seen).doubts}
    assert doubted == {("A", "B"), ("B", "C"), ("A", "C")}


def test_a_lost_observation_is_made_up_for_by_the_others_or_named_as_what_is_missing() -> None:
    seen = watch(CHAIN, FORWARD)
    del seen["A", "C"]
    assert find_topology(seen).parent == (-1, 0, 1)
    seen = watch(CHAIN, FORWARD)
    del seen["B", "C"]
    with pytest.raises(TopologyError, match=r"whether C is mounted on .*: C saw nothing of joint B"):
        find_topology(seen)


def test_modules_that_did_not_answer_are_named_once() -> None:
    seen = {pair: o for pair, o in watch(CHAIN, FORWARD).items() if pair[1] != "B"}
    with pytest.raises(TopologyError, match="module B reported on no joint") as caught:
        find_topology(seen)
    assert caught.value.serials == ("B",)
    seen = {pair: o for pair, o in watch(CHAIN, FORWARD).items() if pair[0] != "B"}
    with pytest.raises(TopologyError, match="no module reported on joint B"):
        find_topology(seen)


@given(forests(), st.data())
@settings(deadline=None)
def test_what_a_joint_that_is_stuck_carries_stands_on_what_carries_it_and_all_else_is_right(
    forest: tuple[dict[str, str | None], dict[str, bool]], data: st.DataObject
) -> None:
    parent, reverse = forest
    stuck = data.draw(st.sampled_from(sorted(parent)))
    seen = {pair: o for pair, o in watch(parent, reverse).items() if pair[0] != stuck}
    if not seen:
        return  # a single module that does not move has seen nothing at all
    found = find_topology(seen, [stuck])
    on = {s: found.serials[p] if p >= 0 else None for s, p in zip(found.serials, found.parent, strict=True)}
    assert on == {s: parent[stuck] if p == stuck else p for s, p in parent.items()}
    assert found.unmoved == (stuck,)
    for s, turned, odds in zip(found.serials, found.reversed, found.reversed_log_odds, strict=True):
        assert odds == 0.0 if s == stuck else turned == reverse[s]


def test_what_is_not_certain_of_a_module_is_said_in_words() -> None:
    seen = watch(CHAIN, FORWARD) | {("B", "C"): MotionObservation(True, 0.6, sigma=0.15)}
    found = likely_topology({pair: o for pair, o in seen.items() if pair[0] != "A"}, ["A"])
    caveats = dict(zip(found.serials, (found.caveat(k) for k in range(3)), strict=True))
    assert caveats["A"] == ", its joint did not move: mounting and what it carries unknown"
    assert caveats["B"] == ""
    assert caveats["C"].endswith(" % sure")


def test_a_housing_that_turns_the_wrong_way_about_its_own_axis_is_named() -> None:
    seen = watch(CHAIN, {"A": False, "B": True, "C": False})
    assert find_topology(seen).reversed == (False, True, False)
    seen["B", "B"] = MotionObservation(True, 1.0, -MINUS_Z)
    with pytest.raises(TopologyError, match="encoder's sign"):
        find_topology(seen)


def test_without_any_observation_there_is_no_tree() -> None:
    for find in (likely_topology, find_topology):
        with pytest.raises(TopologyError, match="no module observed any motion"):
            find({})
