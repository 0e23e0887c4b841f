"""The map from a module's clock to the time of a session."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]


class ClockMap(NamedTuple):
    """session = module + offset_ns + drift * (module - origin_ns).

    `sigma_ns` and `drift_sigma` are one standard deviation of offset and drift, independent of each other as
    the origin is the trips' middle. Of maps from round trips those of two modules are independent too.
    Arithmetic is that of 64 bits: session times, offset and origin are within 2.7e18 ns, a drift within 0.1.
    """

    origin_ns: int
    offset_ns: float
    drift: float
    sigma_ns: float
    drift_sigma: float = 0.0

    def corrected(self, ahead_ns: float, fast: float) -> "ClockMap":
        """Return the map whose session times are less by `ahead_ns` at the origin, and by `fast` per ns."""
        return self._replace(offset_ns=self.offset_ns - ahead_ns, drift=self.drift - fast)

    def to_session(self, module_ns: Times) -> Times:
        """Map module times (n,) to session times (n,), both integer nanoseconds."""
        # The offset can be years of uptime, which a float does not resolve to the nanosecond.
        whole, rest = self._split()
        since = module_ns - self.origin_ns
        mapped: Times = module_ns + whole + np.rint(rest + self.drift * since).astype(np.int64)
        return mapped

    def to_module(self, session_ns: Times) -> Times:
        """Undo `to_session`, to 1 ns: session times (n,) to module times (n,), integer nanoseconds."""
        whole, rest = self._split()
        since = (session_ns - whole - self.origin_ns - rest) / (1.0 + self.drift)
        mapped: Times = session_ns - whole - np.rint(rest + self.drift * since).astype(np.int64)
        return mapped

    def module_span(self, start_ns: int, end_ns: int, step_ns: int) -> tuple[int, int]:
        """Return the module times between which rows count for session times from `start_ns` to `end_ns`.

        Ten steps lie to either side, from which a spline through them is settled.
        """
        first, last = self.to_module(np.array([start_ns - 10 * step_ns, end_ns + 10 * step_ns]))
        return int(first), int(last)

    def _split(self) -> tuple[int, float]:
        whole = round(self.offset_ns)
        return whole, self.offset_ns - whole
