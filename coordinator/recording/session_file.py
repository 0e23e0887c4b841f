"""`session.mcap`: every message as it was sent or received, crash-safe, readable by any MCAP tool.

Topics are the keys; the kind (publication, request, reply) is in the channel's metadata. Message encoding is
msgpack with a JSON schema for each message type; the journal is JSON. Chunks are flushed five times a second,
because a crash loses the last one: the library's default of 1 MiB lost 11.8 s. They are compressed
with zstd (measured: 6.9 MB instead of 15.4 MB for 97 s of four modules, 0.27 s of CPU time).

Every chunk has a checksum. A chunk that fails it is left out, and reading goes on with the next one: whatever
a bad disk did to a file, what comes out is what was recorded, and what does not is reported. Indices are not
read, as the order of the file is that of the recording; the summary serves for channels whose first chunk is
damaged, if its own checksum holds.
"""

import io
import json
import mmap
import struct
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer
from pydantic import BaseModel
from zstandard import ZstdError

from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import MAX_MODULES, Entry, Kind
from module_agent.model.errors import RobotError, UsageError
from module_agent.wire.keys import parse
from module_agent.wire.messages import Ack
from module_agent.wire.topics import TOPICS

CHUNK_BYTES = 64 * 1024
FLUSH_NS = 200_000_000
# Channels are numbered in 16 bits, from 1. Anybody may publish under made-up serials: beyond `MAX_MODULES`
# only modules that were asked something are recorded, so that questions and answers always have channels.
MAX_CHANNELS = 2**16 - 1
MCAP0_MAGIC = b"\x89MCAP0\r\n"
# A record: its opcode, its length, its content. A chunk's content has 28 bytes before its compression.
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD_BYTES = 28
_CHUNK_MARK = b"\x04\x00\x00\x00zstd"
_MARK_AT = _HEAD.size + _CHUNK_HEAD_BYTES
_FOOTER = struct.Struct("<QQI")
# The end of the data has its checksum only. Every chunk is followed by indices, whose opcode is one bit away.
_DATA_END_BYTES = 4
_MAX_CHUNK_BYTES = 1 << 30
_OPCODES = frozenset(map(int, Opcode))
# A length of more than 63 bits overflows.
_UNREADABLE = (McapError, ZstdError, EndOfFile, struct.error, ValueError, MemoryError, OverflowError)

KINDS: tuple[Kind, ...] = ("publication", "request", "reply", "journal")


@cache
def _schema(message_type: type[BaseModel]) -> bytes:
    """Return the JSON schema of a message; a process that records many sessions makes each once."""
    return json.dumps(message_type.model_json_schema()).encode()


class SessionFileError(UsageError):
    """The file is not a recording of a session; the message names it."""


class NotRecorded(RobotError):
    """Nothing more can be recorded; the message says why, and what to do."""


class SessionWriter:
    """Appends entries to a new file, of `max_bytes` at most.

    When nothing more can be written, `failure` says why; what comes then is dropped, but for the journal
    where only the limit is reached. What was written stays readable. `unrecorded` counts the entries that
    have no place in it, of made-up modules.
    """

    def __init__(self, path: Path, max_bytes: int | None = None):
        self.path = path
        self.failure: NotRecorded | None = None
        self.unrecorded = 0
        self._max_bytes = max_bytes
        self._is_broken = False
        self._file = path.open("wb")
        self._flushed_ns = 0
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="x5", library="x5-coordinator")
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[Kind, str], int] = {}
        self._serials: set[str] = set()

    def write(self, entry: Entry) -> bool:
        """Append one entry; return False if it is left out, as it is of one module too many."""
        if not self._has_room(entry.kind, entry.topic):
            self.unrecorded += 1
            return False
        if self._is_broken or (self.failure is not None and entry.kind != "journal"):
            return True
        try:
            self._write(entry)
        except OSError as error:
            self._break(error)
        return True

    def _has_room(self, kind: Kind, topic: str) -> bool:
        if (kind, topic) in self._channels:
            return True
        if len(self._channels) >= MAX_CHANNELS:
            return False
        is_known = kind != "publication" or parse(topic).serial in self._serials
        return is_known or len(self._serials) < MAX_MODULES

    def _break(self, error: OSError) -> None:
        self._is_broken = True
        self.failure = NotRecorded(
            f"{self.path} cannot be written any more: {error.strerror or error}; what was recorded until "
            "then is kept: make room, or give another --out"
        )

    def _write(self, entry: Entry) -> None:
        channel = self._channels.get((entry.kind, entry.topic))
        if channel is None:
            channel = self._register(entry.kind, entry.topic)
        self._writer.add_message(channel, log_time=entry.t_ns, data=entry.payload, publish_time=entry.t_ns)
        if entry.t_ns - self._flushed_ns >= FLUSH_NS:
            self.flush()
            self._flushed_ns = entry.t_ns
            written = self._file.tell()
            if self._max_bytes is not None and written > self._max_bytes and self.failure is None:
                self.failure = NotRecorded(
                    f"{self.path} has reached {self._max_bytes / 1e9:g} GB, the limit of --max-disk; what "
                    "was recorded until then is kept"
                )

    def flush(self) -> None:
        """Pass all entries so far to the operating system, so that a crash of this process keeps them."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def _register(self, kind: Kind, topic: str) -> int:
        message_type = JournalEvent if kind == "journal" else TOPICS[parse(topic).leaf].message(kind) or Ack
        name = f"x5.{message_type.__name__}"
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", _schema(message_type))
        channel = self._writer.register_channel(
            topic=topic,
            message_encoding="json" if kind == "journal" else "msgpack",
            schema_id=self._schemas[name],
            metadata={"kind": kind},
        )
        self._channels[kind, topic] = channel
        if kind != "journal":
            self._serials.add(parse(topic).serial)
        return channel

    def close(self) -> None:
        """Write the index and close. May be called twice; an error is in `failure`."""
        if self._file.closed:
            return
        try:
            if not self._is_broken:
                self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
        except OSError as error:
            # Closed it is all the same.
            self._break(error)


class _Record(NamedTuple):
    """A record's opcode and its place in the file, or a damaged place, whose opcode is None."""

    opcode: int | None
    start: int
    end: int


