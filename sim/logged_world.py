"""A world that takes down its own truth with every step, to be served on the bus."""

from collections.abc import Sequence

from module_agent.hardware import HardwareModule, SensorSample
from sim.truth import TruthLog
from sim.world import World


class LoggedWorld:
    """Steps a world and records it in a `TruthLog`."""

    def __init__(self, world: World):
        self._world = world
        self.log = TruthLog(world)

    @property
    def modules(self) -> Sequence[HardwareModule]:
        """The modules, in the order of `step`."""
        return self._world.modules

    def step(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        """Advance by one tick and return one sample per module."""
        samples = self._world.step(pwm)
        self.log.record()
        return samples
