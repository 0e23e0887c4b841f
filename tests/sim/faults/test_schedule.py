"""A seed stands for one session, whatever machine draws it."""

import pytest

from module_agent.model.errors import UsageError
from sim.commands.faults import seed_range
from sim.faults.fault import KINDS
from sim.faults.schedule import LATEST_S, draw


def test_a_seed_draws_the_same_session_again_and_another_seed_another() -> None:
    assert draw(7) == draw(7)
    assert draw(7).faults != draw(8).faults


def test_every_kind_of_fault_is_drawn_in_time_and_for_a_module_that_exists() -> None:
    drawn = [draw(seed) for seed in range(100)]
    assert {fault.kind for one in drawn for fault in one.faults} == set(KINDS)
    for one in drawn:
        assert all(0.0 <= f.at_s <= LATEST_S and f.module < len(one.robot.modules) for f in one.faults)
        assert list(one.faults) == sorted(one.faults, key=lambda fault: fault.at_s)


def test_seeds_are_a_range_with_both_ends() -> None:
    assert list(seed_range("17..19")) == [17, 18, 19]
    for text in ("17", "3..2", "a..b", "-1..2", "1..2 "):
        with pytest.raises(UsageError, match=r"expected A\.\.B"):
            seed_range(text)
