"""The way of a robot that is led back: all joints begin and end together, on minimum-jerk paths."""

import numpy as np

from module_agent.control.waveform import minimum_jerk, minimum_jerk_duration_s
from module_agent.model.chain import Array


class Way:
    """From `start_rad` to `end_rad` (n,); the joint that goes farthest reaches `top_speed_rad_s`."""

    def __init__(self, start_rad: Array, end_rad: Array, top_speed_rad_s: float):
        self.end_rad = end_rad.copy()
        self._start_rad = start_rad.copy()
        farthest_rad = float(np.abs(end_rad - start_rad).max())
        self.total_s = minimum_jerk_duration_s(farthest_rad, top_speed_rad_s)

    def at(self, t_s: float) -> tuple[Array, Array]:
        """Return positions [rad] and velocities [rad/s], (n,) each, at a time from its beginning."""
        gone = self.end_rad - self._start_rad
        if t_s >= self.total_s:
            return self.end_rad.copy(), np.zeros_like(gone)
        share, rate = minimum_jerk(1.0, self.total_s, t_s)
        return self._start_rad + share * gone, rate * gone
