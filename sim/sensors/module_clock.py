"""A module's own clock: it started some time before the world did and runs a little fast or slow.

All in integers, so that a time is the same on every machine and after any number of days.
"""

from typing import NamedTuple

import numpy as np

from sim.imperfections.noise_profile import NoiseProfile


class ModuleClock(NamedTuple):
    """A clock that reads `offset_ns` at world time 0 and gains `drift_ppb` nanoseconds per second."""

    offset_ns: int
    drift_ppb: int


def module_time(clock: ModuleClock, world_ns: int) -> int:
    """Return what the clock reads at a world time [ns]."""
    return clock.offset_ns + world_ns + world_ns * clock.drift_ppb // 1_000_000_000


def draw_clock(rng: np.random.Generator, noise: NoiseProfile) -> ModuleClock:
    """Draw a clock: offset uniform within the profile's bounds, drift normal."""
    offset_s = rng.uniform(noise.clock_offset_min_s, noise.clock_offset_max_s)
    return ModuleClock(round(offset_s * 1e9), round(rng.normal() * noise.clock_drift_ppm * 1e3))
