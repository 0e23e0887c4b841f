"""A robot that can be broken at will: its agents, its motors, its supply, and what its sensors read."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from module_agent.firmware.config import config_of
from module_agent.hardware.hardware import Readings
from module_agent.hardware.loop_inside import LoopInside
from module_agent.host import AgentHost, InlineWorker
from sim.actuator.actuator import BUS_VOLTAGE_V
from sim.faults.fault import Fault
from sim.faults.sick_sensors import SickSensors
from sim.virtual_time.loop import NS_PER_S, VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from sim.virtual_time.robot import VirtualRobot, VirtualSettings, Wire
from sim.world.truth import TruthLog
from sim.world.world import TICK_NS, World

# Friction of a motor that something holds, and the winding of one that is too hot, above the ambient [K].
STALLED, HOT_K, HOTTEST_K = 1e3, 100.0, 60.0
# How far a supply sags at the most.
SAG = 0.7
# A boot id that no other agent of a session has.
TWIN_BOOT = 2**40


class _SickTruth(TruthLog):
    """Steps the world; what it returns is what the modules read."""

    def __init__(self, world: World, faults: Sequence[Fault]):
        super().__init__(world)
        self._sensors = SickSensors(faults, len(world.modules))

    @property
    def readings(self) -> Readings:
        """What the modules have read in the last tick, sick sensors included."""
        return self.world.readings if self.alteration is None else self._sensors.own

    @property
    def alteration(self) -> Any:
        """What the present faults make of the sensors' readings."""
        return self._sensors.alteration

    @property
    def ticks_ahead(self) -> int:
        """How many ticks there are before a fault begins or ends; 0 in the tick in which one does."""
        most = super().ticks_ahead
        spare_ns = min(max(self._sensors.spare_ns(self.world.t_ns), 0.0), most * TICK_NS)
        return math.ceil(spare_ns / TICK_NS)

    def exchange(self, pwm: Sequence[float]) -> Readings:
        """Step the world and return what the modules read of it."""
        readings = super().exchange(pwm)
        return self._sensors.read(self.world.t_ns - TICK_NS, readings)


class FaultyRobot(VirtualRobot):
    """A robot with the faults of a schedule that concern agents, sensors and motors.

    Those of sensors and clocks begin by themselves, those of agents and motors by `begin`.
    """

    def __init__(
        self, settings: VirtualSettings, loop: VirtualLoop, network: VirtualNetwork, faults: Sequence[Fault]
    ):
        self._faults = faults
        super().__init__(settings, loop, network)
        self._away: dict[str, AgentHost] = {}
        self._sags: list[Fault] = []
        for fault in faults:
            if fault.kind == "hot plug":
                self._crash(fault)

    def _truth_of(self, world: World) -> TruthLog:
        return _SickTruth(world, self._faults)

    def _draws(self, settings: VirtualSettings) -> tuple[np.random.SeedSequence, Iterator[int]]:
        """Boot ids in order: agents can be started any number of times."""
        return np.random.SeedSequence(settings.seed), itertools.count(101)

    @property
    def announced(self) -> frozenset[str]:
        """The modules that say on the network that they are there; a frozen agent does."""
        return frozenset(self.hosts) | frozenset(self._away)

    def begin(self, fault: Fault) -> None:
        """Let a fault of agents or motors begin, and see to its end."""
        BEGINNINGS[fault.kind](self, fault)

    def _later(self, fault: Fault, call: Callable[[], None]) -> None:
        if np.isfinite(fault.for_s):
            self.loop.schedule_ns(self.loop.now_ns + round(fault.for_s * NS_PER_S), call)

    def _take(self, fault: Fault) -> AgentHost | None:
        """Return the agent of the fault's module and run it no more; None if it does not run."""
        serial = self.serials[fault.module]
        host = self.hosts.get(serial)
        if host is not None:
            self.freeze(serial)
        return host

    def _crash(self, fault: Fault) -> None:
        if self._take(fault) is not None:
            self.network.kill(self.serials[fault.module])

    def _freeze(self, fault: Fault) -> None:
        host, serial = self._take(fault), self.serials[fault.module]
        if host is not None:
            self._away[serial] = host
            self._later(fault, partial(self._thaw, serial))

    def _thaw(self, serial: str) -> None:
        self.hosts[serial] = self._away.pop(serial)

    def _reboot(self, fault: Fault) -> None:
        if self.serials[fault.module] in self.hosts:
            self._crash(fault)
            self._later(fault, partial(self._plug, fault))

    def _plug(self, fault: Fault) -> None:
        serial = self.serials[fault.module]
        if serial not in self.hosts and serial not in self._away:
            self.boot(serial)

    def _unplug(self, fault: Fault) -> None:
        host = self._take(fault)
        if host is not None:
            host.close()

    def _clone(self, fault: Fault) -> None:
        """Start a second agent of a module; its motor is none."""
        serial, place = self.serials[fault.module], fault.module
        modules = LoopInside(Wire(self, place))
        config = config_of(modules.information[0], TWIN_BOOT + place)
        name = f"{serial}, twin {self.loop.now_ns}"
        twin = AgentHost(self.robot.name, modules, self.endpoint(name), [config], InlineWorker())
        self.on_tick.append(twin.cycle)

        def end() -> None:
            self.on_tick.remove(twin.cycle)
            twin.close()

        self._later(fault, end)

    def _stall(self, fault: Fault) -> None:
        serial, world = self.serials[fault.module], self.world
        world.change_friction(serial, STALLED)
        self._later(fault, partial(world.change_friction, serial, 1.0 / STALLED))

    def _heat(self, fault: Fault) -> None:
        above_k = np.zeros((3, len(self.serials)))
        above_k[:, fault.module] = HOT_K + HOTTEST_K * fault.size
        self.world.warm(above_k)

    def _sag(self, fault: Fault) -> None:
        self._sags.append(fault)
        self._supply()

        def recover() -> None:
            self._sags.remove(fault)
            self._supply()

        self._later(fault, recover)

    def _supply(self) -> None:
        """Let the supply be what the deepest of the present sags leaves of it."""
        deepest = max((0.1 + 0.9 * fault.size for fault in self._sags), default=0.0)
        self.world.supply(BUS_VOLTAGE_V * (1.0 - SAG * deepest))


BEGINNINGS: dict[str, Callable[[FaultyRobot, Fault], None]] = {
    "agent crash": FaultyRobot._crash,
    "agent freeze": FaultyRobot._freeze,
    "agent thaw": FaultyRobot._freeze,
    "agent reboot": FaultyRobot._reboot,
    "twin": FaultyRobot._clone,
    "hot plug": FaultyRobot._plug,
    "hot unplug": FaultyRobot._unplug,
    "motor stall": FaultyRobot._stall,
    "overheating": FaultyRobot._heat,
    "voltage sag": FaultyRobot._sag,
}
