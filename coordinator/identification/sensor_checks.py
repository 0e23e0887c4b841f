"""Sick and mislabelled sensors: what contradicts the catalogue or the other sensors, by serial and motion.

An encoder's sign and its exchange with another one show before any fit, and stop the identification. What
the fit can estimate instead, an encoder's scale and where an IMU sits, is estimated where it is an outlier of
its prior, and named.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.estimator import SYSTEMATIC, Refinement, with_placement
from coordinator.batch_estimation.imu_intrinsics import FORCE, error_name, read
from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.dynamics.inertia_prior import module_prior
from coordinator.dynamics.pseudo_inertia import parameters
from coordinator.identification.finding import Finding, SensorError, Sickness
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import STEP_NS
from coordinator.topology.topology import Observations, Topology
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import ImuPrior
from module_agent.model.regressor import inverse_dynamics
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import JointMotion
from module_agent.wire.feedback_rows import Rows

# Sigma of a direction in the frame of an IMU as delivered: axes turned by 1 deg, 20 mg, joints that give way.
DIRECTION_SIGMA_RAD = 0.05
# Of some 30 checks of a robot none is beyond this by chance in 500 robots.
NAMED_ABOVE = 4.0
# Beyond this a sensor is sick beyond doubt: what models lack is a few sigmas, too.
SERIOUS_ABOVE = 8.0
# What the model leaves unexplained of a gyro or an accelerometer, over what varies in the motions. Links of
# 100 Nm/rad leave 0.18 and 0.28, an IMU that was exchanged with another in mid session 0.45 and more.
UNEXPLAINED = 0.35
# What the model leaves in one motion, over all that varies in it, where it is also more than any drift
# [rad/s, m/s^2]: what gives moves no more than the motion does, but an IMU exchanged during the session has
# other biases.
UNMOVED, DRIFT = 3.0, np.array([0.01, 0.1])
# What an IMU reads at rest differs from the fit of the motions by more than this [rad/s, m/s^2]: drift is
# less, and so are links that sag.
CHANGED = (0.01, 1.0)
# The mean of a second of an arm that swings is this share of its readings' scatter at the most.
SWINGS = 0.3
_AT_REST: tuple[tuple[str, str, str, Sickness], ...] = (
    ("gyro_rad_s", "its gyro", "rad/s", "gyro_contradicts"),
    ("accel_m_s2", "its accelerometer", "m/s^2", "accelerometer_contradicts"),
)
# Readings that vary by less do not vary: single precision.
EXACT = 1e-6
# A joint that was moved alone travels at least this far, and any other less than the share of it.
TRAVEL_RAD, HELD_SHARE = 0.05, 0.3

# The load of a joint by the catalogue against its effort: links weigh what they weigh, springs have friction.
LOAD_SIGMA = 0.3
# Efforts are compared with loads that vary by more than this, and must follow them this closely.
LOAD_NM, ALIKE_ABOVE = 0.05, 0.8
_BACKWARDS = (
    "its encoder counts backwards, the module is mounted the other way round, or its IMU is another module's"
)
EXPLORATION = "its exploration"
_MISLABELLED = "it seems to be of another type than it reports; its place is estimated"
_SCALED = "the scale is estimated; check its gear ratio and type"
_SENSORS = (("the residual of its gyro", "rad/s"), ("the residual of its accelerometer", "m/s^2"))
_POOR = "the sensor is sick, or the base or the links give"
_UNMODELLED = "a link or the base gives more than the model has, or the sensor is sick; the claim is widened"
_OTHER = "in the motions it was another IMU, or the robot did not rest"
_OPPOSED = "the sign of its effort or of its encoder is wrong"


class Travel(NamedTuple):
    """A motion of one joint, and how far every encoder turned along with it.

    asked_rad: how far the joint was to go. by_encoder_rad: in that direction; without a sign if the recording
    has no commands.
    """

    serial: str
    motion: str
    asked_rad: float
    by_encoder_rad: Mapping[str, float]


def encoder_travels(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str]
) -> list[Travel]:
    """Return how far all encoders turned in the exploration, by regression on the moving joint's command."""
    travels = []
    for event in recording.latest_motions("constant", "windowed_sine", "whole"):
        if event.motion is None or event.motion.end_row is None or event.serial not in serials:
            continue
        rows = recording.rows(event.serial, event.motion.start_row, event.motion.end_row)
        command = rows["position_command_rad"].astype(float)
        commanded = bool(len(rows)) and bool(np.isfinite(command).all()) and float(np.ptp(command)) > 0.0
        if not len(rows) or (event.purpose == "whole" and not commanded):
            continue
        t_ns = clocks[event.serial].to_session(rows["t_ns"].astype(np.int64))
        turned = {}
        for serial in serials:
            clock = clocks[serial]
            between = clock.module_span(int(t_ns[0]), int(t_ns[-1]), STEP_NS)
            track = recording.modules[serial].rows.between(*between)
            if len(track):
                at_ns = clock.to_session(track["t_ns"].astype(np.int64))
                q = np.interp(t_ns, at_ns, track["position_rad"])
                turned[serial] = _along(q, command) if commanded else float(np.ptp(q))
        asked = float(np.ptp(command)) if commanded else turned.get(event.serial, 0.0)
        travels.append(Travel(event.serial, event.purpose, asked, turned))
    return travels


