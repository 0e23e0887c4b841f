"""A secured network: whom it admits, and what each of its parties can do, by real sessions on loopback."""

import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from coordinator.live_robot.authority import make_credentials
from module_agent.model.errors import UsageError
from module_agent.transport.credentials import (
    COORDINATOR,
    OBSERVER,
    Credentials,
    access_control,
    host_credentials,
    load_credentials,
    load_fleet,
    secured,
)
from module_agent.transport.transport import Event, Liveness, NoHub, Reply, Request, Sample, TransportError
from module_agent.transport.zenoh_transport import ZenohConfig, ZenohTransport, open_zenoh
from module_agent.wire.keys import Leaf, every, key

pytestmark = pytest.mark.integration

ROBOT = "arm"
LIMIT_S = 60.0
# Long enough for a message on loopback, on a busy machine too; what has not come is taken as never sent.
GRACE_S = 1.5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("keys")
    make_credentials(path, ROBOT, ["A", "B", "C"], together=[["B", "C"]])
    return path


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def party(folder: Path, name: str) -> Credentials:
    """Return the credentials of the coordinator, of an observer, or of the host of a module."""
    if name in (COORDINATOR, OBSERVER):
        return load_credentials(folder, ROBOT, [name])
    return host_credentials(folder, ROBOT, [name])


class Network:
    """A hub and its spokes, secured or not."""

    def __init__(self, stack: ExitStack, endpoint: str, folder: Path | None):
        self._stack, self._endpoint, self._folder = stack, endpoint, folder
        known = party(folder, COORDINATOR) if folder else None
        self.hub = self._open(ZenohConfig.hub(endpoint, known))

    def _open(self, config: ZenohConfig) -> ZenohTransport:
        opened = open_zenoh(config)
        self._stack.callback(opened.close)
        return opened

    def join(self, name: str) -> ZenohTransport:
        known = party(self._folder, name) if self._folder else None
        return self._open(
            ZenohConfig(mode="client", connect=(self._endpoint,), connect_timeout_s=5.0, credentials=known)
        )


@pytest.fixture
def network(endpoint: str, folder: Path) -> Iterator[Callable[[bool], Network]]:
    with ExitStack() as stack:
        yield lambda is_secured: Network(stack, endpoint, folder if is_secured else None)


def wait(condition: Callable[[], object]) -> None:
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def asked(transport: ZenohTransport, at: str) -> Reply:
    replies: list[Event] = []
    transport.query(at, b"?", 1.0, replies.append, 1)
    wait(lambda: replies)
    assert isinstance(replies[0], Reply)
    return replies[0]


def serve(transport: ZenohTransport, serial: str, leaf: Leaf, answer: bytes) -> list[Request]:
    seen: list[Request] = []

    def on_request(event: Event) -> None:
        assert isinstance(event, Request)
        seen.append(event)
        event.reply(answer)

    transport.serve(key(ROBOT, serial, leaf), on_request)
    return seen


def test_on_a_secured_network_modules_are_heard_asked_and_stopped(network: Callable[[bool], Network]) -> None:
    net = network(True)
    heard: list[Event] = []
    net.hub.subscribe(every(ROBOT, Leaf.STATUS), heard.append)
    net.hub.watch_alive(every(ROBOT, Leaf.ALIVE), heard.append)
    a, b, observer = net.join("A"), net.join("B"), net.join(OBSERVER)
    told: list[Event] = []
    b.subscribe(key(ROBOT, "B", Leaf.STOP), told.append)
    serve(b, "B", Leaf.LEASE, b"granted")
    serve(b, "B", Leaf.STATUS, b"here")
    seen: list[Event] = []
    observer.subscribe(every(ROBOT, Leaf.STATUS), seen.append)
    a.declare_alive(key(ROBOT, "A", Leaf.ALIVE))
    wait(lambda: asked(net.hub, key(ROBOT, "B", Leaf.LEASE)).payload == b"granted")
    wait(lambda: asked(observer, key(ROBOT, "B", Leaf.STATUS)).payload == b"here")
    a.publish(key(ROBOT, "A", Leaf.STATUS), b"1")
    wait(lambda: Sample(key(ROBOT, "A", Leaf.STATUS), b"1") in heard)
    wait(lambda: Sample(key(ROBOT, "A", Leaf.STATUS), b"1") in seen)
    wait(lambda: Liveness(key(ROBOT, "A", Leaf.ALIVE), True) in heard)
    for sender in (a, observer, net.hub):
        sender.publish(key(ROBOT, "B", Leaf.STOP), b"stop")
    wait(lambda: len(told) == 3)


