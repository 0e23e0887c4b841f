"""Looks at a robot while its joints are being explored: assembled from circles, refined by a few samples.

Every motion is filtered once and kept thinned, so that a look costs little more than its refinement.
"""

from collections.abc import Collection, Sequence

import numpy as np

from coordinator.clock_map import map_clocks
from coordinator.journal import JournalEvent
from coordinator.kinematics.assembly import link_lengths
from coordinator.kinematics.imu_intrinsics import IMU_PRIORS, ImuPrior
from coordinator.kinematics.link_flex import flex_slopes, joined, loads_of
from coordinator.kinematics.null_space import name_null_space
from coordinator.kinematics.refinement import Refinement, refine_chain
from coordinator.kinematics.sensor_data import SensorData
from coordinator.motion_window import RATE_HZ, filtered, thinned, window
from coordinator.recording import Recording
from coordinator.robot_so_far import RobotSoFar, robot_so_far
from module_agent.catalogue import ModuleType, module_type
from module_agent.dynamics.differentiation import settling_samples

CUTOFF_HZ = 12.0
# 50 samples a second are kept of every motion, for the loads of its links; the refinement has a quarter of
# them: six of every period of the windowed sine.
KEPT_EVERY, FITTED_EVERY = 5, 4
# Farther from where the circles put a module the refinement has found something else than the robot.
LOST_ABOVE_M = 0.15


class Looks:
    """The looks at one robot, one after the other, from its recording as it grows; one at a time.

    Robots of more than `most_refined` modules are only assembled: a refinement of seven costs half a second,
    and grows with the square.
    """

    def __init__(self, recording: Recording, most_refined: int | None = None):
        self._recording = recording
        self._most_refined = most_refined
        self._parts: dict[tuple[str, int, tuple[str, ...]], SensorData] = {}

    def look(self, explored: Collection[str]) -> RobotSoFar | None:
        """Return the robot as far as the joints `explored` tell; None as long as they tie nothing together.

        Where samples are missing, or do not fit, it is as assembled.

        Raises:
            ValueError: see `robot_so_far`.
        """
        found = robot_so_far(self._recording, explored)
        if found is None or not self._is_refined(found):
            return found
        try:
            return _refined(found, self._kinds(found), self._parts_of(found), self._prior)
        except (ValueError, np.linalg.LinAlgError):
            return found

    def _is_refined(self, found: RobotSoFar) -> bool:
        return self._most_refined is None or len(found.fit.chain.serials) <= self._most_refined

    @property
    def _prior(self) -> ImuPrior:
        return IMU_PRIORS[self._recording.imu]

    def _kinds(self, found: RobotSoFar) -> list[ModuleType]:
        infos = [self._recording.modules[s].info for s in found.fit.chain.serials]
        return [module_type(info.module_type) for info in infos if info is not None]

    def _parts_of(self, found: RobotSoFar) -> list[SensorData]:
        """Return the samples of every slow and fast motion so far, modules as in the chain."""
        serials = found.fit.chain.serials
        events: dict[tuple[str, str], JournalEvent] = {}
        for event in self._recording.journal:
            if event.what == "motion" and event.purpose in ("constant", "windowed_sine"):
                events[event.serial, event.purpose] = event
        moved = [event for event in events.values() if event.serial in serials and event.motion is not None]
        if not moved:
            raise ValueError("no motion of these modules is recorded")
        everybody = tuple(sorted(self._recording.modules))
        order = [everybody.index(s) for s in serials]
        return [_columns(self._part(event, everybody), order) for event in moved]

    def _part(self, event: JournalEvent, serials: tuple[str, ...]) -> SensorData:
        assert event.motion is not None
        key = (event.serial, event.motion.motion_id, serials)
        if key not in self._parts:
            clocks = map_clocks({s: self._recording.modules[s].round_trips for s in serials})
            margin_s = settling_samples(RATE_HZ, CUTOFF_HZ) / RATE_HZ
            whole = filtered(window(self._recording, clocks, serials, event, margin_s), CUTOFF_HZ)
            self._parts[key] = thinned([whole], KEPT_EVERY)
        return self._parts[key]


def _columns(part: SensorData, order: Sequence[int]) -> SensorData:
    """Return the columns of some modules, in another order."""
    at = np.array(order)
    rates = None if part.imu_rates is None else part.imu_rates[:, at]
    joints = (part.q_rad[:, at], part.qd_rad_s[:, at], part.qdd_rad_s2[:, at])
    return SensorData(*joints, part.gyro_rad_s[:, at], part.accel_m_s2[:, at], rates)


def _refined(
    found: RobotSoFar, kinds: Sequence[ModuleType], parts: Sequence[SensorData], prior: ImuPrior
) -> RobotSoFar:
    """Refine the robot as if it were rigid, and again with links that give under their loads."""
    data = thinned(parts, FITTED_EVERY)
    rigid = refine_chain(found.fit.chain, data, prior)
    loads = joined(loads_of(rigid.chain, kinds, parts, RATE_HZ / KEPT_EVERY), FITTED_EVERY)
    refined = refine_chain(rigid.chain, data, prior, flex_slopes(rigid.chain, data.joints, loads))
    length, sigma = link_lengths(refined.chain, refined.covariance)
    if _is_lost(found, refined):
        return found
    fit = found.fit._replace(
        chain=refined.chain,
        covariance=refined.covariance,
        rank=refined.rank,
        condition=refined.condition,
        unresolved=name_null_space(refined.chain, refined.null_basis),
        null_basis=refined.null_basis,
        link_length_m=length,
        link_length_sigma_m=sigma,
    )
    return found._replace(fit=fit)


def _is_lost(found: RobotSoFar, refined: Refinement) -> bool:
    off = refined.chain.imu_home[:, :3, 3] - found.fit.chain.imu_home[:, :3, 3]
    return not bool(np.linalg.norm(off, axis=1).max() < LOST_ABOVE_M)
