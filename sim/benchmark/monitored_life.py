"""A stretch of a robot's life that the monitor attends to, and what it said of it.

The robot is one that a whole run has identified, with the plan that users have by default but for the
excitation of the inertia; the monitor is the one that `x5-coordinator monitor` runs, with its defaults, but
that it looks every half second, which is how long the stretches are that its tests look at. A robot whose
seed is a number is the same in all of its lives, which differ in their day: noise, drift, weather, motions.
"""

import time
from collections.abc import Sequence
from functools import lru_cache
from itertools import islice
from statistics import median
from typing import Literal, NamedTuple

import numpy as np

from coordinator.excitation.d_optimal import draw_possible
from coordinator.excitation.plan import Excitation, Plan
from coordinator.excitation.robot_excitation import RobotModule, excitation_task
from coordinator.excitation.segment import RobotMotion, Segment
from coordinator.monitoring.findings import Finding, Key
from coordinator.monitoring.live import ASK_S, LiveMonitor
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from coordinator.monitoring.reference import ALARMS_PER_HOUR, Reference, build_reference
from coordinator.monitoring.segments import SEGMENT_S
from module_agent.model.catalogue import module_type
from module_agent.network_emulation.profile import PROFILES
from sim.benchmark.cases.link_change import known_robot
from sim.benchmark.cases.monitoring import Alarms, sum_of
from sim.benchmark.everyday_robot import EverydayRobot, Habits, Recurrent, live
from sim.benchmark.slow_change import (
    GROWTHS,
    ChangeKind,
    SlowChange,
    SlowlyChanging,
    draw_change,
    draw_weather,
)
from sim.imperfections.noise_profile import imu_kind, noise_profile
from sim.robot.robot_file import Robot, load_robot
from sim.robot.variants import at_random_site
from sim.virtual_time.robot import VirtualSettings

# When a change begins, for how long it grows, and for how long it stays as large.
ONSET_S, GROWS_S, STAYS_S = 60.0, 180.0, 60.0
# How often weather and growth are applied: a hundredth of a growth at a time is no blow.
_STEP_NS = 2_000_000_000
# The motions that a robot makes in its lives, and how many draws find them.
MOTIONS, MOTION_S, _DRAWS = 24, 5.0, 400
# Other days than that on which the robot became known.
_DAYS = 10_000

Outcome = Literal["rightly", "and wrongly", "wrongly", "missed"]
OUTCOMES: tuple[Outcome, ...] = ("rightly", "and wrongly", "wrongly", "missed")


class LifePlan(NamedTuple):
    """A stretch of life: whose, on which day, for how long; what changes, from when on, and over how long.

    excitation: of the run that the robot is known from. alarms_per_hour: what the monitor is asked for.
    brief: that run is shorter than the default one.
    """

    robot: str
    seed: int
    noise: str
    day: int
    for_s: float
    change: ChangeKind | None = None
    excitation: Excitation = "joint-by-joint"
    alarms_per_hour: float = ALARMS_PER_HOUR
    brief: bool = False
    from_s: float = ONSET_S
    over_s: float = GROWS_S


class Said(NamedTuple):
    """A finding as it was reported first: when [s], its words, and the size of the change then.

    kept: whether it was neither withdrawn nor replaced by another.
    """

    t_s: float
    kind: str
    serial: str
    words: str
    change_size: float
    kept: bool


class Life(NamedTuple):
    """What was said during a stretch of life; change: what happened, None if nothing did.

    unchanged_s: time monitored until the change began, all of it without one.
    """

    plan: LifePlan
    change: SlowChange | None
    monitored_s: float
    unchanged_s: float
    said: tuple[Said, ...]
    cpu_s: float

    @property
    def alarms(self) -> Alarms:
        """False alarms, withdrawn ones too, and the time in which they were raised."""
        return Alarms(sum(not self._later(one) for one in self.said), self.unchanged_s)

    @property
    def rightly(self) -> tuple[Said, ...]:
        """What rightly names the change, and was kept."""
        return tuple(one for one in self._kept() if self._right(one))

    @property
    def wrongly(self) -> tuple[Said, ...]:
        """What names something else once the change has begun, and was kept."""
        return tuple(one for one in self._kept() if not self._right(one))

    @property
    def outcome(self) -> Outcome:
        """How the change was named."""
        if self.rightly:
            return "and wrongly" if self.wrongly else "rightly"
        return "wrongly" if self.wrongly else "missed"

    def _later(self, one: Said) -> bool:
        return self.change is not None and one.t_s >= self.change.from_s

    def _kept(self) -> list[Said]:
        return [one for one in self.said if one.kept and self._later(one)]

    def _right(self, one: Said) -> bool:
        assert self.change is not None
        here = one.kind == "unexplained" or one.serial == self.change.serial
        return one.kind in GROWTHS[self.change.kind].named and here


