"""Assemble a chain by the thesis' method: from circle point analyses only.

Inputs are the agents' circle fits of every joint's fast motion, during which all other joints stand still
(chapter 4.3), and gravity as the IMUs measure it at rest. For comparisons the agents' regressions can take
the circles' place, and only the IMU next to each joint can be used.
"""

from collections.abc import Callable, Sequence

from coordinator.kinematics.assembly import AssemblyError, assemble
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.chain_observations import PairObservation, circle_observation
from coordinator.recording.recording import Recording
from coordinator.topology.topology import Topology
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.wire.messages import Estimate

# The circle of a joint in an agent's estimate, with the mean positions of all joints (n,) meanwhile.
Observation = Callable[[Estimate, Array], PairObservation | None]


def thesis_chain(recording: Recording, topology: Topology) -> ChainEstimate | None:
    """Return the chain by circle point analysis; None without a joint moved by itself, or without a chain.

    The topology is given: the thesis' motions determine it too.

    Raises:
        DataError: the type of a module is not recorded, or no rest.
    """
    return chain_of_pairs(recording, topology, circle_observation)


def chain_of_pairs(
    recording: Recording, topology: Topology, observation: Observation, distal: bool = True
) -> ChainEstimate | None:
    """Return the chain that follows from single joints' motions; None as for `thesis_chain`.

    Args:
        recording, topology: of a robot whose joints moved one by one.
        observation: what is taken of an agent's estimate: its circle or its regression.
        distal: whether every module beyond a joint observes it, or only those mounted on it.

    Raises:
        DataError: the type of a module is not recorded, or no rest.
    """
    types = [recording.module_type(serial) for serial in topology.serials]
    rest = recording.rest_observation(topology.serials)
    pairs = _pairs(recording, topology.serials, rest.q_rad, observation)
    if not distal:
        on = {serial: topology.parent[k] for k, serial in enumerate(topology.serials)}
        pairs = [one for one in pairs if on[one.observer] == topology.serials.index(one.joint)]
    if not pairs:
        return None
    try:
        return assemble(topology, types, pairs, [rest]).estimate
    except AssemblyError:
        # Circles of a compliant arm may contradict each other: the thesis' method has no result then.
        return None


def _pairs(
    recording: Recording, serials: Sequence[str], still_rad: Array, observation: Observation
) -> list[PairObservation]:
    motions = {event.serial: event for event in recording.latest_motions("windowed_sine")}
    pairs = []
    for k, joint in enumerate(serials):
        motion = motions[joint].motion if joint in motions else None
        if motion is None:
            continue
        if motion.end_row is None:
            raise DataError(f"a motion of module {joint} has no end")
        q_rad = still_rad.copy()
        q_rad[k] = float(recording.rows(joint, motion.start_row, motion.end_row)["position_rad"].mean())
        for observer in serials:
            known = recording.estimates.get((joint, observer), {})
            estimates = [one for ids, one in known.items() if ids[-1] == motion.motion_id]
            if observer == joint or not estimates:
                continue
            pair = observation(estimates[0], q_rad)
            pairs += [] if pair is None else [pair]
    return pairs
