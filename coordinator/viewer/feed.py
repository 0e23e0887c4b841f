"""What a run shows in its viewer: the messages as they are recorded, and the results of its steps."""

from typing import Protocol

import numpy as np

from coordinator.identification.identified import HeldOutMotion
from coordinator.identification.preview import Preview
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.frames import axis_angles
from coordinator.kinematics.null_space import Unresolved
from coordinator.recording.recording import Entry, ModuleRecord, Recording
from coordinator.synchronisation.round_trips import map_clock
from coordinator.viewer.scene.parameter_plot import AXIS_ANGLE, LINK_LENGTH, Estimate
from coordinator.viewer.scene.robot_geometry import side_by_side
from coordinator.viewer.viewer import Viewer
from module_agent.model.chain import BASE, Array, Chain
from module_agent.signals.clock_map import ClockMap
from module_agent.wire.messages import Feedback, Message, Status


class Overlay(Protocol):
    """Draws something in addition to the run, such as the true robot of a simulation."""

    def connected(self, viewer: Viewer, t_ns: int) -> None:
        """Draw when all modules are connected, at `t_ns` of the viewer."""
        ...

    def chain(self, viewer: Viewer, t_ns: int, chain: Chain, unresolved: tuple[Unresolved, ...]) -> None:
        """Draw before a chain is shown, of some or all modules; `unresolved` is not identified."""
        ...


ROWS_PERIOD_NS = 100_000_000
MAP_PERIOD_NS = 1_000_000_000
POSE_PERIOD_NS = 33_000_000
NETWORK_PERIOD_NS = 500_000_000
# The lines of estimates are prolonged while there are no newer estimates.
ESTIMATES_PERIOD_NS = 2_000_000_000
RECENT_TRIPS = 100
# Name of the plot of a module's own estimate: its distance from the nearest joint that moves it.
OWN_DISTANCE = "own_distance"


class Screen(Protocol):
    """Shows the progress of a run; the terminal implements it."""

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        """Show that a step begins, and how long all that is left takes, as far as the plan tells."""
        ...

    def note(self, text: str) -> None:
        """Show a line of text."""
        ...


