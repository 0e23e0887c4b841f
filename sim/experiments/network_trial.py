"""One identification of a simulated robot over a network, scored: what latency, jitter and loss cost.

Trials of one seed on different networks are of the same modules, clocks included, so that they come in pairs.
"""

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.clock_map import ClockMap
from coordinator.identify import identify
from coordinator.journal import JournalEvent
from coordinator.kinematics.imu_intrinsics import ImuKind
from coordinator.plan import Plan
from coordinator.recording import Recording
from coordinator.run import write_outputs
from coordinator.run_folder import SESSION, load_recording
from coordinator.terminal import Terminal
from sim.experiments.module_bench import ExperimentFailed
from sim.noise_profile import NoiseProfile, noise_profile
from sim.robot_file import load_robot
from sim.score import score
from sim.truth import Motion, read_motion
from sim.virtual_run import VirtualConfig, run_virtual

OFFSET_S = 0.05
DRIFT_PPM = 100.0
# Every so many ticks of the world the clocks' maps are compared with the truth.
EVERY = 500


class NetworkTrial(NamedTuple):
    """What came of one trial; of one that did not come to its end only the first four fields tell.

    why: what ended the trial before its end, empty if nothing did. again: motions that were interrupted and
    done again. Links are in the order of the robot's file: errors of their lengths, claimed sigmas, errors
    of their parents' axes. clock_error_s: the root mean square, over modules and times, of how far the
    modules' clocks are mapped apart from one another; clock_sigma_s: the same as claimed.
    """

    robot: str
    network: str
    seed: int
    why: str
    again: int = 0
    robot_time_s: float = 0.0
    topology_right: bool = False
    link_error_m: tuple[float, ...] = ()
    link_sigma_m: tuple[float, ...] = ()
    axis_error_deg: tuple[float, ...] = ()
    tip_position_m: float | None = None
    tip_orientation_deg: float | None = None
    clock_error_s: float | None = None
    clock_sigma_s: float | None = None


def network_trial(
    robot: str,
    network: str,
    noise: str | NoiseProfile | None,
    seed: int,
    plan: Plan | None = None,
    keep: Path | None = None,
) -> NetworkTrial:
    """Run, identify and score one robot over one network, in virtual time and without dynamics.

    Args:
        robot: a shipped robot or a robot file.
        network: a network profile or file.
        noise: a noise profile; `apart` gives it clocks that differ by 50 ms and 100 ppm.
        seed: of the modules, their noise and the network.
        plan: of the session; the IMUs count as calibrated where their errors of scale are none.
        keep: folder for the run; None for one that is gone afterwards.
    """
    with tempfile.TemporaryDirectory() as gone:
        out = keep or Path(gone) / "run"
        described = load_robot(robot)
        found = noise if isinstance(noise, NoiseProfile) else noise_profile(noise or described.noise)
        config = VirtualConfig(
            described,
            out,
            seed=seed,
            network=network,
            noise=found,
            plan=plan or Plan(dynamics=False, imu=_kind(found)),
        )
        try:
            run_virtual(config, Terminal(quiet=True))
        except (RuntimeError, TimeoutError, ValueError) as error:
            return NetworkTrial(robot, network, seed, f"{type(error).__name__}: {error}")
        return scored(out, robot, network, seed)


def scored(run: Path, robot: str, network: str, seed: int) -> NetworkTrial:
    """Identify anew from what a run has recorded, write its files, and score them.

    Raises:
        IdentificationError: see `coordinator.identify`.
        ScoreError: the run has no truth beside it.
    """
    recording = load_recording(run / SESSION)
    found = identify(recording)
    write_outputs(run, found)
    result = score(run)
    errors = [link.link_length_error_mm for link in result.links]
    sigmas = [link.link_length_sigma_mm for link in result.links]
    axes = [link.axis_error_deg for link in result.links]
    clocks = found.kinematics.clocks
    return NetworkTrial(
        robot,
        network,
        seed,
        "",
        _again(recording),
        result.robot_time_s,
        result.topology_correct,
        tuple(1e-3 * e for e in errors if e is not None),
        tuple(1e-3 * s for s in sigmas if s is not None),
        tuple(a for a in axes if a is not None),
        None if result.tip_position_rms_mm is None else 1e-3 * result.tip_position_rms_mm,
        result.tip_orientation_rms_deg,
        clock_error_s(clocks, read_motion(run / "truth.npz")),
        float(np.sqrt(np.mean([1e-18 * clock.sigma_ns**2 for clock in clocks.values()]))),
    )


def apart(noise: NoiseProfile, offset_s: float = OFFSET_S, drift_ppm: float = DRIFT_PPM) -> NoiseProfile:
    """Return a profile whose clocks differ by up to `offset_s`, and by `drift_ppm` (one sigma)."""
    return noise.model_copy(
        update={"clock_offset_min_s": 0.0, "clock_offset_max_s": offset_s, "clock_drift_ppm": drift_ppm}
    )


def clock_error_s(clocks: dict[str, ClockMap], motion: Motion) -> float:
    """Return how far the same instants of all modules are mapped apart, root mean square over both."""
    columns = [
        clocks[serial].to_session(motion.clock_ns[::EVERY, column])
        for column, serial in enumerate(motion.serials)
        if serial in clocks
    ]
    if len(columns) < 2:
        raise ExperimentFailed(f"{len(columns)} clocks have nothing to be compared with")
    mapped = np.stack(columns, axis=1)
    # Whole nanoseconds of years do not fit a float: differences first.
    relative = (mapped - mapped[:, :1]).astype(np.float64)
    spread = relative - relative.mean(axis=1, keepdims=True)
    return 1e-9 * float(np.sqrt(np.mean(spread**2)))


def _kind(noise: NoiseProfile) -> ImuKind:
    return "uncalibrated" if noise.accel_scale or noise.imu_misalignment_rad else "calibrated"


def _again(recording: Recording) -> int:
    notes: list[JournalEvent] = [e for e in recording.journal if e.what == "note"]
    return sum("the motion of module" in note.text for note in notes)