def read_session(path: Path, report: Callable[[str], None] = lambda damage: None) -> Iterator[Entry]:
    """Yield the entries of a recording in the order of writing; a file cut short by a crash ends early.

    `report` receives a sentence about every damaged place, whose entries are left out.

    Raises:
        SessionFileError: there is no such file, or it is no recording of a session.
    """
    try:
        file = path.open("rb")
        size = path.stat().st_size
    except OSError as error:
        raise SessionFileError(f"{path}: {error.strerror or error}") from error
    with file:
        # A file cut within its first bytes is an empty recording, of a run that crashed at its start.
        if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))):
            raise SessionFileError(f"{path}: not an MCAP file; give the session.mcap of a run")
        if size > len(MCAP0_MAGIC):
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield from _entries(path, data, report)


def _entries(path: Path, data: mmap.mmap, report: Callable[[str], None]) -> Iterator[Entry]:
    channels = _summarised_channels(data)
    last_ns: int | None = None
    lost = 0
    for record in _records(data):
        messages: list[Message] = []
        if record.opcode == Opcode.CHUNK:
            try:
                messages = _messages(data, record, channels)
            except _UNREADABLE:
                record = record._replace(opcode=None)
        if record.opcode is None:
            after = "" if last_ns is None else f" after {last_ns * 1e-9:.2f} s"
            place = f"from byte {record.start} to {record.end}"
            report(f"{path.name} is damaged {place}: messages{after} may be missing")
        for message in messages:
            channel = channels.get(message.channel_id)
            if channel is None:
                lost += 1
                continue
            kind = channel.metadata.get("kind")
            if kind not in KINDS:
                raise SessionFileError(f"{path}: topic {channel.topic} is not of a session of this project")
            last_ns = message.log_time
            yield Entry(kind, channel.topic, message.log_time, bytes(message.data))
    if lost:
        report(f"{path.name}: {lost} messages are left out, as it is lost what they are")


def _records(data: mmap.mmap) -> Iterator[_Record]:
    """Yield the records up to the end of the data; where they cannot be made out, the next chunk is next."""
    at, size = len(MCAP0_MAGIC), len(data)
    complete = data[-len(MCAP0_MAGIC) :] == MCAP0_MAGIC
    while at + _HEAD.size <= size:
        opcode, length = _HEAD.unpack_from(data, at)
        end = at + _HEAD.size + length
        if opcode in _OPCODES and end <= size and _is_one_record(data, opcode, at, end):
            yield _Record(opcode, at, end)
            if opcode == Opcode.DATA_END:
                return
            at = end
            continue
        following = _next_chunk(data, at + 1)
        if following is None and not complete:
            # Cut short by a crash.
            return
        yield _Record(None, at, following or size)
        at = following or size


def _next_chunk(data: mmap.mmap, start: int) -> int | None:
    mark = data.find(_CHUNK_MARK, start + _MARK_AT)
    # The summary has such marks too, in records of another kind.
    while mark >= 0 and data[mark - _MARK_AT] != Opcode.CHUNK:
        mark = data.find(_CHUNK_MARK, mark + 1)
    return mark - _MARK_AT if mark >= 0 else None


def _is_one_record(data: mmap.mmap, opcode: int, start: int, end: int) -> bool:
    """Return whether a record's length is believable: a damaged one would swallow the chunks after it."""
    if opcode == Opcode.DATA_END:
        return end - start == _HEAD.size + _DATA_END_BYTES
    if opcode != Opcode.CHUNK:
        return data.find(_CHUNK_MARK, start, end) < 0
    mark = start + _MARK_AT
    held_at = mark + len(_CHUNK_MARK)
    if data[mark:held_at] != _CHUNK_MARK:
        # Another tool's file.
        return True
    held = int.from_bytes(data[held_at : held_at + 8], "little")
    return held_at + 8 + held == end


def _messages(data: mmap.mmap, record: _Record, channels: dict[int, Channel]) -> list[Message]:
    """Return the messages of a chunk, and add its channels to those that are known."""
    chunk = Chunk.read(ReadDataStream(io.BytesIO(data[record.start + _HEAD.size : record.end])))
    if chunk.uncompressed_size > _MAX_CHUNK_BYTES:
        raise McapError(f"a chunk of {chunk.uncompressed_size} bytes")
    records = breakup_chunk(chunk, validate_crc=True)
    channels.update({each.id: each for each in records if isinstance(each, Channel)})
    return [each for each in records if isinstance(each, Message)]


def _summarised_channels(data: mmap.mmap) -> dict[int, Channel]:
    """Return the channels of the summary; none where there is no summary, or it is damaged."""
    footer_at = len(data) - len(MCAP0_MAGIC) - _FOOTER.size - _HEAD.size
    if footer_at < len(MCAP0_MAGIC) or data[footer_at] != Opcode.FOOTER:
        return {}
    start, _, checksum = _FOOTER.unpack_from(data, footer_at + _HEAD.size)
    # The checksum is over all before itself.
    if not 0 < start < footer_at or zlib.crc32(data[start : footer_at + _HEAD.size + 16]) != checksum:
        return {}
    channels, at = {}, start
    while at < footer_at:
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(io.BytesIO(data[at : at + length])))
            channels[channel.id] = channel
        at += length
    return channels
