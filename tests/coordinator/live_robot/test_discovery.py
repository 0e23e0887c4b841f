"""Waiting for modules: by the liveliness tokens on the network, on the session's clock."""

import asyncio
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.live_robot import discovery
from coordinator.live_robot.messenger import LANE_BYTES
from coordinator.recording.recording import MAX_MODULES
from module_agent.transport.transport import Event, Liveness, Reply, Sample
from module_agent.wire.keys import Leaf, key


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


class _Flooded:
    """A network on which anybody may be, and publish, before and while modules are searched for."""

    def __init__(self, tokens: int, messages: int):
        self.tokens, self.messages = tokens, messages

    def watch_alive(self, expression: str, sink: Callable[[Event], None]) -> Any:
        robot = expression.split("/")[1]
        for serial in (*(f"M{number}" for number in range(self.tokens)), "Z"):
            sink(Liveness(key(robot, serial, Leaf.ALIVE), True))
        return SimpleNamespace(undeclare=lambda: None)

    def subscribe(self, expression: str, sink: Callable[[Event], None]) -> None:
        for _ in range(self.messages):
            sink(Sample(key(expression.split("/")[1], "Z", Leaf.FEEDBACK), bytes(20_000)))

    def query(
        self, at: str, payload: bytes, timeout_s: float, sink: Callable[[Event], None], tag: int
    ) -> None:
        sink(Reply(tag, at, None, "nobody"))

    def close(self) -> None: ...


SHORT = discovery.Search(quiet_s=0.01, first_s=0.01)


def test_a_module_among_tokens_that_were_made_up_is_asked_as_well() -> None:
    """So that none keeps a module from being stopped."""
    _, silent = discovery.described(_Flooded(MAX_MODULES + 500, 0), "robot", SHORT)  # type: ignore[arg-type]
    assert len(silent) == MAX_MODULES + 501
    assert "Z" in silent


def test_a_late_sign_of_an_event_that_was_taken_does_not_end_the_wait_for_the_next() -> None:
    """As of a thread that is interrupted between both."""
    arrivals, token = discovery._Arrivals(), Liveness(key("robot", "A", Leaf.ALIVE), True)
    arrivals.put(token)
    assert arrivals.get(1.0) is not None
    wait = arrivals._arrived.wait

    def late(timeout: float | None = None) -> bool:
        arrivals._arrived.wait = wait  # type: ignore[method-assign]
        # The sign of the first event comes now, and the second event 50 ms later.
        threading.Timer(0.05, arrivals.put, (token,)).start()
        return True

    arrivals._arrived.wait = late  # type: ignore[method-assign]
    found = arrivals.get(5.0)
    assert found is not None
    assert found[1] == token


def test_what_arrives_while_modules_are_listed_is_kept_up_to_a_bound() -> None:
    found = discovery.listed(_Flooded(0, 3000), "robot", SHORT, listen_s=0.5)  # type: ignore[arg-type]
    assert found.silent == ["Z"]
    # 60 MB are sent; of one key no more waits than an inbox has room for.
    assert found.recording.refused["malformed"] <= LANE_BYTES // 20_000


def test_modules_that_are_present_already_need_no_wait(network: Any) -> None:
    network.alive = {"A"}
    assert wait(network, lambda present, _: present == {"A"}) == ({"A"}, 0.0)
