"""What a robot was when it was well, with all that the watch needs: models, noise, thresholds.

Everything but the priors comes from the recording of one run. The run is looked at as the watch looks at a
robot: in stretches of half a second, whatever was moving. What the tests find in one part of it against all
the rest is what they find in a robot that has not changed; by that their noise is inflated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, lstsq
from scipy.optimize import brentq
from scipy.special import chdtri

from coordinator.baseline.baseline_robot import BaselineRobot
from coordinator.batch_estimation.estimator import with_placement
from coordinator.batch_estimation.imu_intrinsics import DELAY, ImuIntrinsics
from coordinator.dynamics.inertia_prior import module_prior
from coordinator.dynamics.pseudo_inertia import parameter_scale, parameter_transform, parameters
from coordinator.monitoring.contact import ContactModel, FastPart, contact_model
from coordinator.monitoring.likelihood_ratio import (
    Change,
    ChangeTest,
    Evidence,
    gain_above,
    joined,
    tempered,
    without_own,
)
from coordinator.monitoring.momentum_observer import MomentumObserver
from coordinator.monitoring.residual_tests import (
    IMU_ERRORS,
    LARGE,
    LIKELY,
    OWN_SIGMA,
    PRIOR_KG,
    DriveModel,
    ImuModel,
    catalogued_drive,
    drive_evidence,
    drive_rows,
    fitted_drive,
    imu_changes,
    imu_evidence,
    imu_noise,
    information_of,
    link_changes,
    payload_changes,
    torque_evidence,
    torque_residual,
    torque_window,
)
from coordinator.monitoring.segments import (
    SEGMENT_S,
    Alignment,
    Block,
    DataSegment,
    Segmenter,
    noise_level,
    without_offsets,
)
from coordinator.parameter_fit.torque_sensor_scale import OFFSET_SHARE, SCALE_SIGMA
from coordinator.recording.journal import JournalEvent, since_joined
from coordinator.synchronisation.motion_windows import (
    INDEPENDENT_FRACTION,
    RATE_HZ,
    dynamic_windows,
    filtered_window,
    joined_motions,
)
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError, UsageError
from module_agent.model.imu_prior import IMU_PRIORS
from module_agent.model.information import JointInformation, gather, merge
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY
from module_agent.signals.filtering import JointMotion

# How long a window of the watch is, in stretches.
WINDOW = 10
# Fewer windows than this say nothing of how the tests scatter.
MIN_WINDOWS = 4
# A robot does other motions later than those that it is known from, and the model is wrong about them in
# other ways: without this, an arm of six joints that had not changed was said to have a link displaced.
MARGIN = 3.0
# A robot whose joints moved one at a time has not shown how their torques add up, nor how its IMUs move when
# all joints do. By so much larger are the errors of its model then: with `MARGIN`, those of contacts were 2.2
# times at most in eight arms of six joints, and one arm in six had IMUs that passed for a displaced link.
ALONE_FACTOR = 2.5
# Standard deviation of a catalogued body, per `parameter_scale` about its centre of mass: what brackets,
# cables and a tool add.
BODY_SIGMA_KG = 0.1
# The noise of the torques settles in as many rounds.
_ROUNDS = 3
_NO_NOISE = 1e-9
# Of no parameters.
_NONE = np.zeros(0)


# The stretches of half a second of each session of a run.
_Sessions = Sequence[Sequence[DataSegment]]


class UnsuitableBaseline(UsageError):
    """The run does not hold what the watch needs; the message says what is missing."""


@dataclass(frozen=True, eq=False)
class BaselineTest:
    """Evidence of the known run about one thing, and what may have changed later.

    evidence: about p parameters that stay. own_sigma, prior_sigma: (o,) and (p,) how far those that are each
    window's own, and those that stay, may be from the model. changes: of all (o + p), see `ChangeTest`.
    likely: see there. inflation: by how much the variance of noise is larger than it was taken to be, as the
    model is not exact: all evidence is tempered by it, `evidence` is already, and priors are not.
    """

    evidence: Evidence
    own_sigma: Array
    prior_sigma: Array
    changes: tuple[Array, ...]
    inflation: float
    likely: tuple[float, ...] | None = None

    def find(self, later: Evidence) -> tuple[Change, ...]:
        """Test the evidence of a later window, about all parameters."""
        return self._test.find(tempered(later, self.inflation))

    def misfit(self, later: Evidence) -> float:
        """Return what there is to explain of a later window, as gains are."""
        return self._test.misfit(tempered(later, self.inflation))

    @cached_property
    def _test(self) -> ChangeTest:
        # The run says nothing of parameters that are a later window's own.
        own, sigma = self.own_sigma.size, np.concatenate([self.own_sigma, self.prior_sigma])
        before = Evidence(np.zeros((sigma.size, sigma.size)), np.zeros(sigma.size))
        before.matrix[own:, own:], before.vector[own:] = self.evidence.matrix, self.evidence.vector
        return ChangeTest(before, sigma, self.changes, self.likely)


class Reference(NamedTuple):
    """A robot that is well.

    phi, torque_offset_nm: (10 n,) and (n,), see `fitted_torques`; all else is of torques without the offsets.
    torque_sigma_nm: (n,) noise of the torques as if samples were independent. torque_scale_sigma: standard
    deviation of their sensors' scales; zero if calibrated. information: what the run says of the inertial
    parameters. drives: None of a joint that hardly moved. together: see `moved_together`.
    """

    name: str
    chain: Chain
    types: tuple[ModuleType, ...]
    phi: Array
    torque_offset_nm: Array
    torque_sigma_nm: Array
    torque_scale_sigma: float
    information: tuple[JointInformation, ...]
    torque: BaselineTest
    imu_model: ImuModel
    imu: BaselineTest
    drive_models: tuple[DriveModel, ...]
    drives: tuple[BaselineTest | None, ...]
    contact: ContactModel
    together: bool

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the run leaves open, as sentences."""
        if self.together:
            return ()
        return (
            f"the run that {self.name} is known from hardly moved its joints together: torques and IMUs are "
            f"compared {ALONE_FACTOR:.1f} times as coarsely as after a run with --excitation d-optimal",
        )


