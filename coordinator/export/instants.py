"""All modules at common instants: every signal interpolated linearly between two samples of its module.

A sample farther than `HOLE_S` from the next one begins a hole: what lies in it is NaN, as is what lies before
a module's first sample or after its last. The IMU's signals are interpolated over their own times.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.synchronisation.signals import Signals
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError

# Rows are 4 ms apart, at most 20; linear interpolation across more than this would invent motion.
HOLE_S = 0.1
MAX_RATE_HZ = 10_000.0
_IMU = ("gyro_rad_s", "accel_m_s2")
# Numbers that count or name something hold their last value.
_HELD = ("motion_id", "state")


class Instants(NamedTuple):
    """Signals of all modules at the same m instants, `t_s` (m,)."""

    t_s: Array
    signals: Mapping[str, Signals]


def at_instants(signals: Mapping[str, Signals], rate_hz: float) -> Instants:
    """Return all modules' signals at common instants, from the first to the last sample of any module.

    Raises:
        UsageError: the rate is not positive, above `MAX_RATE_HZ`, or too low for any instant to be recorded.
    """
    if not 0.0 < rate_hz <= MAX_RATE_HZ:
        raise UsageError(f"{rate_hz} instants per second: between 0 and {MAX_RATE_HZ:g} are needed")
    # Whole multiples of the period, so that runs and modules share the instants.
    first = np.ceil(min(each.t_s[0] for each in signals.values()) * rate_hz)
    last = np.floor(max(each.t_s[-1] for each in signals.values()) * rate_hz)
    if last < first:
        raise UsageError(f"{rate_hz:g} instants per second: the recording is too short to have one of them")
    t_s = np.arange(first, last + 1.0) / rate_hz
    return Instants(t_s, {serial: _interpolated(each, t_s) for serial, each in signals.items()})


def _interpolated(signals: Signals, t_s: Array) -> Signals:
    fields: dict[str, NDArray[Any]] = {}
    for name, values in zip(signals._fields, signals, strict=True):
        if name in ("t_s", "imu_t_s"):
            fields[name] = t_s
        elif name in _HELD:
            last = np.searchsorted(signals.t_s, t_s, side="right") - 1
            fields[name] = np.where(last >= 0, values[np.maximum(last, 0)], 0)
        else:
            fields[name] = _linear(signals.imu_t_s if name in _IMU else signals.t_s, values, t_s)
    return Signals(**fields)


def _linear(sampled_s: Array, values: Array, t_s: Array) -> Array:
    """Return values (m,) or (m, 3) at other times, NaN outside of them and in holes."""
    if len(sampled_s) < 2:
        return np.full((len(t_s), *values.shape[1:]), np.nan)
    after = np.clip(np.searchsorted(sampled_s, t_s), 1, len(sampled_s) - 1)
    span = sampled_s[after] - sampled_s[after - 1]
    # An IMU that was not read anew repeats its time.
    share = (t_s - sampled_s[after - 1]) / np.where(span > 0.0, span, 1.0)
    at_a_sample = (share == 0.0) | (share == 1.0)
    known = (share >= 0.0) & (share <= 1.0) & ((span <= HOLE_S) | at_a_sample)
    columns = (slice(None), *(None for _ in values.shape[1:]))
    between = values[after - 1] + share[columns] * (values[after] - values[after - 1])
    return np.where(known[columns], between, np.nan)
