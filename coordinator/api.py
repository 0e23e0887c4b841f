"""The library: runs, recordings and robots in a few lines of Python.

A run that was recorded is read back with `load_run`; a recording is evaluated again with `identify`; what was
identified predicts poses with covariance (`forward_kinematics`), torques (`inverse_dynamics`) and what IMUs
measure (`imu_readings`), and leaves as URDF, HRDF or Denavit-Hartenberg rows. Arrays are plain numpy in SI
units. `from coordinator import ...` imports a name when it is used.

A pose with covariance: the chain's 6 n unknowns are one twist per module, [rotation, translation] in the root
frame (`apply_perturbation`). To first order the twist of a module's pose is J delta, with J by central
differences, and its covariance is J C J^T.
"""

import asyncio
import time
import warnings
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from coordinator.description.denavit_hartenberg import DhPath, dh_paths
from coordinator.description.hrdf_writer import write_hrdf
from coordinator.description.urdf_writer import write_urdf
from coordinator.export.exported_run import ExportedRun, exported
from coordinator.export.frames import instants_frame, samples_frame
from coordinator.identification.identified import Identified
from coordinator.identification.result import Result
from coordinator.live_robot.connection import Place, exposures, new_sender, open_connection
from coordinator.live_robot.discovery import await_modules
from coordinator.live_robot.messenger import COALESCED_S, Messenger, Record
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.merge.run_arrays import read_held_out_arrays
from coordinator.recording.recording import Entry, Recording
from coordinator.recording.run_folder import HELD_OUT, SESSION
from coordinator.recording.run_folder import load_recording as read_recording
from coordinator.recording.versions import current_run
from coordinator.synchronisation.signals import Signals
from coordinator.torque_control.gravity_model import gravity_model_of_result, read_result
from module_agent.model.catalogue import module_type
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import LostError
from module_agent.model.forward_kinematics import imu_poses
from module_agent.model.perturbation import apply_perturbation
from module_agent.transport.credentials import COORDINATOR, OBSERVER, load_credentials
from module_agent.transport.endpoint import DEFAULT_ENDPOINT
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import Feedback, GoTo, Message

if TYPE_CHECKING:
    from pandas import DataFrame

_STEP = 1e-6
_NS = 1e-9
# Ten minutes of feedback at 250 Hz, and how many rows there are to a lease renewal.
# Dropping is done when there is a tenth more, not with every message.
_RETAINED_ROWS, _ROWS_A_TRIP = 150_000, 15
# Feedback is published whether a module is held or not; a network may lose some.
_FEEDBACK_S = 3.0


class HeldOutTorques(NamedTuple):
    """Torques of the motions that nothing was fitted to: t_s (m,) since the recording began, else (m, n)."""

    serials: tuple[str, ...]
    t_s: Array
    position_rad: Array
    measured_nm: Array
    predicted_nm: Array


