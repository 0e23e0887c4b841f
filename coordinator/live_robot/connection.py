"""Join a robot's network: as its hub, as a client of the hub that is there, or at routers."""

import os
import secrets
import socket
from collections.abc import Callable
from typing import NamedTuple

from coordinator.live_robot.messenger import Sender
from module_agent.model.errors import UsageError
from module_agent.network_emulation.impaired_transport import inject
from module_agent.network_emulation.profile import PROFILES, NetworkProfile
from module_agent.transport.credentials import Credentials
from module_agent.transport.endpoint import OPEN_TO_ALL, is_loopback
from module_agent.transport.transport import EndpointInUse, Transport, TransportError
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh
from module_agent.wire.proof import SECRET_BYTES

JOIN_TIMEOUT_S = 5.0


class Place(NamedTuple):
    """A robot on a network: the endpoint to listen on, or routers to connect to, and the injected network.

    With `credentials` the network is a secured one.
    """

    robot: str
    listen: str
    connect: tuple[str, ...]
    network: NetworkProfile = PROFILES["none"]
    seed: int = 0
    credentials: Credentials | None = None


class Connection(NamedTuple):
    """The robot's network, and whether this program is its hub."""

    transport: Transport
    is_hub: bool


def exposures(place: Place) -> list[str]:
    """Return a sentence on every endpoint of a robot by which other machines reach it."""
    endpoints = place.connect or (place.listen,)
    is_secured = place.credentials is not None
    return [
        f"{endpoint} is open to the network: {OPEN_TO_ALL}"
        for endpoint in endpoints
        if not is_secured and not is_loopback(endpoint)
    ]


def open_connection(place: Place, note: Callable[[str], None]) -> Connection:
    """Join a robot's network: at its routers, as its hub, or as a client of the hub that it has already.

    `note` is called with what a user should know.

    Raises:
        UsageError: it cannot be joined.
    """
    is_hub = False
    known = place.credentials
    for sentence in exposures(place):
        note(sentence)
    try:
        if place.connect:
            opened = open_zenoh(_client(place.connect, known))
        elif known is not None and not known.may_serve:
            opened = open_zenoh(_client((place.listen,), known))
        else:
            try:
                opened, is_hub = open_zenoh(ZenohConfig.hub(place.listen, known)), True
            except EndpointInUse:
                # By another coordinator, or a router.
                opened = open_zenoh(_client((place.listen,), known))
                note(f"{place.listen} is in use: joined the hub there")
    except (OSError, TransportError) as error:
        raise UsageError(str(error)) from error
    return Connection(inject(opened, place.network, place.seed, "coordinator"), is_hub)


def _client(connect: tuple[str, ...], known: Credentials | None) -> ZenohConfig:
    return ZenohConfig(mode="client", connect=connect, connect_timeout_s=JOIN_TIMEOUT_S, credentials=known)


def new_sender() -> Sender:
    """Return this program as a sender."""
    name = f"coordinator-{os.getpid()}@{socket.gethostname()}-{secrets.token_hex(2)}"[:64]
    return Sender(name, secrets.token_bytes(SECRET_BYTES))
