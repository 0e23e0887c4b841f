"""The driver of real modules: what an agent process of 16 costs, and how well a robot is known through it.

The first is hebi-py's own messages, firmware, rows, and no network. The second is a ratio of errors, of which
one draw of noise says little: over eight draws it was 0.6 to 1.7 for tips.
"""

import time
from typing import Any

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.firmware.config import config_of
from module_agent.hardware.hardware import ModuleInformation
from module_agent.hardware.hebi_library import library
from module_agent.hardware.hebi_modules import HebiModules
from module_agent.host import AgentHost, InlineWorker
from module_agent.model.catalogue import module_type
from module_agent.model.errors import UsageError
from sim.virtual_time.loop import VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from tests.benchmarks.bars import least_cpu_s, report
from tests.simulation.test_hebi_driver import errors_mm

pytestmark = pytest.mark.benchmark

MODULES, RATE_HZ, TICKS = 16, 250, 250
DRAWS = range(1, 9)


def test_sixteen_modules_in_one_agent_process() -> None:
    try:
        hebi: Any = library()
    except UsageError:
        pytest.skip("hebi-py is not installed")
    kind = module_type("X5-4")
    gains, limits = default_gains(kind, 3), catalogue_limits(kind)
    period_ns = 1_000_000_000 // RATE_HZ
    information = [
        ModuleInformation(f"I-{k}", f"i{k}", "imitated", "X5-4", gains, limits, period_ns, period_ns)
        for k in range(MODULES)
    ]
    # The imitation group has no times: the clock is this process's, as if it were paced.
    began, ticks = time.monotonic_ns(), [0]

    def stamp() -> int:
        ticks[0] += 1
        return began + ticks[0] * period_ns

    group = hebi.util.create_imitation_group(MODULES)
    modules = HebiModules(hebi, group, information, lambda: None, stamp)
    endpoint = VirtualNetwork(VirtualLoop()).endpoint("agent")
    configs = [config_of(one, 1) for one in modules.information]
    host = AgentHost("robot", modules, endpoint, configs, InlineWorker())

    def second() -> None:
        for _ in range(TICKS):
            host.cycle()

    second()
    report(f"{MODULES} real modules at {RATE_HZ} Hz, an agent's CPU a second", least_cpu_s(second), "s")


def test_links_and_tip_through_the_driver_are_as_good_as_without(quick_plan: Plan) -> None:
    direct, driven = (
        np.array([errors_mm(seed, quick_plan, rate) for seed in DRAWS]) for rate in (None, float(RATE_HZ))
    )
    ratios = np.sqrt(np.mean(driven**2, axis=0) / np.mean(direct**2, axis=0))
    for k, what in enumerate(("links", "tip")):
        alone = driven[:, k] / direct[:, k]
        report(
            f"{what} through the driver over direct, rms of {len(DRAWS)} draws",
            ratios[k],
            at_most=1.5,
            anchor=f"single draws {alone.min():.2f} to {alone.max():.2f}",
        )
