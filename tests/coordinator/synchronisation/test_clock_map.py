"""Clocks from round trips: offset and drift are recovered, and the map undoes itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.recording.recording import Recording, RoundTrip
from coordinator.synchronisation.round_trips import BootClocks, map_clock, map_clocks
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap

MS = 1_000_000


def _trips(
    seed: int, span_s: float, offset_ns: int, drift: float, uptime_ns: int = 0, count: int = 400
) -> list[RoundTrip]:
    """Questions are slow, answers quick: every trip is lopsided, by 1 ms in the mean and 0.2 ms at least."""
    rng = np.random.default_rng(seed)
    sent = np.sort(rng.uniform(0, span_s * 1e9, count)).astype(np.int64) + 7_000 * MS
    there = 0.4 * MS + rng.gamma(0.7, 1.5 * MS, count)
    back = 0.2 * MS + rng.gamma(0.7, 0.3 * MS, count)
    answered = sent + there.astype(np.int64)
    module = uptime_ns + answered - offset_ns - np.rint(drift * answered).astype(np.int64)
    received = answered + back.astype(np.int64)
    return [RoundTrip(*(int(x) for x in row)) for row in zip(sent, received, module, strict=True)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("offset_ms", [-50, 50])
@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_offset_and_drift_are_recovered_from_lopsided_round_trips(
    seed: int, offset_ms: int, drift: float
) -> None:
    trips = _trips(seed, 60.0, offset_ms * MS, drift)
    clock_map = map_clock(trips)
    module = np.array([t.module_ns for t in trips])
    truth = np.rint((module + offset_ms * MS) / (1.0 - drift))
    error = clock_map.to_session(module) - truth
    # A trip's middle is wrong by half of how lopsided it is. The quickest are lopsided by 0.1 ms; the weights
    # leave of the others about as much again, and the slope of 400 trips varies by some ppm.
    assert np.abs(error).max() < 0.5 * MS
    assert abs(clock_map.drift - drift) < 1e-5
    # The quickest of 400 take 0.6 ms and a little; the line through the trips adds some hundredths.
    assert 0.29 * MS / np.sqrt(3.0) < clock_map.sigma_ns < 0.6 * MS / np.sqrt(3.0)
    assert clock_map.drift_sigma < 1e-5


def test_even_trips_without_jitter_give_the_clock_to_the_nanosecond() -> None:
    trips = [RoundTrip(t, t + 2 * MS, 5 * MS + t) for t in range(0, 20_000 * MS, 500 * MS)]
    clock_map = map_clock(trips)
    assert clock_map.to_session(np.array([5 * MS]))[0] == pytest.approx(MS, abs=1)
    assert abs(clock_map.drift) < 1e-12
    assert clock_map.sigma_ns == pytest.approx(MS / np.sqrt(3.0))


def test_before_and_after_a_module_boots_its_rows_follow_the_clock_of_that_boot() -> None:
    whole, so_far = Recording(), Recording()
    for serial, boot, offset_ms in (("A", 1, 50), ("B", 1, -70), ("B", 2, 90_000)):
        record = whole.module(serial, boot)
        record.has_answered = True
        record.round_trips += _trips(boot, 60.0, offset_ms * MS, 0.0)
    whole.module("B", 3)
    clocks = BootClocks(whole, ("A", "B"))
    so_far.module("A", 1)
    assert clocks.of(so_far) is None
    for boot, offset_ms in ((1, -70), (2, 90_000)):
        so_far.module("B", boot)
        maps = clocks.of(so_far)
        assert maps is not None
        at_ns = np.array([30_000 * MS])
        apart_ns = maps["B"].to_session(at_ns)[0] - maps["A"].to_session(at_ns)[0]
        assert apart_ns == pytest.approx((offset_ms - 50) * MS, abs=MS)
    # The third boot answered no request.
    so_far.module("B", 3)
    assert clocks.of(so_far) is None


def test_over_a_few_seconds_no_drift_is_read_out_of_jitter() -> None:
    clock_map = map_clock(_trips(3, 5.0, 50 * MS, 0.0))
    assert clock_map.drift == 0.0
    assert clock_map.drift_sigma == 1e-4
    assert abs(clock_map.to_session(np.array([7_000 * MS - 50 * MS]))[0] - 7_000 * MS) < 0.5 * MS


def test_a_module_that_has_run_for_years_is_mapped_as_well_as_a_fresh_one() -> None:
    year_ns = 365 * 86_400 * 10**9
    fresh, old = (map_clock(_trips(1, 60.0, 50 * MS, 1e-4, up)) for up in (0, 3 * year_ns))
    probe = np.arange(10_000 * MS, 60_000 * MS, 5_000 * MS)
    # The fit works on differences, so only the integer part of the offset is larger.
    assert np.abs(fresh.to_session(probe) - old.to_session(probe + 3 * year_ns)).max() <= 16


@settings(max_examples=200, deadline=None)
@given(
    offset=st.integers(-(10**17), 10**17),
    fraction=st.floats(-0.5, 0.5),
    drift=st.floats(-5e-4, 5e-4),
    origin=st.integers(0, 10**17),
    since=st.lists(st.integers(0, 10**14), min_size=1, max_size=5),
)
def test_mapping_there_and_back_is_the_same_instant(
    offset: int, fraction: float, drift: float, origin: int, since: list[int]
) -> None:
    clock = ClockMap(origin, offset + fraction, drift, 0.0)
    module = origin + np.array(since, dtype=np.int64)
    # One nanosecond, that of rounding, after up to a day.
    assert np.abs(clock.to_module(clock.to_session(module)) - module).max() <= 1
    session = clock.to_session(module)
    assert np.abs(clock.to_session(clock.to_module(session)) - session).max() <= 1


def test_later_stays_later() -> None:
    clock = map_clock(_trips(0, 60.0, 50 * MS, -1e-4))
    ticks = np.arange(0, 60_000 * MS, MS)
    assert (np.diff(clock.to_session(ticks)) > 0.999 * MS).all()
    assert (np.diff(clock.to_module(ticks)) > 0.999 * MS).all()


def test_a_module_that_never_answered_has_no_clock() -> None:
    with pytest.raises(DataError, match="no round trip"):
        map_clock([])


def test_modules_stay_in_step_when_the_whole_world_falls_behind() -> None:
    """A world on a busy machine runs at 0.7 to 1 times real time: all clocks alike but for crystals."""
    rng = np.random.default_rng(3)
    asked = np.arange(0.0, 100e9, 60e6)
    world = np.cumsum(0.7 + 0.3 * np.sin(asked / 7e9) ** 2) * 60e6
    clocks = {"A": (5e9, 2e-5), "B": (77e9, -3e-5), "C": (3e6, 1e-4)}

    def read(serial: str, world_ns: float) -> int:
        offset, drift = clocks[serial]
        return int(offset + world_ns * (1.0 + drift))

    trips: dict[str, list[RoundTrip]] = {serial: [] for serial in clocks}
    for late_ns, serial in enumerate(clocks):
        for sent in asked + 3e5 * late_ns:
            there, back = rng.gamma(0.7, 2e6, 2) + 3e5
            answered = float(np.interp(sent + there, asked, world))
            trips[serial].append(RoundTrip(int(sent), int(sent + there + back), read(serial, answered)))
    maps = map_clocks(trips)
    instants = np.linspace(1e9, 60e9, 30)
    mapped = {
        serial: maps[serial].to_session(np.array([read(serial, w) for w in instants], dtype=np.int64))
        for serial in clocks
    }
    # 2 ms of jitter each way: the few quick trips of 1600 leave a tenth.
    assert np.abs(mapped["B"] - mapped["A"]).max() < 0.3e6
    assert np.abs(mapped["C"] - mapped["A"]).max() < 0.3e6
    # The base runs as a module's clock does, so that accelerations come out in its seconds.
    assert np.ptp(mapped["A"] - instants) < 2e-5 * 60e9 + 10


@pytest.mark.parametrize("asymmetry_ms", [0.0, 2.0, 4.0])
def test_a_way_there_that_is_longer_misleads_by_half_the_difference_and_that_is_within_three_sigma(
    asymmetry_ms: float,
) -> None:
    trips = [
        RoundTrip(trip.sent_ns - round(asymmetry_ms * MS), trip.received_ns, trip.module_ns)
        for trip in _trips(4, 60.0, 50 * MS, 1e-4)
    ]
    clock_map = map_clock(trips)
    module = np.array([trip.module_ns for trip in trips])
    error = clock_map.to_session(module) - np.rint((module + 50 * MS) / (1.0 - 1e-4))
    # The trips are lopsided by about a tenth of a millisecond themselves.
    assert abs(error.mean() + 0.5 * asymmetry_ms * MS) < 0.2 * MS
    # All of the quickest trip may have been on the way there: half of it is root three sigmas.
    assert abs(error.mean()) < 1.8 * clock_map.sigma_ns


def test_sigmas_of_offset_and_drift_are_those_of_the_errors() -> None:
    """Even networks with a heavy tail: what is left is chance, and so its size is what is claimed."""
    span_ns, normalised = 60e9, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        sent = np.sort(rng.uniform(0.0, span_ns, 900)).astype(np.int64)
        there, back = (rng.gamma(0.7, 4.0 * MS, (2, 900))).astype(np.int64)
        trips = [
            RoundTrip(int(s), int(s + d + u), int(s + d)) for s, d, u in zip(sent, there, back, strict=True)
        ]
        clock_map = map_clock(trips)
        # Without a least delay nothing of sigma is asymmetry.
        error = float(clock_map.to_session(np.array([clock_map.origin_ns]))[0] - clock_map.origin_ns)
        normalised.append((error / clock_map.sigma_ns, clock_map.drift / clock_map.drift_sigma))
    scatter = np.sqrt(np.mean(np.square(normalised), axis=0))
    # 60 draws know a standard deviation to 9 %; of 120 moments of unequal weight few count, which costs a
    # third more at most.
    assert (scatter > 0.7).all()
    assert (scatter < 1.6).all()
