"""Clocks from the motion: they resolve what round trips leave open, where a common motion does."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coordinator.batch_estimation.imu_prediction import imu_readings
from coordinator.synchronisation.clock_refinement import LAG_FLOOR_S, refine_clocks
from coordinator.synchronisation.motion_windows import RATE_HZ, Window
from module_agent.model.chain import Chain
from module_agent.signals.clock_map import ClockMap
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain

DELAY_S = 2.4e-3
SPAN_S = 5.6
GYRO_NOISE_RAD_S = 6e-4
# Half a round trip of 3.5 ms, and drifts as from a minute on a wireless network.
OFFSET_SIGMA_S, DRIFT_SIGMA = 1e-3, 3e-6


class World:
    """A robot whose clocks are mapped wrongly; the first one is the base, and runs as the base does."""

    def __init__(self, robot: str, seed: int, base_sigma_s: float = OFFSET_SIGMA_S, held_rad: float = 0.01):
        self.rng = np.random.default_rng(seed)
        self.held_rad = held_rad
        self.chain: Chain = true_chain(load_robot(robot))
        n = len(self.chain.serials)
        sigma = np.array([base_sigma_s, *[OFFSET_SIGMA_S] * (n - 1)])
        self.offset_s = self.rng.normal(size=n) * sigma
        self.drift = self.rng.normal(size=n) * DRIFT_SIGMA * (np.arange(n) > 0)
        self.origin_s = self.rng.uniform(20.0, 30.0, n)
        self.gyro_matrix = np.eye(3) + 0.01 * self.rng.normal(size=(n, 3, 3))
        self.gyro_bias = 0.02 * self.rng.normal(size=(n, 3))
        self.clocks = {
            serial: ClockMap(round(1e9 * self.origin_s[k]), 0.0, 0.0, 1e9 * sigma[k], DRIFT_SIGMA * (k > 0))
            for k, serial in enumerate(self.chain.serials)
        }

    def error_s(self, module: int, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.offset_s[module] + self.drift[module] * (t_s - self.origin_s[module])

    def joints(
        self, t_s: NDArray[np.float64], start_s: float, amplitudes: NDArray[np.float64]
    ) -> list[object]:
        """Positions, rates and accelerations (m, n) of windowed sines that begin at `start_s`."""
        frequency = 2.0 + 0.37 * np.arange(len(amplitudes)) * (np.count_nonzero(amplitudes > 0.05) > 1)

        def position(at_s: NDArray[np.float64]) -> NDArray[np.float64]:
            since = (at_s - start_s - 0.5 * SPAN_S)[:, None]
            # The held joints follow late, as their springs do near a resonance.
            phase = np.where(amplitudes > 0.05, 0.0, 0.9)
            return amplitudes * np.exp(-0.5 * since**2) * np.sin(2 * np.pi * frequency * since - phase)

        step = 1e-4
        before, here, after = (position(t_s + shift) for shift in (-step, 0.0, step))
        return [here, (after - before) / (2 * step), (after - 2 * here + before) / step**2]

    def motion(self, start_s: float, moving: list[int]) -> Window:
        """What the modules record, by the clocks as they are mapped, of a motion of some joints."""
        n = len(self.chain.serials)
        amplitudes = self.held_rad * self.rng.uniform(0.2, 1.0, n)
        amplitudes[moving] = 0.1
        t_s = np.arange(start_s, start_s + SPAN_S, 1.0 / RATE_HZ)
        q, gyro = np.empty((len(t_s), n)), np.empty((len(t_s), n, 3))
        for k in range(n):
            q[:, k] = self.joints(t_s - self.error_s(k, t_s), start_s, amplitudes)[0][:, k]
            lag = self.error_s(k, t_s) + DELAY_S + LAG_FLOOR_S * self.rng.normal()
            ideal = imu_readings(self.chain, *self.joints(t_s - lag, start_s, amplitudes)).gyro_rad_s[:, k]
            gyro[:, k] = ideal @ self.gyro_matrix[k].T + self.gyro_bias[k]
        gyro += GYRO_NOISE_RAD_S * self.rng.normal(size=gyro.shape)
        t_ns = np.rint(1e9 * t_s).astype(np.int64)
        return Window(t_ns, q, np.zeros_like(q), gyro, np.zeros_like(gyro), np.zeros(n))

    def left_s(self, clocks: dict[str, ClockMap], module: int) -> tuple[float, float]:
        """How wrong a refined map is against the base: at its origin [s], and in drift."""
        refinement = clocks[self.chain.serials[module]]
        removed_s, removed_drift = -1e-9 * refinement.offset_ns, -refinement.drift
        origin = np.array([self.origin_s[module]])
        apart = float(self.error_s(module, origin)[0] - self.error_s(0, origin)[0])
        return apart - removed_s, float(self.drift[module]) - removed_drift


@pytest.mark.parametrize("robot", ["a2085_04", "arm6", "tree_y"])
def test_offsets_and_drifts_are_recovered_to_within_what_is_claimed(robot: str) -> None:
    scores, left = [], []
    for seed in range(6):
        world = World(robot, seed)
        n = len(world.chain.serials)
        motions = [world.motion(6.0 + 8.0 * joint, [joint]) for joint in range(n)]
        refinement = refine_clocks(world.chain, world.clocks, motions)
        assert refinement.imu_delay_s == pytest.approx(DELAY_S, abs=4.0 * refinement.imu_delay_sigma_s)
        # A tenth of a millisecond is how far IMUs of a kind differ: the mean of them is known no better.
        assert refinement.imu_delay_sigma_s < 2.5e-4
        for module in range(1, n):
            offset, drift = world.left_s(refinement.clocks, module)
            clock = refinement.clocks[world.chain.serials[module]]
            scores += [1e9 * offset / clock.sigma_ns, drift / clock.drift_sigma]
            if module < n - 1:
                left.append(offset)
    # About 36 to 60 scores, of which the modules of one world are not independent.
    assert np.max(np.abs(scores)) < 4.5
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.4
    # A millisecond before; what is left comes from the floor of 0.08 ms a lag.
    assert np.sqrt(np.mean(np.square(left))) < 0.25e-3


def test_all_joints_moving_at_once_tell_the_clocks_as_well() -> None:
    world = World("arm6", 3)
    motions = [world.motion(20.0, list(range(6))), world.motion(26.0, list(range(6)))]
    refinement = refine_clocks(world.chain, world.clocks, motions)
    for module in range(1, 6):
        offset, _ = world.left_s(refinement.clocks, module)
        assert abs(1e9 * offset) < 4.0 * refinement.clocks[world.chain.serials[module]].sigma_ns
        # 1.4 ms against the base before.
        assert refinement.clocks[world.chain.serials[module]].sigma_ns < 0.7e6


def test_a_module_without_common_motion_keeps_its_round_trips() -> None:
    # Against a base whose own round trips leave nothing open.
    world = World("tree_y", 1, base_sigma_s=1e-6, held_rad=0.0)
    chain = world.chain
    tip = next(k for k in reversed(range(len(chain.serials))) if k not in chain.parent)
    moving = [k for k in range(len(chain.serials)) if k in chain.parent and not _carries(chain, k, tip)]
    assert moving
    refinement = refine_clocks(chain, world.clocks, [world.motion(6.0, [joint]) for joint in moving])
    assert refinement.lags >= len(moving)
    before, after = world.clocks[chain.serials[tip]], refinement.clocks[chain.serials[tip]]
    assert after.offset_ns == pytest.approx(before.offset_ns, abs=2e3)
    assert after.sigma_ns == pytest.approx(before.sigma_ns, rel=0.01)
    assert after.drift_sigma == pytest.approx(before.drift_sigma, rel=0.01)


def test_a_gyro_that_does_not_follow_its_joints_has_no_say() -> None:
    world = World("a2085_04", 1)
    motion = world.motion(6.0, [0])
    dead = motion.gyro_rad_s.copy()
    dead[:, 3] = 0.0
    with_it = refine_clocks(world.chain, world.clocks, [motion])
    without = refine_clocks(world.chain, world.clocks, [motion._replace(gyro_rad_s=dead)])
    assert without.lags == with_it.lags - 1


def _carries(chain: Chain, joint: int, module: int) -> bool:
    while module >= 0:
        if module == joint:
            return True
        module = chain.parent[module]
    return False


def test_without_any_motion_the_clocks_stay_as_the_round_trips_have_them() -> None:
    world = World("a2085_04", 0)
    refinement = refine_clocks(world.chain, world.clocks, [])
    assert refinement.lags == 0
    for serial, clock in world.clocks.items():
        assert refinement.clocks[serial].offset_ns == clock.offset_ns
        assert refinement.clocks[serial].drift == clock.drift
    # Against the base, whose own round trips are as uncertain; that itself is not uncertain against itself.
    sigmas = [refinement.clocks[serial].sigma_ns for serial in world.chain.serials]
    assert sigmas == pytest.approx([0.0, *[np.sqrt(2.0) * 1e9 * OFFSET_SIGMA_S] * 3])


def test_the_base_clock_stays_what_it_is() -> None:
    world = World("a2085_04", 2)
    refinement = refine_clocks(world.chain, world.clocks, [world.motion(6.0, [0]), world.motion(14.0, [1])])
    serial = world.chain.serials[0]
    assert refinement.clocks[serial] == world.clocks[serial]._replace(sigma_ns=0.0, drift_sigma=0.0)
    assert refinement.covariance.shape == (8, 8)
    assert not refinement.covariance.flags.writeable
    assert np.linalg.eigvalsh(refinement.covariance).min() > -1e-12
