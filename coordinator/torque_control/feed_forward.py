"""Feed-forward torques of a motion from the identified model: the thesis' input mode 3 (chapter 6.3.2).

The effort of a module, and its set-point, is the torque of its spring on its output: that of the rigid bodies
alone, tau = Y(q, qd, qdd) phi (eq. 28). Friction, gear loss and the rotor's inertia act before the spring.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from module_agent.control.motion import effort_profile, profile_period_ns
from module_agent.control.waveform import duration_s, waveform
from module_agent.model.chain import Array, Chain
from module_agent.model.read_only import read_only
from module_agent.model.regressor import inverse_dynamics
from module_agent.signals.filtering import differentiate
from module_agent.wire.messages import EffortProfile, Pattern

# The modules' own tick: a reference at its rate is what a module itself samples of a pattern.
RATE_HZ = 1000.0
# Patterns that end within half a tick of one another end together.
_TOGETHER_S = 5e-4


class Reference(NamedTuple):
    """A desired motion: `t_s` (m,) from its start, the others (m, n); read-only."""

    t_s: Array
    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array


class SetPoints(NamedTuple):
    """A reference and its spring torques (m, n) [Nm], read-only."""

    reference: Reference
    effort_nm: Array


def joint_reference(
    serials: Sequence[str], patterns: Mapping[str, Pattern], origins_rad: Mapping[str, float]
) -> Reference:
    """Sample the motion of all joints at 1 kHz; one without a pattern stands still at its origin.

    Raises:
        KeyError: a pattern of a module that is not among the serials, or a joint without an origin.
        ValueError: no pattern, or patterns that do not end together.
    """
    if unknown := [serial for serial in patterns if serial not in serials]:
        raise KeyError(f"a pattern for {unknown[0]}, which is not among the joints {', '.join(serials)}")
    if missing := [serial for serial in serials if serial not in origins_rad]:
        raise KeyError(f"joint {missing[0]} has no origin: give its position at the start of the motion")
    if not patterns:
        raise ValueError("no joint has a pattern")
    ends = {serial: duration_s(pattern, origins_rad[serial]) for serial, pattern in patterns.items()}
    first, last = min(ends, key=lambda s: ends[s]), max(ends, key=lambda s: ends[s])
    total_s = ends[last]
    if total_s - ends[first] > _TOGETHER_S:
        raise ValueError(
            f"joint {first} ends after {ends[first]:.3f} s and {last} after {total_s:.3f} s: all "
            "patterns must end together, since a joint needs torque as long as the others move"
        )
    t_s = np.arange(round(total_s * RATE_HZ) + 1) / RATE_HZ
    q, qd = np.empty((2, t_s.size, len(serials)))
    for column, serial in enumerate(serials):
        q[:, column], qd[:, column] = origins_rad[serial], 0.0
        if serial in patterns:
            samples = waveform(patterns[serial], origins_rad[serial], np.minimum(t_s, total_s))
            q[:, column] += samples.offset_rad
            qd[:, column] = samples.velocity_rad_s
    return Reference(*(read_only(array) for array in (t_s, q, qd, differentiate(qd, RATE_HZ))))


def standing(reference: Reference, row: int, length_s: float) -> Reference:
    """Return a reference that rests at the position of a row of another one (-1: its end)."""
    t_s = np.arange(round(length_s * RATE_HZ) + 1) / RATE_HZ
    q = np.tile(reference.q_rad[row], (t_s.size, 1))
    return Reference(*(read_only(array) for array in (t_s, q, np.zeros_like(q), np.zeros_like(q))))


def feed_forward(chain: Chain, phi: ArrayLike, reference: Reference) -> SetPoints:
    """Return the spring torques along a reference whose columns are in the chain's order.

    phi: (10 n,) or (n, 10) inertial parameters; only their identifiable combinations have an effect.

    Raises:
        ValueError: another number of joints or parameters, or values that are not finite.
    """
    effort = inverse_dynamics(chain, phi, reference.q_rad, reference.qd_rad_s, reference.qdd_rad_s2)
    return SetPoints(reference, effort)


def on_module(points: SetPoints) -> list[EffortProfile]:
    """Return the efforts as profiles that the modules play along with their motion, one per joint, in order.

    Raises:
        ValueError: a value that is not finite, or a motion too long for a profile: over 799 s.
    """
    t_s = points.reference.t_s
    period_ns = profile_period_ns(float(t_s[-1]))
    # The last sample is at the end or beyond it, where the effort stays as it is at the end.
    count = int(np.ceil(t_s[-1] * 1e9 / period_ns - 1e-9)) + 1
    at_s = np.arange(max(count, 2)) * (period_ns * 1e-9)
    return [effort_profile(np.interp(at_s, t_s, joint), period_ns) for joint in points.effort_nm.T]
