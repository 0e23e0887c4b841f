"""Figures of the benchmarks with the bars that they are held to, for one table at the end of the session.

A test calls `report`; nothing is asserted: a slow machine misses bars and fails no test. `anchor` says what
the figure is compared with in the same run, such as "pinocchio's loop 11.9 us".
"""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple


class Figure(NamedTuple):
    """One measured figure; at most one of `at_most` and `at_least` is its bar."""

    what: str
    value: float
    unit: str
    at_most: float | None
    at_least: float | None
    anchor: str

    @property
    def bar(self) -> str:
        """The bar as text, empty without one."""
        if self.at_most is not None:
            return f"at most {self.at_most:g}"
        return "" if self.at_least is None else f"at least {self.at_least:g}"

    @property
    def met(self) -> bool | None:
        """Whether the bar is met, None without one. A figure that is not a number misses it."""
        if self.at_most is not None:
            return self.value <= self.at_most
        return None if self.at_least is None else self.value >= self.at_least

    @property
    def outcome(self) -> str:
        """`met`, `missed`, or nothing without a bar."""
        return {True: "met", False: "missed", None: ""}[self.met]


FIGURES: list[Figure] = []


def report(
    what: str,
    value: float,
    unit: str = "",
    *,
    at_most: float | None = None,
    at_least: float | None = None,
    anchor: str = "",
) -> None:
    """Print a figure and keep it for the table at the end (`runs/bench.json`, too)."""
    figure = Figure(what, float(value), unit, at_most, at_least, anchor)
    FIGURES.append(figure)
    print("\n" + line(figure))


def line(figure: Figure) -> str:
    """Return a figure as a line of the table."""
    aside = "; ".join(text for text in (f"{figure.bar} {figure.outcome}".strip(), figure.anchor) if text)
    return f"{figure.what:.<64} {figure.value:.4g} {figure.unit}".rstrip() + (f" ({aside})" if aside else "")


def least_cpu_s(work: Callable[[], object], repeats: int = 5, calls: int = 1) -> float:
    """Return the least processor time of a call [s] of some repeats: other processes only add to it."""
    return least_cpu_of((work,), repeats, calls)[0]


def least_cpu_of(works: Sequence[Callable[[], object]], repeats: int = 5, calls: int = 1) -> list[float]:
    """Return the least processor time of a call of each [s], measured in turns, so that ratios are fair."""
    least = [float("inf")] * len(works)
    for _ in range(repeats):
        for k, work in enumerate(works):
            begun = time.process_time()
            for _ in range(calls):
                work()
            least[k] = min(least[k], (time.process_time() - begun) / calls)
    return least
