"""Torque assistance (thesis 6.3.2, 6.3.3): how joints follow a motion with and without calculated torque.

The torques come from what is identified of the same modules on another day, and make up for what the motors
take by the catalogue (`coordinator.torque_control.motor_compensation`), but for those of the thesis, A Phi
alone. The true motion of the joints is compared with the commanded motion.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify
from coordinator.torque_control.feed_forward import (
    Reference,
    SetPoints,
    feed_forward,
    joint_reference,
    on_module,
    standing,
)
from coordinator.torque_control.motor_compensation import with_motor_compensation
from module_agent.control.gains import default_gains
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.model.chain import Array, Chain
from module_agent.model.read_only import read_only
from module_agent.network_emulation.profile_file import network
from module_agent.wire.messages import GainSet, GoTo, Pattern, Rest
from sim.imperfections.noise_profile import NoiseProfile, imu_kind
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain, true_inertia
from sim.robot.variants import as_built, at_random_site
from sim.test_bench.module_bench import ExperimentFailed
from sim.test_bench.robot_bench import BenchRobot, Streaming, Track
from sim.thesis.dynamics.load_identification import Frame, wrench_rows
from sim.thesis.kinematics.joint_trial import rms
from sim.thesis.published import Reading, setting, thesis_gains, without_velocity
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session

# Contents of a set-point: position; position and velocity; position, velocity and calculated torque.
InputMode = Literal[1, 2, 3]
MODES: tuple[InputMode, ...] = (1, 2, 3)

# The day of the identification is 0, that of the trial another one.
TRIAL_DAY = 1
TRAVEL_RAD_S = 1.0
# How long a joint is given to settle under new gains, and to come to rest after the motion.
SETTLE_S = 1.5
_STILL_S = 0.5
# A joint that still moves by so much in the last half second of its rest is unstable: 1 mm rms at the end of
# the thesis' arm of 484 mm.
MAX_RINGING_RAD = 2e-3
# So is one whose bridge is at its limit for more than this share of the motion: no loop is closed then.
MAX_SATURATED = 0.25
_SATURATED_DUTY = 0.98
# And so is one whose loops answer single encoder counts with the full range of the bridge: its duty jumps by
# half of its range or more from one tick to the next. Measured: unstable joints do so in 34 to 57 % of the
# ticks, all others in 6 % at most.
MAX_DUTY_JUMPS = 0.20
_DUTY_JUMP = 1.0


class Delivery(NamedTuple):
    """How set-points come to the loops: in the module itself, or streamed by a host through a network."""

    name: str
    network: str | None = None
    rate_hz: float = 0.0


ON_MODULE = Delivery("on the module")


class Gains(NamedTuple):
    """Which gains: the factory's of a strategy, or one of the thesis' settings in one reading of it."""

    strategy: int
    setting: str | None = None
    reading: Reading | None = None

    @property
    def name(self) -> str:
        """The setting's name."""
        return f"factory S{self.strategy}" if self.setting is None else self.setting

    def of(self, kind: ModuleType) -> GainSet:
        """Return the gains of a type of module."""
        if self.setting is None or self.reading is None:
            return default_gains(kind, self.strategy)
        return thesis_gains(kind, setting(self.setting), self.reading)


class Model(NamedTuple):
    """A robot's model: chain and inertial parameters (10 n,)."""

    chain: Chain
    phi: Array

    @property
    def serials(self) -> tuple[str, ...]:
        """The modules, in the order of a motion's columns."""
        return self.chain.serials

    @property
    def compensates(self) -> bool:
        """Whether the torques make up for the motors."""
        return True

    def set_points(self, motion: Reference) -> SetPoints:
        """Return the spring torques along a motion."""
        return feed_forward(self.chain, self.phi, motion)


class LoadModel(NamedTuple):
    """What is identified of the load of the first of a robot's modules, whose torque is A Phi (eq. 25).

    phi: (10,) parameters. force_m_s2: (3,) specific force of rest at q = 0. frame: whether that force is
    constant, as section 5.1 has it, or turns against the link. compensates: whether the torques make up for
    the motor, too, which the thesis' do not.
    """

    serials: tuple[str, ...]
    phi: Array
    force_m_s2: Array
    frame: Frame = "at rest"
    compensates: bool = False

    def set_points(self, motion: Reference) -> SetPoints:
        """Return the load's torques along a motion, and none for the other modules."""
        effort = np.zeros_like(motion.q_rad)
        q, qd, qdd = (signal[:, 0] for signal in motion[1:])
        rows = wrench_rows(q, qd, qdd, self.force_m_s2, self.frame)
        effort[:, 0] = rows[:, -1] @ self.phi
        return SetPoints(motion, read_only(effort))


