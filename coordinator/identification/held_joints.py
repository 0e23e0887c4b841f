"""Joints that did not move by themselves give way to loads, and the model has no axis to turn them about.

A module that refuses its motions, by its limits for example, holds its joint, and a held joint gives: an X5-4
that carries an arm turns by some hundredths of a radian as the load changes. Where the axis of a joint is
known, the model turns it with its encoder. Of one that no motion of its own has shown it does not know the
axis; what such a joint carries stands on its parent and is still, so that the turns look like errors of the
IMUs beyond it, which are healthy.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.estimator import SYSTEMATIC
from coordinator.identification.finding import Finding, Sickness
from coordinator.identification.sensor_checks import EXPLORATION
from coordinator.synchronisation.motion_windows import Window, filtered
from module_agent.model.catalogue import GRAVITY_M_S2
from module_agent.model.chain import Array
from module_agent.signals.filtering import REFINEMENT_CUTOFF_HZ

# No IMU is farther from the joint that turns it [m].
REACH_M = 2.0
# A fit without the turn spreads it over motions and modules: residuals of arms of six joints are up to a
# fifth larger than it.
SPREAD = 1.5
# What a turn that the model does not have looks like.
_LOOKS_LIKE: frozenset[Sickness] = frozenset(
    {"gyro_contradicts", "accelerometer_contradicts", "imu_error", "imu_place"}
)
_WHAT = "the turn of its joint, which was held,"
_NO_AXIS = (
    "it did not move by itself, so that its axis and what it turned are not known: let it move, or hold it "
    "by stiffer gains"
)


class GivenWay(NamedTuple):
    """How a held joint gave way in a motion of others.

    travel_rad: the range of its positions. gyro_rad_s, accel_m_s2: rms of what it adds to the readings of an
    IMU that it carries, at most. sigmas: its rate over the noise of gyros.
    """

    serial: str
    motion: str
    travel_rad: float
    gyro_rad_s: float
    accel_m_s2: float
    sigmas: float

    def explains(self, finding: Finding) -> bool:
        """Return whether the joint's turn may be all that an IMU contradicts.

        That of its own module as well, which is turned if the module is mounted in reverse.
        """
        if finding.kind not in _LOOKS_LIKE:
            return False
        if finding.motion == EXPLORATION:
            return True
        limit = self.gyro_rad_s if finding.kind == "gyro_contradicts" else self.accel_m_s2
        return finding.motion == self.motion and finding.measured <= SPREAD * limit

    def finding(self, serious: bool) -> Finding:
        """Return what is to be said of the joint."""
        return Finding(
            self.serial,
            self.motion,
            _WHAT,
            self.travel_rad,
            0.0,
            self.sigmas,
            "rad",
            _NO_AXIS,
            "joint_gives",
            serious,
        )


def given_way(
    serials: Sequence[str],
    unmoved: Sequence[str],
    windows: Sequence[Window],
    noise_rad_s: Array,
    motions: Sequence[str],
) -> list[GivenWay]:
    """Return how the joints that did not move by themselves gave way, where an IMU beyond them would see it.

    Args:
        serials: (n,) of the modules, as the columns of the windows.
        unmoved: those whose joints did not move by themselves.
        windows: (k,) of the motions.
        noise_rad_s: (k, n) of the gyros in them, rms per axis.
        motions: (k,) what to call them.
    """
    found = []
    for window, noise, motion in zip(windows, noise_rad_s, motions, strict=True) if unmoved else ():
        part = filtered(window, REFINEMENT_CUTOFF_HZ)
        for k in (serials.index(serial) for serial in unmoved):
            q, qd, qdd = (signal[:, k] for signal in part.joints)
            rate, acceleration = (float(np.sqrt(np.mean(signal**2))) for signal in (qd, qdd))
            sigmas = rate / float(noise[k])
            if sigmas > SYSTEMATIC:
                accel = GRAVITY_M_S2 * float(q.std()) + REACH_M * acceleration
                found.append(GivenWay(serials[k], motion, float(np.ptp(q)), rate, accel, sigmas))
    return found


def explained(findings: Sequence[Finding], given: Sequence[GivenWay]) -> list[Finding]:
    """Return findings of which those that held joints explain accuse the joint, and no sensor.

    A joint is as serious as what it explains; where nothing contradicts anything, it is not named.
    """
    kept, serious = list[Finding](), dict[GivenWay, bool]()
    for finding in findings:
        causes = [one for one in given if one.explains(finding)]
        if not causes:
            kept.append(finding)
            continue
        cause = max(causes, key=lambda one: one.sigmas)
        serious[cause] = serious.get(cause, False) or finding.serious
        remedy = f"joint {cause.serial} gave way, of which the model knows no axis: that may be all of it"
        kept.append(finding._replace(remedy=remedy, serious=False))
    joints = dict[str, GivenWay]()
    for cause in sorted(serious, key=lambda one: one.sigmas):
        joints[cause.serial] = cause
    grave = {cause.serial for cause, is_grave in serious.items() if is_grave}
    return [*(cause.finding(serial in grave) for serial, cause in joints.items()), *kept]
