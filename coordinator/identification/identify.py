"""Identification from a recording, without side effects: a replay computes the same.

Topology from observed motions, a first chain from the agents' joint regressions, one batch refinement
over all exploration motions, then the inertial parameters, checked on held-out motions.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coordinator.batch_estimation.estimator import Refinement
from coordinator.batch_estimation.imu_calibration import CalibrationInformation, measured_before
from coordinator.batch_estimation.imu_intrinsics import beyond
from coordinator.batch_estimation.sensor_data import NoiseFloor
from coordinator.dynamics.torque_prediction import check_held_out
from coordinator.identification.finding import Finding, SensorError
from coordinator.identification.gear_trains import gear_trains
from coordinator.identification.held_joints import explained, given_way
from coordinator.identification.identified import (
    HeldOutMotion,
    IdentificationError,
    Identified,
    Kinematics,
    calibrations,
)
from coordinator.identification.inertia.agent_information import answers
from coordinator.identification.inertia.body_motion import Robot
from coordinator.identification.inertia.inertia import find_inertia, without_terms
from coordinator.identification.inertia.robot_bodies import robot_bodies
from coordinator.identification.result_builder import build_result
from coordinator.identification.robot_refinement import ANYWHERE_M, refine_checked
from coordinator.identification.sensor_checks import (
    changed_since_rest,
    check_encoder_signs,
    check_encoder_travels,
    check_opposed,
    doubted_sensors,
    effort_signs,
    encoder_signs,
    encoder_travels,
    misfits,
    poor_imus,
)
from coordinator.identification.signal_checks import sensor_findings, unusable
from coordinator.identification.topology_observations import respond, simultaneous_motion
from coordinator.identification.topology_search import search_topology
from coordinator.kinematics.assembly import assemble
from coordinator.kinematics.chain_observations import PairObservation, joint_observation
from coordinator.kinematics.gauge_fixing import gauge_fixed
from coordinator.kinematics.simultaneous_motion import circle_observations
from coordinator.recording.journal import (
    JournalEvent,
    Purpose,
    excluded_modules,
    exclusion_notes,
    missing_modules,
)
from coordinator.recording.recording import Recording
from coordinator.synchronisation.clock_refinement import refine_clocks
from coordinator.synchronisation.motion_windows import (
    INDEPENDENT_FRACTION,
    RATE_HZ,
    Window,
    dynamic_windows,
    filtered_window,
    joined_motions,
    motion_noise,
    noise_floor,
    sampling_notes,
    unbroken_windows,
)
from coordinator.synchronisation.round_trips import map_clocks
from coordinator.topology.topology import Topology
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.files import replacing
from module_agent.model.imu_prior import IMU_PRIORS, ImuPrior
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import (
    NS_PER_S,
    REFINEMENT_CUTOFF_HZ,
    JointMotion,
    settling_samples,
)

# The largest of some 30 IMU errors, in standard deviations, is below this for 99 of 100 IMUs.
OUTLIER_ABOVE = 3.5
MIN_REST_ROWS = 10
_NO_SOLUTION = "no robot follows from these readings: they do not vary, or contradict each other"
# Motions that topology and chain are identified from.
EXPLORING: tuple[Purpose, ...] = ("rest", "constant", "windowed_sine", "repeat", "whole")


def identify(
    recording: Recording,
    *,
    revise: Callable[[Kinematics], Kinematics] | None = None,
    kinematics: Kinematics | None = None,
    measured: Sequence[CalibrationInformation] = (),
    explored: Kinematics | None = None,
) -> Identified:
    """Identify everything from a recording.

    Args:
        recording: of a whole session.
        revise: combines the kinematics with prior knowledge, such as a baseline.
        kinematics: the revised kinematics of this recording, if they are computed already.
        measured: earlier recordings of some of the modules, each once.
        explored: the kinematics of `recording.explored`, if they are computed already.

    Raises:
        IdentificationError: data is missing or contradicts itself.
    """
    if kinematics is None:
        kinematics = identify_kinematics(recording, measured, explored)
        kinematics = revise(kinematics) if revise is not None else kinematics
    inertia, bodies, held_out = None, None, None
    if recording.latest_motions("dynamic") and kinematics.dynamic:
        chain, serials, clocks = kinematics.fit.chain, kinematics.topology.serials, kinematics.clocks
        types = [recording.module_type(s) for s in serials]
        floor = base_floor(recording, clocks, kinematics.topology)
        covariance = kinematics.fit.covariance
        robot = Robot(chain, types, kinematics.refinement, covariance, floor, recording.torque)
        windows = dynamic_windows(recording, clocks, serials, "dynamic")
        inertia = find_inertia(robot, windows, answers(recording, chain, clocks))
        estimate = inertia.instrumental
        bodies = robot_bodies(
            estimate.information, chain, types, estimate.fit, INDEPENDENT_FRACTION, inertia.effects
        )
        if recording.latest_motions("held_out") and kinematics.checkable:
            means = joined_motions([without_terms(one, estimate) for one in windows]).tau_nm.mean(axis=0)
            windows = dynamic_windows(recording, clocks, serials, "held_out")
            motion = joined_motions([without_terms(one, estimate) for one in windows])
            held_out = _held_out(kinematics, motion, estimate.fit.phi, means)
            if bodies.fit is not None:
                check = check_held_out(chain, bodies.fit.phi, motion, means)
                bodies = bodies._replace(held_out_error=check.error.overall)
    result = build_result(recording, kinematics, inertia, held_out, bodies)
    return Identified(kinematics, inertia, bodies, held_out, result, calibrations(kinematics, recording))


def identify_topology(recording: Recording) -> Topology:
    """Return which module is mounted on which, from motions of all joints at once or one by one.

    Raises:
        IdentificationError: a module was not explored, or data contradicts itself.
    """
    try:
        return search_topology(recording, _explored(recording)).topology
    except DataError as error:
        raise IdentificationError.of(error) from error
    except np.linalg.LinAlgError as error:
        raise IdentificationError(f"{_NO_SOLUTION} ({error})") from error


def identify_kinematics(
    recording: Recording,
    measured: Sequence[CalibrationInformation] = (),
    explored: Kinematics | None = None,
) -> Kinematics:
    """Identify topology and chain, from what had been recorded at the end of the exploration.

    Later round trips refresh the clocks. Topology and chain are identified from the whole recording if there
    is no `explored` event, or if motions of the exploration differ since: a module has booted.

    Args:
        recording: of a session, at least up to the end of its exploration.
        explored: identified from `recording.explored` and `measured`, if that is computed already.
        measured: earlier recordings of some of the modules, each once: their IMUs are known as well as these
            tell, not only by the catalogue.

    Raises:
        IdentificationError: see `identify`.
    """
    so_far = recording.explored
    if so_far is None or not _same_motions(so_far, recording):
        return _without_sick(recording, measured)
    kept = explored if explored is not None else _without_sick(so_far, measured)
    return _refreshed(kept, recording)


def _without_sick(recording: Recording, measured: Sequence[CalibrationInformation]) -> Kinematics:
    """Identify topology and chain of the modules whose sensors are not sick beyond doubt.

    The robot without a module stands still in its joint: motions of several joints at once do not count then.
    What only the fit shows is excluded one by one, as a sick sensor bends the model of the others as well.

    Raises:
        IdentificationError: as `identify`, also if nothing is left.
    """
    serials = _explored(recording)
    findings = sensor_findings(recording, serials)
    excluded = tuple(serial for serial in unusable(findings) if serial in serials)
    if any(finding.kind == "encoder_stuck" for finding in findings):
        _check_not_exchanged(recording, serials)
    while len(excluded) < len(serials):
        try:
            kept = recording.without(excluded) if excluded else recording
            kinematics = _identify_kinematics(kept, measured)
        except IdentificationError as error:
            if not unusable(findings) or error.findings:
                raise
            without = f"the robot cannot be identified without {', '.join(excluded)}: " if excluded else ""
            text = f"{_reasons(findings, recording)}; {without}{error}"
            raise IdentificationError.of(SensorError(text, findings)) from error
        sick = [one for one in kinematics.findings if unusable([one])]
        if not sick:
            return kinematics._replace(
                findings=(*findings, *kinematics.findings),
                excluded=excluded,
                damage=tuple(recording.damage),
            )
        worst = max(sick, key=lambda one: one.sigmas)
        findings, excluded = (*findings, worst), tuple(sorted((*excluded, worst.serial)))
    text = f"{_reasons(findings, recording)}; no other module is left"
    raise IdentificationError.of(SensorError(text, findings))


def _reasons(findings: Sequence[Finding], recording: Recording) -> str:
    """Return why not all modules were used: what is sick, and who took no part."""
    took_no_part = exclusion_notes(recording.journal)
    return "; ".join((*(finding.summary for finding in findings), *took_no_part))


def _check_not_exchanged(recording: Recording, serials: Sequence[str]) -> None:
    """Check that encoders which seem to be stuck are not exchanged with others, which looks like that, too.

    Raises:
        IdentificationError: as `check_encoder_travels`.
    """
    heard = [serial for serial in serials if serial in recording.modules]
    try:
        clocks = map_clocks({s: recording.modules[s].trips for s in heard})
        check_encoder_travels(encoder_travels(recording, clocks, heard))
    except DataError as error:
        raise IdentificationError.of(error) from error


def _same_motions(so_far: Recording, recording: Recording) -> bool:
    """Return whether no motion of the exploration was added, or is void since its module has booted."""
    before, now = (one.motions(*EXPLORING) for one in (so_far, recording))
    return before == now


def _refreshed(kept: Kinematics, recording: Recording) -> Kinematics:
    """Return kinematics with the clocks by all round trips and notes on later motions.

    Raises:
        IdentificationError: later motions have too few samples.
    """
    later_findings = [
        finding
        for finding in sensor_findings(recording, _explored(recording))
        if (finding.serial, finding.kind) not in {(f.serial, f.kind) for f in kept.findings}
    ]
    recording = recording.without(kept.excluded) if kept.excluded else recording
    try:
        everyone = _explored(recording)
        clocks = map_clocks({s: recording.modules[s].trips for s in everyone})
        _, windows = _exploration(recording, clocks, kept.topology.serials)
        clocks |= refine_clocks(kept.first.chain, clocks, windows).clocks
        later = recording.motions("dynamic", "held_out")
        sampling = (
            *recording.damage,
            *sampling_notes(recording, clocks, everyone, later, REFINEMENT_CUTOFF_HZ),
        )
    except DataError as error:
        raise IdentificationError.of(error) from error
    except np.linalg.LinAlgError as error:
        raise IdentificationError(f"{_NO_SOLUTION} ({error})") from error
    return kept._replace(
        clocks=clocks,
        notes=tuple(dict.fromkeys((*kept.notes, *sampling))),
        findings=(*kept.findings, *later_findings),
        missing=tuple(
            dict.fromkeys((*kept.missing, *missing_modules(recording.journal, kept.topology.serials)))
        ),
        damage=tuple(recording.damage),
    )


def _identify_kinematics(recording: Recording, measured: Sequence[CalibrationInformation]) -> Kinematics:
    """Identify topology and chain from everything that was recorded."""
    serials = _explored(recording)
    try:
        clocks = map_clocks({s: recording.modules[s].trips for s in serials})
        check_encoder_travels(encoder_travels(recording, clocks, serials))
        sampling = (
            *recording.damage,
            *sampling_notes(recording, clocks, serials, _moving(recording), REFINEMENT_CUTOFF_HZ),
        )
        search = search_topology(recording, serials)
        topology = search.topology
        rest = recording.rest_observation(topology.serials, MIN_REST_ROWS)
        signs = encoder_signs(topology, search.observations, rest.specific_force_m_s2)
        check_encoder_signs(signs)
        geared = gear_trains(recording, topology.serials)
        check_opposed(geared.opposed, signs)
        types = [recording.module_type(s) for s in topology.serials]
        explored = _exploration(recording, clocks, topology.serials)
        first = assemble(
            topology,
            types,
            _pairs(recording, clocks, topology.serials, *explored),
            [rest],
        )
        clocks |= refine_clocks(first.chain, clocks, explored[1]).clocks
        motions, windows = _exploration(recording, clocks, topology.serials)
        prior = IMU_PRIORS[recording.imu]
        floor = base_floor(recording, clocks, topology)
        other_type, scaled = (
            [topology.serials.index(s) for s in some] for some in (geared.other_type, geared.scaled)
        )
        known = measured_before(topology.serials, prior, measured).widened(other_type, ANYWHERE_M)
        rest_window = _rest(recording, clocks, topology.serials)
        imu_rate_hz = min(_imu_rate_hz(recording, serial) for serial in topology.serials)
        noise = motion_noise(windows, rest_window, REFINEMENT_CUTOFF_HZ, imu_rate_hz)
        refined, suspects = refine_checked(first.chain, types, windows, prior, floor, known, noise, scaled)
        refined = _settled(refined, first.chain)
        motion = joined_motions([filtered_window(one) for one in windows])
        opposed = effort_signs(refined.chain, types, motion)
        check_opposed(opposed, signs)
        doubted = doubted_sensors(refined, prior, suspects.imus, suspects.encoders)
        named = [f"the {e.purpose} motion of {e.serial}" for e in motions]
        found = (*doubted, *poor_imus(refined, prior), *misfits(refined, noise, named))
        findings = (
            *opposed,
            *(one for one in geared.findings if one.serial not in {other.serial for other in doubted}),
            *explained(found, given_way(topology.serials, topology.unmoved, windows, noise[0], named)),
            *changed_since_rest(refined, rest.q_rad, [recording.rest_rows(s) for s in topology.serials]),
        )
    except DataError as error:
        raise IdentificationError.of(error) from error
    except np.linalg.LinAlgError as error:
        raise IdentificationError(f"{_NO_SOLUTION} ({error})") from error
    notes = tuple(
        f"{estimate.serial} on joint {estimate.joint}: {estimate.note}"
        # Copies: during a session late estimates still arrive.
        for estimates in list(recording.estimates.values())
        for estimate in list(estimates.values())
        if estimate.note
    )
    notes += (*search.notes, *sampling, *_imu_outliers(topology.serials, refined, prior))
    return Kinematics(
        topology, first, refined, clocks, notes, findings, tuple(measured), missing=search.missing
    )


def _imu_outliers(serials: Sequence[str], refined: Refinement, prior: ImuPrior) -> tuple[str, ...]:
    """Return notes on IMUs whose estimated errors are outliers of the prior: the model lacks an effect."""
    return tuple(
        f"{serial}: its IMU seems to have {ratio:.1f} times the error that its kind has. It is poor, "
        "or the robot's base or links give; lengths and axes near it may be worse than claimed"
        for serial, ratio in zip(serials, beyond(refined.intrinsics, prior), strict=True)
        if ratio > OUTLIER_ABOVE
    )


def _settled(refined: Refinement, reference: Chain) -> Refinement:
    """Return a refinement whose unobservable directions are fixed at `reference` (`gauge_fixed`)."""
    by_noise = replace(refined.estimate, covariance=refined.noise_covariance)
    return refined._replace(
        estimate=gauge_fixed(refined.estimate, reference),
        noise_covariance=gauge_fixed(by_noise, reference).covariance,
    )


def _explored(recording: Recording) -> list[str]:
    rested = sorted({e.serial for e in recording.latest_motions("rest")})
    explored = {e.serial for e in recording.latest_motions("windowed_sine", "whole")}
    excluded = excluded_modules(recording.journal)
    if not rested:
        raise IdentificationError("no rest was recorded")
    for what, lacking in (("exploration", set(rested) - explored), ("rest", explored - set(rested))):
        missing = sorted(lacking - set(excluded))
        if missing:
            raise IdentificationError(f"no {what} of {', '.join(missing)} was recorded")
    return rested


def _pairs(
    recording: Recording,
    clocks: dict[str, ClockMap],
    serials: Sequence[str],
    motions: Sequence[JournalEvent],
    windows: Sequence[Window],
) -> list[PairObservation]:
    """Return the modules' own estimates as observations."""
    whole = simultaneous_motion(recording, serials)
    if whole is not None:
        return circle_observations(serials, respond(recording, clocks, serials, whole))
    explored = zip(motions, windows, strict=True)
    sines = {e.serial: (e.motion, one) for e, one in explored if e.purpose == "windowed_sine"}
    pairs = []
    for joint in [s for s in serials if s in sines]:
        motion, one = sines[joint]
        for observer in [s for s in serials if s != joint and motion is not None]:
            estimates = list(recording.estimates.get((joint, observer), {}).items())
            of_motion = [e for ids, e in estimates if motion is not None and ids[-1] == motion.motion_id]
            pair = joint_observation(of_motion[0], one.q_rad.mean(axis=0)) if of_motion else None
            pairs += [] if pair is None else [pair]
    return pairs


