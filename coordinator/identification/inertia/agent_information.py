"""The information that agents gathered from their own torques: request, collect and check it.

A module's answer replaces the coordinator's rows of its joint if it is complete, of the boot that measured
the rows, computed with the same chain and clocks, and agrees with those rows along a random direction.
Otherwise the coordinator's rows are used.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import ModuleRecord, Recording
from coordinator.synchronisation.motion_windows import STEP_NS, span, window
from coordinator.synchronisation.round_trips import map_clocks
from module_agent.model.chain import Array, Chain
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


class Answers(NamedTuple):
    """The agents' information by joint, and the reasons why some have none."""

    joints: Mapping[int, JointInformation]
    reasons: tuple[str, ...]


class Products(NamedTuple):
    """Of a joint's rows A (m, p) and torques tau (m,): A^T A d with d of `direction`, A^T tau, |tau|^2, m."""

    along: Array
    target: Array
    square: Array
    samples: int

    def plus(self, other: "Products") -> "Products":
        """Return the products of both stretches of samples."""
        return Products(
            self.along + other.along,
            self.target + other.target,
            self.square + other.square,
            self.samples + other.samples,
        )


class AgentInformation(NamedTuple):
    """Who gathered the information of the joints.

    by_agents: serials whose information is the module's own. difference: the largest relative difference of
    an agent's information from the coordinator's rows; None without any answer. note: why some are not the
    agents'; empty if all are or no agent was asked.
    """

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


def answers(recording: Recording, chain: Chain, clocks: Mapping[str, ClockMap]) -> Answers:
    """Return the agents' complete answers to a request with this chain and these clocks."""
    digest, why = _asked(recording, chain, clocks)
    if digest is None:
        return Answers({}, (why,) if why else ())
    joints, reasons = dict[int, JointInformation](), list[str]()
    for k, serial in enumerate(chain.serials):
        try:
            joints[k] = _answer(recording.modules[serial], digest)
        except DataError as error:
            reasons.append(f"{serial}: {error}")
    return Answers(joints, tuple(reasons))


def direction(columns: int) -> Array:
    """Return the direction (columns,) along which answers are compared with the coordinator's rows."""
    return np.random.default_rng(0).standard_normal(columns)


def products(rows: Array, tau_nm: Array) -> Products:
    """Return the products of the rows (m, p) of a joint and its torques (m,)."""
    square = np.array([tau_nm @ tau_nm])
    along = rows.T @ (rows @ direction(rows.shape[1]))
    return Products(along, rows.T @ tau_nm, square, len(tau_nm))


def difference(answer: JointInformation, own: Products) -> float:
    """Return the relative difference of an answer from the rows that it should be the factor of.

    A^T A d for one random d tells two different A^T A apart but for rounding (Freivalds, 1977), at the cost
    of two products with the rows in place of their QR.
    """
    if answer.samples != own.samples or answer.r.shape[1] != len(own.target):
        return float("inf")
    r, z = answer.r, answer.z
    theirs = (r.T @ (r @ direction(r.shape[1])), r.T @ z, np.array([z @ z + answer.rest]))
    pairs = zip(theirs, own[:3], strict=True)
    return max(float(np.linalg.norm(a - b)) / max(float(np.linalg.norm(b)), 1e-300) for a, b in pairs)


def compared(
    asked: Answers, own: Mapping[int, Products], serials: Sequence[str]
) -> tuple[dict[int, JointInformation], AgentInformation]:
    """Return the answers that agree with the coordinator's rows by joint, and a report."""
    apart = {k: difference(answer, own[k]) for k, answer in asked.joints.items()}
    good = {k: asked.joints[k] for k, value in apart.items() if value <= AGREES_BELOW}
    reasons = list(asked.reasons)
    reasons += [f"{serials[k]}: its own differs by {apart[k]:.1e}" for k in apart if k not in good]
    note = f"torques by the rows of the coordinator, not the agent: {'; '.join(reasons)}" if reasons else ""
    by_agents = tuple(serials[k] for k in sorted(good))
    return good, AgentInformation(by_agents, max(apart.values(), default=None), note)


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
