"""The arms on which the dynamic pattern is played: their units of work, and figures of their recordings."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from module_agent.estimate.windows import Array
from sim.robot.noise_choice import NoiseChoice
from sim.thesis.dynamics.pattern_recording import (
    Estimate,
    OurTorques,
    PatternRun,
    PatternSeries,
    Torques,
    pattern_series,
)
from sim.thesis.experiment import Check, Curve, Panel, Plot, Scope, Unit
from sim.thesis.published import DYNAMIC_SEARCHES, Alignment

# Modules differ from arm to arm by a percent; the plots are those of the first arm.
ARMS, QUICK_ARMS = 5, 1
_SERIES_S = {"vertical": 3.0, "horizontal": 2.2}
_BASE_EFFECT = "base-shake"
# The thesis prints neither how long its pattern is nor how the error is summed.
LSE_FACTOR = 3.0
LINES_UP = 1.0 / 3.0


class Recorded(NamedTuple):
    """What the experiments of an alignment have: several arms, and the first one on a rigid base or None."""

    arms: tuple[PatternSeries, ...]
    rigid: PatternSeries | None = None

    @property
    def arms_text(self) -> str:
        """How many arms they are, as text."""
        return f"{len(self.arms)} arm{'s' * (len(self.arms) != 1)}"

    def mean(self, amplitude_rad: float, value: Callable[[PatternRun], float]) -> float:
        """Return the mean of a value over all arms."""
        return float(np.mean([value(run_of(arm, amplitude_rad)) for arm in self.arms]))


def run_of(arm: PatternSeries, amplitude_rad: float) -> PatternRun:
    """Return an arm's run with an amplitude."""
    return next(run for run in arm.runs if run.amplitude_rad == amplitude_rad)


def arm_units(alignment: Alignment, scope: Scope) -> tuple[Unit, ...]:
    """Return the work on all arms of an alignment."""
    seeds = range(scope.seed, scope.seed + (QUICK_ARMS if scope.quick else ARMS))
    return tuple(_unit(alignment, scope.noise, seed, "") for seed in seeds)


def first_unit(alignment: Alignment, scope: Scope) -> tuple[Unit, ...]:
    """Return the work on the first arm of an alignment."""
    return arm_units(alignment, scope)[:1]


def rigid_base_unit(scope: Scope) -> Unit:
    """Return the work on the first vertical arm with its base at rest."""
    on = tuple(name for name in scope.noise.on if name != _BASE_EFFECT)
    off = tuple(dict.fromkeys((*scope.noise.off, _BASE_EFFECT)))
    return _unit("vertical", scope.noise._replace(on=on, off=off), scope.seed, ", rigid base")


def _unit(alignment: Alignment, noise: NoiseChoice, seed: int, remark: str) -> Unit:
    search = DYNAMIC_SEARCHES[alignment]
    arguments = (alignment, search.amplitudes_rad, search.chosen_rad, noise, seed)
    name = f"dynamic pattern, {alignment}, arm {seed}{remark}"
    return Unit(name, pattern_series, arguments, PatternSeries, _SERIES_S[alignment])


def torque_plot(torques: Torques, ours: OurTorques, caption: str) -> Plot:
    """Return the torque as measured and calculated, and what the thesis' method and ours miss of it."""
    measured, calculated = np.array(torques.measured_nm), np.array(torques.calculated_nm)
    thesis = "calculated, the thesis' method"
    over = (
        Curve(label="measured", x=torques.t_s, y=torques.measured_nm),
        Curve(label=thesis, x=torques.t_s, y=torques.calculated_nm),
    )
    apart = np.array(ours.calculated_nm) - np.interp(ours.t_s, torques.t_s, measured)
    off = (
        Curve(label=thesis, x=torques.t_s, y=tuple(calculated - measured)),
        Curve(label="calculated, ours", x=ours.t_s, y=tuple(apart)),
    )
    panels = (
        Panel(y_label="torque [Nm]", curves=over),
        Panel(y_label="less measured [Nm]", curves=off),
    )
    return Plot(caption=caption, x_label="time [s]", panels=panels)


class Size(NamedTuple):
    """How large a torque is: its peak, its mean absolute value, and its rms about the mean [Nm]."""

    peak_nm: float
    mean_nm: float
    rms_nm: float


def size(torques: Torques) -> Size:
    """Return how large the measured torque of a motion is."""
    measured: Array = np.array(torques.measured_nm)
    return Size(float(np.abs(measured).max()), float(np.abs(measured).mean()), float(measured.std()))


def lse_check(amplitude_rad: float, own_nm2: float, where: str) -> Check:
    """Return whether a least-squares error is within a factor of the printed one."""
    printed = DYNAMIC_SEARCHES["vertical"].squared_error_nm2[amplitude_rad]
    holds = printed / LSE_FACTOR <= own_nm2 <= LSE_FACTOR * printed
    statement = f"{where} the error ({own_nm2:.3g} Nm²) is within a factor of {LSE_FACTOR:g} of the printed "
    return Check(f"{statement}{printed:g}", holds)


def mean_of(estimate: str, value: Callable[[Estimate], float]) -> Callable[[PatternRun], float]:
    """Return a value of one of a run's estimates."""
    return lambda run: value(getattr(run, estimate))
