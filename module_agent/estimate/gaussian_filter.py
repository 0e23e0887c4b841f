"""The thesis' smoothing filter (chapter 6.2.1.2): a zero-phase Gaussian, 11 taps, sigma 2.83 samples."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from module_agent.model.errors import DataError
from module_agent.model.read_only import read_only

TAPS = 11
SIGMA_SAMPLES = 2.83


def kernel(taps: int = TAPS, sigma_samples: float = SIGMA_SAMPLES) -> NDArray[np.float64]:
    """Return the weights, (taps,), which add up to one.

    Raises:
        ValueError: `taps` is not odd and positive (an even filter would delay by half a sample).
    """
    if taps < 1 or taps % 2 == 0:
        raise ValueError(f"{taps} taps: a zero-phase filter needs an odd, positive number")
    k = np.arange(taps) - taps // 2
    weights = np.exp(-0.5 * (k / sigma_samples) ** 2)
    return np.asarray(weights / weights.sum(), dtype=float)


def gaussian_filter(
    signal: ArrayLike, taps: int = TAPS, sigma_samples: float = SIGMA_SAMPLES
) -> NDArray[np.float64]:
    """Smooth (n,) or (n, k) along the first axis; the result is read-only.

    The edges are continued by point reflection about the end samples, which keeps constants and straight
    lines as they are to the very end; zero padding or shortened windows would bend them.

    Raises:
        ValueError: fewer samples than half the filter.
    """
    values = np.asarray(signal, dtype=float)
    weights = kernel(taps, sigma_samples)
    half = taps // 2
    if values.shape[0] <= half:
        raise DataError(f"{values.shape[0]} samples: a filter of {taps} taps needs at least {half + 1}")
    widths = [(half, half)] + [(0, 0)] * (values.ndim - 1)
    padded = np.pad(values, widths, mode="reflect", reflect_type="odd")
    windows = np.lib.stride_tricks.sliding_window_view(padded, taps, axis=0)
    return read_only(np.asarray(windows @ weights))
