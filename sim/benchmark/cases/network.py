"""Networks: the cost of latency, jitter, loss and differing clocks for the estimates.

Trials of one seed on different networks have the same modules, clocks included, so that they come in pairs.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from coordinator.excitation.plan import Plan
from coordinator.identification.identified import Kinematics
from coordinator.identification.identify import identify_kinematics
from coordinator.recording.recording import Recording
from module_agent.model.errors import RobotError
from module_agent.network_emulation.profile_file import network as named_network
from module_agent.signals.clock_map import ClockMap
from sim.benchmark.case import Case, Summary, Trial, trial_seed
from sim.benchmark.cases.arm import arm_plan
from sim.benchmark.row import Row, count, coverage, for_few, ratio, rms, scaled
from sim.imperfections.noise_profile import NoiseProfile, imu_kind, noise_profile
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain
from sim.robot.variants import at_random_site
from sim.scoring.chain_score import link_errors, tip_errors, topology_differences
from sim.sensors.module_clock import ModuleClock, module_time
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session
from sim.world.world import World

OFFSET_S = 0.05
DRIFT_PPM = 100.0
# Instants of a session at which the clocks' maps are compared with one another.
INSTANTS = 200


class NetworkTrial(NamedTuple):
    """The result of one trial; of one that failed only the first four fields are set.

    why: the reason for a failure, empty without one. repeats: motions that were interrupted and run again.
    link_error_m, link_sigma_m, axis_error_deg: errors of lengths, claimed sigmas and errors of the parents'
    axes of all links that were identified, in the order of the robot's file. clock_error_s: root mean square,
    over modules and times, of the differences between the modules' mapped clocks; clock_sigma_s: as claimed.
    """

    robot: str
    network: str
    seed: int
    why: str
    repeats: int = 0
    robot_time_s: float = 0.0
    topology_right: bool = False
    link_error_m: tuple[float, ...] = ()
    link_sigma_m: tuple[float, ...] = ()
    axis_error_deg: tuple[float, ...] = ()
    tip_position_m: float | None = None
    tip_orientation_deg: float | None = None
    clock_error_s: float | None = None
    clock_sigma_s: float | None = None


def network_trial(
    robot: str, network: str, noise: str | NoiseProfile | None, seed: int, plan: Plan | None = None
) -> NetworkTrial:
    """Run, identify and score one robot over one network, in virtual time and without dynamics.

    Args:
        robot: a shipped robot or a robot file.
        network: a network profile or file.
        noise: a noise profile; `with_clock_errors` adds clocks that differ by 50 ms and 100 ppm.
        seed: of the modules, their noise, the network, and the site.
        plan: of the session; None for that of `arm_trial`.
    """
    described = at_random_site(load_robot(robot), seed)
    profile = noise if isinstance(noise, NoiseProfile) else noise_profile(noise or described.noise)
    settings = VirtualSettings(described, named_network(network), seed, profile)
    begun = NetworkTrial(robot, network, seed, "")
    try:
        recording = record_session(settings, plan or arm_plan("joint", imu_kind(profile)))
        kinematics = identify_kinematics(recording)
    except RobotError as error:
        return begun._replace(why=str(error))
    world = World(described, seed, profile)
    try:
        clocks = dict(zip(described.serials, world.sensors.clocks, strict=True))
    finally:
        world.close()
    return scored(begun, described, clocks, recording, kinematics)


def scored(
    begun: NetworkTrial,
    robot: Robot,
    clocks: Mapping[str, ModuleClock],
    recording: Recording,
    kinematics: Kinematics,
) -> NetworkTrial:
    """Return the trial with its comparison of result and truth."""
    truth, fit = true_chain(robot), kinematics.fit
    differences = topology_differences(fit.chain, truth)
    tip = (None, None) if differences else tip_errors(fit.chain, truth, fit.null_basis)
    children = [child for child, parent in enumerate(truth.parent) if parent >= 0]
    errors = {child: error for child in children if (error := link_errors(fit.chain, truth, child))}
    own = [fit.chain.serials.index(truth.serials[child]) for child in errors]
    end_s = 1e-9 * float(np.ptp([event.t_ns for event in recording.journal]))
    return begun._replace(
        repeats=sum(e.what == "note" and "the motion of module" in e.text for e in recording.journal),
        robot_time_s=end_s,
        topology_right=not differences,
        link_error_m=tuple(error.length_m for error in errors.values()),
        link_sigma_m=tuple(float(fit.link_length_sigma_m[k]) for k in own),
        axis_error_deg=tuple(error.axis_deg for error in errors.values()),
        tip_position_m=None if tip[0] is None else 1e-3 * tip[0],
        tip_orientation_deg=tip[1],
        clock_error_s=clock_error_s(kinematics.clocks, clocks, end_s),
        clock_sigma_s=_rms([1e-9 * clock.sigma_ns for clock in kinematics.clocks.values()]),
    )


def with_clock_errors(
    noise: NoiseProfile, offset_s: float = OFFSET_S, drift_ppm: float = DRIFT_PPM
) -> NoiseProfile:
    """Return a profile whose clocks differ by up to `offset_s`, and by `drift_ppm` (one sigma)."""
    return noise.model_copy(
        update={"clock_offset_min_s": 0.0, "clock_offset_max_s": offset_s, "clock_drift_ppm": drift_ppm}
    )


def clock_error_s(estimated: Mapping[str, ClockMap], true: Mapping[str, ModuleClock], end_s: float) -> float:
    """Return the root mean square, over modules and times, of differences between mapped clocks.

    The same instants of all modules are mapped, spread from the world's start to `end_s`.
    """
    instants = [round(1e9 * t) for t in np.linspace(0.0, end_s, INSTANTS)]
    mapped = np.stack(
        [
            clock.to_session(np.array([module_time(true[s], t) for t in instants], dtype=np.int64))
            for s, clock in estimated.items()
        ],
        axis=1,
    )
    # Whole nanoseconds of years do not fit a float: differences first.
    relative = (mapped - mapped[:, :1]).astype(np.float64)
    return _rms(1e-9 * (relative - relative.mean(axis=1, keepdims=True)).ravel())


def _rms(values: Sequence[float] | np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# Clocks are 50 ms and 100 ppm apart, see `with_clock_errors`.
ROBOT = "a2085_04"
PERFECT, POOR, BAD = "none", "wifi", "bad"
OVER_PERFECT = 1.2
_COST_S = 9.0


def network_cases(trials: int, seed: int, plan: Plan | None = None) -> list[Case]:
    """Return a case of `wifi` against a perfect network on the same modules, and one of `bad`."""
    noise = with_clock_errors(noise_profile("x5"))

    def work(*networks: str) -> tuple[Trial, ...]:
        return tuple(
            Trial(network_trial, (ROBOT, network, noise, trial_seed(seed, ROBOT, number), plan), _COST_S)
            for number in range(trials)
            for network in networks
        )

    pair, bad = (f"{ROBOT}, x5, clocks apart, {network}" for network in (POOR, BAD))
    return [
        Case(pair, work(PERFECT, POOR), partial(_pairs, pair)),
        Case(bad, work(BAD), partial(_bad, bad)),
    ]


def _pairs(case: str, trials: Sequence[NetworkTrial]) -> Summary:
    """Compare trials on the same modules; a pair with a failure is excluded from the ratios."""
    by_seed = {(trial.network, trial.seed): trial for trial in trials}
    whole = [
        (perfect, by_seed[POOR, perfect.seed])
        for perfect in trials
        if perfect.network == PERFECT and (POOR, perfect.seed) in by_seed
    ]
    right = [(a, b) for a, b in whole if _right(a) and _right(b)]
    perfect, poor = [a for a, _ in right], [b for _, b in right]
    own = [trial for trial in trials if trial.network == POOR]
    rows = (
        _wrong(case, own),
        _ratio(case, "tip position", len(right), _tips(perfect), _tips(poor)),
        _ratio(case, "link lengths", len(right), _errors(perfect), _errors(poor)),
        Row(case, "tip position, rms [mm]", None, scaled(rms(_tips(poor)), 1e3)),
        _clocks(case, poor),
    )
    return Summary(rows, _sigmas_off(trials))


def _bad(case: str, trials: Sequence[NetworkTrial]) -> Summary:
    right = [trial for trial in trials if _right(trial)]
    off = _sigmas_off(right)
    rows = (
        _wrong(case, trials),
        coverage(case, off),
        Row(case, "tip position, rms [mm]", None, scaled(rms(_tips(right)), 1e3)),
        _clocks(case, right),
    )
    return Summary(rows, off)


def _right(trial: NetworkTrial) -> bool:
    return not trial.why and trial.topology_right


def _wrong(case: str, trials: Sequence[NetworkTrial]) -> Row:
    return count(case, "runs without the right topology", [not _right(trial) for trial in trials])


def _errors(trials: Sequence[NetworkTrial]) -> list[float]:
    return [error for trial in trials for error in trial.link_error_m]


def _tips(trials: Sequence[NetworkTrial]) -> list[float | None]:
    return [trial.tip_position_m for trial in trials]


def _ratio(
    case: str, of: str, trials: int, perfect: Sequence[float | None], poor: Sequence[float | None]
) -> Row:
    figure = f"{of}, rms error over a perfect network's"
    return Row(case, figure, None, ratio(rms(poor), rms(perfect)), None, for_few(OVER_PERFECT, trials))


def _clocks(case: str, trials: Sequence[NetworkTrial]) -> Row:
    error = scaled(rms([trial.clock_error_s for trial in trials]), 1e6)
    return Row(case, "clocks apart, rms [us]", None, error)


def _sigmas_off(trials: Sequence[NetworkTrial]) -> tuple[float, ...]:
    return tuple(
        abs(error) / sigma
        for trial in trials
        if _right(trial)
        for error, sigma in zip(trial.link_error_m, trial.link_sigma_m, strict=True)
    )
