"""What every module of a robot does now, as a table shows it: from its messages alone, without a model.

Rates and delays (`synchronisation.feedback_delays`) are of the last ten seconds.
"""

from collections import deque
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from coordinator.recording.recording import Entry, ModuleRecord, Recording
from coordinator.synchronisation.feedback_delays import FeedbackDelay, recent_delay
from module_agent.wire.messages import Feedback, Info, Message

WINDOW_NS = 10_000_000_000
# What a session of days keeps of a module: ten seconds of rows at 1 kHz, and a minute of round trips.
KEPT_ROWS, KEPT_TRIPS = 10_000, 240
# Without a message for so long a module is silent.
SILENT_NS = 1_000_000_000


class ModuleState(NamedTuple):
    """A module at one time; None where it is not known.

    name: family and name as its user gave them, empty without. state: as the module says, or `silent`, or
    `gone` without its liveliness token. rows_per_s, delay: of the last ten seconds.
    lost_rows: since the module was heard first. refused: by reason.
    """

    serial: str
    name: str
    kind: str | None
    state: str
    holder: str | None
    position_rad: float | None = None
    velocity_rad_s: float | None = None
    effort_nm: float | None = None
    winding_temperature_c: float | None = None
    voltage_v: float | None = None
    rows_per_s: float = 0.0
    lost_rows: int = 0
    delay: FeedbackDelay | None = None
    refused: Mapping[str, int] = MappingProxyType({})


def full_name(info: Info | None) -> str:
    """Return `family/name` as HEBI's programs write it, or what there is of it."""
    return "" if info is None else "/".join(part for part in (info.family, info.name) if part)


class _Delivery(NamedTuple):
    """A feedback message: first row, number of rows, session time of arrival."""

    first_row: int
    rows: int
    arrival_ns: int


class _Deliveries:
    """The feedback of one boot of a module: of the last ten seconds, and how many rows since the first."""

    def __init__(self, boot: int, first_row: int):
        self.boot = boot
        self.latest: deque[_Delivery] = deque()
        self._first_row = self._end_row = first_row
        self._rows = 0
        self._recent: set[int] = set()

    @property
    def lost(self) -> int:
        """Rows between the first and the newest that have not come."""
        return max(0, self._end_row - self._first_row - self._rows)

    def add(self, new: _Delivery) -> None:
        """Note a message; one that came before does not count again."""
        if new.first_row in self._recent:
            return
        self._rows += new.rows
        self._first_row = min(self._first_row, new.first_row)
        self._end_row = max(self._end_row, new.first_row + new.rows)
        self.latest.append(new)
        self._recent.add(new.first_row)
        self.drop_before(new.arrival_ns - WINDOW_NS)

    def drop_before(self, arrival_ns: int) -> None:
        """Forget what arrived before a time."""
        while self.latest and self.latest[0].arrival_ns < arrival_ns:
            self._recent.discard(self.latest.popleft().first_row)


class ModuleStates:
    """Follows all modules that are heard; times are session time [ns]."""

    def __init__(self) -> None:
        self.recording = Recording()
        self._deliveries: dict[str, _Deliveries] = {}

    def record(self, entry: Entry) -> Message | None:
        """Take a message in; None if it cannot be read."""
        message = self.recording.accept(entry)
        if isinstance(message, Feedback) and entry.kind == "publication" and message.count:
            module = self.recording.module(message.serial, message.boot)
            known = self._deliveries.get(message.serial)
            if known is None or known.boot != message.boot:
                known = self._deliveries[message.serial] = _Deliveries(message.boot, message.first_row)
            known.add(_Delivery(message.first_row, message.count, entry.t_ns))
            if module.rows.end_row - module.rows.first_row > 2 * KEPT_ROWS:
                module.forget(KEPT_ROWS, KEPT_TRIPS)
        return message

    def at(self, now_ns: int, alive: Collection[str]) -> list[ModuleState]:
        """Return all modules by serial; `alive` are those whose liveliness token is on the network."""
        return [
            self._state(serial, now_ns, serial in alive)
            for serial in sorted({*self.recording.modules, *alive})
        ]

    def _state(self, serial: str, now_ns: int, present: bool) -> ModuleState:
        module = self.recording.modules.get(serial)
        if module is None:
            return ModuleState(serial, "", None, "silent", None)
        status, info, known = module.status, module.info, self._deliveries.get(serial)
        silent = module.feedback_ns is None or now_ns - module.feedback_ns > SILENT_NS
        own = status.state if status is not None else "unknown"
        state = ModuleState(
            serial,
            full_name(info),
            info.module_type if info is not None else None,
            "gone" if not present else "silent" if silent else own,
            status.holder if status is not None else None,
            refused=dict(status.refusals) if status is not None else {},
        )
        latest = module.rows.rows(module.rows.end_row - 1, module.rows.end_row)
        if len(latest):
            shown: dict[str, Any] = {name: float(latest[name][0]) for name in _SHOWN}
            state = state._replace(**shown)
        if known is not None and known.boot == module.boot:
            state = state._replace(lost_rows=known.lost, **_figures(module, known, now_ns))
        return state


_SHOWN = ("position_rad", "velocity_rad_s", "effort_nm", "winding_temperature_c", "voltage_v")


def _figures(module: ModuleRecord, known: _Deliveries, now_ns: int) -> dict[str, Any]:
    """Return the rate of rows, and their delay as far as the clock is known."""
    known.drop_before(now_ns - WINDOW_NS)
    if not known.latest:
        return {}
    # From the arrival of the first message, whose rows are of the time before it.
    first, *later = known.latest
    span_ns = now_ns - first.arrival_ns
    figures: dict[str, Any] = {}
    if span_ns > 0:
        figures["rows_per_s"] = 1e9 * sum(one.rows for one in later) / span_ns
    return figures | {"delay": recent_delay(module, now_ns - WINDOW_NS)}
