"""Messages about the information in torques (`model.information`): the rows that a module is to keep, the
request with everything to compute with, and the answer. Sizes are bounded for 64 modules.
"""

import hashlib
from typing import Annotated, Self

from pydantic import Field, model_validator

from module_agent.wire.codec import encode
from module_agent.wire.messages import (
    MAX_ROWS_PER_MOTION,
    Counter,
    Message,
    Name,
    Part,
    Serial,
    Vector3,
    out_of_range,
)

MAX_MODULES = 64
MAX_PART_BYTES = 65_536
# A module's part in `ChainPart.geometry`: axis, point and IMU's pose, row by row.
GEOMETRY_BYTES = 8 * (3 + 3 + 16)

# Samples of all motions together, times modules squared, to which the time of computing goes: under a minute.
MAX_WORK = 200_000_000
# 85 years, of Unix time until 2055: sums of three such times, and a tenth for the drift, fit in 64 bits.
MAX_TIME_NS = 2_700_000_000_000_000_000
MAX_OFFSET_NS = 2.7e18

Instant = Annotated[int, Field(ge=-MAX_TIME_NS, le=MAX_TIME_NS)]


class RowRange(Part):
    """Feedback rows `first_row` up to and without `end_row` of one boot of a module, at least one."""

    serial: Serial
    boot: Annotated[int, Field(ge=0, lt=2**64)]
    first_row: Counter
    end_row: Counter

    @model_validator(mode="after")
    def _check_length(self) -> Self:
        if not 0 < self.end_row - self.first_row <= MAX_ROWS_PER_MOTION:
            raise out_of_range(
                f"rows {self.first_row} to {self.end_row} of {self.serial}: "
                f"1 to {MAX_ROWS_PER_MOTION} rows of a motion are kept"
            )
        return self


class CollectRequest(Message):
    """Ask a module to keep the rows of a motion, its own and those of other modules, which it fetches.

    The same motion again is the same request, and counts once.
    """

    sender: Name
    motion_id: Counter
    rows: Annotated[tuple[RowRange, ...], Field(min_length=1, max_length=MAX_MODULES)]

    @model_validator(mode="after")
    def _check_serials(self) -> Self:
        serials = [wanted.serial for wanted in self.rows]
        twice = next((serial for serial in serials if serials.count(serial) > 1), None)
        if twice is not None:
            raise out_of_range(f"rows of {twice} are asked for twice in one motion")
        return self


class ChainPart(Part):
    """A `model.chain.Chain` of n modules; `geometry` is one block of little-endian doubles, (n, 22)."""

    serials: Annotated[tuple[Serial, ...], Field(min_length=1, max_length=MAX_MODULES)]
    parent: tuple[Annotated[int, Field(ge=-1, lt=MAX_MODULES)], ...]
    reversed: tuple[bool, ...]
    geometry: Annotated[bytes, Field(max_length=MAX_MODULES * GEOMETRY_BYTES)]
    gravity_m_s2: Vector3


class ClockPart(Part):
    """How a module's clock maps to the session's (`signals.clock_map.ClockMap`)."""

    origin_ns: Annotated[int, Field(ge=0, le=MAX_TIME_NS)]
    offset_ns: Annotated[float, Field(ge=-MAX_OFFSET_NS, le=MAX_OFFSET_NS)]
    drift: Annotated[float, Field(ge=-0.1, le=0.1)]


class SpanPart(Part):
    """A motion in session time: rows from `start_ns` to `end_ns` count; `samples` from `first_ns` on."""

    motion_id: Counter
    start_ns: Instant
    end_ns: Instant
    first_ns: Instant
    samples: Annotated[int, Field(gt=0, le=65_536)]


class InformationRequest(Message):
    """Ask for the information in a module's own torques in some motions, with this chain and these clocks.

    `clocks` in the order of the chain's serials. Samples are `step_ns` apart and low-passed at `cutoff_hz`.
    The answer comes in parts; `offset` is where in the block it is to begin.
    """

    sender: Name
    chain: ChainPart
    clocks: Annotated[tuple[ClockPart, ...], Field(min_length=1, max_length=MAX_MODULES)]
    motions: Annotated[tuple[SpanPart, ...], Field(min_length=1, max_length=64)]
    step_ns: Annotated[int, Field(ge=1_000_000, le=1_000_000_000)]
    cutoff_hz: Annotated[float, Field(ge=0.01, le=500.0)]
    offset: Counter = 0

    @model_validator(mode="after")
    def _check_work(self) -> Self:
        samples, modules = sum(motion.samples for motion in self.motions), len(self.chain.serials)
        if samples * modules**2 > MAX_WORK:
            raise out_of_range(
                f"{samples} samples of {modules} modules: at most {MAX_WORK // modules**2} are computed with"
            )
        return self

    def digest(self) -> bytes:
        """Return a SHA-256 of the computation asked for: the same for every module, sender and part."""
        question = {"serial": "", "boot": 0, "seq": 0, "sender": "", "offset": 0}
        return hashlib.sha256(encode(self.model_copy(update=question))).digest()


class Information(Message):
    """Part of a module's answer: `total_bytes` of `information_block`, here those from `offset` on.

    `digest` is the request's; `motion_ids` are the motions that it holds, each once. No part is empty, and
    none reaches beyond the block.
    """

    digest: Annotated[bytes, Field(min_length=32, max_length=32)]
    motion_ids: Annotated[tuple[Counter, ...], Field(max_length=64)]
    total_bytes: Annotated[int, Field(gt=0, le=4_194_304)]
    offset: Counter
    part: Annotated[bytes, Field(min_length=1, max_length=MAX_PART_BYTES)]

    @model_validator(mode="after")
    def _check_end(self) -> Self:
        if self.offset + len(self.part) > self.total_bytes:
            raise out_of_range(
                f"{len(self.part)} bytes from {self.offset} on are beyond the {self.total_bytes} of the block"
            )
        return self
