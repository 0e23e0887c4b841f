"""Logging as it is done in the logging thread: keeps what is known of the run and writes it to the stream."""

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from coordinator.viewer.scene import (
    blueprint,
    entity_paths,
    progress,
    robot_geometry,
    robot_scene,
    time_series,
)
from coordinator.viewer.scene import topology_graph as graphs
from coordinator.viewer.scene.parameter_plot import Estimate, with_estimate
from coordinator.viewer.scene.time_series import Batch, IntArray
from module_agent.model.chain import Array, Chain

# Times the reach that the eye was set for.
OUTGROWN = 1.25


class Recorder:
    """Everything that one run has logged so far; used by one thread only."""

    def __init__(self, stream: rr.RecordingStream, robot: str, lays_out: bool = True) -> None:
        self._stream = stream
        self._lays_out = lays_out
        self._palette = entity_paths.Palette()
        self._types: dict[str, str] = {}
        self._contents = blueprint.Contents(robot)
        self._shown: blueprint.Contents | None = None
        self._states = time_series.StateChanges()
        self._scenes: dict[str, robot_scene.Scene] = {}
        self._q_rad: dict[str, float] = {}
        self._estimates: dict[tuple[str, str], Estimate] = {}
        self._truths: dict[tuple[str, str], float] = {}

    def modules(self, serials: Sequence[str], types: Mapping[str, str]) -> None:
        """Make modules known: their types, names, colours and places in the layout."""
        self._types.update(types)
        self._know(serials)

    def name_types(self, types: Mapping[str, str]) -> None:
        """Make types known of modules that nobody may have heard of; what is known of others stays."""
        self._types = {**types, **self._types}

    def rows(self, batch: Batch) -> None:
        """Log rows."""
        self._know([batch.serial])
        if batch.t_ns.size:
            time_series.send_rows(self._stream, batch)
            time_series.send_states(self._stream, batch.serial, *self._states.of(batch))
        # Estimates of many modules come in bursts: one layout shows them all.
        self.show_if_new()

    def finish(self) -> None:
        """Log the layout that the file opens with."""
        self._show()

    def phase(self, t_ns: int, text: str) -> None:
        """Log a step of the run."""
        self._show()
        progress.set_time(self._stream, t_ns)
        progress.log_phase(self._stream, text)

    def network(self, serial: str, t_ns: int, round_trip_ms: float, age_ms: float, refusals: int) -> None:
        """Log a module's connection."""
        self._know([serial])
        progress.set_time(self._stream, t_ns)
        progress.log_network(self._stream, serial, round_trip_ms, age_ms, refusals)

    def topology(self, t_ns: int, topology: graphs.Topology) -> None:
        """Log the tree of modules."""
        self._know(topology.serials)
        progress.set_time(self._stream, t_ns)
        for drawn in graphs.graph(topology, self._types, self._colours(topology.serials)):
            self._stream.log(entity_paths.TOPOLOGY, drawn)
        self._contents = self._contents._replace(topology=topology)
        self._show()

    def estimate(self, t_ns: int, estimate: Estimate) -> None:
        """Log an estimated parameter, and the true value beside it where that is known.

        One that is shown once more, so that its line goes on, does not change its plot.
        """
        which = (estimate.name, estimate.serial)
        truth, previous = self._truths.get(which), self._estimates.get(which)
        colour = self._palette.colour(estimate.serial)
        if previous is None:
            progress.log_interval_style(self._stream, *which, colour)
        if estimate != previous:
            before = None if previous is None else previous.value
            estimated = with_estimate(self._contents.estimated, estimate, before, truth)
            self._contents = self._contents._replace(estimated=estimated)
            self._estimates[which] = estimate
        progress.set_time(self._stream, t_ns)
        progress.log_estimate(self._stream, estimate, colour)
        if truth is not None:
            progress.log_truth(self._stream, *which, truth)

    def true_value(self, name: str, serial: str, value: float, t_ns: Sequence[int]) -> None:
        """Make the true value of a parameter known, to be drawn with its estimates."""
        if (name, serial) not in self._truths:
            progress.log_truth_style(self._stream, name, serial)
        self._truths[name, serial] = value
        for t in t_ns:
            progress.set_time(self._stream, t)
            progress.log_truth(self._stream, name, serial, value)

    def chain(
        self, t_ns: int, chain: Chain, sigma_m: Sequence[float] | None, look: robot_scene.SceneStyle
    ) -> None:
        """Draw the robot from now on, in the posture it was last seen in; at q = 0 before the first pose."""
        self._know(chain.serials)
        scene = robot_scene.build_scene(chain, self._types, self._colours(chain.serials), sigma_m, look)
        progress.set_time(self._stream, t_ns)
        before = self._scenes.get(look.world)
        if before is not None:
            robot_scene.clear_gone(self._stream, before, scene)
        robot_scene.log_scene(self._stream, scene, self._posture(chain))
        self._scenes[look.world] = scene
        self._contents = self._contents._replace(truth=entity_paths.TRUE_WORLD in self._scenes)
        self._frame(chain)

    def poses(self, t_ns: IntArray, q_rad: Array, serials: Sequence[str] | None) -> None:
        """Turn the robots that are drawn at `t_ns` (k,); `q_rad` (k, n) of `serials`.

        Without `serials` it is in the identified chain's order. Joints that are not named stay as they are.
        """
        first = self._scenes.get(entity_paths.ESTIMATED_WORLD, self._scenes.get(entity_paths.TRUE_WORLD))
        if first is None and serials is None:
            return  # before there is a robot there is nothing to turn
        named = tuple(serials or ()) if first is None or serials is not None else first.chain.serials
        if q_rad.shape != (t_ns.size, len(named)):
            raise ValueError(f"{t_ns.size} poses of shape {q_rad.shape} for a robot of {len(named)} joints")
        self._q_rad.update(zip(named, q_rad[-1].tolist(), strict=True))
        for scene in self._scenes.values():
            postures = np.tile(self._posture(scene.chain), (t_ns.size, 1))
            for column, serial in enumerate(scene.chain.serials):
                if serial in named:
                    postures[:, column] = q_rad[:, named.index(serial)]
            robot_scene.send_poses(self._stream, scene, t_ns, postures)

    def residuals(self, serial: str, t_ns: IntArray, measured_nm: Array, predicted_nm: Array) -> None:
        """Log held-out torque."""
        self._know([serial])
        progress.send_residuals(self._stream, serial, t_ns, measured_nm, predicted_nm)

    def _know(self, serials: Sequence[str]) -> None:
        new = [serial for serial in dict.fromkeys(serials) if serial not in self._contents.serials]
        if not new:
            return
        for serial in new:
            time_series.log_module_styles(self._stream, serial, serial, self._palette.colour(serial))
        self._contents = self._contents._replace(serials=(*self._contents.serials, *new))
        self._show()

    def _frame(self, chain: Chain) -> None:
        placed = robot_geometry.modules(chain, self._types)
        reach = robot_geometry.reach_m(chain, placed)
        self._stream.log(entity_paths.GRAVITY, robot_scene.gravity_arrow(chain, reach))
        # The eye stays in the hands of whoever looks, unless the robot has outgrown what is seen.
        if self._contents.reach_m is None or reach > OUTGROWN * self._contents.reach_m:
            self._contents = self._contents._replace(reach_m=reach)
            self._show()

    def _posture(self, chain: Chain) -> Array:
        return np.array([self._q_rad.get(serial, 0.0) for serial in chain.serials])

    def _colours(self, serials: Sequence[str]) -> dict[str, entity_paths.Colour]:
        return {serial: self._palette.colour(serial) for serial in serials}

    def show_if_new(self) -> None:
        """Log the layout if it has other views than the one that stands."""
        # A new layout puts the first tab in front again. Ranges of plots alone are not worth that in the
        # middle of a step; they come with the next one.
        if self._shown is None or blueprint.views(self._contents) != blueprint.views(self._shown):
            self._show()

    def _show(self) -> None:
        if self._lays_out and self._contents != self._shown:
            self._shown = self._contents
            self._stream.send_blueprint(blueprint.build(self._contents))
