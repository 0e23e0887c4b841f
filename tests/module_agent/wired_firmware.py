"""A firmware and the loops inside its module, whose readings the test gives."""

from collections.abc import Sequence

from module_agent.firmware.config import FirmwareConfig
from module_agent.firmware.firmware import Firmware, Incoming, Outgoing
from module_agent.hardware.hardware import SensorSample, WiredModule
from module_agent.hardware.loop_inside import LoopInside

MS = 1_000_000


class ScriptedWires:
    """Wires to one module that reads `sample`."""

    def __init__(self, module_type: str, serial: str = "A"):
        self.modules = (WiredModule(serial, module_type, MS, 4 * MS),)
        self.sample: SensorSample | None = None
        self.pwm: list[float] = []

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        assert self.sample is not None
        self.pwm += pwm
        return [self.sample]

    def close(self) -> None:
        self.pwm.append(0.0)


class WiredFirmware:
    """One firmware on scripted wires."""

    def __init__(self, config: FirmwareConfig):
        self._wires = ScriptedWires(config.kind.name, config.serial)
        self.modules = LoopInside(self._wires, {config.serial: config.safety})
        self.firmware = Firmware(config, self.modules)

    def tick(
        self, sample: SensorSample, inbox: Sequence[Incoming] = (), m_stop: bool = False
    ) -> tuple[float, list[Outgoing]]:
        """Run one tick; return the PWM and what is to be sent."""
        self._wires.sample = sample
        (received,) = self.modules.receive()
        command = self.firmware.step(received._replace(m_stop=m_stop), inbox)
        (pwm,) = self.modules.send([command])
        return pwm, self.firmware.publish(pwm)
