"""A simulated robot in everyday use: motions with pauses between them, in virtual time and without a network.

World, firmware and control loops are those of every simulated robot, and quiet ticks run many in a compiled
call. What a network adds is left out, so that hours cost minutes: the modules' feedback is handed over as it
is published, in larger batches than over a network, and requests for the time of a module are drawn, with the
delays of a local network. Leases live for as long as the firmware takes, and are renewed as often as it says
how it is, in ticks that are not quiet for that.
"""

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np

from coordinator.excitation.segment import RobotMotion
from coordinator.recording.recording import Entry, RoundTrip
from module_agent.firmware.config import config_of
from module_agent.firmware.firmware import STATUS_PERIOD_NS, Firmware, Outgoing, Publication
from module_agent.firmware.quiet_ticks import NOT_QUIET, QUIET, QuietTicks
from module_agent.hardware.loop_inside import LoopInside
from module_agent.network_emulation.channel import Channel
from module_agent.network_emulation.profile import PROFILES
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import GoTo, Pattern
from sim.imperfections.noise_profile import NoiseProfile
from sim.robot.robot_file import Robot
from sim.sensors.module_clock import module_time
from sim.test_bench.module_bench import ModuleBench
from sim.virtual_time.quiet_run import QuietRun
from sim.world.truth import TruthLog
from sim.world.world import TICK_NS, World

# As long and as large as firmware and messages take.
LIFETIME_NS, RENEWED_NS, BATCH_ROWS = 1_000_000_000, STATUS_PERIOD_NS // 2, 64
_TICKS_OF_A_RUN = 256
# Shares of the speed at which joints may travel, and the mean and the longest of the pauses.
TRAVEL_SHARE, PAUSE_S, MAX_PAUSE_S, SETTLE_S = (0.4, 1.0), 4.0, 30.0, 0.3


class Recurrent(NamedTuple):
    """What is to be done every `period_ns` of the robot's life; it is given the time [ns]."""

    period_ns: int
    what: Callable[[int], None]


