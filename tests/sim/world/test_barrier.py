"""A world that runs its ticks and the barrier in one compiled call, with agents on its bus."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from module_agent.hardware.bus_client import BusClient
from sim.robot.robot_file import load_robot
from sim.world.bus_server import BusServer
from sim.world.truth import TruthLog
from sim.world.world import World

ROBOT, SEED, TICKS = "thesis_171_horizontal", 5, 300


@contextmanager
def served(path: str, log: TruthLog, speed: float | None, lines: list[str]) -> Iterator[None]:
    server, stopping = BusServer(path, log, bound_s=0.3, report=lines.append), threading.Event()
    thread = threading.Thread(target=server.run, args=(speed, stopping.is_set))
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join()


def test_the_world_behind_a_bus_moves_as_one_that_is_stepped_by_hand(tmp_path: Path) -> None:
    """To the bit, samples and truth, from whatever tick the agents are in step."""
    robot, path = load_robot(ROBOT), str(tmp_path / "bus")
    log = TruthLog(World(robot, SEED))
    assert log.ticks_ahead
    pwm = 0.3 * np.sin(np.outer(np.arange(TICKS), 0.02 + 0.01 * np.arange(len(robot.serials))))
    # One agent has the modules in the opposite order.
    serials = robot.serials[::-1]
    with served(path, log, None, []):
        client = BusClient(path, serials)
        samples = [list(client.exchange(row.tolist())) for row in pwm[:, ::-1]]
        first_tick = int(client.kernel_state[-1][0]) - TICKS + 1
        client.close()
    by_hand = TruthLog(World(robot, SEED))
    still = [0.0] * len(serials)
    for _ in range(first_tick - 1):
        by_hand.exchange(still)
    # The first answer was to the welcome, long due when it came; each of the others is to the tick before.
    expected = [list(by_hand.exchange(row))[::-1] for row in [still, *pwm[1:].tolist()]]
    assert samples == expected
    rows = len(by_hand.motion().t_ns)
    for one, other in zip(log.motion()[1:], by_hand.motion()[1:], strict=True):
        assert np.array_equal(one[:rows], other[:rows])


def test_an_agent_that_stops_answering_has_zero_pwm_and_comes_back(tmp_path: Path) -> None:
    robot, path, lines = load_robot(ROBOT), str(tmp_path / "bus"), []  # type: ignore[var-annotated]
    log = TruthLog(World(robot, SEED))
    with served(path, log, None, lines):
        client = BusClient(path, robot.serials)
        for _ in range(5):
            client.exchange([0.2] * len(robot.serials))
        deadline_s = time.monotonic() + 20.0
        while not any("zero PWM until it does" in line for line in lines):
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        silent = int(client.kernel_state[-1][0])
        for _ in range(2):
            client.exchange([0.2] * len(robot.serials))
        # What was sent before it froze is read first; the next sample is of the time when it came back.
        assert int(client.kernel_state[-1][0]) > silent + 1
        assert sum("is in step" in line for line in lines) == 2
        client.close()


def test_the_pace_of_a_world_that_runs_ahead_is_the_asked_speed(tmp_path: Path) -> None:
    log = TruthLog(World(load_robot(ROBOT), SEED))
    server = BusServer(str(tmp_path / "bus"), log)
    end_s = time.monotonic() + 0.5
    report = server.run(0.5, lambda: time.monotonic() > end_s)
    # No tick is early; on a busy machine some are late, and what is not caught up is said.
    assert report.ticks <= 0.5 * 1e3 * report.elapsed_s + 1
    assert report.simulated_s == pytest.approx(
        0.5 * (report.elapsed_s - report.slipped_s), abs=0.5 * (0.020 + 0.002 * 9)
    )
