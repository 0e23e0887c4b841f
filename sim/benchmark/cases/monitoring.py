"""Monitoring: an event on a moving robot is detected, named and located; without one there is no alarm.

The robot is recorded once, on a day of its own; each trial is another day: the modules and their errors are
the same, noise, drift and network differ. The seed draws the event: kind, module, size and time.
"""

from collections.abc import Sequence
from functools import lru_cache
from statistics import median
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import gammainccinv, gammaincinv

from coordinator.excitation.plan import Plan
from coordinator.excitation.segment import RobotMotion
from coordinator.monitoring.findings import Finding, Kind
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from coordinator.monitoring.reference import ALARMS_PER_HOUR, Reference, build_reference
from module_agent.model.chain import Chain
from module_agent.network_emulation.profile_file import network as network_named
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.cases.link_change import draw_link_change, known_robot, with_link_change
from sim.benchmark.cases.monitored_robot import WorldEvent, monitor_robot, ordinary_motions
from sim.benchmark.row import Row
from sim.geometry.link_parts import FreePose
from sim.robot.robot_file import Robot, load_robot
from sim.robot.variants import at_random_site, loaded
from sim.virtual_time.robot import VirtualSettings
from sim.world.external_force import Push

Happens = Literal["nothing", "collision", "payload", "friction", "wear"]
KINDS: tuple[Happens, ...] = ("collision", "payload", "friction", "wear")
Found = Literal["nothing"] | Kind

# Trials that share a robot, each a day of it; a robot's own day is the first.
DAYS = 1000
# The run that a robot is known from: all joints at once, and six motions for its inertia.
KNOWN_PLAN = Plan(
    mode="simultaneous", excitation="d-optimal", excitation_motions=6, excitation_s=5.0, imu="calibrated"
)
BRIEF = {"excitation_motions": 4, "excitation_s": 4.0}
MOTION_S, MOTIONS = 4.0, 6
# The event is drawn between these times; monitoring goes on for so long after it.
EARLIEST_S, LATEST_S, AFTER_S = 8.0, 12.0, 14.0
# Ranges of what is drawn: masses, friction factors, displacements, forces and durations of a push.
MASS_KG, FRICTION, SHIFT_M = (0.05, 0.3), (1.25, 1.75), (6e-3, 12e-3)
FORCE_N, PUSH_S, LEVER_M = (6.0, 20.0), (0.05, 0.3), 0.1


class MonitoringTrial(NamedTuple):
    """The result of monitoring one robot during one event, or none.

    found: kind of the first retained finding, "nothing" if there was none. located: it named the right
    module. latency_s: from the event to the first finding of any kind, named_s: to that of the right kind.
    size, size_error: of the event, in the finding's unit; the latter is None for findings without a size.
    false_alarms: findings without an event. monitored_s: time monitored.
    """

    happened: Happens
    found: Found
    located: bool
    latency_s: float | None
    named_s: float | None
    size: float
    size_error: float | None
    false_alarms: int
    monitored_s: float
    words: tuple[str, ...]


class Alarms(NamedTuple):
    """False alarms of unchanged robots, and the time monitored [s]."""

    alarms: int
    monitored_s: float

    @property
    def per_hour(self) -> float:
        """False alarms per hour."""
        return 3600.0 * self.alarms / self.monitored_s

    def interval_per_hour(self, confidence: float = 0.95) -> tuple[float, float]:
        """Return the confidence interval of the rate, for Poisson counts (Garwood 1936)."""
        tail = 0.5 * (1.0 - confidence)
        low = gammaincinv(self.alarms, tail) if self.alarms else 0.0
        high = gammainccinv(self.alarms + 1, tail)
        return 3600.0 * float(low) / self.monitored_s, 3600.0 * float(high) / self.monitored_s


def sum_of(segments: Sequence[Alarms]) -> Alarms:
    """Return the alarms and the time of several segments."""
    return Alarms(sum(one.alarms for one in segments), sum(one.monitored_s for one in segments))


