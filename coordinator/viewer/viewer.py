"""The front of the viewer: what the coordinator calls; every call returns at once."""

import logging
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike

from coordinator.viewer import viewer_process
from coordinator.viewer.logging_thread import Job, LoggingThread
from coordinator.viewer.recorder import Recorder
from coordinator.viewer.scene import blueprint, entity_paths, robot_scene
from coordinator.viewer.scene.parameter_plot import Estimate
from coordinator.viewer.scene.time_series import Batch, IntArray
from coordinator.viewer.scene.topology_graph import as_topology
from coordinator.viewer.targets import ViewerTargets, open_targets
from module_agent.model.chain import Chain
from module_agent.wire.feedback_rows import Rows

POSE_PERIOD_NS = 33_333_333
FLUSH_SECONDS = 5.0

logger = logging.getLogger(__name__)


class Viewer:
    """Shows a run live and writes it to a file, in a thread of its own.

    Data that comes faster than it can be logged is dropped and counted in `dropped`; what cannot be logged is
    reported once per kind and counted in `failed`. Times are integer nanoseconds of the common session time.
    The methods are to be called from one thread.
    """

    def __init__(
        self, robot: str, run_id: str, targets: ViewerTargets, waits: bool = False, lays_out: bool = True
    ) -> None:
        """Open the targets; the only part that may take seconds, where a viewer has to be started.

        Args:
            robot: the robot's name, shown above it.
            run_id: the recording's identity; the same one in two processes makes one recording.
            targets: where to; with none at all, nothing is recorded and all calls do nothing.
            waits: let calls wait when there is too much, instead of dropping it: for virtual time.
            lays_out: send layouts; without, what is logged adds to a run that has its layout from elsewhere.

        Raises:
            OSError: the file cannot be written. A live viewer that is not there is only reported.
        """
        self._stream = rr.RecordingStream(entity_paths.APPLICATION_ID, recording_id=run_id)
        first = blueprint.build(blueprint.Contents(robot)) if lays_out else None
        self._opened = open_targets(self._stream, targets, first)
        self._recorder = Recorder(self._stream, robot, lays_out)
        self._thread = (
            LoggingThread(on_idle=self._recorder.show_if_new, on_end=self._recorder.finish, waits=waits)
            if self._opened.records
            else None
        )
        self._next_pose_ns: int | None = None
        self._closed = False

    @property
    def dropped(self) -> int:
        """How many calls' data were dropped because the queue was full."""
        return self._thread.dropped if self._thread else 0

    @property
    def failed(self) -> int:
        """How many calls' data could not be logged; the reasons are in the log."""
        return self._thread.failed if self._thread else 0

    def modules(self, serials: Sequence[str], types: Mapping[str, str]) -> None:
        """Name the modules and their types; their order is that of the views and of the colours."""
        self._submit(partial(self._recorder.modules, tuple(serials), dict(types)), essential=True)

    def rows(self, serial: str, t_ns: IntArray, rows: Rows) -> None:
        """Show feedback: `rows` (m,) records of `feedback_rows.ROW`, taken at `t_ns` (m,).

        Raises:
            ValueError: there is not one time per row.
        """
        times = np.array(t_ns, dtype=np.int64)
        if times.shape != rows.shape:
            raise ValueError(f"times of shape {times.shape} for rows of shape {rows.shape} of {serial!r}")
        self._submit(partial(self._recorder.rows, Batch(serial, times, rows.copy())))

    def phase(self, t_ns: int, text: str) -> None:
        """Show the step that begins, in the log and above the robot."""
        self._submit(partial(self._recorder.phase, t_ns, text), essential=True)

    def network(self, serial: str, t_ns: int, round_trip_ms: float, age_ms: float, refusals: int) -> None:
        """Show a module's round trip, the age of its newest sample and its refusals so far."""
        self._submit(partial(self._recorder.network, serial, t_ns, round_trip_ms, age_ms, refusals))

    def topology(
        self, t_ns: int, serials: Sequence[str], parent: Sequence[int], reversed: Sequence[bool]
    ) -> None:
        """Show the tree: per module the index of its parent (-1 is the base), and whether it is reversed.

        Raises:
            ValueError: not a tree with parents before children.
        """
        found = as_topology(serials, parent, reversed)
        self._submit(partial(self._recorder.topology, t_ns, found), essential=True)

    def estimate(self, name: str, serial: str, t_ns: int, value: float, sigma: float, units: str) -> None:
        """Show an estimate with its standard deviation; `sigma` not finite means that it is not known."""
        found = Estimate(name, serial, float(value), float(sigma), units)
        self._submit(partial(self._recorder.estimate, t_ns, found), essential=True)

    def true_value(self, name: str, serial: str, value: float, t_ns: Sequence[int] = ()) -> None:
        """Draw the true value of a parameter with its estimates; only the simulator's tools know it.

        It is drawn at `t_ns` too, for estimates that somebody else draws.
        """
        times = tuple(int(t) for t in t_ns)
        self._submit(partial(self._recorder.true_value, name, serial, float(value), times), essential=True)

    def chain(self, t_ns: int, chain: Chain, sigma_m: Sequence[float] | None = None) -> None:
        """Draw the robot as identified, with (n,) standard deviations of its joints' places [m]."""
        self._chain(t_ns, chain, sigma_m, robot_scene.ESTIMATE_STYLE)

    def true_chain(self, t_ns: int, chain: Chain, types: Mapping[str, str] | None = None) -> None:
        """Draw the robot as it is, in grey; only the simulator's tools know it.

        `types` are the module types of those that were not named by `modules`.
        """
        if types is not None:
            self._submit(partial(self._recorder.name_types, dict(types)), essential=True)
        self._chain(t_ns, chain, None, robot_scene.TRUTH_STYLE)

    def pose(self, t_ns: int, q_rad: ArrayLike) -> None:
        """Turn the robot to `q_rad` (n,), in the order of the chain; at most 30 times a second are shown."""
        if self._next_pose_ns is not None and 0 < self._next_pose_ns - t_ns <= POSE_PERIOD_NS:
            return
        self._next_pose_ns = t_ns + POSE_PERIOD_NS
        self.poses([t_ns], np.array(q_rad, dtype=float)[None])

    def poses(self, t_ns: ArrayLike, q_rad: ArrayLike, serials: Sequence[str] | None = None) -> None:
        """Turn the robot to `q_rad` (k, n) at `t_ns` (k,), all of which are shown.

        The columns are those of `serials`, or of the identified chain if left out.

        Raises:
            ValueError: there is not one time per pose, or one serial per column.
        """
        times, postures = np.array(t_ns, dtype=np.int64), np.array(q_rad, dtype=float)
        if times.shape != postures.shape[:1]:
            raise ValueError(f"times of shape {times.shape} for poses of shape {postures.shape}")
        if serials is not None and postures.shape[1:] != (len(serials),):
            raise ValueError(f"poses of shape {postures.shape} for {len(serials)} serials")
        named = None if serials is None else tuple(serials)
        self._submit(partial(self._recorder.poses, times, postures, named))

    def residuals(self, serial: str, t_ns: IntArray, measured_nm: ArrayLike, predicted_nm: ArrayLike) -> None:
        """Show held-out torque at `t_ns` (m,): measured (m,) and predicted (m,).

        Raises:
            ValueError: the three differ in length.
        """
        times = np.array(t_ns, dtype=np.int64)
        measured, predicted = (np.array(torque, dtype=float) for torque in (measured_nm, predicted_nm))
        if not (times.shape == measured.shape == predicted.shape):
            shapes = f"{times.shape}, {measured.shape} and {predicted.shape}"
            raise ValueError(f"times, measured and predicted torque of {serial!r} have shapes {shapes}")
        self._submit(partial(self._recorder.residuals, serial, times, measured, predicted), essential=True)

    def close(self) -> None:
        """Write what is queued, complete the file and let go of live viewers. May be called twice."""
        if self._thread is None or self._closed:
            return
        self._closed = True
        self._thread.close()
        if self.dropped:
            logger.warning("%d batches were dropped: they came faster than the viewer logs", self.dropped)
        self._disconnect()

    def _disconnect(self) -> None:
        try:
            self._stream.flush(timeout_sec=FLUSH_SECONDS)
        except (RuntimeError, ValueError) as failure:
            # The file has its own sink and is complete; only the live viewer is gone.
            logger.warning("a live viewer did not get everything: %s", failure)
        self._stream.disconnect()
        if self._opened.web_server is not None:
            viewer_process.stop(self._opened.web_server)

    def _chain(
        self, t_ns: int, chain: Chain, sigma_m: Sequence[float] | None, look: robot_scene.SceneStyle
    ) -> None:
        sigma = None if sigma_m is None else tuple(float(s) for s in sigma_m)
        self._submit(partial(self._recorder.chain, t_ns, chain, sigma, look), essential=True)

    def _submit(self, job: Job, *, essential: bool = False) -> None:
        if self._thread is not None:
            self._thread.submit(job, essential=essential)
