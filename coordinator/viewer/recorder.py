"""What the logging thread does: keep the state of what is shown, and write it to one stream."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr

from coordinator.viewer.scene import blueprint, entity_paths, robot_geometry, robot_scene, time_series
from coordinator.viewer.scene import topology_graph as graphs
from coordinator.viewer.scene.parameter_plot import EDGE_MARGIN, NINETY_FIVE_SIGMAS, Estimate, with_estimate
from coordinator.viewer.scene.time_series import Batch, IntArray
from module_agent.model.chain import Array, Chain
from module_agent.wire.feedback_rows import Rows

LEGEND = "Band: 1σ. Thin lines and ellipsoids: 95 %. Grey: the truth, if known."
# The camera is set for a robot larger than this by as much, and moved when the robot has outgrown that.
ROOM = 1.25
# Of the postures that the camera is to show, one a second is kept, and those of the last ten minutes.
POSTURE_NS, POSTURES = 1_000_000_000, 600
STYLES = {style.world: style for style in (robot_scene.ESTIMATE_STYLE, robot_scene.TRUTH_STYLE)}


class Pace(NamedTuple):
    """How long rows and poses are gathered before they are logged, and whether the layout follows the run.

    One chunk costs some 2.6 kB in a file whatever it holds. A layout of four modules costs about 250 kB.
    """

    period_ns: int
    layout_follows: bool


LIVE = Pace(0, layout_follows=True)
# A file gets its layout when the modules are known, and at the end.
FILE = Pace(10_000_000_000, layout_follows=False)


class Recorder:
    """Writes one run to one stream; used by one thread only.

    Args:
        stream: where to.
        robot: the robot's name, shown above it.
        pace: how long data are gathered; of a killed run a file misses the last `period_ns`.
        lays_out: send layouts and the styles of the modules; without, another program has sent them.
    """

    def __init__(
        self, stream: rr.RecordingStream, robot: str, pace: Pace = LIVE, lays_out: bool = True
    ) -> None:
        self._stream = stream
        self._pace = pace
        self._lays_out = lays_out
        self._palette = entity_paths.Palette()
        self._types: dict[str, str] = {}
        self._contents = blueprint.Contents(robot)
        self._shown: blueprint.Contents | None = None
        self._states = time_series.StateChanges()
        self._scenes: dict[str, robot_scene.Scene] = {}
        self._q_rad: dict[str, float] = {}
        self._stood: deque[tuple[int, dict[str, float]]] = deque(maxlen=POSTURES)
        self._drawn: Chain | None = None
        self._turned_rad: list[float] = []
        self._estimates: dict[tuple[str, str], Estimate] = {}
        self._truths: dict[tuple[str, str], float] = {}
        self._rows: dict[str, list[Batch]] = {}
        self._poses: list[tuple[IntArray, Array]] = []
        self._posed: tuple[str, ...] = ()

    def modules(self, serials: Sequence[str], types: Mapping[str, str]) -> None:
        """Register modules with their types, names, colours and places in the layout."""
        self._types.update(types)
        self._register(serials)

    def rows(self, serial: str, t_ns: IntArray, rows: Rows) -> None:
        """Log `rows` (m,), taken at `t_ns` (m,)."""
        self._register([serial])
        if t_ns.size:
            q_rad = [*self._turned_rad, *rows["position_rad"].tolist()]
            self._turned_rad = [min(q_rad), max(q_rad)]
            gathered = self._rows.setdefault(serial, [])
            gathered.append(Batch(serial, t_ns, rows))
            if t_ns.max() - gathered[0].t_ns.min() >= self._pace.period_ns:
                self._log_rows(serial)
        # Estimates of many modules come in bursts: one layout shows them all.
        self.show_if_new()

    def _log_rows(self, serial: str) -> None:
        gathered = self._rows.pop(serial)
        batch = Batch(
            serial, np.concatenate([b.t_ns for b in gathered]), np.concatenate([b.rows for b in gathered])
        )
        time_series.send_rows(self._stream, batch)
        time_series.send_states(self._stream, serial, *self._states.changes(batch))

    def finish(self) -> None:
        """Log what was gathered, and the layout that the file opens with."""
        for serial in tuple(self._rows):
            self._log_rows(serial)
        self._log_poses()
        if not self._pace.layout_follows:
            # All is known that there is to see; a live viewer's camera is left where its user has it.
            if self._drawn is not None:
                self._contents = self._contents._replace(ball=self._ball(self._drawn))
            if self._turned_rad:
                low, high = self._turned_rad
                edge = EDGE_MARGIN * max(high - low, 0.1)
                self._contents = self._contents._replace(position_rad=(low - edge, high + edge))
        self._show()

    def phase(self, t_ns: int, text: str) -> None:
        """Log a step of the run."""
        if self._pace.layout_follows:
            self._show()
        self._set_time(t_ns)
        self._stream.log(entity_paths.PHASE_LOG, rr.TextLog(text, level=rr.TextLogLevel.INFO))
        heading = rr.TextDocument(f"**{text}**\n\n{LEGEND}", media_type="text/markdown")
        self._stream.log(entity_paths.PHASE_NOW, heading)

    def note(self, t_ns: int, text: str) -> None:
        """Log a line on the step that is under way, indented as in a terminal."""
        self._set_time(t_ns)
        self._stream.log(entity_paths.PHASE_LOG, rr.TextLog(f"  {text}", level=rr.TextLogLevel.INFO))

    def network(self, serial: str, t_ns: int, round_trip_ms: float, age_ms: float, refusals: int) -> None:
        """Log the state of a module's connection."""
        self._register([serial])
        self._set_time(t_ns)
        groups = (entity_paths.ROUND_TRIP, entity_paths.AGE, entity_paths.REFUSALS)
        for group, value in zip(groups, (round_trip_ms, age_ms, float(refusals)), strict=True):
            self._stream.log(entity_paths.network_path(serial, group), rr.Scalars(value))

    def topology(self, t_ns: int, topology: graphs.Topology) -> None:
        """Log the tree of modules."""
        self._register(topology.serials)
        self._set_time(t_ns)
        for drawn in graphs.graph(topology, self._types, self._palette):
            self._stream.log(entity_paths.TOPOLOGY, drawn)
        self._contents = self._contents._replace(topology=topology)
        self.show_if_new()

    def estimate(self, t_ns: int, estimate: Estimate) -> None:
        """Log an estimated parameter, and its true value if that is known.

        An estimate that is logged again, so that its line continues, does not change its plot.
        """
        key = (estimate.name, estimate.serial)
        truth, previous = self._truths.get(key), self._estimates.get(key)
        colour = self._palette[estimate.serial]
        if previous is None:
            ends = rr.SeriesLines(
                names=["95 %: from", "95 %: to"],
                colors=[entity_paths.shade(colour, 0.75)] * 2,
                widths=[1.0, 1.0],
                interpolation_mode="stepafter",
            )
            self._stream.log(entity_paths.interval_path(*key), ends, static=True)
        if estimate != previous:
            before = None if previous is None else previous.value
            estimated = with_estimate(self._contents.estimated, estimate, before, truth)
            self._contents = self._contents._replace(estimated=estimated)
            self._estimates[key] = estimate
        self._set_time(t_ns)
        self._log_estimate(estimate, colour)
        if truth is not None:
            self._stream.log(entity_paths.truth_path(*key), rr.Scalars(truth))

    def _log_estimate(self, estimate: Estimate, colour: entity_paths.Colour) -> None:
        """Log a value with its variance and its 95 % interval; without these if sigma is not finite.

        The viewer draws a line in a band of one sigma, and the ends of the interval as two thin lines.
        """
        known = math.isfinite(estimate.sigma)
        drawn = rr.Measurements(
            [estimate.value],
            # With None the variance of the previous estimate would remain valid.
            variances=[estimate.sigma**2] if known else [],
            units=estimate.units,
            names=estimate.serial,
            colors=[colour],
            widths=[2.0],
            # An estimate is valid until the next one.
            interpolation_mode="stepafter",
        )
        self._stream.log(entity_paths.estimate_path(estimate.name, estimate.serial), drawn)
        reach = NINETY_FIVE_SIGMAS * estimate.sigma if known else math.nan
        ends = [estimate.value - reach, estimate.value + reach]
        self._stream.log(entity_paths.interval_path(estimate.name, estimate.serial), rr.Scalars(ends))

    def true_value(self, name: str, serial: str, value: float, t_ns: Sequence[int]) -> None:
        """Set the true value of a parameter, which is logged at `t_ns` and with every estimate."""
        path = entity_paths.truth_path(name, serial)
        if (name, serial) not in self._truths:
            style = rr.SeriesLines(names="true", colors=[entity_paths.TRUTH_COLOUR], widths=[1.5])
            self._stream.log(path, style, static=True)
        self._truths[name, serial] = value
        for t in t_ns:
            self._set_time(t)
            self._stream.log(path, rr.Scalars(value))

    def chain(
        self,
        t_ns: int,
        chain: Chain,
        sigma_m: Sequence[float] | None,
        world: str,
        types: Mapping[str, str] | None = None,
        covariance: Array | None = None,
    ) -> None:
        """Draw the robot of a world from now on, in its latest posture; at q = 0 before the first pose.

        `types` are those of modules that have not been registered with theirs.
        """
        self._types = {**(types or {}), **self._types}
        self._register(chain.serials)
        self._log_poses()  # of the previous chain
        style = STYLES[world]
        scene = robot_scene.build_scene(chain, self._types, self._palette, sigma_m, style, covariance)
        self._set_time(t_ns)
        robot_scene.log_scene(self._stream, scene, self._posture(chain), self._scenes.get(world))
        self._scenes[world] = scene
        self._contents = self._contents._replace(truth=entity_paths.TRUE_WORLD in self._scenes)
        self._frame(chain)

    def poses(self, t_ns: IntArray, q_rad: Array, serials: tuple[str, ...]) -> None:
        """Turn the joints `serials` of the robots that are drawn to `q_rad` (k, n) at `t_ns` (k,)."""
        if serials != self._posed:
            self._log_poses()
            self._posed = serials
        self._poses.append((t_ns, q_rad))
        if t_ns[-1] - self._poses[0][0][0] >= self._pace.period_ns:
            self._log_poses()

    def _log_poses(self) -> None:
        if not self._poses:
            return
        t_ns, q_rad = (np.concatenate(column) for column in zip(*self._poses, strict=True))
        self._poses.clear()
        for t, q in zip(t_ns.tolist(), q_rad, strict=True):
            if not self._stood or t - self._stood[-1][0] >= POSTURE_NS:
                self._stood.append((t, dict(zip(self._posed, q.tolist(), strict=True))))
        self._q_rad.update(zip(self._posed, q_rad[-1].tolist(), strict=True))
        for scene in self._scenes.values():
            postures = np.tile(self._posture(scene.chain), (t_ns.size, 1))
            for column, serial in enumerate(scene.chain.serials):
                if serial in self._posed:
                    postures[:, column] = q_rad[:, self._posed.index(serial)]
            robot_scene.send_poses(self._stream, scene, t_ns, postures)

    def residuals(self, serial: str, t_ns: IntArray, measured_nm: Array, predicted_nm: Array) -> None:
        """Log the envelopes of held-out torque (m,), measured and predicted, and of the residual."""
        self._register([serial])
        both = np.stack([measured_nm, predicted_nm], axis=1)
        error = (measured_nm - predicted_nm)[:, None]
        for group, values in ((entity_paths.HELD_OUT, both), (entity_paths.ERROR, error)):
            thinned = time_series.envelope(t_ns, values)
            time_series.send_scalars(self._stream, entity_paths.residual_path(serial, group), *thinned)

    def result(self, t_ns: int, markdown: str) -> None:
        """Log the tables of the result."""
        self._set_time(t_ns)
        self._stream.log(entity_paths.RESULT, rr.TextDocument(markdown, media_type="text/markdown"))

    def _set_time(self, t_ns: int) -> None:
        """Set the session time of everything that is logged next."""
        self._stream.set_time(entity_paths.TIMELINE, duration=np.timedelta64(t_ns, "ns"))

    def _register(self, serials: Sequence[str]) -> None:
        new = [serial for serial in dict.fromkeys(serials) if serial not in self._contents.serials]
        if not new:
            return
        if self._lays_out:
            for serial in new:
                time_series.log_module_styles(self._stream, serial, self._palette[serial])
        self._contents = self._contents._replace(serials=(*self._contents.serials, *new))
        self._show()

    def _frame(self, chain: Chain) -> None:
        self._drawn, ball = chain, self._ball(chain)
        self._stream.log(entity_paths.GRAVITY, robot_scene.gravity_arrow(chain, ball.radius_m))
        # The camera belongs to the user, unless the robot has outgrown the view.
        known = self._contents.ball
        if known is None or not known._replace(radius_m=ROOM * known.radius_m).holds(ball):
            self._contents = self._contents._replace(ball=ball)
            self.show_if_new()

    def _ball(self, chain: Chain) -> robot_geometry.Ball:
        """Return the ball around a robot in all postures that it was seen in, and as it is now."""
        stood = [*(q_rad for _, q_rad in self._stood), self._q_rad]
        postures = np.array([[q_rad.get(serial, 0.0) for serial in chain.serials] for q_rad in stood])
        return robot_geometry.ball_around(chain, robot_geometry.modules(chain, self._types), postures)

    def _posture(self, chain: Chain) -> Array:
        return np.array([self._q_rad.get(serial, 0.0) for serial in chain.serials])

    def show_if_new(self) -> None:
        """Send the layout if its views differ from those that are shown, and this stream follows the run."""
        # A new layout puts the first tab in front again. Axis ranges alone are not worth that in the middle
        # of a step; they come with the next one.
        if self._pace.layout_follows and (
            self._shown is None or blueprint.views(self._contents) != blueprint.views(self._shown)
        ):
            self._show()

    def _show(self) -> None:
        if self._lays_out and self._contents != self._shown:
            self._shown = self._contents
            blueprint.send(self._stream, blueprint.build(self._contents))
