"""Without security, a program says in plain words when its address can be reached from other machines."""

import asyncio
import warnings
from pathlib import Path
from typing import Any

import pytest

from coordinator import connect
from coordinator.live_robot import connection
from coordinator.live_robot.authority import make_credentials
from coordinator.live_robot.connection import Place, open_connection
from module_agent import main as agent
from module_agent.model.errors import UsageError
from module_agent.network_emulation.profile import PROFILES
from module_agent.transport.credentials import COORDINATOR, load_credentials
from module_agent.transport.endpoint import DEFAULT_ENDPOINT, is_loopback
from module_agent.transport.transport import TransportError
from module_agent.transport.zenoh_transport import ZenohConfig

CLOSED = [
    "tcp/127.0.0.1:7447",
    "tcp/127.9.9.9:7447",
    "tcp/[::1]:7447",
    "tcp/localhost:7447",
    "unixpipe/x5",
    "unixsock-stream/x5.sock",
]
OPEN = [
    "tcp/0.0.0.0:7447",
    "tcp/[::]:7447",
    "tcp/192.168.0.7:7447",
    "tls/robot.local:7447",
    "udp/[fe80::1]:1",
    # A module's computer at the other end of a cable, and a virtual machine.
    "serial//dev/ttyACM0",
    "vsock/1:2",
]


@pytest.fixture(autouse=True)
def network_that_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is to be said is said before anything is opened."""

    def refuse(config: Any) -> None:
        raise TransportError("taken")

    monkeypatch.setattr(connection, "open_zenoh", refuse)
    monkeypatch.setattr(agent, "open_zenoh", refuse)


def said_by_coordinator(endpoint: str, joins: bool, credentials: Any) -> list[str]:
    said: list[str] = []
    place = Place(
        "arm", DEFAULT_ENDPOINT if joins else endpoint, (endpoint,) if joins else (), credentials=credentials
    )
    with pytest.raises(UsageError, match="taken"):
        open_connection(place, said.append)
    return said


def said_by_agent(endpoint: str, credentials: Any, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(TransportError):
        agent._transport([endpoint], [], PROFILES["none"], 0, credentials)
    return capsys.readouterr().err


@pytest.mark.parametrize("endpoint", OPEN)
def test_an_address_open_to_others_is_warned_of(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert not is_loopback(endpoint)
    for joins in (False, True):
        (line,) = said_by_coordinator(endpoint, joins, None)
        assert line.startswith(f"{endpoint} is open to the network: every program")
        assert "--secure" in line
    assert f"{endpoint} is open to the network" in said_by_agent(endpoint, None, capsys)


async def connected(endpoint: str, secure: Path | None) -> None:
    async with connect("arm", listen=endpoint, secure=secure):
        pass


@pytest.mark.parametrize("endpoint", OPEN)
def test_an_address_open_to_others_is_warned_of_in_python_too(endpoint: str) -> None:
    with (
        pytest.warns(UserWarning, match="is open to the network: every program"),
        pytest.raises(UsageError, match="taken"),
    ):
        asyncio.run(connected(endpoint, None))


def test_in_python_a_secured_robot_is_joined_with_its_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_credentials(tmp_path, "arm", ["A"])
    opened: list[ZenohConfig] = []

    def refuse(config: ZenohConfig) -> None:
        opened.append(config)
        raise TransportError("taken")

    monkeypatch.setattr(connection, "open_zenoh", refuse)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UsageError, match="taken"):
            asyncio.run(connected("tcp/0.0.0.0:7447", tmp_path))
    assert [config.credentials for config in opened] == [load_credentials(tmp_path, "arm", [COORDINATOR])]
    with pytest.raises(UsageError, match="made for robot 'arm', this is robot 'robot'"):
        asyncio.run(_robot_of_another_name(tmp_path))


async def _robot_of_another_name(secure: Path) -> None:
    async with connect(secure=secure):
        pass


@pytest.mark.parametrize("endpoint", CLOSED)
def test_an_address_of_this_machine_is_not(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert is_loopback(endpoint)
    assert said_by_coordinator(endpoint, False, None) == []
    assert said_by_agent(endpoint, None, capsys) == ""


def test_by_default_a_program_listens_on_this_machine_only() -> None:
    assert is_loopback(DEFAULT_ENDPOINT)


def test_a_secured_network_may_be_open_to_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_credentials(tmp_path / "keys", "arm", ["X-00009"])
    secured = load_credentials(tmp_path / "keys", "arm", [COORDINATOR])
    assert said_by_coordinator(OPEN[0], False, secured) == []
    assert said_by_agent(OPEN[0], secured, capsys) == ""
