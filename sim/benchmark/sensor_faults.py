"""Sick sensors and soft links: the claim covers every link, or what is wrong is named.

A session of a healthy robot is recorded, and then what one module sends is altered; links, rates of IMUs and
the robot itself are altered before.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.estimator import with_placement
from coordinator.excitation.plan import Plan
from coordinator.identification.identified import Kinematics
from coordinator.identification.identify import identify_kinematics
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import Entry, Recording
from module_agent.model.catalogue import CATALOGUE, ModuleType
from module_agent.model.chain import Chain
from module_agent.model.errors import RobotError
from module_agent.network_emulation.profile_file import network
from module_agent.wire.messages import Message
from sim.benchmark.case import Case, Summary, Trial, trial_seeds
from sim.benchmark.cases.arm import KNOWN, SHORTENED, arm_plan
from sim.benchmark.row import Row, count, coverage
from sim.benchmark.sick_recordings import (
    COMMANDS,
    POSITION,
    Alteration,
    dead,
    exchanged,
    jumped,
    leaping_clock,
    mislabelled,
    multiplied,
    not_a_number,
    saturated,
    silent,
    stuck,
    with_hole,
)
from sim.imperfections.noise_profile import noise_profile
from sim.robot.robot_file import Flex, Robot, load_robot
from sim.robot.robot_tree import true_chain
from sim.robot.variants import as_built, at_random_site
from sim.scoring.chain_score import link_errors
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session

ROBOT, NOISE = "a2085_03", "x5"
SCALE = 1.01
# A sensor's range as a share of its largest reading; a jump of an encoder, of 3 deg.
CLIPPED, JUMP_RAD = 0.6, 0.05
# Beyond this is one interval in a thousand by chance.
WRONG_ABOVE = 3.29
# Damping of links of 1 Nm/rad; it grows with the root of the stiffness. 2 % of the critical one at 5 Hz and
# 100 Nm/rad, as of tubes.
_DAMPING = 0.013
_COST_S, _SMALL_COST_S = 15.0, 2.0
# As many intervals make a row of their own: of fewer, one that does not cover would be a miss.
_OWN_COVERAGE = 20


class FaultTrial(NamedTuple):
    """The result of one robot with a fault.

    named: a finding or the refusal names a module that the fault concerns. others: serials of findings on
    other modules. sigmas_off: |error| / claimed sigma of every link's length; empty if it was refused.
    """

    named: bool
    others: tuple[str, ...]
    sigmas_off: tuple[float, ...]
    text: str

    @property
    def silent(self) -> bool:
        """Whether a link is wrong and nothing is named."""
        return not self.named and max(self.sigmas_off, default=np.inf) > WRONG_ABOVE


class Fault(NamedTuple):
    """What is wrong: with the links [Nm/rad], the rate of the IMUs [Hz], or a recording of some serials.

    alter: entries, serials that the fault concerns and the first module row of a fast motion, to entries.
    concerns: how many modules, drawn by the seed; 0 for all.
    """

    stiffness_nm_rad: float = 0.0
    imu_rate_hz: float = 250.0
    alter: Alteration | None = None
    concerns: int = 0


class KeptRecording(Recording):
    """A recording that keeps what it is made of."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[Entry] = []

    def add(self, entry: Entry) -> Message | JournalEvent:
        """Add one entry and keep it."""
        self.entries.append(entry)
        return super().add(entry)


def fault_trial(fault: str, seed: int, plan: Plan) -> FaultTrial:
    """Record the robot of a seed, identify it with a fault, and compare links and findings with the truth."""
    this = FAULTS[fault]
    robot = _robot(seed, this.stiffness_nm_rad)
    drawn = np.random.default_rng(seed).permutation(len(robot.serials))[: this.concerns or None]
    ill = tuple(robot.serials[k] for k in sorted(drawn.tolist()))
    try:
        recording = _recorded(seed, plan, this.stiffness_nm_rad, this.imu_rate_hz)
        altered = _altered(recording, this, ill)
        kinematics = identify_kinematics(altered)
    except RobotError as error:
        return FaultTrial(any(serial in str(error) for serial in ill), (), (), str(error))
    named = [finding.serial for finding in kinematics.findings]
    text = "; ".join(finding.summary for finding in kinematics.findings)
    others = tuple(serial for serial in named if serial not in ill)
    return FaultTrial(any(s in ill for s in named), others, _sigmas_off(robot, kinematics, altered), text)


