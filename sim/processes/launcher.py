"""World, agents and coordinator as processes: started and stopped in order, nothing left behind."""

import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from module_agent.control.safety import Safety
from module_agent.control.safety_file import safety_toml
from module_agent.main import ATTACHED
from module_agent.model.errors import RobotError
from module_agent.model.settings import SETTINGS, SETTINGS_VARIABLE, variable
from module_agent.transport.endpoint import DEFAULT_ENDPOINT
from sim.hebi_stand_in import on_bus
from sim.physics.engine import Physics
from sim.robot.noise_choice import NoiseChoice

# A first start without `x5-sim compile` compiles for over a minute.
START_TIMEOUT_S = 240.0
# A world writes its truth before it ends.
STOP_TIMEOUT_S = 20.0
WATCH_S = 0.1
LOGS = "logs"
SAFETY = "safety.toml"
# The file systems' limit is 255 bytes.
_MAX_NAME = 100
# A process is woken once a tick whatever it hosts: eight modules in one cost a sixth of eight processes.
MODULES_PER_PROCESS = 8
_PR_SET_PDEATHSIG = 1
EMPTY: Mapping[str, str] = MappingProxyType({})


class LaunchError(RobotError):
    """A process did not start or ended early; the message has its name and its last output."""


def default_processes(modules: int, cores: int | None = None) -> int:
    """Return how many agent processes share the modules: one a core, more if it would host over eight."""
    cores = cores or os.cpu_count() or 1
    return min(modules, max(cores, -(-modules // MODULES_PER_PROCESS)))


class LaunchConfig(NamedTuple):
    """The settings of a launch; `processes` is how many agent processes share the modules (None: one each).

    `pushes` are on the world, as its option `--push` takes them.
    `within` maps the name of a process ("world", "coordinator", or "agent" and its serials) to the command
    that it is run by, such as `nsenter` with a network namespace. `secure` is a folder of keys.
    `safety` are the limits of the modules by serial, which the agents read from `safety.toml` in the run's
    folder. With `hebi` the agents speak to the modules through the driver of real ones, over a stand-in for
    hebi-py. With `truth` the world keeps the true motion in its memory, for the run's folder.
    """

    robot_file: str
    robot_name: str
    serials: tuple[str, ...]
    out: Path
    seed: int = 0
    network: str = "lan"
    noise: NoiseChoice = NoiseChoice()
    speed: float = 1.0
    endpoint: str = DEFAULT_ENDPOINT
    processes: int | None = None
    coordinator_options: tuple[str, ...] = ()
    agent_options: tuple[str, ...] = ()
    within: Callable[[str], tuple[str, ...]] = lambda process: ()
    pushes: tuple[str, ...] = ()
    imu_rate_hz: float = 250.0
    physics: Physics = "pybullet"
    hebi: bool = False
    secure: Path | None = None
    safety: Mapping[str, Safety] = MappingProxyType({})
    truth: bool = True

    @property
    def shares(self) -> list[tuple[str, ...]]:
        """The serials of each agent process."""
        count = min(self.processes or len(self.serials), len(self.serials))
        return [self.serials[i::count] for i in range(count)]

    @property
    def secured(self) -> list[str]:
        """What agents and coordinator are told of security."""
        return [] if self.secure is None else ["--secure", str(self.secure)]


class Child(NamedTuple):
    """A started process, its log, and the text `up` that it prints there when it is ready."""

    name: str
    process: "subprocess.Popen[bytes]"
    log: Path | None
    up: str = ""


def _die_with_parent() -> None:
    # A launcher that is killed outright cannot stop its children; the kernel does it then.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _environment() -> dict[str, str]:
    """Return the environment of the processes: a launch says all, and no settings of a user change it."""
    settings = {variable(name) for name in SETTINGS}
    kept = {name: value for name, value in os.environ.items() if name not in settings}
    return {**kept, SETTINGS_VARIABLE: "", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


class Launcher:
    """Starts, watches and stops the processes of one robot. Use as a context manager.

    The output of the processes goes to `logs/` of the run's folder; `report` is called with one line whenever
    a process is ready or has ended.
    """

    def __init__(self, config: LaunchConfig, report: Callable[[str], None]):
        self.config = config
        self._report = report
        self._folder = tempfile.TemporaryDirectory(prefix="x5-")
        self.bus = str(Path(self._folder.name) / "bus")
        self.children: list[Child] = []
        self._waited_for: list[Child] = []
        self._ended: list[Child] = []

    def __enter__(self) -> "Launcher":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    # ------------------------------------------------------------------ starting

    def start_world(self) -> Child:
        """Start the world and wait until its bus listens."""
        config = self.config
        arguments = ["sim.main", "world", config.robot_file, "--bus", self.bus, "--seed", str(config.seed)]
        arguments += ["--speed", str(config.speed), *(("--truth", str(config.out)) if config.truth else ())]
        arguments += ["--imu-rate-hz", str(config.imu_rate_hz), "--physics", config.physics]
        arguments += config.noise.arguments
        for push in config.pushes:
            arguments += ["--push", push]
        world = self._start("world", arguments)
        self._wait(lambda: os.path.exists(self.bus), world, "its bus")
        self._report("world: bus open")
        return world

    def start_agents(self) -> list[Child]:
        """Start the agent processes; they wait for the coordinator by themselves."""
        if self.config.safety:
            (self.config.out / SAFETY).write_text(safety_toml(self.config.safety), encoding="utf-8")
        return [self.start_agent(share, index) for index, share in enumerate(self.config.shares)]

    def start_agent(self, serials: Sequence[str], index: int = 0) -> Child:
        """Start one agent process that hosts these modules."""
        config = self.config
        arguments = ["module_agent.main", "--robot", config.robot_name]
        arguments += ["--connect", config.endpoint, "--network", config.network]
        arguments += ["--seed", str(1000 * config.seed + index + 1), *config.secured, *config.agent_options]
        if config.safety:
            arguments += ["--safety", str(config.out / SAFETY)]
        environment = {}
        if config.hebi:
            arguments += ["--hebi", "--library", on_bus.__name__, "--family", on_bus.FAMILY]
            environment = {on_bus.BUS: self.bus, on_bus.SERIALS: ",".join(serials)}
        else:
            arguments += ["--bus", self.bus]
        for serial in serials:
            arguments += ["--name" if config.hebi else "--serial", serial]
        agent = self._start(f"agent {','.join(serials)}", arguments, up=ATTACHED, environment=environment)
        self._waited_for.append(agent)
        return agent

    def start_coordinator(self, options: Sequence[str] = (), quiet: bool = False) -> Child:
        """Start the coordinator; its output goes to this terminal, or to its log when `quiet`."""
        config = self.config
        arguments = ["coordinator.main", "run", "--out", str(config.out), "--robot", config.robot_name]
        arguments += ["--listen", config.endpoint, "--network", config.network]
        arguments += ["--seed", str(1000 * config.seed), "--expect", str(len(config.serials))]
        arguments += ["--speed", str(config.speed), *config.secured]
        arguments += [*config.coordinator_options, *options]
        return self._start("coordinator", arguments, quiet)

    def _log(self, name: str) -> Path:
        folder = self.config.out / LOGS
        folder.mkdir(parents=True, exist_ok=True)
        stem = name.replace(" ", "-").replace("/", "-")[:_MAX_NAME]
        taken = [child.log for child in self.children]
        paths = [folder / f"{stem}.log", *(folder / f"{stem}-{k}.log" for k in range(2, len(taken) + 3))]
        return next(path for path in paths if path not in taken)

    def _start(
        self,
        name: str,
        arguments: Sequence[str],
        quiet: bool = True,
        up: str = "",
        environment: Mapping[str, str] = EMPTY,
    ) -> Child:
        log = self._log(name) if quiet else None
        child = start_child(name, arguments, log, self.config.within(name), up, environment)
        self.children.append(child)
        self._report(f"{name}: process {child.process.pid}")
        return child

    def _wait(self, ready: Callable[[], bool], child: Child, what: str) -> None:
        end = time.monotonic() + START_TIMEOUT_S
        while not ready():
            if child.process.poll() is not None:
                raise LaunchError(_ending(child))
            if time.monotonic() > end:
                raise LaunchError(f"{child.name} did not open {what} within {START_TIMEOUT_S:.0f} s")
            time.sleep(0.02)

    # ------------------------------------------------------------------ watching and stopping

    def dead(self) -> list[Child]:
        """Return the processes that have ended."""
        return [child for child in self.children if child.process.poll() is not None]

    def watch(self, coordinator: Child) -> int:
        """Watch until the coordinator ends, and return its exit code (128 + n if signal n ended it).

        An agent that ends early is reported with its last output; the coordinator decides how to go on.

        Raises:
            LaunchError: the world ended early, so that there is no robot any more.
        """
        while (code := coordinator.process.poll()) is None:
            self.look(coordinator)
            time.sleep(WATCH_S)
        return code if code >= 0 else 128 - code

    def look(self, coordinator: Child) -> None:
        """Report once for every process that it is ready and that it has ended; see `watch`."""
        for child in [each for each in self._waited_for if each.up in whole_log(each)]:
            self._waited_for.remove(child)
            self._report(f"{child.name}: {child.up}")
        for child in [each for each in self.dead() if each not in self._ended and each != coordinator]:
            self._ended.append(child)
            if child.name == "world":
                raise LaunchError(_ending(child))
            self._report(_ending(child))

    def stop(self) -> None:
        """Stop everything, coordinator first and world last, and remove the bus. May be called twice."""
        for child in reversed(self.children):
            stop_child(child)
        self.children.clear()
        self._folder.cleanup()


def start_child(
    name: str,
    arguments: Sequence[str],
    log: Path | None,
    within: Sequence[str] = (),
    up: str = "",
    environment: Mapping[str, str] = EMPTY,
) -> Child:
    """Start `python -m arguments`; its output goes to the log, or to this terminal without one.

    `environment` is in addition to that of this process.
    """
    with open(log if log is not None else os.devnull, "wb") as output:
        # Its own session: Ctrl-C reaches the launcher alone, which then stops the others in order.
        process = subprocess.Popen(
            [*within, sys.executable, "-m", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output if log is not None else None,
            stderr=subprocess.STDOUT if log is not None else None,
            start_new_session=True,
            preexec_fn=_die_with_parent,
            env=_environment() | dict(environment),
        )
    return Child(name, process, log, up)


def stop_child(child: Child) -> None:
    """End one process: interrupt, then kill after a while."""
    if child.process.poll() is None:
        child.process.send_signal(signal.SIGCONT)
        child.process.send_signal(signal.SIGTERM)
        try:
            child.process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            child.process.kill()
    child.process.wait()


def whole_log(child: Child) -> str:
    """Return all that a process has printed."""
    if child.log is None or not child.log.exists():
        return ""
    return child.log.read_text(errors="replace")


def last_output(child: Child) -> str:
    """Return the last lines that a process printed."""
    return " / ".join(whole_log(child).strip().splitlines()[-3:])


def _ending(child: Child) -> str:
    return f"{child.name} ended with {child.process.returncode}: {last_output(child) or 'no output'}"
