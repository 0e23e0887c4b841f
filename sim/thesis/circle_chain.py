"""Assemble a chain by the thesis' method: from circle point analyses only.

Inputs are the agents' circle fits of every joint's fast motion, during which all other joints stand still
(chapter 4.3), and gravity as the IMUs measure it at rest.
"""

from collections.abc import Sequence

from coordinator.kinematics.assembly import AssemblyError, assemble
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.chain_observations import PairObservation, circle_observation
from coordinator.recording.journal import JournalEvent, Purpose
from coordinator.recording.recording import Recording
from coordinator.topology.topology import Topology
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import Estimate


def thesis_chain(recording: Recording, topology: Topology) -> ChainEstimate | None:
    """Return the chain by circle point analysis; None without a joint moved by itself, or without a chain.

    The topology is given: the thesis' motions determine it too.

    Raises:
        DataError: the type of a module is not recorded, or no rest.
    """
    types = [recording.module_type(serial) for serial in topology.serials]
    rest = recording.rest_observation(topology.serials)
    pairs = _pairs(recording, topology.serials, rest.q_rad)
    if not pairs:
        return None
    try:
        return assemble(topology, types, pairs, [rest]).estimate
    except AssemblyError:
        # Circles of a compliant arm may contradict each other: the thesis' method has no result then.
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
            estimate = _estimate(recording, joint, observer, event.motion.motion_id)
            if estimate is None or joint == observer:
                continue
            pair = circle_observation(estimate, q_rad)
            pairs += [] if pair is None else [pair]
    return pairs


def _estimate(recording: Recording, joint: str, observer: str, motion_id: int) -> Estimate | None:
    estimates = recording.estimates.get((joint, observer), {})
    return next((estimate for ids, estimate in estimates.items() if ids[-1] == motion_id), None)


def _last(recording: Recording, purpose: Purpose, serial: str) -> JournalEvent | None:
    motions = [event for event in recording.journal if event.what == "motion"]
    own = [event for event in motions if (event.purpose, event.serial) == (purpose, serial)]
    return own[-1] if own else None


def _rows(recording: Recording, event: JournalEvent) -> Rows:
    motion = event.motion
    if motion is None or motion.end_row is None:
        raise DataError(f"a motion of module {event.serial} has no end")
    return recording.rows(event.serial, motion.start_row, motion.end_row)