def _robot(seed: int, stiffness_nm_rad: float) -> Robot:
    robot = at_random_site(as_built(load_robot(ROBOT), seed, noise_profile(NOISE)), seed)
    return softened(robot, stiffness_nm_rad) if stiffness_nm_rad else robot


@lru_cache(maxsize=1)
def _recorded(seed: int, plan: Plan, stiffness_nm_rad: float, imu_rate_hz: float) -> KeptRecording:
    """Record a session; the faults that alter recordings have the same one."""
    robot, profile = _robot(seed, stiffness_nm_rad), noise_profile(NOISE)
    settings = VirtualSettings(robot, network("lan"), seed, profile, imu_rate_hz=imu_rate_hz)
    recording = KeptRecording()
    record_session(settings, plan, recording=recording)
    return recording


def _sigmas_off(robot: Robot, kinematics: Kinematics, recording: Recording) -> tuple[float, ...]:
    truth, fit, off = true_chain(robot), kinematics.fit, []
    reported = {serial: recording.module_type(serial) for serial in fit.chain.serials}
    built = {module.serial: CATALOGUE[module.type] for module in robot.modules}
    chain = relabelled(fit.chain, reported, built)
    # Of a robot without a module the links of the others to each other count.
    for child in [
        child
        for child, parent in enumerate(truth.parent)
        if parent >= 0 and not {truth.serials[child], truth.serials[parent]} & set(kinematics.excluded)
    ]:
        errors = link_errors(chain, truth, child)
        own = fit.chain.serials.index(truth.serials[child])
        sigma_m = float(fit.link_length_sigma_m[own])
        # A length of which the result says nothing counts as one that it says wrongly.
        off.append(np.inf if errors is None or np.isinf(sigma_m) else abs(errors.length_m) / sigma_m)
    return tuple(off)


def relabelled(chain: Chain, reported: Mapping[str, ModuleType], built: Mapping[str, ModuleType]) -> Chain:
    """Return a chain of modules of the reported types as one of the types that they are, housings in place.

    An IMU stands for the housing around it, and in that of another type it is elsewhere.
    """
    away = [np.subtract(built[serial].imu_xyz, reported[serial].imu_xyz) for serial in chain.serials]
    return with_placement(chain, np.pad(away, ((0, 0), (3, 0))))


def softened(robot: Robot, stiffness_nm_rad: float) -> Robot:
    """Return the robot with links that give at their beginning, about all three axes alike."""
    damping = _DAMPING * stiffness_nm_rad**0.5
    flex = Flex(stiffness_nm_rad=(stiffness_nm_rad,) * 3, damping_nm_s_rad=(damping,) * 3)
    modules = [m if m.parent == "base" else m.model_copy(update={"flex": flex}) for m in robot.modules]
    return robot.model_copy(update={"modules": tuple(modules)})


def _altered(recording: KeptRecording, fault: Fault, ill: tuple[str, ...]) -> Recording:
    if fault.alter is None:
        return recording
    (moved, *_) = [e for e in recording.latest_motions("windowed_sine") if e.serial in ill]
    assert moved.motion is not None
    assert moved.motion.end_row is not None
    # The middle of the motion, where it is fastest.
    middle = (moved.motion.start_row + moved.motion.end_row) // 2
    altered = Recording()
    for entry in fault.alter(recording.entries, ill, middle):
        altered.add(entry)
    return altered


