"""The interface of the viewer to the coordinator; every call returns at once.

Rerun is imported when a viewer with a target is made, not with this module.
"""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from coordinator.viewer.logging_thread import LoggingThread
from coordinator.viewer.scene import entity_paths
from coordinator.viewer.scene.parameter_plot import Estimate
from coordinator.viewer.scene.topology_graph import as_topology
from coordinator.viewer.targets import Opened, ViewerTargets, open_targets
from module_agent.model.chain import Chain
from module_agent.wire.feedback_rows import Rows

if TYPE_CHECKING:
    from coordinator.viewer.recorder import Recorder

FLUSH_SECONDS = 5.0
# To disconnect from both streams, each of which is flushed before.
DISCONNECT_SECONDS = 20.0

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
            waits: if the queue is full, let calls wait instead of dropping data: for virtual time.
            lays_out: send layouts and the modules' colours; without, what is logged adds to a run that has
                them from elsewhere.

        Raises:
            OSError: the file cannot be written. A live viewer that cannot be reached is only reported.
        """
        self._opened = open_targets(run_id, targets)
        self._thread: LoggingThread | None = None
        self._recorders: tuple[Recorder, ...] = ()
        self._closed = False
        if self._opened.file is None and self._opened.live is None:
            return
        from coordinator.viewer import recorder

        self._recorders = tuple(
            recorder.Recorder(stream, robot, pace, lays_out)
            for stream, pace in ((self._opened.file, recorder.FILE), (self._opened.live, recorder.LIVE))
            if stream is not None
        )
        self._thread = LoggingThread(
            on_idle=partial(self._all, lambda each: each.show_if_new()),
            on_end=partial(self._all, lambda each: each.finish()),
            waits=waits,
        )

    @property
    def dropped(self) -> int:
        """How many calls' data were dropped because the queue was full."""
        return self._thread.dropped if self._thread else 0

    @property
    def failed(self) -> int:
        """How many calls' data could not be logged; the reasons are in the log."""
        return self._thread.failed if self._thread else 0

    def modules(self, serials: Sequence[str], types: Mapping[str, str]) -> None:
        """Register modules and their types; their order is that of the views and of the colours."""
        order, type_by_serial = tuple(serials), dict(types)
        self._submit(lambda recorder: recorder.modules(order, type_by_serial))

    def rows(self, serial: str, t_ns: ArrayLike, rows: Rows) -> None:
        """Show feedback: `rows` (m,) records of `feedback_rows.ROW`, taken at `t_ns` (m,).

        Raises:
            ValueError: there is not one time per row.
        """
        times, copy = np.array(t_ns, dtype=np.int64), rows.copy()
        if times.shape != rows.shape:
            raise ValueError(f"times of shape {times.shape} for rows of shape {rows.shape} of {serial!r}")
        self._submit(lambda recorder: recorder.rows(serial, times, copy), essential=False)

    def phase(self, t_ns: int, text: str) -> None:
        """Show the step that begins, in the log and above the robot."""
        self._submit(lambda recorder: recorder.phase(t_ns, text))

    def note(self, t_ns: int, text: str) -> None:
        """Show a line on the step that is under way, in the log."""
        self._submit(lambda recorder: recorder.note(t_ns, text))

    def network(self, serial: str, t_ns: int, round_trip_ms: float, age_ms: float, refusals: int) -> None:
        """Show a module's round trip, the age of its newest sample and its refusals so far."""
        self._submit(
            lambda recorder: recorder.network(serial, t_ns, round_trip_ms, age_ms, refusals), essential=False
        )

    def topology(
        self, t_ns: int, serials: Sequence[str], parent: Sequence[int], reversed: Sequence[bool]
    ) -> None:
        """Show the tree: per module the index of its parent (-1 is the base), and whether it is reversed.

        Raises:
            ValueError: not a tree with parents before children.
        """
        tree = as_topology(serials, parent, reversed)
        self._submit(lambda recorder: recorder.topology(t_ns, tree))

    def estimate(self, name: str, serial: str, t_ns: int, value: float, sigma: float, units: str) -> None:
        """Show an estimate with its standard deviation; `sigma` is not finite if it is unknown."""
        estimate = Estimate(name, serial, float(value), float(sigma), units)
        self._submit(lambda recorder: recorder.estimate(t_ns, estimate))

    def true_value(self, name: str, serial: str, value: float, t_ns: Sequence[int] = ()) -> None:
        """Draw the true value of a parameter with its estimates; known to the simulator's tools only.

        It is drawn at `t_ns` too, for estimates that another process draws.
        """
        times = tuple(int(t) for t in t_ns)
        self._submit(lambda recorder: recorder.true_value(name, serial, float(value), times))

    def chain(
        self,
        t_ns: int,
        chain: Chain,
        sigma_m: Sequence[float] | None = None,
        covariance: ArrayLike | None = None,
    ) -> None:
        """Draw the identified robot, with (n,) standard deviations of its links [m].

        covariance: (6 n, 6 n) of the chain's perturbations, for the ellipsoids of its joints.
        """
        sigma = None if sigma_m is None else tuple(float(s) for s in sigma_m)
        spread = None if covariance is None else np.array(covariance, dtype=float)
        world = entity_paths.ESTIMATED_WORLD
        self._submit(lambda recorder: recorder.chain(t_ns, chain, sigma, world, covariance=spread))

    def true_chain(self, t_ns: int, chain: Chain, types: Mapping[str, str]) -> None:
        """Draw the true robot, of modules of these types, in grey; known to the simulator's tools only."""
        named = dict(types)
        self._submit(lambda recorder: recorder.chain(t_ns, chain, None, entity_paths.TRUE_WORLD, named))

    def poses(self, t_ns: ArrayLike, q_rad: ArrayLike, serials: Sequence[str]) -> None:
        """Turn the robot to `q_rad` (k, n) of `serials` (n) at `t_ns` (k,), all of which are shown.

        Raises:
            ValueError: there is not one time per pose, or one serial per column.
        """
        times, postures = np.array(t_ns, dtype=np.int64), np.array(q_rad, dtype=float)
        named = tuple(serials)
        if postures.shape != (*times.shape, len(named)):
            raise ValueError(
                f"times of shape {times.shape} and {len(named)} serials for poses of shape {postures.shape}"
            )
        self._submit(lambda recorder: recorder.poses(times, postures, named), essential=False)

    def residuals(
        self, serial: str, t_ns: ArrayLike, measured_nm: ArrayLike, predicted_nm: ArrayLike
    ) -> None:
        """Show held-out torque at `t_ns` (m,): measured (m,) and predicted (m,).

        Raises:
            ValueError: the three differ in length.
        """
        times = np.array(t_ns, dtype=np.int64)
        measured, predicted = (np.array(torque, dtype=float) for torque in (measured_nm, predicted_nm))
        if not (times.shape == measured.shape == predicted.shape):
            shapes = f"{times.shape}, {measured.shape} and {predicted.shape}"
            raise ValueError(f"times, measured and predicted torque of {serial!r} have shapes {shapes}")
        self._submit(lambda recorder: recorder.residuals(serial, times, measured, predicted))

    def result(self, t_ns: int, markdown: str) -> None:
        """Show the tables of the result, in Markdown."""
        self._submit(lambda recorder: recorder.result(t_ns, markdown))

    def close(self) -> None:
        """Write what is queued, complete the file and disconnect from live viewers. May be called twice.

        What hangs, as the library does on some full disks, is given up and reported.
        """
        if self._closed:
            return
        self._closed = True
        if self._thread is None:
            return
        complete = self._thread.close()
        if self.dropped:
            logger.warning("%d batches were dropped: they came faster than the viewer logs", self.dropped)
        complete = complete and _ends_within(DISCONNECT_SECONDS, self._disconnect)
        # A stream has threads until nothing refers to it and it is cleaned up.
        self._recorders, self._opened = (), Opened()
        if complete:
            from rerun_bindings import flush_and_cleanup_orphaned_recordings

            flush_and_cleanup_orphaned_recordings()
        else:
            self._give_up()

    def _give_up(self) -> None:
        """Report a library that hangs, and let it not be waited for as the process ends."""
        import rerun as rr

        logger.error(
            "the view of the run is not complete: the viewer's library does not end, as on some full disks; "
            "the recording itself, session.mcap, is another file and has what was recorded"
        )
        rr.unregister_shutdown()

    def _disconnect(self) -> None:
        for stream in (self._opened.file, self._opened.live):
            if stream is not None:
                try:
                    stream.flush(timeout_sec=FLUSH_SECONDS)
                except (RuntimeError, ValueError) as failure:
                    # The file has its own stream and is complete; only the live viewer was lost.
                    logger.warning("a live viewer did not receive everything: %s", failure)
                stream.disconnect()

    def _submit(self, log: "Callable[[Recorder], None]", *, essential: bool = True) -> None:
        """Queue a call to every recorder, each as a job of its own: one may fail without the other."""
        if self._thread is None:
            return
        if self._closed:
            raise RuntimeError("the viewer is closed; nothing can be logged any more")
        for recorder in self._recorders:
            self._thread.submit(partial(log, recorder), essential=essential)

    def _all(self, log: "Callable[[Recorder], None]") -> None:
        for recorder in self._recorders:
            log(recorder)


def _ends_within(seconds: float, work: Callable[[], None]) -> bool:
    """Run something in a thread, which is left alone if it takes longer; return whether it ended."""
    thread = threading.Thread(target=work, name="viewer's end", daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()
