"""A motion pattern running on a module: its command at any module time."""

import numpy as np

from module_agent.firmware.controller import Command
from module_agent.firmware.effort_profile import effort_at
from module_agent.firmware.waveform import duration_s, waveform
from module_agent.wire.messages import EffortProfile, Limits, Pattern, Setpoint
from module_agent.wire.refusal import Refusal, WireError

# A motion is sampled when it starts; a minute takes 3 ms.
LONGEST_S = 60.0
# The thesis asks for up to 9 times what the module can do, to show how it saturates.
ABSURD_SPEED = 10.0


class Motion:
    """A pattern sampled once at its start (0.3 ms for 6 s), so that a tick only looks it up."""

    __slots__ = (
        "_effort",
        "_end_ns",
        "_position",
        "_start_ns",
        "_tick_ns",
        "_velocity",
        "last_effort_nm",
        "last_position_rad",
    )

    def __init__(
        self,
        pattern: Pattern,
        origin_rad: float,
        start_ns: int,
        tick_ns: int,
        effort: EffortProfile | None = None,
    ):
        total_s = duration_s(pattern, origin_rad)
        ticks = max(1, round(total_s * 1e9 / tick_ns))
        t_s = np.minimum(np.arange(ticks + 1) * (tick_ns / 1e9), total_s)
        samples = waveform(pattern, origin_rad, t_s)
        self._position: list[float] = (origin_rad + samples.offset_rad).tolist()
        self._velocity: list[float] = samples.velocity_rad_s.tolist()
        self._effort: list[float] | None = None if effort is None else effort_at(effort, t_s).tolist()
        self._start_ns = start_ns
        self._end_ns = start_ns + ticks * tick_ns
        self._tick_ns = tick_ns
        self.last_position_rad = self._position[-1]
        self.last_effort_nm = None if self._effort is None else self._effort[-1]

    @property
    def top_speed_rad_s(self) -> float:
        """The highest commanded speed of the motion."""
        return max(max(self._velocity), -min(self._velocity))

    @property
    def range_rad(self) -> tuple[float, float]:
        """The lowest and the highest position of the motion."""
        return min(self._position), max(self._position)

    def command(self, now_ns: int) -> Command | None:
        """Return the command at this time, None when the motion is over."""
        if now_ns >= self._end_ns:
            return None
        index = (now_ns - self._start_ns) // self._tick_ns
        effort_nm = None if self._effort is None else self._effort[index]
        return Command(self._position[index], self._velocity[index], effort_nm)


def check_duration(pattern: Pattern, origin_rad: float) -> None:
    """Check that a motion is short enough to be sampled within a tick or so.

    Raises:
        WireError: LIMIT, with the duration.
    """
    total_s = duration_s(pattern, origin_rad)
    if total_s > LONGEST_S:
        raise WireError(
            Refusal.LIMIT, f"the motion would take {total_s:.0f} s, at most {LONGEST_S:.0f} s are taken"
        )


def check_speed(speed_rad_s: float, limits: Limits) -> None:
    """Check that a speed is one that somebody may mean. The loops clamp what the motor cannot follow.

    Raises:
        WireError: LIMIT, with the speed.
    """
    if speed_rad_s > ABSURD_SPEED * limits.max_speed_rad_s:
        raise WireError(
            Refusal.LIMIT,
            f"{speed_rad_s:.1f} rad/s is over {ABSURD_SPEED:.0f} times what this module can do, "
            f"{limits.max_speed_rad_s:.2f} rad/s",
        )


def check_setpoint(setpoint: Setpoint, limits: Limits) -> None:
    """Check that a setpoint is within the position limits and is not absurdly fast.

    Raises:
        WireError: LIMIT, with the position and the range that is allowed, or the speed.
    """
    check_speed(abs(setpoint.velocity_rad_s or 0.0), limits)
    position, low, high = setpoint.position_rad, limits.min_position_rad, limits.max_position_rad
    if position is not None and (
        (low is not None and position < low) or (high is not None and position > high)
    ):
        raise WireError(Refusal.LIMIT, f"position {position:.3f} rad is outside {low} .. {high} rad")


def check_motion(motion: Motion, limits: Limits) -> None:
    """Check that a motion stays within the position limits and is not absurdly fast.

    Raises:
        WireError: LIMIT, with the range that the motion needs and the one that is allowed, or its speed.
    """
    check_speed(motion.top_speed_rad_s, limits)
    low, high = motion.range_rad
    if (limits.min_position_rad is not None and low < limits.min_position_rad) or (
        limits.max_position_rad is not None and high > limits.max_position_rad
    ):
        raise WireError(
            Refusal.LIMIT,
            f"the motion needs {low:.3f} .. {high:.3f} rad, "
            f"allowed are {limits.min_position_rad} .. {limits.max_position_rad} rad",
        )
