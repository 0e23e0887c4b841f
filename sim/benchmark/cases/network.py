"""Networks: the cost of latency, jitter, loss and differing clocks for the estimates.

Trials of one seed on different networks have the same modules, clocks included, so that they come in pairs.
"""

from collections.abc import Sequence

from coordinator.excitation.plan import Plan
from sim.benchmark.case import Case, Summary, Trial, trial_seeds
from sim.benchmark.cases.arm import KNOWN, TIP_MM, ArmTrial, arm_trial, reasons, sigmas_off, wrong_row
from sim.benchmark.row import ENOUGH_TRIALS, Row, coverage, ratio, rms, scaled
from sim.imperfections.noise_profile import NoiseProfile, noise_profile

OFFSET_S, DRIFT_PPM = 0.05, 100.0
ROBOT = "a2085_04"
PERFECT, POOR, BAD = "none", "wifi", "bad"
OVER_PERFECT = 1.2
_COST_S = 9.0


def with_clock_errors(noise: NoiseProfile) -> NoiseProfile:
    """Return a profile whose clocks differ by up to `OFFSET_S`, and by `DRIFT_PPM` (one sigma)."""
    clocks = {"clock_offset_min_s": 0.0, "clock_offset_max_s": OFFSET_S, "clock_drift_ppm": DRIFT_PPM}
    return noise.model_copy(update=clocks)


def network_cases(trials: int, seed: int, plan: Plan | None = None) -> list[Case]:
    """Return a case of `wifi` against a perfect network on the same modules, and one of `bad`."""
    noise = with_clock_errors(noise_profile("x5"))

    def work(*networks: str) -> list[Trial]:
        return [
            Trial(arm_trial, (ROBOT, noise, own, "joint", network, plan), _COST_S)
            for own in trial_seeds(seed, ROBOT, trials)
            for network in networks
        ]

    name, about = f"{ROBOT}, x5, clocks apart", ("x5", KNOWN["calibrated"])
    return [
        Case(f"{name}, {POOR}", work(PERFECT, POOR), _pairs, *about),
        Case(f"{name}, {BAD}", work(BAD), _bad, *about),
    ]


def _pairs(trials: Sequence[ArmTrial]) -> Summary:
    """Compare trials on the same modules; a pair with a failure is excluded from the ratios."""
    right = {(trial.network, trial.seed): trial for trial in trials if trial.right}
    seeds = [t.seed for t in trials if {(PERFECT, t.seed), (POOR, t.seed)} <= right.keys()]
    perfect, poor = ([right[network, s] for s in dict.fromkeys(seeds)] for network in (PERFECT, POOR))
    # A ratio of few errors says nothing.
    limit = OVER_PERFECT if len(trials) >= 2 * ENOUGH_TRIALS else None
    over = "rms error over a perfect network's"
    rows = [
        wrong_row([trial for trial in trials if trial.network == POOR]),
        Row(f"tip position, {over}", ratio(rms(_tips(poor)), rms(_tips(perfect))), limit),
        Row(f"link lengths, {over}", ratio(rms(_lengths(poor)), rms(_lengths(perfect))), limit),
        *_absolute_rows(poor),
    ]
    return Summary(rows, sigmas_off(list(right.values())), reasons=reasons(trials))


def _bad(trials: Sequence[ArmTrial]) -> Summary:
    right = [trial for trial in trials if trial.right]
    off = sigmas_off(right)
    rows = [wrong_row(trials), coverage(off), *_absolute_rows(right)]
    return Summary(rows, off, reasons=reasons(trials))


def _tips(trials: Sequence[ArmTrial]) -> list[float | None]:
    return [None if trial.tip is None else trial.tip.position_m for trial in trials]


def _lengths(trials: Sequence[ArmTrial]) -> list[float | None]:
    return [link.error_m for trial in trials for link in trial.links]


def _absolute_rows(trials: Sequence[ArmTrial]) -> list[Row]:
    return [
        Row("tip position, rms [mm]", scaled(rms(_tips(trials)), 1e3), TIP_MM["x5"]),
        Row("clocks apart, rms [us]", scaled(rms([trial.clock_error_s for trial in trials]), 1e6)),
    ]
