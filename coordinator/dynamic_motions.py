"""The motions of a recording as the regressor needs them: filtered alike, all joints on one time base."""

from collections.abc import Mapping, Sequence

import numpy as np

from coordinator.journal import Purpose
from coordinator.motion_window import RATE_HZ, Window, window
from coordinator.recording import Recording
from module_agent.dynamics.clock_map import ClockMap
from module_agent.dynamics.differentiation import JointMotion, filtered_motion, settling_samples

DYNAMIC_CUTOFF_HZ = 12.0
# The low-pass leaves so many independent samples a sample.
INDEPENDENT_FRACTION = min(1.0, 2.0 * DYNAMIC_CUTOFF_HZ / RATE_HZ)


def dynamic_windows(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str], *purposes: Purpose
) -> list[Window]:
    """Return all motions of some purposes, columns in the order of `serials`, with the low-pass' margins.

    Of a step that was done again the latest counts.

    Raises:
        ValueError: there is no such motion, or the recording has a hole in it.
    """
    # Joints that move at once share their step, and its window.
    steps = {event.step: event for event in recording.motions(*purposes)}
    if not steps:
        raise ValueError(f"the recording holds no motion for {' or '.join(purposes)}")
    margin = settling_samples(RATE_HZ, DYNAMIC_CUTOFF_HZ) / RATE_HZ
    return [window(recording, clocks, serials, event, margin) for event in steps.values()]


def dynamic_motion(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str], *purposes: Purpose
) -> JointMotion:
    """Return all motions of some purposes one after the other, filtered; see `dynamic_windows`.

    Raises:
        ValueError: as there.
    """
    motions = [filtered_window(one) for one in dynamic_windows(recording, clocks, serials, *purposes)]
    return joined_motions(motions)


def joined_motions(motions: Sequence[JointMotion]) -> JointMotion:
    """Return motions one after the other."""
    return JointMotion(*(np.concatenate(column) for column in zip(*motions, strict=True)))


def filtered_window(one: Window) -> JointMotion:
    """Return a window as the regressor needs it, without its margins."""
    # No velocity: that of the modules is late by their filter.
    return filtered_motion(one.t_ns, one.q_rad, None, one.tau_nm, RATE_HZ, DYNAMIC_CUTOFF_HZ)
