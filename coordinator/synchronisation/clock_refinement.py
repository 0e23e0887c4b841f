"""The modules' clocks refined from the motion itself: gyros against the rates of the joints that turn them.

Round trips leave the clocks of two modules apart by what the ways there and back differ. Where an IMU rides
on a joint, both have seen the same motion: the gyro lags the encoder's rate by the IMU's own delay and by the
error of the one clock less that of the other. All lags of all motions go into one weighted least squares for
offset and drift of every clock and for the IMUs' delay, with the round trips as what is known before; clocks
that no common motion ties keep their round trips, and the covariance says so.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from coordinator.batch_estimation.imu_prediction import turned
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import DELAY_RMS_S, DELAY_SPREAD_S, GYRO_BIAS_SIGMA_RAD_S
from module_agent.model.perturbation import cross
from module_agent.model.read_only import frozen
from module_agent.signals.autocorrelation import samples_per_independent
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import CLOCK_CUTOFF_HZ, filtered_signals

RATE_HZ = 250.0
# Half the time constant of that low-pass: about as many samples as are independent.
KEEP_EVERY = 5
# What shifts a single lag without any clock: a gyro that feels acceleration (0.1 deg/s/g on 0.3 m), a link
# that gives. Lags of other motions and IMUs are shifted otherwise.
LAG_FLOOR_S = 8e-5
# Scale and axes of the gyros and the chain's own axes together; then the gyros' noise.
AXES, FIRST_RAD_S = 0.05, 1e-3
# A gyro that reads otherwise than the joints that carry it, by this share, tells nothing of clocks.
MAX_OFF = 0.3
# An angular rate that no sensor resolves, and the rounding of 16 bit readings [rad/s].
STILL_RAD_S, FINEST_RAD_S = 0.02, 3e-4
# A base clock runs as it does by definition.
EXACT = 1e-12
# One second of residuals (every fifth sample at 250 Hz).
_MAX_LAG = 50


class Moved(Protocol):
    """One motion on one time base at `RATE_HZ`: `t_ns` (m,) session time, (m, n) joints, (m, n, 3) gyros."""

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Session time."""
        ...

    @property
    def q_rad(self) -> Array:
        """Positions of the joints."""
        ...

    @property
    def gyro_rad_s(self) -> Array:
        """Rates in the IMUs' frames."""
        ...


class ClockRefinement(NamedTuple):
    """Refined maps of n clocks.

    covariance: (2 n, 2 n), read-only, of [offsets [s] at the maps' origins, drifts], all against the clock
    that is the base; zero for that. imu_delay_s: how late the IMUs' readings are in the mean. lags: how many
    pairs of an IMU and a motion that turned it spoke.
    """

    clocks: dict[str, ClockMap]
    covariance: Array
    imu_delay_s: float
    imu_delay_sigma_s: float
    lags: int


class _Normal(NamedTuple):
    """Normal equations of [clock errors of all modules (n), the observer's lag] about one lag."""

    information: Array
    rhs: Array


def refine_clocks(chain: Chain, clocks: Mapping[str, ClockMap], motions: Sequence[Moved]) -> ClockRefinement:
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
    # In units of what is known before, which span many orders of magnitude.
    information, rhs, lags = np.eye(3 * n + 1), np.zeros(3 * n + 1), 0
    for motion in motions:
        since_s = 1e-9 * (int(motion.t_ns.mean()) - origins).astype(np.float64)
        for imu, lag in _lags(chain, motion):
            onto = _onto(n, imu, since_s) * before
            information += onto.T @ lag.information @ onto
            rhs += onto.T @ lag.rhs
            lags += 1
    covariance = np.linalg.inv(information) * np.outer(before, before)
    found = covariance @ (rhs / before)
    base = _base([clocks[s] for s in serials])
    against = np.eye(2 * n)
    against[:n, base] -= 1.0
    against[:n, n + base] -= 1e-9 * (origins - origins[base])
    against[n:, n + base] -= 1.0
    errors = against @ found[: 2 * n]
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
        refined, frozen(spread), float(found[2 * n]), float(np.sqrt(covariance[2 * n, 2 * n])), lags
    )


def _before(clocks: Sequence[ClockMap]) -> Array:
    """Return what is known before: sigmas of [offset errors, drift errors, common delay, its spread]."""
    offsets = [max(1e-9 * clock.sigma_ns, EXACT) for clock in clocks]
    drifts = [max(clock.drift_sigma, EXACT) for clock in clocks]
    return np.array([*offsets, *drifts, DELAY_RMS_S, *[DELAY_SPREAD_S] * len(clocks)])


