"""The information that agents gathered from their own torques: request, collect and check it.

A module's answer replaces the coordinator's rows of its joint if it is complete, of the boot that measured
the rows, and computed with the same chain and clocks. Otherwise the coordinator's rows are used.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import ModuleRecord, Recording
from coordinator.synchronisation.motion_windows import STEP_NS, span, window
from coordinator.synchronisation.round_trips import map_clocks
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.model.information import JointInformation
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import DYNAMIC_CUTOFF_HZ
from module_agent.torque_information.serialisation import chain_of, chain_part, clock_part, clocks_of, unpack
from module_agent.wire.information_messages import MAX_MODULES, InformationRequest, RowRange, SpanPart

# Differences of a chain and of clocks that are computed again, for example on another machine.
SAME_CHAIN, SAME_CLOCK_NS = 1e-9, 2.0
# The rounding of some hundred thousand additions of doubles. More is another computation.
AGREES_BELOW = 1e-10
# Rows around the motion that are kept too: the clock maps are not final yet.
_SPARE_NS = 100_000_000


class AgentInformation(NamedTuple):
    """The information of n joints, and who gathered it.

    by_agents: serials whose information is the module's own. difference: the largest relative difference
    between an agent's and the coordinator's information of a joint; None without any answer. note: why some
    are not the agents'; empty if all are or no agent was asked.
    """

    joints: tuple[JointInformation, ...]
    by_agents: tuple[str, ...]
    difference: float | None
    note: str


def dynamic_steps(recording: Recording) -> list[JournalEvent]:
    """Return the motions that inertia is identified from: of every step the latest, as `dynamic_windows`."""
    return list({event.step: event for event in recording.motions("dynamic")}.values())


def rows_to_keep(recording: Recording, serials: Sequence[str], event: JournalEvent) -> tuple[RowRange, ...]:
    """Return the rows of every module that agents have to keep of a motion.

    Raises:
        DataError: a module has no rows of it, or no round trip by which to tell when it was.
    """
    clocks = map_clocks({s: recording.modules[s].trips for s in serials})
    start_ns, end_ns = span(recording, clocks, event, DYNAMIC_CUTOFF_HZ)
    ranges = []
    for serial in serials:
        record = recording.modules[serial]
        around = clocks[serial].module_span(start_ns - _SPARE_NS, end_ns + _SPARE_NS, STEP_NS)
        first, end = record.rows.range_between(*around)
        if first == end or record.rows.missing(first, end):
            raise DataError(f"rows of {serial} in the motion of {event.step} are missing")
        ranges.append(RowRange(serial=serial, boot=record.boot, first_row=first, end_row=end))
    return tuple(ranges)


def question(
    recording: Recording, chain: Chain, clocks: Mapping[str, ClockMap], sender: str
) -> InformationRequest:
    """Return the request to every module; serial, boot, sequence number and offset are to be filled in.

    Raises:
        DataError: there is no dynamic motion, a hole in its rows, or more than a message carries.
    """
    steps = dynamic_steps(recording)
    if not steps or len(chain.serials) > MAX_MODULES:
        raise DataError(f"{len(steps)} dynamic motions of {len(chain.serials)} modules")
    motions = []
    for event in steps:
        assert event.motion is not None
        start_ns, end_ns = span(recording, clocks, event, DYNAMIC_CUTOFF_HZ)
        t_ns = window(recording, clocks, chain.serials, event, DYNAMIC_CUTOFF_HZ).t_ns
        within = {"start_ns": start_ns, "end_ns": end_ns, "first_ns": int(t_ns[0]), "samples": len(t_ns)}
        motions.append(SpanPart(motion_id=event.motion.motion_id, **within))
    return InformationRequest(
        serial="",
        boot=0,
        seq=0,
        sender=sender,
        chain=chain_part(chain),
        clocks=tuple(clock_part(clocks[s]) for s in chain.serials),
        motions=tuple(motions),
        step_ns=STEP_NS,
        cutoff_hz=DYNAMIC_CUTOFF_HZ,
    )


def gathered(
    recording: Recording, chain: Chain, clocks: Mapping[str, ClockMap], own: Sequence[JointInformation]
) -> AgentInformation:
    """Return the agents' information where they have answered, else the coordinator's `own`, joint by joint.

    If the coordinator's own rows have further columns than the agents', the two are compared in the columns
    that both have, and the own rows are used.
    """
    digest, why = _asked(recording, chain, clocks)
    if digest is None:
        return AgentInformation(tuple(own), (), None, why)
    joints, by_agents, apart, reasons = list(own), list[str](), list[float](), list[str]()
    for k, serial in enumerate(chain.serials):
        try:
            theirs = _answer(recording.modules[serial], digest)
        except DataError as error:
            reasons.append(f"{serial}: {error}")
            continue
        apart.append(difference(theirs, own[k]))
        if apart[-1] > AGREES_BELOW:
            reasons.append(f"{serial}: its own differs by {apart[-1]:.1e}")
        elif theirs.r.shape[1] == own[k].r.shape[1]:
            joints[k] = theirs
            by_agents.append(serial)
    note = f"torques by the rows of the coordinator, not the agent: {'; '.join(reasons)}" if reasons else ""
    return AgentInformation(tuple(joints), tuple(by_agents), max(apart, default=None), note)


def difference(one: JointInformation, other: JointInformation) -> float:
    """Return the relative difference of two pieces of information in the columns that both have.

    R^T R, R^T z and |tau|^2 are compared; the rows themselves are unique up to their signs only.
    """
    if one.samples != other.samples:
        return float("inf")
    both = min(one.r.shape[1], other.r.shape[1])
    products = [
        (i.r[:, :both].T @ i.r[:, :both], i.r[:, :both].T @ i.z, np.array([i.z @ i.z + i.rest]))
        for i in (one, other)
    ]
    return max(
        float(np.linalg.norm(a - b)) / max(float(np.linalg.norm(b)), 1e-300)
        for a, b in zip(*products, strict=True)
    )


def _asked(recording: Recording, chain: Chain, clocks: Mapping[str, ClockMap]) -> tuple[bytes | None, str]:
    """Return the latest request with this chain, these clocks and these motions, or why there is none."""
    if not recording.questions:
        return None, ""
    motions = {e.motion.motion_id for e in dynamic_steps(recording) if e.motion is not None}
    for digest, asked in reversed(recording.questions.items()):
        if _is_same(asked, chain, clocks) and {m.motion_id for m in asked.motions} == motions:
            return digest, ""
    return None, "the agents were asked with another chain, other clocks or other motions"


def _is_same(asked: InformationRequest, chain: Chain, clocks: Mapping[str, ClockMap]) -> bool:
    chain_asked = chain_of(asked.chain)
    if chain_asked[:3] != chain[:3] or asked.cutoff_hz != DYNAMIC_CUTOFF_HZ or asked.step_ns != STEP_NS:
        return False
    off = max(float(np.abs(a - b).max()) for a, b in zip(chain_asked[3:], chain[3:], strict=True))
    ends = np.array([t for motion in asked.motions for t in (motion.start_ns, motion.end_ns)])
    late = [
        np.abs(there.to_module(ends) - clocks[serial].to_module(ends)).max()
        for serial, there in zip(chain.serials, clocks_of(asked.clocks), strict=True)
    ]
    return off <= SAME_CHAIN and float(max(late)) <= SAME_CLOCK_NS


def _answer(module: ModuleRecord, digest: bytes) -> JointInformation:
    """Put the parts of an answer together; a DataError says that it is not whole, or not information."""
    parts = module.information.get(digest, {})
    block = b"".join(parts[offset].part for offset in sorted(parts))
    total = next(iter(parts.values())).total_bytes if parts else 0
    if not parts or len(block) != total:
        raise DataError(f"{len(block)} of {total or '?'} bytes of its answer have come")
    return unpack(block)
