"""The thesis' amplitude experiment: series of trials on one rig.

A series is one rig, assembled once, on which trials of given amplitudes are run in turn, as in the thesis:
the same modules, with the same errors, which get warmer. Rigs differ in their seed.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from coordinator.excitation.plan import Plan
from module_agent.estimate.circle_point_analysis import (
    REST_S,
    CircleFit,
    angular_acceleration,
    circle_point_analysis,
)
from module_agent.estimate.gaussian_filter import TAPS, gaussian_filter
from module_agent.estimate.joint_regression import JointRegression
from module_agent.estimate.windows import imu_window
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import IMU_PRIORS
from sim.imperfections.noise_profile import NoiseProfile, imu_kind
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import sensing_chain
from sim.scoring.chain_score import link_length_m
from sim.test_bench.one_joint_rig import JOINT, OneJointRig, TrialRows, aligned, analyse, regress
from sim.thesis.published import ALIGNMENTS, Alignment, thesis_length

Purpose = Literal["sweep", "repeats"]
ROBOTS_OWN_NOISE = NoiseChoice()


class Series(NamedTuple):
    """The trials of one rig; `rig` is its number, `seed` its own."""

    purpose: Purpose
    alignment: Alignment
    length_mm: int
    rig: int
    seed: int
    amplitudes_rad: tuple[float, ...]
    noise: NoiseChoice = ROBOTS_OWN_NOISE

    @property
    def robot(self) -> Robot:
        """The shipped robot that is this arm."""
        return load_robot(f"thesis_{self.length_mm}_{self.alignment}")


class AmplitudeTrial(NamedTuple):
    """One trial: the estimated distance from the joint's axis to the second IMU, and how the joint moved.

    estimated_mm, sigma_mm: by the thesis' analysis; unfiltered_mm: the same data without its filter. None
        where the analysis found too little motion; `note` says so.
    commanded_rad_s, reached_rad_s: peak speeds of the windowed sine; the latter as measured and smoothed.
    saturated: the commanded speed is beyond what the module's velocity loop takes.
    stroke: size of the motion over that of the commanded one, both rms.
    printed_mm: by the thesis' analysis with eq. 16 as printed (`as_printed`).
    printed_by_algebra_mm, twice_gravity_mm: what that should give, and how much gravity adds across the axis
        (`turned_wrongly`).
    ours_mm, ours_sigma_mm: by the agents' joint regression.
    """

    purpose: Purpose
    alignment: Alignment
    length_mm: int
    rig: int
    trial: int
    amplitude_rad: float
    true_mm: float
    estimated_mm: float | None
    sigma_mm: float | None
    unfiltered_mm: float | None
    commanded_rad_s: float
    reached_rad_s: float
    saturated: bool
    stroke: float
    note: str
    printed_mm: float | None = None
    printed_by_algebra_mm: float | None = None
    twice_gravity_mm: float | None = None
    ours_mm: float | None = None
    ours_sigma_mm: float | None = None

    def error(self, filtered: bool = True) -> float | None:
        """Return the relative error of the estimate, with the thesis' filter or without."""
        estimate = self.estimated_mm if filtered else self.unfiltered_mm
        return None if estimate is None else estimate / self.true_mm - 1.0


def sweep_series(
    lengths_mm: Sequence[int],
    amplitudes_rad: Sequence[float],
    rigs: int,
    seed: int,
    noise: NoiseChoice = ROBOTS_OWN_NOISE,
) -> list[Series]:
    """Return the sweep over amplitudes: every length in both alignments, on `rigs` rigs each."""
    return [
        Series("sweep", alignment, length, rig, _seed(seed, 0, a, length, rig), tuple(amplitudes_rad), noise)
        for a, alignment in enumerate(ALIGNMENTS)
        for length in lengths_mm
        for rig in range(rigs)
    ]


def repeat_series(
    lengths_mm: Sequence[int], trials: int, seed: int, noise: NoiseChoice = ROBOTS_OWN_NOISE
) -> list[Series]:
    """Return the repeated trials at the amplitudes that the thesis chose (its tables 4 and 5)."""
    series = []
    for a, alignment in enumerate(ALIGNMENTS):
        for length in lengths_mm:
            amplitudes_rad = (thesis_length(alignment, length).amplitude_rad,) * trials
            own = _seed(seed, 1, a, length, 0)
            series.append(Series("repeats", alignment, length, 0, own, amplitudes_rad, noise))
    return series


def _seed(seed: int, *key: int) -> int:
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0])