class KnownRobot(NamedTuple):
    """A robot, what a run has identified of it, and what it does every day."""

    robot: Robot
    reference: Reference
    habits: Habits


def monitored_life(plan: LifePlan) -> Life:
    """Live a stretch of life under the monitor; the same plan gives the same life.

    Raises:
        ExperimentFailed: a motion was interrupted.
    """
    begin_s = time.process_time()
    known = known_robot_of(plan.robot, plan.seed, plan.noise, plan.excitation, plan.brief)
    rng = np.random.default_rng((plan.seed, plan.day, 0x11FE))
    weather = draw_weather(len(known.robot.serials), rng)
    change = None
    if plan.change is not None:
        change = draw_change(plan.change, known.robot, rng, plan.from_s, plan.over_s)
    monitor = Monitor(known.reference, plan.alarms_per_hour)
    ears = _Ears(change)
    feed: list[LiveMonitor] = []
    with EverydayRobot(
        known.robot,
        plan.seed,
        noise_profile(plan.noise),
        plan.seed * _DAYS + 1 + plan.day,
        lambda entry: feed[0].record(entry),
    ) as robot:
        clock = robot.world

        def report(update: MonitorUpdate) -> None:
            ears.report(update, 1e-9 * clock.t_ns)

        feed.append(LiveMonitor(monitor, lambda: clock.t_ns, "monitor", report))
        changing = SlowlyChanging(robot.world, known.robot, weather, change)
        robot.repeat(Recurrent(_STEP_NS, lambda now_ns: changing.at(1e-9 * now_ns)))
        robot.repeat(Recurrent(round(1e9 * ASK_S), lambda _: _ask(robot, feed[0])))
        robot.repeat(Recurrent(round(1e9 * SEGMENT_S), lambda _: feed[0].look()))
        live(robot, known.habits, plan.for_s, rng)
    lasted_s = monitor.monitored_s
    return Life(
        plan,
        change,
        lasted_s,
        lasted_s if change is None else min(change.from_s, lasted_s),
        ears.said(monitor.finding_log.all),
        time.process_time() - begin_s,
    )


def _ask(robot: EverydayRobot, monitor: LiveMonitor) -> None:
    """Let every module's answer to a request come back."""
    for module, trip in zip(robot.modules, robot.trips(), strict=True):
        record = monitor.recording.module(module.serial, module.firmware.config.boot)
        record.round_trips.append(trip)


class _Ears:
    """Hears what the monitor reports."""

    def __init__(self, change: SlowChange | None):
        self._change = change
        self._said: dict[tuple[Key, str, str, int], Said] = {}

    def report(self, update: MonitorUpdate, t_s: float) -> None:
        """Take a report at a time [s]."""
        size = 0.0 if self._change is None else self._change.size(t_s)
        for one in update.findings:
            said = Said(t_s, one.kind, one.serial, one.summary, size, False)
            self._said.setdefault(_identity(one), said)

    def said(self, kept: Sequence[Finding]) -> tuple[Said, ...]:
        """Return all that was said, in the order of time; `kept` are the findings that hold in the end."""
        holds = {_identity(one) for one in kept}
        return tuple(one._replace(kept=identity in holds) for identity, one in self._said.items())


def _identity(finding: Finding) -> tuple[Key, str, str, int]:
    """Return what makes it the same finding as an earlier one, also where its key holds another one now."""
    return finding.key, finding.kind, finding.serial, finding.detected_ns


