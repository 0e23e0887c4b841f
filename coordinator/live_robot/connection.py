"""Join a robot's network: as its hub, as a client of the hub that is there, or at routers."""

import os
import secrets
import socket
from collections.abc import Callable
from typing import NamedTuple

from module_agent.model.errors import UsageError
from module_agent.network_emulation.impaired_transport import inject
from module_agent.network_emulation.profile import PROFILES, NetworkProfile
from module_agent.transport.transport import EndpointInUse, Transport, TransportError
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh

JOIN_TIMEOUT_S = 5.0


class Place(NamedTuple):
    """A robot on a network: the endpoint to listen on, or routers to connect to, and the injected network."""

    robot: str
    listen: str
    connect: tuple[str, ...]
    network: NetworkProfile = PROFILES["none"]
    seed: int = 0


class Connection(NamedTuple):
    """The robot's network, and whether this program is its hub."""

    transport: Transport
    is_hub: bool


def open_connection(place: Place, note: Callable[[str], None]) -> Connection:
    """Join a robot's network: at its routers, as its hub, or as a client of the hub that it has already.

    `note` is called with what a user should know.

    Raises:
        UsageError: it cannot be joined.
    """
    is_hub = False
    try:
        if place.connect:
            opened = open_zenoh(_client(place.connect))
        else:
            try:
                opened, is_hub = open_zenoh(ZenohConfig.hub(place.listen)), True
            except EndpointInUse:
                # By another coordinator, or a router.
                opened = open_zenoh(_client((place.listen,)))
                note(f"{place.listen} is in use: joined the hub there")
    except (OSError, TransportError) as error:
        raise UsageError(str(error)) from error
    return Connection(inject(opened, place.network, place.seed, "coordinator"), is_hub)


def _client(connect: tuple[str, ...]) -> ZenohConfig:
    return ZenohConfig(mode="client", connect=connect, connect_timeout_s=JOIN_TIMEOUT_S)


def sender_name() -> str:
    """Return the unique name under which this program holds leases."""
    return f"coordinator-{os.getpid()}@{socket.gethostname()}-{secrets.token_hex(2)}"[:64]
