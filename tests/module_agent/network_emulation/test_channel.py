"""Fates of messages: moments of the jitter, bursts and stalls against theory, traces to the row."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from module_agent.network_emulation.channel import BadTimes, Channel, Fate, jitter_ms
from module_agent.network_emulation.profile import Burst, Jitter, LossBurst, PathProfile, Stall
from module_agent.network_emulation.trace import NetworkTrace, TraceRow

JITTERS: tuple[Jitter, ...] = ("gamma", "lognormal", "pareto")


def fates(path: PathProfile, times_s: Sequence[float], seed: int = 0) -> list[Fate]:
    channel = Channel(path, np.random.default_rng(seed))
    return [channel.fate(t_s) for t_s in times_s]


def theory(path: PathProfile) -> stats.rv_continuous:
    """The distribution by scipy, parametrised on its own from mean and standard deviation."""
    mean, deviation = path.jitter_ms, path.jitter_ms / np.sqrt(path.jitter_shape)
    if path.jitter == "gamma":
        return stats.gamma((mean / deviation) ** 2, scale=deviation**2 / mean)
    if path.jitter == "lognormal":
        sigma = np.sqrt(np.log1p((deviation / mean) ** 2))
        return stats.lognorm(sigma, scale=mean / np.sqrt(1.0 + (deviation / mean) ** 2))
    index = 2.0 * deviation**2 / (deviation**2 - mean**2)
    return stats.lomax(index, scale=mean * (index - 1.0))


@pytest.mark.parametrize("jitter", JITTERS)
@pytest.mark.parametrize("shape", [0.3, 0.7, 0.95])
def test_every_jitter_has_the_mean_and_deviation_of_the_profile_and_its_own_tail(jitter, shape) -> None:
    path = PathProfile(jitter=jitter, jitter_ms=4.0, jitter_shape=shape)
    expected = theory(path)
    assert expected.mean() == pytest.approx(4.0)
    assert expected.std() == pytest.approx(4.0 / np.sqrt(shape))
    number = 20_000
    drawn = jitter_ms(path, np.random.default_rng(1), (number,))
    # One seed, nine cases: a right distribution fails one of them with a probability of 1 %.
    assert stats.kstest(drawn, expected.cdf).pvalue > 1e-3
    # Five standard deviations of a mean.
    assert abs(drawn.mean() - 4.0) < 5 * expected.std() / np.sqrt(number)


def test_without_jitter_the_delay_is_the_least_delay() -> None:
    for jitter in JITTERS:
        path = PathProfile(delay_ms=2.0, jitter=jitter, jitter_shape=0.5)
        assert {fate.delay_s for fate in fates(path, [0.0] * 300)} == {2e-3}


def test_each_endpoint_has_a_base_delay_of_its_own_and_keeps_it() -> None:
    path = PathProfile(delay_ms=1.0, spread_ms=4.0)
    bases_ms = []
    for seed in range(200):
        delays = {fate.delay_s for fate in fates(path, [0.0, 1.0, 2.0], seed)}
        assert len(delays) == 1
        bases_ms.append(1e3 * delays.pop())
    assert stats.kstest(bases_ms, stats.uniform(1.0, 4.0).cdf).pvalue > 1e-3


# --------------------------------------------------------------------------- bursts in continuous time


def intervals(burst: Burst, end_s: float, seed: int, step_s: float) -> list[tuple[float, float]]:
    """Look at a chain in steps; return the bad intervals as (first seen, end)."""
    bad = BadTimes(burst, np.random.default_rng(seed))
    found: dict[float, float] = {}
    for t_s in np.arange(0.0, end_s, step_s).tolist():
        if (end := bad.end_s(t_s)) is not None:
            found.setdefault(end, t_s)
    return [(start, end) for end, start in found.items()]


def test_bad_times_and_the_times_between_them_are_exponential() -> None:
    burst = Burst(apart_s=0.5, mean_ms=50.0)
    step_s = 1e-3
    found = intervals(burst, 1500.0, 4, step_s)
    durations = np.array([end - start for start, end in found[1:]])
    gaps = np.array([after[0] - before[1] for before, after in pairwise(found)])
    # About 2700 bad times: means to five standard deviations, and a step of the looking for its coarseness.
    assert abs(durations.mean() - 0.05) < 5 * 0.05 / np.sqrt(len(durations)) + step_s
    assert abs(gaps.mean() - 0.5) < 5 * 0.5 / np.sqrt(len(gaps)) + step_s
    # Bad times shorter than the step are partly missed: compared from five steps on, both being memoryless.
    for seen, mean_s in ((durations, 0.05), (gaps, 0.5)):
        late = seen[seen > 5 * step_s] - 5 * step_s
        assert stats.kstest(late, stats.expon(scale=mean_s).cdf).pvalue > 1e-3


def test_when_a_burst_comes_does_not_depend_on_how_often_one_looks() -> None:
    burst = Burst(apart_s=0.5, mean_ms=50.0)
    fine = {end for _, end in intervals(burst, 100.0, 7, 1e-3)}
    coarse = {end for _, end in intervals(burst, 100.0, 7, 37e-3)}
    assert len(coarse) > 50
    assert coarse <= fine


def test_a_chain_begins_in_its_steady_state() -> None:
    burst = Burst(apart_s=0.03, mean_ms=10.0)
    number = 4000
    bad = sum(BadTimes(burst, np.random.default_rng(seed)).end_s(0.0) is not None for seed in range(number))
    # A quarter of the time is bad; five standard deviations of a binomial.
    assert abs(bad / number - 0.25) < 5 * np.sqrt(0.25 * 0.75 / number)


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0])
def test_losses_come_in_bursts_as_gilbert_and_elliott_have_it_at_any_rate(rate_hz: float) -> None:
    apart_s, bad_s, low, high = 0.2, 0.05, 0.01, 0.6
    path = PathProfile(loss=low, loss_burst=LossBurst(apart_s=apart_s, mean_ms=1e3 * bad_s, loss=high))
    step_s, seconds = 1.0 / rate_hz, 800.0
    times_s = np.arange(0.0, seconds, step_s)
    lost = np.array([fate.lost for fate in fates(path, times_s.tolist(), 11)], float)
    share = bad_s / (bad_s + apart_s)
    mean = share * high + (1.0 - share) * low
    # The state's autocovariance is p (1 - p) exp(-t (1/bad + 1/apart)), so that of the losses is that times
    # (high - low)^2; the variance of a mean over T is 2 p (1 - p) (high - low)^2 / (T (1/bad + 1/apart)).
    decay_hz = 1.0 / bad_s + 1.0 / apart_s
    slow = share * (1.0 - share) * (high - low) ** 2
    deviation = np.sqrt(2.0 * slow / (seconds * decay_hz) + mean * (1.0 - mean) / len(lost))
    assert abs(lost.mean() - mean) < 5 * deviation
    for lag in (1, 3):
        measured = np.mean((lost[:-lag] - mean) * (lost[lag:] - mean))
        # The product's own scatter, with an effective sample for each correlation time; five deviations.
        samples = min(len(lost), seconds * decay_hz / 2.0)
        assert abs(measured - slow * np.exp(-lag * step_s * decay_hz)) < 5 * 0.25 / np.sqrt(samples)


def test_in_good_times_the_loss_is_the_profiles_own() -> None:
    path = PathProfile(loss=0.2, loss_burst=LossBurst(apart_s=1e5, mean_ms=0.1, loss=1.0))
    number = 20_000
    lost = sum(fate.lost for fate in fates(path, [1e-3 * i for i in range(number)]))
    assert abs(lost / number - 0.2) < 5 * np.sqrt(0.2 * 0.8 / number)


def test_a_stall_holds_every_message_until_its_end_and_lets_all_go_together() -> None:
    path = PathProfile(delay_ms=1.0, stall=Stall(apart_s=0.5, mean_ms=40.0))
    times_s = [1e-3 * i for i in range(60_000)]
    found = fates(path, times_s, 2)
    held = [(t, t + f.delay_s) for t, f in zip(times_s, found, strict=True) if f.delay_s > 1.001e-3]
    # In a stall of 40 ms one in 13.5 of all milliseconds passes; 110 stalls, five standard deviations.
    assert abs(len(held) / 60_000 - 0.04 / 0.54) < 5 * 0.04 / 0.54 * np.sqrt(2.0 / 110)
    releases = {round(arrival, 9) for _, arrival in held}
    assert 70 < len(releases) < 150
    assert all(arrival > t for t, arrival in held)
    arrivals = [t + f.delay_s for t, f in zip(times_s, found, strict=True)]
    assert all(b >= a - 1e-12 for a, b in pairwise(arrivals))


# --------------------------------------------------------------------------- traces

ROWS = (
    TraceRow(0.0, 5.0, False),
    TraceRow(0.5, 8.0, False),
    TraceRow(0.75, 0.0, True),
    TraceRow(1.0, 2.0, False),
)


def test_a_trace_is_replayed_to_the_row_round_and_round() -> None:
    # The last row holds for 0.25 s, as long as the one before it.
    path = PathProfile(trace=NetworkTrace(rows=ROWS))
    times_s = [0.0, 0.25, 0.5, 0.625, 0.75, 0.875, 1.0, 1.125, 1.25, 1.75, 2.0, 2.25, 125.0, 125.5]
    expected = [5, 5, 8, 8, None, None, 2, 2, 5, 8, None, 2, 5, 8]
    for fate, delay_ms in zip(fates(path, times_s), expected, strict=True):
        assert fate.lost is (delay_ms is None)
        if delay_ms is not None:
            assert fate.delay_s == 1e-3 * delay_ms


def test_a_trace_comes_on_top_of_the_profiles_own_delay_and_loss() -> None:
    path = PathProfile(delay_ms=3.0, loss=0.5, trace=NetworkTrace(rows=ROWS[:2]))
    found = fates(path, [0.6] * 1000)
    assert {round(fate.delay_s, 12) for fate in found} == {0.011}
    assert 400 < sum(fate.lost for fate in found) < 600


def test_a_trace_of_one_row_holds_for_ever() -> None:
    trace = NetworkTrace(rows=ROWS[:1])
    assert {trace.at(t_s) for t_s in (0.0, 1.0, 1e9)} == {ROWS[0]}


# --------------------------------------------------------------------------- reproducible

FULL = PathProfile(
    delay_ms=2.0,
    spread_ms=3.0,
    jitter_ms=4.0,
    jitter_shape=0.7,
    loss=0.1,
    loss_burst=LossBurst(apart_s=0.3, mean_ms=30.0, loss=0.8),
    stall=Stall(apart_s=0.2, mean_ms=20.0),
    reorder=0.2,
    duplicate=0.1,
)


GOLDEN = (
    "x+15174 8178 13917 x~ 2893~ x 4524 x~ 3755 2893 11167~ 12488+18840 12010 "
    "17692~ 2918 19897 4332 3924 x 3277 3628 6231 9649 5642+8658"
)


def test_a_seed_gives_these_fates_and_no_others() -> None:
    """The golden record: another one is another experiment under the same seed."""

    def shown(fate: Fate) -> str:
        delay = "x" if fate.lost else str(round(1e6 * fate.delay_s))
        copy = f"+{round(1e6 * fate.copy_delay_s)}" if fate.copy_delay_s is not None else ""
        return delay + "~" * fate.reordered + copy

    found = fates(FULL, [0.02 * i for i in range(24)], 2027)
    assert " ".join(shown(fate) for fate in found) == GOLDEN


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**64), st.lists(st.floats(0.0, 0.1), max_size=50))
def test_the_same_seed_and_times_give_the_same_fates(seed: int, gaps_s: list[float]) -> None:
    times_s = np.cumsum(gaps_s).tolist()
    assert fates(FULL, times_s, seed) == fates(FULL, times_s, seed)
