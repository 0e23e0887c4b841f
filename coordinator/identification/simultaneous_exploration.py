"""Response of all modules to a motion of all joints at once, from a recording."""

from collections.abc import Mapping, Sequence

import numpy as np

from coordinator.kinematics.simultaneous_motion import (
    SimultaneousMotion,
    SimultaneousResponse,
    StillReading,
    simultaneous_response,
)
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import RATE_HZ, window
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import SIMULTANEOUS_CUTOFF_HZ, filtered_signals, settling_samples


def simultaneous_motion(recording: Recording, serials: Sequence[str]) -> JournalEvent | None:
    """Return the latest motion of all these joints at once, as the event of the first of them.

    None if not all took part, or if all were moved one by one as well: those motions are more informative.
    """
    latest = {e.serial: e for e in recording.motions("whole")}
    alone = {e.serial for e in recording.motions("windowed_sine")}
    if all(s in alone for s in serials):
        return None
    return latest[serials[0]] if serials and all(s in latest for s in serials) else None


def respond(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str], event: JournalEvent
) -> SimultaneousResponse:
    """Regress all IMUs' readings on all joints' motions; columns in the order of `serials`.

    Raises:
        DataError: see `simultaneous_response`; also a hole in the recording, or no rest.
    """
    margin_s = settling_samples(RATE_HZ, SIMULTANEOUS_CUTOFF_HZ) / RATE_HZ
    one = window(recording, clocks, serials, event, margin_s)
    others = [one.gyro_rad_s, one.accel_m_s2]
    signals = filtered_signals(one.q_rad, others, RATE_HZ, SIMULTANEOUS_CUTOFF_HZ)
    motion = SimultaneousMotion(*signals.settled())
    return simultaneous_response(motion, _still(recording, serials), RATE_HZ, SIMULTANEOUS_CUTOFF_HZ)


def _still(recording: Recording, serials: Sequence[str]) -> StillReading:
    rows = {serial: recording.rest_rows(serial) for serial in serials}
    missing = [serial for serial in serials if not len(rows[serial])]
    if missing:
        raise DataError(
            f"no rest of {', '.join(missing)} was recorded: the offsets of its gyro are not known"
        )
    return StillReading(
        np.array([rows[serial]["gyro_rad_s"].astype(float).mean(axis=0) for serial in serials]),
        np.array([rows[serial]["accel_m_s2"].astype(float).mean(axis=0) for serial in serials]),
    )