def build_reference(known: BaselineRobot) -> Reference:
    """Learn what is normal from a run of the robot.

    Raises:
        UnsuitableBaseline: the run has no motions for inertia, or is too short.
    """
    chain, recording = known.chain, known.recording
    if not recording.motions("dynamic"):
        raise UnsuitableBaseline(f"{known.folder} has no motions for inertia: it was run with --no-dynamics")
    if not known.kinematics.dynamic:
        why = "; ".join(known.kinematics.suspicions)
        raise UnsuitableBaseline(f"{known.folder} does not tell the robot's inertia: {why}")
    types = tuple(recording.module_type(serial) for serial in chain.serials)
    motions, blocks = steps_of_run(known)
    phi, offset_nm = fitted_torques(chain, types, joined_motions(motions))
    blocks = [without_offsets(block, offset_nm) for block in blocks]
    sessions = [Segmenter().add(block) for block in blocks]
    if len(_windows(sessions)) < MIN_WINDOWS:
        raise UnsuitableBaseline(
            f"{known.folder} lasts {SEGMENT_S * len(_stretches(sessions)):.0f} s: too short to tell what is "
            f"normal; at least {SEGMENT_S * MIN_WINDOWS * WINDOW:.0f} s are needed"
        )
    together = moved_together(recording.motions("dynamic"), len(types))
    factor = 1.0 if together else ALONE_FACTOR
    sigma, information, torque = _torque(chain, phi, sessions, factor)
    model = _imu_model(known, types, sessions)
    drives = [_drive(kind, sessions, joint) for joint, kind in enumerate(types)]
    outside = [MomentumObserver(chain, phi).advance(b.q_rad, b.qd_rad_s, b.tau_nm) for b in blocks]
    fast = [factor * FastPart().advance(one) for one in outside]
    return Reference(
        name=known.name,
        chain=chain,
        types=types,
        phi=phi,
        torque_offset_nm=offset_nm,
        torque_sigma_nm=sigma,
        torque_scale_sigma=SCALE_SIGMA[recording.torque],
        information=information,
        torque=torque,
        imu_model=model,
        imu=_imu_test(model, sessions, factor),
        drive_models=tuple(drive for drive, _ in drives),
        drives=tuple(test for _, test in drives),
        contact=contact_model(fast),
        together=together,
    )