class ViewerFeed:
    """Feeds one viewer from one recording; the viewer's time is zero at the beginning of the session.

    Rows are gathered for `ROWS_PERIOD_NS`; `close` shows the last ones. `overlay` draws in addition.
    """

    def __init__(self, viewer: Viewer, recording: Recording, overlay: Overlay | None = None):
        self._viewer = viewer
        self._recording = recording
        self._overlay = overlay
        self._maps: dict[tuple[str, int], tuple[int, ClockMap]] = {}
        self._pending: dict[tuple[str, int], list[tuple[int, int]]] = {}
        self._rows_ns = 0
        self._drawn = False
        self._pose_ns = 0
        self._network_ns: dict[str, int] = {}
        self._known: tuple[str, ...] = ()
        self._origin_ns = 0
        self._begun = False
        # The newest estimates, each valid until there is a newer one.
        self._shown: dict[tuple[str, str], Estimate] = {}
        self._shown_ns = 0

    def on_message(self, entry: Entry, message: Message) -> None:
        """Show one recorded message, if it is feedback or a status."""
        if message.serial not in self._known:
            return
        if isinstance(message, Feedback) and entry.kind == "publication":
            self._gather(message)
            self._pose(entry.t_ns)
        elif isinstance(message, Status):
            self._on_status(entry, message)
        if entry.t_ns - self._rows_ns >= ROWS_PERIOD_NS:
            self._show_rows(entry.t_ns)
        if entry.t_ns - self._shown_ns >= ESTIMATES_PERIOD_NS:
            self._show_again(entry.t_ns)

    def begin(self, session_ns: int) -> None:
        """Set the beginning of the session, from which the viewer's time counts."""
        self._origin_ns, self._begun = session_ns, True

    def _gather(self, feedback: Feedback) -> None:
        """Note which rows were received; the rows themselves are in the recording."""
        spans = self._pending.setdefault((feedback.serial, feedback.boot), [])
        first, end = feedback.first_row, feedback.first_row + feedback.count
        if spans and spans[-1][1] == first:
            spans[-1] = (spans[-1][0], end)
        else:
            spans.append((first, end))

    def _show_rows(self, now_ns: int) -> None:
        """Show the rows received since the last time, of modules whose clock map is known."""
        self._rows_ns = now_ns
        for (serial, boot), spans in self._pending.items():
            record = self._recording.module(serial, boot)
            clock = self._map(record, now_ns)
            if clock is not None:
                rows = np.concatenate([record.rows.rows(first, end) for first, end in spans])
                session_ns = clock.to_session(rows["t_ns"].astype(np.int64))
                self._viewer.rows(serial, session_ns - self._origin_ns, rows)
        self._pending.clear()

    def _map(self, record: ModuleRecord, now_ns: int) -> ClockMap | None:
        key = record.serial, record.boot
        fitted_ns, clock = self._maps.get(key, (-MAP_PERIOD_NS, None))
        if record.round_trips and now_ns - fitted_ns >= MAP_PERIOD_NS:
            clock = map_clock(record.round_trips[-RECENT_TRIPS:])
            self._maps[key] = (now_ns, clock)
        return clock

    def _pose(self, now_ns: int) -> None:
        if not self._drawn or now_ns - self._pose_ns < POSE_PERIOD_NS:
            return
        self._pose_ns = now_ns
        self._viewer.poses([now_ns - self._origin_ns], [self._positions()], self._known)

    def close(self) -> None:
        """Show the rows that are left, and close the viewer. May be called twice."""
        self._show_rows(self._rows_ns)
        self._viewer.close()

    def _positions(self) -> Array:
        q = np.zeros(len(self._known))
        for index, serial in enumerate(self._known):
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
        age_ns = 0 if record.feedback_ns is None else entry.t_ns - record.feedback_ns
        refused = sum(status.refusals.values())
        round_trip_ms = (trip.received_ns - trip.sent_ns) / 1e6
        self._viewer.network(
            status.serial, entry.t_ns - self._origin_ns, round_trip_ms, age_ns / 1e6, refused
        )

    def connected(self, types: dict[str, str], session_ns: int) -> None:
        """Show the connected modules; `types` are their module types by serial."""
        if tuple(types) != self._known:
            self._known = tuple(types)
            self._viewer.modules(self._known, types)
            if self._overlay is not None:
                self._overlay.connected(self._viewer, session_ns - self._origin_ns)
                self._drawn = True

    def step(self, session_ns: int, text: str) -> None:
        """Show that a step begins, and the present estimates again, so that their lines reach this step."""
        self._viewer.phase(session_ns - self._origin_ns, text)
        self._show_again(session_ns)

    def note(self, session_ns: int, text: str) -> None:
        """Show a line on the step that is under way; before the session begins there is no time for it."""
        if self._begun:
            self._viewer.note(session_ns - self._origin_ns, text)

    def _show_again(self, session_ns: int) -> None:
        self._shown_ns = session_ns
        for shown in self._shown.values():
            self._show(session_ns - self._origin_ns, shown)

    def _show(self, now_ns: int, shown: Estimate) -> None:
        self._shown[shown.name, shown.serial] = shown
        self._viewer.estimate(shown.name, shown.serial, now_ns, shown.value, shown.sigma, shown.units)

    def estimates(self, joint: str, session_ns: int) -> None:
        """Show the modules' own estimates of their distance from a joint, unless another one is nearer."""
        for (moved, observer), messages in self._recording.estimates.items():
            fit = list(messages.values())[-1].best if moved == joint and observer != joint else None
            if fit is None:
                continue
            known = self._shown.get((OWN_DISTANCE, observer))
            if known is None or 1e3 * fit.distance_m <= known.value:
                distance_mm, sigma_mm = 1e3 * fit.distance_m, 1e3 * fit.sigma_distance_m
                shown = Estimate(OWN_DISTANCE, observer, distance_mm, sigma_mm, "mm")
                self._show(session_ns - self._origin_ns, shown)

    def preview(self, session_ns: int, preview: Preview) -> None:
        """Show the robot as far as it is known, and the links that are final: between adjacent modules."""
        self._draw(session_ns, preview.fit)
        self._show_links(session_ns, preview.fit, preview.adjacent)

    def chain(self, session_ns: int, fit: ChainEstimate) -> None:
        """Show the identified robot; from then on it turns with the robot."""
        self._draw(session_ns, fit)
        self._show_links(session_ns, fit, tuple(parent != BASE for parent in fit.chain.parent))

    def _draw(self, session_ns: int, fit: ChainEstimate) -> None:
        chain, now_ns = side_by_side(fit.chain), session_ns - self._origin_ns
        if self._overlay is not None:
            self._overlay.chain(self._viewer, now_ns, chain, fit.unresolved)
        self._viewer.topology(now_ns, chain.serials, chain.parent, chain.reversed)
        sigma = [0.0 if np.isnan(s) else s for s in fit.link_length_sigma_m.tolist()]
        self._viewer.chain(now_ns, chain, sigma, fit.covariance)
        self._drawn = True

    def _show_links(self, session_ns: int, fit: ChainEstimate, shown: tuple[bool, ...]) -> None:
        now_ns = session_ns - self._origin_ns
        angle, spread = (np.degrees(value) for value in axis_angles(fit.chain, fit.covariance))
        for k, serial in enumerate(fit.chain.serials):
            if shown[k]:
                length, sigma = 1e3 * float(fit.link_length_m[k]), 1e3 * float(fit.link_length_sigma_m[k])
                self._show(now_ns, Estimate(LINK_LENGTH, serial, length, sigma, "mm"))
                self._show(now_ns, Estimate(AXIS_ANGLE, serial, float(angle[k]), float(spread[k]), "deg"))

    def held_out(self, motion: HeldOutMotion) -> None:
        """Show measured and predicted torques of the held-out motions."""
        t_ns = motion.session_ns - self._origin_ns
        for index, serial in enumerate(motion.serials):
            measured, predicted = motion.tau_measured_nm[:, index], motion.tau_predicted_nm[:, index]
            self._viewer.residuals(serial, t_ns, measured, predicted)

    def result(self, session_ns: int, markdown: str) -> None:
        """Show the tables of the result, in Markdown."""
        self._viewer.result(session_ns - self._origin_ns, markdown)
