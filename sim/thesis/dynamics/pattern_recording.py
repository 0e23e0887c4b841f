"""The dynamic pattern of table 6 on the thesis' arm: recordings, and what is identified from each of them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict

from module_agent.model.catalogue import module_type
from module_agent.model.chain import Array
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import DynamicPattern, GoTo, Pattern, Rest, WindowedSine
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_inertia
from sim.test_bench.robot_bench import BenchRobot
from sim.thesis.dynamics.joint_identification import (
    MARGIN_NS,
    JointFit,
    JointModel,
    TorqueComparison,
    compare_torques,
    identify_joint,
    joint_model,
)
from sim.thesis.dynamics.load_identification import (
    JointSamples,
    LoadFit,
    accelerations,
    identify_load,
    identify_load_by_six_rows,
    moment_rows,
)
from sim.thesis.published import DYNAMIC_LENGTH_MM, DYNAMIC_MOTION, Alignment, thesis_length

Values = tuple[float, ...]

_JOINT = 0
_REST_S = 2.0
_SETTLE_S = 1.0
_TRAVEL_RAD_S = 1.0


class _Data(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Torques(_Data):
    """A motion with its torque, as read and as calculated: (n,) each."""

    t_s: Values
    position_command_rad: Values
    position_rad: Values
    velocity_command_rad_s: Values
    velocity_rad_s: Values
    acceleration_rad_s2: Values
    measured_nm: Values
    calculated_nm: Values


class OurTorques(_Data):
    """The torque that the coordinator's estimator calculates for a motion, (n,) each."""

    t_s: Values
    calculated_nm: Values


class Estimate(_Data):
    """Inertial parameters (10,), and the sum of the squared torque errors [Nm^2].

    relative_error: rms of the error over that of the torque about its mean.
    """

    phi: Values
    squared_error_nm2: float
    relative_error: float


class PatternRun(_Data):
    """What one amplitude gives.

    thesis: gravity at rest in the frame (section 5.1). turning: gravity turns against the link. unfiltered:
    the acceleration not filtered. six_rows: all six rows of eq. 25. ours: the coordinator's estimator;
    our_sigma: (10,) its standard deviations, of the noise alone.
    """

    amplitude_rad: float
    torques: Torques
    thesis: Estimate
    turning: Estimate
    unfiltered: Estimate
    six_rows: Estimate
    ours: Estimate
    our_sigma: Values
    our_torques: OurTorques


class CheckRun(_Data):
    """A motion that nothing was fitted to, with torques calculated by another one's parameters."""

    torques: Torques
    relative_error: float
    our_torques: OurTorques
    our_relative_error: float


class PatternSeries(_Data):
    """All amplitudes on one arm.

    truth: (10,) all that the joint carries, as built. force_m_s2: specific force of rest. whole: the windowed
    sine of table 6, once. usual: that of table 3. Both have torques by the parameters of the amplitude
    that the thesis chose.
    """

    truth: Values
    force_m_s2: Values
    runs: tuple[PatternRun, ...]
    whole: CheckRun
    usual: CheckRun


def pattern_series(
    alignment: Alignment, amplitudes_rad: tuple[float, ...], chosen_rad: float, noise: NoiseChoice, seed: int
) -> PatternSeries:
    """Play the dynamic pattern at some amplitudes, and both windowed sines, on a new arm of 484 mm.

    Args:
        alignment: of the arm. amplitudes_rad: of the pattern. chosen_rad: the one among them whose parameters
            the torques of the windowed sines are calculated with.
        noise: of the modules. seed: of the modules and their noise.

    Raises:
        ExperimentFailed: a module refused a motion or broke it off.
        DataError: too little motion.
    """
    robot = load_robot(f"thesis_{DYNAMIC_LENGTH_MM}_{alignment}")
    with BenchRobot(robot, seed, noise.of(robot)) as bench:
        arm = _Arm(bench)
        played = [_play(arm, each) for each in amplitudes_rad]
        chosen = played[amplitudes_rad.index(chosen_rad)]
        table_6 = WindowedSine(amplitude=chosen_rad, **DYNAMIC_MOTION._asdict())
        table_3 = WindowedSine(amplitude=thesis_length(alignment, DYNAMIC_LENGTH_MM).amplitude_rad)
        whole, usual = (_checked(arm, motion, chosen) for motion in (table_6, table_3))
        truth = true_inertia(bench.world.robot).sum(axis=0)
    return PatternSeries(
        truth=_values(truth),
        force_m_s2=_values(arm.force_m_s2),
        runs=tuple(one.run for one in played),
        whole=whole,
        usual=usual,
    )


def dynamic_pattern(amplitude_rad: float) -> DynamicPattern:
    """Return the pattern of table 6 and figure 44: the window's steep part, 1 s long, four times."""
    return DynamicPattern(
        amplitude_rad=amplitude_rad, frequency_hz=DYNAMIC_MOTION.frequency_hz, sigma_s=DYNAMIC_MOTION.sigma_s
    )


