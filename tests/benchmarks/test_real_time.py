"""What real time costs, with one process per module and with several in each: figures, nothing is asserted.

Speeds are only worth something on a machine that is otherwise idle; CPU time per tick is robust. A tick can
be no shorter than the CPU time of all processes over the number of cores.
"""

import math
import os
import socket
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from module_agent.transport.transport import Event, Sample
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode
from module_agent.wire.feedback_rows import unpack
from module_agent.wire.keys import Leaf, every
from module_agent.wire.messages import Feedback
from sim.processes.fleet import FleetConfig, run_fleet
from sim.processes.fleet_figures import FleetFigures
from sim.processes.fleet_plan import plan_fleet
from sim.processes.launcher import Child, LaunchConfig, Launcher, last_output, stop_child
from sim.robot.robot_file import load_robot
from tests.benchmarks.bare_barrier import measure
from tests.benchmarks.bars import report

pytestmark = pytest.mark.benchmark

WINDOW_S = 20.0
# How long a moved robot and a bare barrier are measured.
MOVED_S, BARE_S = 15.0, 4.0
STARTUP_S = 60.0
_HERTZ = os.sysconf("SC_CLK_TCK")
CORES = os.cpu_count() or 1


class Cpu(NamedTuple):
    """CPU time of a process so far [s]: of its main thread, of its other threads, and within the kernel."""

    main_s: float
    others_s: float
    kernel_s: float


def cpu(pid: int) -> Cpu:
    user, kernel = _ticks(Path(f"/proc/{pid}/stat"))
    main = sum(_ticks(Path(f"/proc/{pid}/task/{pid}/stat")))
    return Cpu(main / _HERTZ, (user + kernel - main) / _HERTZ, kernel / _HERTZ)


def _ticks(stat: Path) -> tuple[int, int]:
    # The name of the program, in brackets, may hold blanks.
    fields = stat.read_text().rsplit(")", 1)[1].split()
    return int(fields[11]), int(fields[12])


class Ear:
    """Hears the feedback of all modules: how many rows, and the newest module time of each."""

    def __init__(self, robot: str, config: ZenohConfig):
        self.rows = 0
        self.newest_ns: dict[str, int] = {}
        self._transport = open_zenoh(config)
        self._transport.subscribe(every(robot, Leaf.FEEDBACK), self._hear)

    def _hear(self, event: Event) -> None:
        assert isinstance(event, Sample)
        feedback = decode(Feedback, event.payload, MAX_MESSAGE_BYTES)
        self.rows += feedback.count
        self.newest_ns[feedback.serial] = int(unpack(feedback)["t_ns"][-1])

    def wait_for(self, serials: tuple[str, ...], world: Child) -> None:
        end = time.monotonic() + STARTUP_S
        while set(serials) - set(self.newest_ns):
            assert world.process.poll() is None, last_output(world)
            assert time.monotonic() < end, f"only {sorted(self.newest_ns)} were heard"
            time.sleep(0.1)

    def close(self) -> None:
        self._transport.close()


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def _measure(ear: Ear, children: dict[str, list[int]], serials: tuple[str, ...]) -> None:
    """Print what a window of real time costs each kind of process, per tick."""
    pids = [pid for group in children.values() for pid in group]
    before, t_ns, rows, start = {p: cpu(p) for p in pids}, dict(ear.newest_ns), ear.rows, time.monotonic()
    time.sleep(WINDOW_S)
    after, wall_s = {p: cpu(p) for p in pids}, time.monotonic() - start
    passed_s = min((ear.newest_ns[s] - t_ns[s]) * 1e-9 for s in serials)
    ticks = passed_s * 1e3
    print(f"  {passed_s:.1f} s in {wall_s:.1f} s: {passed_s / wall_s:.2f} x real time; ", end="")
    print(f"{(ear.rows - rows) / passed_s / len(serials):.0f} rows/s heard of each module")
    total = 0.0
    for name, group in children.items():
        spent = [[1e6 * (b - a) / ticks for a, b in zip(before[p], after[p], strict=True)] for p in group]
        main, others, kernel = (sum(column) / len(group) for column in zip(*spent, strict=True))
        total += len(group) * (main + others)
        print(
            f"  {len(group):2d} x {name:12s} {main + others:6.1f} us a tick each: main thread {main:.1f}, "
            f"others {others:.1f}; {kernel:.1f} of it in the kernel"
        )
    print(f"  all: {total:.0f} us CPU a tick; on {CORES} cores at most {1e3 * CORES / total:.2f} x real time")