class SavedRun:
    """A run on disk: `result` as identified, `recording` as received, `signals` per module."""

    def __init__(self, folder: Path, result: Result):
        self.folder = folder
        self.result = result
        self.chain: Chain = result.chain.chain()
        self.covariance: Array = np.asarray(result.chain_covariance, dtype=float)

    def __repr__(self) -> str:
        """Name folder, robot and modules, and say if the result is suspect."""
        suspect = ", suspect" if self.suspicions else ""
        return (
            f"SavedRun({str(self.folder)!r}: {self.result.robot}, modules {', '.join(self.serials)}{suspect})"
        )

    @property
    def serials(self) -> tuple[str, ...]:
        """Serials of the modules in the order of the chain's joints."""
        return self.chain.serials

    @property
    def suspicions(self) -> tuple[str, ...]:
        """Why the result is not to be believed as usual, the reasons of exit code 5; mostly empty."""
        return tuple(self.result.suspicions)

    @cached_property
    def phi(self) -> Array | None:
        """The (10 n,) inertial parameters of physically consistent bodies, None for a run without dynamics.

        Those of a suspect result are given as they are: see `suspicions`.
        Per body [m, m c (3), I about the root frame's origin (xx, xy, xz, yy, yz, zz)], root frame at q = 0.
        """
        return None if self.result.dynamics is None else gravity_model_of_result(self.result).phi

    @cached_property
    def recording(self) -> Recording:
        """Every message of the session, read from `session.mcap` at the first use."""
        return load_recording(self.folder)

    @cached_property
    def _exported(self) -> ExportedRun:
        return exported(self.recording, None, [])

    def signals(self, serial: str) -> Signals:
        """Return all samples of a module on the session's time base.

        Raises:
            KeyError: the run has no such module; the message lists those it has.
        """
        if serial not in self.serials:
            raise KeyError(f"{self.folder} has no module {serial!r}, but {', '.join(self.serials)}")
        return self._exported.signals[serial]

    def frame(self, rate_hz: float | None = None) -> "DataFrame":
        """Return everything that all modules reported as a pandas DataFrame, clocks applied.

        Args:
            rate_hz: None for a row for each sample as it was measured, with the column `module`; otherwise a
                row for each of so many instants a second, interpolated, with columns like
                `elbow.position_rad`.

        Raises:
            MissingPackage: pandas is not installed.
            UsageError: no rate.
        """
        return samples_frame(self._exported) if rate_hz is None else instants_frame(self._exported, rate_hz)

    @cached_property
    def held_out(self) -> HeldOutTorques | None:
        """Torques of the held-out motions, measured and predicted; None for a run without dynamics.

        Raises:
            RunArraysError: the file is damaged.
        """
        path = self.folder / HELD_OUT
        if not path.is_file():
            return None
        serials, session_ns, *arrays = read_held_out_arrays(path)
        t_s = _NS * (session_ns - self._exported.start_ns).astype(float)
        return HeldOutTorques(serials, t_s, *arrays)


def load_run(folder: Path | str) -> SavedRun:
    """Read a finished run back, or the current version of a robot that `attend` measured again.

    Args:
        folder: the run's folder, which holds `result.json`.

    Raises:
        BaselineError: the folder holds no result, or one that cannot be read.
        VersionError: see `current_run`.
    """
    run = current_run(Path(folder))
    return SavedRun(run, read_result(run))


def load_recording(path: Path | str) -> Recording:
    """Read every message of a session.

    Args:
        path: `session.mcap`, or the folder that holds it.

    Raises:
        SessionFileError: there is no such file, or it is no recording.
    """
    path = Path(path)
    return read_recording(path / SESSION if path.is_dir() else path)


# ---------------------------------------------------------------------- kinematics


class Poses(NamedTuple):
    """Poses of the modules' IMU frames in the root frame, at m positions of n joints.

    pose: (m, n, 4, 4). covariance: (m, n, 6, 6) of the twist [rotation (rad), translation (m)] by which each
    pose errs, about the root frame's axes at the pose's own origin; None without the chain's covariance.
    """

    serials: tuple[str, ...]
    pose: Array
    covariance: Array | None

    @property
    def position_sigma_m(self) -> Array | None:
        """The (m, n) standard deviations of position: root of the summed variances of three axes."""
        if self.covariance is None:
            return None
        return np.asarray(np.sqrt(np.trace(self.covariance[..., 3:, 3:], axis1=-2, axis2=-1)))


def forward_kinematics(
    robot: SavedRun | Chain, q_rad: ArrayLike, covariance: ArrayLike | None = None
) -> Poses:
    """Return where every module's IMU is, with the uncertainty of the identified chain.

    Args:
        robot: a run, with its covariance; or a chain.
        q_rad: (m, n) joint positions, or (n,) for one.
        covariance: (6 n, 6 n) of the chain's perturbations; the run's own if a run is given. Directions that
            cannot be identified have zero variance in it and are named in `result.unresolved`.

    Raises:
        ValueError: shapes do not fit the chain.
    """
    chain = robot.chain if isinstance(robot, SavedRun) else robot
    if covariance is None and isinstance(robot, SavedRun):
        covariance = robot.covariance
    q = np.atleast_2d(np.asarray(q_rad, dtype=float))
    pose = imu_poses(chain, q)
    if covariance is None:
        return Poses(chain.serials, pose, None)
    size = 6 * len(chain.serials)
    spread = np.asarray(covariance, dtype=float)
    if spread.shape != (size, size):
        raise ValueError(
            f"the covariance of {len(chain.serials)} modules is ({size}, {size}), got {spread.shape}"
        )
    slope = np.stack([_pose_slope(chain, q, direction) for direction in np.eye(size)], axis=-1)
    return Poses(chain.serials, pose, slope @ spread @ np.swapaxes(slope, -1, -2))