FAULTS: Mapping[str, Fault] = {
    "none": Fault(),
    "a mislabelled type": Fault(alter=mislabelled, concerns=1),
    "two encoders exchanged": Fault(alter=exchanged, concerns=2),
    "an encoder against its command": Fault(alter=multiplied(POSITION, -1.0), concerns=1),
    "an encoder and commands of the wrong sign": Fault(
        alter=multiplied((*POSITION, *COMMANDS), -1.0), concerns=1
    ),
    "an encoder 1 % off in scale": Fault(alter=multiplied(POSITION, SCALE), concerns=1),
    **{f"links of {k} Nm/rad": Fault(stiffness_nm_rad=float(k)) for k in (100, 200, 400, 1000, 2000)},
    **{f"IMUs at {rate} Hz": Fault(imu_rate_hz=float(rate)) for rate in (50, 100, 500, 1000)},
    "a hole in a motion": Fault(alter=with_hole, concerns=1),
    **{
        f"a dead axis {'xyz'[axis]} of {name}": Fault(alter=dead(field, [axis]), concerns=1)
        for name, field in (("an accelerometer", "accel_m_s2"), ("a gyro", "gyro_rad_s"))
        for axis in range(3)
    },
    "a stuck IMU": Fault(alter=stuck("gyro_rad_s", "accel_m_s2"), concerns=1),
    "a saturated gyro": Fault(alter=saturated("gyro_rad_s", CLIPPED), concerns=1),
    "a saturated accelerometer": Fault(alter=saturated("accel_m_s2", CLIPPED), concerns=1),
    "a gyro 5 % off in scale": Fault(alter=multiplied(("gyro_rad_s",), 1.05), concerns=1),
    "an accelerometer 5 % off in scale": Fault(alter=multiplied(("accel_m_s2",), 1.05), concerns=1),
    "a stuck encoder": Fault(alter=stuck(*POSITION), concerns=1),
    "an encoder that jumps": Fault(alter=jumped("position_rad", JUMP_RAD), concerns=1),
    "a stuck torque sensor": Fault(alter=stuck("effort_nm"), concerns=1),
    "a clock that leaps ahead": Fault(alter=leaping_clock(500_000_000), concerns=1),
    "a clock that goes back": Fault(alter=leaping_clock(-300_000_000), concerns=1),
    "readings that are no numbers": Fault(alter=not_a_number("gyro_rad_s"), concerns=1),
    "a module without messages": Fault(alter=silent, concerns=1),
}
# Without a fault, and with one that does not hide the links: nothing may be named.
HARMLESS = tuple(name for name in FAULTS if name in ("none", "a hole in a motion") or "IMUs" in name)
QUICK = ("none", "an encoder against its command")


def _shares(fault: str, seed: int) -> str:
    """Return the name of the recording of a healthy robot; nothing where the robot itself is altered."""
    this = FAULTS[fault]
    own = this.stiffness_nm_rad or this.imu_rate_hz != Fault().imu_rate_hz
    return "" if own else f"healthy {ROBOT}, {seed}"


def fault_cases(
    trials: int, seed: int, faults: Sequence[str] = tuple(FAULTS), small: bool = False
) -> list[Case]:
    """Return one case for every fault, of the same robots; `small`: with motions that are cut short."""
    plan = arm_plan("joint", "calibrated")
    plan = plan.model_copy(update=SHORTENED) if small else plan
    cost_s = _SMALL_COST_S if small else _COST_S
    return [
        Case(
            f"sensor faults, {fault}",
            [
                Trial(fault_trial, (fault, own, plan), cost_s, _shares(fault, own))
                for own in trial_seeds(seed, "sensor faults", trials)
            ],
            partial(_summary, fault),
            NOISE,
            KNOWN["calibrated"],
        )
        for fault in faults
    ]


def _summary(fault: str, trials: Sequence[FaultTrial]) -> Summary:
    """Return the rows of a fault; intervals count where nothing is named."""
    unnamed = [trial for trial in trials if not trial.named]
    off = [value for trial in unnamed for value in trial.sigmas_off]
    rows = [count("wrong in silence", [trial.silent for trial in trials])]
    if fault in HARMLESS:
        rows.append(count("findings on healthy robots", [t.named or bool(t.others) for t in trials]))
    else:
        rows.append(Row(f"named, of {len(trials)}", float(len(trials) - len(unnamed))))
        rows.append(count("another module named", [bool(t.others) for t in trials]))
    # A few intervals count with those of all other cases only.
    return Summary([*rows, coverage(off)] if len(off) >= _OWN_COVERAGE else rows, off)