class _Arm:
    """The arm at q = 0, and what is known of it from its rest there."""

    def __init__(self, bench: BenchRobot):
        self._bench = bench
        self._module = bench.modules[_JOINT]
        serial = self._module.serial
        self._go()
        bench.run({serial: Rest(duration_s=_REST_S)})
        rest = self._since(self._module.now_ns - round(_REST_S * 1e9))
        kind = module_type(bench.world.robot.modules[_JOINT].type)
        self.model: JointModel = joint_model(kind, serial, rest)

    @property
    def force_m_s2(self) -> Array:
        """The specific force of rest (3,) as the module's accelerometer reads it."""
        return self.model.chain.gravity

    def play(self, pattern: Pattern) -> tuple[Rows, Rows]:
        """Return the rows of a motion from q = 0, and those with margins either side."""
        self._go()
        record = self._bench.run({self._module.serial: pattern})[0]
        self._bench.wait(2e-9 * MARGIN_NS)
        assert record.end_row is not None
        own = self._module.rows(record.start_row, record.end_row)
        return own, self._since(int(own["t_ns"][0]) - MARGIN_NS, int(own["t_ns"][-1]) + MARGIN_NS)

    def _go(self) -> None:
        self._bench.run({self._module.serial: GoTo(target_rad=0.0, max_speed_rad_s=_TRAVEL_RAD_S)})
        self._bench.wait(_SETTLE_S)

    def _since(self, start_ns: int, end_ns: int | None = None) -> Rows:
        end = self._module.now_ns if end_ns is None else end_ns
        return self._module.firmware.history.between(start_ns, end)


class _Played(NamedTuple):
    """A run, and what was identified from it by the thesis' method and ours."""

    run: PatternRun
    thesis: LoadFit
    ours: JointFit


def _play(arm: _Arm, amplitude_rad: float) -> _Played:
    rows, wide = arm.play(dynamic_pattern(amplitude_rad))
    samples, force = joint_samples(rows), arm.force_m_s2
    thesis, ours = identify_load(samples, force), identify_joint(arm.model, wide)
    own = _during(rows, compare_torques(arm.model, ours, wide))
    others = {
        "thesis": thesis,
        "turning": identify_load(samples, force, "with the link"),
        "unfiltered": identify_load(samples, force, filtered=False),
        "six_rows": identify_load_by_six_rows(samples, force),
    }
    run = PatternRun(
        amplitude_rad=amplitude_rad,
        torques=_torques(rows, samples, thesis.calculated_nm),
        **{name: _estimate(one.phi, one.calculated_nm, samples.tau_nm) for name, one in others.items()},
        ours=_estimate(ours.phi, own.calculated_nm, own.measured_nm),
        our_sigma=_values(ours.sigma),
        our_torques=_our_torques(rows, own),
    )
    return _Played(run, thesis, ours)


def _checked(arm: _Arm, pattern: Pattern, chosen: _Played) -> CheckRun:
    rows, wide = arm.play(pattern)
    samples = joint_samples(rows)
    calculated = moment_rows(samples, arm.force_m_s2) @ chosen.thesis.phi
    own = _during(rows, compare_torques(arm.model, chosen.ours, wide))
    return CheckRun(
        torques=_torques(rows, samples, calculated),
        relative_error=_relative(calculated - samples.tau_nm, samples.tau_nm),
        our_torques=_our_torques(rows, own),
        our_relative_error=_relative(own.calculated_nm - own.measured_nm, own.measured_nm),
    )


def _during(rows: Rows, compared: TorqueComparison) -> TorqueComparison:
    """Return what is between the first and the last of some rows."""
    begin_ns, end_ns = rows["t_ns"][[0, -1]]
    kept = (compared.t_ns >= begin_ns) & (compared.t_ns <= end_ns)
    return TorqueComparison(*(signal[kept] for signal in compared))


def _our_torques(rows: Rows, own: TorqueComparison) -> OurTorques:
    t_s = 1e-9 * (own.t_ns - rows["t_ns"][0])
    return OurTorques(t_s=_values(t_s), calculated_nm=_values(own.calculated_nm))


def joint_samples(rows: Rows) -> JointSamples:
    """Return a joint's samples from its rows."""
    t_s = 1e-9 * (rows["t_ns"] - rows["t_ns"][0]).astype(float)
    return JointSamples(
        t_s, *(rows[name].astype(float) for name in ("position_rad", "velocity_rad_s", "effort_nm"))
    )


def _torques(rows: Rows, samples: JointSamples, calculated_nm: Array) -> Torques:
    return Torques(
        t_s=_values(samples.t_s),
        position_command_rad=_values(np.nan_to_num(rows["position_command_rad"])),
        position_rad=_values(samples.q_rad),
        velocity_command_rad_s=_values(np.nan_to_num(rows["velocity_command_rad_s"])),
        velocity_rad_s=_values(samples.qd_rad_s),
        acceleration_rad_s2=_values(accelerations(samples)),
        measured_nm=_values(samples.tau_nm),
        calculated_nm=_values(calculated_nm),
    )


def _estimate(phi: Array, calculated_nm: Array, measured_nm: Array) -> Estimate:
    error = calculated_nm - measured_nm
    return Estimate(
        phi=_values(phi),
        squared_error_nm2=float(error @ error),
        relative_error=_relative(error, measured_nm),
    )


def _relative(error_nm: Array, measured_nm: Array) -> float:
    return float(np.sqrt(np.mean(error_nm**2)) / measured_nm.std())


def _values(signal: Array | Sequence[float]) -> Values:
    # What JSON holds of a signal: six digits are finer than any sensor's step.
    return tuple(round(float(value), 6) for value in np.asarray(signal))
