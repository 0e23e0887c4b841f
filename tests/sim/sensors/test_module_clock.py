import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sim.imperfections.noise_profile import noise_profile
from sim.sensors.module_clock import ModuleClock, draw_clock, module_time

clocks = st.builds(ModuleClock, st.integers(0, 10**11), st.integers(-(10**5), 10**5))
days = st.integers(0, 30 * 86_400 * 10**9)


@given(clock=clocks, t_ns=days, later_ns=st.integers(2, 10**12))
def test_a_clock_never_stands_still(clock: ModuleClock, t_ns: int, later_ns: int) -> None:
    assert module_time(clock, t_ns + later_ns) > module_time(clock, t_ns)


@given(clock=clocks, tick=st.integers(0, 30 * 86_400 * 1000))
def test_stamps_of_successive_ticks_are_a_tick_apart_to_the_drift_and_a_nanosecond(
    clock: ModuleClock, tick: int
) -> None:
    apart = module_time(clock, (tick + 1) * 1_000_000) - module_time(clock, tick * 1_000_000)
    assert abs(apart - 1_000_000 - clock.drift_ppb / 1000) <= 1


def test_a_clock_of_twenty_ppm_gains_seventy_two_milliseconds_in_an_hour() -> None:
    clock = ModuleClock(offset_ns=5, drift_ppb=20_000)
    assert module_time(clock, 3600 * 10**9) - 5 - 3600 * 10**9 == 72_000_000


def test_drawn_clocks_are_spread_as_the_profile_says() -> None:
    rng = np.random.default_rng(1)
    drawn = np.array([draw_clock(rng, noise_profile("x5")) for _ in range(2000)])
    offset_s, drift_ppb = drawn[:, 0] / 1e9, drawn[:, 1]
    assert 1.0 <= offset_s.min() < 2.0
    assert 99.0 < offset_s.max() <= 100.0
    # One sigma of the deviation of 2000 draws is 1.6 %.
    assert abs(drift_ppb.std() / 20_000 - 1.0) < 0.07
