"""What the docstrings of `Modules` promise, for every implementation of it.

An implementation joins by a fixture that gives its modules at rest, in their factory state. The driver of
real modules speaks to what stands in for hebi-py; there a command reaches the loops one tick later, and PWM
comes back as a 32-bit number.
"""

import math
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from module_agent.control.controller import BRAKE, MOTOR_OFF, Command
from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.hardware.bus_client import BusClient
from module_agent.hardware.hardware import HardwareLost, LimitState, Modules
from module_agent.hardware.hebi_modules import HebiModules
from module_agent.hardware.hebi_network import describe
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.catalogue import module_type
from sim.hebi_stand_in.library import Group, StandIn
from sim.hebi_stand_in.modules import ModuleNetwork
from sim.robot.robot_file import load_robot
from sim.world.bus_server import BusServer
from sim.world.world import World

LIMIT_S = 20.0
# Two modules whose gears hold them still without current: when an agent attaches matters to no test.
ROBOT = "thesis_171_vertical"
NAN = math.nan
LAST = 1
F4 = 1e-6


def driver(world: World) -> HebiModules:
    """Return the driver of real modules at 1 kHz, over simulated ones that tick when it waits."""
    network = ModuleNetwork(world.modules)
    pwm = [0.0] * len(world.modules)

    def tick() -> None:
        pwm[:] = network.tick(world.exchange(pwm))

    # A module that has never ticked has no feedback.
    tick()
    library = StandIn(network)
    group = Group(network.all, lambda: True)
    return HebiModules(library, group, describe(library, group, 1000.0), tick)


@pytest.fixture(params=["bus", "in process", "driver"])
def modules(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Modules]:
    world = World(load_robot(ROBOT), seed=1, noise="ideal")
    if request.param == "driver":
        yield driver(world)
        world.close()
        return
    if request.param == "in process":
        yield LoopInside(world)
        world.close()
        return
    path = str(tmp_path / "bus")
    server = BusServer(path, world, bound_s=LIMIT_S)
    ended = threading.Event()
    thread = threading.Thread(target=server.run, args=(None, ended.is_set))
    thread.start()
    wires = BusClient(path, load_robot(ROBOT).serials, LIMIT_S)
    # The PWM that answers the welcome belongs to no tick and is discarded; the contract begins after it.
    wires.exchange([0.0] * len(wires.modules))
    yield LoopInside(wires)
    wires.close()
    ended.set()
    thread.join(LIMIT_S)
    assert not thread.is_alive()
    world.close()


def drive(modules: Modules, last: Command, ticks: int = 1) -> float:
    """Command the last module for some ticks, all others off; return its PWM as the next sample shows it."""
    commands = [MOTOR_OFF] * (len(modules.information) - 1) + [last]
    for _ in range(ticks + late(modules)):
        modules.receive()
        modules.send(commands)
    return modules.receive()[LAST].pwm


def late(modules: Modules) -> int:
    """Return how many ticks later than its samples say a command reaches the loops."""
    return int(isinstance(modules, HebiModules))


def position(modules: Modules) -> float:
    return modules.receive()[LAST].sensors.position_rad


def use(modules: Modules, strategy: int) -> None:
    """Give the last module factory gains, whose loops then have no past."""
    kind = module_type(modules.information[LAST].module_type)
    modules.set_gains(LAST, default_gains(kind, strategy))


# ------------------------------------------------------------------ information


def test_the_modules_are_those_of_the_robot_and_describe_themselves(modules: Modules) -> None:
    assert tuple(m.serial for m in modules.information) == load_robot(ROBOT).serials
    for module in modules.information:
        kind = module_type(module.module_type)
        assert module.name
        assert module.family
        assert module.gains.strategy in range(5)
        assert module.limits == catalogue_limits(kind)
        assert module.tick_ns > 0
        assert module.imu_period_ns >= module.tick_ns


# ------------------------------------------------------------------ samples


def test_every_receive_is_the_next_tick_of_every_module(modules: Modules) -> None:
    ticks = []
    for _ in range(50):
        ticks.append(modules.receive())
        modules.send([MOTOR_OFF] * len(modules.information))
    for index, module in enumerate(modules.information):
        t_ns = np.array([samples[index].sensors.t_ns for samples in ticks])
        # A module's clock drifts by some 1e-5, never by a tenth of a tick.
        assert np.all(np.abs(np.diff(t_ns) - module.tick_ns) < 0.1 * module.tick_ns)
        imu_t_ns = np.array([samples[index].sensors.imu_t_ns for samples in ticks])
        assert np.all(np.diff(imu_t_ns) >= 0)
        assert np.all(imu_t_ns <= t_ns)
        assert np.all(np.diff([samples[index].sequence for samples in ticks]) == 1)


def test_samples_are_finite_and_in_the_order_of_their_fields(modules: Modules) -> None:
    samples = modules.receive()
    assert len(samples) == len(modules.information)
    for sensors, *drive_state in samples:
        assert isinstance(sensors.t_ns, int)
        assert isinstance(sensors.imu_t_ns, int)
        assert all(math.isfinite(value) for value in sensors)
        assert drive_state == [0.0, drive_state[1], LimitState.NONE, False, ""]


