"""Choose the next motion that settles a doubt about the topology."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from coordinator.topology.topology import Doubt, Observations
from module_agent.wire.messages import ConstantMotion

# A joint is moved again at most this often: doubts that three motions of different kinds leave open, a fourth
# does not settle either.
MAX_REPEATS = 3
OTHERS_TURNED_RAD = 0.5


class NextMotion(NamedTuple):
    """A slow motion of one joint that is observed once more.

    speed, travel: relative to the slow motion that every joint is explored with.
    others_rad: how far all other joints are turned from home first, so that weight and inertia act otherwise.
    """

    joint: str
    speed: float
    travel: float
    others_rad: float
    summary: str

    def pattern(self, slow: ConstantMotion) -> ConstantMotion:
        """Return the motion, `slow` being the one that every joint is explored with."""
        travel = self.travel * slow.velocity_rad_s * (slow.duration_s + slow.ramp_s)
        velocity = self.speed * slow.velocity_rad_s
        duration = travel / velocity - slow.ramp_s
        return slow.model_copy(update={"velocity_rad_s": velocity, "duration_s": duration})

    def travel_rad(self, slow: ConstantMotion) -> float:
        """Return how far the joint turns; the motion is to begin half of that before home."""
        pattern = self.pattern(slow)
        return pattern.velocity_rad_s * (pattern.duration_s + pattern.ramp_s)


def next_motions(
    doubts: Sequence[Doubt], observations: Observations, repeated: Mapping[str, int]
) -> tuple[NextMotion, ...]:
    """Return the motions that would settle the doubts, at most one per joint, the most doubtful first.

    Args:
        doubts: of a topology, the least certain first.
        observations: what it was made of.
        repeated: how often every joint was moved again already; a joint is given up after `MAX_REPEATS`.
    """
    wanted: dict[str, NextMotion] = {}
    for doubt in doubts:
        done = repeated.get(doubt.joint, 0)
        if doubt.joint not in wanted and done < MAX_REPEATS:
            wanted[doubt.joint] = _next(doubt, observations, done)
    return tuple(wanted.values())


def _next(doubt: Doubt, observations: Observations, done: int) -> NextMotion:
    seen = observations.get((doubt.joint, doubt.observer))
    if done == MAX_REPEATS - 1:
        how = 0.7, 1.0, OTHERS_TURNED_RAD
        summary = f"joint {doubt.joint} moves again with all other joints turned by {OTHERS_TURNED_RAD} rad"
    elif seen is None:
        how = 1.0, 1.0, 0.0
        summary = f"joint {doubt.joint} moves again, for {doubt.observer} has missed it"
    elif seen.give > 0.7 * seen.sigma:
        # Half the speed over the same way takes a quarter of the acceleration.
        how = 0.5 ** (done + 1), 1.0, 0.0
        summary = f"joint {doubt.joint} moves more slowly, for other joints gave way when it moved"
    else:
        how = 1.0, 1.5, 0.0
        summary = f"joint {doubt.joint} moves farther, for {doubt.observer} saw it through noise or shaking"
    return NextMotion(doubt.joint, *how, f"{summary}: {doubt.text}")
