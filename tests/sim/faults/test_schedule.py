"""A seed stands for one session, whatever machine draws it, and whatever kinds are added."""

import math
from typing import Any

import pytest

from module_agent.model.catalogue import module_type
from module_agent.model.errors import UsageError
from sim.commands.faults import seed_range
from sim.faults import schedule
from sim.faults.fault import KINDS, NATURES, Fault, fault_of
from sim.faults.schedule import (
    LATEST_DYNAMIC_S,
    LATEST_S,
    PLANS,
    SHARES,
    SLOWEST,
    draw,
    safety,
    simpler,
    speed_limits,
)
from sim.robot.robot_file import load_robot

SEEDS = range(300)


@pytest.fixture(scope="module")
def drawn() -> list[schedule.Schedule]:
    return [draw(seed) for seed in SEEDS]


def test_a_seed_draws_the_same_session_again_and_another_seed_another() -> None:
    assert draw(7) == draw(7)
    assert draw(7).faults != draw(8).faults


def test_every_kind_of_fault_is_drawn_in_time_and_for_a_module_that_exists(drawn: Any) -> None:
    assert {fault.kind for one in drawn for fault in one.faults} == set(KINDS)
    for one in drawn:
        assert all(
            0.0 <= f.at_s <= LATEST_DYNAMIC_S and f.module < len(one.robot.modules) for f in one.faults
        )
        assert list(one.faults) == sorted(one.faults, key=lambda fault: fault.at_s)
        assert all(math.isinf(f.for_s) for f in one.faults if f.nature.ends == "never")
        assert not any(math.isinf(f.for_s) for f in one.faults if f.nature.ends == "after")


def test_of_some_sessions_the_coordinator_is_not_told_how_many_modules_there_are(drawn: Any) -> None:
    """A quarter: of 300 these are 75, give or take four standard deviations."""
    assert 45 <= sum(not one.expects for one in drawn) <= 105


def test_sessions_of_every_plan_are_drawn_with_faults_to_their_end(drawn: Any) -> None:
    """Give or take four standard deviations. Without inertia faults come earlier."""
    for (name, plan), share in zip(PLANS.items(), SHARES, strict=True):
        count = sum(one.planned == name for one in drawn)
        assert abs(count - 300.0 * share) <= 4.0 * (300.0 * share * (1.0 - share)) ** 0.5
        assert draw(7, planned=name).plan == plan
    dynamic = [one for one in drawn if one.plan.dynamics]
    assert LATEST_S < max(f.at_s for one in dynamic for f in one.faults) <= LATEST_DYNAMIC_S
    assert all(f.at_s <= LATEST_S for one in drawn for f in draw(one.seed, planned="short").faults)


def test_every_second_module_is_configured_to_a_speed_below_that_of_its_type(drawn: Any) -> None:
    modules = [(one, module) for one in drawn for module in one.robot.modules]
    limited = [
        (speed_limits(one)[m.serial], module_type(m.type).max_speed_rad_s)
        for one, m in modules
        if m.serial in speed_limits(one)
    ]
    # Give or take four standard deviations.
    assert abs(len(limited) / len(modules) - 0.5) < 2.0 / len(modules) ** 0.5
    assert all(SLOWEST * most - 1e-3 <= speed <= most for speed, most in limited)
    configured = [safety(one)[m.serial].velocity_rad_s[1] for one, m in modules]
    assert sorted(speed for speed in configured if math.isfinite(speed)) == sorted(s for s, _ in limited)


def test_an_added_kind_changes_the_seeds_that_draw_it_and_no_others(
    monkeypatch: pytest.MonkeyPatch, drawn: Any
) -> None:
    monkeypatch.setitem(NATURES, "lightning", NATURES["agent crash"])
    monkeypatch.setattr(schedule, "KINDS", (*KINDS, "lightning"))
    changed = [before for before in drawn if draw(before.seed) != before]
    struck = [seed for seed in SEEDS if any(fault.kind == "lightning" for fault in draw(seed).faults)]
    assert [one.seed for one in changed] == struck
    # A part in 35 of the faults, 1.5 a seed: 13 of 300, give or take four standard deviations.
    assert 1 <= len(struck) <= 28