class Stage(NamedTuple):
    """A robot and its commanded motion; joints without a pattern hold their start position."""

    robot: Robot
    start_rad: Mapping[str, float]
    patterns: Mapping[str, Pattern]


class Follow(NamedTuple):
    """Tracking of a motion, over the joints that were commanded to move.

    rms_error_rad: of the true position, over the whole motion.
    ringing_rad: the largest standard deviation of a joint at the end of its rest afterwards.
    saturated: the largest share of the motion during which a bridge is at its limit. duty_jumps: the largest
    share of ticks in which a duty changes by half its range or more. unstable: the reason, empty if stable.
    commanded_rad, true_rad: (m, k) of the joints that moved, at 250 Hz; empty if the motion was broken off.
    """

    rms_error_rad: float
    ringing_rad: float
    saturated: float
    duty_jumps: float
    unstable: str
    commanded_rad: Array
    true_rad: Array


def identified_model(robot: Robot, noise: NoiseProfile, seed: int, plan: Plan | None = None) -> Model:
    """Run one whole session on a simulated robot, and return the identified model.

    Raises:
        what `record_session` and `identify` raise.
    """
    settings = VirtualSettings(robot, network("lan"), seed, noise, noise_seed=0)
    identified = identify(record_session(settings, plan or Plan(imu=imu_kind(noise))))
    if identified.inertia is None:
        raise ValueError(
            f"the plan leaves out the dynamics of {robot.name}: there is nothing to calculate from"
        )
    return Model(identified.kinematics.fit.chain, identified.inertia.instrumental.fit.phi)


def true_model(name: str, seed: int, noise: NoiseProfile) -> Model:
    """Return the true model of a shipped robot as the seed builds and places it, not an identified one."""
    robot = as_built(standing_robot(name, seed), seed, noise)
    return Model(true_chain(robot), read_only(true_inertia(robot).reshape(-1)))


def standing_robot(name: str, seed: int) -> Robot:
    """Return a shipped robot at the place that the seed draws."""
    return at_random_site(load_robot(name), seed)


def follow(
    stage: Stage,
    gains: Gains,
    mode: InputMode,
    delivery: Delivery,
    model: Model | LoadModel,
    noise: NoiseProfile,
    seed: int,
) -> Follow:
    """Run a motion on a robot and return its tracking.

    The joints go to the start under the factory's gains and settle under those of the trial, in the same
    input mode; then comes the motion, and a rest after it.
    """
    movers = list(stage.patterns)
    types = {module.serial: module_type(module.type) for module in stage.robot.modules}
    kinds = [types[serial] for serial in movers]
    sets = [gains.of(kind) if mode > 1 else without_velocity(gains.of(kind)) for kind in kinds]
    points = _phases(stage, model)
    try:
        with BenchRobot(stage.robot, seed, noise, noise_seed=TRIAL_DAY) as bench:
            bench.run(
                {s: GoTo(target_rad=q, max_speed_rad_s=TRAVEL_RAD_S) for s, q in stage.start_rad.items()}
            )
            if model.compensates:
                points = _driven(points, kinds, sets, [bench.by_serial[s].winding_c for s in movers])
            bench.set_gains(dict(zip(movers, sets, strict=True)))
            if delivery.network is None:
                tracks = _on_module(bench, stage, points, mode)
            else:
                tracks = _streamed(bench, movers, points, mode, delivery, seed)
    except ExperimentFailed as error:
        return _broken_off(points[1].reference, str(error))
    columns = [stage.robot.serials.index(serial) for serial in movers]
    moving, after = (Track(*(signal[:, columns] for signal in track)) for track in tracks[1:])
    return tracking(points[1].reference, moving, after)


