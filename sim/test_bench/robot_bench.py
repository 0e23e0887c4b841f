"""A robot on the bench: its world, and every module's firmware under command, without agents.

Motions run on the modules, or a host streams set-points to them through an emulated network. The leases are
kept without a network: the set-points are what is tested.
"""

import heapq
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Generic, NamedTuple, Self, TypeVar

import numpy as np

from coordinator.torque_control.feed_forward import SetPoints
from module_agent.firmware.config import config_of
from module_agent.firmware.firmware import Firmware, Incoming
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.read_only import read_only
from module_agent.network_emulation.channel import Channel
from module_agent.network_emulation.profile import NetworkProfile, PathProfile
from module_agent.wire.messages import EffortProfile, GainSet, MotionRecord, Pattern
from sim.geometry.pose import Array
from sim.imperfections.noise_profile import NoiseProfile
from sim.robot.robot_file import Robot
from sim.test_bench.module_bench import ModuleBench
from sim.world.world import TICK_NS, World

T = TypeVar("T")


class MessagePath(Generic[T]):
    """One direction of a network, asked tick by tick: messages are late, doubled or lost (`PathProfile`)."""

    def __init__(self, path: PathProfile, rng: np.random.Generator):
        self._channel = Channel(path, rng)
        self._under_way: list[tuple[int, int, T]] = []
        self._count = 0
        self._newest_ns = 0

    def send(self, t_ns: int, message: T) -> None:
        """Send a message; times must not decrease."""
        fate = self._channel.fate(t_ns * 1e-9)
        if fate.lost:
            return
        at_ns = t_ns + round(fate.delay_s * 1e9)
        if not fate.reordered:
            # It waits for all that was sent before it, as on one connection.
            at_ns = self._newest_ns = max(self._newest_ns, at_ns)
        self._put(at_ns, message)
        if fate.copy_delay_s is not None:
            self._put(t_ns + round(fate.copy_delay_s * 1e9), message)

    def arrived(self, t_ns: int) -> list[T]:
        """Return the messages that have arrived since the last call, in the order of their arrival."""
        messages = []
        while self._under_way and self._under_way[0][0] <= t_ns:
            messages.append(heapq.heappop(self._under_way)[2])
        return messages

    def _put(self, at_ns: int, message: T) -> None:
        # The count keeps messages that come at the same time in order, and from being compared themselves.
        self._count += 1
        heapq.heappush(self._under_way, (at_ns, self._count, message))


class Track(NamedTuple):
    """The true motion of the joints at every tick, (m, n) each, read-only; duty as applied by the bridges."""

    q_rad: Array
    spring_torque_nm: Array
    duty: Array


class Streaming(NamedTuple):
    """How a host streams set-points: the network, their rate, and which targets they have.

    velocity, effort: whether set-points have these targets; without one its loop is off.
    """

    network: NetworkProfile
    rate_hz: float
    velocity: bool
    effort: bool


