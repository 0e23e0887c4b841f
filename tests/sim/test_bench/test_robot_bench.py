"""Messages through one direction of a network: late, in order, lost or twice, as its profile has it."""

import numpy as np

from module_agent.network_emulation.profile import PathProfile
from sim.test_bench.robot_bench import MessagePath

MS = 1_000_000


def sent(profile: PathProfile, count: int, every_ns: int = MS) -> list[tuple[int, int]]:
    """Send numbers, one a millisecond, and return when which came, asked every millisecond."""
    path = MessagePath[int](profile, np.random.default_rng(7))
    found = []
    for tick in range(count + 200):
        if tick < count:
            path.send(tick * every_ns, tick)
        found += [(tick, number) for number in path.arrived(tick * every_ns)]
    return found


def test_a_constant_delay_passes_everything_by_that_much_later() -> None:
    assert sent(PathProfile(delay_ms=3.0), 50) == [(k + 3, k) for k in range(50)]


def test_jitter_does_not_change_the_order_and_delays_by_its_mean_at_least() -> None:
    found = sent(PathProfile(delay_ms=1.0, jitter_ms=4.0, jitter_shape=0.7), 400)
    assert [number for _, number in found] == list(range(400))
    late = np.array([tick - number for tick, number in found])
    assert late.min() >= 1
    # To wait for those before adds to the mean of 5 ms; asking once a millisecond adds half of one.
    assert late.mean() > 5.0


def test_reordered_messages_overtake() -> None:
    numbers = [number for _, number in sent(PathProfile(jitter_ms=5.0, reorder=0.5), 400)]
    assert sorted(numbers) == list(range(400))
    assert numbers != sorted(numbers)


def test_losses_are_lost_and_duplicates_come_twice() -> None:
    numbers = [number for _, number in sent(PathProfile(loss=0.2, duplicate=0.1), 1000)]
    kept = set(numbers)
    # Four standard deviations of the binomial counts.
    assert abs(len(kept) - 800) < 4 * 12.7
    assert abs(len(numbers) - len(kept) - 80) < 4 * 8.6
