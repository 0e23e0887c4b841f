"""Refinement of the modules' clocks from motion: gyros against the rates of the joints that turn them.

Round trips leave an error of half the difference between the ways there and back. The gyro of an IMU that a
joint carries lags the encoder's rate by the IMU's delay and by the difference of the two clocks' errors. All
lags enter one weighted least squares for all clocks and the IMUs' delay, with the round trips as prior;
clocks without a common motion keep their maps and covariance.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.imu_prediction import turned
from coordinator.synchronisation.motion_windows import RATE_HZ, Window
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import DELAY_RMS_S, DELAY_SPREAD_S, GYRO_BIAS_SIGMA_RAD_S
from module_agent.model.perturbation import cross
from module_agent.model.read_only import frozen
from module_agent.signals.autocorrelation import samples_per_independent
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import CLOCK_CUTOFF_HZ, filtered_signals

# Half the time constant of the low-pass: about the number of independent samples.
KEEP_EVERY = 5
# Error of a single lag that is not due to clocks: a gyro's sensitivity to acceleration (0.1 deg/s/g at 0.3 m)
# or a compliant link. Those of other motions and IMUs are independent of it.
LAG_FLOOR_S = 8e-5
# Scale and axes of the gyros and the chain's own axes together; then the gyros' noise.
AXES, FIRST_RAD_S = 0.05, 1e-3
# A gyro whose readings deviate from the joints' rates by more than this share is not used.
MAX_OFF = 0.3
# Rates below this are rest; rounding of 16 bit readings [rad/s].
STILL_RAD_S, FINEST_RAD_S = 0.02, 3e-4
# Sigma of the base clock, exact by definition.
EXACT = 1e-12
# One second of residuals (every fifth sample at 250 Hz).
_MAX_LAG = 50


class ClockRefinement(NamedTuple):
    """Refined maps of n clocks.

    covariance: (2 n, 2 n), read-only, of [offsets [s] at the maps' origins, drifts], all against the clock
    that is the base; zero for that. imu_delay_s: mean delay of the IMUs' readings. lags: number of pairs of
    an IMU and a motion that were used.
    """

    clocks: dict[str, ClockMap]
    covariance: Array
    imu_delay_s: float
    imu_delay_sigma_s: float
    lags: int


# Normal equations of [clock errors of all modules (n), the observer's lag] about one lag: matrix, right side.
_Normal = tuple[Array, Array]


def refine_clocks(chain: Chain, clocks: Mapping[str, ClockMap], motions: Sequence[Window]) -> ClockRefinement:
    """Refine the clocks by which `motions` were put on one time base.

    Clock errors up to some milliseconds; the chain's axes may be off by some degrees, and the gyros' scales
    and axes by some percent.

    Args:
        chain: n modules.
        clocks: maps of these modules by round trips; the one without drift is the base, and stays.
        motions: windows of n modules in the order of the chain, one or several joints moving.
    """
    serials = chain.serials
    n = len(serials)
    before = _before([clocks[s] for s in serials])
    origins = np.array([int(clocks[s].to_session(np.array([clocks[s].origin_ns]))[0]) for s in serials])
    # In units of the prior sigmas, which span many orders of magnitude.
    information, rhs, lags = np.eye(3 * n + 1), np.zeros(3 * n + 1), 0
    for motion in motions:
        since_s = 1e-9 * (int(motion.t_ns.mean()) - origins).astype(np.float64)
        for imu, (of_lag, target) in _lags(chain, motion):
            onto = _onto(n, imu, since_s) * before
            information += onto.T @ of_lag @ onto
            rhs += onto.T @ target
            lags += 1
    covariance = np.linalg.inv(information) * np.outer(before, before)
    estimate = covariance @ (rhs / before)
    # The clock to which the others are mapped: the one without drift.
    base = min(range(n), key=lambda k: (abs(clocks[serials[k]].drift), clocks[serials[k]].drift_sigma))
    against = np.eye(2 * n)
    against[:n, base] -= 1.0
    against[:n, n + base] -= 1e-9 * (origins - origins[base])
    against[n:, n + base] -= 1.0
    errors = against @ estimate[: 2 * n]
    spread = against @ covariance[: 2 * n, : 2 * n] @ against.T
    spread[[base, n + base]] = spread[:, [base, n + base]] = 0.0
    sigmas = np.sqrt(np.diagonal(spread))
    refined = {
        s: clocks[s]
        .corrected(1e9 * float(errors[k]), float(errors[n + k]))
        ._replace(sigma_ns=1e9 * float(sigmas[k]), drift_sigma=float(sigmas[n + k]))
        for k, s in enumerate(serials)
    }
    return ClockRefinement(
        refined, frozen(spread), float(estimate[2 * n]), float(np.sqrt(covariance[2 * n, 2 * n])), lags
    )


def _before(clocks: Sequence[ClockMap]) -> Array:
    """Return the prior sigmas of [offset errors, drift errors, common delay, its spread]."""
    offsets = [max(1e-9 * clock.sigma_ns, EXACT) for clock in clocks]
    drifts = [max(clock.drift_sigma, EXACT) for clock in clocks]
    return np.array([*offsets, *drifts, DELAY_RMS_S, *[DELAY_SPREAD_S] * len(clocks)])


def _onto(n: int, imu: int, since_s: Array) -> Array:
    """Return the slopes (n + 1, 3 n + 1) of clock errors at a time, and of the observer's lag."""
    slopes = np.zeros((n + 1, 3 * n + 1))
    modules = np.arange(n)
    slopes[modules, modules] = 1.0
    slopes[modules, n + modules] = since_s
    # The observer's readings are stamped by its clock, and late by its delay.
    slopes[n] = slopes[imu]
    slopes[n, [2 * n, 2 * n + 1 + imu]] = 1.0
    return slopes


def _lags(chain: Chain, motion: Window) -> list[tuple[int, _Normal]]:
    """Return the normal equations of the lag of every IMU that was turned."""
    signals = filtered_signals(motion.q_rad, [motion.gyro_rad_s], RATE_HZ, CLOCK_CUTOFF_HZ, KEEP_EVERY)
    *joints, gyro = signals.settled()
    lags = [(imu, _lag(chain, imu, joints, gyro[:, imu])) for imu in range(len(chain.serials))]
    return [(imu, lag) for imu, lag in lags if lag is not None]


def _lag(chain: Chain, imu: int, joints: Sequence[Array], gyro: Array) -> _Normal | None:
    """Return the normal equations of one IMU's lag behind the joints that turn it; None if it hardly turns.

    gyro = b + (I + E) rate + sum over the joints of slopes_j (e_j - lag), where slopes_j is how the rate
    changes with time by joint j alone; b and E, known to be small, are taken out.
    """
    turns = _turns(chain, imu, *joints)
    if turns is None:
        return None
    rate, path, slopes = turns
    if float(np.sqrt(np.mean(np.sum(rate**2, axis=1)))) < STILL_RAD_S:
        return None
    count = len(chain.serials)
    columns = np.zeros((count + 1, *rate.shape))
    columns[path] = slopes
    columns[count] = -slopes.sum(axis=0)
    nuisance = np.column_stack([np.full(len(rate), GYRO_BIAS_SIGMA_RAD_S), AXES * rate])
    variance = FIRST_RAD_S**2
    for _ in range(2):
        signals = np.concatenate([columns, [gyro - rate]])
        clean = signals - nuisance @ _shares(nuisance, variance, signals)
        common, rest = clean[count], clean[-1]
        power = float(np.vdot(columns[count], common))
        if power <= 0.0:
            return None
        left = rest - common * float(np.vdot(columns[count], rest)) / power
        # Per axis, as large as if the samples were independent.
        power_left = float(np.mean(left**2)) + FINEST_RAD_S**2 / 12.0
        variance = power_left * float(samples_per_independent(left, _MAX_LAG))
    off = nuisance[:, 1:] @ _shares(nuisance, variance, (gyro - rate)[None])[0, 1:] + left
    if np.vdot(off, off) > MAX_OFF**2 * np.vdot(rate, rate):
        return None
    flat = columns.reshape(count + 1, -1)
    normal = flat @ clean.reshape(count + 2, -1).T / variance
    information, rhs = normal[:, :-1], normal[:, -1]
    # The floor: an error of this lag alone, taken out.
    share = information[:, count] / (information[count, count] + LAG_FLOOR_S**-2)
    return information - np.outer(share, information[count]), rhs - share * rhs[count]


def _shares(nuisance: Array, variance: float, signals: Array) -> Array:
    """Return the shares (k, l, 3) of the nuisance (m, l) in signals (k, m, 3), axis by axis.

    The shares have a standard deviation of one before, so that no small part of the nuisance explains much:
    (N^T N + variance I)^-1 N^T x.
    """
    inner = nuisance.T @ nuisance + variance * np.eye(nuisance.shape[1])
    return np.asarray(np.linalg.solve(inner, nuisance.T @ signals))


def _turns(chain: Chain, imu: int, q: Array, qd: Array, qdd: Array) -> tuple[Array, list[int], Array] | None:
    """Return the rate (m, 3) of an IMU from the joints, these joints, and their slopes (j, m, 3)."""
    path = list(chain.ancestors(chain.carrier(imu)))
    if not path:
        return None
    samples = len(q)
    axes = np.zeros((3, 0, samples))
    for joint in path:
        carried = turned(chain.axis[joint], -q[:, joint], axes) if axes.shape[1] else axes
        own = np.broadcast_to(chain.axis[joint][:, None, None], (3, 1, samples))
        axes = np.concatenate([carried, own], axis=1)
    parts = axes * qd[:, path].T
    below = np.cumsum(parts, axis=1) - parts
    turning = np.swapaxes(cross(np.swapaxes(below, 0, 1), np.swapaxes(axes, 0, 1)), 0, 1)
    slopes = axes * qdd[:, path].T + turning * qd[:, path].T
    turn = chain.imu_home[imu, :3, :3]
    return (parts.sum(axis=1).T @ turn), path, np.einsum("ijm,ik->jmk", slopes, turn)
