"""How fast things are: figures to read (`pytest -m benchmark -s`), no assertion on any of them."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from coordinator.batch_estimation.imu_prediction import imu_readings
from coordinator.excitation.plan import Plan
from coordinator.runtime.terminal import Terminal
from module_agent.control.gains import catalogue_limits
from module_agent.firmware.config import FirmwareConfig
from module_agent.hardware.hardware import SensorSample
from module_agent.model.catalogue import CATALOGUE
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.feedback_rows import ROW, unpack
from module_agent.wire.messages import Feedback, LeaseRequest
from sim.benchmark.cases.regressor import CHUNK, JOINTS, regressor_trial
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.virtual_time.run import VirtualConfig, run_virtual
from sim.world.world import World
from tests.benchmarks.bars import least_cpu_s, report
from tests.module_agent.wired_firmware import WiredFirmware

pytestmark = pytest.mark.benchmark


def _report(what: str, work: Callable[[], object], calls: int, of: int = 1) -> None:
    """Report the processor time of a call, or of each of its `of` parts."""
    report(what, 1e6 * least_cpu_s(work, 3, calls) / of, "us")


@pytest.mark.parametrize(("name", "noise"), [("a2085_04", "x5-uncalibrated"), ("arm7", "poor")])
@pytest.mark.parametrize("dynamics", [False, True])
def test_virtual_time_over_real_time(tmp_path: Path, name: str, noise: str, dynamics: bool) -> None:
    """`arm7` with `poor` is seven modules with all effects on."""
    config = VirtualConfig(
        load_robot(name), tmp_path / "run", network="lan", noise=noise, plan=Plan(dynamics=dynamics)
    )
    start = time.perf_counter()
    result = run_virtual(config, Terminal(quiet=True))
    wall_s = time.perf_counter() - start
    assert result.robot_time_s > 0.0
    what = f"{name}, {noise}, whole run{' with dynamics' if dynamics else ''}"
    anchor = f"{result.robot_time_s:.1f} s in {wall_s:.1f} s"
    report(what, result.robot_time_s / wall_s, "times real time", anchor=anchor)


def test_firmware_step() -> None:
    kind = CATALOGUE["X5-9"]
    wired = WiredFirmware(FirmwareConfig("A", kind, 1, catalogue_limits(kind)))
    now = 0

    def tick() -> None:
        nonlocal now
        now += 1_000_000
        sample = SensorSample(now, now // 4_000_000 * 4_000_000, *([0.0] * 6), 40.0, 24.0, *([0.0] * 6))  # type: ignore[call-arg]
        wired.tick(sample)

    _report("firmware tick with its loops, one module, idle, 250 rows/s", tick, 5000)


@pytest.mark.parametrize("name", ["thesis_171_horizontal", "a2085_04", "snake16"])
def test_world_tick(name: str) -> None:
    world = World(load_robot(name), seed=0)
    pwm = [0.01] * len(world.modules)
    _report(f"world tick, {name}, {len(pwm)} modules", lambda: world.step(pwm), 500)
    world.close()


def test_codec() -> None:
    rows = np.zeros(5, dtype=ROW)
    feedback = Feedback(serial="A", boot=1, seq=1, first_row=0, count=5, rows=rows.tobytes())
    request = LeaseRequest(serial="A", boot=1, seq=1, sender="C", token=1, echo_ns=1, action="renew")
    for name, message in (("feedback of 5 rows", feedback), ("lease request", request)):
        payload = encode(message)
        what = f"codec, {name}, {len(payload)} bytes"
        _report(f"{what}, encoded", partial(encode, message), 5000)
        _report(f"{what}, decoded", partial(decode, type(message), payload, MAX_MESSAGE_BYTES), 5000)
    _report("codec, rows unpacked and checked", partial(unpack, feedback), 5000)


def test_regressor_against_pinocchios_loop() -> None:
    found = regressor_trial(1, 9)
    assert found.loop_us is not None
    loop = f"pinocchio's loop {found.loop_us:.2f} us"
    what = f"torque regressor, {JOINTS} joints,"
    report(
        f"{what} batch, faster than pinocchio",
        found.loop_us / found.batch_us,
        "times",
        at_least=8.0,
        anchor=loop,
    )
    report(f"{what} batch, a sample", found.batch_us, "us", anchor=loop)
    report(f"{what} batch into new memory, a sample", found.array_us, "us", anchor=loop)
    report(f"{what} in chunks of {CHUNK}, a sample", found.chunks_us, "us", anchor=loop)
    report(f"{what} streaming, a sample", found.stream_us, "us", at_most=5.0, anchor=loop)
    report(f"inverse dynamics, {JOINTS} joints, a sample", found.torque_us, "us", anchor=loop)
    assert found.difference is not None
    report(f"{what} difference from pinocchio", found.difference, "relative", at_most=1e-12)


def test_imu_prediction() -> None:
    chain = true_chain(load_robot("a2085_04"))
    q, qd, qdd = np.random.default_rng(1).uniform(-1, 1, (3, 4000, 4))
    _report("IMU prediction, 4 modules, a sample", partial(imu_readings, chain, q, qd, qdd), 5, of=4000)