def run_series(series: Series) -> list[AmplitudeTrial]:
    """Assemble the rig and run its trials.

    Raises:
        ExperimentFailed: a module refused a motion or broke it off.
        KeyError, ValueError: no such noise profile or effect, no such robot.
    """
    robot = series.robot
    profile = series.noise.of(robot)
    trials = []
    with OneJointRig(robot, series.seed, profile) as rig:
        true_mm = 1e3 * link_length_m(sensing_chain(rig.world.robot), child=1)
        clamp_rad_s = rig.modules[JOINT].firmware.config.kind.velocity_clamp_rad_s
        for number, amplitude_rad in enumerate(series.amplitudes_rad):
            rows = rig.trial(Plan(sine_amplitude_rad=amplitude_rad))
            filtered, note = _fit(rows, TAPS)
            unfiltered, _ = _fit(rows, taps=1)
            wrong = filtered and turned_wrongly(rows, filtered)
            ours = _regressed(rows, profile)
            joint = rows.sine.joint
            # The sag under a load counts neither for the motion nor for the commanded one.
            moving = joint[np.isfinite(joint["position_command_rad"])]
            stroke = np.std(moving["position_rad"]) / np.std(moving["position_command_rad"])
            commanded_rad_s = float(np.nanmax(np.abs(joint["velocity_command_rad_s"])))
            trials.append(
                AmplitudeTrial(
                    purpose=series.purpose,
                    alignment=series.alignment,
                    length_mm=series.length_mm,
                    rig=series.rig,
                    trial=number,
                    amplitude_rad=amplitude_rad,
                    true_mm=true_mm,
                    estimated_mm=filtered and 1e3 * filtered.distance_m,
                    sigma_mm=filtered and 1e3 * filtered.sigma_distance_m,
                    unfiltered_mm=unfiltered and 1e3 * unfiltered.distance_m,
                    commanded_rad_s=commanded_rad_s,
                    reached_rad_s=float(np.abs(gaussian_filter(joint["velocity_rad_s"])).max()),
                    saturated=commanded_rad_s > clamp_rad_s,
                    stroke=float(stroke),
                    note=note,
                    printed_mm=filtered and 1e3 * as_printed(rows).distance_m,
                    printed_by_algebra_mm=wrong and wrong.distance_mm,
                    twice_gravity_mm=wrong and wrong.twice_gravity_mm,
                    ours_mm=ours and 1e3 * ours.distance_m,
                    ours_sigma_mm=ours and 1e3 * ours.sigma_distance_m,
                )
            )
    return trials


def as_printed(rows: TrialRows) -> CircleFit:
    """Run the thesis' analysis with eq. 16 as printed: gravity is turned by +phi.

    The world turns by -phi as seen from a body that turns by +phi (`circle_point_analysis`). Of the windowed
    sine, eq. 16 alone uses the position: its sign is that of eq. 16.

    Raises:
        DataError: too little motion, with what would be enough.
    """
    constant, sine = aligned(rows)
    turned = sine._replace(position_rad=-sine.position_rad)
    return circle_point_analysis(imu_window(rows.rest), constant, turned)


class WrongTurn(NamedTuple):
    """What eq. 16 as printed should give [mm]: the distance, and 2 |j x g| / w^2, which it adds to d n."""

    distance_mm: float
    twice_gravity_mm: float


def turned_wrongly(rows: TrialRows, fit: CircleFit) -> WrongTurn:
    """Return the distance that eq. 16 as printed should give, by algebra from the right one's fit.

    With (R(-phi) - R(+phi)) g = -2 sin(phi) j x g and phi = -alpha / w^2 of a small sine, eq. 17 leaves
    alpha (d n + (2 / w^2) j x g): the first singular vector has the length of the bracket. That is
    sqrt(d^2 + (2 g / w^2)^2) where gravity is along the tangent, d +- 2 g / w^2 where it is along the radius,
    and d about a vertical axis. 1 / w^2 is the regression of -phi on alpha, since the window widens the line.

    Raises:
        DataError: too little motion, with what would be enough.
    """
    _, sine = aligned(rows)
    alpha = angular_acceleration(sine)
    phi = sine.position_rad - sine.position_rad.mean()
    per_w2 = -float(alpha @ phi) / float(alpha @ alpha)
    gravity = sine.accel_m_s2[sine.t_s <= REST_S].mean(axis=0)
    added = 2.0 * per_w2 * np.cross(fit.axis, gravity)
    distance_m = float(np.linalg.norm(fit.distance_m * fit.tangent + added))
    return WrongTurn(1e3 * distance_m, 1e3 * float(np.linalg.norm(added)))


def _regressed(rows: TrialRows, profile: NoiseProfile) -> JointRegression | None:
    try:
        return regress(rows, IMU_PRIORS[imu_kind(profile)])
    except DataError:
        return None


def _fit(rows: TrialRows, taps: int) -> tuple[CircleFit | None, str]:
    """Return the fit, or why there is none."""
    try:
        return analyse(rows, taps), ""
    except DataError as error:
        return None, str(error)
