"""A run at a terminal: its place on the network, signals, and what is said when it ends before its end."""

import os
import secrets
import socket
from typing import NamedTuple

from coordinator.commands.options import fail
from coordinator.identification.result import Result
from coordinator.runtime.event_loop import SIGNALS, Interruption, ScaledLoop, ignore_signals, run_to_end
from coordinator.runtime.exit_codes import EXIT_USAGE, explain
from coordinator.runtime.terminal import Terminal
from coordinator.session.run import Run, RunConfig
from module_agent.network_emulation.impaired_transport import inject
from module_agent.network_emulation.profile import PROFILES, NetworkProfile
from module_agent.transport.transport import EndpointInUse, Transport, TransportError
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh

JOIN_TIMEOUT_S = 5.0


class Place(NamedTuple):
    """Where the robot is to be met: a hub to be, or routers to connect to; and through which network."""

    listen: str
    connect: tuple[str, ...]
    network: NetworkProfile = PROFILES["none"]
    seed: int = 0


class Joined(NamedTuple):
    """The robot's network, and whether this program is its hub."""

    transport: Transport
    is_hub: bool


def join(place: Place, terminal: Terminal) -> Joined:
    """Join a robot's network: at its routers, as its hub, or with whoever is its hub already.

    Raises:
        OSError, TransportError: it cannot be joined.
    """
    if place.connect:
        routers = ZenohConfig(mode="client", connect=place.connect, connect_timeout_s=JOIN_TIMEOUT_S)
        return Joined(inject(open_zenoh(routers), place.network, place.seed, "coordinator"), False)
    try:
        hub = open_zenoh(ZenohConfig.hub(place.listen))
        return Joined(inject(hub, place.network, place.seed, "coordinator"), True)
    except EndpointInUse:
        # By another coordinator, or a router: join it as a client.
        joining = ZenohConfig(mode="client", connect=(place.listen,), connect_timeout_s=JOIN_TIMEOUT_S)
        transport = open_zenoh(joining)
        terminal.note(f"{place.listen} is in use: joined the hub there")
        return Joined(inject(transport, place.network, place.seed, "coordinator"), False)


def sender_name() -> str:
    """Return the name under which this program takes modules: unlike any other's."""
    return f"coordinator-{os.getpid()}@{socket.gethostname()}-{secrets.token_hex(2)}"[:64]


def run_attended(config: RunConfig, place: Place, speed: float, terminal: Terminal, advice: str) -> Result:
    """Run to the end, or end the command with what went wrong, what is recorded, and the advice.

    A first signal stops the robot in order.
    """
    loop = ScaledLoop(speed)
    interruption: Interruption | None = None
    try:
        work = _prepared(config, place, loop, terminal)
        task = loop.create_task(work.run())
        interruption = Interruption(loop, task)
        for number in SIGNALS:
            loop.add_signal_handler(number, interruption)
        try:
            return run_to_end(loop, task)
        except BaseException as error:
            failure = explain(error)
            if failure is None:
                raise
            kept = f"{failure.text}; {work.standstill}; recorded up to here: {config.out}"
            fail("\n".join((kept, advice)).rstrip(), failure.exit_code)
    finally:
        loop.run_until_complete(loop.shutdown_default_executor())
        # Closing hands the signals back to Python.
        loop.close()
        if interruption is not None and interruption.asked:
            ignore_signals()


def _prepared(config: RunConfig, place: Place, loop: ScaledLoop, terminal: Terminal) -> Run:
    """Open everything, or nothing."""
    try:
        transport = join(place, terminal).transport
    except (OSError, TransportError) as error:
        fail(error, EXIT_USAGE)
    try:
        return Run(config, transport, loop.clock_ns, loop.call_soon_threadsafe, terminal)
    except BaseException as error:
        transport.close()
        if isinstance(error, ValueError | OSError):
            fail(error, EXIT_USAGE)
        raise
