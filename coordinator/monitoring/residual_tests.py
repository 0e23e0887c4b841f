"""What joint torques say of a change of the bodies' inertial parameters.

What IMUs say of a link that has changed: rates and specific forces against those of the joints' motion.

A payload changes nothing in them, as encoders sit beyond the springs, but for the deflection of links. That
is predicted by the compliance that the known run tells and the modules' own masses (`estimated_turns`):
joints that are caught with a jolt ring on their springs, and tubes of 325 mm then shake what they carry by
1 m/s^2. By what the prediction is uncertain each sample is noisier, although that lasts as long as the jolt,
and a payload makes it worse: the inflation of the test has to cover both.
A link that is displaced moves every module beyond it by the same twist, linear in the readings as long as it
is small (`imu_jacobian`). Biases and delays are each stretch's own: they drift, and clocks are mapped anew
every day.

What motor currents say of a drive's friction: the motor's torque against the spring's.

A motor that turns at w (seen at the output) with current i, behind a gear of ratio N that passes on a share
eta of what drives and all of what is driven back, has

    m = k N i (eta or 1) = c tau + l sign(w) |tau| + Fc sign(w) + Fv w + J w' + T tau' + offset,

tau the spring's torque as read, c and l what motor constant and losses are off their type's (1 and 0; Khalil
and Dombre 2002, section 9.6, for the rest), T [s] the time by which the reading lags behind what the spring
transmits (its own damping; `torque_terms`): in quick motions, where inertia prevails, tau' goes against the
speed, and less friction would else explain it. The motor's side stands alone on the left, as a joint that
carries nothing would else be explained best by no motor at all. Only where the motor turns is friction what
it seems, so that slow samples do not count.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from coordinator.batch_estimation.imu_intrinsics import DELAY, SIZE, ImuIntrinsics, mixing, read, slopes
from coordinator.batch_estimation.imu_jacobian import imu_jacobian, kernel_motion
from coordinator.batch_estimation.imu_prediction import (
    BodyMotion,
    ImuReadings,
    body_motions,
    readings_on,
)
from coordinator.batch_estimation.link_compliance import estimated_turns
from coordinator.dynamics.pseudo_inertia import parameter_scale
from coordinator.monitoring.likelihood_ratio import Evidence, evidence_of, joined, without_first
from coordinator.monitoring.segments import DataSegment, noise_level
from coordinator.synchronisation.motion_windows import RATE_HZ
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import ImuPrior
from module_agent.model.information import JointInformation, gather
from module_agent.model.perturbation import skew
from module_agent.model.read_only import make_read_only, read_only
from module_agent.model.regressor import PER_BODY, inverse_dynamics, torque_regressor
from module_agent.signals.filtering import differentiate

# How far parameters may be from where a fit has them, per `parameter_scale`: bodies weigh some hundred grams.
PRIOR_KG = 0.5
# Of a torque sensor: offset and scale.
SENSOR_ERRORS = 2
# Of a payload: a change of 1 is one of a kilogram at the body's place.
UNIT_PAYLOAD_KG = 1.0


def information_of(chain: Chain, segment: DataSegment) -> tuple[JointInformation, ...]:
    """Return the information of every joint."""
    return gather(chain, segment.q_rad, segment.qd_rad_s, segment.qdd_rad_s2, segment.tau_nm)


def torque_residual(chain: Chain, phi: Array, segment: DataSegment) -> Array:
    """Return what a model leaves of the torques, (m, n) [Nm]."""
    predicted = inverse_dynamics(chain, phi, segment.q_rad, segment.qd_rad_s, segment.qdd_rad_s2)
    return np.asarray(segment.tau_nm - predicted)


def torque_evidence(chain: Chain, phi: Array, sigma_nm: Array, segment: DataSegment) -> Evidence:
    """Return the evidence about torque sensors' offsets [Nm] and scales (2 n), then about phi.

    phi (10 n) is its deviation from `phi` in kilograms by `parameter_scale`. sigma_nm: (n,) noise as if
    samples were independent.
    """
    count = len(chain.serials)
    regressor = torque_regressor(chain, segment.q_rad, segment.qd_rad_s, segment.qdd_rad_s2)
    predicted = regressor @ phi
    rows = np.zeros((*predicted.shape, (SENSOR_ERRORS + PER_BODY) * count))
    joint = np.arange(count)
    rows[:, joint, joint] = 1.0
    rows[:, joint, count + joint] = predicted
    rows[..., SENSOR_ERRORS * count :] = regressor * parameter_scale(count)
    rows /= sigma_nm[:, None]
    residual = (segment.tau_nm - predicted) / sigma_nm
    return evidence_of(rows.reshape(-1, rows.shape[-1]), residual.reshape(-1))


def torque_window(parts: Sequence[Evidence]) -> Evidence:
    """Return the evidence about phi (10 n) of a window's stretches together, if their sensors are well."""
    whole = joined(parts)
    return without_first(whole, whole.parameters // (SENSOR_ERRORS + PER_BODY) * SENSOR_ERRORS)


def payload_changes(count: int) -> tuple[Array, ...]:
    """Return the hypotheses: all ten parameters of one body change."""
    unit = UNIT_PAYLOAD_KG * np.eye(PER_BODY * count)
    return tuple(unit[:, PER_BODY * b : PER_BODY * (b + 1)] for b in range(count))


# The low-pass leaves about as many independent samples as one in five. Near the ends of a stretch it is not
# known how links turn, as that takes the joints' fourth derivatives: gains would exceed chance by a third
# more.
KEEP_EVERY = 5
_KEPT = slice(10, -10, KEEP_EVERY)
# Of an IMU's errors: those that are the stretch's own, and those that stay.
_OWN = [*range(18, 24), DELAY]
_LASTING = [k for k in range(SIZE) if k not in _OWN]
_PER_TWIST = 6
# The noise of the IMUs settles in as many rounds.
_ROUNDS = 5
_MIN_NOISE = 1e-5
ImuSensor = Literal["gyro", "accelerometer"]
# Biases, and scales of the axes.
IMU_ERRORS: dict[ImuSensor, tuple[range, range]] = {
    "gyro": (range(18, 21), range(0, 9, 4)),
    "accelerometer": (range(21, 24), range(9, 18, 4)),
}
# How far the known links may be off, in radians and metres; gravity, in m/s^2; own biases against those of
# the known run, and delays against those of no filter at all.
_LINK_SIGMA, _GRAVITY_SIGMA = 0.02, 0.05
_OWN_SIGMA = np.array([3e-3] * 3 + [0.05] * 3 + [5e-3])
# Of what links' giving way makes of readings: how much of it is uncertain, and by how much later or earlier
# it may come. An arm that rings at 12 Hz bends by as much as expected, but 12 ms later.
_GIVING_SHARE, _GIVING_LATE_S = 0.1, 0.01
# Of a link's change, in radians and metres: as it is measured, and as it is judged. A stretch that cannot
# tell 5 mm says nothing: a wrist that swings alone shakes the arm by less than a count of its encoders, which
# half a metre of displacement would explain.
LARGE, LIKELY = 0.1, 5e-3
# How large a change of 1 is of biases [rad/s, m/s^2] and scales of a sensor of three axes.
IMU_SIZES: dict[ImuSensor, Array] = {
    "gyro": np.repeat([0.1, 0.1], 3),
    "accelerometer": np.repeat([1.0, 0.1], 3),
}


class ImuModel(NamedTuple):
    """What IMUs should read, and how well.

    chain: n joints. kinds: (n,) their types. compliance: of the links, see `estimated_turns`. intrinsics: the
    IMUs' errors. sigma: (n, 6) scatter per sample of links that do not give way.
    """

    chain: Chain
    kinds: tuple[ModuleType, ...]
    compliance: Array
    intrinsics: ImuIntrinsics
    prior: ImuPrior
    sigma: Array

    @property
    def own_sigma(self) -> Array:
        """How far a stretch's own parameters may be from the known, (7 n,)."""
        return np.tile(_OWN_SIGMA, len(self.chain.serials))

    @property
    def prior_sigma(self) -> Array:
        """The same of those that stay: twists of all links (6 n), gravity (3), IMUs' errors (27 n)."""
        count = len(self.chain.serials)
        errors = np.maximum(self.prior.sigmas[_LASTING], 1e-5)
        return np.concatenate(
            [np.full(_PER_TWIST * count, _LINK_SIGMA), np.full(3, _GRAVITY_SIGMA), np.tile(errors, count)]
        )


class _Predicted(NamedTuple):
    """The samples of a stretch that are kept: the bodies' motions, ideal readings, and what the model leaves.

    at: the stretch at these samples. uncertain: (m, n, 6) standard deviation of the ideal readings, as links
    give way otherwise than expected. residual: (m, n, 6) of the real ones.
    """

    at: DataSegment
    bodies: list[BodyMotion]
    ideal: ImuReadings
    uncertain: Array
    residual: Array


def _predicted(model: ImuModel, segment: DataSegment) -> _Predicted:
    joints = segment.q_rad, segment.qd_rad_s, segment.qdd_rad_s2
    bodies = body_motions(model.chain, *joints)
    rigid = readings_on(model.chain, bodies)
    ideal, uncertain = rigid, np.zeros(segment.imu_rates.shape)
    turns = estimated_turns(model.chain, model.kinds, model.compliance, joints, RATE_HZ)
    if turns:
        bodies = body_motions(model.chain, *joints, turns=turns)
        ideal = readings_on(model.chain, bodies, turns)
        giving = np.concatenate([one - other for one, other in zip(ideal, rigid, strict=True)], axis=2)
        uncertain = np.hypot(_GIVING_SHARE * giving, _GIVING_LATE_S * differentiate(giving, RATE_HZ))
    at = DataSegment(segment.raw, segment.t_ns[_KEPT], *(signal[_KEPT] for signal in segment[2:]))
    bodies = [BodyMotion(*(signal[:, _KEPT] for signal in body)) for body in bodies]
    ideal = ImuReadings(*(signal[_KEPT] for signal in ideal))
    gyro, accel = read(model.intrinsics, ideal.gyro_rad_s, ideal.accel_m_s2, None)
    residual = np.concatenate([at.gyro_rad_s - gyro, at.accel_m_s2 - accel], axis=2)
    return _Predicted(at, bodies, ideal, uncertain[_KEPT], residual)


def imu_noise(model: ImuModel, segments: Sequence[DataSegment]) -> Array:
    """Return what `ImuModel.sigma` is, as if samples were independent.

    By what the model leaves of the readings, but for biases and delays that are the same in all segments.
    """
    expected = [_predicted(model, one) for one in segments]
    whole = np.concatenate([one.residual for one in expected])
    late = np.concatenate([-one.at.imu_rates for one in expected])
    whole, late = whole - whole.mean(axis=0), late - late.mean(axis=0)
    # One delay for all six axes of an IMU, weighed by what each scatters.
    weight = 1.0 / np.maximum(whole.var(axis=0), 1e-12)
    delay = (weight * late * whole).sum(axis=(0, 2)) / np.maximum((weight * late**2).sum(axis=(0, 2)), 1e-12)
    settled = whole - delay[:, None] * late
    uncertain = np.concatenate([one.uncertain for one in expected])
    sigma, counted = settled.std(axis=0), np.ones(settled.shape[1:])
    for _ in range(_ROUNDS):
        # Each sample's share of its scatter that is not by links that give way.
        own = settled * sigma / np.maximum(np.hypot(sigma, uncertain), 1e-300)
        sigma, counted = (one.reshape(sigma.shape) for one in noise_level([own.reshape(len(own), -1)]))
    return read_only(np.maximum(sigma * np.sqrt(counted), _MIN_NOISE))


def imu_evidence(model: ImuModel, segment: DataSegment) -> Evidence:
    """Return the evidence about own parameters (`own_sigma`), then those that stay (`prior_sigma`)."""
    count = len(model.chain.serials)
    at, bodies, ideal, uncertain, residual = _predicted(model, segment)
    scatter = np.hypot(model.sigma, uncertain)
    links = len(_OWN) * count
    tilt = links + _PER_TWIST * count
    total = links + len(model.prior_sigma)
    matrix, vector = np.zeros((total, total)), np.zeros(total)
    motion = kernel_motion(bodies, at.q_rad, at.qd_rad_s)
    by_errors = slopes(ideal.gyro_rad_s, ideal.accel_m_s2, at.imu_rates, np.ones(SIZE, dtype=bool))
    for k in range(count):
        moved = imu_jacobian(model.chain, motion, len(at.q_rad), k, mixing(model.intrinsics, k))
        by_error = by_errors[:, :, k]
        # Slopes (p, 6, m) by those parameters alone that this IMU depends on.
        own = np.concatenate([by_error[_OWN], moved.poses, moved.gravity, by_error[_LASTING]])
        columns = np.concatenate(
            [
                len(_OWN) * k + np.arange(len(_OWN)),
                *(links + _PER_TWIST * module + np.arange(_PER_TWIST) for module in moved.modules),
                tilt + np.arange(3),
                tilt + 3 + len(_LASTING) * k + np.arange(len(_LASTING)),
            ]
        )
        rows = (own / scatter[:, k].T).reshape(len(columns), -1).T
        part = evidence_of(rows, (residual[:, k] / scatter[:, k]).T.reshape(-1))
        matrix[np.ix_(columns, columns)] += part.matrix
        vector[columns] += part.vector
    make_read_only((matrix, vector))
    return Evidence(matrix, vector)


def imu_error_columns(count: int, sensor: ImuSensor) -> list[Array]:
    """Return per module the columns (6,) of `imu_evidence` that its sensor's biases and scales are in."""
    bias, scale = IMU_ERRORS[sensor]
    lasting = (len(_OWN) + _PER_TWIST) * count + 3
    places = [_OWN.index(one) for one in bias], [_LASTING.index(one) for one in scale]
    return [
        np.array(
            [len(_OWN) * k + one for one in places[0]]
            + [lasting + len(_LASTING) * k + one for one in places[1]]
        )
        for k in range(count)
    ]


def link_changes(chain: Chain) -> tuple[Array, ...]:
    """Return the hypotheses, one for every module but those on the base: all beyond its link is displaced.

    By a turn and a shift (6,) of the module's IMU in the root frame at q = 0, in units of `LARGE`.
    """
    count = len(chain.serials)
    found = np.zeros((len(chain.linked), _imu_parameters(count), _PER_TWIST))
    for change, child in zip(found, chain.linked, strict=True):
        # A shift s of the IMU's place p, turned by w, is one of the origin by s - w x p.
        about_imu = np.eye(_PER_TWIST)
        about_imu[3:, :3] = skew(chain.imu_home[child, :3, 3])
        for module in chain.descendants(child):
            first = len(_OWN) * count + _PER_TWIST * module
            change[first : first + _PER_TWIST] = LARGE * about_imu
    return tuple(found)


def imu_changes(count: int, sensor: ImuSensor) -> tuple[Array, ...]:
    """Return the hypotheses, one for every module: its gyro's or accelerometer's biases and scales change."""
    found = np.zeros((count, _imu_parameters(count), len(IMU_SIZES[sensor])))
    for change, columns in zip(found, imu_error_columns(count, sensor), strict=True):
        change[columns, np.arange(len(columns))] = IMU_SIZES[sensor]
    return tuple(found)


def displacement(size: Array) -> tuple[Array, Array]:
    """Return the turn (3,) [rad] and the shift (3,) [m] of a module's IMU, in the root frame at q = 0.

    size: (6,) of a `Change` by `link_changes`.
    """
    return LARGE * size[:3], LARGE * size[3:]


def _imu_parameters(count: int) -> int:
    """Return how many parameters `imu_evidence` of n modules is about."""
    return (len(_OWN) + _PER_TWIST + len(_LASTING)) * count + 3


# c, l, Fc, Fv, J, T, offset: Fc and Fv are what changes.
TERMS = 7
_FRICTION = slice(2, 4)
# Of the largest speed; below, a motor may stick within its tick.
SLOW_SHARE = 0.04
# Of the low-pass: what is farther has no say.
REACH_SAMPLES = 10
MIN_SAMPLES = 20
# Of c and l: what a joint that carries little tells of them is not what they are under another load.
OWN_SIGMA = np.array([0.1, 0.1])
# Standard deviation of the lag of a spring's reading about none: rubber damps.
_LAG_SIGMA_S = 5e-3


class DriveModel(NamedTuple):
    """A joint's drive: its parameters (7,), and its scatter [Nm] as if samples were independent."""

    kind: ModuleType
    theta: Array
    sigma_nm: float

    @property
    def prior_sigma(self) -> Array:
        """How far its parameters may be from where they are (7,): gears and motors of a type are alike."""
        usual = catalogued_drive(self.kind)
        friction = np.maximum(usual[_FRICTION], 0.01) * 2.0
        return np.array([0.05, 0.1, *friction, usual[4], _LAG_SIGMA_S, 0.05 * self.kind.max_effort_nm])

    @property
    def change(self) -> Array:
        """The hypothesis: Coulomb and viscous friction change, by as much as the catalogue has them."""
        found = np.zeros((OWN_SIGMA.size + TERMS, 2))
        found[OWN_SIGMA.size :][_FRICTION] = np.diag(catalogued_drive(self.kind)[_FRICTION])
        return found

    @property
    def offset_change(self) -> Array:
        """The rival hypothesis: the torque sensor's offset changes; in units of a twentieth of its range."""
        found = np.zeros((OWN_SIGMA.size + TERMS, 1))
        found[-1] = 0.05 * self.kind.max_effort_nm
        return found

    @property
    def relative_friction(self) -> Array:
        """The change of friction at half the largest speed, over what it is, by a `Change` of 1 in each."""
        speed = 0.5 * self.kind.max_speed_rad_s
        coulomb, viscous = self.theta[_FRICTION]
        slope = np.array([1.0, speed]) / float(coulomb + viscous * speed)
        return np.asarray(catalogued_drive(self.kind)[_FRICTION] * slope)


def drive_rows(kind: ModuleType, segment: DataSegment, joint: int) -> tuple[Array, Array]:
    """Return the rows (k, 7) and motor torques (k,) [Nm] of the samples in which the motor of a joint turns.

    All signals went through the same low-pass, which reaches into what is around a sample.
    """
    speed = segment.raw.motor_rad_s[:, joint] / kind.gear_ratio
    slow = np.abs(speed) < SLOW_SHARE * kind.max_speed_rad_s
    turning = np.convolve(slow, np.ones(2 * REACH_SAMPLES + 1), mode="same") == 0
    driving, driven, loss, sign, turned, change = segment.drive[:, joint].T
    per_amp = kind.gear_ratio * kind.motor.back_emf_v_s_rad
    motor = per_amp * (kind.motor.efficiency * driving + driven)
    speeds = turned / kind.gear_ratio, change / kind.gear_ratio
    tau, rate = segment.tau_nm[:, joint], segment.tau_rate_nm_s[:, joint]
    rows = np.column_stack([tau, loss, sign, *speeds, rate, np.ones_like(sign)])
    return rows[turning], motor[turning]


def drive_evidence(model: DriveModel, segment: DataSegment, joint: int) -> Evidence | None:
    """Return the evidence about the drive's deviation from its model; None if the motor stood.

    Before the seven parameters are those of how torque is passed on, the stretch's own (2,): see `OWN_SIGMA`.
    """
    rows, torque = drive_rows(model.kind, segment, joint)
    if len(rows) < MIN_SAMPLES:
        return None
    weighted = np.column_stack([rows[:, : OWN_SIGMA.size], rows]) / model.sigma_nm
    return evidence_of(weighted, (torque - rows @ model.theta) / model.sigma_nm)


def fitted_drive(kind: ModuleType, rows: Array, torque_nm: Array) -> Array:
    """Return the parameters (7,) that explain a drive's torques best.

    A drive that hardly moved keeps what its type's catalogue says, as far as the samples leave it open.
    """
    expected = catalogued_drive(kind)
    sigma = 0.01 * kind.max_effort_nm
    prior = DriveModel(kind, expected, sigma).prior_sigma
    stacked = np.vstack([rows / sigma, np.diag(1.0 / prior)])
    target = np.concatenate([(torque_nm - rows @ expected) / sigma, np.zeros(TERMS)])
    return read_only(expected + np.linalg.lstsq(stacked, target, rcond=None)[0])


def catalogued_drive(kind: ModuleType) -> Array:
    """Return a drive's parameters (7,) by its type."""
    motor = kind.motor
    inertia = motor.rotor_inertia_kg_m2 * kind.gear_ratio**2
    return np.array([1.0, 0.0, motor.coulomb_nm, motor.viscous_nm_s_rad, inertia, 0.0, 0.0])
