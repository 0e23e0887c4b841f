"""Networks: what latency, jitter, loss and clocks that differ do to the estimates."""

from collections.abc import Sequence
from functools import partial

from coordinator.plan import Plan
from sim.benchmark.case import Case, Summary, Trial, trial_seed
from sim.benchmark.row import Row, count, coverage, for_few, ratio, rms, scaled
from sim.experiments.network_trial import NetworkTrial, apart, network_trial
from sim.noise_profile import noise_profile

# Clocks are 50 ms and 100 ppm apart, see `network_trial.apart`.
ROBOT = "a2085_04"
PERFECT, POOR, BAD = "none", "wifi", "bad"
OVER_PERFECT = 1.2
_COST_S = 9.0


def network_cases(trials: int, seed: int, plan: Plan | None = None) -> list[Case]:
    """Return `wifi` beside a perfect network on the same modules, and `bad` by itself."""
    noise = apart(noise_profile("x5"))

    def work(*networks: str) -> tuple[Trial, ...]:
        return tuple(
            Trial(network_trial, (ROBOT, network, noise, trial_seed(seed, ROBOT, number), plan), _COST_S)
            for number in range(trials)
            for network in networks
        )

    pair, bad = (f"{ROBOT}, x5, clocks apart, {network}" for network in (POOR, BAD))
    return [
        Case(pair, work(PERFECT, POOR), partial(_pairs, pair)),
        Case(bad, work(BAD), partial(_bad, bad)),
    ]


def _pairs(case: str, trials: Sequence[NetworkTrial]) -> Summary:
    """Compare trials on the same modules; a pair of which one came to no result is left out of the ratios."""
    by_seed = {(trial.network, trial.seed): trial for trial in trials}
    whole = [
        (perfect, by_seed[POOR, perfect.seed])
        for perfect in trials
        if perfect.network == PERFECT and (POOR, perfect.seed) in by_seed
    ]
    right = [(a, b) for a, b in whole if _right(a) and _right(b)]
    perfect, poor = [a for a, _ in right], [b for _, b in right]
    own = [trial for trial in trials if trial.network == POOR]
    rows = (
        _wrong(case, own),
        _ratio(case, "tip position", len(right), _tips(perfect), _tips(poor)),
        _ratio(case, "link lengths", len(right), _errors(perfect), _errors(poor)),
        Row(case, "tip position, rms [mm]", None, scaled(rms(_tips(poor)), 1e3)),
        _clocks(case, poor),
    )
    return Summary(rows, _sigmas_off(trials))


def _bad(case: str, trials: Sequence[NetworkTrial]) -> Summary:
    right = [trial for trial in trials if _right(trial)]
    off = _sigmas_off(right)
    rows = (
        _wrong(case, trials),
        coverage(case, off),
        Row(case, "tip position, rms [mm]", None, scaled(rms(_tips(right)), 1e3)),
        _clocks(case, right),
    )
    return Summary(rows, off)


def _right(trial: NetworkTrial) -> bool:
    return not trial.why and trial.topology_right


def _wrong(case: str, trials: Sequence[NetworkTrial]) -> Row:
    return count(case, "runs without the right topology", [not _right(trial) for trial in trials])


def _errors(trials: Sequence[NetworkTrial]) -> list[float]:
    return [error for trial in trials for error in trial.link_error_m]


def _tips(trials: Sequence[NetworkTrial]) -> list[float | None]:
    return [trial.tip_position_m for trial in trials]


def _ratio(
    case: str, of: str, trials: int, perfect: Sequence[float | None], poor: Sequence[float | None]
) -> Row:
    figure = f"{of}, rms error over a perfect network's"
    return Row(case, figure, None, ratio(rms(poor), rms(perfect)), None, for_few(OVER_PERFECT, trials))


def _clocks(case: str, trials: Sequence[NetworkTrial]) -> Row:
    error = scaled(rms([trial.clock_error_s for trial in trials]), 1e6)
    return Row(case, "clocks apart, rms [us]", None, error)


def _sigmas_off(trials: Sequence[NetworkTrial]) -> tuple[float, ...]:
    return tuple(
        abs(error) / sigma
        for trial in trials
        if _right(trial)
        for error, sigma in zip(trial.link_error_m, trial.link_sigma_m, strict=True)
    )