def _along(q_rad: Array, command_rad: Array) -> float:
    """Return how far positions (m,) went with a command (m,)."""
    aim = command_rad - command_rad.mean()
    return float(np.ptp(aim) * (aim @ q_rad) / (aim @ aim))


def check_encoder_travels(travels: Sequence[Travel]) -> None:
    """Check that every joint's motion turned its own encoder, and forwards.

    Raises:
        SensorError: two encoders are exchanged, or one counts backwards; with the serials and what travelled.
    """
    turned: dict[str, str] = {}
    cases: dict[str, str] = {}
    exchanged: dict[str, Finding] = {}
    for joint, motion, asked, by_encoder in travels:
        if joint not in by_encoder:
            continue
        own, most = by_encoder[joint], max(by_encoder, key=lambda s: abs(by_encoder[s]))
        if own < -max(TRAVEL_RAD, HELD_SHARE * asked):
            text = (
                f"{joint}: its encoder turned by {own:.2g} rad in its {motion} motion, {asked:.2g} rad were "
                "commanded: its encoder counts backwards"
            )
            raise SensorError(text, [_travel(joint, motion, own, asked, "encoder_sign")])
        far = abs(by_encoder[most])
        if far > TRAVEL_RAD and abs(own) < HELD_SHARE * far:
            cases[joint] = (
                f"moving {joint} turned its encoder by {own:.2g} rad and that of {most} by {far:.2g}"
            )
            turned[joint] = most
            exchanged[joint] = _travel(joint, motion, own, asked, "encoders_exchanged")
        else:
            turned.setdefault(joint, joint)
    # A joint that is stuck turns another's encoder as well, but no other joint turns its own.
    cycle = sorted(s for s, other in turned.items() if other != s and s in _followed(turned, s))
    if cycle:
        raise SensorError(
            f"the encoders of {' and '.join(cycle)} are exchanged ({'; '.join(cases[s] for s in cycle)}): "
            "check which serial is where, and the columns of the recording",
            [exchanged[s] for s in cycle],
        )


def _travel(joint: str, motion: str, turned: float, asked: float, kind: Sickness) -> Finding:
    what, sigmas = "the turn of its encoder", abs(turned - asked) / TRAVEL_RAD
    return Finding(joint, f"its {motion} motion", what, turned, asked, sigmas, "rad", "", kind, True)


def _followed(turned: Mapping[str, str], serial: str) -> list[str]:
    """Return where a serial leads, step by step."""
    steps = [turned[serial]]
    while len(steps) <= len(turned) and steps[-1] in turned:
        steps.append(turned[steps[-1]])
    return steps


