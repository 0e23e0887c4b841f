"""What the viewer is shown of a session as it runs, from the messages as they are recorded."""

from typing import NamedTuple, Protocol

import numpy as np

from coordinator.chain import Array, Chain
from coordinator.clock_map import ClockMap, map_clock
from coordinator.identify import HeldOutMotion
from coordinator.kinematics.assembly import ChainFit
from coordinator.recording import Entry, Recording
from coordinator.viewer.viewer import Viewer
from module_agent.wire.feedback_rows import unpack
from module_agent.wire.messages import Feedback, Message, Status

MAP_PERIOD_NS = 1_000_000_000
POSE_PERIOD_NS = 33_000_000
NETWORK_PERIOD_NS = 500_000_000
RECENT_TRIPS = 100
# Name of the plot of what a module itself finds: its distance from the nearest joint that moves it.
LOCAL = "distance_from_joint"


class Screen(Protocol):
    """Shows a line of progress; the terminal implements it."""

    def step(self, index: int, total: int, text: str) -> None:
        """A step begins."""
        ...

    def note(self, text: str) -> None:
        """Something worth a line."""
        ...


class _Shown(NamedTuple):
    """An estimate on the screen, which stays as it is until there is a newer one."""

    name: str
    serial: str
    value_mm: float
    sigma_mm: float


class ViewerFeed:
    """Feeds one viewer from one recording; the viewer's time counts from the beginning of the session."""

    def __init__(self, viewer: Viewer, recording: Recording):
        self._viewer = viewer
        self._recording = recording
        self._maps: dict[str, tuple[int, ClockMap]] = {}
        self._chain: Chain | None = None
        self._pose_ns = 0
        self._network_ns: dict[str, int] = {}
        self._known: tuple[str, ...] = ()
        self._origin_ns: int | None = None
        self._shown: dict[tuple[str, str], _Shown] = {}

    def on_message(self, entry: Entry, message: Message) -> None:
        """Show one recorded message, if it is one that is shown."""
        if message.serial not in self._known:
            return
        if isinstance(message, Feedback) and entry.kind == "publication":
            self._on_feedback(entry, message)
        elif isinstance(message, Status):
            self._on_status(entry, message)

    def since_start(self, session_ns: int) -> int:
        """Return the time that the viewer shows for a session time."""
        if self._origin_ns is None:
            self._origin_ns = session_ns
        return session_ns - self._origin_ns

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
        now_ns = self.since_start(entry.t_ns)
        session = clock.to_session(rows["t_ns"].astype(np.int64))
        self._viewer.rows(feedback.serial, session - (entry.t_ns - now_ns), rows)
        if self._chain is not None and entry.t_ns - self._pose_ns >= POSE_PERIOD_NS:
            self._pose_ns = entry.t_ns
            self._viewer.pose(now_ns, self._positions(self._chain))

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
        round_trip_ms = (trip.received_ns - trip.sent_ns) / 1e6
        self._viewer.network(
            status.serial, self.since_start(entry.t_ns), round_trip_ms, age_ns / 1e6, refused
        )

    def met(self, types: dict[str, str]) -> None:
        """Show the modules that were found."""
        if tuple(types) != self._known:
            self._known = tuple(types)
            self._viewer.modules(self._known, types)

    def step(self, session_ns: int, text: str) -> None:
        """Show that a step begins; what is known by now is shown once more, so that it draws a line."""
        now_ns = self.since_start(session_ns)
        self._viewer.phase(now_ns, text)
        for shown in self._shown.values():
            self._show(now_ns, shown)

    def _show(self, now_ns: int, shown: _Shown) -> None:
        self._shown[shown.name, shown.serial] = shown
        self._viewer.estimate(shown.name, shown.serial, now_ns, shown.value_mm, shown.sigma_mm, "mm")

    def estimates(self, joint: str, session_ns: int) -> None:
        """Show the distances from a joint that the modules found, where no nearer joint is known yet."""
        for (moved, observer), found in self._recording.estimates.items():
            circle = list(found.values())[-1].circle if moved == joint and observer != joint else None
            if circle is None:
                continue
            known = self._shown.get((LOCAL, observer))
            if known is None or 1e3 * circle.distance_m <= known.value_mm:
                shown = _Shown(LOCAL, observer, 1e3 * circle.distance_m, 1e3 * circle.sigma_distance_m)
                self._show(self.since_start(session_ns), shown)

    def chain(self, session_ns: int, fit: ChainFit) -> None:
        """Show the identified robot; it then turns as the robot turns."""
        chain, now_ns = fit.chain, self.since_start(session_ns)
        self._viewer.topology(now_ns, chain.serials, chain.parent, chain.reversed)
        sigma = [s if np.isfinite(s) else 0.0 for s in fit.link_length_sigma_m.tolist()]
        self._viewer.chain(now_ns, chain, sigma)
        self._chain = chain
        for k, parent in enumerate(chain.parent):
            if parent >= 0:
                length, spread = 1e3 * float(fit.link_length_m[k]), 1e3 * float(fit.link_length_sigma_m[k])
                self._show(now_ns, _Shown("link_length", chain.serials[k], length, spread))

    def held_out(self, found: HeldOutMotion) -> None:
        """Show measured and predicted torques of the held-out motions."""
        origin_ns = self._origin_ns or 0
        for index, serial in enumerate(found.serials):
            self._viewer.residuals(
                serial,
                found.session_ns - origin_ns,
                found.tau_measured_nm[:, index],
                found.tau_predicted_nm[:, index],
            )
