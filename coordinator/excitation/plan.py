"""The settings of a session: which motions, how large, how long."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from module_agent.control.gains import default_gains
from module_agent.model.catalogue import ImuKind, ModuleType, TorqueKind
from module_agent.model.errors import UsageError
from module_agent.model.model_faults import faults_of
from module_agent.model.toml_location import fault_lines, read_toml
from module_agent.wire.messages import ConstantMotion, DynamicPattern, GainSet, WindowedSine

Mode = Literal["joint", "simultaneous"]
Motions = Literal["standard", "optimised"]
Excitation = Literal["joint-by-joint", "d-optimal"]
Seconds = Annotated[float, Field(gt=0.0, le=60.0)]


class Plan(BaseModel):
    """The settings of an identification run; defaults are the thesis' where the thesis has one."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    # One joint after the other, or all at once: shorter, but without the agents' own estimates.
    mode: Mode = "joint"
    # `standard`: the motions below for every joint. `optimised`: motions chosen by a joint's load and module
    # type (`excitation.single_joint`), and then one of all joints at once.
    motions: Motions = "standard"
    # Of designed motions: how long exploring a joint may take, journeys included; by their number if not set,
    # so that all of the session takes 10 s a joint.
    joint_s: Seconds | None = None
    # Of designed motions: fast ones are repeated until the predicted sigma of a radius is below this, or
    # until a further repetition would not lower it.
    precision_mm: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    # Of the motion of all joints at once; by their number if not set.
    simultaneous_duration_s: Seconds | None = None
    discover_s: Seconds = 1.0
    link_s: Seconds = 1.0
    home_rad: Annotated[float, Field(ge=-6.2832, le=6.2832)] = 0.0
    travel_speed_rad_s: Annotated[float, Field(gt=0.0, le=10.0)] = 1.0
    # Before anything else the robot goes home, and every joint a little to either side, no faster than this;
    # a joint that is blocked ends the session. None for no such trial.
    trial_speed_rad_s: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    settle_s: Seconds = 0.6
    rest_s: Seconds = 2.0
    # Thesis 6.2.1.1: from an offset of 0.5 rad at 1 rad/s for 0.75 s.
    constant_velocity_rad_s: Annotated[float, Field(gt=0.0, le=10.0)] = 1.0
    constant_duration_s: Seconds = 0.75
    # Thesis table 3, and amplitudes of tables 4 and 5.
    sine_amplitude_rad: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    sine_frequency_hz: Annotated[float, Field(gt=0.0, le=10.0)] = 2.0
    sine_centre_s: Seconds = 2.8
    sine_sigma_s: Seconds = 1.0
    # Thesis table 6 and figure 44.
    dynamic_amplitude_rad: Annotated[float, Field(gt=0.0, le=3.0)] | None = None
    dynamic_repeats: Annotated[int, Field(ge=1, le=20)] = 4
    # `joint-by-joint`: the dynamic pattern above. `d-optimal`: `excitation_motions` motions of all joints at
    # once, each `excitation_s` long, D-optimal for the inertial parameters, with no joint further than
    # `excitation_reach_rad` from home: the space around the robot must be free.
    excitation: Excitation = "joint-by-joint"
    excitation_motions: Annotated[int, Field(ge=2, le=50)] = 5
    excitation_s: Annotated[float, Field(ge=3.0, le=60.0)] = 6.0
    excitation_reach_rad: Annotated[float, Field(gt=0.0, le=1.2)] = 0.8
    dynamics: bool = True
    # The topology needs the slow motions only; the chain needs the fast ones, too.
    topology_only: bool = False
    # The prior of the modules' IMUs: `module_agent.model.imu_prior`.
    imu: ImuKind = "uncalibrated"
    # The prior of the scales of their torque sensors: `parameter_fit.torque_sensor_scale`.
    torque: TorqueKind = "uncalibrated"
    hold_stiffness: Annotated[float, Field(ge=1.0, le=20.0)] = 1.0
    retries: Annotated[int, Field(ge=0, le=5)] = 2

    def constant(self) -> ConstantMotion:
        """Return the thesis' constant motion."""
        return ConstantMotion(
            velocity_rad_s=self.constant_velocity_rad_s, duration_s=self.constant_duration_s
        )

    def sine(self, kind: ModuleType) -> WindowedSine:
        """Return the thesis' windowed sine motion, no faster than the module type can follow."""
        return WindowedSine(
            amplitude=self.sine_amplitude_rad or _amplitude(kind, self.sine_frequency_hz, 0.10),
            frequency_hz=self.sine_frequency_hz,
            centre_s=self.sine_centre_s,
            sigma_s=self.sine_sigma_s,
        )

    def dynamic(self, kind: ModuleType) -> DynamicPattern:
        """Return the thesis' dynamic pattern, wide enough to be followed."""
        return DynamicPattern(
            amplitude_rad=self.dynamic_amplitude_rad or _amplitude(kind, 0.7, 0.35),
            frequency_hz=0.7,
            sigma_s=0.5,
            half_width_s=1.0,
            repeats=self.dynamic_repeats,
            alternate=True,
        )

    def held_out(self, kind: ModuleType) -> DynamicPattern:
        """Return a motion that no parameter is fitted to: another frequency, amplitude and shape."""
        return DynamicPattern(
            amplitude_rad=_amplitude(kind, 1.0, 0.25),
            frequency_hz=1.0,
            sigma_s=0.35,
            half_width_s=0.8,
            repeats=2,
            alternate=False,
        )

    def exploring_gains(self, kind: ModuleType, strategy: int) -> GainSet:
        """Return the factory gains, the position loop `hold_stiffness` times as stiff."""
        factory = default_gains(kind, strategy)
        position = factory.position.model_copy(update={"kp": factory.position.kp * self.hold_stiffness})
        return factory.model_copy(update={"position": position})


def _amplitude(kind: ModuleType, frequency_hz: float, max_rad: float) -> float:
    """Return an amplitude whose peak speed is 70 % of the type's: back-EMF then leaves torque to spare."""
    return min(max_rad, 0.7 * kind.max_speed_rad_s / (6.2832 * frequency_hz))


def load_plan(path: Path) -> Plan:
    """Read a plan from a TOML file; what the file does not set keeps its default.

    Raises:
        UsageError: the file cannot be read, is not TOML, or sets nothing, something unknown or out of range.
    """
    table, text = read_toml(path)
    if not table:
        raise UsageError(f"{path} sets nothing; for the default plan give none")
    try:
        return Plan.model_validate(table)
    except ValidationError as error:
        known = f"unknown setting; known are {', '.join(Plan.model_fields)}"
        faults = [
            (location, reason if not location or location[0] in Plan.model_fields else known)
            for location, reason in faults_of(error)
        ]
        raise UsageError(fault_lines(faults, text, path)) from error
