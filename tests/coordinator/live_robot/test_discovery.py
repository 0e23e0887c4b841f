"""Waiting for modules: by the liveliness tokens on the network, on the session's clock."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.live_robot import discovery


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A network whose modules come at given times; waiting takes no real time."""
    state = SimpleNamespace(now_ns=0, alive=set(), coming={})

    async def sleep(seconds: float) -> None:
        state.now_ns += round(1e9 * seconds)
        state.alive |= {serial for serial, t_s in state.coming.items() if state.now_ns >= 1e9 * t_s}

    monkeypatch.setattr(discovery, "asyncio", SimpleNamespace(sleep=sleep))
    return state


def wait(network: Any, complete: Any, **more: float) -> tuple[set[str], float]:
    present = asyncio.run(discovery.await_modules(network, lambda: network.now_ns, complete, **more))
    return set(present), network.now_ns / 1e9


def test_it_ends_as_soon_as_the_modules_present_are_complete(network: Any) -> None:
    network.coming = {"A": 0.1, "B": 0.5, "C": 0.9}
    assert wait(network, lambda present, _: {"A", "B"} <= present) == ({"A", "B"}, 0.5)


def test_quiet_time_counts_from_the_last_module_that_came(network: Any) -> None:
    network.coming = {"A": 0.1, "B": 0.5}
    present, end_s = wait(network, lambda present, quiet_s: bool(present) and quiet_s >= 1.0)
    assert (present, end_s) == ({"A", "B"}, 1.5)


def test_when_the_time_is_up_it_returns_the_modules_present(network: Any) -> None:
    network.coming = {"A": 0.1}
    assert wait(network, lambda *_: False, timeout_s=2.0, poll_s=0.05) == ({"A"}, 2.0)


def test_modules_that_are_present_already_need_no_wait(network: Any) -> None:
    network.alive = {"A"}
    assert wait(network, lambda present, _: present == {"A"}) == ({"A"}, 0.0)