def encoder_signs(
    topology: Topology, seen: Observations, force_m_s2: Array
) -> dict[str, tuple[float, float]]:
    """Return the sign of every encoder that another IMU than the joint's observes: {serial: (sign, sigma)}.

    The IMU in a module's housing and one beyond its joint see the same directions d, gravity and the axes of
    the joints below, and turning about the joint's axis does not change their component along it:
    z^T d = s j^T d', with z the axis by the catalogue, j the gyro's answer to the encoder's rate and s the
    sign. Where all directions are across the axis, sigma is large. Of reversed modules, the topology has
    compared the own axis.

    Args:
        topology: n modules.
        seen: which joint moved which IMU, and about which axis.
        force_m_s2: (n, 3) specific forces of rest.
    """
    up = _units(force_m_s2)
    signs = {}
    for j, serial in enumerate(topology.serials):
        if topology.reversed[j]:
            signs[serial] = 1.0, DIRECTION_SIGMA_RAD
        elif pairs := _components(topology, seen, up, j):
            here, there = np.array(pairs).T
            power = max(float(here @ here), 1e-9)
            signs[serial] = float(here @ there) / power, DIRECTION_SIGMA_RAD / power**0.5
    return signs


def check_encoder_signs(signs: Mapping[str, tuple[float, float]]) -> None:
    """Raise a SensorError that names the encoders that count backwards, if there are any."""
    findings = [
        Finding(
            serial,
            "its slow motions",
            "the encoder's sign",
            sign,
            1.0,
            (1.0 - sign) / sigma,
            "",
            _BACKWARDS,
            "encoder_sign",
            True,
        )
        for serial, (sign, sigma) in signs.items()
        if sign < -NAMED_ABOVE * sigma
    ]
    if findings:
        raise SensorError("; ".join(finding.summary for finding in findings), findings)


