"""The chain that the thesis' way makes of a recording: put together from circle point analyses, no more.

Only what the agents found by that analysis counts, in the fast motion of every joint by itself, and gravity
as the IMUs felt it at rest. As the thesis has it (chapter 4.3), all other joints stand still meanwhile.
"""

from collections.abc import Sequence

from coordinator.kinematics.assembly import AssemblyError, assemble
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.chain_observations import PairObservation, circle_observation
from coordinator.recording.at_rest import rest_observation
from coordinator.recording.journal import JournalEvent, Purpose
from coordinator.recording.recording import Recording
from coordinator.topology.topology import Topology
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import Estimate


def thesis_chain(recording: Recording, topology: Topology) -> ChainEstimate | None:
    """Return the chain by circle point analysis; None without a joint moved by itself, or without a chain.

    The topology is given: the thesis' own motions tell it as well as any.

    Raises:
        DataError: a module has not told its type, or was not recorded at rest.
    """
    types = [recording.module_type(serial) for serial in topology.serials]
    rest = rest_observation(recording, topology.serials)
    pairs = _pairs(recording, topology.serials, rest.q_rad)
    if not pairs:
        return None
    try:
        return assemble(topology, types, pairs, [rest]).estimate
    except AssemblyError:
        # What the circles of an arm that gives say may contradict itself: the thesis' way has no answer then.
        return None


def _pairs(recording: Recording, serials: Sequence[str], still_rad: Array) -> list[PairObservation]:
    pairs = []
    for k, joint in enumerate(serials):
        event = _last(recording, "windowed_sine", joint)
        if event is None or event.motion is None:
            continue
        q_rad = still_rad.copy()
        q_rad[k] = float(_rows(recording, event)["position_rad"].mean())
        for observer in serials:
            found = _estimate(recording, joint, observer, event.motion.motion_id)
            if found is None or joint == observer:
                continue
            pair = circle_observation(found, q_rad)
            pairs += [] if pair is None else [pair]
    return pairs


def _estimate(recording: Recording, joint: str, observer: str, motion_id: int) -> Estimate | None:
    found = recording.estimates.get((joint, observer), {})
    return next((estimate for ids, estimate in found.items() if ids[-1] == motion_id), None)


def _last(recording: Recording, purpose: Purpose, serial: str) -> JournalEvent | None:
    motions = [event for event in recording.journal if event.what == "motion"]
    found = [event for event in motions if (event.purpose, event.serial) == (purpose, serial)]
    return found[-1] if found else None


def _rows(recording: Recording, event: JournalEvent) -> Rows:
    motion = event.motion
    if motion is None or motion.end_row is None:
        raise DataError(f"a motion of module {event.serial} has no end")
    return recording.rows(event.serial, motion.start_row, motion.end_row)