@lru_cache(maxsize=1)
def known_robot_of(
    name: str, seed: int, noise: str, excitation: Excitation, brief: bool = False
) -> KnownRobot:
    """Return a robot as its first run has identified it, and motions for its lives.

    brief: by a run that explores all joints at once, which takes half a minute.

    Raises:
        RobotFileError: there is no such robot.
        UsageError: there is no such noise profile.
    """
    profile = noise_profile(noise)
    robot = at_random_site(load_robot(name), seed)
    plan = Plan(imu=imu_kind(profile), excitation=excitation)
    if brief:
        plan = plan.model_copy(update=_BRIEF)
    settings = VirtualSettings(robot, PROFILES["lan"], seed, profile, noise_seed=seed * _DAYS)
    known = known_robot(settings, plan, 0)
    infos = [known.recording.modules[serial].info for serial in known.chain.serials]
    modules = [RobotModule(module_type(one.module_type), one.limits) for one in infos if one is not None]
    task = excitation_task(known.chain, modules, plan)._replace(segment_s=MOTION_S)
    rng = np.random.default_rng((seed, 0x307105))
    drawn = (draw_possible(task, rng) for _ in range(_DRAWS))
    segments = islice((one for one in drawn if isinstance(one, Segment)), MOTIONS)
    serials = known.chain.serials
    motions = tuple(
        RobotMotion(
            dict(zip(serials, one.pose_rad.tolist(), strict=True)),
            dict(zip(serials, one.patterns, strict=True)),
        )
        for one in segments
    )
    habits = Habits(motions, plan.home_rad, plan.travel_speed_rad_s)
    return KnownRobot(robot, build_reference(known), habits)


_BRIEF = {"mode": "simultaneous", "excitation_motions": 4, "excitation_s": 4.0}


# A life without change: some minutes of work, which is what an interruption costs.
LIFE_S = 600.0
# Lives that a robot has before another one of its kind, with other modules, has the next.
LIVES = 6


def lives(
    robots: Sequence[str],
    hours: float,
    kinds: Sequence[ChangeKind],
    trials: int,
    seed: int,
    noise: str,
    excitation: Excitation,
) -> list[LifePlan]:
    """Return lives without change that last so many hours, shared among robots, and some with each kind."""
    plans = []
    for robot in robots:
        left_s = 3600.0 * hours / len(robots)
        stretches: list[tuple[float, ChangeKind | None]] = []
        while left_s > 1.0:
            stretches.append((min(left_s, LIFE_S), None))
            left_s -= LIFE_S
        changed_s = ONSET_S + GROWS_S + STAYS_S
        stretches += [(changed_s, kind) for _ in range(trials) for kind in kinds]
        for day, (for_s, kind) in enumerate(stretches):
            plans.append(LifePlan(robot, 1000 * seed + day // LIVES, noise, day, for_s, kind, excitation))
    return plans


class ChangeSummary(NamedTuple):
    """What became of the lives with one kind of change; medians over those in which it was named rightly.

    called: as what else it was named, and how often.
    """

    lives: int
    outcomes: dict[Outcome, int]
    named_s: float | None
    size: float | None
    unit: str
    called: dict[str, int]


def summary(all_lives: Sequence[Life]) -> dict[ChangeKind, ChangeSummary]:
    """Return what became of every kind of change."""
    found = {}
    for kind, growth in GROWTHS.items():
        own = [one for one in all_lives if one.change is not None and one.change.kind == kind]
        if not own:
            continue
        first = [(one.rightly[0], one.change) for one in own if one.rightly]
        called: dict[str, int] = {}
        for one in own:
            for word in {said.kind for said in one.wrongly}:
                called[word] = called.get(word, 0) + 1
        found[kind] = ChangeSummary(
            len(own),
            {outcome: sum(one.outcome == outcome for one in own) for outcome in OUTCOMES},
            median(s.t_s - c.from_s for s, c in first if c is not None) if first else None,
            median(s.change_size for s, _ in first) if first else None,
            growth.unit,
            called,
        )
    return found


def false_alarms(all_lives: Sequence[Life]) -> Alarms:
    """Return the false alarms of all lives, as long as nothing had changed."""
    return sum_of([one.alarms for one in all_lives])