def _pose_slope(chain: Chain, q: Array, direction: Array) -> Array:
    """Return the (m, n, 6) change of every pose, [rotation, translation], per unit of a perturbation."""
    ahead, behind = (imu_poses(apply_perturbation(chain, s * _STEP * direction), q) for s in (1.0, -1.0))
    shape = ahead.shape[:2]
    turn = np.array(ahead[..., :3, :3] @ np.swapaxes(behind[..., :3, :3], -1, -2)).reshape(-1, 3, 3)
    poses = np.tile(np.eye(4), (len(turn), 1, 1))
    poses[:, :3, :3] = turn
    rotation = RigidTransform.from_matrix(poses).rotation.as_rotvec().reshape(*shape, 3)
    return np.concatenate([rotation, ahead[..., :3, 3] - behind[..., :3, 3]], axis=-1) / (2.0 * _STEP)


def denavit_hartenberg(robot: SavedRun | Chain) -> tuple[DhPath, ...]:
    """Return the Denavit-Hartenberg rows of every path from the base to a leaf (see `DhPath`; m and rad)."""
    return dh_paths(robot.chain if isinstance(robot, SavedRun) else robot)


# ---------------------------------------------------------------------- files


def export_urdf(robot: SavedRun | Identified, path: Path | str) -> None:
    """Write the robot as URDF, whole or not at all; inertias are physically consistent bodies.

    Raises:
        OSError: the file cannot be written.
    """
    chain, phi, types, name = _described(robot)
    kinds = [module_type(types[s]) for s in chain.serials]
    write_urdf(Path(path), chain, phi, name, kinds, _undetermined(robot), robot.result.unknown_links)