class Subject(NamedTuple):
    """The monitored robot; `seed` draws its modules and its site.

    brief: it is known from half as much motion, and events come sooner.
    """

    robot: str = "a2085_03"
    noise: str = "x5"
    network: str = "lan"
    seed: int = 0
    brief: bool = False

    @property
    def plan(self) -> Plan:
        """The plan of the run that it is known from."""
        return KNOWN_PLAN.model_copy(update=BRIEF) if self.brief else KNOWN_PLAN

    @property
    def between_s(self) -> tuple[float, float]:
        """The range of times in which the event is drawn [s]."""
        return (4.0, 5.0) if self.brief else (EARLIEST_S, LATEST_S)


ARM = Subject()


class MonitoredRobot(NamedTuple):
    """The robot, its model, and the motions that it runs."""

    robot: Robot
    reference: Reference
    motions: tuple[RobotMotion, ...]


class _Event(NamedTuple):
    """An event: its module, size in the finding's unit, time, and what it does to the world."""

    serial: str
    size: float | None
    at_s: float
    happening: WorldEvent | None


def monitoring_trial(
    happens: Happens, seed: int, subject: Subject = ARM, after_s: float = AFTER_S
) -> MonitoringTrial:
    """Monitor a known robot that moves while an event happens to it.

    Args:
        happens: kind of the event.
        seed: draws module, size and time of the event, and the day's noise; below `DAYS`.
        subject: the robot.
        after_s: for how long monitoring goes on after the event.
    """
    known = known_subject(subject)
    rng = np.random.default_rng((seed, subject.seed, 0x3A7C))
    event = _draw(happens, rng, known.robot, float(rng.uniform(*subject.between_s)))
    monitor = Monitor(known.reference)
    findings: list[Finding] = []

    def report(update: MonitorUpdate, now_ns: int) -> None:
        findings.extend(update.findings)

    happening = () if event.happening is None else (event.happening,)
    settings = settings_of(known.robot, subject, 1 + seed)
    monitor_robot(settings, known.motions, event.at_s + after_s, monitor, report, happening)
    return _trial(happens, event, monitor, findings)


def false_alarms(seed: int, for_s: float, subject: Subject = ARM) -> Alarms:
    """Monitor an unchanged robot for some time [s]."""
    known = known_subject(subject)
    monitor = Monitor(known.reference)
    settings = settings_of(known.robot, subject, 1 + seed)
    monitor_robot(settings, known.motions, for_s, monitor, lambda update, now_ns: None)
    return Alarms(len(monitor.finding_log.all), monitor.monitored_s)


@lru_cache(maxsize=2)
def known_subject(subject: Subject) -> MonitoredRobot:
    """Return a robot, its model from one run, and other motions than those of that run."""
    robot = at_random_site(load_robot(subject.robot), subject.seed)
    known = known_robot(settings_of(robot, subject, 0), subject.plan, 0)
    plan = KNOWN_PLAN.model_copy(update={"excitation_s": MOTION_S, "excitation_motions": MOTIONS})
    motions = ordinary_motions(known.chain, known.recording, plan, 1000 + subject.seed)
    return MonitoredRobot(robot, build_reference(known), motions)


def settings_of(robot: Robot, subject: Subject, day: int) -> VirtualSettings:
    """Return the settings of one day of the robot; the known run was on day 0."""
    return VirtualSettings(
        robot,
        network_named(subject.network),
        subject.seed,
        subject.noise,
        noise_seed=subject.seed * (DAYS + 1) + day,
    )


def _draw(happens: Happens, rng: np.random.Generator, robot: Robot, at_s: float) -> _Event:
    serial = str(rng.choice(robot.serials))
    match happens:
        case "nothing":
            return _Event("", None, at_s, None)
        case "collision":
            return _collision(rng, robot, at_s)
        case "payload":
            mass = float(rng.uniform(*MASS_KG))
            changed = loaded(robot, robot.serials[-1], _weight(rng, mass))
            return _Event(robot.serials[-1], mass, at_s, WorldEvent(at_s, lambda w: w.become(changed)))
        case "friction":
            factor = float(rng.uniform(*FRICTION))
            happening = WorldEvent(at_s, lambda w: w.change_friction(serial, factor))
            return _Event(serial, 100.0 * (factor - 1.0), at_s, happening)
        case "wear":
            change = draw_link_change(robot, int(rng.integers(2**31)), float(rng.uniform(*SHIFT_M)))
            size_mm = 1e3 * float(np.linalg.norm(change.displacement_m))
            displaced = with_link_change(robot, change)
            return _Event(change.child, size_mm, at_s, WorldEvent(at_s, lambda w: w.become(displaced)))


