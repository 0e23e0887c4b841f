"""Which joint carries which IMU, and circles, from one motion of all joints at once (thesis 7.2).

Joints that turn at different frequencies are separated by regression. The gyro of IMU k reads

    w_k = sum_i j_ik dq_i/dt + b       over the joints i that carry it, j_ik the axis of joint i in its frame,

and its accelerometer, less gravity as the gyro says that it turned,

    f_k - g_k = sum_i (j_ik x r_ik) d2q_i/dt2 + ...,

so that r_ik = (j_ik x r_ik) x j_ik is the radial vector of the circle that joint i makes it describe (thesis
eqs 15 to 24 for all joints together). The joints between turn the axes in the IMU's frame by as much as they
move: the regression includes that to first order; terms of second order are left to the refinement.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from coordinator.kinematics.chain_observations import PairObservation
from coordinator.topology.topology import MotionObservation
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.read_only import frozen

MOVED_ABOVE = 0.5
# What is left of taking the axes as constant, per square of the joints' swing [1 / rad^2]: joints between
# that turn by s shorten what is across them by s^2 / 2, so that an axis at 45 degrees to theirs tilts by
# s^2 / 4.
TILT_PER_SWING2 = 0.25
# What is left in a radius of the other joints' motion: a share of the longest radius that the IMU turns at,
# and the least of it. On random robots of six joints with links of 0.3 m it is 6 cm rms of up to 1 m.
CROSSTALK_SHARE = 0.15
RADIUS_FLOOR_M = 0.01
# The motion of a joint that turns less than this (rms) is lost in the gyros' errors of some mrad/s.
MIN_RATE_RAD_S = 0.005


class SimultaneousMotion(NamedTuple):
    """Uniform samples of n joints (m, n) and their IMUs (m, n, 3), in their frames, through one low-pass."""

    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    gyro_rad_s: Array
    accel_m_s2: Array


class StillReading(NamedTuple):
    """Means of all IMUs at rest, where the motion begins: rates and specific forces (n, 3)."""

    gyro_rad_s: Array
    force_m_s2: Array


class SimultaneousResponse(NamedTuple):
    """The response of IMU k to joint i: arrays (n joints, n IMUs, ...), in the IMU's frame, read-only.

    axis: (n, n, 3) of the gyro to the joint's rate: the axis if it is carried, else about zero.
    tangential_m: (n, n, 3) of the specific force to the joint's acceleration, j x r.
    sigma_axis, sigma_tangential_m: (n, n) one standard deviation of each component, from the scatter.
    swing2_rad2: (n,) mean square of the joints' motion about its mean. q_mean_rad: (n,).
    """

    axis: Array
    tangential_m: Array
    sigma_axis: Array
    sigma_tangential_m: Array
    swing2_rad2: Array
    q_mean_rad: Array

    def moved(self, joint: int, observer: int) -> bool:
        """Return whether the observer's IMU is carried by the joint."""
        return float(np.linalg.norm(self.axis[joint, observer])) > MOVED_ABOVE


def simultaneous_response(
    serials: Sequence[str],
    data: SimultaneousMotion,
    still: StillReading,
    rate_hz: float,
    bandwidth_hz: float,
) -> SimultaneousResponse:
    """Regress all IMUs on the motion of all joints.

    Args:
        serials: of the modules, as the columns.
        data: samples at `rate_hz` that begin where `still` was read.
        still: the IMUs at rest.
        rate_hz: of the samples.
        bandwidth_hz: of their low-pass; there are 2 bandwidth / rate as many independent samples.

    Raises:
        DataError: a joint hardly turned, or two joints cannot be told apart; they are named. Or all modules
            have too few samples at the same times.
    """
    samples, count = data.q_rad.shape
    # More than the unknowns of each regression, which are as many as pairs of joints, and some.
    if samples < (needed := 2 * (count + 1) ** 2):
        raise DataError(
            f"all modules together have {samples} samples of the motion of all joints, at least {needed} are "
            "needed: a clock is wrong, or rows are missing"
        )
    _check_told_apart(serials, data.qd_rad_s)
    independent = min(1.0, 2.0 * bandwidth_hz / rate_hz)
    gyro = data.gyro_rad_s - still.gyro_rad_s
    q, qd, one = data.q_rad, data.qd_rad_s, np.ones(samples)
    swing = q - q.mean(axis=0)
    # A joint's place times another's rate: the one tilts the other's axis.
    place, rate = np.nonzero(~np.eye(count, dtype=bool))
    terms = np.column_stack([qd, one, swing[:, place] * qd[:, rate]])
    axis, sigma_axis = _regressed(terms, gyro, independent)
    force = data.accel_m_s2 - _gravity(gyro, still.force_m_s2, rate_hz)
    # Products of two rates: what centripetal and Coriolis accelerations are made of.
    first, second = np.triu_indices(count)
    terms = np.column_stack([data.qdd_rad_s2, swing, one, qd[:, first] * qd[:, second]])
    tangential, sigma_tangential = _regressed(terms, force, independent)
    own = (part[:count] for part in (axis, tangential, sigma_axis, sigma_tangential))
    return SimultaneousResponse(*map(frozen, (*own, np.mean(swing**2, axis=0), q.mean(axis=0))))


