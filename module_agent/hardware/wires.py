"""The contract to the wires inside simulated modules, which `loop_inside` drives."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from module_agent.hardware.hardware import SensorSample


class WiredModule(NamedTuple):
    """The description of one simulated module before its first tick. Periods in the module's own clock."""

    serial: str
    module_type: str
    tick_ns: int
    imu_period_ns: int


class Wires(Protocol):
    """The wires inside simulated modules: PWM to the motors, readings of the sensors.

    The client of the physics bus implements it, and the world of the simulator for its own process.
    """

    @property
    def modules(self) -> Sequence[WiredModule]:
        """The modules served, in the order of `exchange`."""

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        """Hand over one PWM per module, wait for the next tick, return one sample per module.

        A PWM is in [-1, 1] and normalised to 48 V, as the gains are: the motor sees the duty
        `clip(pwm * 48 / voltage_v, -1, 1)` of the bus voltage.

        Raises:
            HardwareLost: no further tick will come.
            ValueError: not one PWM per module.
        """

    def close(self) -> None:
        """Release the modules; their motors then get zero PWM. May be called twice."""