def test_an_imu_at_rest_reads_specific_force(modules: Modules) -> None:
    for sensors, *_ in modules.receive():
        force = math.hypot(sensors.accel_x_m_s2, sensors.accel_y_m_s2, sensors.accel_z_m_s2)
        assert force == pytest.approx(9.81, abs=0.01)


# ------------------------------------------------------------------ commands


def test_a_command_reaches_its_module_and_the_next_sample_shows_its_pwm(modules: Modules) -> None:
    """Only the last module is driven, so only its winding carries current."""
    use(modules, 1)
    assert drive(modules, Command(NAN, NAN, 0.4), 5) == pytest.approx(0.4, abs=F4)
    samples = modules.receive()
    currents_a = np.array([sample.sensors.motor_current_a for sample in samples])
    assert currents_a[LAST] > 1.0
    assert np.all(np.abs(currents_a[:LAST]) < 0.1)
    assert [sample.pwm for sample in samples] == pytest.approx([0.0, 0.4], abs=F4)


@pytest.mark.parametrize("strategy", [2, 3, 4])
def test_a_target_of_nan_switches_its_loop_off(modules: Modules, strategy: int) -> None:
    use(modules, strategy)
    here = position(modules)
    modules.send([MOTOR_OFF] * 2)
    use(modules, strategy)
    position_only = drive(modules, Command(here + 0.05, NAN, NAN))
    # At rest again, so that the speed that is left does not decide.
    drive(modules, BRAKE, 200)
    use(modules, strategy)
    velocity_only = drive(modules, Command(NAN, 0.1, NAN))
    drive(modules, BRAKE, 200)
    use(modules, strategy)
    effort_only = drive(modules, Command(NAN, NAN, 0.2))
    assert min(position_only, velocity_only, effort_only) > 0.0
    assert len({position_only, velocity_only, effort_only}) == 3


def test_three_targets_of_nan_are_motor_off(modules: Modules) -> None:
    assert drive(modules, Command(5.0, NAN, NAN), 20) > 0.1
    assert drive(modules, Command(NAN, NAN, NAN)) == 0.0
    assert modules.receive()[LAST].pwm == 0.0


def test_the_brake_drives_against_the_motion(modules: Modules) -> None:
    use(modules, 3)
    drive(modules, Command(NAN, 1.0, NAN), 300)
    assert modules.receive()[LAST].sensors.motor_velocity_rad_s > 1.0
    assert drive(modules, BRAKE, 3) < 0.0
    assert drive(modules, BRAKE, 2000) == pytest.approx(0.0, abs=1e-3)


def test_there_is_one_command_per_module_after_a_first_sample(modules: Modules) -> None:
    with pytest.raises(ValueError, match="receive a sample first"):
        modules.send([MOTOR_OFF] * len(modules.information))
    modules.receive()
    with pytest.raises(ValueError, match="commands for"):
        modules.send([MOTOR_OFF] * (len(modules.information) + 1))


# ------------------------------------------------------------------ lifetime, gains, identification, end


def test_a_command_is_followed_for_its_lifetime_and_then_the_motor_is_off(modules: Modules) -> None:
    modules.set_lifetime(LAST, 20_000_000)
    drive(modules, Command(5.0, NAN, NAN), 50)
    pwm = [modules.receive()[LAST].pwm for _ in range(40)]
    assert min(pwm[:20]) > 0.1
    assert max(pwm[22 + 2 * late(modules) :]) == 0.0
    assert drive(modules, Command(5.0, NAN, NAN)) > 0.1


@pytest.mark.parametrize("lifetime_ns", [0, -1])
def test_a_lifetime_is_positive(modules: Modules, lifetime_ns: int) -> None:
    with pytest.raises(ValueError, match="must be over 0"):
        modules.set_lifetime(0, lifetime_ns)


def test_gains_act_on_one_module_and_are_part_of_its_information(modules: Modules) -> None:
    factory = modules.information[0].gains
    kind = module_type(modules.information[LAST].module_type)
    modules.set_gains(LAST, default_gains(kind, 1))
    assert [m.gains for m in modules.information] == [factory, default_gains(kind, 1)]
    assert drive(modules, Command(NAN, NAN, 0.25)) == pytest.approx(0.25, abs=F4)
    modules.set_gains(LAST, default_gains(kind, 0))
    assert drive(modules, Command(1.0, 1.0, 0.25)) == 0.0


def test_identification_does_not_disturb_a_command(modules: Modules) -> None:
    use(modules, 1)
    modules.identify(LAST, True)
    assert drive(modules, Command(NAN, NAN, 0.1)) == pytest.approx(0.1, abs=F4)
    modules.identify(LAST, False)
    assert drive(modules, Command(NAN, NAN, 0.1)) == pytest.approx(0.1, abs=F4)


def test_after_close_there_is_no_further_tick(modules: Modules) -> None:
    drive(modules, MOTOR_OFF)
    modules.close()
    modules.close()
    with pytest.raises(HardwareLost):
        modules.receive()
