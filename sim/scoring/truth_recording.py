"""Add the true robot to the viewer's recording of a run, after the run, as its processes do not know it.

The motion is the true one, at the times that the viewer shows. The true robot appears when all joints have
been explored, when the identified robot is complete as well.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from coordinator.identification.result import Result
from coordinator.kinematics.null_space import name_null_space
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import RESULT, SESSION, VIEW, load_recording
from coordinator.synchronisation.round_trips import map_clocks
from coordinator.viewer.targets import ViewerTargets
from coordinator.viewer.viewer import Viewer
from coordinator.viewer.viewer_process import merge_into
from module_agent.model.errors import DataError, RobotError
from module_agent.model.model_faults import first_fault
from sim.geometry.pose import Array
from sim.scoring.truth_view import TruthView
from sim.world.truth import Motion, read_motion, read_truth

PERIOD_NS = 33_000_000
ADDITION = "truth.rrd"


def add_truth(run: Path, viewer: str | None, say: Callable[[str], None]) -> None:
    """Draw the true robot in a run's recording, and in the viewer at an address if that is still reachable.

    A failure is reported by `say`; the recording then stays as it was.
    """
    try:
        result = Result.model_validate_json((run / RESULT).read_bytes())
        truth, motion = read_truth(run / "truth.json"), read_motion(run / "truth.npz")
        t_ns, q_rad = _shown(load_recording(run / SESSION), motion)
        view = TruthView(truth.chain, truth.module_types)
        targets = ViewerTargets(rrd=run / ADDITION, connect=viewer)
        drawn = Viewer(truth.robot, run.name, targets, waits=True, lays_out=False)
        view.values(drawn, (0, int(t_ns[-1])))
        chain = result.chain.chain()
        view.chain(drawn, int(t_ns[0]), chain, name_null_space(chain, np.array(result.null_basis)))
        drawn.poses(t_ns, q_rad, motion.serials)
        drawn.close()
        merge_into(run / VIEW, run / ADDITION)
    except (RobotError, OSError, ValueError, KeyError) as failure:
        say(f"the true robot is not in {run / VIEW}: {_why(failure)}")
    finally:
        (run / ADDITION).unlink(missing_ok=True)


def _why(failure: Exception) -> str:
    """Return why a file cannot be read, as a phrase."""
    if isinstance(failure, ValidationError):
        return f"{RESULT} is no result of a run: {first_fault(failure)}"
    if isinstance(failure, KeyError):
        return f"the truth has no {str(failure.args[0]).split()[0]}"
    return str(failure)


def _shown(recording: Recording, motion: Motion) -> tuple[NDArray[np.int64], Array]:
    """Return times of the viewer (k,) and true positions (k, n): 30 a second after the last exploration.

    Raises:
        DataError: the session does not say when it began, or nothing of the motion is after its exploration.
    """
    begun = [event.t_ns for event in recording.journal if event.what == "session"]
    explored = [e.t_ns for e in recording.journal if e.what == "done" and e.step.startswith("explore/")]
    if not begun or not explored:
        raise DataError("its journal has no beginning, or no exploration that was done")
    serial = next(s for s in motion.serials if recording.modules[s].round_trips)
    clock = map_clocks({serial: recording.modules[serial].round_trips})[serial]
    session_ns = clock.to_session(motion.clock_ns[:, motion.serials.index(serial)])
    after = np.flatnonzero((session_ns >= explored[-1]) & (session_ns <= recording.journal[-1].t_ns))
    if not after.size:
        raise DataError("the true motion ends before the exploration")
    step = max(1, round(PERIOD_NS / float(np.median(np.diff(session_ns)))))
    rows = after[::step]
    return session_ns[rows] - begun[-1], motion.q_rad[rows]