def _base(clocks: Sequence[ClockMap]) -> int:
    """Return the clock that the others are mapped to: it has no drift, and no doubt about that."""
    return min(range(len(clocks)), key=lambda k: (abs(clocks[k].drift), clocks[k].drift_sigma))


def _onto(n: int, imu: int, since_s: Array) -> Array:
    """Return the slopes (n + 1, 3 n + 1) of clock errors at a time, and of the observer's lag."""
    found = np.zeros((n + 1, 3 * n + 1))
    modules = np.arange(n)
    found[modules, modules] = 1.0
    found[modules, n + modules] = since_s
    # The observer's readings are stamped by its clock, and late by its delay.
    found[n] = found[imu]
    found[n, [2 * n, 2 * n + 1 + imu]] = 1.0
    return found


def _lags(chain: Chain, motion: Moved) -> list[tuple[int, _Normal]]:
    """Return what every IMU that was turned says of its lag."""
    signals = filtered_signals(motion.q_rad, [motion.gyro_rad_s], RATE_HZ, CLOCK_CUTOFF_HZ, KEEP_EVERY)
    *joints, gyro = signals.settled()
    found = []
    for imu in range(len(chain.serials)):
        lag = _lag(chain, imu, tuple(joints), gyro[:, imu])
        if lag is not None:
            found.append((imu, lag))
    return found


def _lag(chain: Chain, imu: int, joints: tuple[Array, ...], gyro: Array) -> _Normal | None:
    """Return the normal equations of one IMU's lag behind the joints that turn it, None if they hardly do.

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
        clean = _without(nuisance, variance, np.concatenate([columns, [gyro - rate]]))
        common, rest = clean[count], clean[-1]
        power = float(np.vdot(columns[count], common))
        if power <= 0.0:
            return None
        left = rest - common * float(np.vdot(columns[count], rest)) / power
        variance = _variance(left)
    off = nuisance[:, 1:] @ _shares(nuisance, variance, (gyro - rate)[None])[0, 1:] + left
    if np.vdot(off, off) > MAX_OFF**2 * np.vdot(rate, rate):
        return None
    flat = columns.reshape(count + 1, -1)
    normal = flat @ clean.reshape(count + 2, -1).T / variance
    information, rhs = normal[:, :-1], normal[:, -1]
    # The floor: an error of this lag alone, taken out.
    share = information[:, count] / (information[count, count] + LAG_FLOOR_S**-2)
    return _Normal(information - np.outer(share, information[count]), rhs - share * rhs[count])


def _without(nuisance: Array, variance: float, signals: Array) -> Array:
    """Return signals (k, m, 3) without what each axis' own share of the nuisance (m, l) explains of them.

    The shares have a standard deviation of one before, so that no small part of the nuisance explains much:
    (I - N (N^T N + variance I)^-1 N^T) x.
    """
    return np.asarray(signals - nuisance @ _shares(nuisance, variance, signals))


def _shares(nuisance: Array, variance: float, signals: Array) -> Array:
    """Return the shares (k, l, 3) of the nuisance (m, l) in signals (k, m, 3)."""
    inner = nuisance.T @ nuisance + variance * np.eye(nuisance.shape[1])
    return np.asarray(np.linalg.solve(inner, nuisance.T @ signals))


def _variance(residual: Array) -> float:
    """Return the variance per axis of residuals (m, 3), as large as if its samples were independent."""
    size = float(np.mean(residual**2)) + FINEST_RAD_S**2 / 12.0
    return size * float(samples_per_independent(residual, _MAX_LAG))


def _turns(chain: Chain, imu: int, q: Array, qd: Array, qdd: Array) -> tuple[Array, list[int], Array] | None:
    """Return the rate (m, 3) of an IMU by the joints, who they are, and their slopes (j, m, 3)."""
    path = list(chain.ancestors(chain.carrier(imu)))
    if not path:
        return None
    samples = len(q)
    axes = np.zeros((3, 0, samples))
    for joint in path:
        seen = turned(chain.axis[joint], -q[:, joint], axes) if axes.shape[1] else axes
        own = np.broadcast_to(chain.axis[joint][:, None, None], (3, 1, samples))
        axes = np.concatenate([seen, own], axis=1)
    parts = axes * qd[:, path].T
    below = np.cumsum(parts, axis=1) - parts
    turning = np.swapaxes(cross(np.swapaxes(below, 0, 1), np.swapaxes(axes, 0, 1)), 0, 1)
    slopes = axes * qdd[:, path].T + turning * qd[:, path].T
    turn = chain.imu_home[imu, :3, :3]
    return (parts.sum(axis=1).T @ turn), path, np.einsum("ijm,ik->jmk", slopes, turn)
