"""Forged messages: one field of a message holds what it should not, or something else that it may."""

import copy
import math
import random
from collections.abc import Iterator
from typing import Any

# What a field may hold instead, by its type or of any other.
EXTREMES: tuple[Any, ...] = (
    *(0, 1, -1, 2**31, 2**53, 2**62, -(2**62)),
    *(0.0, 1e-300, 1e300, -1e300, 1e9, math.nan, math.inf),
    *("", "x", b"", None, [], {}, True, False),
)
# Of fields whose extremes are refused at once, what is not.
WORDS = {
    "outcome": ("running", "done", "superseded", "stopped", "expired", "fault"),
    "state": ("idle", "armed", "moving", "streaming", "expired", "stopped", "fault"),
}
HEAD = ("v", "serial", "boot")


def fields(message: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all fields of a message, those of its parts too."""
    inside = message.items() if isinstance(message, dict) else enumerate(message[:8])
    for name, value in inside:
        if path or name not in HEAD:
            yield (*path, name)
            if isinstance(value, dict | list):
                yield from fields(value, (*path, name))


def altered(message: dict[str, Any], draw: random.Random) -> dict[str, Any]:
    """Return a message with another value in one field, mostly of the same type."""
    forged = copy.deepcopy(message)
    *above, name = draw.choice(list(fields(forged)))
    part: Any = forged
    for step in above:
        part = part[step]
    old = part[name]
    alike = [value for value in EXTREMES if type(value) is type(old)]
    new = draw.choice(alike if alike and draw.random() < 0.7 else EXTREMES)
    if isinstance(old, int | float) and draw.random() < 0.5:
        new = old + draw.choice((1, -1, 10, 100, -100))
    elif isinstance(old, list) and old and draw.random() < 0.5:
        new = [*old, old[-1]] if draw.random() < 0.5 else old[:-1]
    part[name] = draw.choice(WORDS[name]) if name in WORDS else new
    return forged
