"""`x5-agent`: the process that runs one or several modules on a physics bus and the network."""

import gc
import os
import secrets
import signal
import sys
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from module_agent.control.safety_file import read_safety
from module_agent.firmware.config import config_of
from module_agent.hardware.bus_client import BusClient
from module_agent.hardware.hardware import HardwareLost
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.catalogue import ImuKind
from module_agent.model.errors import EXIT_LOST, EXIT_USAGE, RobotError, UsageError
from module_agent.network_emulation.impaired_transport import inject
from module_agent.network_emulation.profile import PROFILES, NetworkProfile
from module_agent.network_emulation.profile_file import network as network_named
from module_agent.transport.credentials import Credentials, host_credentials
from module_agent.transport.endpoint import DEFAULT_ENDPOINT, OPEN_TO_ALL, is_loopback
from module_agent.transport.transport import NoHub, Transport
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh
from module_agent.wire.keys import check_chunk
from module_agent.worker import ThreadWorker

if TYPE_CHECKING:
    from module_agent.host import AgentHost

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)

CONNECT_ATTEMPT_S = 1.0
# An agent prints this when it is up; the launcher waits for it.
ATTACHED = "attached to the bus and the network"


class Stopped(SystemExit):
    """Raised in the main thread by SIGINT and SIGTERM, so that even a blocked tick ends cleanly."""


def _ignore_signals() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _stop(number: int, _frame: FrameType | None) -> None:
    _ignore_signals()
    raise Stopped(0 if number == signal.SIGTERM else 130)


def _transport(
    connect: list[str],
    listen: list[str],
    network: NetworkProfile,
    seed: int,
    credentials: Credentials | None,
) -> Transport:
    """Open the session, waiting for the hub as long as it takes; a signal ends the waiting.

    Raises:
        TransportError: an endpoint is wrong, or taken; waiting would not help.
    """
    config = ZenohConfig(
        mode="client",
        connect=tuple(connect),
        listen=tuple(listen),
        connect_timeout_s=CONNECT_ATTEMPT_S,
        credentials=credentials,
    )
    for endpoint in (*connect, *listen):
        if credentials is None and not is_loopback(endpoint):
            typer.echo(f"x5-agent: {endpoint} is open to the network: {OPEN_TO_ALL}", err=True)
    reported = False
    while True:
        try:
            return inject(open_zenoh(config), network, seed, "module")
        except NoHub as error:
            if not reported:
                reported = True
                typer.echo(f"x5-agent: waiting for the network: {error}", err=True)


@app.command()
def main(
    serial: Annotated[list[str], typer.Option(help="Serial of a module to run; repeat for several.")],
    bus: Annotated[str, typer.Option(help="Path of the physics bus of the world.")],
    robot: Annotated[str, typer.Option(help="Name of the robot, part of every key.")] = "robot",
    connect: Annotated[
        list[str] | None,
        typer.Option(help=f"Zenoh endpoint of the coordinator or a router [{DEFAULT_ENDPOINT}]."),
    ] = None,
    listen: Annotated[list[str] | None, typer.Option(help="Zenoh endpoint to listen on.")] = None,
    network: Annotated[
        str, typer.Option(help=f"Injected network: {', '.join(PROFILES)}, or a TOML file.")
    ] = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the injected network.")] = 0,
    feedback_rate: Annotated[
        float, typer.Option(min=1.0, max=1000.0, help="Feedback rows per second.")
    ] = 250.0,
    lifetime_ms: Annotated[float, typer.Option(min=1.0, max=1000.0, help="Command lifetime [ms].")] = 250.0,
    expiry: Annotated[str, typer.Option(help="On expiry: motor_off, hold or damping.")] = "motor_off",
    strategy: Annotated[int, typer.Option(min=0, max=4, help="Control strategy at start.")] = 3,
    secure: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Speak mutual TLS with the keys in this folder (x5-coordinator keys)."
        ),
    ] = None,
    safety: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Limits that the modules enforce, as TOML or HEBI safety XML."),
    ] = None,
    imu: Annotated[ImuKind, typer.Option(help="Calibration of the modules' IMUs.")] = "uncalibrated",
) -> None:
    """Run the agent of one or several modules until the world ends or a signal comes."""
    # Imported here: it brings the estimators, which `--help` does not need.
    from module_agent.host import AgentHost

    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, _stop)
    # Estimates run on a second thread; a tick must not wait for it the default 5 ms.
    sys.setswitchinterval(0.0005)
    with ExitStack() as opened:
        try:
            check_chunk("robot", robot)
            injected = network_named(network)
            if expiry not in ("motor_off", "hold", "damping"):
                raise UsageError(f"--expiry {expiry}: it must be motor_off, hold or damping")
            limits = read_safety(safety, serial) if safety else {}
            known = host_credentials(secure, robot, serial) if secure else None
            transport = _transport(connect or [DEFAULT_ENDPOINT], listen or [], injected, seed, known)
            opened.callback(transport.close)
            # A full collection of what the imports have left takes 38 ms, in which no tick would run: it is
            # made once, and they are not looked at again.
            gc.collect()
            gc.freeze()
            # The world waits for every agent on its bus, so the bus comes last.
            modules = LoopInside(BusClient(bus, serial), limits)
            opened.callback(modules.close)
            configs = [
                config_of(
                    module,
                    secrets.randbits(64),
                    feedback_rate_hz=feedback_rate,
                    lifetime_ns=round(lifetime_ms * 1e6),
                    expiry_action=expiry,
                    strategy=strategy,
                    imu=imu,
                )
                for module in modules.information
            ]
            host = AgentHost(robot, modules, transport, configs, worker := ThreadWorker())
        except (RobotError, OSError) as error:
            typer.echo(f"x5-agent: {error}", err=True)
            raise typer.Exit(EXIT_USAGE) from error
        opened.pop_all()
    _serve(host, worker)


def _serve(host: "AgentHost", worker: ThreadWorker) -> None:
    names = ", ".join(module.serial for module in host.modules)
    typer.echo(f"x5-agent: {names}: {ATTACHED}, process {os.getpid()}", err=True)
    try:
        while True:
            host.cycle()
    except HardwareLost as error:
        typer.echo(f"x5-agent: {names}: the world is gone: {error}", err=True)
        raise typer.Exit(EXIT_LOST) from error
    finally:
        # The end of the world is mostly followed by a signal that ends the agents too: one in the middle of
        # closing would leave the session half open, and its threads would keep the process for ever.
        _ignore_signals()
        host.close()
        worker.close()


if __name__ == "__main__":
    app()
