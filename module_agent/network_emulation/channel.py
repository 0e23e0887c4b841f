"""One direction of a network: random draws and recorded traces determine the fate of each message.

Messages of one key stay in order: each waits for its own time and for those before it, as on a TCP link.
"""

from collections import deque
from collections.abc import Callable, Iterator
from math import log, log1p, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.network_emulation.profile import Burst, PathProfile

# Scalar draws cost several times more than their share of a block.
_BLOCK = 256


class Fate(NamedTuple):
    """What happens to one message; `copy_delay_s` is that of its duplicate, None without one."""

    lost: bool
    reordered: bool
    delay_s: float
    copy_delay_s: float | None


class _Draws(NamedTuple):
    """Uniform chances and jitters of one message and of its duplicate."""

    loss: float
    reorder: float
    duplicate: float
    jitter_s: float
    copy_jitter_s: float


class Channel:
    """Decides the fates of the messages of one path, asked in the order of their times.

    Stalls and loss bursts have generators of their own: when they come does not depend on what is sent.
    """

    def __init__(self, path: PathProfile, rng: np.random.Generator):
        burst_rng, stall_rng, spread_rng = rng.spawn(3)
        self._path = path
        self._base_s = 1e-3 * (path.delay_ms + path.spread_ms * spread_rng.random())
        self._burst = BadTimes(path.loss_burst, burst_rng) if path.loss_burst is not None else None
        self._stall = BadTimes(path.stall, stall_rng) if path.stall is not None else None
        self._draws = _draws(path, rng)

    def fate(self, t_s: float) -> Fate:
        """Return the fate of a message that is sent at a time from the start of the channel [s]."""
        path, draws = self._path, next(self._draws)
        base_s, loss = self._base_s, path.loss
        if self._burst is not None and path.loss_burst is not None and self._burst.end_s(t_s) is not None:
            loss = path.loss_burst.loss
        if self._stall is not None and (end_s := self._stall.end_s(t_s)) is not None:
            base_s += end_s - t_s
        lost = draws.loss < loss
        if path.trace is not None:
            row = path.trace.at(t_s)
            base_s += 1e-3 * row.delay_ms
            lost = lost or row.lost
        copy_s = base_s + draws.copy_jitter_s if draws.duplicate < path.duplicate else None
        return Fate(lost, draws.reorder < path.reorder, base_s + draws.jitter_s, copy_s)


class BadTimes:
    """When a two-state Markov chain in continuous time is in its bad state; it starts in its steady state."""

    def __init__(self, burst: Burst, rng: np.random.Generator):
        bad_s = 1e-3 * burst.mean_ms
        self._rng = rng
        self._mean_s = {False: burst.apart_s, True: bad_s}
        self._bad = bool(rng.random() < bad_s / (bad_s + burst.apart_s))
        self._until_s = rng.exponential(self._mean_s[self._bad])

    def end_s(self, t_s: float) -> float | None:
        """Return when the bad state that holds at `t_s` ends, None in the good one; times never decrease."""
        while t_s >= self._until_s:
            self._bad = not self._bad
            self._until_s += self._rng.exponential(self._mean_s[self._bad])
        return self._until_s if self._bad else None


def _draws(path: PathProfile, rng: np.random.Generator) -> Iterator[_Draws]:
    while True:
        chances = rng.random((_BLOCK, 3)).tolist()
        jitters_s = (1e-3 * jitter_ms(path, rng, (_BLOCK, 2))).tolist()
        for chance, jitter_s in zip(chances, jitters_s, strict=True):
            yield _Draws(*chance, *jitter_s)


def jitter_ms(path: PathProfile, rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Draw jitters [ms] with mean m = `jitter_ms` and variance m^2 / k, k = `jitter_shape`.

    gamma: shape k, scale m / k. lognormal: sigma^2 = ln(1 + 1 / k), mu = ln m - sigma^2 / 2. pareto (Lomax):
    tail index a = 2 / (1 - k), scale m (a - 1), from variance = mean^2 a / (a - 2).
    """
    mean_ms, k = path.jitter_ms, path.jitter_shape
    if mean_ms == 0.0:
        return np.zeros(shape)
    if path.jitter == "lognormal":
        variance = log1p(1.0 / k)
        return rng.lognormal(log(mean_ms) - 0.5 * variance, sqrt(variance), shape)
    if path.jitter == "pareto":
        index = 2.0 / (1.0 - k)
        return mean_ms * (index - 1.0) * rng.pareto(index, shape)
    return mean_ms / k * rng.standard_gamma(k, shape)


class OrderedFlow:
    """The messages of one key that are under way."""

    def __init__(self) -> None:
        self._queue: deque[list[object]] = deque()

    def enter(self) -> list[object]:
        """Return the place of one more message, behind all others."""
        entry: list[object] = [None]
        self._queue.append(entry)
        return entry

    def ripen(self, entry: list[object], deliver: Callable[[], None]) -> list[Callable[[], None]]:
        """Mark an entry's time as come; return what may be delivered now, in order."""
        entry[0] = deliver
        ready: list[Callable[[], None]] = []
        while self._queue and callable(first := self._queue[0][0]):
            self._queue.popleft()
            ready.append(first)
        return ready

    @property
    def is_empty(self) -> bool:
        """Whether nothing is under way."""
        return not self._queue
