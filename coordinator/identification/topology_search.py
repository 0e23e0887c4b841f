"""The topology out of a recording: what is found, what is missing, and what to move next when in doubt."""

from collections.abc import Sequence
from typing import NamedTuple

from coordinator.identification.simultaneous_exploration import respond, simultaneous_motion
from coordinator.identification.topology_observations import Seen, observe, slow_motions
from coordinator.kinematics.simultaneous_motion import motion_observations
from coordinator.recording.journal import excluded_modules
from coordinator.recording.recording import Recording
from coordinator.synchronisation.round_trips import map_clocks
from coordinator.topology.next_motion import NextMotion, next_motions
from coordinator.topology.topology import (
    MotionObservation,
    Topology,
    TopologyError,
    combined_observation,
    find_topology,
    likely_topology,
)
from module_agent.model.errors import DataError


class TopologyFound(NamedTuple):
    """The topology of the modules that respond, and notes in words on those that do not, and on doubts."""

    topology: Topology
    notes: tuple[str, ...]


def search_topology(recording: Recording, serials: Sequence[str]) -> TopologyFound:
    """Find the topology of these modules by their slow motions.

    Of all joints moved at once, that motion counts along. A module that saw nothing is left out; one whose
    joint did not move is part of it, as a leaf.

    Raises:
        TopologyError: what was seen contradicts itself or leaves open how a module is mounted.
    """
    seen = _seen(recording, serials)
    if not seen.observations:
        raise TopologyError(_nothing_seen(seen), tuple(serials))
    topology = find_topology(*_usable(seen))
    without = [f"{s} took no part: {why}" for s, why in excluded_modules(recording.journal).items()]
    return TopologyFound(topology, (*without, *_notes(seen, topology)))


def doubtful_motions(recording: Recording) -> tuple[NextMotion, ...]:
    """Return what to move next to settle doubts about the topology, nothing if there are none left."""
    serials = sorted({e.serial for e in recording.journal if e.what == "motion" and e.purpose == "rest"})
    try:
        observations, unmoved = _usable(_seen(recording, serials))
        doubts = likely_topology(observations, unmoved).doubts
    except DataError:
        return ()  # nothing to go by; whoever assembles the robot next says what is missing
    first = 0 if simultaneous_motion(recording, serials) is not None else 1
    repeated = {s: len(slow_motions(recording, s)) - first for s in serials}
    return next_motions(doubts, observations, repeated)


def _seen(recording: Recording, serials: Sequence[str]) -> Seen:
    """Return what the slow motions say, and the motion of all joints at once, put together.

    Raises:
        ValueError: the motion of all joints cannot be evaluated; see `whole_exploration.respond`.
    """
    slow, whole = observe(recording, serials), simultaneous_motion(recording, serials)
    if whole is None:
        return slow
    clocks = map_clocks({s: recording.modules[s].round_trips for s in serials})
    found = dict(motion_observations(serials, respond(recording, clocks, serials, whole)))
    for pair, seen in slow.observations.items():
        found[pair] = combined_observation([found[pair], seen])
    return Seen(found, {}, ())


def _usable(seen: Seen) -> tuple[dict[tuple[str, str], MotionObservation], list[str]]:
    """Return the observations among modules that saw something, and the joints that did not move."""
    left = {p: o for p, o in seen.observations.items() if p[0] not in seen.blind}
    return left, [s for s in seen.unmoved if s not in seen.blind]


def _nothing_seen(seen: Seen) -> str:
    reasons = "; ".join(f"joint {serial}: {why}" for serial, why in seen.unmoved.items())
    return f"no module saw any motion, so nothing is known of the topology. {reasons}"


def _notes(seen: Seen, topology: Topology) -> list[str]:
    notes = [f"{s} saw no motion at all and is left out: who carries it is not known" for s in seen.blind]
    notes += [
        f"joint {s} did not move ({why}): its mounting is not known, and whatever it carries shows on what "
        "carries it"
        for s, why in seen.unmoved.items()
        if s in topology.unmoved
    ]
    notes += [f"in doubt: {doubt.text}" for doubt in topology.doubts]
    return notes
