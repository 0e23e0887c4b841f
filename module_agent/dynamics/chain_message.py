"""Chains and clock maps as parts of messages, and back: doubles as they are, so that nothing is rounded."""

from collections.abc import Sequence

import numpy as np

from module_agent.dynamics.chain import Chain
from module_agent.dynamics.clock_map import ClockMap
from module_agent.wire.information_messages import GEOMETRY_BYTES, ChainPart, ClockPart


def chain_part(chain: Chain) -> ChainPart:
    """Return a chain as it goes over the wire.

    Raises:
        ValueError: more modules than a message carries.
    """
    joints = len(chain.serials)
    columns = [chain.axis, chain.point, chain.imu_home.reshape(joints, 16)]
    x, y, z = (float(value) for value in chain.gravity)
    return ChainPart(
        serials=chain.serials,
        parent=tuple(int(parent) for parent in chain.parent),
        reversed=tuple(bool(turned) for turned in chain.reversed),
        geometry=np.hstack(columns).astype("<f8").tobytes(),
        gravity_m_s2=(x, y, z),
    )


def chain_of(part: ChainPart) -> Chain:
    """Return the chain that a message carries; its arrays are read-only.

    Raises:
        ValueError: parts that do not fit, a parent that does not come before its child, a serial twice, or a
            value that is not finite.
    """
    joints = len(part.serials)
    if len(part.parent) != joints or len(part.reversed) != joints or len(set(part.serials)) != joints:
        raise ValueError(f"{joints} serials, {len(part.parent)} parents, {len(part.reversed)} mountings")
    if len(part.geometry) != joints * GEOMETRY_BYTES:
        raise ValueError(
            f"{len(part.geometry)} bytes of geometry, {joints} modules need {joints * GEOMETRY_BYTES}"
        )
    if any(parent >= child for child, parent in enumerate(part.parent)):
        raise ValueError(f"parents {part.parent}: a parent comes before its children")
    values = np.frombuffer(part.geometry, "<f8").astype(np.float64).reshape(joints, 22)
    if not np.isfinite(values).all():
        raise ValueError("the chain's geometry holds a value that is not finite")
    gravity = np.array(part.gravity_m_s2)
    axis, point, home = values[:, :3].copy(), values[:, 3:6].copy(), values[:, 6:].reshape(joints, 4, 4)
    for array in (axis, point, home, gravity):
        array.flags.writeable = False
    return Chain(part.serials, part.parent, part.reversed, axis, point, home, gravity)


def clock_part(clock: ClockMap) -> ClockPart:
    """Return a clock map as it goes over the wire, without how well it is known."""
    return ClockPart(
        origin_ns=int(clock.origin_ns), offset_ns=float(clock.offset_ns), drift=float(clock.drift)
    )


def clocks_of(parts: Sequence[ClockPart]) -> list[ClockMap]:
    """Return the clock maps that a message carries."""
    return [ClockMap(part.origin_ns, part.offset_ns, part.drift, 0.0) for part in parts]
