"""The topology from a recording, notes on missing observations, and the motions to repeat when in doubt."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.identification.signal_checks import MIN_FOLLOWED
from coordinator.identification.topology_observations import (
    ObservedMotions,
    observe,
    respond,
    simultaneous_motion,
    slow_motions,
)
from coordinator.kinematics.simultaneous_motion import motion_observations
from coordinator.recording.journal import excluded_modules, exclusion_notes, missing_modules
from coordinator.recording.recording import Recording
from coordinator.synchronisation.round_trips import map_clocks
from coordinator.topology.next_motion import NextMotion, next_motions
from coordinator.topology.topology import (
    MotionObservation,
    Observations,
    Topology,
    TopologyError,
    combined_observation,
    find_topology,
    likely_topology,
)
from module_agent.model.chain import Array
from module_agent.model.errors import DataError


class TopologyFound(NamedTuple):
    """The topology of the modules with observations, these, and notes on the others and on doubts.

    missing: those of the notes that name a module without which the topology is not whole, or a joint that
    was commanded and did not move: what it carries may be elsewhere in the tree.
    """

    topology: Topology
    observations: Observations
    notes: tuple[str, ...]
    missing: tuple[str, ...]


def search_topology(recording: Recording, serials: Sequence[str]) -> TopologyFound:
    """Find the topology of these modules by their slow motions.

    A motion of all joints at once counts too. A module without observations is left out; one whose joint did
    not move is included as a leaf.

    Raises:
        TopologyError: the observations contradict each other or leave open how a module is mounted.
    """
    observed = _observed_motions(recording, serials)
    observations, unmoved = _usable(observed)
    if not observations:
        reasons = "; ".join(f"joint {serial}: {why}" for serial, why in observed.unmoved.items())
        raise TopologyError(
            f"no module observed any motion: the topology cannot be identified. {reasons}", tuple(serials)
        )
    topology = find_topology(observations, unmoved)
    silent = [f"{s} observed no motion and is left out: its parent is not known" for s in observed.silent]
    still, excluded = _still(observed, topology), excluded_modules(recording.journal)
    doubts = [f"in doubt: {doubt.text}" for doubt in topology.doubts]
    halted = _halted(recording, [s for s in topology.serials if s not in still])
    notes = (*exclusion_notes(recording.journal), *silent, *still.values(), *halted, *doubts)
    dead = [text for serial, text in still.items() if serial not in excluded]
    missing = (*missing_modules(recording.journal, topology.serials), *silent, *dead, *halted)
    return TopologyFound(topology, observations, notes, missing)


def doubtful_motions(recording: Recording) -> tuple[NextMotion, ...]:
    """Return the motions to repeat to settle doubts about the topology; none if there is no doubt."""
    serials = sorted({e.serial for e in recording.journal if e.what == "motion" and e.purpose == "rest"})
    try:
        observations, unmoved = _usable(_observed_motions(recording, serials))
        doubts = likely_topology(observations, unmoved).doubts
    except DataError:
        return ()  # the identification reports what is missing
    first = 0 if simultaneous_motion(recording, serials) is not None else 1
    repeated = {s: len(slow_motions(recording, s)) - first for s in serials}
    return next_motions(doubts, observations, repeated)


def _observed_motions(recording: Recording, serials: Sequence[str]) -> ObservedMotions:
    """Return the observations of slow motions combined with those of all joints at once (`respond`)."""
    slow, whole = observe(recording, serials), simultaneous_motion(recording, serials)
    if whole is None:
        return slow
    clocks = map_clocks({s: recording.modules[s].round_trips for s in serials})
    combined = dict(motion_observations(serials, respond(recording, clocks, serials, whole)))
    for pair, observed in slow.observations.items():
        combined[pair] = combined_observation([combined[pair], observed])
    return ObservedMotions(combined, {}, ())


def _usable(observed: ObservedMotions) -> tuple[dict[tuple[str, str], MotionObservation], list[str]]:
    """Return the observations of modules that are not silent, and the joints that did not move."""
    left = {p: o for p, o in observed.observations.items() if p[0] not in observed.silent}
    return left, [s for s in observed.unmoved if s not in observed.silent]


def _halted(recording: Recording, joints: Sequence[str]) -> list[str]:
    """Return a sentence on every last motion of a joint that did not follow its command.

    It may have moved in an earlier one, so that the topology is known; of what it carries nothing is then.
    """
    sentences = []
    for event in recording.latest_motions("constant", "windowed_sine"):
        if event.serial not in joints or event.motion is None or event.motion.end_row is None:
            continue
        rows = recording.rows(event.serial, event.motion.start_row, event.motion.end_row)
        turned_rad, wanted_rad = (_span(rows[name]) for name in ("position_rad", "position_command_rad"))
        if turned_rad < MIN_FOLLOWED * wanted_rad:
            sentences.append(
                f"joint {event.serial} turned by {turned_rad:.2g} rad in its {event.purpose} motion, "
                f"{wanted_rad:.2g} rad were commanded: its motor is dead, or something held it; what it "
                "carries is not known"
            )
    return sentences


def _span(values: Array) -> float:
    """Return the range of the finite values, 0 without any."""
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if finite.size else 0.0


def _still(observed: ObservedMotions, topology: Topology) -> dict[str, str]:
    """Return a sentence on every joint of the topology that did not move, by serial."""
    unknown = "its mounting is not known, and what it carries is attributed to its parent"
    unmoved = {s: why for s, why in observed.unmoved.items() if s in topology.unmoved}
    return {s: f"joint {s} did not move ({why}): {unknown}" for s, why in unmoved.items()}
