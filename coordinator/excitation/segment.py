"""One segment of excitation: all joints move about a pose at once, each by its own sum of sines."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.excitation.joint_limits import JointLimits, NoExcitation
from coordinator.excitation.multisine import scaled
from module_agent.control.waveform import duration_s, waveform
from module_agent.model.chain import Array
from module_agent.model.read_only import make_read_only, read_only
from module_agent.signals.filtering import differentiate
from module_agent.wire.messages import GoTo, MultiSine, Sine

# Sines per joint, fast enough for inertia to show against gravity, slow enough for compliant links.
SINES = 3
BAND_HZ = (0.2, 1.6)
# Share of the limits of speed and acceleration that is used: the taper adds the rest.
SHARE = 0.8


class Segment(NamedTuple):
    """A pose (n,) [rad], and every joint's motion about it, in the order of the chain."""

    pose_rad: Array
    patterns: tuple[MultiSine, ...]


class RobotMotion(NamedTuple):
    """A segment by serials: the pose where every joint begins [rad], and its motion from there."""

    pose_rad: Mapping[str, float]
    patterns: Mapping[str, MultiSine]


class SampledMotion(NamedTuple):
    """Samples of a motion, (m, n) each, read-only."""

    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array


def draw_segment(
    rng: np.random.Generator,
    limits: Sequence[JointLimits],
    home_rad: Array,
    reach_rad: float,
    duration_s: float,
) -> Segment:
    """Draw a pose within reach of home, and motions about it within the joints' limits.

    The pose takes between nothing and all of the reach, the motion what is left of it and of the range.

    Raises:
        NoExcitation: a joint has no room to move about its home.
    """
    patterns, poses = [], []
    for home, limit in zip(home_rad, limits, strict=True):
        room = min(reach_rad, limit.room_rad(float(home)))
        if room <= 0.0:
            raise NoExcitation(
                f"a joint has no room about {home:.2f} rad: its range is {limit.low_rad:.2f} .. "
                f"{limit.high_rad:.2f} rad"
            )
        away = float(rng.uniform(-0.8, 0.8)) * room
        patterns.append(_draw_sines(rng, limit, room - abs(away), duration_s))
        poses.append(float(home) + away)
    return Segment(read_only(np.array(poses)), tuple(patterns))


def _draw_sines(
    rng: np.random.Generator, limit: JointLimits, room_rad: float, duration_s: float
) -> MultiSine:
    slowest, fastest = BAND_HZ
    frequency = np.exp(rng.uniform(np.log(slowest), np.log(fastest), SINES))
    omega = 2.0 * np.pi * frequency
    share = rng.dirichlet(np.ones(SINES))
    amplitude = np.maximum(share * room_rad / np.maximum(1.0, omega / omega.min()), 1e-4)
    pairs = zip(amplitude.tolist(), frequency.tolist(), strict=True)
    sines = tuple(Sine(amplitude_rad=a, frequency_hz=f) for a, f in pairs)
    pattern = MultiSine(sines=sines, duration_s=duration_s)
    return scaled(pattern, limit.fitting_scale(pattern, SHARE))


def smaller(segment: Segment, home_rad: Array, share: float) -> Segment:
    """Return the segment with pose and motion that much nearer to home, 0 < share <= 1."""
    pose = home_rad + share * (segment.pose_rad - home_rad)
    return Segment(read_only(pose), tuple(scaled(pattern, share) for pattern in segment.patterns))


def way(from_rad: Array, to_rad: Array, max_speed_rad_s: float, rate_hz: float) -> Array:
    """Return positions (m, n) from one pose to another, every joint in its own time as `GoTo` takes it."""
    goals = [GoTo(target_rad=float(q), max_speed_rad_s=max_speed_rad_s) for q in to_rad]
    lasting = [duration_s(goal, float(q)) for goal, q in zip(goals, from_rad, strict=True)]
    t_s = np.arange(int(max(lasting) * rate_hz) + 2) / rate_hz
    joints = zip(goals, from_rad, lasting, strict=True)
    columns = [q + waveform(goal, float(q), np.minimum(t_s, end)).offset_rad for goal, q, end in joints]
    return read_only(np.stack(columns, axis=1))


def sampled(segment: Segment, rate_hz: float) -> SampledMotion:
    """Return the motion as commanded, at a rate, ends included."""
    t_s = np.arange(int(segment.patterns[0].duration_s * rate_hz) + 1) / rate_hz
    waves = [waveform(pattern, 0.0, t_s) for pattern in segment.patterns]
    q = segment.pose_rad + np.stack([wave.offset_rad for wave in waves], axis=1)
    qd = np.stack([wave.velocity_rad_s for wave in waves], axis=1)
    make_read_only((q, qd))
    return SampledMotion(q, qd, differentiate(qd, rate_hz))