def tracking(commanded: Reference, moving: Track, after: Track) -> Follow:
    """Return the tracking of a motion; columns are the joints that moved, `after` is the rest after it."""
    if not all(np.isfinite(track.q_rad).all() for track in (moving, after)):
        return _broken_off(commanded, "the simulated motion diverges")
    q = commanded.q_rad
    error = moving.q_rad[: len(q)] - q
    still = round(_STILL_S * 1e3)
    ringing = float(after.q_rad[-still:].std(axis=0).max())
    saturated = _largest_share(np.abs(moving.duty) > _SATURATED_DUTY)
    duty_jumps = _largest_share(np.abs(np.diff(moving.duty, axis=0)) > _DUTY_JUMP)
    reasons = (
        (ringing > MAX_RINGING_RAD, f"rings by {1e3 * ringing:.1f} mrad"),
        (saturated > MAX_SATURATED, f"saturates {100.0 * saturated:.0f} % of the time"),
        (duty_jumps > MAX_DUTY_JUMPS, f"duty jumps in {100.0 * duty_jumps:.0f} % of the ticks"),
    )
    return Follow(
        rms_error_rad=rms(error),
        ringing_rad=ringing,
        saturated=saturated,
        duty_jumps=duty_jumps,
        unstable=", ".join(text for applies, text in reasons if applies),
        commanded_rad=read_only(q[::4].copy()),
        true_rad=read_only(moving.q_rad[: len(q) : 4].copy()),
    )


def _largest_share(when: NDArray[np.bool_]) -> float:
    return float(np.mean(when, axis=0).max())


def _broken_off(commanded: Reference, why: str) -> Follow:
    nothing = read_only(np.empty((0, commanded.q_rad.shape[1])))
    return Follow(np.inf, np.inf, 1.0, 1.0, f"broken off: {why}", nothing, nothing)


def _phases(stage: Stage, model: Model | LoadModel) -> list[SetPoints]:
    """Return the set-points of the joints that move: settling, the motion, the rest after it."""
    serials = model.serials
    motion = joint_reference(serials, stage.patterns, stage.start_rad)
    phases = (standing(motion, 0, SETTLE_S), motion, standing(motion, -1, SETTLE_S))
    columns = [serials.index(serial) for serial in stage.patterns]
    return [_picked(model.set_points(each), columns) for each in phases]


def _driven(
    phases: list[SetPoints], kinds: list[ModuleType], gains: list[GainSet], winding_c: list[float]
) -> list[SetPoints]:
    """Return successive phases with motor compensation, in which the motors get warmer."""
    driven = with_motor_compensation(_joined(phases), kinds, gains, winding_c).effort_nm
    parts = np.split(driven, _ends(phases))
    return [phase._replace(effort_nm=part) for phase, part in zip(phases, parts, strict=True)]


def _ends(phases: list[SetPoints]) -> NDArray[np.int64]:
    """Return the rows at which all phases but the first begin."""
    return np.cumsum([len(phase.effort_nm) for phase in phases])[:-1]


def _joined(phases: list[SetPoints]) -> SetPoints:
    signals = zip(*(phase.reference for phase in phases), strict=True)
    reference = Reference(*(np.concatenate(signal) for signal in signals))
    return SetPoints(reference, np.concatenate([phase.effort_nm for phase in phases]))


def _picked(points: SetPoints, columns: list[int]) -> SetPoints:
    t_s, *motion = points.reference
    chosen = Reference(t_s, *(read_only(signal[:, columns].copy()) for signal in motion))
    return SetPoints(chosen, read_only(points.effort_nm[:, columns].copy()))


def _on_module(bench: BenchRobot, stage: Stage, points: list[SetPoints], mode: InputMode) -> list[Track]:
    rest = dict.fromkeys(stage.patterns, Rest(duration_s=SETTLE_S))
    tracks = []
    for patterns, phase in zip((rest, stage.patterns, rest), points, strict=True):
        efforts = dict(zip(stage.patterns, on_module(phase), strict=True)) if mode == 3 else None
        tracks.append(bench.record(patterns, efforts))
    return tracks


def _streamed(
    bench: BenchRobot,
    movers: list[str],
    points: list[SetPoints],
    mode: InputMode,
    delivery: Delivery,
    seed: int,
) -> list[Track]:
    assert delivery.network is not None
    how = Streaming(network(delivery.network), delivery.rate_hz, velocity=mode > 1, effort=mode == 3)
    track = bench.stream(movers, _joined(points), how, seed)
    parts = (np.split(signal, _ends(points)) for signal in track)
    return [Track(*part) for part in zip(*parts, strict=True)]
