"""The efforts that a motion is fed forward: as bytes on the wire, and at the ticks of a module."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from module_agent.wire.messages import EffortProfile
from module_agent.wire.refusal import Refusal, WireError

SAMPLE = np.dtype("<f4")
# What `EffortProfile` takes.
MOST_SAMPLES = 800
LEAST_PERIOD_NS = 1_000_000
# A motion of a few hertz is then interpolated to better than 0.2 %: (2 pi f h)^2 / 8 at 2 Hz.
USUAL_PERIOD_NS = 10_000_000


def profile_period_ns(total_s: float) -> int:
    """Return how far apart the samples of a motion are: 10 ms, more for a motion over 8 s."""
    fitting_ns = -(-round(total_s * 1e9) // (MOST_SAMPLES - 1))
    # Whole milliseconds, which are a module's ticks.
    return max(USUAL_PERIOD_NS, -(-fitting_ns // LEAST_PERIOD_NS) * LEAST_PERIOD_NS)


def effort_profile(effort_nm: ArrayLike, period_ns: int) -> EffortProfile:
    """Return the efforts (k,) at 0, 1, 2 ... periods of a motion as a module takes them.

    Raises:
        ValueError: not 2 to 800 finite numbers in a row, or a period outside 1 ms to 1 s.
    """
    values = np.asarray(effort_nm, dtype=float)
    if values.ndim != 1 or not 2 <= values.size <= MOST_SAMPLES or not np.isfinite(values).all():
        raise ValueError(
            f"efforts of shape {values.shape}; a profile is 2 to {MOST_SAMPLES} finite numbers in a row"
        )
    return EffortProfile(period_ns=period_ns, samples=values.astype(SAMPLE).tobytes())


def effort_at(profile: EffortProfile, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the efforts (m,) [Nm] at times (m,) since the start of the motion.

    Raises:
        WireError: TYPES, the block is no whole number of samples; NOT_FINITE, one of them is no number.
    """
    if len(profile.samples) % SAMPLE.itemsize:
        raise WireError(
            Refusal.TYPES,
            f"an effort profile of {len(profile.samples)} bytes; a sample is {SAMPLE.itemsize} bytes long",
        )
    values = np.frombuffer(profile.samples, dtype=SAMPLE).astype(float)
    if not np.isfinite(values).all():
        place = int(np.argmin(np.isfinite(values)))
        raise WireError(Refusal.NOT_FINITE, f"sample {place} of the effort profile is {values[place]}")
    found: NDArray[np.float64] = np.interp(t_s, np.arange(values.size) * (profile.period_ns * 1e-9), values)
    return found
