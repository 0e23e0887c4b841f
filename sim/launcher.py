"""World, agents and coordinator as processes: started and stopped in order, nothing left behind."""

import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

START_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 5.0
_PR_SET_PDEATHSIG = 1


class LaunchError(RuntimeError):
    """A process did not come up or died; the message says which and what it printed last."""


class LaunchConfig(NamedTuple):
    """What is started; `processes` is how many agent processes share the modules (None: one each)."""

    robot_file: str
    robot_name: str
    serials: tuple[str, ...]
    out: Path
    seed: int = 0
    network: str = "lan"
    noise: str | None = None
    speed: float = 1.0
    endpoint: str = "tcp/127.0.0.1:7447"
    processes: int | None = None
    coordinator_options: tuple[str, ...] = ()
    agent_options: tuple[str, ...] = ()


class Child(NamedTuple):
    """A started process and where its output goes."""

    name: str
    process: "subprocess.Popen[bytes]"
    log: Path | None


def _die_with_parent() -> None:
    # A launcher that is killed outright cannot stop its children; the kernel does it then.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Launcher:
    """Starts and stops the processes of one robot. Use as a context manager."""

    def __init__(self, config: LaunchConfig, say: Callable[[str], None]):
        self.config = config
        self._say = say
        self._folder = tempfile.TemporaryDirectory(prefix="x5-")
        self.bus = str(Path(self._folder.name) / "bus")
        self.children: list[Child] = []

    def __enter__(self) -> "Launcher":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    # ------------------------------------------------------------------ starting

    def start_world(self) -> Child:
        """Start the world and wait until its bus listens."""
        config = self.config
        arguments = ["sim.main", "world", config.robot_file, "--bus", self.bus, "--seed", str(config.seed)]
        arguments += ["--speed", str(config.speed), "--truth", str(config.out)]
        if config.noise is not None:
            arguments += ["--noise", config.noise]
        world = self._start("world", arguments)
        self._wait(lambda: os.path.exists(self.bus), world, "its bus")
        return world

    def start_agents(self) -> list[Child]:
        """Start the agent processes; they wait for the coordinator by themselves."""
        config = self.config
        count = config.processes or len(config.serials)
        shares = [config.serials[i::count] for i in range(min(count, len(config.serials)))]
        return [self.start_agent(share, index) for index, share in enumerate(shares)]

    def start_agent(self, serials: Sequence[str], index: int = 0) -> Child:
        """Start one agent process that hosts these modules."""
        config = self.config
        arguments = ["module_agent.main", "--bus", self.bus, "--robot", config.robot_name]
        arguments += ["--connect", config.endpoint, "--network", config.network]
        arguments += ["--seed", str(1000 * config.seed + index + 1), *config.agent_options]
        for serial in serials:
            arguments += ["--serial", serial]
        return self._start(f"agent {','.join(serials)}", arguments)

    def start_coordinator(self, options: Sequence[str] = (), quiet: bool = False) -> Child:
        """Start the coordinator; its output goes to this terminal, or to its log when `quiet`."""
        config = self.config
        arguments = ["coordinator.main", "run", "--out", str(config.out), "--robot", config.robot_name]
        arguments += ["--listen", config.endpoint, "--network", config.network]
        arguments += ["--seed", str(1000 * config.seed), "--expect", str(len(config.serials))]
        arguments += ["--speed", str(config.speed), *config.coordinator_options, *options]
        return self._start("coordinator", arguments, quiet)

    def _start(self, name: str, arguments: Sequence[str], quiet: bool = True) -> Child:
        log = Path(self._folder.name) / f"{len(self.children)}.log" if quiet else None
        with open(log if log is not None else os.devnull, "wb") as output:
            # Its own session: Ctrl-C reaches the launcher alone, which then stops the others in order.
            process = subprocess.Popen(
                [sys.executable, "-m", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output if quiet else None,
                stderr=subprocess.STDOUT if quiet else None,
                start_new_session=True,
                preexec_fn=_die_with_parent,
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        child = Child(name, process, log)
        self.children.append(child)
        self._say(f"{name}: process {process.pid}")
        return child

    def _wait(self, ready: Callable[[], bool], child: Child, what: str) -> None:
        end = time.monotonic() + START_TIMEOUT_S
        while not ready():
            if child.process.poll() is not None:
                raise LaunchError(f"{child.name} ended with {child.process.returncode}: {last_words(child)}")
            if time.monotonic() > end:
                raise LaunchError(f"{child.name} did not open {what} within {START_TIMEOUT_S:.0f} s")
            time.sleep(0.02)

    # ------------------------------------------------------------------ watching and stopping

    def dead(self) -> list[Child]:
        """Return the processes that have ended."""
        return [child for child in self.children if child.process.poll() is not None]

    def stop(self) -> None:
        """Stop everything, coordinator first and world last, and remove the bus. May be called twice."""
        for child in reversed(self.children):
            stop_child(child)
        self.children.clear()
        self._folder.cleanup()


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


def last_words(child: Child) -> str:
    """Return the last lines that a process printed."""
    if child.log is None or not child.log.exists():
        return ""
    return " / ".join(child.log.read_text(errors="replace").strip().splitlines()[-3:])
