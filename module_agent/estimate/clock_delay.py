"""Estimate the offset between two modules' clocks from one motion: gyro against encoder rate.

Round trips bound the offset to tens of milliseconds; the motion itself gives it to tens of microseconds. The
gyro of a carried module reads gyro(t) = b + c v(t - delay) with v the joint's rate and c, b constant
3-vectors, so no axis has to be known. A grid finds the basin, Gauss-Newton on (b, c, delay) the minimum.
"""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from module_agent.estimate.gaussian_filter import SIGMA_SAMPLES, TAPS, gaussian_filter
from module_agent.estimate.windows import Array, ImuWindow, JointWindow
from module_agent.model.errors import DataError

SEARCH_S = 0.08  # round trips are off by up to 60 ms, and the optimum must lie inside the grid
GRID_S = 0.004
STEPS = 8
# Below this the gyro does not follow the joint, and the best delay is meaningless. The reaction motion of a
# held joint follows it well and is accepted here: `motion_detection` rejects it by its size.
MIN_EXPLAINED = 0.25


class ClockDelay(NamedTuple):
    """How the joint's clock maps to the IMU's: t_imu = t_joint + offset_ns.

    delay_s: offset minus the rough offset it was started from.
    sigma_s: one standard deviation; infinite if undetermined.
    explained: fraction of the gyro's variance that the joint's rate explains, 0..1.
    determined: whether the gyro follows the joint; if not, the offset is the rough one.
    """

    offset_ns: int
    delay_s: float
    sigma_s: float
    explained: float
    determined: bool


def clock_delay(imu: ImuWindow, joint: JointWindow, rough_offset_ns: int) -> ClockDelay:
    """Refine the offset between the joint's clock and the IMU's from one motion.

    Both windows should hold the whole motion and a little rest about it. The offset is taken as constant: 100
    ppm over 5 s are 0.5 ms from end to end, and the estimate is the mean.

    Raises:
        DataError: fewer than 3 filter lengths of samples, or windows that do not overlap by as much.
    """
    if joint.t_ns.size < 3 * TAPS:
        raise DataError(f"{joint.t_ns.size} joint samples; {3 * TAPS} are needed to find a clock's delay")
    knots = 1e-9 * (joint.t_ns - int(joint.t_ns[0]))
    end_s = float(knots[-1])
    # Smoothed as the gyro is: its noise would prefer delays between samples, where interpolation averages it.
    rate = CubicSpline(knots, gaussian_filter(joint.velocity_rad_s))
    t_s = 1e-9 * (imu.t_ns - rough_offset_ns - int(joint.t_ns[0]))
    inside = (t_s >= SEARCH_S) & (t_s <= end_s - SEARCH_S)
    if np.count_nonzero(inside) < 3 * TAPS:
        raise DataError(
            f"only {np.count_nonzero(inside)} IMU samples lie {SEARCH_S} s inside the joint's window of "
            f"{end_s:.2f} s; {3 * TAPS} are needed"
        )
    gyro: Array = gaussian_filter(imu.gyro_rad_s)[inside]
    at: Array = t_s[inside].astype(np.float64)
    grid = np.arange(-SEARCH_S, SEARCH_S + 0.5 * GRID_S, GRID_S)
    scores = np.array([_explained(gyro, rate(at - delay)) for delay in grid])
    delay, sigma = _refine(gyro, at, rate, float(grid[np.argmax(scores)]))
    delay = min(max(delay, -SEARCH_S), SEARCH_S)
    explained = _explained(gyro, rate(at - delay))
    if explained < MIN_EXPLAINED:
        return ClockDelay(rough_offset_ns, 0.0, float("inf"), explained, determined=False)
    return ClockDelay(rough_offset_ns + round(1e9 * delay), delay, sigma, explained, determined=True)


def _explained(gyro: Array, rate: Array) -> float:
    """Return the fraction of the gyro's variance, over all three axes, that is linear in the rate."""
    g = gyro - gyro.mean(axis=0)
    v = rate - rate.mean()
    total, power = float((g * g).sum()), float(v @ v)
    if total <= 0.0 or power <= 0.0:
        return 0.0
    return float(((v @ g) ** 2).sum()) / (total * power)


def _refine(gyro: Array, at_s: Array, spline: CubicSpline, delay_s: float) -> tuple[float, float]:
    """Least squares of gyro = b + c v(t - delay) by variable projection; returns the delay and its sigma."""
    sigma = float("inf")
    slope = spline.derivative()
    for _ in range(STEPS):
        v, dv = spline(at_s - delay_s), -slope(at_s - delay_s)
        v, dv = v - v.mean(), dv - dv.mean()
        power = float(v @ v)
        if power <= 0.0:
            return delay_s, float("inf")
        g = gyro - gyro.mean(axis=0)
        c = v @ g / power
        free = dv - v * (v @ dv) / power  # the slope without its share of the amplitude
        information = float(c @ c) * float(free @ free)
        if information <= 0.0:
            return delay_s, float("inf")
        residual = g - np.outer(v, c)
        # One step never goes farther than the grid cell that the search has chosen.
        delay_s += float(np.clip(free @ residual @ c / information, -GRID_S, GRID_S))
        # The filter correlates neighbours: about 10 samples (2 sqrt(pi) sigma) carry the information of one.
        # Only what lies along c counts; there the noise of the joint's rate comes on top of the gyro's.
        variance = float(((residual @ c) ** 2).mean() / (c @ c)) * 2 * np.sqrt(np.pi) * SIGMA_SAMPLES
        sigma = float(np.sqrt(variance / information))
    return delay_s, sigma
