"""Randomness of the simulated modules; every module and purpose has its own generator.

A generator is seeded by the world's seed and by serial and purpose, so adding a module, or drawing more of
one kind, changes no other draw.
"""

import zlib
from collections.abc import Sequence

import numpy as np

from sim.geometry.pose import Array

_BLOCK = 512


def generator(seed: int, serial: str, purpose: str) -> np.random.Generator:
    """Return the generator of one module's one purpose."""
    entropy = (seed, zlib.crc32(serial.encode()), zlib.crc32(purpose.encode()))
    return np.random.default_rng(np.random.SeedSequence(entropy))


class StandardNormals:
    """A row of independent standard normal numbers per module at a time, for one purpose.

    They are drawn in blocks: a call per module and tick costs 1 us each.
    """

    def __init__(self, seed: int, serials: Sequence[str], purpose: str, columns: int):
        self._sources = [generator(seed, serial, purpose) for serial in serials]
        self._columns = columns
        self._next = _BLOCK
        self._block = np.zeros((_BLOCK, len(serials), columns))

    def draw(self) -> Array:
        """Return the next numbers, (modules, columns)."""
        if self._next == _BLOCK:
            draws = [source.standard_normal((_BLOCK, self._columns)) for source in self._sources]
            self._block = np.stack(draws, axis=1)
            self._next = 0
        self._next += 1
        row: Array = self._block[self._next - 1]
        return row
