"""The settings of tables 7 to 9 of the thesis on the arms: their units of work, and their results."""

from collections.abc import Sequence
from math import inf

from sim.thesis.dynamics.assistance_runs import (
    AS_READ,
    PER_SECOND,
    PLAY_AND_SPRING,
    TABLE_3,
    WAYS,
    Attempt,
    Condition,
    Trial,
    Trials,
    Way,
    attempts,
)
from sim.thesis.dynamics.torque_assistance_cases import ON_SINE
from sim.thesis.experiment import Scope, Unit
from sim.thesis.published import SETTINGS, Alignment

# As the thesis did it: mode 3 with A Phi alone.
THESIS_WAYS: tuple[Way, ...] = ("1", "2", "3")
WAY_NAMES: dict[Way, str] = {
    "1": "mode 1: position",
    "2": "mode 2: position, velocity",
    "3": "mode 3: with A Φ alone",
    "ours": "mode 3: ours, drive fed forward",
}
# Errors below this share of the largest have a panel of their own.
SMALL = 0.3
_ARMS = 3
_CONDITIONS: tuple[Condition, ...] = (AS_READ, PER_SECOND, PLAY_AND_SPRING, TABLE_3)
_FOLLOW_S, _IDENTIFY_S = 0.75, 1.0


def settings_of(strategy: int) -> tuple[str, ...]:
    """Return the names of a strategy's settings."""
    return tuple(each.name for each in SETTINGS if each.strategy == strategy)


def setting_units(alignment: Alignment, strategy: int, scope: Scope) -> tuple[Unit, ...]:
    """Return the work on the settings of a strategy: one arm under all conditions, others as read."""
    names = settings_of(strategy)
    conditions = (AS_READ,) if scope.quick else _CONDITIONS
    full = tuple(
        Attempt(name, condition)
        for condition in conditions
        for name in names
        if not (condition.table_3 and name in ON_SINE)
    )
    plain = tuple(Attempt(name, AS_READ) for name in names)
    arms = 1 if scope.quick else _ARMS
    return tuple(
        Unit(
            f"torque assistance, {alignment}, strategy {strategy}, arm {scope.seed + k}",
            attempts,
            (alignment, own, scope.noise, scope.seed + k),
            Trials,
            _IDENTIFY_S + _FOLLOW_S * len(WAYS) * len(own),
        )
        for k, own in enumerate((full, *[plain] * (arms - 1)))
    )


def error_rad(trial: Trial, way: Way) -> float:
    """Return a way's rms error [rad], infinite if it was broken off."""
    error = trial.ways[way].error_rad
    return inf if error is None else error


def error_text(trial: Trial, way: Way) -> str:
    """Return a way's rms error in mrad."""
    error = trial.ways[way].error_rad
    return "no" if error is None else f"{1e3 * error:.1f}"


def as_read(measured: Sequence[Trials], name: str) -> list[Trial]:
    """Return a setting's trial as read on every arm."""
    return [
        trial
        for trials in measured
        for trial in trials
        if (trial.setting, trial.condition) == (name, AS_READ.name)
    ]