class EverydayRobot:
    """A robot on the bench with its world, whose leases are kept; `feedback` receives what modules publish.

    `day` draws noise, drift and delays anew for the same modules. The world's time is the session's.
    """

    def __init__(
        self,
        robot: Robot,
        seed: int,
        noise: NoiseProfile,
        day: int,
        feedback: Callable[[Entry], object],
    ):
        self.world = World(robot, seed, noise, noise_seed=day)
        self._name, self._feedback = robot.name, feedback
        count = len(robot.serials)
        self._loops, self._quiet = LoopInside(self.world), QuietTicks(count)
        self._run = QuietRun(self.world, TruthLog(self.world, every=None), self._quiet)
        self.modules = tuple(ModuleBench(self._firmware(place), RENEWED_NS) for place in range(count))
        for place, module in enumerate(self.modules):
            self._quiet.attach(place, module.firmware, self._loops, place)
        self._pwm = [0.0] * count
        lan = PROFILES["lan"]
        streams = np.random.default_rng((day, seed, 0xDA7)).spawn(2 * count)
        self._ways = [
            (Channel(lan.path("module"), down), Channel(lan.path("coordinator"), up))
            for down, up in zip(streams[:count], streams[count:], strict=True)
        ]
        self._recurrent: list[tuple[int, Recurrent]] = []
        # In their first tick all modules are leased, and hold their positions.
        self._advance(TICK_NS)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.world.close()

    def _firmware(self, place: int) -> Firmware:
        config = config_of(
            self._loops.information[place],
            boot=1 + place,
            lifetime_ns=LIFETIME_NS,
            batch_rows=BATCH_ROWS,
        )
        return Firmware(config, self._loops, place)

    def repeat(self, what: Recurrent) -> None:
        """Do something again and again, from now on."""
        self._recurrent.append((self.world.t_ns, what))

    def wait(self, duration_s: float) -> None:
        """Let time pass."""
        until_ns = self.world.t_ns + round(duration_s * 1e9)
        while self.world.t_ns < until_ns:
            self._advance(until_ns)

    def move(self, patterns: dict[str, Pattern]) -> None:
        """Run a motion on modules by serial, all begun at once, to the end of the last.

        Raises:
            ExperimentFailed: a module refused its motion, or it was interrupted.
        """
        running = [module for module in self.modules if module.serial in patterns]
        for module in running:
            module.start(patterns[module.serial])
        # Every module is asked, so that an interrupted motion raises at once.
        while None in [module.finished() for module in running]:
            self._advance(self.world.t_ns + _TICKS_OF_A_RUN * TICK_NS)

    def trips(self) -> list[RoundTrip]:
        """Return a request for the time of every module, sent now, as it will have come back."""
        now_ns, trips = self.world.t_ns, []
        for (down, up), clock in zip(self._ways, self.world.sensors.clocks, strict=True):
            at_ns = now_ns + round(1e9 * down.fate(1e-9 * now_ns).delay_s)
            # It is read in the next tick, and answered with that tick's time.
            tick_ns = -(-at_ns // TICK_NS) * TICK_NS
            back_ns = tick_ns + round(1e9 * up.fate(1e-9 * now_ns).delay_s)
            trips.append(RoundTrip(now_ns, back_ns, module_time(clock, tick_ns)))
        return trips

    def _advance(self, until_ns: int) -> None:
        """Run ticks up to a time at most, or until something is to be done."""
        now_ns = self.world.t_ns
        for place, (due_ns, what) in enumerate(self._recurrent):
            if due_ns <= now_ns:
                self._recurrent[place] = due_ns + what.period_ns, what
                what.what(now_ns)
        next_ns = min([until_ns, *(due_ns for due_ns, _ in self._recurrent)])
        busy = [place for place, module in enumerate(self.modules) if module.has_mail]
        ticks = 1 if busy else min((next_ns - now_ns) // TICK_NS, _TICKS_OF_A_RUN)
        everyone = list(range(len(self.modules)))
        _, results = self._run.run(self._pwm, everyone, busy, ticks)
        for place, result in enumerate(results):
            self._finish(place, result)
        self._pwm[:] = self._quiet.pwm.tolist()

    def _finish(self, place: int, result: int) -> None:
        """Do what quiet ticks have left of a tick of one module."""
        module, quiet = self.modules[place], self._quiet
        out: Sequence[Outgoing] = ()
        if result == NOT_QUIET:
            quiet.load(place)
            command = module.step(self._loops.take(place, self.world.readings[place]))
            out = module.publish(self._loops.run(place, command))
            quiet.store(place)
        elif result != QUIET:
            out = quiet.keep_rows(place)
        module.now_ns = quiet.now_ns[place]
        for one in out:
            if isinstance(one, Publication) and one.leaf is Leaf.FEEDBACK:
                topic = key(self._name, module.serial, Leaf.FEEDBACK)
                self._feedback(Entry("publication", topic, self.world.t_ns, one.payload))


class Habits(NamedTuple):
    """What a robot does every day: motions, and how it travels between them, as its plan has it.

    Its ways lead over home, as those of a run: only they are known to be within what its motors can do.
    """

    motions: tuple[RobotMotion, ...]
    home_rad: float
    travel_rad_s: float


def live(robot: EverydayRobot, habits: Habits, for_s: float, rng: np.random.Generator) -> None:
    """Move a robot about for some time [s]: to where a motion begins, the motion, a pause; all drawn.

    Raises:
        ExperimentFailed: as `EverydayRobot.move`.
    """
    end_ns = robot.world.t_ns + round(for_s * 1e9)
    while robot.world.t_ns < end_ns:
        motion = habits.motions[int(rng.integers(len(habits.motions)))]
        speed = habits.travel_rad_s * float(rng.uniform(*TRAVEL_SHARE))
        for pose in (dict.fromkeys(motion.pose_rad, habits.home_rad), motion.pose_rad):
            robot.move({s: GoTo(target_rad=q, max_speed_rad_s=speed) for s, q in pose.items()})
        robot.wait(SETTLE_S)
        robot.move(dict(motion.patterns))
        robot.wait(min(float(rng.exponential(PAUSE_S)), MAX_PAUSE_S))
