"""All messages that a session received and sent, in order, with indices over them.

The live session and a replay add the same entries to the same `Recording`, so that both compute the same
results. The recording's hash is the trace hash of the run.
"""

import copy
import hashlib
import struct
from array import array
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from coordinator.kinematics.chain_observations import RestObservation
from coordinator.recording.journal import JournalEvent, Purpose, since_joined
from module_agent.model.catalogue import ImuKind, ModuleType, TorqueKind, module_type
from module_agent.model.errors import DataError, RobotError
from module_agent.wire.codec import decode
from module_agent.wire.feedback_rows import ROW, Rows
from module_agent.wire.information_messages import Information, InformationRequest
from module_agent.wire.keys import Leaf, parse
from module_agent.wire.messages import Ack, Estimate, Feedback, Info, Message, Status
from module_agent.wire.refusal import Refusal, WireError
from module_agent.wire.row_log import MAX_ROWS, RowLog
from module_agent.wire.topics import TOPICS, Exchange

P = ParamSpec("P")
T = TypeVar("T")
Kind = Exchange | Literal["journal"]
JOURNAL_TOPIC = "journal"
# Requests that wait for an answer; an answer comes within seconds, if it comes.
MAX_OPEN_REQUESTS = 4096
# Of one module in one session, and of modules: what is beyond is made up, and is not to fill the memory.
MAX_BOOTS, MAX_MODULES = 32, 1024
# Of all modules together, 27 GB: full logs of rows of 67 modules, or 70 min of 256 modules at 250 Hz.
MAX_ROWS_OF_ALL = 1 << 28
# Of a boot that has not answered a question, which may be made up: 16 s at 250 Hz, in 0.4 MB.
STRANGER_ROWS = 4096
# Of one joint by one module: motions that it was estimated from.
MAX_ESTIMATES = 256


class RecordingFull(RobotError):
    """No more feedback of a session can be kept in memory; the message names a module and says what to do."""


class Entry(NamedTuple):
    """One recorded message: `topic` is its key (or `journal`), `t_ns` the session time."""

    kind: Kind
    topic: str
    t_ns: int
    payload: bytes


class RoundTrip(NamedTuple):
    """A request and its reply: session times of sending and receiving, module time of the reply."""

    sent_ns: int
    received_ns: int
    module_ns: int


