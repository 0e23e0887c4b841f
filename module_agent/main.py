"""`x5-agent`: the process that runs one or several modules on a physics bus and the network."""

import os
import secrets
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand

from module_agent.control.safety import Safety
from module_agent.control.safety_file import read_safety
from module_agent.firmware.config import config_of
from module_agent.hardware.bus_client import BusClient
from module_agent.hardware.hardware import HardwareLost, Modules
from module_agent.hardware.hebi_library import HEBI
from module_agent.hardware.hebi_library import library as hebi_library
from module_agent.hardware.hebi_network import FAMILY, RATE_HZ, HebiOptions, open_modules, seen
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.catalogue import ImuKind
from module_agent.model.errors import EXIT_FAILED, EXIT_LOST, EXIT_USAGE, RobotError, UsageError
from module_agent.model.garbage import leave_out_imports
from module_agent.model.settings import read_settings, variable
from module_agent.model.version import installed_version
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

app = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False)

CONNECT_ATTEMPT_S = 1.0
# An agent prints this when it is up; the launcher waits for it.
ATTACHED = "attached to the bus and the network"


class Stopped(SystemExit):
    """Raised in the main thread by a signal that ends, so that even a blocked tick ends cleanly."""


def _handle_signals(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # What was started to outlive its terminal (nohup) does.
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def _stop(number: int, _frame: FrameType | None) -> None:
    _handle_signals(signal.SIG_IGN)
    raise Stopped({signal.SIGTERM: 0, signal.SIGINT: 130}.get(signal.Signals(number), 128 + number))


@contextmanager
def _signals_later() -> Iterator[None]:
    """Let a signal end the program when this is over, and not before.

    Machine code is loaded with callbacks from C to Python. What a signal raises in one of them is printed and
    lost, and the program would go on.
    """
    came: list[int] = []
    _handle_signals(lambda number, _frame: came.append(number))
    try:
        yield
    finally:
        _handle_signals(_stop)
        if came:
            _stop(came[0], None)


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


class AgentCommand(TyperCommand):
    """The command with its repeated options from `x5.toml` or the environment (see `settings`)."""

    def make_context(self, *arguments: Any, **more: Any) -> Any:
        """Return the context of a call, with settings as defaults."""
        try:
            settings = read_settings(os.environ, Path())
        except UsageError as error:
            typer.echo(f"x5-agent: {error}", err=True)
            raise typer.Exit(EXIT_USAGE) from error
        for option in self.params:
            if option.name in ("robot", "connect", "secure"):
                option.envvar = variable(option.name)
        return super().make_context(*arguments, default_map=settings, **more)


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(installed_version())
        raise typer.Exit


@app.command(cls=AgentCommand, epilog="Example: x5-agent --robot my_arm --bus runs/bus --serial shoulder")
def main(
    serial: Annotated[
        list[str] | None, typer.Option(help="Serial of a module to run; repeat for several.")
    ] = None,
    bus: Annotated[str, typer.Option(help="Path of the physics bus of the world.")] = "",
    hebi: Annotated[bool, typer.Option("--hebi", help="Run real HEBI modules, in place of a bus.")] = False,
    family: Annotated[str, typer.Option(help="HEBI: family of the modules.")] = FAMILY,
    name: Annotated[
        list[str] | None, typer.Option(help="HEBI: name of a module; repeat for several [all of the family].")
    ] = None,
    module_type: Annotated[
        list[str] | None,
        typer.Option("--type", help="HEBI: type of each module, in their order [what they tell]."),
    ] = None,
    rate: Annotated[
        float, typer.Option(help="HEBI: ticks a second, each a command and a feedback.")
    ] = RATE_HZ,
    list_modules: Annotated[
        bool, typer.Option("--list", help="HEBI: list the modules on the network, and end.")
    ] = False,
    library: Annotated[str, typer.Option(hidden=True, help="What stands in for hebi-py.")] = HEBI,
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
    strategy: Annotated[
        int | None,
        typer.Option(
            min=0, max=4, help="Control strategy to begin with, and its factory gains [what modules have]."
        ),
    ] = None,
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
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Run the agent of one or several modules until the world ends or a signal comes.

    Simulated modules are those of a world on a physics bus (--serial, --bus), real ones those on HEBI's
    network (--hebi --family F --name N).
    """
    of_hebi = {"--family": family != FAMILY, "--name": name, "--type": module_type, "--rate": rate != RATE_HZ}
    with _usage_errors():
        _check_source(hebi, of_hebi | {"--list": list_modules}, {"--serial": serial, "--bus": bus})
    if list_modules:
        _list(library)
        return
    options = HebiOptions(family, tuple(name or ()), tuple(module_type or ()), rate, safety, library)
    settings = {
        "feedback_rate_hz": feedback_rate,
        "lifetime_ns": round(lifetime_ms * 1e6),
        "expiry_action": expiry,
        "strategy": strategy,
        "imu": imu,
    }

    def open_transport(serials: list[str]) -> Transport:
        known = host_credentials(secure, robot, serials) if secure else None
        return _transport(connect or [DEFAULT_ENDPOINT], listen or [], network_named(network), seed, known)

    with _usage_errors():
        check_chunk("robot", robot)
        for one in serial or ():
            check_chunk("serial", one)
        network_named(network)
        _check_expiry(expiry, hebi)
        limits = read_safety(safety, serial or []) if safety and not hebi else {}
    _run(robot, options if hebi else _OnBus(bus, tuple(serial or ()), limits), open_transport, settings)


def _check_source(hebi: bool, of_hebi: Mapping[str, object], of_bus: Mapping[str, object]) -> None:
    """Check that modules are given either on a bus or on HEBI's network.

    An option of the other kind is no way to choose among these: without this check all of them would be run.

    Raises:
        UsageError: neither is given, or options of both.
    """
    if not hebi and not any(of_hebi.values()) and not all(of_bus.values()):
        raise UsageError("give --serial and --bus for simulated modules, or --hebi for real ones")
    other = [option for option, given in (of_bus if hebi else of_hebi).items() if given]
    if other:
        why = (
            "simulated modules; real ones are chosen by --family and --name"
            if hebi
            else "real modules: add --hebi"
        )
        raise UsageError(f"{', '.join(other)} chooses {why}")


class _OnBus(NamedTuple):
    """Simulated modules on a physics bus."""

    path: str
    serials: tuple[str, ...]
    limits: Mapping[str, Safety]


@contextmanager
def _usage_errors() -> Iterator[None]:
    try:
        yield
    except (RobotError, OSError) as error:
        typer.echo(f"x5-agent: {error}", err=True)
        raise typer.Exit(EXIT_LOST if isinstance(error, HardwareLost) else EXIT_USAGE) from error


def _run(
    robot: str,
    source: HebiOptions | _OnBus,
    open_transport: Callable[[list[str]], Transport],
    settings: dict[str, Any],
) -> None:
    """Open modules and network, and serve until the modules are gone or a signal comes."""
    # Imported here: it brings the estimators, which `--help` does not need.
    from module_agent.host import AgentHost

    _handle_signals(_stop)
    # Estimates run on a second thread; a tick must not wait for it the default 5 ms.
    sys.setswitchinterval(0.0005)
    with ExitStack() as opened:
        with _usage_errors():
            modules: Modules
            if isinstance(source, HebiOptions):
                modules = open_modules(source, lambda text: typer.echo(f"x5-agent: {text}", err=True))
                opened.callback(modules.close)
                transport = open_transport([module.serial for module in modules.information])
                opened.callback(transport.close)
                leave_out_imports()
            else:
                transport = open_transport(list(source.serials))
                opened.callback(transport.close)
                leave_out_imports()
                # The world waits for every agent on its bus, so the bus comes last.
                modules = LoopInside(BusClient(source.path, source.serials), source.limits)
                opened.callback(modules.close)
            configs = [config_of(module, secrets.randbits(64), **settings) for module in modules.information]
            opened.callback((worker := ThreadWorker()).close)
            with _signals_later():
                host = AgentHost(robot, modules, transport, configs, worker)
        opened.pop_all()
    _serve(host, worker)


def _check_expiry(expiry: str, hebi: bool) -> None:
    possible = ("motor_off", "hold") if hebi else ("motor_off", "hold", "damping")
    if expiry not in possible:
        raise UsageError(
            f"--expiry {expiry}: it must be {', '.join(possible[:-1])} or {possible[-1]}"
            + (" with --hebi: a real module damps by a command, and has none when it expires" if hebi else "")
        )


def _list(library: str) -> None:
    with _usage_errors():
        modules = seen(hebi_library(library))
    rows = [("family", "name", "serial", "type", "firmware", "address")]
    rows += [(m.family, m.name, m.serial, m.mechanical_type, m.firmware, m.address) for m in modules]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        typer.echo("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
    if not modules:
        typer.echo(
            "x5-agent: no HEBI module answers: is this host on their network, and are they on?", err=True
        )
        raise typer.Exit(EXIT_FAILED)


def _say(text: str) -> None:
    """Print a line on standard error; a closed terminal or full disk there does not end the agent."""
    with suppress(OSError):
        typer.echo(text, err=True)


def _serve(host: "AgentHost", worker: ThreadWorker) -> None:
    names = ", ".join(module.serial for module in host.modules)
    try:
        _say(f"x5-agent: {names}: {ATTACHED}, process {os.getpid()}")
        while True:
            host.cycle()
    except HardwareLost as error:
        _say(f"x5-agent: {names}: the modules are gone: {error}")
        raise typer.Exit(EXIT_LOST) from error
    finally:
        # The end of the world is mostly followed by a signal that ends the agents too: one in the middle of
        # closing would leave the session half open, and its threads would keep the process for ever.
        _handle_signals(signal.SIG_IGN)
        host.close()
        worker.close()


if __name__ == "__main__":
    app()