def test_a_fault_reads_back_from_its_text(drawn: Any) -> None:
    for one in drawn:
        for fault in one.faults:
            read = fault_of(str(fault))
            assert read == (fault if fault.of_a_module else fault._replace(module=0))
    for text in ("", "agent crash", "thunder from 1.000 s on, size 0.500", "twin at 1 s for 1 s, size 1"):
        with pytest.raises(UsageError, match="expected KIND"):
            fault_of(text)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("partition from 1.000 s on, size 0.500", "partition ends: at S s for S s"),
        ("agent crash of module 0 at 1.000 s for 0.500 s, size 0.500", "does not end: from S s on"),
    ],
)
def test_a_fault_lasts_as_its_kind_does(text: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        fault_of(text)


@pytest.mark.parametrize(
    ("fault", "text", "named"),
    [
        (Fault("twin", 1.0, math.inf, 0), "A: the network is slow", False),
        (Fault("twin", 1.0, math.inf, 0), "A answers under two boot ids", True),
        (Fault("twin", 1.0, math.inf, 0), "module A is lost: it has booted anew", True),
        (Fault("clock drift", 1.0, math.inf, 0), "A: it sometimes did not answer", False),
        (Fault("clock drift", 1.0, math.inf, 0), "A: the clocks of A and B disagree", True),
        (Fault("torque stuck", 1.0, math.inf, 0), "AB: its effort is stuck", False),
        (Fault("torque stuck", 1.0, math.inf, 0), "module A: its efforts are stuck", True),
        (Fault("coordinator crash", 1.0, math.inf), "A: its encoder is stuck", False),
    ],
)
def test_a_fault_is_named_by_whole_words_and_whole_serials(fault: Fault, text: str, named: bool) -> None:
    assert fault.is_named(text, ("A", "B")) is named


def test_every_module_has_room_about_where_it_begins(drawn: Any) -> None:
    for one in drawn[:50]:
        ranges = schedule.position_ranges(one)
        for module in one.robot.modules:
            low, high = ranges[module.serial]
            assert low + 0.79 < module.start_rad < high - 0.79
        # The same whatever else is simpler about the session.
        assert schedule.position_ranges(one._replace(network="none", faults=())) == ranges


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("A: check how its IMU is mounted", True),
        ("C: the residual of its gyro is 0.3 rad/s", True),
        ("B: the residual of its gyro is 0.3 rad/s", False),
        ("C: its encoder is stuck", False),
    ],
)
def test_exchanged_imus_are_named_by_either_of_their_modules(text: str, named: bool) -> None:
    assert Fault("IMU swapped", 1.0, math.inf, module=2).is_named(text, ("A", "B", "C")) is named


def test_a_message_that_is_malformed_names_what_corrupts_messages() -> None:
    text = "module A refused motion: malformed: not a msgpack map"
    assert Fault("corrupted messages", 1.0, 0.5).is_named(text, ("A", "B"))
    assert not Fault("agent crash", 1.0, math.inf, module=1).is_named(text, ("A", "B"))


def test_simpler_sessions_are_fewer_faults_smaller_robots_and_shorter_times() -> None:
    faults = (Fault("agent thaw", 1.0, 0.8, 2), Fault("agent crash", 2.0, math.inf, 0))
    start = schedule.Schedule(5, load_robot("a2085_03"), "wifi", faults)
    once = list(simpler(start))
    assert [one.faults for one in once[:2]] == [faults[1:], faults[:1]]
    assert len(once[2].robot.modules) == 2
    assert [fault.module for fault in once[2].faults] == [1, 0]
    assert once[3].network == "none"
    assert once[4].faults == (faults[0]._replace(for_s=0.4), faults[1])
    assert len(once) == 5
    # It comes to an end.
    steps = 0
    while (following := next(simpler(start), None)) is not None:
        start, steps = following, steps + 1
    assert steps < 10


def test_seeds_are_a_range_with_both_ends() -> None:
    assert list(seed_range("17..19")) == [17, 18, 19]
    for text in ("17", "3..2", "a..b", "-1..2", "1..2 "):
        with pytest.raises(UsageError, match=r"expected A\.\.B"):
            seed_range(text)