def base_floor(recording: Recording, clocks: dict[str, ClockMap], topology: Topology) -> NoiseFloor | None:
    """Return the noise of the first module's IMU at rest; None if that IMU is not fixed to the base."""
    if topology.reversed[0]:
        return None
    return noise_floor(_rest(recording, clocks, topology.serials), REFINEMENT_CUTOFF_HZ)


def _imu_rate_hz(recording: Recording, serial: str) -> float:
    """Return how often a module's IMU is read, by its time stamps of rest."""
    between = np.diff(np.unique(recording.rest_rows(serial)["imu_t_ns"].astype(np.int64)))
    return NS_PER_S / float(np.median(between)) if len(between) else 0.0


def _rest(recording: Recording, clocks: dict[str, ClockMap], serials: Sequence[str]) -> Window:
    """Return the longest stretch of rest without holes.

    Raises:
        DataError: it is too short for the noise of the sensors to be told.
    """
    still = [e for e in recording.latest_motions("rest") if e.serial == serials[0]]
    longest = max(unbroken_windows(recording, clocks, serials, still[0]), key=lambda part: len(part.t_ns))
    # The low-pass settles at either end.
    needed = 2 * settling_samples(RATE_HZ, REFINEMENT_CUTOFF_HZ) + MIN_REST_ROWS
    if len(longest.t_ns) < needed:
        raise DataError(
            f"all modules together have {len(longest.t_ns) / RATE_HZ:.2g} s of rest without a hole, at least "
            f"{needed / RATE_HZ:.2g} s are needed: rows are missing, or a clock is wrong"
        )
    return longest


