"""A motion pattern running on a module: its command at any module time, and which motions are refused.

A motion may bring a profile of efforts that the effort loop is fed forward, as bytes on the wire.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from module_agent.control.controller import Command
from module_agent.control.waveform import duration_s, waveform
from module_agent.wire.messages import EffortProfile, Limits, Pattern, Setpoint
from module_agent.wire.refusal import Refusal, WireError

# A motion is sampled when it starts; a minute takes 3 ms.
MAX_MOTION_S = 60.0
# The thesis commands up to 9 times the maximum speed, to show how the module saturates.
ABSURD_SPEED = 10.0
# The effort loop clamps its target at 1.6 times the type's effort.
ABSURD_EFFORT = 10.0
# A setpoint is followed at once: one turn away and more it is a mistake, or meant to do harm.
MAX_STEP_RAD = 2.0 * math.pi
# How finely a motion is sampled. Its command holds from one sample to the next, in the module's time and
# however far apart the ticks are.
STEP_NS = 1_000_000

SAMPLE = np.dtype("<f4")
# What `EffortProfile` takes.
MAX_SAMPLES = 800
MIN_PERIOD_NS = 1_000_000
# A motion of a few hertz is then interpolated to better than 0.2 %: (2 pi f h)^2 / 8 at 2 Hz.
USUAL_PERIOD_NS = 10_000_000


def profile_period_ns(total_s: float) -> int:
    """Return the sample period of a motion's effort profile: 10 ms, more for a motion over 8 s."""
    fitting_ns = -(-round(total_s * 1e9) // (MAX_SAMPLES - 1))
    # Whole milliseconds, which are a module's ticks.
    return max(USUAL_PERIOD_NS, -(-fitting_ns // MIN_PERIOD_NS) * MIN_PERIOD_NS)


def effort_profile(effort_nm: ArrayLike, period_ns: int) -> EffortProfile:
    """Return the message with the efforts (k,) [Nm] at 0, 1, 2 ... periods of a motion.

    Raises:
        ValueError: not 2 to 800 finite numbers in a row, or a period outside 1 ms to 1 s.
    """
    values = np.asarray(effort_nm, dtype=float)
    if values.ndim != 1 or not 2 <= values.size <= MAX_SAMPLES or not np.isfinite(values).all():
        raise ValueError(
            f"efforts of shape {values.shape}; a profile is 2 to {MAX_SAMPLES} finite numbers in a row"
        )
    return EffortProfile(period_ns=period_ns, samples=values.astype(SAMPLE).tobytes())


def effort_at(profile: EffortProfile, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the efforts (m,) [Nm] at times (m,) since the start of the motion.

    Raises:
        WireError: TYPES, the block is no whole number of samples; NOT_FINITE, one of them is no number.
    """
    if len(profile.samples) % SAMPLE.itemsize:
        raise WireError(
            Refusal.TYPES,
            f"an effort profile of {len(profile.samples)} bytes; a sample is {SAMPLE.itemsize} bytes long",
        )
    values = np.frombuffer(profile.samples, dtype=SAMPLE).astype(float)
    if not np.isfinite(values).all():
        place = int(np.argmin(np.isfinite(values)))
        raise WireError(Refusal.NOT_FINITE, f"sample {place} of the effort profile is {values[place]}")
    efforts: NDArray[np.float64] = np.interp(t_s, np.arange(values.size) * (profile.period_ns * 1e-9), values)
    return efforts


class Motion:
    """A pattern sampled every millisecond at its start (0.3 ms for 6 s), so that a tick only looks it up.

    Args:
        pattern: the motion.
        origin_rad: the commanded position at which it begins.
        start_ns: the module time at which it begins.
        effort: the efforts that it is fed forward; without them the effort loop is off.

    Raises:
        WireError: TYPES, the efforts are no numbers; NOT_FINITE, one or a target is not finite.
    """

    def __init__(
        self, pattern: Pattern, origin_rad: float, start_ns: int, effort: EffortProfile | None = None
    ):
        total_s = duration_s(pattern, origin_rad)
        steps = max(1, round(total_s * 1e9 / STEP_NS))
        t_s = np.minimum(np.arange(steps + 1) * (STEP_NS / 1e9), total_s)
        with np.errstate(all="ignore"):
            samples = waveform(pattern, origin_rad, t_s)
        if not (np.isfinite(samples.offset_rad).all() and np.isfinite(samples.velocity_rad_s).all()):
            # No comparison with a limit would hold for it.
            raise WireError(
                Refusal.NOT_FINITE, f"a {pattern.kind} motion of these sizes has no finite targets"
            )
        self._position: list[float] = (origin_rad + samples.offset_rad).tolist()
        self._velocity: list[float] = samples.velocity_rad_s.tolist()
        self._effort: list[float] | None = None if effort is None else effort_at(effort, t_s).tolist()
        self.origin_rad = origin_rad
        self._start_ns = start_ns
        self._end_ns = start_ns + steps * STEP_NS
        self.last_position_rad = self._position[-1]
        self.last_effort_nm = math.nan if self._effort is None else self._effort[-1]

    @property
    def span_ns(self) -> tuple[int, int]:
        """The module times at which it begins, and at which it is over."""
        return self._start_ns, self._end_ns

    @property
    def targets(self) -> NDArray[np.float64]:
        """The commands of every millisecond, rows position, velocity and effort, (3, samples)."""
        effort = [math.nan] * len(self._position) if self._effort is None else self._effort
        return np.array((self._position, self._velocity, effort))

    @property
    def top_speed_rad_s(self) -> float:
        """The highest commanded speed of the motion."""
        return max(max(self._velocity), -min(self._velocity))

    @property
    def top_effort_nm(self) -> float:
        """The largest effort that is fed forward, 0 without any."""
        return 0.0 if self._effort is None else max(max(self._effort), -min(self._effort))

    @property
    def range_rad(self) -> tuple[float, float]:
        """The lowest and the highest position of the motion."""
        return min(self._position), max(self._position)

    def command(self, now_ns: int) -> Command | None:
        """Return the command at this time, None when the motion is over."""
        if now_ns >= self._end_ns:
            return None
        index = (now_ns - self._start_ns) // STEP_NS
        effort_nm = math.nan if self._effort is None else self._effort[index]
        return Command(self._position[index], self._velocity[index], effort_nm)


def check_duration(pattern: Pattern, origin_rad: float) -> None:
    """Check that a motion is short enough to be sampled within a tick or so.

    Raises:
        WireError: LIMIT, with the duration.
    """
    total_s = duration_s(pattern, origin_rad)
    if total_s > MAX_MOTION_S:
        raise WireError(
            Refusal.LIMIT, f"the motion would take {total_s:.0f} s, at most {MAX_MOTION_S:.0f} s are taken"
        )


def check_setpoint(setpoint: Setpoint, measured_rad: float, limits: Limits) -> None:
    """Check that a setpoint is within the position limits, and no absurd step, speed or effort.

    Raises:
        WireError: LIMIT, with what the setpoint asks and what is allowed.
    """
    _check_speed(abs(setpoint.velocity_rad_s or 0.0), limits)
    _check_effort(abs(setpoint.effort_nm or 0.0), limits)
    position = setpoint.position_rad
    if position is not None and abs(position - measured_rad) > MAX_STEP_RAD:
        raise WireError(
            Refusal.LIMIT,
            f"position {position:.1f} rad is {abs(position - measured_rad):.1f} rad from where the joint is, "
            f"at most {MAX_STEP_RAD:.1f} rad are taken: a motion leads farther",
        )
    if position is not None and not _within(position, limits):
        allowed = f"{limits.min_position_rad} .. {limits.max_position_rad} rad"
        raise WireError(Refusal.LIMIT, f"position {position:.3f} rad is outside {allowed}")


def check_motion(motion: Motion, limits: Limits) -> None:
    """Check that a motion stays within the position limits and is not absurdly fast.

    A joint that is beyond a limit may be moved back, and no farther out.

    Raises:
        WireError: LIMIT, with the range that the motion needs and the one that is allowed, its speed or its
            effort.
    """
    _check_speed(motion.top_speed_rad_s, limits)
    _check_effort(motion.top_effort_nm, limits)
    low, high = motion.range_rad
    least, most, origin = limits.min_position_rad, limits.max_position_rad, motion.origin_rad
    too_low = least is not None and low < min(least, origin)
    too_high = most is not None and high > max(most, origin)
    if too_low or too_high:
        allowed = f"{limits.min_position_rad} .. {limits.max_position_rad} rad"
        raise WireError(Refusal.LIMIT, f"the motion needs {low:.3f} .. {high:.3f} rad, allowed are {allowed}")


def _check_speed(speed_rad_s: float, limits: Limits) -> None:
    """Refuse what is probably a unit error; the loops clamp slower speeds to what the motor can follow."""
    _check_size(speed_rad_s, ABSURD_SPEED, limits.max_speed_rad_s, "rad/s")


def _check_effort(effort_nm: float, limits: Limits) -> None:
    _check_size(effort_nm, ABSURD_EFFORT, limits.max_effort_nm, "Nm")


def _check_size(value: float, times: float, most: float, unit: str) -> None:
    if value > times * most:
        raise WireError(
            Refusal.LIMIT,
            f"{value:.1f} {unit} is over {times:.0f} times what this module can do, {most:.2f} {unit}",
        )


def _within(position_rad: float, limits: Limits) -> bool:
    least, most = limits.min_position_rad, limits.max_position_rad
    return (least is None or position_rad >= least) and (most is None or position_rad <= most)