@pytest.mark.parametrize("is_secured", [False, True])
def test_what_a_hostile_module_or_observer_does_in_the_name_of_another_fails_only_when_secured(
    network: Callable[[bool], Network], is_secured: bool
) -> None:
    """Without security all of it succeeds: that is the positive control."""
    net = network(is_secured)
    heard: list[Event] = []
    net.hub.subscribe(every(ROBOT, Leaf.FEEDBACK), heard.append)
    net.hub.watch_alive(every(ROBOT, Leaf.ALIVE), heard.append)
    b = net.join("B")
    aims: list[Event] = []
    commands = Leaf.SETPOINT, Leaf.LEASE
    for leaf in commands:
        b.subscribe(key(ROBOT, "B", leaf), aims.append)
    leases = serve(b, "B", Leaf.LEASE, b"of B")
    wait(lambda: asked(net.hub, key(ROBOT, "B", Leaf.LEASE)).payload == b"of B")
    leases.clear()
    for intruder in (net.join("A"), net.join(OBSERVER)):
        overheard: list[Event] = []
        for leaf in commands:
            intruder.subscribe(key(ROBOT, "B", leaf), overheard.append)
        intruder.declare_alive(key(ROBOT, "GHOST", Leaf.ALIVE))
        stolen = serve(intruder, "B", Leaf.GAINS, b"of the intruder")
        time.sleep(GRACE_S)
        heard.clear(), aims.clear(), leases.clear()
        intruder.publish(key(ROBOT, "B", Leaf.FEEDBACK), b"forged")
        for leaf in commands:
            intruder.publish(key(ROBOT, "B", leaf), b"forged")
        lease = asked(intruder, key(ROBOT, "B", Leaf.LEASE))
        gains = asked(net.hub, key(ROBOT, "B", Leaf.GAINS))
        for leaf in commands:
            net.hub.publish(key(ROBOT, "B", leaf), b"true")
        wait(lambda: set(samples(b"true", *commands)) <= set(aims))
        time.sleep(GRACE_S)
        succeeded = {
            "forged rows": Sample(key(ROBOT, "B", Leaf.FEEDBACK), b"forged") in heard,
            "forged setpoints": samples(b"forged", Leaf.SETPOINT)[0] in aims,
            "forged renewals": samples(b"forged", Leaf.LEASE)[0] in aims,
            "overheard setpoints": samples(b"true", Leaf.SETPOINT)[0] in overheard,
            "overheard renewals": samples(b"true", Leaf.LEASE)[0] in overheard,
            "asked for the lease": bool(leases) or lease.payload is not None,
            "answered for another": bool(stolen) or gains.payload is not None,
        }
        assert succeeded == dict.fromkeys(succeeded, not is_secured)
    ghosts = [event for event in net_tokens(net) if event.key == key(ROBOT, "GHOST", Leaf.ALIVE)]
    assert bool(ghosts) == (not is_secured)


def samples(payload: bytes, *leaves: Leaf) -> list[Sample]:
    return [Sample(key(ROBOT, "B", leaf), payload) for leaf in leaves]


def net_tokens(net: Network) -> list[Liveness]:
    events: list[Event] = []
    net.hub.watch_alive(every(ROBOT, Leaf.ALIVE), events.append)
    time.sleep(GRACE_S)
    return [event for event in events if isinstance(event, Liveness)]


