"""The information in a module's own torques about the inertial parameters, from its kept rows of motions.

It uses the chain, clocks and times of the request, and the same resampling, low-pass and regressor as a
coordinator with the rows of all modules: both results agree to rounding.
"""

from collections.abc import Mapping
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.information import JointInformation, gather_joint, merge_joint
from module_agent.peers.row_collection import Track
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import NS_PER_S, JointMotion, filtered_motion, resample
from module_agent.signals.torque_terms import term_columns
from module_agent.torque_information.serialisation import chain_of, clocks_of
from module_agent.wire.information_messages import InformationRequest, SpanPart


def coupled(chain: Chain, joint: int) -> tuple[int, ...]:
    """Return the joints that a joint's torque depends on: itself, those that carry it, those it carries."""
    return (*chain.ancestors(joint)[:-1], *chain.descendants(joint))


def own_information(
    serial: str, request: InformationRequest, tracks: Mapping[int, Mapping[str, Track]]
) -> JointInformation:
    """Return the information of a module's torques in all motions of a request.

    Its columns are those of the bodies of the chain, and behind them its own of `torque_terms`.

    Args:
        serial: of the module.
        request: which motions, and what to compute with.
        tracks: by motion and serial, at least those of all `coupled` modules.

    Raises:
        DataError: a request that contradicts itself or is not about this module; a hole in the rows.
        KeyError: a track is missing.
    """
    chain = chain_of(request.chain)
    if serial not in chain.serials or len(request.clocks) != len(chain.serials):
        raise DataError(
            f"a chain of {', '.join(chain.serials)} with {len(request.clocks)} clocks is asked of {serial}"
        )
    joint = chain.serials.index(serial)
    clocks = dict(zip(chain.serials, clocks_of(request.clocks), strict=True))

    def of(span: SpanPart) -> JointInformation:
        own = _motion(chain, joint, clocks, request, span, tracks[span.motion_id])
        terms = term_columns(own, NS_PER_S / request.step_ns, request.cutoff_hz)[:, joint]
        motion = own.q_rad, own.qd_rad_s, own.qdd_rad_s2
        return gather_joint(chain, joint, *motion, own.tau_nm[:, joint], terms)

    return reduce(merge_joint, map(of, {motion.motion_id: motion for motion in request.motions}.values()))


def _motion(
    chain: Chain,
    joint: int,
    clocks: Mapping[str, ClockMap],
    request: InformationRequest,
    span: SpanPart,
    tracks: Mapping[str, Track],
) -> JointMotion:
    """Return one filtered motion; joints without influence stand still in it."""
    common = span.first_ns + request.step_ns * np.arange(span.samples, dtype=np.int64)
    signals = np.zeros((span.samples, len(chain.serials), 2))
    for k in coupled(chain, joint):
        serial = chain.serials[k]
        times, values = _within(tracks[serial], clocks[serial], span, request.step_ns)
        signals[:, k] = resample([times], [values], common)[:, 0]
    rate_hz = NS_PER_S / request.step_ns
    return filtered_motion(common, signals[..., 0], None, signals[..., 1], rate_hz, request.cutoff_hz)


def _within(track: Track, clock: ClockMap, span: SpanPart, step_ns: int) -> tuple[NDArray[np.int64], Array]:
    first_ns, last_ns = clock.module_span(span.start_ns, span.end_ns, step_ns)
    part = slice(
        np.searchsorted(track.t_ns, first_ns, side="left"), np.searchsorted(track.t_ns, last_ns, side="right")
    )
    if track.t_ns[part].size == 0:
        raise DataError(f"no row of motion {span.motion_id} lies within its times")
    return clock.to_session(track.t_ns[part]), np.column_stack(
        [track.position_rad[part], track.effort_nm[part]]
    )
