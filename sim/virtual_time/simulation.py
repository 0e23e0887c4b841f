"""Identify a simulated robot in one call, in virtual time and one process: the simulator as a library."""

from functools import cached_property
from pathlib import Path

from coordinator.excitation.plan import Plan
from coordinator.identification.identified import Identified
from coordinator.identification.identify import identify
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import SESSION, check_free, load_recording
from module_agent.network_emulation.profile_file import network as network_profile
from sim.imperfections.noise_profile import NoiseProfile, imu_kind, noise_profile
from sim.physics.engine import Physics
from sim.robot.robot_file import Robot, load_robot
from sim.scoring.score import Score, score_identified
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from sim.virtual_time.run import VirtualConfig, run_virtual
from sim.virtual_time.session import record_session
from sim.world.external_force import Push
from sim.world.truth import Motion, Truth, read_motion, read_truth, truth_of


class Simulation:
    """One simulated session: what the coordinator received and identified, and the truth, kept apart.

    robot: what was simulated. folder: the run's folder, None if nothing was written.
    recording: every message that the coordinator received.
    identified: topology, chain, inertial parameters and result, computed from the recording alone.
    truth: constants of the robot; `truth.chain` has the fields of `identified.kinematics.fit.chain`,
        `truth.inertia` is (n, 10) [kg, kg m, kg m^2], every body in the root frame at q = 0.
    motion: the true joint motion at 250 Hz, arrays (T, n) [rad, rad/s, Nm].
    """

    def __init__(self, robot: Robot, folder: Path | None, recording: Recording, truth: Truth, motion: Motion):
        self.robot = robot
        self.folder = folder
        self.recording = recording
        self.truth = truth
        self.motion = motion

    @cached_property
    def identified(self) -> Identified:
        """Everything that follows from the recording; computed once.

        Raises:
            IdentificationError: the recording does not suffice, or contradicts itself.
        """
        return identify(self.recording)

    def score(self) -> Score:
        """Compare result and truth: link lengths [mm], axes [deg], tips, torques."""
        return score_identified(self.identified, self.truth.chain, self.motion)


def simulate(
    robot: Robot | str | Path,
    *,
    noise: NoiseProfile | str | None = "x5-uncalibrated",
    network: str = "none",
    seed: int = 0,
    plan: Plan | None = None,
    dynamics: bool | None = None,
    pushes: tuple[Push, ...] = (),
    imu_rate_hz: float = 250.0,
    physics: Physics | None = None,
    out: Path | str | None = None,
) -> Simulation:
    """Simulate a robot, identify it in virtual time, and return result and truth.

    Args:
        robot: name of a shipped robot (`x5-sim robots`), a robot file, or a robot.
        noise: noise profile, by name (`x5-sim effects`) or as an object; the robot's own when None.
        network: network profile by name (none, lan, wifi, ...), or a TOML file of one.
        seed: of all randomness; the same seed gives the same recording, bit by bit.
        plan: the motions; by default the standard ones, with IMU priors that fit the noise profile.
        dynamics: whether to identify inertial parameters [kg, kg m, kg m^2] too; by default as planned.
        pushes: external forces [N] and torques [Nm] on modules.
        imu_rate_hz: how often the IMUs are read, 1000 Hz divided by a whole number.
        physics: engine that moves the bodies; by default compiled, pybullet where there are obstacles.
        out: folder to write the run to (`session.mcap`, `result.json`, `truth.json`, ...), as
            `x5-sim run --virtual` does; nothing is written when None.

    Raises:
        RobotFileError: no such robot, or one that cannot be simulated.
        RunFolderError: `out` holds a run already.
        KeyError: no such noise profile.
        ValueError: no such network.
        IdentificationError: the robot could not be identified.
    """
    described = robot if isinstance(robot, Robot) else load_robot(str(robot))
    profile = noise if isinstance(noise, NoiseProfile) else noise_profile(noise or described.noise)
    planned = Plan(imu=imu_kind(profile)) if plan is None else plan
    if dynamics is not None:
        planned = planned.model_copy(update={"dynamics": dynamics})
    if out is not None:
        folder = Path(out)
        check_free(folder)
        run_virtual(
            VirtualConfig(
                *(described, folder, seed, network, profile, planned),
                pushes=pushes,
                imu_rate_hz=imu_rate_hz,
                physics=physics,
            )
        )
        truth, motion = read_truth(folder / "truth.json"), read_motion(folder / "truth.npz")
        return Simulation(described, folder, load_recording(folder / SESSION), truth, motion)
    ended: list[tuple[Truth, Motion]] = []

    def keep_truth(simulated: VirtualRobot) -> None:
        ended.append((truth_of(described, simulated.world), simulated.truth.motion()))

    settings = VirtualSettings(
        described, network_profile(network), seed, profile, None, pushes, imu_rate_hz, physics
    )
    recording = record_session(settings, planned, keep_truth)
    simulation = Simulation(described, None, recording, *ended[0])
    # Compute at once, so that an identification error is raised by this call.
    _ = simulation.identified
    return simulation