def effort_signs(chain: Chain, kinds: Sequence[ModuleType], motion: JointMotion) -> list[Finding]:
    """Return the joints whose efforts oppose their load: the sign of effort or encoder is wrong.

    The load is that of the catalogue's bodies on links as a kit has them, good to `LOAD_SIGMA`.

    Args:
        chain: n modules, roughly right.
        kinds: (n,) their types.
        motion: of all joints, with their efforts.
    """
    phi = np.concatenate([parameters(body) for body in module_prior(chain, kinds)])
    load = inverse_dynamics(chain, phi, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
    load, effort = load - load.mean(axis=0), motion.tau_nm - motion.tau_nm.mean(axis=0)
    size, power = np.sqrt((load**2).mean(axis=0)), (load**2).mean(axis=0)
    slope = (load * effort).mean(axis=0) / np.maximum(power, 1e-12)
    alike = slope * size / np.maximum(np.sqrt((effort**2).mean(axis=0)), 1e-9)
    return [
        Finding(
            serial,
            EXPLORATION,
            "effort over load",
            float(s),
            1.0,
            float((1.0 - s) / LOAD_SIGMA),
            "",
            _OPPOSED,
            "effort_sign",
            True,
        )
        for serial, s, c, rms in zip(chain.serials, slope, alike, size, strict=True)
        if c < -ALIKE_ABOVE and rms > LOAD_NM
    ]


def check_opposed(findings: Sequence[Finding], signs: Mapping[str, tuple[float, float]]) -> None:
    """Raise a SensorError with the findings on joints whose encoder's sign no other IMU observes."""
    open_ = [f for f in findings if signs.get(f.serial, (1.0, np.inf))[1] * NAMED_ABOVE > 1.0]
    if open_:
        raise SensorError("; ".join(finding.summary for finding in open_), open_)


def doubted_sensors(
    refined: Refinement, prior: ImuPrior, imus: Sequence[int], encoders: Sequence[int]
) -> list[Finding]:
    """Return the IMUs that sit elsewhere than the catalogue has them, and the encoders that are off in scale.

    Args:
        refined: n modules.
        prior: of the IMUs that agree with it.
        imus, encoders: the modules of which places and scales were free.
    """
    serials, findings = refined.chain.serials, []
    for k in imus:
        off_m = refined.placement[k, 3:]
        away = np.abs(off_m / np.hypot(refined.placement_sigma[k, 3:], prior.place_m))
        worst = int(away.argmax())
        what = f"the place of its IMU along {'xyz'[worst]} against its catalogued place"
        if away[worst] > NAMED_ABOVE:
            off = 1e3 * float(off_m[worst]), 0.0, float(away[worst])
            findings.append(
                Finding(
                    serials[k],
                    EXPLORATION,
                    what,
                    *off,
                    "mm",
                    _MISLABELLED,
                    "imu_place",
                    bool(away[worst] > SERIOUS_ABOVE),
                )
            )
    for k in encoders:
        scale, sigma = float(refined.encoder_scale[k]), float(refined.encoder_scale_sigma[k])
        if abs(scale) > NAMED_ABOVE * sigma:
            read = 1.0 / (1.0 + scale), 1.0, abs(scale) / max(sigma, 1e-9)
            what, serious = "its encoder's scale against the gyros", read[2] > SERIOUS_ABOVE
            findings.append(
                Finding(serials[k], EXPLORATION, what, *read, "", _SCALED, "encoder_scale", serious)
            )
    return findings


def misfits(refined: Refinement, noise: Array, motions: Sequence[str]) -> list[Finding]:
    """Return the IMUs whose residuals are far beyond their noise, each by the motion where they are most so.

    An axis that reads the same all the time, where the model has it vary, is stuck. A sensor much of which is
    unexplained in all motions together is not that of its module, or reads nonsense; and one that is off in a
    motion by more than anything moved in it has changed.

    Args:
        refined: n modules by k motions.
        noise: (2, k, n) of gyro and accelerometer, rms per axis.
        motions: (k,) what to call them.
    """
    ratio, findings = refined.residuals / noise, []
    # What is left and what is read, by sensor; of what is read the most of any module.
    left, read = (refined.columns**2).sum(axis=-1).swapaxes(0, 1)
    unexplained = np.sqrt(left.sum(axis=1) / np.maximum(read.max(axis=2).sum(axis=1), 1e-12)[:, None])
    off_unmoved = np.sqrt(left) > np.maximum(
        UNMOVED * np.sqrt(read.max(axis=2, keepdims=True)), DRIFT[:, None, None]
    )
    for k, serial in enumerate(refined.chain.serials):
        sensor, motion = divmod(int(ratio[:, :, k].argmax()), len(motions))
        if ratio[sensor, motion, k] > SYSTEMATIC:
            measured, expected = float(refined.residuals[sensor, motion, k]), float(noise[sensor, motion, k])
            what, unit = _SENSORS[sensor]
            off = (measured - expected) / expected
            kind: Sickness = "accelerometer_contradicts" if sensor else "gyro_contradicts"
            wrong, spread = refined.columns[sensor, :, :, k]
            still = (spread < EXACT).all(axis=0)
            stuck = bool((still & (wrong > SYSTEMATIC * noise[sensor, :, k, None]).any(axis=0)).any())
            changed = bool(off_unmoved[sensor, :, k].any())
            serious = stuck or changed or bool(unexplained[sensor, k] > UNEXPLAINED)
            findings.append(
                Finding(
                    serial, motions[motion], what, measured, expected, off, unit, _UNMODELLED, kind, serious
                )
            )
    return findings


def changed_since_rest(refined: Refinement, q_rad: Array, rests: Sequence[Rows]) -> list[Finding]:
    """Return the IMUs that read at rest what those of the motions would not: they are others.

    An IMU exchanged for another one between rest and motion may fit another robot in all motions, but its
    biases are its own. An arm that still swings when it should rest, or sinks since no joint can hold it,
    is none that has changed.

    Args:
        refined: of the motions.
        q_rad: (n,) the joints' mean positions at rest. rests: the rows of every module then.
    """
    chain, steady = with_placement(refined.chain, refined.placement), np.zeros((1, len(q_rad)))
    rate = np.array([_mean_rate(rows) for rows in rests])
    ideal = readings_on(chain, body_motions(chain, q_rad[None], rate[None], steady))
    expected = read(refined.intrinsics, ideal.gyro_rad_s, ideal.accel_m_s2, None)
    findings = []
    for k, (serial, rows) in enumerate(zip(refined.chain.serials, rests, strict=True)):
        for sensor, (field, name, unit, kind) in enumerate(_AT_REST):
            readings = rows[field].astype(float)
            off = readings.mean(axis=0) - expected[sensor][0, k]
            size, worst = float(np.linalg.norm(off)), int(np.abs(off).argmax())
            allowed = max(CHANGED[sensor], SWINGS * float(np.linalg.norm(readings.std(axis=0))))
            if size > allowed:
                what = f"what {name} reads along {'xyz'[worst]}"
                wanted = float(expected[sensor][0, k, worst])
                there, away = wanted + float(off[worst]), NAMED_ABOVE * size / allowed
                findings.append(
                    Finding(serial, "its rest", what, there, wanted, away, unit, _OTHER, kind, True)
                )
    return findings


def _mean_rate(rows: Rows) -> float:
    """Return by how much a joint turned in these rows, over their time [rad/s]; 0 by a clock that stood."""
    turned_rad, ns = (float(rows[name][-1] - rows[name][0]) for name in ("position_rad", "t_ns"))
    return 1e9 * turned_rad / ns if ns > 0.0 else 0.0


def poor_imus(refined: Refinement, prior: ImuPrior) -> list[Finding]:
    """Return the IMUs whose estimated scale, axes or biases are far outside of what their kind has.

    The fit takes such an error for the IMU's own only as far as the prior allows, and the rest for the
    robot's: a place or an axis may be wrong beyond its claim. What links and bases that give leave here is
    below `SERIOUS_ABOVE`, but in the gyro's answer to a force: a link that bends turns its IMU with the force
    on it. That alone is not serious.
    """
    free, findings = prior.sigmas > 0.0, []
    off = np.abs(refined.intrinsics.errors[:, free] / prior.sigmas[free])
    for serial, sigmas, errors in zip(refined.chain.serials, off, refined.intrinsics.errors, strict=True):
        bends = (FORCE.start <= np.flatnonzero(free)) & (np.flatnonzero(free) < FORCE.stop)
        serious = bool((sigmas[~bends] > SERIOUS_ABOVE).any())
        sigmas = np.where(bends, 0.0, sigmas) if serious else sigmas
        worst, most = int(np.flatnonzero(free)[sigmas.argmax()]), float(sigmas.max())
        if most > SERIOUS_ABOVE:
            what, unit = error_name(worst)
            size = float(errors[worst])
            findings.append(
                Finding(serial, EXPLORATION, what, size, 0.0, most, unit, _POOR, "imu_error", serious)
            )
    return findings


def _components(topology: Topology, seen: Observations, up: Array, j: int) -> list[tuple[float, float]]:
    """Return the components of directions along axis j, by the module's own IMU and by those beyond it."""
    serials, pairs = topology.serials, []
    below: list[int] = []
    while (parent := topology.parent[below[-1] if below else j]) >= 0:
        below.append(parent)
    for k in [k for k, parent in enumerate(topology.parent) if parent == j]:
        axis = _axis(seen, serials[j], serials[k])
        if axis is None:
            continue
        pairs.append((float(up[j, 2]), float(up[k] @ axis)))
        for p in below:
            here, there = _axis(seen, serials[p], serials[j]), _axis(seen, serials[p], serials[k])
            if here is not None and there is not None:
                pairs.append((float(here[2]), float(there @ axis)))
    return pairs


def _axis(seen: Observations, joint: str, observer: str) -> Array | None:
    one = seen.get((joint, observer))
    return None if one is None or not one.moved or one.axis is None else np.asarray(one.axis)


def _units(vectors: Array) -> Array:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(size, 1e-9))
