"""What the viewer is shown of a session as it runs, from the messages as they are recorded."""

from typing import Protocol

import numpy as np

from coordinator.chain import Array, Chain
from coordinator.clock_map import ClockMap, map_clock
from coordinator.recording import Entry, Recording
from coordinator.viewer.viewer import Viewer
from module_agent.wire.feedback_rows import unpack
from module_agent.wire.messages import Feedback, Message, Status

MAP_PERIOD_NS = 1_000_000_000
POSE_PERIOD_NS = 33_000_000
NETWORK_PERIOD_NS = 500_000_000
RECENT_TRIPS = 100


class Screen(Protocol):
    """Shows a line of progress; the terminal implements it."""

    def step(self, index: int, total: int, text: str) -> None:
        """A step begins."""
        ...

    def note(self, text: str) -> None:
        """Something worth a line."""
        ...


class ViewerFeed:
    """Feeds one viewer from one recording."""

    def __init__(self, viewer: Viewer, recording: Recording):
        self._viewer = viewer
        self._recording = recording
        self._maps: dict[str, tuple[int, ClockMap]] = {}
        self._chain: Chain | None = None
        self._pose_ns = 0
        self._network_ns: dict[str, int] = {}
        self._known: tuple[str, ...] = ()

    def on_message(self, entry: Entry, message: Message) -> None:
        """Show one recorded message, if it is one that is shown."""
        if message.serial not in self._known:
            return
        if isinstance(message, Feedback) and entry.kind == "publication":
            self._on_feedback(entry, message)
        elif isinstance(message, Status):
            self._on_status(entry, message)

    def _map(self, serial: str, now_ns: int) -> ClockMap | None:
        made_ns, found = self._maps.get(serial, (-MAP_PERIOD_NS, None))
        trips = self._recording.modules[serial].round_trips
        if trips and now_ns - made_ns >= MAP_PERIOD_NS:
            found = map_clock(trips[-RECENT_TRIPS:])
            self._maps[serial] = (now_ns, found)
        return found

    def _on_feedback(self, entry: Entry, feedback: Feedback) -> None:
        clock = self._map(feedback.serial, entry.t_ns)
        if clock is None or not feedback.count:
            return
        rows = unpack(feedback)
        self._viewer.rows(feedback.serial, clock.to_session(rows["t_ns"].astype(np.int64)), rows)
        if self._chain is not None and entry.t_ns - self._pose_ns >= POSE_PERIOD_NS:
            self._pose_ns = entry.t_ns
            self._viewer.pose(entry.t_ns, self._positions(self._chain))

    def _positions(self, chain: Chain) -> Array:
        q = np.zeros(len(chain.serials))
        for index, serial in enumerate(chain.serials):
            log = self._recording.modules[serial].rows
            rows = log.rows(log.end_row - 1, log.end_row)
            if len(rows):
                q[index] = rows["position_rad"][-1]
        return q

    def _on_status(self, entry: Entry, status: Status) -> None:
        record = self._recording.modules[status.serial]
        if not record.round_trips or entry.t_ns - self._network_ns.get(status.serial, 0) < NETWORK_PERIOD_NS:
            return
        self._network_ns[status.serial] = entry.t_ns
        trip = record.round_trips[-1]
        age_ns = entry.t_ns - record.arrivals[-1][0] if record.arrivals else 0
        refused = sum(status.refusals.values())
        self._viewer.network(
            status.serial, entry.t_ns, (trip.received_ns - trip.sent_ns) / 1e6, age_ns / 1e6, refused
        )

    def met(self, types: dict[str, str]) -> None:
        """Show the modules that were found."""
        if tuple(types) != self._known:
            self._known = tuple(types)
            self._viewer.modules(self._known, types)

    def estimates(self, joint: str, now_ns: int) -> None:
        """Show what every module made of a joint's motion."""
        for (moved, observer), found in self._recording.estimates.items():
            if moved != joint or not found:
                continue
            circle = list(found.values())[-1].circle
            if circle is not None:
                self._viewer.estimate(
                    "distance_to_joint",
                    f"{joint}-{observer}",
                    now_ns,
                    1e3 * circle.distance_m,
                    1e3 * circle.sigma_distance_m,
                    "mm",
                )

    def chain(self, now_ns: int, chain: Chain, sigma_m: list[float]) -> None:
        """Show the identified robot; it then turns as the robot turns."""
        self._viewer.topology(now_ns, chain.serials, chain.parent, chain.reversed)
        self._viewer.chain(now_ns, chain, sigma_m)
        self._chain = chain
