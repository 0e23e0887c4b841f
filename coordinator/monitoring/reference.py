"""What a robot was when it was well, with all that the watch needs: models, noise, thresholds.

Everything comes from the recording of one run. The run is looked at as the watch looks at a robot: in
stretches of half a second, whatever was moving. What the tests find in one part of it against all the rest
is what they find in a robot that has not changed; by that their noise is inflated.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from coordinator.baseline.baseline_robot import BaselineRobot
from coordinator.monitoring.contact import ContactModel, contact_model, fast_part
from coordinator.monitoring.likelihood_ratio import ChangeTest, WhitenedRows, find_change, joined, without_own
from coordinator.monitoring.momentum_observer import MomentumObserver
from coordinator.monitoring.residual_tests import (
    PRIOR_KG,
    DriveModel,
    ImuModel,
    catalogued_drive,
    drive_rows,
    drive_window,
    fitted_drive,
    imu_rows,
    information_of,
    lasting_residual,
    link_changes,
    payload_changes,
    torque_residual,
    torque_rows,
    whitened_drive_rows,
    without_delay,
)
from coordinator.monitoring.segments import Alignment, Block, DataSegment, Segmenter, noise_level, part_of
from coordinator.parameter_fit.least_squares import solve_weighted
from coordinator.synchronisation.motion_windows import INDEPENDENT_FRACTION, RATE_HZ, dynamic_motion
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError, UsageError
from module_agent.model.imu_prior import IMU_PRIORS
from module_agent.model.information import JointInformation, gather, merge

# How long a window of the watch is, in stretches.
WINDOW = 10
# Fewer windows than this say nothing of how the tests scatter.
MIN_WINDOWS = 4
# A robot does other motions later than those that it is known from, and the model is wrong about them in
# other ways: without this, an arm of six joints that had not changed was said to have a link displaced.
MARGIN = 3.0
# Of a robot's first torques, as its arm falls into its springs, nothing is expected.
_FIRST_S = 1.0


class UnsuitableBaseline(UsageError):
    """The run does not hold what the watch needs; the message says what is missing."""


class BaselineTest(NamedTuple):
    """Evidence of the known run about one thing, and by how much its tests' gains are inflated there."""

    evidence: WhitenedRows
    prior_sigma: Array
    changes: tuple[Array, ...]
    inflation: float

    def test(self, later: WhitenedRows) -> ChangeTest:
        """Test a later window; gains are those of well-behaved noise."""
        found = find_change(self.evidence, later, self.prior_sigma, self.changes)
        return ChangeTest(
            found.misfit / self.inflation,
            tuple(
                c._replace(gain=c.gain / self.inflation, covariance=c.covariance * self.inflation)
                for c in found.changes
            ),
        )


class Reference(NamedTuple):
    """A robot that is well.

    torque_sigma_nm: (n,) noise of the torques as if samples were independent. information: what the run says
    of the inertial parameters. drives: None of a joint that hardly moved.
    """

    name: str
    chain: Chain
    types: tuple[ModuleType, ...]
    phi: Array
    torque_sigma_nm: Array
    information: tuple[JointInformation, ...]
    torque: BaselineTest
    imu_model: ImuModel
    imu: BaselineTest
    drive_models: tuple[DriveModel, ...]
    drives: tuple[BaselineTest | None, ...]
    contact: ContactModel


def build_reference(known: BaselineRobot) -> Reference:
    """Learn what is normal from a run of the robot.

    Raises:
        NoReference: the run has no motions for inertia, or is too short.
    """
    chain, recording = known.chain, known.recording
    if not recording.motions("dynamic"):
        raise UnsuitableBaseline(f"{known.folder} has no motions for inertia: it was run with --no-dynamics")
    types = tuple(recording.module_type(serial) for serial in chain.serials)
    try:
        motion = dynamic_motion(recording, known.kinematics.clocks, chain.serials, "dynamic")
    except DataError as error:
        raise UnsuitableBaseline(f"{known.folder}: {error}") from error
    signals = motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2, motion.tau_nm
    phi = solve_weighted(gather(chain, *signals), INDEPENDENT_FRACTION).phi
    aligned = Alignment(chain.serials).advance(recording, known.kinematics.clocks)
    if aligned.block is None:
        lost = ", ".join(f"module {h.serial}" for h in aligned.gaps) or "a module"
        raise UnsuitableBaseline(f"{known.folder}: its recording has a hole in the rows of {lost}")
    block = part_of(aligned.block, round(_FIRST_S * RATE_HZ), len(aligned.block.t_ns))
    segments = Segmenter().add(block)
    if len(segments) < MIN_WINDOWS * WINDOW:
        raise UnsuitableBaseline(
            f"{known.folder} lasts {0.5 * len(segments):.0f} s: too short to tell what is normal; "
            f"at least {0.5 * MIN_WINDOWS * WINDOW:.0f} s are needed"
        )
    sigma, information, torque = _torque(chain, phi, segments)
    model, imu = _imu(known, segments)
    models, drives = _drives(types, segments)
    return Reference(
        name=known.name,
        chain=chain,
        types=types,
        phi=phi,
        torque_sigma_nm=sigma,
        information=information,
        torque=torque,
        imu_model=model,
        imu=imu,
        drive_models=models,
        drives=drives,
        contact=_contact(chain, phi, block),
    )