def export_hrdf(robot: SavedRun | Identified, path: Path | str) -> None:
    """Write the robot as HRDF, the manufacturer's format, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    chain, phi, types, name = _described(robot)
    kinds = [module_type(types[s]) for s in chain.serials]
    write_hrdf(Path(path), chain, kinds, phi, name, _undetermined(robot))


def _described(robot: SavedRun | Identified) -> tuple[Chain, Array | None, Mapping[str, str], str]:
    if isinstance(robot, SavedRun):
        return robot.chain, robot.phi, robot.result.types, robot.result.robot
    return robot.kinematics.fit.chain, robot.real_phi, robot.result.types, robot.result.robot


def _undetermined(robot: SavedRun | Identified) -> Mapping[str, Sequence[str]]:
    return {} if robot.result.dynamics is None else robot.result.dynamics.undetermined


# ---------------------------------------------------------------------- live robots


class LiveRobot:
    """A connected robot: what it has sent last is in `recording`, see `connect`; `group` takes commands.

    Modules that are not held move for other programs and send their feedback all the same.
    """

    def __init__(self, messenger: Messenger, group: ModuleGroup, recording: Recording):
        self.group = group
        self.recording = recording
        self._messenger = messenger

    @property
    def serials(self) -> tuple[str, ...]:
        """Serials of the modules, sorted."""
        return self.group.serials

    @property
    def without_feedback(self) -> list[str]:
        """Serials of the modules that have sent no feedback so far."""
        return [serial for serial in self.serials if not len(self.latest(serial))]

    def latest(self, serial: str, count: int = 1) -> Rows:
        """Return the newest `count` rows of a module (dtype `feedback_rows.ROW`), fewer if fewer came.

        Raises:
            KeyError: no such module.
        """
        log = self.recording.modules[serial].rows
        return log.rows(log.end_row - count, log.end_row)

    async def hold(self, serials: Sequence[str] | None = None) -> None:
        """Take the lease of modules (all by default) and renew it until the connection ends.

        Raises:
            Refused: another program holds one; the message names it and the time left. The others are held.
        """
        await self.group.acquire(*(self.serials if serials is None else serials))

    async def move_to(self, position_rad: Mapping[str, float], max_speed_rad_s: float = 0.5) -> None:
        """Move joints of held modules to positions, all at the same time, by minimum jerk.

        Raises:
            MotionInterrupted, ModuleLost, Refused: a motion did not come to its end; the message says why.
        """
        await self.group.run(
            {s: GoTo(target_rad=q, max_speed_rad_s=max_speed_rad_s) for s, q in position_rad.items()}
        )

    async def close(self) -> None:
        """Release what is held, so that its motors are off, and leave the network."""
        try:
            await self.group.release_all()
        finally:
            self._messenger.close()


@asynccontextmanager
async def connect(
    robot: str = "robot",
    *,
    listen: str = DEFAULT_ENDPOINT,
    routers: Sequence[str] = (),
    expect: int | None = None,
    timeout_s: float = 15.0,
    retained_rows: int = _RETAINED_ROWS,
    secure: Path | str | None = None,
) -> AsyncIterator[LiveRobot]:
    """Connect to a robot on the network: `async with connect("my_arm", expect=4) as arm: ...`.

    Feedback is there within 2 ms of its arrival, as messages wait for each other; answers do not wait.

    Args:
        robot: its name, part of every key.
        listen: the Zenoh endpoint that its agents connect to; a hub that is there already is joined.
        routers: Zenoh routers to connect to instead.
        expect: how many modules there are; by default all that answer until none has come for a second.
        timeout_s: how long to wait for them.
        retained_rows: how many of each module's newest feedback rows are kept, at 101 bytes each; by default
            those of ten minutes.
        secure: the folder of keys that `x5-coordinator keys` makes, for a robot whose programs have
            `--secure`; without it an endpoint that other machines reach is warned of, as a `UserWarning`.

    Raises:
        UsageError: the network cannot be joined, or the folder has no keys of a coordinator or an observer
            of this robot.
        LostError: no module, or fewer than expected, answered within the time, or one sends no feedback.
    """
    loop = asyncio.get_running_loop()
    recording = Recording()
    known = load_credentials(Path(secure), robot, [COORDINATOR, OBSERVER]) if secure is not None else None
    place = Place(robot, listen, tuple(routers), credentials=known)
    for sentence in exposures(place):
        warnings.warn(sentence, stacklevel=2)
    # That a hub is there already is as it should be.
    transport = open_connection(place, lambda text: None).transport
    record = _recorder(recording, retained_rows)
    messenger = Messenger(
        transport, robot, time.monotonic_ns, loop.call_soon_threadsafe, record, coalesced_s=COALESCED_S
    )
    live = LiveRobot(messenger, ModuleGroup(messenger, recording, time.monotonic_ns, new_sender()), recording)
    try:
        messenger.start()
        await live.group.meet(await _present(messenger, robot, expect, timeout_s))
        if not await live.group.wait(lambda: not live.without_feedback, _FEEDBACK_S):
            raise LostError(f"no feedback from {', '.join(live.without_feedback)} within {_FEEDBACK_S:g} s")
        yield live
    finally:
        await live.close()


def _recorder(recording: Recording, retained_rows: int = _RETAINED_ROWS) -> Record:
    """Return what adds messages to a recording that retains the newest feedback rows of every module."""

    def record(entry: Entry) -> Message | None:
        message = recording.accept(entry)
        if isinstance(message, Feedback):
            module = recording.module(message.serial, message.boot)
            if module.rows.end_row - module.rows.first_row > 1.1 * retained_rows:
                module.forget(retained_rows, retained_rows // _ROWS_A_TRIP)
        return message

    return record


async def _present(messenger: Messenger, robot: str, expect: int | None, timeout_s: float) -> list[str]:
    def complete(present: frozenset[str], quiet_s: float) -> bool:
        return bool(present) and (quiet_s > 1.0 if expect is None else len(present) >= expect)

    present = await await_modules(messenger, time.monotonic_ns, complete, timeout_s)
    if present and len(present) >= (expect or 1):
        return sorted(present)
    wanted = "at least one module" if expect is None else f"{expect} modules"
    raise LostError(
        f"{wanted} of robot {robot!r} expected within {timeout_s:g} s, {len(present)} answered: "
        f"{', '.join(sorted(present)) or 'none'}; are the agents running, and is the robot's name right?"
    )