def _collision(rng: np.random.Generator, robot: Robot, at_s: float) -> _Event:
    """Push the body that a joint turns, at a lever, so that the push loads the joint."""
    serial = str(rng.choice(robot.serials))
    direction = rng.standard_normal(3)
    force = float(rng.uniform(*FORCE_N)) * direction / np.linalg.norm(direction)
    x, y, z = (float(f) for f in force)
    lasting = float(rng.uniform(*PUSH_S))
    push = Push(serial=serial, force_n=(x, y, z), at_m=(LEVER_M, 0.0, 0.0), from_s=at_s, for_s=lasting)
    return _Event(serial, None, at_s, WorldEvent(at_s, lambda w: w.push(push)))


def _weight(rng: np.random.Generator, mass_kg: float) -> FreePose:
    x, y, z = (float(c) for c in rng.uniform(-0.05, 0.05, 3))
    own = mass_kg * 5e-4
    return FreePose(mass_kg=mass_kg, com_xyz_m=(x, y, z), inertia=(own, own, own, 0.0, 0.0, 0.0))


def _trial(happens: Happens, event: _Event, monitor: Monitor, findings: Sequence[Finding]) -> MonitoringTrial:
    at_ns = round(1e9 * event.at_s)
    retained = monitor.finding_log.all
    # The time of a change is known to within the windows of the monitor.
    early = [f for f in retained if f.detected_ns < at_ns]
    later = [f for f in retained if f.detected_ns >= at_ns]
    right = [f for f in later if f.kind == happens]
    found: Found = later[0].kind if later else "nothing"
    others = [f for f in later if f.kind != happens]
    first = [f.reported_ns for f in findings if f.reported_ns >= at_ns]
    named = [f.reported_ns for f in findings if f.reported_ns >= at_ns and f.kind == happens]
    own = right[0] if right else None
    return MonitoringTrial(
        happened=happens,
        found=found,
        located=own is not None and _is_there(monitor.reference.chain, own, event.serial),
        latency_s=1e-9 * (first[0] - at_ns) if first else None,
        named_s=1e-9 * (named[0] - at_ns) if named and own is not None else None,
        size=event.size or 0.0,
        size_error=own.size - event.size if own is not None and event.size is not None else None,
        false_alarms=len(early) + len(others),
        monitored_s=monitor.monitored_s,
        words=tuple(f.summary for f in retained),
    )


def _is_there(chain: Chain, finding: Finding, serial: str) -> bool:
    """Return whether a finding names the right module; for a collision also one that bears it."""
    if finding.kind != "collision":
        return finding.serial == serial
    named, where = (chain.serials.index(s) for s in (finding.serial, serial))
    return named in chain.ancestors(where)


def confusion(trials: Sequence[MonitoringTrial]) -> dict[Happens, dict[Found, int]]:
    """Return how often each kind of event was found as which kind."""
    table: dict[Happens, dict[Found, int]] = {}
    for trial in trials:
        row = table.setdefault(trial.happened, {})
        row[trial.found] = row.get(trial.found, 0) + 1
    return table


