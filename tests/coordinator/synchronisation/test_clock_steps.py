"""A clock that leaps or stands is told from agents that are held up and worlds that fall behind."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.recording.recording import RoundTrip
from coordinator.synchronisation.clock_steps import CRYSTAL, STEP_TRIPS, clocks_that_stood, leapt

EVERY_NS, SECONDS = 60_000_000, 20
# From the middle on something is otherwise.
MIDDLE_NS = 10_000_000_000
Behind = Callable[[float], float]


def trips(behind_ns: Behind, keep: Callable[[int], bool] = lambda t: True) -> list[RoundTrip]:
    """Trips of 2 ms; the module's clock is behind the session's by `behind_ns(session time)`."""
    return [
        RoundTrip(t, t + 2_000_000, t + 1_000_000 - int(behind_ns(t + 1_000_000)))
        for t in range(0, SECONDS * 1_000_000_000, EVERY_NS)
        if keep(t)
    ]


def stood_ns(own: list[RoundTrip], witnesses: list[list[RoundTrip]]) -> float | None:
    """What is said of a module, by others that are asked along with it."""
    others = {f"W{k}": witness for k, witness in enumerate(witnesses)}
    return clocks_that_stood({"A": own} | others).get("A")


def later(size_ns: float, since_ns: float = MIDDLE_NS) -> Behind:
    return lambda t: size_ns if t > since_ns else 0.0


def both(*behind: Behind) -> Behind:
    return lambda t: sum(one(t) for one in behind)


STILL, CRYSTALS = trips(lambda t: 0.0), trips(lambda t: 1e-4 * t)


def test_a_clock_that_leaps_is_told_from_a_world_that_falls_behind_and_a_crystal_that_drifts() -> None:
    early = trips(later(-50e6))
    assert leapt(early, [STILL], MIDDLE_NS)
    assert not leapt(STILL, [STILL], MIDDLE_NS)
    assert not leapt(trips(lambda t: -1e-4 * t), [STILL], MIDDLE_NS)
    assert not leapt(trips(later(50e6)), [STILL], MIDDLE_NS)
    # A simulated world that catches up makes all modules early.
    assert not leapt(early, [early], MIDDLE_NS)


@pytest.mark.parametrize("size_ns", [25e6, 570e6])
def test_a_clock_that_stood_is_behind_the_others_from_then_on(size_ns: float) -> None:
    # The trips to two modules bound their difference within the length of both; and crystals drift.
    within_ns = 4e6 + 2.0 * CRYSTAL * 2 * STEP_TRIPS * EVERY_NS
    stood = trips(later(size_ns))
    for witnesses in ([STILL], [CRYSTALS, stood, STILL], [[], CRYSTALS]):
        assert stood_ns(stood, witnesses) == pytest.approx(size_ns, abs=within_ns)
    # The session's clock leaps later on, for all of them, and by more.
    leap = later(1e9, 15e9)
    assert stood_ns(trips(both(later(size_ns), leap)), [trips(leap)]) == pytest.approx(size_ns, abs=within_ns)


def test_without_enough_trips_or_a_witness_nothing_is_known() -> None:
    stood = trips(later(30e6))
    assert stood_ns(stood, []) is None
    assert stood_ns(stood, [[]]) is None
    assert stood_ns([], [STILL]) is None
    few = [one for one in stood if abs(one.sent_ns - MIDDLE_NS) < (STEP_TRIPS - 1) * EVERY_NS]
    assert stood_ns(few, [STILL]) is None


def test_a_world_that_falls_behind_and_a_witness_that_leaps_are_no_step_of_ones_own() -> None:
    stood = trips(later(30e6))
    assert stood_ns(stood, [stood, stood]) is None
    # Of two witnesses that differ neither is believed.
    assert stood_ns(stood, [stood, STILL]) is None
    assert stood_ns(CRYSTALS, [STILL]) is None
    assert stood_ns(STILL, [CRYSTALS]) is None
    # The witness is ahead from the middle on, or the module itself.
    assert stood_ns(STILL, [trips(later(-300e6))]) is None
    assert stood_ns(trips(later(-30e6)), [STILL]) is None
    # It leaps as the world slips: the module is behind it, and behind the session by less.
    assert stood_ns(trips(later(20e6)), [trips(later(-280e6))]) is None


@pytest.mark.parametrize("share", [0.05, 0.1])
@pytest.mark.parametrize("size_ns", [25e6, 100e6])
def test_a_witness_that_leaps_in_a_slow_world_is_no_step_of_ones_own(share: float, size_ns: float) -> None:
    """All modules are late, more and more."""

    def slow(t: float) -> float:
        return share * t

    assert stood_ns(trips(slow), [trips(both(slow, later(-size_ns)))]) is None
    assert stood_ns(trips(both(slow, later(size_ns))), [trips(slow)]) is not None


def test_an_hour_between_trips_is_time_for_crystals_to_drift() -> None:
    """350 ppm of each other are 1.3 s in an hour; a session that is resumed has such a gap in its trips."""
    pause_ns = 3600 * 1_000_000_000

    def resumed(fast: float) -> list[RoundTrip]:
        return [
            RoundTrip(
                one.sent_ns + pause, one.received_ns + pause, round((1.0 + fast) * (one.module_ns + pause))
            )
            for pause in (0, pause_ns)
            for one in trips(lambda t: 0.0)
        ]

    for fast in (3.5e-4, -3.5e-4):
        assert stood_ns(resumed(0.0), [resumed(fast)]) is None
        assert stood_ns(resumed(fast), [resumed(0.0)]) is None


def test_crystals_that_drift_for_long_hide_no_step() -> None:
    """The witness is slower: after five minutes it is behind by half of what the module stood."""
    stood = [t for k in range(15) for t in _shifted(trips(later(30e6) if k == 0 else lambda t: 30e6), k)]
    slower = [
        t._replace(module_ns=round((1.0 - 5e-5) * t.module_ns)) for k in range(15) for t in _shifted(STILL, k)
    ]
    assert stood_ns(stood, [slower]) == pytest.approx(30e6, abs=6e6)


def _shifted(some: list[RoundTrip], k: int) -> list[RoundTrip]:
    return [RoundTrip(*(t + k * SECONDS * 1_000_000_000 for t in trip)) for trip in some]


def test_those_are_asked_who_were_asked_at_the_same_moments() -> None:
    """Modules of a large robot are asked by turns: three have other turns, and one has the same."""
    stood, moved = trips(later(30e6)), [_at_once(STILL, 20_000_000)] * 3
    assert stood_ns(stood, moved) is None
    assert stood_ns(stood, [*moved, STILL]) == pytest.approx(30e6, abs=5e6)


def _at_once(some: list[RoundTrip], later_ns: int) -> list[RoundTrip]:
    return [RoundTrip(*(t + later_ns for t in trip)) for trip in some]


@pytest.mark.parametrize("held_ns", [0.3e9, 0.7e9, 0.9e9, 3e9])
def test_a_module_that_is_silent_as_the_world_slips_is_not_accused_nor_are_others(held_ns: float) -> None:
    """A world waits 0.18 s for a frozen agent, and all clocks are behind by that; it answers again later."""
    slip = later(180e6)
    frozen = trips(slip, lambda t: not MIDDLE_NS - 1e8 < t < MIDDLE_NS + held_ns)
    healthy = trips(slip)
    assert stood_ns(frozen, [healthy, healthy]) is None
    assert stood_ns(healthy, [frozen]) is None
    assert stood_ns(healthy, [frozen, healthy]) is None


@pytest.mark.parametrize("share", [0.05, 0.1, 0.2])
def test_a_slow_world_with_gaps_between_answers_accuses_no_module(share: float) -> None:
    def slow(t: float) -> float:
        return share * t

    sparse = trips(slow, lambda t: not MIDDLE_NS < t < MIDDLE_NS + 0.9e9)
    assert stood_ns(sparse, [trips(slow)]) is None
    assert stood_ns(trips(slow), [sparse]) is None


@pytest.mark.parametrize("count", [1, 6, 40])
def test_answers_that_were_held_up_are_no_step_of_a_clock(count: int) -> None:
    """So many answers come late, all at once, or with the time at which the module was held up."""
    until_ns = MIDDLE_NS + count * EVERY_NS
    held = [MIDDLE_NS < one.sent_ns <= until_ns for one in STILL]
    waited = [
        one._replace(received_ns=until_ns + 5_000_000) if late else one
        for one, late in zip(STILL, held, strict=True)
    ]
    stale = [
        one._replace(module_ns=MIDDLE_NS) if late else one for one, late in zip(STILL, held, strict=True)
    ]
    assert stood_ns(waited, [STILL]) is None
    assert stood_ns(stale, [STILL]) is None
    assert stood_ns(STILL, [waited]) is None


def test_requests_that_take_longer_as_the_world_slips_are_no_step_of_another_clock() -> None:
    """A machine that is too busy does both: the witness is asked later, and so reads more."""
    slip, longer_ns = later(300e6), 300_000_000
    asked_late = [
        RoundTrip(t.sent_ns, t.received_ns + longer_ns, t.module_ns + longer_ns)
        if t.sent_ns > MIDDLE_NS
        else t
        for t in trips(slip)
    ]
    assert stood_ns(trips(slip), [asked_late]) is None
    assert stood_ns(asked_late, [trips(slip)]) is None


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    slips=st.lists(st.tuples(st.floats(1e9, 19e9), st.floats(1e6, 1e9)), max_size=4),
    slow=st.floats(0.0, 0.3),
    lost=st.floats(0.0, 0.9),
    longest_ns=st.floats(2e6, 4e8),
)
def test_whatever_the_world_and_the_network_do_no_sound_clock_is_accused(
    seed: int, slips: list[tuple[float, float]], slow: float, lost: float, longest_ns: float
) -> None:
    """Two modules of a world that slips and is slow, over a network that loses answers and delays them."""
    draw = np.random.default_rng(seed)

    def world_ns(t: float) -> float:
        return (1.0 - slow) * t - sum(min(max(t - at, 0.0), size) for at, size in slips)

    modules: list[list[RoundTrip]] = []
    for rate in draw.uniform(1.0 - 1e-4, 1.0 + 1e-4, 2):
        made = []
        for sent in range(0, SECONDS * 1_000_000_000, EVERY_NS):
            there, back = draw.uniform(0.3e6, 0.5 * longest_ns, 2)
            if draw.uniform() >= lost:
                stamp = int(rate * world_ns(sent + there))
                made.append(RoundTrip(sent, int(sent + there + back), stamp))
        modules.append(made)
    one, other = modules
    assert stood_ns(one, [other]) is None
    assert stood_ns(other, [one]) is None