def steps_of_run(known: BaselineRobot) -> tuple[list[JointMotion], list[Block]]:
    """Return the motions for inertia, and per session of the run its samples.

    They begin with its first step and end with the last one that was done, as far as all modules have them.
    Before, between and after these the motors may be off, and the robot may lie on whatever is there.

    Raises:
        UnsuitableBaseline: something within them was not recorded.
    """
    recording, clocks, serials = known.recording, known.kinematics.clocks, known.chain.serials
    try:
        motions = [filtered_window(w) for w in dynamic_windows(recording, clocks, serials, "dynamic")]
    except DataError as error:
        raise UnsuitableBaseline(f"{known.folder}: {error}") from error
    blocks = []
    for begin_ns, end_ns in session_spans(since_joined(recording.journal)):
        aligned = Alignment(serials, begin_ns).advance(recording, clocks, end_ns)
        if aligned.gaps:
            lost = ", ".join(f"module {gap.serial}" for gap in aligned.gaps)
            raise UnsuitableBaseline(f"{known.folder}: its recording has a hole in the rows of {lost}")
        if aligned.block is not None:
            blocks.append(aligned.block)
    if not blocks:
        raise UnsuitableBaseline(
            f"{known.folder}: its steps have no time in common with the rows of all modules"
        )
    return motions, blocks


def session_spans(journal: Sequence[JournalEvent]) -> list[tuple[int, int]]:
    """Return the session times at which the first step of every session began and its last one was done."""
    sessions: list[list[JournalEvent]] = [[]]
    for event in journal:
        if event.what == "session":
            sessions.append([])
        elif event.what in ("begin", "motion", "done"):
            sessions[-1].append(event)
    done = [[event.t_ns for event in events if event.what == "done"] for events in sessions]
    return [(events[0].t_ns, max(ends)) for events, ends in zip(sessions, done, strict=True) if ends]