# Share of events that may be missed: some of those drawn load no joint, or stay in the noise.
MISSED_SHARE = 0.2
# How soon it must be named: a collision while it lasts, a change within the windows that show it.
NAMED_S = {"collision": 0.5, "payload": 10.0, "friction": 10.0, "wear": 10.0}
# Findings beyond the one that happened, a trial.
ADDITIONAL_SHARE = 0.1
# Length of a trial without event: with longer ones processes would idle at the end.
SEGMENT_S = 300.0
QUICK_AFTER_S, QUICK_SEGMENT_S = 5.0, 8.0
# What is known beforehand under a noise profile.
KNOWN_BY_NOISE = {ARM.noise: "a baseline run, IMU scale and axes", "x5-uncalibrated": "a baseline run"}
# Trials of unchanged robots are days of their own.
UNCHANGED_DAY = 500
_KNOWN_COST_S, COST_PER_S = 8.0, 0.2


class MonitoredSegments(NamedTuple):
    """Trials with an event, and segments without any change."""

    trials: tuple[MonitoringTrial, ...]
    unchanged: tuple[Alarms, ...]


def monitoring_cases(trials: int, segments: int, seed: int, shortened: bool = False) -> list[Case]:
    """Return a case for each noise profile: every kind of event so many times, and segments without change.

    `shortened`: trials and segments are short, all in one process, which records the robot once, and only
    with calibrated IMUs.
    """
    after_s, segment_s = (QUICK_AFTER_S, QUICK_SEGMENT_S) if shortened else (AFTER_S, SEGMENT_S)
    drawn = [(kind, seed * 100 + number) for number in range(trials) for kind in KINDS]
    days = [UNCHANGED_DAY + number for number in range(segments)]
    # Pieces of work of some minutes each.
    count = 1 if shortened else max(1, -(-len(drawn) // 12), len(days))
    cases = []
    for noise, known in KNOWN_BY_NOISE.items() if not shortened else [(ARM.noise, KNOWN_BY_NOISE[ARM.noise])]:
        subject = ARM._replace(noise=noise, brief=shortened)
        work = []
        for k in range(count):
            own, still = tuple(drawn[k::count]), tuple(days[k::count])
            cost_s = _KNOWN_COST_S + COST_PER_S * (len(own) * (12.0 + after_s) + len(still) * segment_s)
            work.append(Trial(monitor_one_robot, (own, still, after_s, segment_s, subject), cost_s))
        name = f"{subject.robot}, monitored" if noise == ARM.noise else f"{subject.robot}, {noise}, monitored"
        cases.append(Case(name, work, _summary, noise, known))
    return cases


def monitor_one_robot(
    drawn: Sequence[tuple[Happens, int]],
    quiet: Sequence[int],
    after_s: float,
    segment_s: float,
    subject: Subject,
) -> MonitoredSegments:
    """Record a robot once, and monitor it in all of its trials."""
    return MonitoredSegments(
        tuple(monitoring_trial(kind, seed, subject, after_s) for kind, seed in drawn),
        tuple(false_alarms(day, segment_s, subject) for day in quiet),
    )


def _summary(robots: Sequence[MonitoredSegments]) -> Summary:
    trials = [trial for one in robots for trial in one.trials]
    rows = []
    for kind in dict.fromkeys(trial.happened for trial in trials):
        own = [trial for trial in trials if trial.happened == kind]
        wrong = sum(not (trial.found == kind and trial.located) for trial in own)
        named_s = [trial.named_s for trial in own if trial.named_s is not None]
        limit = float(int(MISSED_SHARE * len(own)))
        rows += [
            Row(f"{kind}: missed or misplaced, of {len(own)}", float(wrong), limit),
            Row(f"{kind}: named after, median [s]", median(named_s) if named_s else None, NAMED_S[kind]),
        ]
    total = sum_of([alarms for one in robots for alarms in one.unchanged])
    low, high = total.interval_per_hour()
    additional = sum(trial.false_alarms for trial in trials)
    rows += [
        Row(
            f"additional findings, in {len(trials)} trials",
            float(additional),
            float(int(ADDITIONAL_SHARE * len(trials))),
        ),
        Row(f"false alarms in {total.monitored_s / 3600.0:.2g} h", float(total.alarms)),
        Row("false alarms, 95 % sure to be above [1/h]", low, ALARMS_PER_HOUR),
        Row("false alarms, 95 % sure to be below [1/h]", high),
    ]
    return Summary(rows)
