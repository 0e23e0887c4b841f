"""The network is checked before anything moves, by its rates and round trips and not by a short outage."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from coordinator.live_robot.errors import UnfitLink
from coordinator.live_robot.link_check import MAX_MEASUREMENTS, check_link
from coordinator.recording.recording import RoundTrip
from module_agent.network_emulation.profile import PROFILES, NetworkProfile, PathProfile

ARM = "thesis_171_horizontal"
BASE, TIP = "X-00009", "X-00010"
MEASUREMENT_S = 0.4
SECOND_S = 1.0


def _checked(rig: Any, duration_s: float = MEASUREMENT_S) -> list[str]:
    """Meet both modules, check the link, and return what was noted."""
    _, _, group = rig.group()
    notes: list[str] = []

    async def work() -> None:
        await asyncio.sleep(0.2)
        await group.meet((BASE, TIP))
        await check_link(group, lambda: rig.loop.now_ns, duration_s, notes.append)

    rig.run(work())
    return notes


def test_every_module_is_noted_with_its_rate_and_round_trips(rigs: Callable[..., Any]) -> None:
    notes = _checked(rigs(ARM, "lan"))
    assert [note.split(" ")[0] for note in notes] == [BASE, TIP]
    assert all("rows/s, round trip" in note for note in notes)


@pytest.mark.parametrize("seed", range(8))
def test_a_bad_network_that_carries_keep_alives_is_fit(rigs: Callable[..., Any], seed: int) -> None:
    # Round trips of 60 ms in the mean; one in twenty takes more than half of the 250 ms that commands live.
    assert len(_checked(rigs(ARM, "bad", seed), SECOND_S)) == 2


def test_too_many_slow_trips_are_unfit_with_name_and_number(rigs: Callable[..., Any]) -> None:
    with pytest.raises(UnfitLink, match=rf"to module {BASE} one in five takes more than 30\d ms"):
        _checked(rigs(ARM, NetworkProfile(name="slow", delay_ms=150.0)))


def test_a_module_slower_than_its_feedback_rate_is_unfit(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, recording, group = rig.group()

    async def work() -> None:
        await asyncio.sleep(0.2)
        await group.meet((BASE, TIP))
        # As from a module on a machine that is too slow for its feedback rate.
        info = recording.modules[TIP].info
        recording.modules[TIP].info = info.model_copy(update={"feedback_rate_hz": 1000.0})
        await check_link(group, lambda: rig.loop.now_ns, MEASUREMENT_S, lambda note: None)

    with pytest.raises(UnfitLink, match=rf"unfit: module {TIP} delivers 2\d\d rows/s of 1000"):
        rig.run(work())


def test_a_second_module_with_the_same_serial_is_named_though_it_answers_nothing(
    rigs: Callable[..., Any],
) -> None:
    rig = rigs(ARM, "lan")
    _, recording, group = rig.group()

    async def work() -> None:
        await asyncio.sleep(0.2)
        await group.meet((BASE, TIP))
        # It is heard of once, and the first one goes on.
        recording.module(TIP, boot=recording.modules[TIP].boot + 1).info = recording.modules[BASE].info
        await check_link(group, lambda: rig.loop.now_ns, MEASUREMENT_S, lambda note: None)

    with pytest.raises(UnfitLink, match=rf"unfit: module {TIP} booted anew .* or a second module has its"):
        rig.run(work())


def test_feedback_that_the_network_loses_is_unfit(rigs: Callable[..., Any]) -> None:
    """Rows are numbered: the newest number alone does not tell how many have come."""
    losing = PROFILES["lan"].model_copy(update={"to_coordinator": PathProfile(loss=0.7)})
    rig = rigs(ARM, losing)
    with pytest.raises(UnfitLink, match=r"delivers \d\d? rows/s of 250"):
        _checked(rig, SECOND_S)


@pytest.mark.parametrize("delay_ms", [0.1, 150.0])
def test_what_came_before_the_check_does_not_count(rigs: Callable[..., Any], delay_ms: float) -> None:
    """A session that is resumed after its network was mended, or has broken, has its old round trips."""
    rig = rigs(ARM, NetworkProfile(name="now", delay_ms=delay_ms))
    _, recording, group = rig.group()
    old_ns = 1_000_000 if delay_ms > 1.0 else 400_000_000

    async def work() -> None:
        await asyncio.sleep(0.5)
        await group.meet((BASE, TIP))
        for serial in (BASE, TIP):
            recording.modules[serial].round_trips += [RoundTrip(0, old_ns, 0)] * 3000
        await check_link(group, lambda: rig.loop.now_ns, MEASUREMENT_S, lambda note: None)

    if delay_ms > 1.0:
        with pytest.raises(UnfitLink, match="one in five takes more than 30"):
            rig.run(work())
    else:
        rig.run(work())


def test_a_short_outage_is_measured_again(rigs: Callable[..., Any]) -> None:
    # Partitioned during most of the first measurement only.
    parted = PROFILES["lan"].model_copy(update={"partitions": ((0.25, 0.55),)})
    rig = rigs(ARM, parted)
    assert len(_checked(rig)) == 2
    assert 0.2 + MEASUREMENT_S < rig.loop.time() < 0.4 + (MAX_MEASUREMENTS + 1) * MEASUREMENT_S
