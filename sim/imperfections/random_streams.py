"""Randomness of the simulated modules; every module and purpose has its own generator.

A generator is seeded by the world's seed and by serial and purpose, so adding a module, or drawing more of
one kind, changes no other draw.
"""

import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sim.geometry.pose import Array

BLOCK = 512


def generator(seed: int, serial: str, purpose: str) -> np.random.Generator:
    """Return the generator of one module's one purpose."""
    entropy = (seed, zlib.crc32(serial.encode()), zlib.crc32(purpose.encode()))
    return np.random.default_rng(np.random.SeedSequence(entropy))


class Draws(NamedTuple):
    """Standard normal numbers drawn in advance: a block (BLOCK, modules, columns), and the next row (1,)."""

    block: Array
    next: np.ndarray[Any, np.dtype[np.int64]]


class StandardNormals:
    """A row of independent standard normal numbers per module at a time, for one purpose.

    They are drawn in blocks: a call per module and tick costs 1 us each. Kernels take rows from `draws`,
    after `refill`.
    """

    def __init__(self, seed: int, serials: Sequence[str], purpose: str, columns: int):
        self._sources = [generator(seed, serial, purpose) for serial in serials]
        self.draws = Draws(np.zeros((BLOCK, len(serials), columns)), np.array([BLOCK]))

    def refill(self) -> None:
        """Draw the next block, if this one is used up."""
        block, at = self.draws
        if at[0] == BLOCK:
            for module, source in enumerate(self._sources):
                block[:, module] = source.standard_normal((BLOCK, block.shape[2]))
            at[0] = 0

    def draw(self) -> Array:
        """Return the next numbers, (modules, columns)."""
        self.refill()
        block, at = self.draws
        at[0] += 1
        row: Array = block[at[0] - 1].copy()
        return row
