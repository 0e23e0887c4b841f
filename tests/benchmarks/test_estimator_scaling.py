"""How the processor time of identification grows with the modules: figures to read.

The refinement alone, of up to 64 modules: a serial robot of random modules and links, each joint moved alone
while the others give and the base rocks, sampled as in a session: encoders with steps, IMUs as delivered. Of
64 modules this takes 5 GB. The refinement works on at most `MAX_IMU_SAMPLES` IMU samples, so that the more
modules there are, the fewer samples a joint are fitted, and the wider is what is claimed: both are printed
beside the time. The exponent is that of the power law which fits the times of all sizes, as users wait, with
this limit in force; those between neighbouring sizes are printed beside it, and the steepest is to hold too.

The whole identification of kinematics, clocks, topology and checks of sensors included, is that of recorded
sessions: of `arm7` with every effect, and of `snake16` as delivered.
"""

import time
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest

from coordinator.batch_estimation.imu_intrinsics import ImuIntrinsics, read
from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.batch_estimation.sensor_data import BaseMotion, NoiseFloor
from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify_kinematics
from coordinator.identification.robot_refinement import KEEP_EVERY, MAX_IMU_SAMPLES, refine_checked
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import RATE_HZ, STEP_NS, Window
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import UNCALIBRATED
from module_agent.model.perturbation import apply_perturbation
from module_agent.network_emulation.profile import PROFILES
from module_agent.signals.filtering import REFINEMENT_CUTOFF_HZ
from sim.robot.robot_file import load_robot
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session
from tests.benchmarks.bars import report
from tests.random_chains import build, random_robot

pytestmark = pytest.mark.benchmark

# Noise of gyros and accelerometers behind the low-pass, and of the encoders' steps.
GYRO, ACCEL, STEP_RAD = 4e-4, 8e-3, 2e-5
SAMPLES = 1660
BARS_S = {7: 4.0, 16: 15.0, 32: 60.0, 64: None}


class _Fit(NamedTuple):
    cpu_s: float
    fitted: int
    error_mm: float
    sigma_mm: float


def _robot(joints: int) -> tuple[Chain, list[ModuleType]]:
    chain, types = random_robot(40, joints, serial=True)
    mounted = [False, *chain.reversed[1:]]
    return build(
        list(chain.parent), mounted, np.array(chain.imu_home), types, np.array([0.2, 0.1, 1.0])
    ), types


def _window(chain: Chain, joint: int, errors: ImuIntrinsics) -> Window:
    """One joint's windowed sine at 1 Hz; the others give by a hundredth of it."""
    rng = np.random.default_rng((joint, 11))
    t, count = np.arange(SAMPLES) / RATE_HZ, len(chain.serials)
    share = rng.normal(0.0, 0.01, count)
    share[joint] = 0.4
    bump = np.sin(np.pi * t / t[-1]) ** 2 * np.sin(2.0 * np.pi * 1.1 * t)
    moving = [np.outer(one, share) for one in _derivatives(bump)]
    rocking = _derivatives(2e-3 * np.outer(bump, rng.normal(size=3)))
    force = np.outer(bump, rng.normal(0.0, 0.1, 3))
    base = BaseMotion(rocking[1], rocking[2], force)
    ideal = readings_on(chain, body_motions(chain, moving[0], moving[1], moving[2], base))
    gyro, accel = read(errors, *ideal, None)
    gyro, accel = gyro + rng.normal(0.0, GYRO, gyro.shape), accel + rng.normal(0.0, ACCEL, accel.shape)
    q = np.round(moving[0] / STEP_RAD) * STEP_RAD
    return Window(np.arange(SAMPLES) * STEP_NS, q, np.zeros_like(q), gyro, accel, np.full(count, STEP_RAD))


def _derivatives(signal: Array) -> tuple[Array, Array, Array]:
    first = np.gradient(signal, 1.0 / RATE_HZ, axis=0, edge_order=2)
    return signal, first, np.gradient(first, 1.0 / RATE_HZ, axis=0, edge_order=2)


