"""What a network profile may say, and what the named ones amount to."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from module_agent.network_emulation.channel import Channel
from module_agent.network_emulation.profile import (
    PROFILES,
    LossBurst,
    NetworkProfile,
    PathProfile,
    Receiver,
    Stall,
)

RECEIVERS: tuple[Receiver, ...] = ("module", "coordinator")
PROBABILITY = st.floats(0.0, 1.0)
MILLISECONDS = st.floats(0.0, 10_000.0)
BURST = {"apart_s": st.floats(1e-3, 1e5), "mean_ms": st.floats(0.1, 10_000.0)}


def field_values() -> st.SearchStrategy[dict[str, object]]:
    """Any of the fields of a path, each within its own bounds."""
    return st.fixed_dictionaries(
        {},
        optional={
            "delay_ms": MILLISECONDS,
            "spread_ms": MILLISECONDS,
            "jitter": st.sampled_from(["gamma", "lognormal", "pareto"]),
            "jitter_ms": MILLISECONDS,
            "jitter_shape": st.floats(0.01, 100.0),
            "loss": PROBABILITY,
            "loss_burst": st.builds(LossBurst, loss=PROBABILITY, **BURST),
            "stall": st.builds(Stall, **BURST),
            "reorder": PROBABILITY,
            "duplicate": PROBABILITY,
        },
    )


def has_a_variance(fields: dict[str, object]) -> bool:
    return fields.get("jitter") != "pareto" or fields.get("jitter_shape", 1.0) < 1.0  # type: ignore[operator]


@given(field_values(), field_values(), field_values(), st.integers(0, 2**32))
def test_fields_within_bounds_make_a_profile_unless_a_pareto_jitter_has_no_variance(
    common, up, down, seed
) -> None:
    def build() -> NetworkProfile:
        return NetworkProfile(
            name="drawn", to_coordinator=PathProfile(**up), to_modules=PathProfile(**down), **common
        )

    if not (has_a_variance(common | up) and has_a_variance(common | down)):
        with pytest.raises(ValidationError, match="that of a pareto jitter is less than 1"):
            build()
        return
    found = build()
    for receiver, own in (("coordinator", up), ("module", down)):
        path = found.path(receiver)
        assert path == PathProfile(**(common | own))
        fate = Channel(path, np.random.default_rng(seed)).fate(0.0)
        assert np.isfinite(fate.delay_s)
        assert fate.delay_s >= 1e-3 * path.delay_ms


@pytest.mark.parametrize(
    "wrong",
    [
        {"delay_ms": -1.0},
        {"delay_ms": float("nan")},
        {"spread_ms": float("inf")},
        {"jitter": "normal"},
        {"jitter_shape": 0.0},
        {"loss": 1.5},
        {"reorder": -0.1},
        {"stall": {"apart_s": 0.0, "mean_ms": 1.0}},
        {"stall": {"apart_s": 1.0}},
        {"stall": {"apart_s": 1.0, "mean_ms": 1.0, "loss": 0.5}},
        {"loss_burst": {"apart_s": 1.0, "mean_ms": 1.0, "loss": 2.0}},
        {"latency_ms": 1.0},
    ],
)
def test_what_no_network_does_is_refused_in_either_direction_and_in_both(wrong: dict[str, object]) -> None:
    (key,) = wrong
    for fields in (wrong, {"to_modules": wrong}, {"to_coordinator": wrong}):
        with pytest.raises(ValidationError, match=key):
            NetworkProfile.model_validate({"name": "wrong", **fields})


@given(st.lists(st.floats(0.0, 1e6), max_size=8))
def test_partitions_follow_one_another(times_s: list[float]) -> None:
    pairs = list(zip(times_s[::2], times_s[1::2], strict=False))
    flat = [t for pair in pairs for t in pair]
    right = flat == sorted(flat) and all(start < end for start, end in pairs)
    if right:
        assert NetworkProfile(name="parted", partitions=tuple(pairs)).partitions == tuple(pairs)
    else:
        with pytest.raises(ValidationError, match="partitions"):
            NetworkProfile(name="parted", partitions=tuple(pairs))


def test_a_direction_replaces_what_it_names_and_keeps_the_rest() -> None:
    found = NetworkProfile(
        name="t", delay_ms=1.0, loss=0.1, to_coordinator=PathProfile(loss=0.0, jitter_ms=2.0)
    )
    assert found.path("module") == PathProfile(delay_ms=1.0, loss=0.1)
    assert found.path("coordinator") == PathProfile(delay_ms=1.0, loss=0.0, jitter_ms=2.0)


def test_only_a_path_that_does_nothing_is_perfect() -> None:
    assert PathProfile(reorder=1.0, jitter_shape=0.5).is_perfect
    for fields in (
        {"delay_ms": 0.1},
        {"spread_ms": 0.1},
        {"jitter_ms": 0.1},
        {"loss": 0.1},
        {"duplicate": 0.1},
        {"stall": Stall(apart_s=1.0, mean_ms=1.0)},
        {"loss_burst": LossBurst(apart_s=1.0, mean_ms=1.0)},
    ):
        assert not PathProfile(**fields).is_perfect


def mean_delay_ms(path: PathProfile) -> float:
    """The mean of what a message waits: base, jitter, and the rest of a stall, which has no memory."""
    stalled = 0.0
    if path.stall is not None:
        bad_s = 1e-3 * path.stall.mean_ms
        stalled = bad_s / (bad_s + path.stall.apart_s) * path.stall.mean_ms
    return path.delay_ms + 0.5 * path.spread_ms + path.jitter_ms + stalled


def mean_loss(path: PathProfile) -> float:
    if path.loss_burst is None:
        return path.loss
    bad_s = 1e-3 * path.loss_burst.mean_ms
    share = bad_s / (bad_s + path.loss_burst.apart_s)
    return share * path.loss_burst.loss + (1.0 - share) * path.loss


@pytest.mark.parametrize(
    ("name", "round_trip_ms", "loss"),
    [
        ("none", 0.0, 0.0),
        ("lan", 0.7, 0.0),
        ("lossy", 0.7, 0.05),
        ("wifi", 9.4, 0.011),
        ("bad", 56.6, 0.048),
        ("asymmetric", 11.6, 0.0),
    ],
)
def test_a_named_profile_delays_and_loses_as_much_as_is_known_of_it(name, round_trip_ms, loss) -> None:
    paths = [PROFILES[name].path(receiver) for receiver in RECEIVERS]
    assert sum(mean_delay_ms(path) for path in paths) == pytest.approx(round_trip_ms, abs=0.05)
    assert np.mean([mean_loss(path) for path in paths]) == pytest.approx(loss, abs=0.001)


def test_what_is_computed_of_a_profile_is_what_its_channels_do() -> None:
    number = 100_000
    for name in ("wifi", "bad", "asymmetric"):
        for receiver in RECEIVERS:
            path = PROFILES[name].path(receiver)
            found = []
            for seed in range(20):
                channel = Channel(path, np.random.default_rng(seed))
                # Messages 0.1 s apart: a stall then hardly ever holds two, and they are independent enough.
                found += [channel.fate(0.1 * i) for i in range(number // 20)]
            delays_ms = 1e3 * np.array([fate.delay_s for fate in found])
            # Five standard deviations of a mean; 20 endpoints each with a base of its own count as 20.
            bound_ms = 5 * (delays_ms.std() / np.sqrt(number) + path.spread_ms / np.sqrt(12 * 20))
            assert abs(delays_ms.mean() - mean_delay_ms(path)) < bound_ms
            expected = mean_loss(path)
            lost = np.mean([fate.lost for fate in found])
            assert abs(lost - expected) <= 5 * np.sqrt(expected / number)
