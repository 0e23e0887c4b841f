"""One PID loop with the manufacturer's parameters, in the manufacturer's order of operations.

Target clamp, target low-pass, error, dead zone, P + I + D + punch + feed-forward, output clamp, output
low-pass. A low-pass is x = a x + (1 - a) x_prev, so 1 means none; `i_clamp` limits the integral's output.
"""

from module_agent.wire.messages import PidGains


class Pid:
    """The state of one loop; `update` advances it by one tick of `dt_s`."""

    __slots__ = ("_dt", "_error", "_ff_scale", "_g", "_integral", "_measured", "_output", "_target")

    def __init__(self, gains: PidGains, dt_s: float, feed_forward_scale: float = 1.0):
        """`feed_forward_scale` turns the target's unit into the output's (PWM per rad/s, or per Nm)."""
        self._g = gains
        self._dt = dt_s
        self._ff_scale = feed_forward_scale * gains.feed_forward
        self.reset()

    def reset(self) -> None:
        """Forget the past, as a loop does whose command is unset."""
        self._target: float | None = None
        self._error: float | None = None
        self._measured: float | None = None
        self._integral = 0.0
        self._output: float | None = None

    def update(self, target: float, measured: float) -> float:
        """Return this tick's output; the first one after a reset has no derivative and no filter past."""
        g = self._g
        target = min(max(target, g.min_target), g.max_target)
        if g.target_lowpass < 1.0 and self._target is not None:
            target = g.target_lowpass * target + (1.0 - g.target_lowpass) * self._target
        self._target = target
        error = target - measured
        if -g.dead_zone < error < g.dead_zone:
            error = 0.0
        output = g.kp * error + self._ff_scale * target
        if g.ki:
            limit = g.i_clamp
            self._integral = min(max(self._integral + g.ki * error * self._dt, -limit), limit)
            output += self._integral
        if g.kd:
            output += g.kd * self._derivative(error, measured)
        if g.punch and error:
            output += g.punch if error > 0.0 else -g.punch
        output = min(max(output, g.min_output), g.max_output)
        if g.output_lowpass < 1.0 and self._output is not None:
            output = g.output_lowpass * output + (1.0 - g.output_lowpass) * self._output
        self._output = output
        return output

    def _derivative(self, error: float, measured: float) -> float:
        last_error, last_measured = self._error, self._measured
        self._error, self._measured = error, measured
        if last_error is None or last_measured is None:
            return 0.0
        change = error - last_error if self._g.d_on_error else last_measured - measured
        return change / self._dt
