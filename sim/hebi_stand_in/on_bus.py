"""Stands in for `hebi` in an agent process: `x5-agent --hebi --library sim.hebi_stand_in.on_bus`.

Its modules are those of a world on a physics bus in real time. `BUS` in the environment is the bus's path,
and `SERIALS` are the modules that this process sees, with commas between them.
"""

import os
import threading
from collections.abc import Sequence

from module_agent.hardware.bus_client import BusClient
from module_agent.hardware.hardware import HardwareLost, Readings
from module_agent.model.errors import UsageError
from sim.hebi_stand_in.library import Lookup as _Lookup
from sim.hebi_stand_in.library import StandIn
from sim.hebi_stand_in.messages import Color, GroupCommand, GroupFeedback
from sim.hebi_stand_in.modules import FAMILY, ModuleNetwork

__all__ = ["BUS", "FAMILY", "SERIALS", "Color", "GroupCommand", "GroupFeedback", "Lookup"]

BUS, SERIALS = "X5_STAND_IN_BUS", "X5_STAND_IN_SERIALS"
_TICK_TIMEOUT_S = 0.02


class _TickingModules:
    """Modules that tick by themselves, in a thread, as long as there is a world."""

    def __init__(self, path: str, serials: Sequence[str]):
        self._bus = BusClient(path, serials)
        self.network = ModuleNetwork(self._bus.modules)
        self._ticked = threading.Condition()
        self._ticks = 0
        threading.Thread(target=self._run, name="modules", daemon=True).start()

    def _run(self) -> None:
        pwm = [0.0] * len(self.network.all)
        try:
            while True:
                readings: Readings = self._bus.exchange(pwm)
                with self._ticked:
                    pwm = self.network.tick(readings)
                    self._ticks += 1
                    self._ticked.notify_all()
        except HardwareLost:
            # The agent finds that its modules are silent.
            return

    def await_tick(self) -> bool:
        """Wait for the next tick; return whether it has come in time."""
        with self._ticked:
            before = self._ticks
            return self._ticked.wait_for(lambda: self._ticks > before, _TICK_TIMEOUT_S)


def Lookup() -> _Lookup:
    """Begin to look for modules.

    Raises:
        UsageError: the environment does not say where they are.
    """
    missing = [name for name in (BUS, SERIALS) if name not in os.environ]
    if missing:
        raise UsageError(
            f"the environment has no {' and no '.join(missing)}: this library stands in for modules"
        )
    modules = _TickingModules(os.environ[BUS], os.environ[SERIALS].split(","))
    return StandIn(modules.network, modules.await_tick).Lookup()
