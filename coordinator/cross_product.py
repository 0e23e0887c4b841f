"""The cross product of many vectors at once, samples in the last axis."""

import numpy as np

from module_agent.dynamics.chain import Array


def cross(a: Array, b: Array) -> Array:
    """Return a x b (..., 3, m) along the last axis but one, broadcasting.

    Several times faster than `np.cross`, which moves its axes about.
    """
    ax, ay, az = a[..., 0, :], a[..., 1, :], a[..., 2, :]
    bx, by, bz = b[..., 0, :], b[..., 1, :], b[..., 2, :]
    first = ay * bz
    found = np.empty((*first.shape[:-1], 3, first.shape[-1]))
    np.subtract(first, az * by, out=found[..., 0, :])
    np.subtract(az * bx, ax * bz, out=found[..., 1, :])
    np.subtract(ax * by, ay * bx, out=found[..., 2, :])
    return found