@cache
def _fit(joints: int) -> _Fit:
    """The processor time of a whole refinement, and how far off its lengths are, rms, against their claim."""
    chain, types = _robot(joints)
    rng = np.random.default_rng(joints)
    errors = ImuIntrinsics(rng.normal(size=(joints, len(UNCALIBRATED.sigmas))) * UNCALIBRATED.sigmas)
    errors.errors[:, 24] = 0.0
    windows = [_window(chain, joint, errors) for joint in range(joints)]
    noise = np.broadcast_to(np.array([GYRO, ACCEL])[:, None, None], (2, joints, joints))
    floor = NoiseFloor(np.full(3, GYRO**2), np.full(3, ACCEL**2), REFINEMENT_CUTOFF_HZ)
    off = rng.normal(0.0, 0.01, (joints, 6))
    off[:, 3:] += np.cross(chain.imu_home[:, :3, 3], off[:, :3])
    off[0] = 0.0
    start = apply_perturbation(chain, off.ravel())
    begun = time.process_time()
    refined, _ = refine_checked(start, types, windows, UNCALIBRATED, floor, None, noise)
    cpu_s = time.process_time() - begun
    true = true_lengths(chain)
    error = (refined.estimate.link_length_m - true)[1:]
    sigma = refined.estimate.link_length_sigma_m[1:]
    keep = max(KEEP_EVERY, -(-joints * joints * SAMPLES // MAX_IMU_SAMPLES))
    return _Fit(
        cpu_s,
        SAMPLES // keep,
        1e3 * float(np.sqrt(np.mean(error**2))),
        1e3 * float(np.sqrt(np.mean(sigma**2))),
    )


@pytest.fixture(autouse=True, scope="module")
def _compiled() -> None:
    """Machine code is loaded before anything is timed."""
    _fit.__wrapped__(2)


def true_lengths(chain: Chain) -> Array:
    """Lengths (n,) as `ChainEstimate.link_length_m` has them."""
    off = chain.imu_home[:, :3, 3] - chain.point[list(chain.parent)]
    axis = chain.axis[list(chain.parent)]
    return np.asarray(np.linalg.norm(np.cross(axis, off), axis=1))


@pytest.mark.parametrize("joints", BARS_S)
def test_time_of_the_refinement(joints: int) -> None:
    fit = _fit(joints)
    report(
        f"refinement of {joints} modules, {SAMPLES} samples a joint, CPU",
        fit.cpu_s,
        "s",
        at_most=BARS_S[joints],
        anchor=f"{fit.fitted} samples a joint fitted, lengths off by {fit.error_mm:.1f} mm, "
        f"claimed {fit.sigma_mm:.1f}",
    )


@pytest.mark.parametrize(
    ("name", "noise", "bar_s"), [("arm7", "poor", 4.0), ("snake16", "x5-uncalibrated", 15.0)]
)
def test_time_of_the_identification_of_a_recorded_session(name: str, noise: str, bar_s: float) -> None:
    settings = VirtualSettings(load_robot(name), PROFILES["lan"], 1, noise)
    recording = record_session(settings, Plan(dynamics=False))
    spent_s = min(_identification_s(recording) for _ in range(5))
    what = f"kinematics of {name}, {noise}, from a recorded session, CPU"
    report(what, spent_s, "s", at_most=bar_s)


def _identification_s(recording: Recording) -> float:
    begun = time.process_time()
    identify_kinematics(recording)
    return time.process_time() - begun


def test_exponent_of_the_refinement() -> None:
    sizes = np.log(list(BARS_S))
    times = np.log([_fit(joints).cpu_s for joints in BARS_S])
    between = ", ".join(
        f"{many} over {few} {exponent:.2f}"
        for (few, many), exponent in zip(pairwise(BARS_S), np.diff(times) / np.diff(sizes), strict=True)
    )
    what = f"refinement, exponent of the time from {min(BARS_S)} to {max(BARS_S)} modules"
    report(what, float(np.polyfit(sizes, times, 1)[0]), at_most=2.0, anchor=f"between neighbours {between}")
    steepest = float((np.diff(times) / np.diff(sizes)).max())
    report("the same, the steepest between neighbours", steepest, at_most=2.0)