def _torque(
    chain: Chain, phi: Array, segments: Sequence[DataSegment]
) -> tuple[Array, tuple[JointInformation, ...], BaselineTest]:
    sigma, counted = noise_level([torque_residual(chain, phi, one) for one in segments])
    independent = np.maximum(sigma, 1e-6) * np.sqrt(counted)
    windows = []
    for part in _window_segments(segments):
        whole: tuple[JointInformation, ...] = ()
        for one in part:
            found = information_of(chain, one)
            whole = merge(whole, found) if whole else found
        windows.append(whole)
    total = windows[0]
    for more in windows[1:]:
        total = merge(total, more)
    evidence = [torque_rows(window, phi, independent) for window in windows]
    count = len(chain.serials)
    prior = np.full(phi.size, PRIOR_KG)
    return independent, total, _calibrated(evidence, prior, payload_changes(count))


def _imu(known: BaselineRobot, segments: Sequence[DataSegment]) -> tuple[ImuModel, BaselineTest]:
    chain, refinement = known.chain, known.kinematics.refinement
    count = len(chain.serials)
    rough = ImuModel(
        chain, without_delay(refinement.intrinsics), IMU_PRIORS[known.imu], np.full((count, 6), 0.05)
    )
    sigma, counted = noise_level(lasting_residual(rough, segments))
    model = rough._replace(sigma=np.maximum(sigma * np.sqrt(counted), 1e-5).reshape(count, 6))
    evidence = [
        without_own(joined([imu_rows(model, one) for one in part]), model.own_sigma)
        for part in _window_segments(segments)
    ]
    return model, _calibrated(evidence, model.prior_sigma, link_changes(chain))


def _drives(
    types: Sequence[ModuleType], segments: Sequence[DataSegment]
) -> tuple[tuple[DriveModel, ...], tuple[BaselineTest | None, ...]]:
    models, found = [], []
    for joint, kind in enumerate(types):
        parts = [drive_rows(kind, one, joint) for one in segments]
        rows = np.concatenate([part[0] for part in parts])
        torque = np.concatenate([part[1] for part in parts])
        theta = fitted_drive(kind, rows, torque) if len(rows) else catalogued_drive(kind)
        if len(rows) > RATE_HZ:
            sigma, counted = noise_level([(torque - rows @ theta)[:, None]])
            noise = float(max(sigma[0], 1e-6) * np.sqrt(counted[0]))
        else:
            noise = kind.max_effort_nm
        models.append(DriveModel(kind, theta, noise))
        found.append(_drive(models[-1], segments, joint))
    return tuple(models), tuple(found)


def _drive(model: DriveModel, segments: Sequence[DataSegment], joint: int) -> BaselineTest | None:
    evidence = []
    for part in _window_segments(segments):
        window = [e for one in part if (e := whitened_drive_rows(model, one, joint)) is not None]
        if window:
            evidence.append(drive_window(window))
    if len(evidence) < MIN_WINDOWS:
        return None
    return _calibrated(evidence, model.prior_sigma, (model.change,))


def _calibrated(
    windows: Sequence[WhitenedRows], prior_sigma: Array, changes: tuple[Array, ...]
) -> BaselineTest:
    """Return what all windows say, and by how much the tests of each against the others exceed chance."""
    exceeding = []
    for k, window in enumerate(windows):
        others = joined([*windows[:k], *windows[k + 1 :]])
        found = find_change(others, window, prior_sigma, changes)
        exceeding += [
            (change.gain, columns.shape[1]) for change, columns in zip(found.changes, changes, strict=True)
        ]
    # The largest that chance makes of so many, of which every second window's largest is below.
    expected = [chi2.isf(0.5 / len(exceeding), freedom) for _, freedom in exceeding]
    largest = max([1.0, *(gain / level for (gain, _), level in zip(exceeding, expected, strict=True))])
    return BaselineTest(joined(windows), prior_sigma, changes, MARGIN * largest)


def _window_segments(segments: Sequence[DataSegment]) -> list[Sequence[DataSegment]]:
    whole = len(segments) // WINDOW
    return [segments[WINDOW * k : WINDOW * (k + 1)] for k in range(whole)]


def _contact(chain: Chain, phi: Array, block: Block) -> ContactModel:
    observer = MomentumObserver(chain, phi, RATE_HZ)
    outside = observer.advance(block.q_rad, block.qd_rad_s, block.tau_nm)
    return contact_model(fast_part(outside, RATE_HZ))