@pytest.mark.parametrize("processes", [16, 4])
@pytest.mark.parametrize("speed", [1.0, 20.0])
def test_sixteen_modules_in_real_time(tmp_path: Path, endpoint: str, processes: int, speed: float) -> None:
    """Idle modules that publish 250 rows/s each, and somebody who listens to all of them."""
    robot = load_robot("snake16")
    config = LaunchConfig(
        "snake16",
        robot.name,
        robot.serials,
        tmp_path,
        speed=speed,
        endpoint=endpoint,
        processes=processes,
        network="none",
    )
    print(f"\nsnake16, {processes} agent processes, world asked for {speed:g} x real time, modules idle")
    ear = Ear(robot.name, ZenohConfig.hub(endpoint))
    with Launcher(config, lambda text: None) as launcher:
        world = launcher.start_world()
        agents = launcher.start_agents()
        ear.wait_for(robot.serials, world)
        children = {"world": [world.process.pid], "agent": [a.process.pid for a in agents]}
        _measure(ear, {**children, "listener": [os.getpid()]}, robot.serials)
        for child in (world, *agents):
            stop_child(child)
        print(f"  the world, start included: {last_output(world)}")
    ear.close()


@pytest.mark.parametrize(("modules", "processes", "bar"), [(16, 16, 1.0), (32, 4, 1.5), (64, 8, 0.8)])
def test_robots_moved_by_a_coordinator_beside_a_bare_barrier(
    tmp_path: Path, modules: int, processes: int, bar: float
) -> None:
    """All joints are held at 1 kHz and move in turn; asked for a fifth more than the bar.

    It is not asked for much more, because the modules' clocks are as fast as their world: at three times
    real time the 250 ms that a command lives are 83 ms for the coordinator, whose keep-alives come every
    60 ms. The bare barrier runs before and after, so that both see the same machine.
    """
    bares = [measure(tmp_path, processes, modules, BARE_S, free_endpoint())]
    plan = plan_fleet(1, modules, (free_endpoint(),), processes)
    figures = run_fleet(FleetConfig(plan, tmp_path, MOVED_S, 1.2 * bar, moves=True), lambda text: None)
    bares.append(measure(tmp_path, processes, modules, BARE_S, free_endpoint()))
    what = f"{modules} modules in {processes} processes, moved by a coordinator"
    broke = "; ".join(figures.broke) or "nothing"
    report(f"{what}: times real time", figures.real_time, at_least=bar, anchor=f"broke first: {broke}")
    # Like for like: world and agents as server and processes, router and coordinator as the listener.
    for who, ours_us, bares_us in (
        ("world and agents", _served_us(figures), [bare.served_us for bare in bares]),
        ("all processes", figures.us_per_module_tick, [bare.all_us for bare in bares]),
    ):
        anchor = f"{ours_us:.1f} us over {min(bares_us):.1f} us"
        over = ours_us / min(bares_us)
        report(f"{what}: CPU of {who} over a bare barrier's", over, at_most=1.5, anchor=anchor)
    report(
        f"{what}: motions that did not end",
        figures.motions_failed if figures.motions else math.nan,
        at_most=0.0,
        anchor=f"{figures.motions} did",
    )


def _served_us(figures: FleetFigures) -> float:
    """Return the processor time of world and agents for each module and tick [us]."""
    percent = sum(figures.kinds[kind].cpu_percent for kind in ("world", "agent"))
    return 1e4 * percent / (1e3 * figures.real_time * figures.modules)