def test_who_has_no_certificate_of_the_authority_does_not_get_in(
    network: Callable[[bool], Network], endpoint: str, tmp_path: Path
) -> None:
    network(True)
    make_credentials(tmp_path / "foreign", ROBOT, ["A"])
    foreign = party(tmp_path / "foreign", "A")
    for known in (None, foreign):
        with pytest.raises(NoHub, match="certificates of the same authority"):
            open_zenoh(
                ZenohConfig(mode="client", connect=(endpoint,), connect_timeout_s=1.5, credentials=known)
            )


def test_nobody_but_the_coordinator_can_be_the_hub(folder: Path, endpoint: str) -> None:
    """Neither by our own programs, nor by a foreign one that serves with a module's certificate."""
    for name in ("A", OBSERVER):
        with pytest.raises(TransportError, match="good for connecting only"):
            open_zenoh(ZenohConfig.hub(endpoint, party(folder, name)))

    settings = {
        "mode": "router",
        "listen/endpoints": [secured(endpoint)],
        "scouting/multicast/enabled": False,
    }
    config = zenoh.Config()
    for name, value in {**settings, **party(folder, "A").settings(as_hub=False)}.items():
        config.insert_json5(name, json.dumps(value))
    rogue = zenoh.open(config)
    try:
        with pytest.raises(NoHub):
            open_zenoh(
                ZenohConfig(
                    mode="client",
                    connect=(endpoint,),
                    connect_timeout_s=1.5,
                    credentials=party(folder, "B"),
                )
            )
    finally:
        rogue.close()


def test_a_process_takes_the_narrowest_certificate_that_covers_its_modules(folder: Path) -> None:
    assert host_credentials(folder, ROBOT, ["B"]).name == "module-B"
    assert host_credentials(folder, ROBOT, ["C", "B"]).name == "host-B+C"
    with pytest.raises(UsageError, match="--together A,B"):
        host_credentials(folder, ROBOT, ["A", "B"])


def test_a_folder_that_does_not_fit_is_refused_by_what_is_missing(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no fleet.toml in it; `x5-coordinator keys --out"):
        load_fleet(tmp_path)
    with pytest.raises(UsageError, match="made for robot 'arm', this is robot 'leg'"):
        load_credentials(folder, "leg", [COORDINATOR])
    (tmp_path / "fleet.toml").write_text((folder / "fleet.toml").read_text())
    with pytest.raises(UsageError, match=r"observer.pem with observer.key or spy.pem with spy.key"):
        load_credentials(tmp_path, ROBOT, [OBSERVER, "spy"])
    (tmp_path / "fleet.toml").write_text("robot = 3\n")
    with pytest.raises(UsageError, match=r"fleet.toml:1: robot: expected a text, found 3"):
        load_fleet(tmp_path)


def test_only_tls_is_spoken_with_credentials() -> None:
    assert secured("tcp/robot.local:7447") == secured("tls/robot.local:7447") == "tls/robot.local:7447"
    with pytest.raises(UsageError, match="it must be tls/HOST:PORT"):
        secured("udp/127.0.0.1:7447")


def test_no_rule_lets_a_module_speak_for_another(folder: Path) -> None:
    """Read from the generated rules themselves, for every host and every leaf."""
    control = access_control(load_fleet(folder))
    rules = {rule["id"]: rule for rule in control["rules"]}
    assert control["default_permission"] == "deny"
    for policy in control["policies"]:
        (name,) = policy["subjects"]
        if not name.startswith("module-"):
            continue
        own = name.removeprefix("module-")
        for rule in (rules[each] for each in policy["rules"]):
            if rule["flows"] == ["egress"]:
                continue
            for expression in rule["key_exprs"]:
                _, _, serial, leaf = expression.split("/")
                speaks = {"put", "reply", "declare_queryable", "liveliness_token"} & set(rule["messages"])
                assert serial == own or leaf == Leaf.STOP or not speaks
                asks = "query" in rule["messages"]
                assert not asks or leaf in (Leaf.HISTORY, Leaf.STOP)
