"""The motions of a recording as the regressor needs them: filtered alike, all joints on one time base."""

from collections.abc import Mapping, Sequence

import numpy as np

from coordinator.journal import JournalEvent, Purpose
from coordinator.motion_window import RATE_HZ, window
from coordinator.recording import Recording
from module_agent.dynamics.clock_map import ClockMap
from module_agent.dynamics.differentiation import JointMotion, filtered_motion, settling_samples

DYNAMIC_CUTOFF_HZ = 12.0
# The low-pass leaves so many independent samples a sample.
INDEPENDENT_FRACTION = min(1.0, 2.0 * DYNAMIC_CUTOFF_HZ / RATE_HZ)


def dynamic_motion(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str], *purposes: Purpose
) -> JointMotion:
    """Return all motions of some purposes one after the other, columns in the order of `serials`.

    Of a step that was done again the latest counts.

    Raises:
        ValueError: there is no such motion, or the recording has a hole in it.
    """
    # Joints that move at once share their step, and its window.
    steps = {event.step: event for event in recording.motions(*purposes)}
    if not steps:
        raise ValueError(f"the recording holds no motion for {' or '.join(purposes)}")
    motions = [_filtered(recording, clocks, serials, event) for event in steps.values()]
    return JointMotion(*(np.concatenate(column) for column in zip(*motions, strict=True)))


def _filtered(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str], event: JournalEvent
) -> JointMotion:
    margin = settling_samples(RATE_HZ, DYNAMIC_CUTOFF_HZ) / RATE_HZ
    one = window(recording, clocks, serials, event, margin)
    # No velocity: that of the modules is late by their filter.
    return filtered_motion(one.t_ns, one.q_rad, None, one.tau_nm, RATE_HZ, DYNAMIC_CUTOFF_HZ)
