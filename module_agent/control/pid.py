"""One PID loop with the manufacturer's parameters, in the manufacturer's order of operations.

Target clamp, target low-pass, error, dead zone, P + I + D + punch + feed-forward, output clamp, output
low-pass. A low-pass is x = a x + (1 - a) x_prev, so 1 means none; `i_clamp` limits the integral's output.
"""

from collections.abc import Sequence

from module_agent.wire.messages import PidGains


class Pid:
    """The state of one loop; `update` advances it by one tick of `dt_s`."""

    def __init__(self, gains: PidGains, dt_s: float, feed_forward_scale: float = 1.0):
        """`feed_forward_scale` turns the target's unit into the output's (PWM per rad/s, or per Nm)."""
        self._g = gains
        self._dt = dt_s
        # What every tick needs is resolved once: a model's fields are dictionary lookups.
        self._kp = gains.kp
        self._ff = feed_forward_scale * gains.feed_forward
        self._min_target, self._max_target = gains.min_target, gains.max_target
        self._min_output, self._max_output = gains.min_output, gains.max_output
        self._lowpass = gains.output_lowpass
        self._plain = not (gains.ki or gains.kd or gains.punch or gains.dead_zone) and (
            gains.target_lowpass == 1.0
        )
        self.reset()

    def reset(self) -> None:
        """Forget the past, as a loop does whose target is NaN."""
        self._target: float | None = None
        self._last: tuple[float, float] | None = None
        self._integral = 0.0
        self._output: float | None = None

    @property
    def record(self) -> tuple[float, ...]:
        """The parameters as `tick_kernel.LOOP` has them."""
        g = self._g
        return (
            *(self._kp, g.ki, g.kd, self._ff, g.dead_zone, g.i_clamp, g.punch),
            *(g.min_target, g.max_target, g.target_lowpass),
            *(g.min_output, g.max_output, g.output_lowpass, self._dt),
            *(g.d_on_error, self._plain),
        )

    @property
    def memory(self) -> tuple[float, ...]:
        """The state as `tick_kernel` has it: pairs of whether there is one and its value."""
        target, last, output = self._target, self._last, self._output
        return (
            *((0.0, 0.0) if target is None else (1.0, target)),
            *((0.0, 0.0, 0.0) if last is None else (1.0, *last)),
            self._integral,
            *((0.0, 0.0) if output is None else (1.0, output)),
        )

    def remember(self, memory: Sequence[float]) -> None:
        """Go on from a state as `memory` gives it."""
        has_target, target, has_last, error, measured, self._integral, has_output, output = memory
        self._target = target if has_target else None
        self._last = (error, measured) if has_last else None
        self._output = output if has_output else None

    def follow(self, target: float, measured: float) -> float:
        """Return this tick's output; 0, and the past is forgotten, while the target is NaN."""
        if target == target:
            return self.update(target, measured)
        if self._output is not None:
            self.reset()
        return 0.0

    def update(self, target: float, measured: float) -> float:
        """Return this tick's output; the first one after a reset has no derivative and no filter past."""
        if target < self._min_target:
            target = self._min_target
        if target > self._max_target:
            target = self._max_target
        if self._plain:
            output = self._kp * (target - measured) + self._ff * target
        else:
            output = self._every_term(target, measured)
        if output < self._min_output:
            output = self._min_output
        if output > self._max_output:
            output = self._max_output
        if self._lowpass < 1.0 and self._output is not None:
            output = self._lowpass * output + (1.0 - self._lowpass) * self._output
        self._output = output
        return output

    def _every_term(self, target: float, measured: float) -> float:
        """Return the output before its clamp, for a target within its own."""
        g = self._g
        if g.target_lowpass < 1.0 and self._target is not None:
            target = g.target_lowpass * target + (1.0 - g.target_lowpass) * self._target
        self._target = target
        error = target - measured
        if -g.dead_zone < error < g.dead_zone:
            error = 0.0
        output = self._kp * error + self._ff * target
        if g.ki:
            limit = g.i_clamp
            self._integral = min(max(self._integral + g.ki * error * self._dt, -limit), limit)
            output += self._integral
        if g.kd:
            output += g.kd * self._derivative(error, measured)
        if g.punch and error:
            output += g.punch if error > 0.0 else -g.punch
        return output

    def _derivative(self, error: float, measured: float) -> float:
        last, self._last = self._last, (error, measured)
        if last is None:
            return 0.0
        change = error - last[0] if self._g.d_on_error else last[1] - measured
        return change / self._dt