def moved_together(motions: Sequence[JournalEvent], joints: int) -> bool:
    """Return whether half of the joints, two at least, moved at once in half of the steps.

    motions: those for inertia; joints that move at once share their step. A single joint always does.
    """
    steps = {event.step: set[str]() for event in motions}
    for event in motions:
        steps[event.step].add(event.serial)
    several = sum(len(serials) >= max(2, -(-joints // 2)) for serials in steps.values())
    return joints == 1 or 2 * several >= len(steps)


def fitted_torques(chain: Chain, types: Sequence[ModuleType], motion: JointMotion) -> tuple[Array, Array]:
    """Return the bodies' parameters phi (10 n,) and the offsets o (n,) [Nm] of the torque sensors.

    They are the most probable ones by a motion's independent samples, with the catalogue's bodies phi_0 and
    no offsets as Gaussian priors,

        minimise sum |tau - Y phi - o|^2 / sigma_tau^2 + |phi - phi_0|^2 / sigma_phi^2 + |o|^2 / sigma_o^2,

    sigma_tau (n,) from the residual. Without offsets the fit takes that of a joint with little load for
    weight of the bodies beyond it, and is wrong in all other poses; without the prior it has from noise what
    the motion determines weakly, and other motions more.
    """
    joints, bodies = len(types), PER_BODY * len(types)
    prior = module_prior(chain, types)
    expected = np.concatenate([*map(parameters, prior), np.zeros(joints)])
    offset_sigmas = np.diag([OFFSET_SHARE["uncalibrated"] * one.max_effort_nm for one in types])
    spread = block_diag(*map(_body_spread, prior), offset_sigmas)
    rows, target = [], []
    information = gather(
        chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2, motion.tau_nm, with_offset=True
    )
    for joint, piece in enumerate(information):
        columns = np.zeros((len(piece.z), bodies + joints))
        columns[:, :bodies], columns[:, bodies + joint] = piece.r[:, :bodies], piece.r[:, bodies]
        rows.append(columns @ spread)
        target.append(piece.z - columns @ expected)
    phi, offset_nm = np.split(expected + spread @ _most_probable(rows, target, information), [bodies])
    make_read_only((phi, offset_nm))
    return phi, offset_nm


def _body_spread(prior: Array) -> Array:
    """Return one standard deviation of a body's parameters in every direction, (10, 10), from its prior."""
    centre = np.eye(4)
    centre[:3, 3] = prior[:3, 3] / prior[3, 3]
    return np.asarray(BODY_SIGMA_KG * parameter_transform(centre) * parameter_scale(1))


def _most_probable(
    rows: Sequence[Array], target: Sequence[Array], information: Sequence[JointInformation]
) -> Array:
    """Return the parameters, in standard deviations of their prior, by rows of unknown noise."""
    size = rows[0].shape[1]
    estimate = np.zeros(size)
    for _ in range(_ROUNDS):
        stacked, wanted = [np.eye(size)], [np.zeros(size)]
        for own, own_target, piece in zip(rows, target, information, strict=True):
            misfit = float(np.sum((own_target - own @ estimate) ** 2)) + piece.rest
            weight = np.sqrt(INDEPENDENT_FRACTION * piece.samples / max(misfit, _NO_NOISE))
            stacked.append(weight * own)
            wanted.append(weight * own_target)
        estimate = np.asarray(lstsq(np.vstack(stacked), np.concatenate(wanted), check_finite=False)[0])
    return estimate


def _torque(
    chain: Chain, phi: Array, sessions: _Sessions, factor: float
) -> tuple[Array, tuple[JointInformation, ...], BaselineTest]:
    sigma, counted = noise_level([torque_residual(chain, phi, one) for one in _stretches(sessions)])
    independent = np.maximum(sigma, 1e-6) * np.sqrt(counted)
    evidence = [
        torque_window([torque_evidence(chain, phi, independent, one) for one in window])
        for window in _windows(sessions)
    ]
    test = calibrated_test(
        evidence, _NONE, np.full(phi.size, PRIOR_KG), payload_changes(len(chain.serials)), factor=factor
    )
    whole = merge(*(information_of(chain, one) for window in _windows(sessions) for one in window))
    return independent, whole, test


def _imu_model(known: BaselineRobot, types: tuple[ModuleType, ...], sessions: _Sessions) -> ImuModel:
    refinement, count = known.kinematics.refinement, len(known.chain.serials)
    chain = with_placement(known.chain, refinement.placement)
    # Delays are each segment's own.
    errors = refinement.intrinsics.errors.copy()
    errors[:, DELAY] = 0.0
    rough = ImuModel(
        chain=chain,
        kinds=types,
        compliance=refinement.compliance,
        intrinsics=ImuIntrinsics(errors),
        prior=IMU_PRIORS[known.imu],
        sigma=np.full((count, 6), 0.05),
    )
    return rough._replace(sigma=imu_noise(rough, _stretches(sessions)))


def _imu_test(model: ImuModel, sessions: _Sessions, factor: float) -> BaselineTest:
    """Return the test of links, then of gyros, then of accelerometers."""
    evidence = [joined([imu_evidence(model, one) for one in window]) for window in _windows(sessions)]
    count, links = len(model.chain.serials), link_changes(model.chain)
    sensors = [one for sensor in IMU_ERRORS for one in imu_changes(count, sensor)]
    likely = (*[LIKELY / LARGE] * len(links), *[1.0] * len(sensors))
    return calibrated_test(evidence, model.own_sigma, model.prior_sigma, (*links, *sensors), likely, factor)


def _drive(kind: ModuleType, sessions: _Sessions, joint: int) -> tuple[DriveModel, BaselineTest | None]:
    parts = [drive_rows(kind, one, joint) for one in _stretches(sessions)]
    rows, torque = (np.concatenate(column) for column in zip(*parts, strict=True))
    theta, noise = catalogued_drive(kind), kind.max_effort_nm
    if len(rows):
        theta = fitted_drive(kind, rows, torque)
    if len(rows) > RATE_HZ:
        sigma, counted = noise_level([(torque - rows @ theta)[:, None]])
        noise = float(max(sigma[0], 1e-6) * np.sqrt(counted[0]))
    model = DriveModel(kind, theta, noise)
    windows = [
        [e for one in window if (e := drive_evidence(model, one, joint)) is not None]
        for window in _windows(sessions)
    ]
    evidence = [joined(window) for window in windows if window]
    known = len(evidence) >= MIN_WINDOWS
    return model, calibrated_test(evidence, OWN_SIGMA, model.prior_sigma, (model.change,)) if known else None


def calibrated_test(
    windows: Sequence[Evidence],
    own_sigma: Array,
    prior_sigma: Array,
    changes: tuple[Array, ...],
    likely: tuple[float, ...] | None = None,
    factor: float = 1.0,
) -> BaselineTest:
    """Return what all windows say, with noise inflated until each agrees with the others, and by a margin.

    factor: by how much more the noise is, see `ALONE_FACTOR`. Else as `BaselineTest`.
    """
    # The median of the largest gain that chance makes in as many tests.
    expected = [chdtri(change.shape[1], 0.5 / (len(windows) * len(changes))) for change in changes]

    def parts(inflation: float) -> list[Evidence]:
        return [without_own(tempered(window, inflation), own_sigma) for window in windows]

    def excess(log_inflation: float) -> float:
        """Return the logarithm of the largest gain over what chance makes."""
        inflation, largest = float(np.exp(log_inflation)), 0.0
        each = parts(inflation)
        whole = joined(each)
        for part, window in zip(each, windows, strict=True):
            others = Evidence(whole.matrix - part.matrix, whole.vector - part.vector)
            test = BaselineTest(others, own_sigma, prior_sigma, changes, inflation, likely)
            gains = [change.gain / level for change, level in zip(test.find(window), expected, strict=True)]
            largest = max([largest, *gains])
        return float(np.log(max(largest, _NO_NOISE)))

    exact, lower, upper = 0.0, 0.0, excess(0.0)
    if upper > 0.0:
        # More noise makes less of every gain, but of some by less than in proportion, as priors hold it back.
        while excess(upper) > 0.0:
            lower, upper = upper, 2.0 * upper
        exact = brentq(excess, lower, upper, xtol=0.01)
    inflation = MARGIN * factor**2 * float(np.exp(exact))
    return BaselineTest(joined(parts(inflation)), own_sigma, prior_sigma, changes, inflation, likely)


def _windows(sessions: _Sessions) -> list[Sequence[DataSegment]]:
    """Return windows, none of which begins in one session and ends in the next."""
    return [own[WINDOW * k : WINDOW * (k + 1)] for own in sessions for k in range(len(own) // WINDOW)]


def _stretches(sessions: _Sessions) -> list[DataSegment]:
    return [one for own in sessions for one in own]


# Allowed false alarms, of all tests together.
ALARMS_PER_HOUR = 0.1
# A push of less than this share of a joint's largest torque is none.
MIN_CONTACT = 0.01
# Windows of the last so many segments are tested: short ones for what is large, long ones for what is small.
SPANS = (3, WINDOW)
_DRIVE_FREEDOM, _LINK_FREEDOM = 2, 6


class Thresholds(NamedTuple):
    """Gains, and torques (n,) of a contact [Nm], that chance exceeds as seldom as asked for.

    link: of links and of IMUs, which are each other's rivals.
    """

    payload: float
    link: float
    drive: float
    contact_nm: Array


def thresholds(reference: Reference, alarms_per_hour: float = ALARMS_PER_HOUR) -> Thresholds:
    """Share the allowed rate among contacts, payloads, links and drives, and that of each among its tests.

    Raises:
        UsageError: a rate that is not positive.
    """
    if not (np.isfinite(alarms_per_hour) and alarms_per_hour > 0.0):
        raise UsageError(f"{alarms_per_hour} false alarms an hour cannot be asked for; it must be above 0")
    each, count = alarms_per_hour / 4.0, len(reference.chain.serials)
    effort = np.array([kind.max_effort_nm for kind in reference.types])
    looks = len(SPANS) * 3600.0 / SEGMENT_S
    return Thresholds(
        gain_above(PER_BODY, looks * count, each),
        # A gyro's or an accelerometer's biases and scales are as many.
        gain_above(_LINK_FREEDOM, looks * (len(reference.chain.linked) + 2 * count), each),
        gain_above(_DRIVE_FREEDOM, looks * count, each),
        np.maximum(reference.contact.level_nm(each), MIN_CONTACT * effort),
    )
