"""What the local estimates of a joint cost a module: figures to read, no assertion on any of them."""

import time
import tracemalloc
from collections.abc import Callable

import pytest

from coordinator.excitation.plan import Plan
from module_agent.model.imu_prior import UNCALIBRATED
from sim.robot.robot_file import load_robot
from sim.test_bench.one_joint_rig import OneJointRig, TrialRows, analyse, regress

pytestmark = pytest.mark.benchmark


def _best_s(work: Callable[[], object], count: int) -> float:
    best = float("inf")
    for _ in range(count):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def _peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    work()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def _trial(noise: str) -> TrialRows:
    with OneJointRig(load_robot("thesis_350_vertical"), 0, noise) as rig:
        return rig.trial(Plan(sine_amplitude_rad=0.08))


@pytest.mark.parametrize(("noise", "base"), [("ideal", "solid"), ("x5", "rocking")])
def test_estimates_of_one_joint(noise: str, base: str) -> None:
    trial = _trial(noise)
    regression = regress(trial, UNCALIBRATED)
    assert regression.base_shakes == (base == "rocking")
    estimators: tuple[tuple[str, Callable[[], object]], ...] = (
        ("thesis' circle", lambda: analyse(trial)),
        ("joint regression", lambda: regress(trial, UNCALIBRATED)),
    )
    for name, work in estimators:
        figures = f"{1e3 * _best_s(work, 7):.1f} ms, {_peak_bytes(work) / 1024:.0f} KiB at its peak"
        print(f"\n{f'{name}, {base} base, with the clock between both modules':.<70} {figures}")
