"""What is known of a robot while joints are still being explored: no more than what has moved can tell."""

from collections.abc import Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coordinator.identification.preview import adjacent, preview
from coordinator.kinematics.chain_estimate import link_lengths
from coordinator.recording.recording import Recording
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.wire.feedback_rows import ROW

RESTED, MOVED = 100, 200


class Seen(Recording):
    """A recording of a robot at rest and of perfect circles, of those joints that have moved."""

    def __init__(self, robots: Any, chain: Chain, types: Any, explored: Sequence[str]):
        super().__init__()
        self._chain = chain
        self._rest = robots.rest(chain, np.zeros(len(chain.serials)))
        self.modules = {
            s: SimpleNamespace(boot=0, info=SimpleNamespace(module_type=kind.name))
            for s, kind in zip(chain.serials, types, strict=True)
        }
        self.journal = [self._motion(s, "rest", 1, 0, RESTED) for s in chain.serials]
        self.journal += [self._motion(s, "windowed_sine", 2, RESTED, MOVED) for s in explored]
        self.estimates = {
            (joint, observer): {(2,): self._estimate(robots, joint, observer)}
            for joint in explored
            for observer in chain.serials
        }

    def _motion(self, serial: str, purpose: str, number: int, first: int, end: int) -> Any:
        motion = SimpleNamespace(motion_id=number, start_row=first, end_row=end)
        return SimpleNamespace(what="motion", serial=serial, boot=0, purpose=purpose, motion=motion)

    def _estimate(self, robots: Any, joint: str, observer: str) -> Any:
        chain = self._chain
        i, k = chain.serials.index(joint), chain.serials.index(observer)
        moved = i in chain.ancestors(chain.carrier(k))
        circle = None
        if moved:
            axis, radial = robots.circle(chain, i, k, np.zeros(len(chain.serials)))
            circle = SimpleNamespace(
                axis=tuple(axis),
                radial_m=tuple(radial),
                sigma_axis_rad=1e-4,
                sigma_distance_m=1e-4,
                distance_m=float(np.linalg.norm(radial)),
            )
        return SimpleNamespace(
            serial=observer,
            joint=joint,
            moved=moved,
            rate_ratio=float(moved),
            circle=circle,
            best=circle,
            motion_ids=(2,),
        )

    def rows(self, serial: str, first: int, end: int) -> np.ndarray:
        result = np.zeros(end - first, ROW)
        result["accel_m_s2"] = self._rest.specific_force_m_s2[self._chain.serials.index(serial)]
        return result


def forward(robots: Any, seed: int, joints: int) -> tuple[Chain, Any]:
    """A tree of modules that are all mounted forward, so that the last ones move nothing."""
    chain, types = robots.random(seed, joints)
    straight = [False] * joints
    return robots.build(list(chain.parent), straight, chain.imu_home, types, chain.gravity), types


@pytest.mark.parametrize("seed", range(6))
def test_when_all_joints_have_moved_the_robot_is_the_whole_one(robots: Any, seed: int) -> None:
    chain, types = robots.random(seed, joints=2 + seed)
    recording: Any = Seen(robots, chain, types, chain.serials)
    result = preview(recording, chain.serials)
    assert result is not None
    partial = result.fit.chain
    parents = {
        s: partial.serials[p] if p >= 0 else None
        for s, p in zip(partial.serials, partial.parent, strict=True)
    }
    assert parents == {
        s: chain.serials[p] if p >= 0 else None for s, p in zip(chain.serials, chain.parent, strict=True)
    }
    assert result.adjacent == tuple(p >= 0 for p in partial.parent)
    lengths, _ = link_lengths(chain, np.zeros((6 * len(types),) * 2))
    expected = [lengths[chain.serials.index(s)] for s in partial.serials]
    # Work ends when the squares shrink by a thousandth: far below the 0.3 mm that circles are believed to.
    np.testing.assert_allclose(result.fit.link_length_m, expected, atol=2e-4)


@pytest.mark.parametrize("seed", range(8))
def test_a_module_stands_on_the_nearest_joint_that_has_moved_and_moves_it(robots: Any, seed: int) -> None:
    chain, types = forward(robots, seed, joints=6)
    order = np.random.default_rng(seed).permutation(6)
    for count in range(1, 7):
        explored = [chain.serials[i] for i in order[:count]]
        recording: Any = Seen(robots, chain, types, explored)
        result = preview(recording, explored)
        nearest = {}
        for k, serial in enumerate(chain.serials):
            above = [chain.serials[i] for i in chain.ancestors(chain.carrier(k))]
            moved = [s for s in above if s in explored]
            nearest[serial] = moved[-1] if moved else None
        tied = set(nearest.values()) - {None} | {s for s, p in nearest.items() if p is not None}
        if result is None:
            assert not tied
            continue
        partial = result.fit.chain
        assert set(partial.serials) == tied
        for k, serial in enumerate(partial.serials):
            on = partial.serials[partial.parent[k]] if partial.parent[k] >= 0 else None
            assert on == nearest[serial]
            if result.adjacent[k]:
                assert on == chain.serials[chain.parent[chain.serials.index(serial)]]


def test_a_module_is_adjacent_only_if_no_unexplored_joint_can_be_in_between(robots: Any) -> None:
    chain, _ = forward(robots, 3, joints=4)
    star = chain._replace(parent=(-1, 0, 0, 0))
    assert adjacent(star, chain.serials[:1]) == (False,) * 4
    # One that is open itself can only be at the end.
    assert adjacent(star, chain.serials[:3]) == (False, False, False, True)
    assert adjacent(star, chain.serials) == (False, True, True, True)


def test_bands_grow_narrower_the_more_joints_have_moved(robots: Any) -> None:
    chain, types = robots.random(4, joints=5, serial=True)
    sigmas = []
    for count in range(1, 6):
        recording: Any = Seen(robots, chain, types, chain.serials[:count])
        result = preview(recording, chain.serials[:count])
        assert result is not None
        sigmas.append(float(result.fit.link_length_sigma_m[1]))
    assert all(later <= sooner * (1 + 1e-6) for sooner, later in pairwise(sigmas))


def test_before_anything_has_moved_there_is_no_robot(robots: Any) -> None:
    chain, types = robots.random(1, joints=3)
    recording: Any = Seen(robots, chain, types, [])
    assert preview(recording, []) is None


def test_a_module_without_a_reported_type_is_named(robots: Any) -> None:
    chain, types = robots.random(1, joints=3)
    recording: Any = Seen(robots, chain, types, chain.serials)
    recording.modules[chain.serials[1]].info = None
    with pytest.raises(DataError, match=f"module {chain.serials[1]} has not reported its type"):
        preview(recording, chain.serials)
