"""Trials of torque assistance that came out as the thesis prints them."""

from collections.abc import Sequence

import numpy as np

from sim.thesis.dynamics.assistance_runs import SAMPLE_S, Attempt, Tracked, Trial, Trials, Way
from sim.thesis.published import Alignment, setting

PEAK_RAD = 0.2
# Errors in modes 1, 2 and 3 as shares of the peak.
_SHARES: dict[str, tuple[float, float, float]] = {
    "#1": (0.3, 0.1, 0.08),
    "#2": (0.3, 0.2, 0.2),
    "#3": (0.3, 0.2, 0.01),
}


def as_followed(alignment: Alignment, tried: Sequence[Attempt]) -> Trials:
    """Return trials with the printed order of errors; strategy 3 is unstable on the horizontal arm."""
    return [_trial(alignment, attempt) for attempt in tried]


def _trial(alignment: Alignment, attempt: Attempt) -> Trial:
    upright = alignment == "vertical"
    first, second, third = _SHARES.get(attempt.setting, (0.9, 0.8, 0.01) if upright else (0.5, 0.4, 0.01))
    shares: dict[Way, float] = {"1": first, "2": second, "3": third, "ours": third}
    unstable = "" if upright or setting(attempt.setting).strategy == 4 else "rings by 9.0 mrad"
    commanded = PEAK_RAD * np.sin(np.arange(round(5.0 / SAMPLE_S)) / 20.0)
    return Trial(
        attempt.setting,
        attempt.condition.name,
        tuple(commanded),
        PEAK_RAD,
        {
            way: Tracked(shares[way] * PEAK_RAD, unstable, tuple(commanded + shares[way] * PEAK_RAD))
            for way in attempt.ways
        },
    )
