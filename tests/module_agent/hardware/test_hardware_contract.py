"""What the docstrings of `Hardware` promise, over the physics bus and over a world in the same process."""

import math
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from module_agent.hardware.bus_client import BusClient
from module_agent.hardware.hardware import Hardware, HardwareLost
from module_agent.model.catalogue import CATALOGUE
from sim.robot.robot_file import load_robot
from sim.world.bus_server import BusServer
from sim.world.world import InProcessHardware, World

LIMIT_S = 20.0
# Two modules whose gears hold them still without current: when an agent attaches matters to no test.
ROBOT = "thesis_171_vertical"


@pytest.fixture(params=["bus", "in process"])
def hardware(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Hardware]:
    world = World(load_robot(ROBOT), seed=1, noise="ideal")
    if request.param == "in process":
        yield InProcessHardware(world)
        world.close()
        return
    path = str(tmp_path / "bus")
    server = BusServer(path, world, bound_s=LIMIT_S)
    ended = threading.Event()
    thread = threading.Thread(target=server.run, args=(None, ended.is_set))
    thread.start()
    client = BusClient(path, load_robot(ROBOT).serials, LIMIT_S)
    # The PWM that answers the welcome belongs to no tick and is discarded; the contract begins after it.
    client.exchange([0.0] * len(client.modules))
    yield client
    client.close()
    ended.set()
    thread.join(LIMIT_S)
    assert not thread.is_alive()
    world.close()


def test_the_modules_are_those_of_the_robot_and_say_what_they_are(hardware: Hardware) -> None:
    assert tuple(m.serial for m in hardware.modules) == load_robot(ROBOT).serials
    for module in hardware.modules:
        assert module.module_type in CATALOGUE
        assert module.tick_ns > 0
        assert module.imu_period_ns >= module.tick_ns


def test_every_exchange_is_the_next_tick_of_every_module(hardware: Hardware) -> None:
    ticks = [hardware.exchange([0.0] * len(hardware.modules)) for _ in range(50)]
    for slot, module in enumerate(hardware.modules):
        t_ns = np.array([samples[slot].t_ns for samples in ticks])
        # A module's clock drifts by some 1e-5, never by a tenth of a tick.
        assert np.all(np.abs(np.diff(t_ns) - module.tick_ns) < 0.1 * module.tick_ns)
        imu_t_ns = np.array([samples[slot].imu_t_ns for samples in ticks])
        assert np.all(np.diff(imu_t_ns) >= 0)
        assert np.all(imu_t_ns <= t_ns)


def test_samples_are_finite_and_in_the_field_s_order(hardware: Hardware) -> None:
    samples = hardware.exchange([0.0] * len(hardware.modules))
    assert len(samples) == len(hardware.modules)
    for sample in samples:
        assert isinstance(sample.t_ns, int)
        assert isinstance(sample.imu_t_ns, int)
        assert all(math.isfinite(value) for value in sample)


def test_an_imu_at_rest_reads_specific_force(hardware: Hardware) -> None:
    for sample in hardware.exchange([0.0] * len(hardware.modules)):
        force = math.hypot(sample.accel_x_m_s2, sample.accel_y_m_s2, sample.accel_z_m_s2)
        assert force == pytest.approx(9.81, abs=0.01)


def test_the_pwm_reaches_the_module_in_its_place(hardware: Hardware) -> None:
    """Only the last module is driven, so only its winding carries current."""
    pwm = [0.0] * len(hardware.modules)
    pwm[-1] = 1.0
    currents_a = np.zeros(len(pwm))
    for _ in range(5):
        currents_a = np.array([sample.motor_current_a for sample in hardware.exchange(pwm)])
    assert currents_a[-1] > 1.0
    assert np.all(np.abs(currents_a[:-1]) < 0.1)


def test_after_close_there_is_no_further_tick(hardware: Hardware) -> None:
    hardware.exchange([0.0] * len(hardware.modules))
    hardware.close()
    hardware.close()
    with pytest.raises(HardwareLost):
        hardware.exchange([0.0] * len(hardware.modules))


def test_one_pwm_per_module_or_none_at_all(hardware: Hardware) -> None:
    with pytest.raises(ValueError, match="PWM values for"):
        hardware.exchange([0.0] * (len(hardware.modules) + 1))