def motion_observations(
    serials: Sequence[str], response: SimultaneousResponse
) -> dict[tuple[str, str], MotionObservation]:
    """Return {(joint, observer): MotionObservation}; the columns are named by `serials`."""
    seen: dict[tuple[str, str], MotionObservation] = {}
    for (i, joint), (k, observer) in product(enumerate(serials), repeat=2):
        size, moved = float(np.linalg.norm(response.axis[i, k])), response.moved(i, k)
        axis = response.axis[i, k] / size if moved else None
        seen[joint, observer] = MotionObservation(moved, size, axis)
    return seen


def circle_observations(serials: Sequence[str], response: SimultaneousResponse) -> list[PairObservation]:
    """Return the circle of every joint in every other IMU that it carries; `serials` name the columns."""
    tilt = TILT_PER_SWING2 * float(response.swing2_rad2.sum())
    pairs = []
    for i, k in product(range(len(serials)), repeat=2):
        if i == k or not response.moved(i, k):
            continue
        axis = response.axis[i, k] / np.linalg.norm(response.axis[i, k])
        movers = [j for j in range(len(serials)) if response.moved(j, k)]
        longest = max(float(np.linalg.norm(response.tangential_m[j, k])) for j in movers)
        floor = np.hypot(RADIUS_FLOOR_M, CROSSTALK_SHARE * longest)
        pairs.append(
            PairObservation(
                serials[i],
                serials[k],
                axis,
                np.cross(response.tangential_m[i, k], axis),
                float(np.hypot(response.sigma_axis[i, k], tilt)),
                float(np.hypot(response.sigma_tangential_m[i, k], floor)),
                response.q_mean_rad,
            )
        )
    return pairs


def _check_told_apart(serials: Sequence[str], qd_rad_s: Array) -> None:
    size = np.sqrt(np.mean(qd_rad_s**2, axis=0))
    if size.min() < MIN_RATE_RAD_S:
        raise DataError(
            f"joint {serials[int(size.argmin())]} turned at only {size.min():.2g} rad/s rms while all moved, "
            f"{MIN_RATE_RAD_S} are needed: its motor is dead, or something held it"
        )
    alike = np.abs(qd_rad_s.T @ qd_rad_s) / len(qd_rad_s) / np.outer(size, size) - np.eye(len(size))
    if alike.max() > 0.9:
        i, k = (int(index) for index in np.unravel_index(int(alike.argmax()), alike.shape))
        raise DataError(
            f"joints {serials[i]} and {serials[k]} moved alike (correlation {alike.max():.2f}): give them "
            "frequencies of their own"
        )


def _regressed(terms: Array, signals: Array, independent: float) -> tuple[Array, Array]:
    """Return coefficients (p, n, 3) of signals (m, n, 3) on terms (m, p), and their sigmas (p, n)."""
    samples, count, _ = signals.shape
    scale = np.maximum(np.sqrt(np.mean(terms**2, axis=0)), np.finfo(float).tiny)
    terms, flat = terms / scale, signals.reshape(samples, -1)
    solution, *_ = np.linalg.lstsq(terms, flat, rcond=1e-10)
    residual = (flat - terms @ solution).reshape(samples, count, 3)
    scatter = np.sqrt(np.mean(residual**2, axis=(0, 2)) / independent)
    spread = np.sqrt(np.diag(np.linalg.pinv(terms.T @ terms)))
    coefficients = (solution / scale[:, None]).reshape(len(scale), count, 3)
    return coefficients, np.outer(spread / scale, scatter)


def _gravity(gyro_rad_s: Array, force_m_s2: Array, rate_hz: float) -> Array:
    """Return the specific force of rest (m, n, 3) as every IMU sees it after what its gyro has turned."""
    samples, count, _ = gyro_rad_s.shape
    between = 0.5 * (gyro_rad_s[1:] + gyro_rad_s[:-1]) / rate_hz
    steps = Rotation.from_rotvec(-between.reshape(-1, 3)).as_matrix().reshape(samples - 1, count, 3, 3)
    gravity = np.empty((samples, count, 3))
    gravity[0] = force_m_s2
    for row, step in enumerate(steps):
        gravity[row + 1] = np.einsum("nij,nj->ni", step, gravity[row])
    return gravity