def _moving(recording: Recording) -> list[JournalEvent]:
    """Return all motions that something is identified from."""
    latest = recording.latest_motions("constant", "windowed_sine", "whole")
    return [*latest, *recording.motions("repeat", "dynamic", "held_out")]


def _exploration(
    recording: Recording, clocks: dict[str, ClockMap], serials: Sequence[str]
) -> tuple[list[JournalEvent], list[Window]]:
    """Return the motions to which the chain is fitted, of the modules in it, one for each window."""
    alone = recording.latest_motions("constant", "windowed_sine")
    whole, repeats = recording.latest_motions("whole"), recording.motions("repeat")
    alone, whole, repeats = ([e for e in some if e.serial in serials] for some in (alone, whole, repeats))
    # The window of any one joint of a simultaneous motion holds all joints.
    motions = [*alone, *whole[:1], *repeats]
    parts = [(e, unbroken_windows(recording, clocks, serials, e, REFINEMENT_CUTOFF_HZ)) for e in motions]
    return [e for e, windows in parts for _ in windows], [one for _, windows in parts for one in windows]


def _held_out(kinematics: Kinematics, motion: JointMotion, phi: Array, means: Array) -> HeldOutMotion:
    serials, t_ns = kinematics.topology.serials, motion.t_ns
    _, predicted, error = check_held_out(kinematics.fit.chain, phi, motion, means)
    module_ns = np.stack([kinematics.clocks[s].to_module(t_ns) for s in serials], axis=1)
    return HeldOutMotion(serials, t_ns, module_ns, motion.q_rad, motion.tau_nm, predicted, error)


def write_held_out(path: Path, held_out: HeldOutMotion) -> None:
    """Write the held-out torques as npz, whole or not at all."""
    names = ("session_ns", "q_rad", "tau_measured_nm", "tau_predicted_nm")
    arrays: dict[str, Any] = {name: getattr(held_out, name) for name in names}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, serials=np.array(held_out.serials), t_ns=held_out.module_ns, **arrays)