class BenchRobot:
    """The world of a robot and the firmware of all its modules, leased from the first tick on.

    Args:
        robot: the robot.
        seed: draws the modules and their noise, as in `World`.
        noise: name of a noise profile, or one; by default that of the robot.
        noise_seed: draws the noise anew for the same modules.

    Raises:
        KeyError: unknown noise profile.
        ValueError: the robot's base or links are too soft to carry it.
    """

    def __init__(
        self, robot: Robot, seed: int, noise: str | NoiseProfile | None = None, noise_seed: int | None = None
    ):
        self.world = World(robot, seed, noise, noise_seed=noise_seed)
        self._hardware = LoopInside(self.world)
        self.modules = tuple(
            ModuleBench(Firmware(config_of(module, index + 1), self._hardware, index))
            for index, module in enumerate(self._hardware.information)
        )
        self.by_serial = {module.serial: module for module in self.modules}
        self._track: list[tuple[Array, Array, Array]] | None = None
        # In their first tick all modules are leased, and hold their positions.
        self.tick()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the world."""
        self.world.close()

    def tick(self, arrived: Mapping[str, Sequence[Incoming]] | None = None) -> None:
        """Advance world and firmware by one tick; the PWM acts in the next, as on the bus."""
        samples = self._hardware.receive()
        mail = arrived or {}
        commands = [
            module.step(sample, mail.get(module.serial, ()))
            for module, sample in zip(self.modules, samples, strict=True)
        ]
        for module, pwm in zip(self.modules, self._hardware.send(commands), strict=True):
            module.publish(pwm)
        if self._track is not None:
            plant = self.world.plant
            self._track.append((plant.q_rad, plant.spring_torque_nm, plant.duty))

    def wait(self, duration_s: float) -> None:
        """Let time pass."""
        for _ in range(round(duration_s * 1e9 / TICK_NS)):
            self.tick()

    def set_gains(self, gains: Mapping[str, GainSet]) -> None:
        """Set gains by serial."""
        for serial, one in gains.items():
            self.by_serial[serial].set_gains(one)
        self.tick()

    def run(
        self, patterns: Mapping[str, Pattern], efforts: Mapping[str, EffortProfile] | None = None
    ) -> list[MotionRecord]:
        """Run one motion on each of some modules, by serial, in the same time; return their records.

        Raises:
            ExperimentFailed: a module refused its motion, or it was interrupted.
        """
        for serial, pattern in patterns.items():
            self.by_serial[serial].start(pattern, (efforts or {}).get(serial))
        running = [self.by_serial[serial] for serial in patterns]
        while True:
            self.tick()
            # Every module is asked in every tick, so that an interrupted motion raises at once.
            records = [record for module in running if (record := module.finished()) is not None]
            if len(records) == len(running):
                return records

    def record(
        self, patterns: Mapping[str, Pattern], efforts: Mapping[str, EffortProfile] | None = None
    ) -> Track:
        """Run motions as `run` does, and return the true motion of the joints meanwhile.

        Raises:
            ExperimentFailed: as `run`.
        """
        self._track = []
        self.run(patterns, efforts)
        return self._taken()

    def stream(self, serials: Sequence[str], points: SetPoints, how: Streaming, seed: int) -> Track:
        """Stream set-points to some modules, in the order of the points' columns; return the true motion.

        Every set-point holds the values of the reference at the time when it is sent.

        Raises:
            ExperimentFailed: a module refused a request.
        """
        host = _Host([self.by_serial[serial] for serial in serials], points, how, seed)
        self._track = []
        for row in range(len(points.reference.t_s)):
            self.tick(host.exchange(self.world.t_ns, row))
            host.listen(self.world.t_ns)
        return self._taken()

    def _taken(self) -> Track:
        q, torque, duty = np.array(self._track).transpose(1, 0, 2)
        self._track = None
        return Track(read_only(q), read_only(torque), read_only(duty))


class _Host:
    """The sender of set-points: each echoes the newest feedback of its module that has reached the sender."""

    def __init__(self, modules: Sequence[ModuleBench], points: SetPoints, how: Streaming, seed: int):
        self._modules, self._points, self._how = modules, points, how
        self._every = max(1, round(1e9 / (how.rate_hz * TICK_NS)))
        down, up = np.random.default_rng((seed, 0x5E7)).spawn(2)
        to_module, to_host = how.network.path("module"), how.network.path("coordinator")
        self._down = [MessagePath[Incoming](to_module, rng) for rng in down.spawn(len(modules))]
        self._up = [MessagePath[int](to_host, rng) for rng in up.spawn(len(modules))]
        self._echo_ns = [module.now_ns for module in modules]

    def exchange(self, t_ns: int, row: int) -> dict[str, list[Incoming]]:
        """Send what is due, and return what arrives at every module in this tick."""
        reference, effort = self._points.reference, self._points.effort_nm
        for column, module in enumerate(self._modules):
            self._echo_ns[column] = max([self._echo_ns[column], *self._up[column].arrived(t_ns)])
            if row % self._every == 0:
                message = module.setpoint(
                    float(reference.q_rad[row, column]),
                    float(reference.qd_rad_s[row, column]) if self._how.velocity else None,
                    float(effort[row, column]) if self._how.effort else None,
                    self._echo_ns[column],
                )
                self._down[column].send(t_ns, message)
        return {
            module.serial: path.arrived(t_ns) for module, path in zip(self._modules, self._down, strict=True)
        }

    def listen(self, t_ns: int) -> None:
        """Send off the time of the modules' feedback that was published in this tick."""
        for module, path in zip(self._modules, self._up, strict=True):
            if module.published_rows:
                path.send(t_ns, module.now_ns)
