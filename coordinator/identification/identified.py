"""Results of an identification: topology, chain, inertia, held-out motions."""

from typing import NamedTuple, Self

import numpy as np

from coordinator.batch_estimation.estimator import Refinement
from coordinator.batch_estimation.imu_calibration import CalibrationInformation
from coordinator.dynamics.torque_prediction import TorqueError
from coordinator.identification.finding import UNUSABLE, Finding, SensorError, motion_of
from coordinator.identification.inertia.inertia import Inertia
from coordinator.identification.inertia.robot_bodies import RobotBodies
from coordinator.identification.result import Result
from coordinator.kinematics.assembly import ChainFit
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.recording.recording import Recording
from coordinator.topology.topology import Topology
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap

HELD_OUT = motion_of("held_out")


class IdentificationError(DataError):
    """Data is missing from the recording, or contradicts itself; the message says what and where.

    findings: the sick sensors that are the cause; without any, nothing is known to be sick.
    """

    findings: tuple[Finding, ...] = ()

    @classmethod
    def of(cls, error: Exception) -> Self:
        """Return the failure of an identification by another error, with the sick sensors that it names."""
        failure = cls(str(error))
        if isinstance(error, SensorError):
            failure.findings, failure.exit_code = error.findings, error.exit_code
        return failure


class Kinematics(NamedTuple):
    """Topology and chain: `first` as assembled from the circles, `refinement` by the batch estimator.

    findings: sensors that contradict the catalogue or the others. measured: earlier recordings of some of the
    modules, from which the refinement took the prior of their IMUs. excluded: modules without which the robot
    is identified, as their sensors are sick. missing: sentences on modules that were absent or at fault,
    observed no motion, or did not move their joint as commanded. damage: sentences on what cannot be read of
    the recording.
    """

    topology: Topology
    first: ChainFit
    refinement: Refinement
    clocks: dict[str, ClockMap]
    notes: tuple[str, ...]
    findings: tuple[Finding, ...] = ()
    measured: tuple[CalibrationInformation, ...] = ()
    excluded: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()

    @property
    def dynamic(self) -> bool:
        """Whether torques tell of all bodies: every joint is known and moved, every effort is measured."""
        return not self.missing and all(one.motion == HELD_OUT for one in self._without_torques)

    @property
    def checkable(self) -> bool:
        """Whether the torques of a held-out motion tell how good inertia is."""
        return self.dynamic and not self._without_torques

    @property
    def _without_torques(self) -> list[Finding]:
        """The findings on joints of whose torques or motions nothing is known."""
        sick = UNUSABLE | {"effort_stuck", "joint_halted"}
        return [one for one in self.findings if one.serious and one.kind in sick]

    @property
    def suspicions(self) -> list[str]:
        """Why the robot is not to be believed as usual, as sentences; none of healthy robots."""
        before = (
            f"it began with {one.name}, and there {why}" for one in self.measured for why in one.suspicions
        )
        return [*self.own_suspicions, *before]

    @property
    def own_suspicions(self) -> list[str]:
        """The suspicions of this recording, without those of earlier ones."""
        known = [*(one.summary for one in self.findings if one.serious), *self.missing]
        return [*(known or self._unknown_lengths), *self.damage]

    @property
    def _unknown_lengths(self) -> list[str]:
        """What is to be said of links of whose length the motions told nothing, where nothing else says why.

        In the forest all modules stand on joints that moved. A motion shows how far from its axis an IMU is
        unless it is small and slow, or what it leaves unexplained widens the claim until nothing is left.
        """
        chain = self.fit.chain
        lines = []
        for k in chain.linked:
            joint, carried = chain.serials[chain.parent[k]], chain.serials[k]
            if not np.isfinite(self.fit.link_length_sigma_m[k]):
                lines.append(
                    f"the length of the link {joint} - {carried} is not known, although {joint} moved: "
                    "move it farther or faster, and check the sensors and clocks of both"
                )
        return lines

    @property
    def fit(self) -> ChainEstimate:
        """The refined chain with its covariance and unresolved directions."""
        return self.refinement.estimate

    def summary(self) -> list[str]:
        """Return the tree, the links and the findings on sensors as lines of text."""
        lines = []
        for k, serial in enumerate(self.topology.serials):
            parent = self.topology.parent[k]
            mounted = (", mounted reversed" if self.topology.reversed[k] else "") + self.topology.caveat(k)
            if parent < 0:
                lines.append(f"{serial} on the base{mounted}")
                continue
            length, sigma = 1e3 * self.fit.link_length_m[k], 1e3 * self.fit.link_length_sigma_m[k]
            on = f"{serial} on {self.topology.serials[parent]}{mounted}"
            known = f"{length:.1f} +- {sigma:.1f} mm" if np.isfinite(sigma) else "its length is not known"
            lines.append(f"{on}: {known}")
        return lines + [finding.summary for finding in self.findings]


def calibrations(kinematics: Kinematics, recording: Recording) -> tuple[CalibrationInformation, ...]:
    """Return what a recording tells of its IMUs, by its kinematics, and after it what earlier ones told."""
    own = kinematics.refinement.calibration_information
    suspicions = tuple(kinematics.own_suspicions)
    own = own._replace(session=recording.trace_hash, imu=recording.imu, suspicions=suspicions)
    return (own, *kinematics.measured)


class HeldOutMotion(NamedTuple):
    """Torques of the held-out motions, measured (low-passed) and predicted, columns in the chain's order.

    session_ns: (m,). module_ns: (m, n) the same instants in every module's own clock. The others (m, n).
    """

    serials: tuple[str, ...]
    session_ns: "np.ndarray[tuple[int], np.dtype[np.int64]]"
    module_ns: "np.ndarray[tuple[int, int], np.dtype[np.int64]]"
    q_rad: Array
    tau_measured_nm: Array
    tau_predicted_nm: Array
    error: TorqueError


class Identified(NamedTuple):
    """Everything that follows from a recording; calibrations: what it and earlier ones tell of the IMUs."""

    kinematics: Kinematics
    inertia: Inertia | None
    bodies: RobotBodies | None
    held_out: HeldOutMotion | None
    result: Result
    calibrations: tuple[CalibrationInformation, ...]

    @property
    def real_phi(self) -> Array | None:
        """The inertial parameters for URDF and HRDF: of physically consistent bodies if there are any."""
        if self.bodies is not None and self.bodies.fit is not None:
            return self.bodies.fit.phi
        return self.inertia.instrumental.fit.phi if self.inertia is not None else None
