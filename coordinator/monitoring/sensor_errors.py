"""Which sensor explains best what a window shows, if its errors have changed.

A torque sensor has an offset and a scale; a gyro or an accelerometer a bias and a scale on each axis. A
payload shows in the torques of every joint below it by the lever that it has there, and a displaced link in
all IMUs beyond it by how its joints turn: only one sensor's error is its own alone. They are judged by the
same likelihood ratio, with fewer parameters or as many. Where a sensor explains no more than a link or a
payload, nothing tells them apart, and what happens more often is named: the link or the payload.

A gyro or an accelerometer is named also where it passes for nothing else: how far temperature makes biases
drift is known before (`ImuModel.own_sigma`).

The offset of a torque sensor shows in its drive as well, whose motor does not know of it; where a joint turns
one way more often than the other it passes for friction, now for more and now for less.

What is left out is an error of the axes: an accelerometer that turned is a link that turned.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from coordinator.monitoring.findings import UNITS, Detection, Kind
from coordinator.monitoring.likelihood_ratio import Change, Evidence, joined, most_of
from coordinator.monitoring.reference import BaselineTest
from coordinator.monitoring.residual_tests import (
    IMU_ERRORS,
    IMU_SIZES,
    SENSOR_ERRORS,
    DriveModel,
    ImuSensor,
    imu_error_columns,
)
from module_agent.model.chain import Array

# By so much more [variances] than a payload or a link a sensor has to explain: chance makes as much of its
# own parameters once in a thousand windows.
LEAD = 22.0
# How large a change of 1 is of a torque sensor's offset [Nm] and scale.
_TORQUE_SIZES = np.array([1.0, 0.3])
# What the model has no error of to begin with is where it was.
_FIXED = 1e-9
_MIN_WEIGHT = 1e-12
_PER_UNIT = {"Nm": 1.0, "mrad/s": 1e3, "m/s^2": 1.0}


class SensorError(NamedTuple):
    """By what one sensor has changed; place: of its module; gain: what that explains, in variances.

    error, sigma: its readings' root mean square error in the window and the standard deviation of that, in
    the kind's unit.
    """

    kind: Kind
    place: int
    gain: float
    error: float
    sigma: float

    def detection(self, serial: str, level: float) -> Detection:
        """Return it as a finding, but for its times."""
        size = f"{self.error:.2g} +- {self.sigma:.1g} {UNITS[self.kind]} (rms)"
        summary = f"the {self.kind.replace('-', ' ')} of {serial} reads {size} other than before"
        return Detection(self.kind, serial, self.error, self.sigma, self.gain, level, summary)


def torque_sensor_error(test: BaselineTest, parts: Sequence[Evidence]) -> SensorError:
    """Return the torque sensor that explains most of a window's evidence (`torque_evidence`)."""
    later = joined(parts)
    count = later.parameters - test.evidence.parameters
    joints = count // SENSOR_ERRORS
    columns = [np.array([joint, joints + joint]) for joint in range(joints)]
    hypotheses = np.zeros((joints, later.parameters, SENSOR_ERRORS))
    for change, own in zip(hypotheses, columns, strict=True):
        change[own, np.arange(SENSOR_ERRORS)] = _TORQUE_SIZES
    rival = replace(test, own_sigma=np.full(count, _FIXED), changes=tuple(hypotheses), likely=None)
    changes = rival.find(later)
    index = most_of(changes)
    return _sensor_error("torque-sensor", index, changes[index], later, columns[index], _TORQUE_SIZES)


def drive_offset(test: BaselineTest, model: DriveModel, joint: int, later: Evidence) -> SensorError:
    """Return what an offset of a joint's torque sensor explains of its drive (`drive_evidence`)."""
    change = replace(test, changes=(model.offset_change,), likely=None).find(later)[0]
    # The hypothesis has one parameter, which moves the offset alone.
    unit_nm = float(model.offset_change.max())
    error, sigma = abs(float(change.size[0])), float(np.sqrt(change.covariance[0, 0]))
    return SensorError("torque-sensor", joint, change.gain, unit_nm * error, unit_nm * sigma)


def imu_error(changes: Sequence[Change], later: Evidence) -> SensorError:
    """Return the gyro or accelerometer that explains most of a window.

    Args:
        changes: of the gyros, then of the accelerometers, as `Reference.imu` finds them.
        later: the window's evidence (`imu_evidence`).
    """
    count, best = len(changes) // len(IMU_ERRORS), most_of(changes)
    sensors: list[ImuSensor] = list(IMU_ERRORS)
    kind, place = sensors[best // count], best % count
    columns = imu_error_columns(count, kind)[place]
    return _sensor_error(kind, place, changes[best], later, columns, IMU_SIZES[kind])


def _sensor_error(
    kind: Kind, index: int, change: Change, later: Evidence, columns: Array, sizes: Array
) -> SensorError:
    shares = sizes * change.size
    covariance = sizes[:, None] * change.covariance * sizes
    # Rows in standard deviations: of the offsets' columns their squares are the samples' weights, which an
    # axis does not share with the others.
    seen = later.matrix[np.ix_(columns, columns)]
    weight = np.tile(np.diag(seen)[: len(sizes) // 2], 2)
    mean = seen / np.maximum(weight, _MIN_WEIGHT)[:, None]
    error = float(np.sqrt(max(shares @ mean @ shares, 0.0)))
    slope = mean @ shares / max(error, 1e-12)
    unit = _PER_UNIT[UNITS[kind]]
    return SensorError(
        kind,
        index,
        change.gain,
        unit * error,
        unit * float(np.sqrt(slope @ covariance @ slope)),
    )
