"""An asyncio loop whose clock runs faster or slower than real time, for a simulation run at another speed."""

import asyncio
import math
import selectors
import time


def check_speed(speed: float) -> float:
    """Return a speed that a clock can run at.

    Raises:
        ValueError: not positive, or not finite.
    """
    if not (math.isfinite(speed) and speed > 0.0):
        raise ValueError(f"speed {speed}: it must be a positive number, 1 for real time")
    return speed


class _ScaledSelector(selectors.DefaultSelector):
    def __init__(self, speed: float):
        super().__init__()
        self._speed = speed

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait for the real time that `timeout` session seconds take."""
        return super().select(timeout if timeout is None else timeout / self._speed)


class ScaledLoop(asyncio.SelectorEventLoop):
    """Sleeps and time-outs are in session seconds: `speed` of them pass in a real second.

    Raises:
        ValueError: see `check_speed`.
    """

    def __init__(self, speed: float = 1.0):
        super().__init__(_ScaledSelector(check_speed(speed)))
        self._speed = speed
        # Wall time at the start, so that the recordings of a resumed session do not overlap.
        self._origin_ns = time.time_ns()
        self._start_ns = time.monotonic_ns()

    def time(self) -> float:
        """Return session seconds."""
        return time.monotonic() * self._speed

    def clock_ns(self) -> int:
        """Return session time as integer nanoseconds since 1970 (at the start)."""
        return self._origin_ns + int((time.monotonic_ns() - self._start_ns) * self._speed)
