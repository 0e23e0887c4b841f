"""Arrays that cannot be written to: results are shared, and a caller that changes one changes it for all."""

from collections.abc import Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Scalar = TypeVar("Scalar", bound=np.generic)


def read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Make an array read-only, and return it."""
    array.flags.writeable = False
    return array


def make_read_only(values: Iterable[object]) -> None:
    """Make all arrays among some values read-only."""
    for value in values:
        if isinstance(value, np.ndarray):
            value.flags.writeable = False


def frozen(values: ArrayLike) -> NDArray[np.float64]:
    """Return a read-only copy in double precision."""
    return read_only(np.array(values, dtype=np.float64))