class Arrivals:
    """Module times of the newest rows of published messages, and the session times of their arrival [ns].

    One thread adds and forgets, others may read and copy meanwhile: both times of a message come and go at
    once.
    """

    def __init__(self, times_ns: Iterable[int] = ()) -> None:
        # In turn: the time of a message's row, and that of its arrival.
        self._times_ns = array("q", times_ns)

    def add(self, row_ns: int, arrival_ns: int) -> None:
        """Note a message."""
        self._times_ns.extend((row_ns, arrival_ns))

    def columns(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return both times, (n,) each, as a copy: others may be added meanwhile."""
        row_ns, arrival_ns = np.array(self._times_ns[:], np.int64).reshape(-1, 2).T.copy()
        return row_ns, arrival_ns

    def copied(self) -> "Arrivals":
        """Return the arrivals so far, to which later ones are not added."""
        return Arrivals(self._times_ns[:])

    def forget(self, kept: int) -> None:
        """Drop all but the newest."""
        del self._times_ns[: max(0, len(self._times_ns) - 2 * kept)]


class FeedbackLoss(NamedTuple):
    """How many rows of a module's feedback came, from the first to the newest.

    received: recorded, however they came. lost: had not come by themselves before they came on request, or
    did not come at all. missing: of the lost ones those that did not come on request either.
    """

    serial: str
    received: int
    lost: int
    missing: int


class ModuleRecord:
    """What is known of one boot of one module; times in nanoseconds.

    newest_ns: latest module time in any message. feedback_ns: session time at which feedback was published
    last, None before the first. newest_row_ns, newest_row_arrival_ns: module time of the newest published
    row, and session time at which it first arrived; messages that come late or twice do not change them.
    arrivals: of all published messages whose rows had not come before. has_answered: whether it has answered
    a question; one that has not may be made up. requested_rows: how many came in answer to a request, and not
    by themselves before.
    """

    def __init__(self, serial: str, boot: int):
        self.serial = serial
        self.boot = boot
        self.rows = RowLog(boot)
        self.info: Info | None = None
        self.status: Status | None = None
        self.round_trips: list[RoundTrip] = []
        self.settled_trips: int | None = None
        self.information: dict[bytes, dict[int, Information]] = {}
        self.newest_ns = 0
        self.feedback_ns: int | None = None
        self.newest_row_ns = -1
        self.newest_row_arrival_ns = 0
        self.arrivals = Arrivals()
        self.has_answered = False
        self.requested_rows = 0

    @property
    def loss(self) -> FeedbackLoss:
        """The loss of feedback, unless rows were forgotten."""
        log = self.rows
        missing = log.end_row - log.first_row - log.count
        return FeedbackLoss(self.serial, log.count, missing + self.requested_rows, missing)

    @property
    def trips(self) -> list[RoundTrip]:
        """The round trips for mapping clocks: all up to the journal's `settled` event."""
        return self.round_trips[: self.settled_trips]

    def copied(self) -> "ModuleRecord":
        """Return a record of the rows and round trips so far, to which later ones are not added."""
        record = copy.copy(self)
        record.rows, record.round_trips = self.rows.copied(), list(self.round_trips)
        record.arrivals = self.arrivals.copied()
        return record

    def forget(self, rows: int, round_trips: int) -> None:
        """Drop all but the newest rows and round trips, for sessions that go on for long."""
        self.rows.forget_before(self.rows.end_row - rows)
        self.arrivals.forget(rows)
        del self.round_trips[: max(0, len(self.round_trips) - round_trips)]


class Recording:
    """The messages of one session and their indices. `modules` holds the latest boot of every serial.

    explored: what had been recorded at the journal's `explored` event; None before it, and in older
    recordings, which do not have it. damage: sentences on places of a file that could not be read.
    not_finite: by serial, how many messages with values that are no numbers were refused.
    """

    def __init__(self) -> None:
        self.modules: dict[str, ModuleRecord] = {}
        self.past: dict[tuple[str, int], ModuleRecord] = {}
        self.estimates: dict[tuple[str, str], dict[tuple[int, ...], Estimate]] = {}
        self.journal: list[JournalEvent] = []
        self.explored: Recording | None = None
        self.questions: dict[bytes, InformationRequest] = {}
        self.refused: dict[str, int] = {}
        self.not_finite: dict[str, int] = {}
        self.damage: list[str] = []
        self._hash = hashlib.sha256()
        self._sent: dict[tuple[str, int], int] = {}

    @property
    def trace_hash(self) -> str:
        """SHA-256 over kind, topic, session time and bytes of every message so far."""
        return self._hash.hexdigest()

    def module(self, serial: str, boot: int) -> ModuleRecord:
        """Return the record of one boot of a module, new if it was not known."""
        record = self.past.get((serial, boot))
        if record is None:
            self._make_room(serial)
            latest = self.modules.get(serial)
            if latest is not None and not latest.has_answered:
                latest.forget(0, 0)
            # A late message of an earlier boot does not make that boot the latest again.
            record = self.past[serial, boot] = self.modules[serial] = ModuleRecord(serial, boot)
        return record

    def _make_room(self, serial: str) -> None:
        """Forget a boot of a module where there are too many: made-up ones first, then those with few rows.

        Raises:
            WireError: LIMIT, there are too many modules.
        """
        if serial not in self.modules and len(self.modules) >= MAX_MODULES:
            raise WireError(Refusal.LIMIT, f"{serial} is one module more than {MAX_MODULES}")
        boots = [record for (each, _), record in self.past.items() if each == serial]
        if len(boots) >= MAX_BOOTS:
            del self.past[serial, min(boots, key=lambda one: (one.has_answered, one.rows.count)).boot]

    def _forget_stranger(self, module: ModuleRecord) -> None:
        """Forget the older rows of a module that has not answered yet: anybody may publish as one."""
        if not module.has_answered:
            kept = STRANGER_ROWS if self.modules[module.serial] is module else 0
            if module.rows.end_row - module.rows.first_row > 1.1 * kept:
                module.forget(kept, kept)

    def check_room_for(self, serials: Iterable[str], duration_s: float) -> None:
        """Check that the feedback of modules can be kept for so long, before a session that needs all of it.

        Raises:
            RecordingFull: it cannot.
        """
        modules = [self.modules[serial] for serial in serials]
        rates_hz = [0.0 if one.info is None else one.info.feedback_rate_hz for one in modules]
        rows = [one.rows.count + rate * duration_s for one, rate in zip(modules, rates_hz, strict=True)]
        if max(rows, default=0.0) > MAX_ROWS or sum(rows) > MAX_ROWS_OF_ALL:
            raise RecordingFull(
                f"the session takes {duration_s / 60.0:.3g} min and makes {sum(rows):.0f} feedback rows of "
                f"{len(modules)} modules; at most {MAX_ROWS_OF_ALL}, and {MAX_ROWS} of each, are kept in "
                "memory: plan fewer or shorter motions, or give the agents a lower --feedback-rate"
            )

    def check_room(self, serials: Iterable[str]) -> None:
        """Check that the next feedback of modules can be kept, for sessions that need all of it.

        Raises:
            RecordingFull: it cannot.
        """
        for serial in serials:
            module = self.modules[serial]
            if module.rows.is_full:
                raise RecordingFull(
                    f"no more feedback of module {serial} can be kept in memory: there are "
                    f"{module.rows.count} rows of it{_lasted(module)}; {_WHAT_TO_DO}"
                )
        total = sum(module.rows.count for module in self.modules.values())
        if total > MAX_ROWS_OF_ALL:
            most = max(self.modules.values(), key=lambda module: module.rows.count)
            raise RecordingFull(
                f"no more feedback can be kept in memory: there are {total} rows of {len(self.modules)} "
                f"modules, most of them of {most.serial}: {most.rows.count}{_lasted(most)}; {_WHAT_TO_DO}"
            )

    def add(self, entry: Entry) -> Message | JournalEvent:
        """Add one entry; return its message.

        Raises:
            WireError: the bytes are no message of their key, or no event of the journal; counted in
                `refused` by reason.
        """
        if entry.kind == "journal":
            event = self._counted(JournalEvent.decode, entry.payload)
            self.journal.append(event)
            if event.what in ("session", "explored"):
                self.explored = self._so_far() if event.what == "explored" else None
            if event.what in ("session", "settled"):
                for module in self.modules.values():
                    module.settled_trips = len(module.round_trips) if event.what == "settled" else None
            return event
        head = f"{entry.kind} {entry.topic} {len(entry.payload)} ".encode()
        self._hash.update(head + struct.pack("<q", entry.t_ns) + entry.payload)
        try:
            return self._counted(self._index, entry, entry.kind)
        except WireError as error:
            if error.reason is Refusal.NOT_FINITE:
                serial = parse(entry.topic).serial
                if serial in self.modules or len(self.not_finite) < MAX_MODULES:
                    self.not_finite[serial] = self.not_finite.get(serial, 0) + 1
            raise

    def _counted(self, read: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T:
        """Return what is read; count it by reason where it is refused."""
        try:
            return read(*arguments, **options)
        except WireError as error:
            self.refused[error.reason.value] = self.refused.get(error.reason.value, 0) + 1
            raise

    def accept(self, entry: Entry) -> Message | None:
        """Add one entry; return its message, None if it is of the journal or unreadable, see `refused`."""
        try:
            message = self.add(entry)
        except RobotError:
            return None
        return message if isinstance(message, Message) else None

    def _so_far(self) -> "Recording":
        """Return a recording of what has been recorded, to which later entries are not added.

        Entries may be added meanwhile by another thread.
        """
        so_far = Recording()
        so_far.modules = {serial: module.copied() for serial, module in dict(self.modules).items()}
        so_far.past = {(serial, module.boot): module for serial, module in so_far.modules.items()}
        so_far.estimates = {pair: dict(each) for pair, each in dict(self.estimates).items()}
        so_far.journal = list(self.journal)
        so_far.not_finite, so_far.damage = dict(self.not_finite), list(self.damage)
        so_far._hash = self._hash.copy()
        return so_far

    def without(self, serials: Collection[str]) -> "Recording":
        """Return the recording of the robot without some modules, whose joints stand still.

        Motions of several joints at once are not part of it, as these joints moved along. It is for reading.
        """
        rest = self._so_far()
        rest.explored = None
        rest.modules = {s: module for s, module in rest.modules.items() if s not in serials}
        rest.past = {key: module for key, module in rest.past.items() if key[0] not in serials}
        rest.estimates = {
            pair: estimates for pair, estimates in rest.estimates.items() if not set(pair) & set(serials)
        }
        together = ("whole", "dynamic", "held_out")
        rest.journal = [
            event
            for event in rest.journal
            if event.what != "motion" or (event.serial not in serials and event.purpose not in together)
        ]
        return rest

    def _index(self, entry: Entry, exchange: Exchange) -> Message:
        parts = parse(entry.topic)
        message = _decode(exchange, parts.leaf, entry.payload)
        if message.serial != parts.serial:
            raise WireError(Refusal.WRONG_SERIAL, f"{message.serial} speaks on the key of {parts.serial}")
        if exchange == "request":
            self._sent[entry.topic, message.seq] = entry.t_ns
            if len(self._sent) > MAX_OPEN_REQUESTS:
                del self._sent[next(iter(self._sent))]
            if isinstance(message, InformationRequest):
                self.questions.setdefault(message.digest(), message)
            return message
        if exchange == "publication" and TOPICS[parts.leaf].published_by == "coordinator":
            return message
        module = self.module(message.serial, message.boot)
        self._note(module, message, entry)
        return message

    def _note(self, module: ModuleRecord, message: Message, entry: Entry) -> None:
        module.has_answered |= entry.kind == "reply"
        match message:
            case Feedback():
                is_new = not module.rows.has(message.first_row + message.count - 1)
                before = module.rows.count
                rows = module.rows.add(message)
                if entry.kind == "reply":
                    module.requested_rows += module.rows.count - before
                if len(rows):
                    row_ns = int(rows["t_ns"][-1])
                    module.newest_ns = max(module.newest_ns, row_ns)
                    if entry.kind == "publication":
                        module.feedback_ns = entry.t_ns
                        if is_new:
                            module.arrivals.add(row_ns, entry.t_ns)
                        if row_ns > module.newest_row_ns:
                            module.newest_row_ns, module.newest_row_arrival_ns = row_ns, entry.t_ns
                self._forget_stranger(module)
            case Status() | Ack():
                module.newest_ns = max(module.newest_ns, message.t_ns)
                if isinstance(message, Status):
                    module.status = message
                sent_ns = self._sent.pop((entry.topic, message.re), None)
                if entry.kind == "reply" and sent_ns is not None:
                    module.round_trips.append(RoundTrip(sent_ns, entry.t_ns, message.t_ns))
            case Info():
                module.info = message
                module.newest_ns = max(module.newest_ns, message.t_ns)
            case Estimate():
                known = message.joint in self.modules or message.joint == message.serial
                if not known and len(self.estimates) >= MAX_MODULES:
                    raise WireError(Refusal.LIMIT, f"no module {message.joint} was heard of")
                estimates = self.estimates.setdefault((message.joint, message.serial), {})
                estimates[message.motion_ids] = message
                if len(estimates) > MAX_ESTIMATES:
                    del estimates[next(iter(estimates))]
            case Information():
                module.information.setdefault(message.digest, {})[message.offset] = message

    def _session_event(self) -> JournalEvent:
        sessions = [event for event in list(self.journal) if event.what == "session"]
        return sessions[-1] if sessions else JournalEvent(t_ns=0, what="session")

    @property
    def remarks(self) -> list[str]:
        """What is not as in a run that ended in order, as sentences: its end, and unreadable messages."""
        remarks = []
        times = [event.t_ns for event in list(self.journal)]
        if not any(event.what == "finished" for event in list(self.journal)):
            after = f" after {1e-9 * (max(times) - min(times)):.1f} s" if times else ""
            remarks.append(f"the recording ends{after}, before its run had finished")
        if self.refused:
            reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(self.refused.items()))
            remarks.append(f"messages were refused, and are not part of the result: {reasons}")
        return remarks

    @property
    def imu(self) -> ImuKind:
        """The prior of the IMUs, as of the latest session event."""
        return self._session_event().imu

    @property
    def torque(self) -> TorqueKind:
        """The prior of the torque sensors' scales, as of the latest session event."""
        return self._session_event().torque

    def motions(self, *purposes: Purpose) -> list[JournalEvent]:
        """Return the motions of these purposes whose rows are those of their module's latest boot.

        A module that boots numbers its rows from zero again, and may have lost its joint zero: its earlier
        motions do not describe the present robot. Nor do those before modules joined it.
        """
        boots = {serial: module.boot for serial, module in list(self.modules.items())}
        return [
            event
            for event in since_joined(list(self.journal))
            if event.what == "motion"
            and event.purpose in purposes
            and event.motion is not None
            and event.boot in (0, boots.get(event.serial, event.boot))
        ]

    def latest_motions(self, *purposes: Purpose) -> list[JournalEvent]:
        """Return the last of `motions` of every module and purpose, in the order of the journal."""
        return list({(event.serial, event.purpose): event for event in self.motions(*purposes)}.values())

    def rows(self, serial: str, first: int, end: int) -> Rows:
        """Return the rows of a range of the latest boot of a module that have arrived."""
        return self.modules[serial].rows.rows(first, end)

    def rest_rows(self, serial: str) -> Rows:
        """Return the rows of a module's last rest; none if it did not rest."""
        rests = [e.motion for e in self.motions("rest") if e.serial == serial and e.motion is not None]
        if not rests or rests[-1].end_row is None:
            return np.zeros(0, ROW)
        return self.rows(serial, rests[-1].start_row, rests[-1].end_row)

    def rest_observation(self, serials: Sequence[str], min_rows: int = 1) -> RestObservation:
        """Average every IMU and encoder over its module's last rest.

        Raises:
            DataError: a module has fewer than `min_rows` rows at rest.
        """
        rows = [self.rest_rows(serial) for serial in serials]
        for serial, resting in zip(serials, rows, strict=True):
            if len(resting) < min_rows:
                raise DataError(f"module {serial} has {len(resting)} rows at rest, {min_rows} are needed")
        accel = [resting["accel_m_s2"].astype(float) for resting in rows]
        force = np.array([one.mean(axis=0) for one in accel])
        scatter = [float(one.std(axis=0).max()) / np.sqrt(len(one)) for one in accel]
        position = np.array([float(resting["position_rad"].mean()) for resting in rows])
        return RestObservation(force, max(scatter), position)

    def module_type(self, serial: str) -> ModuleType:
        """Return a module's type, as it reported it.

        Raises:
            DataError: it has not reported its type.
            UnknownModuleType: the catalogue does not have it.
        """
        info = self.modules[serial].info
        if info is None:
            raise DataError(f"module {serial} has not reported its type")
        return module_type(info.module_type)


_WHAT_TO_DO = (
    "what was recorded is kept; plan fewer or shorter motions, or give the agents a lower --feedback-rate"
)


def _lasted(module: ModuleRecord) -> str:
    """Return how long the rows of a module last at the rate that it has told."""
    if module.info is None:
        return ""
    rate_hz = module.info.feedback_rate_hz
    return f", {module.rows.count / rate_hz / 60.0:.3g} min at {rate_hz:g} Hz"


def _decode(exchange: Exchange, leaf: Leaf, payload: bytes) -> Message:
    topic = TOPICS[leaf]
    message_type = topic.message(exchange)
    if message_type is None:
        raise WireError(Refusal.MALFORMED, f"no {exchange} is defined on {leaf.value}")
    try:
        return decode(message_type, payload, topic.max_bytes(exchange))
    except WireError as error:
        if exchange == "reply" and error.reason is Refusal.TYPES:
            return decode(Ack, payload)  # a refusal
        raise
