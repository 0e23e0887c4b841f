"""The likelihood of a forest of modules against its rivals: log-odds of every edge.

A forest says of every joint and IMU whether the one carries the other. With independent observations its
log-likelihood, up to a constant, is the sum of the log-odds of all pairs that it says are carried. Other
forests are weighed against it that differ by one move: a module mounted elsewhere with all that it carries,
or taken out alone and put elsewhere, beneath some of what is mounted there. One or a few wrong observations
lead to one of these. Forests more than one move away are not counted: they matter only where less than 1 % is
in doubt, and leaving them out understates that by up to a factor of seven.
"""

from collections.abc import Collection, Iterator, Sequence
from itertools import chain

import numpy as np

from module_agent.model.chain import BASE, Array

# (n,) the index of every module's parent, BASE on the base; parents need not come first.
Parents = tuple[int, ...]


def log_likelihood(parent: Sequence[int], odds: Array) -> float:
    """Return the log-likelihood of a forest over that of modules that all stand on the base.

    Args:
        odds: (n, n) log-odds that joint i carries the IMU of module k; the diagonal does not matter here.
    """
    return float(odds[ancestors(parent)].sum())


def ancestors(parent: Sequence[int]) -> "np.ndarray[tuple[int, int], np.dtype[np.bool_]]":
    """Return (n, n): whether i is between k and the base.

    Raises:
        ValueError: the parents form a ring.
    """
    children: list[list[int]] = [[] for _ in range(len(parent) + 1)]
    for k, p in enumerate(parent):
        children[p].append(k)  # BASE is the last
    above = np.zeros((len(parent), len(parent)), dtype=bool)
    ordered = list(children[BASE])
    for k in ordered:
        if parent[k] != BASE:
            above[:, k] = above[:, parent[k]]
            above[parent[k], k] = True
        ordered += children[k]
    if len(ordered) < len(parent):
        ring = sorted(set(range(len(parent))) - set(ordered))
        raise ValueError(f"the parents of modules {ring} never reach the base")
    return above


def likeliest_forest(odds: Array, leaves: Collection[int] = ()) -> Parents:
    """Return a forest that no single move makes likelier.

    If the signs of the odds describe a forest, that one is the likeliest of all and is returned.

    Args:
        odds: as for `log_likelihood`.
        leaves: modules that carry nothing.
    """
    starts = [_by_movers(odds, leaves), _by_insertion(odds, leaves)]
    return max((_climbed(s, odds, leaves) for s in starts), key=lambda p: log_likelihood(p, odds))


def _by_movers(odds: Array, leaves: Collection[int]) -> Parents:
    """Mount every module on the one of its movers that has the most movers itself."""
    carried = odds > 0.0
    np.fill_diagonal(carried, False)
    carried[list(leaves)] = False
    movers = carried.sum(axis=0)
    rank = np.argsort(np.argsort(movers, kind="stable"), kind="stable")
    carried &= rank[:, None] < rank[None, :]
    return tuple(int(max(np.flatnonzero(c), key=lambda i: rank[i], default=BASE)) for c in carried.T)


def _by_insertion(odds: Array, leaves: Collection[int]) -> Parents:
    """Mount one module after another, the most moved last, where it fits best."""
    n = len(odds)
    parent = [BASE] * n
    placed: list[int] = []
    for k in np.argsort((odds > 0.0).sum(axis=0), kind="stable"):
        place = _place_gain(ancestors(parent), odds[:, k])
        choices = [BASE, *(p for p in placed if p not in leaves)]
        parent[k] = int(max(choices, key=lambda p: place[p]))
        placed.append(int(k))
    return tuple(parent)


def _climbed(parent: Parents, odds: Array, leaves: Collection[int]) -> Parents:
    while True:
        others = rivals(parent, odds, leaves)
        best = max(others.items(), key=lambda move: move[1], default=(parent, 0.0))
        # Gains of rounding errors would let it go round for ever.
        if best[1] <= 1e-9:
            return parent
        parent = best[0]


def rivals(parent: Parents, odds: Array, leaves: Collection[int] = ()) -> dict[Parents, float]:
    """Return the forests one move away, each once, with their log-likelihood relative to this one."""
    odds = np.where(np.eye(len(odds), dtype=bool), 0.0, odds)
    moves = (
        (*_mounted_elsewhere(parent, odds, leaves, k), *_put_in_between(parent, odds, leaves, k))
        for k in range(len(parent))
    )
    return dict(chain.from_iterable(moves))


def _mounted_elsewhere(
    parent: Parents, odds: Array, leaves: Collection[int], k: int
) -> Iterator[tuple[Parents, float]]:
    above = ancestors(parent)
    branch = above[k].copy()
    branch[k] = True
    place = _place_gain(above, odds[:, branch].sum(axis=1))
    for p in (BASE, *range(len(parent))):
        if p == parent[k] or (p != BASE and (branch[p] or p in leaves)):
            continue
        yield _with(parent, {k: p}), float(place[p] - place[parent[k]])


def _put_in_between(
    parent: Parents, odds: Array, leaves: Collection[int], k: int
) -> Iterator[tuple[Parents, float]]:
    """Take k out, its children staying where it was; put it elsewhere, beneath some of those there."""
    without = _with(parent, {c: parent[k] for c, p in enumerate(parent) if p == k})
    above = ancestors(without)
    place = _place_gain(above, odds[:, k])
    gain = odds[k] @ (above | np.eye(len(parent), dtype=bool)).T
    before = place[parent[k]] + sum(gain[c] for c, p in enumerate(parent) if p == k)
    for p in (BASE, *range(len(parent))):
        if p == k or p in leaves:
            continue
        there = [c for c, q in enumerate(without) if q == p and c != k] if k not in leaves else []
        best = [c for c in there if gain[c] > 0.0]
        for carried in (best, *(sorted({c} ^ set(best)) for c in there)):
            moved = _with(without, {k: p, **dict.fromkeys(carried, k)})
            if moved != parent:
                yield moved, float(place[p] + sum(gain[c] for c in carried) - before)


def _place_gain(above: "np.ndarray[tuple[int, int], np.dtype[np.bool_]]", odds: Array) -> Array:
    """Return (n + 1,): the summed odds of the ancestors of something mounted on p, the base last."""
    return np.append(odds @ (above | np.eye(len(above), dtype=bool)), 0.0)


def _with(parent: Parents, changes: dict[int, int]) -> Parents:
    return tuple(changes.get(k, p) for k, p in enumerate(parent))


def edge_log_odds(parent: Parents, others: dict[Parents, float]) -> Array:
    """Return (n,) log-odds that each module's parent is the right one, against all rivals together.

    Infinite for a module that no rival mounts elsewhere.
    """
    log_odds = np.full(len(parent), np.inf)
    if not others:
        return log_odds
    moved = np.array(list(others)) != np.array(parent)
    weight = np.array(list(others.values()))
    for k in range(len(parent)):
        wrong = weight[moved[:, k]]
        right = np.append(weight[~moved[:, k]], 0.0)
        if wrong.size:
            log_odds[k] = np.logaddexp.reduce(right) - np.logaddexp.reduce(wrong)
    return log_odds
