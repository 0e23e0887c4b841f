"""Zenoh between processes: agents that hear each other through a hub, and hubs and agents that die."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from module_agent.transport.transport import Event, Liveness, Reply, Sample, TransportError
from module_agent.transport.zenoh_transport import ZenohConfig, ZenohTransport, open_zenoh

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[3]
LIMIT_S = 60.0

HUB = """
import sys
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh
transport = open_zenoh(ZenohConfig.hub(sys.argv[1]))
print("open", flush=True)
sys.stdin.read()
transport.close()
"""

AGENT = """
import sys, threading
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh
endpoint, name = sys.argv[1:]
transport = open_zenoh(ZenohConfig.spoke(endpoint))
hears = name.encode() + b" hears "
transport.serve(f"x5/r/{name}/info", lambda request: request.reply(hears + request.payload))
transport.declare_alive(f"x5/r/{name}/alive")
ended = threading.Event()
def publish():
    number = 0
    while not ended.wait(0.01):
        transport.publish(f"x5/r/{name}/feedback", str(number).encode())
        number += 1
publisher = threading.Thread(target=publish)
publisher.start()
print("open", flush=True)
sys.stdin.read()
ended.set()
publisher.join()
transport.close()
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def start() -> Iterator[Callable[..., "subprocess.Popen[str]"]]:
    """Start a process that says when it is up, and ends when its input does."""
    started: list[subprocess.Popen[str]] = []

    def run(program: str, *arguments: str) -> "subprocess.Popen[str]":
        child = subprocess.Popen(
            [sys.executable, "-c", program, *arguments],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        started.append(child)
        assert child.stdout is not None
        assert child.stdout.readline() == "open\n"
        return child

    yield run
    for child in started:
        child.communicate("", timeout=LIMIT_S)
        assert child.returncode in (0, -signal.SIGKILL)


def kill(child: "subprocess.Popen[str]") -> None:
    child.kill()
    child.wait(LIMIT_S)


def until(condition: Callable[[], bool], what: str) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s, f"{what} did not come about"
        time.sleep(0.002)


def answer(transport: ZenohTransport, key: str) -> bytes:
    """Ask until there is an answer; every single query must end in one reply."""
    end_s = time.monotonic() + LIMIT_S
    while time.monotonic() < end_s:
        got: list[Event] = []
        ended = threading.Event()

        def sink(event: Event, got: list[Event] = got, ended: threading.Event = ended) -> None:
            got.append(event)
            ended.set()

        transport.query(key, b"me", 0.5, sink, 1)
        assert ended.wait(LIMIT_S)
        assert len(got) == 1
        reply = got[0]
        assert isinstance(reply, Reply)
        if reply.payload is not None:
            return reply.payload
        time.sleep(0.005)
    raise AssertionError(f"no answer on {key}")


def test_agents_started_before_the_hub_hear_each_other_through_it(endpoint, start) -> None:
    me = open_zenoh(ZenohConfig.spoke(endpoint))
    start(AGENT, endpoint, "B")
    heard: list[Event] = []
    alive: list[Event] = []
    me.subscribe("x5/r/*/feedback", heard.append)
    me.watch_alive("x5/r/*/alive", alive.append)
    start(HUB, endpoint)
    until(lambda: bool(heard), "a sample of B")
    assert isinstance(heard[0], Sample)
    assert heard[0].key == "x5/r/B/feedback"
    until(lambda: alive == [Liveness("x5/r/B/alive", True)], "the token of B")
    assert answer(me, "x5/r/B/info") == b"B hears me"
    me.close()


def test_a_new_hub_on_the_same_port_brings_everything_back(endpoint, start) -> None:
    first = start(HUB, endpoint)
    me = open_zenoh(ZenohConfig.spoke(endpoint))
    start(AGENT, endpoint, "B")
    heard: list[Event] = []
    alive: list[Event] = []
    me.subscribe("x5/r/*/feedback", heard.append)
    me.watch_alive("x5/r/*/alive", alive.append)
    until(lambda: bool(heard) and bool(alive), "life before")
    kill(first)
    until(lambda: Liveness("x5/r/B/alive", False) in alive, "the end of B's token")
    alive.clear()
    heard.clear()
    start(HUB, endpoint)
    up_s = time.monotonic()
    until(lambda: Liveness("x5/r/B/alive", True) in alive, "the return of B's token")
    until(lambda: bool(heard), "the return of B's samples")
    print(f"back {time.monotonic() - up_s:.3f} s after the new hub")
    assert answer(me, "x5/r/B/info") == b"B hears me"
    me.close()


def test_a_killed_agent_s_token_vanishes_and_its_successor_takes_over(endpoint, start) -> None:
    hub = open_zenoh(ZenohConfig.hub(endpoint))
    alive: list[Event] = []
    hub.watch_alive("x5/r/*/alive", alive.append)
    agent = start(AGENT, endpoint, "B")
    until(lambda: len(alive) == 1, "the token")
    kill(agent)
    until(lambda: len(alive) == 2, "its end")
    start(AGENT, endpoint, "B")
    until(lambda: len(alive) == 3, "the successor's token")
    assert [event.alive for event in alive if isinstance(event, Liveness)] == [True, False, True]
    assert answer(hub, "x5/r/B/info") == b"B hears me"
    hub.close()


def test_a_second_hub_learns_that_the_port_is_taken_and_may_join_as_a_spoke(endpoint, start) -> None:
    hub = open_zenoh(ZenohConfig.hub(endpoint))
    with pytest.raises(TransportError, match=r"in use.*another coordinator"):
        open_zenoh(ZenohConfig.hub(endpoint))
    start(AGENT, endpoint, "B")
    second = open_zenoh(ZenohConfig.spoke(endpoint))
    assert answer(second, "x5/r/B/info") == b"B hears me"
    second.close()
    hub.close()


def test_a_port_is_free_again_after_close(endpoint) -> None:
    for _ in range(3):
        open_zenoh(ZenohConfig.hub(endpoint)).close()
    with socket.create_server(("127.0.0.1", int(endpoint.rpartition(":")[2]))) as own:
        assert own.getsockname()[1] > 0


def test_a_client_without_a_hub_gives_up_in_time_and_says_what_to_check(endpoint) -> None:
    with pytest.raises(TransportError, match=r"no hub answers on tcp/127.*0\.2 s.*coordinator running"):
        open_zenoh(ZenohConfig(mode="client", connect=(endpoint,), connect_timeout_s=0.2))


@pytest.mark.parametrize("address", ["nonsense", "tcp/127.0.0.1:notaport"])
def test_a_malformed_endpoint_is_a_transport_error(address) -> None:
    with pytest.raises(TransportError, match=address):
        open_zenoh(ZenohConfig.hub(address)).close()


def test_a_spoke_closes_while_something_else_holds_the_port() -> None:
    """A listener that never shakes hands, as a frozen hub, must not hold `close` up for ever."""
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        deaf.listen()
        spoke = open_zenoh(ZenohConfig.spoke(f"tcp/127.0.0.1:{deaf.getsockname()[1]}"))
        closing = threading.Thread(target=spoke.close, daemon=True)
        closing.start()
        closing.join(LIMIT_S)
        assert not closing.is_alive()


def test_an_error_reply_of_a_foreign_server_becomes_the_error(endpoint) -> None:
    hub = open_zenoh(ZenohConfig.hub(endpoint))
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    with zenoh.open(config) as foreign:

        def refuse(query: zenoh.Query) -> None:
            with query:
                query.reply_err(b"not today")

        foreign.declare_queryable("k", refuse)
        got: list[Event] = []
        until(lambda: _ask(hub, got) == "not today", "the error")
        assert all(isinstance(reply, Reply) and reply.payload is None for reply in got)
    hub.close()


def _ask(transport: ZenohTransport, got: list[Event]) -> str:
    number = len(got)
    transport.query("k", b"", 1.0, got.append, 1)
    until(lambda: len(got) == number + 1, "a reply")
    last = got[-1]
    assert isinstance(last, Reply)
    return last.error
