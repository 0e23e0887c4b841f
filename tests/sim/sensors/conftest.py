from collections.abc import Callable, Sequence

import numpy as np
import pytest

from module_agent.hardware.hardware import Readings
from module_agent.model.catalogue import module_type
from sim.imperfections.noise_profile import NoiseProfile
from sim.sensors.sensors import Instant, Sensors

GRAVITY_M_S2 = 9.81

Measure = Callable[..., np.ndarray]


class Bench:
    """Sensors on a bench: told what to feel instead of being moved."""

    def __init__(
        self,
        profile: NoiseProfile,
        serials: Sequence[str] = ("a", "b"),
        kind: str = "X5-9",
        seed: int = 1,
        imu_ticks: int = 4,
        tick_ns: int = 1_000_000,
    ):
        types = [module_type(kind)] * len(serials)
        self.sensors = Sensors(seed, serials, types, profile, imu_ticks, tick_ns * 1e-9)
        self.kind = types[0]
        self._shape = (len(serials),)
        self._tick_ns = tick_ns
        self._tick = 0

    def read(self, ticks: int, **truth: object) -> np.ndarray:
        """Return the samples (ticks, n, 16); what is not given is at rest, housing upright.

        A value is for all ticks and modules, or has them as its first two axes, to be broadcast.
        """
        felt = {name: self._spread(ticks, truth.pop(name, 0.0)) for name in _SCALARS}
        gyro = self._spread(ticks, truth.pop("gyro", 0.0), 3)
        force = self._spread(ticks, truth.pop("force", (0.0, 0.0, GRAVITY_M_S2)), 3)
        assert not truth, truth
        rows = []
        for k in range(ticks):
            values = {name: of_tick[k] for name, of_tick in felt.items()}
            instant = Instant(
                t_ns=self._tick * self._tick_ns,
                voltage_v=24.0,
                gyro_rad_s=gyro[k],
                specific_force_m_s2=force[k],
                **values,  # type: ignore[arg-type]
            )
            readings = Readings(*self._shape)
            self.sensors.read(self._tick, instant, readings)
            rows.append(list(readings))
            self._tick += 1
        return np.array(rows)

    def _spread(self, ticks: int, value: object, *axes: int) -> np.ndarray:
        return np.ascontiguousarray(np.broadcast_to(np.asarray(value, float), (ticks, *self._shape, *axes)))


_SCALARS = (
    "q_rad",
    "qd_rad_s",
    "motor_rad_s",
    "elastic_nm",
    "current_a",
    "winding_c",
)


@pytest.fixture
def bench() -> type[Bench]:
    return Bench
