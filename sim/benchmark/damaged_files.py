"""What bad disks do to files: flipped bits, damaged sectors, and ends that are missing, by seed."""

from collections.abc import Callable, Mapping

from numpy.random import Generator

SECTOR_BYTES = 4096


def flipped(content: bytes, draw: Generator) -> bytes:
    """Return the content with one bit the other way round."""
    at, bit = int(draw.integers(len(content))), int(draw.integers(8))
    return content[:at] + bytes([content[at] ^ (1 << bit)]) + content[at + 1 :]


def _sector(content: bytes, draw: Generator) -> slice:
    first = SECTOR_BYTES * int(draw.integers(-(-len(content) // SECTOR_BYTES)))
    return slice(first, min(first + SECTOR_BYTES, len(content)))


def zeroed(content: bytes, draw: Generator) -> bytes:
    """Return the content with one sector of zeros."""
    sector = _sector(content, draw)
    return content[: sector.start] + bytes(sector.stop - sector.start) + content[sector.stop :]


def scrambled(content: bytes, draw: Generator) -> bytes:
    """Return the content with one sector of noise."""
    sector = _sector(content, draw)
    return content[: sector.start] + draw.bytes(sector.stop - sector.start) + content[sector.stop :]


def truncated(content: bytes, draw: Generator) -> bytes:
    """Return the beginning of the content."""
    return content[: int(draw.integers(len(content)))]


DAMAGES: Mapping[str, Callable[[bytes, Generator], bytes]] = {
    "a flipped bit": flipped,
    "a zeroed sector": zeroed,
    "a scrambled sector": scrambled,
    "a missing end": truncated,
}
