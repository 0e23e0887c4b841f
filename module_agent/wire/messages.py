"""The messages on the wire, as frozen models; `codec` turns them into bytes and back.

Times are integer nanoseconds of the module's own monotonic clock. A message from an agent carries the agent's
boot id; a command carries the boot id of the module it is meant for, so that it dies with that boot.
Unknown fields are ignored; another schema version is refused by name.
"""

from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

SCHEMA_VERSION = 1
# The type of `out_of_range`; pydantic has none of this name.
OUT_OF_RANGE: Final = "out_of_range"

Nanoseconds = Annotated[int, Field(ge=0, lt=2**63)]
Counter = Annotated[int, Field(ge=0, lt=2**63)]
MAX_NAME = 64
Name = Annotated[str, Field(max_length=MAX_NAME)]
# One that stands for a module in a key: with any other no module could be asked.
Serial = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,63}$")]
# Of texts in bytes, which is what a reader bounds.
MAX_TEXT_BYTES = 512
Text = Annotated[str, Field(max_length=MAX_TEXT_BYTES)]
Finite = Annotated[float, Field(ge=-1e6, le=1e6)]
Positive = Annotated[float, Field(gt=0.0, le=1e6)]
Vector3 = tuple[Finite, Finite, Finite]

# Of a module in one motion: 400 s at 250 Hz.
MAX_ROWS_PER_MOTION = 100_000
# Of one feedback message.
MAX_BATCH_ROWS, MAX_ROWS_BYTES = 512, 65536

State = Literal["idle", "armed", "moving", "streaming", "expired", "stopped", "fault"]
ExpiryAction = Literal["motor_off", "hold", "damping"]


# Frozen models have no other way in.
_set = object.__setattr__


class Part(BaseModel):
    """A piece of a message."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False, strict=True)


class Message(Part):
    """What every message carries."""

    v: int = SCHEMA_VERSION
    serial: Name
    boot: Annotated[int, Field(ge=0, lt=2**64)]
    seq: Counter


def cut(text: str) -> str:
    """Return a text without what is too long for a message: characters may have several bytes."""
    return text.encode(errors="replace")[:MAX_TEXT_BYTES].decode(errors="ignore")


def out_of_range(detail: str) -> PydanticCustomError:
    """Return the error of fields that contradict each other, which `codec` reports as one of range."""
    return PydanticCustomError(OUT_OF_RANGE, "{detail}", {"detail": detail})


class Rest(Part):
    """Hold the present set position."""

    kind: Literal["rest"] = "rest"
    duration_s: Annotated[float, Field(gt=0.0, le=60.0)]


class GoTo(Part):
    """Move to a position on a minimum-jerk path at no more than the given speed."""

    kind: Literal["goto"] = "goto"
    target_rad: Finite
    max_speed_rad_s: Positive


class ConstantMotion(Part):
    """The thesis' CM (eq. 13): constant velocity for a time, with ramps of `ramp_s` before and after it."""

    kind: Literal["constant"] = "constant"
    velocity_rad_s: Finite
    duration_s: Annotated[float, Field(gt=0.0, le=60.0)]
    ramp_s: Annotated[float, Field(ge=0.0, le=2.0)] = 0.15


class WindowedSine(Part):
    """The thesis' WSM (eq. 14): exp(-(t - Tm)^2 / (2 Ts^2)) * A sin(2 pi f t), tapered to exactly zero.

    `of` says whether the amplitude is of position [rad] or of velocity [rad/s]. The motion lasts 2 Tm.
    """

    kind: Literal["windowed_sine"] = "windowed_sine"
    amplitude: Positive
    of: Literal["position", "velocity"] = "position"
    frequency_hz: Annotated[float, Field(gt=0.0, le=50.0)] = 2.0
    centre_s: Annotated[float, Field(gt=0.0, le=30.0)] = 2.8
    sigma_s: Annotated[float, Field(gt=0.0, le=30.0)] = 1.0


class DynamicPattern(Part):
    """The thesis' dynamic pattern (table 6, figure 44): the steep part of a WSM, cut out and repeated.

    One period is q = A exp(-s^2 / (2 Ts^2)) sin(2 pi f s) for s in +-`half_width_s`, which begins and ends
    at rest but for the taper; it is repeated `repeats` times, every second time mirrored when `alternate`
    is set.
    """

    kind: Literal["dynamic"] = "dynamic"
    amplitude_rad: Positive
    frequency_hz: Annotated[float, Field(gt=0.0, le=50.0)] = 1.0
    sigma_s: Annotated[float, Field(gt=0.0, le=30.0)] = 0.1
    half_width_s: Annotated[float, Field(gt=0.0, le=10.0)] = 0.5
    repeats: Annotated[int, Field(ge=1, le=50)] = 4
    alternate: bool = False


class Sine(Part):
    """One part of a `MultiSine`: A sin(2 pi f t) of position."""

    amplitude_rad: Positive
    frequency_hz: Annotated[float, Field(gt=0.0, le=50.0)]


class MultiSine(Part):
    """Several sines at once: w(t) sum of A_i sin(2 pi f_i t), with w tapered to exactly zero at both ends."""

    kind: Literal["multi_sine"] = "multi_sine"
    sines: Annotated[tuple[Sine, ...], Field(min_length=1, max_length=8)]
    duration_s: Annotated[float, Field(gt=0.0, le=60.0)]


Pattern = Annotated[
    Rest | GoTo | ConstantMotion | WindowedSine | DynamicPattern | MultiSine, Field(discriminator="kind")
]


class OtherMotion(Part):
    """A motion that another program has commanded: it is known by its rows alone, and no module runs it."""

    kind: Literal["other"] = "other"


# The motions that all modules estimate from.
EXPLORATION_KINDS = ("constant", "windowed_sine")


class EffortProfile(Part):
    """The effort that a motion is fed forward: torques of the spring [Nm], at equal times from its start.

    `samples` are `period_ns` apart, little-endian 4-byte floats, 2 to 800 of them; the module interpolates
    linearly. After the last one the effort stays as that says.
    """

    period_ns: Annotated[int, Field(ge=1_000_000, le=1_000_000_000)]
    samples: Annotated[bytes, Field(min_length=8, max_length=3200)]


class PidGains(Part):
    """One loop's parameters, with the manufacturer's meanings (see `control.pid`)."""

    kp: Finite
    ki: Finite = 0.0
    kd: Finite = 0.0
    feed_forward: Finite = 0.0
    dead_zone: Annotated[float, Field(ge=0.0, le=1e6)] = 0.0
    i_clamp: Annotated[float, Field(ge=0.0, le=1e6)] = 0.25
    punch: Annotated[float, Field(ge=0.0, le=1e6)] = 0.0
    min_target: Finite = -1e6
    max_target: Finite = 1e6
    target_lowpass: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    min_output: Finite = -1.0
    max_output: Finite = 1.0
    output_lowpass: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    d_on_error: bool = True


class GainSet(Part):
    """A control strategy and its three loops."""

    strategy: Annotated[int, Field(ge=0, le=4)]
    position: PidGains
    velocity: PidGains
    effort: PidGains


class MotionRecord(Part):
    """A motion as the module ran it; rows are feedback rows, `end_row` is one past the last.

    One that is done has ended at a row.
    """

    motion_id: Counter
    pattern: Annotated[Pattern | OtherMotion, Field(discriminator="kind")]
    outcome: Literal["running", "done", "superseded", "stopped", "expired", "fault"]
    start_ns: Nanoseconds
    start_row: Counter
    end_row: Counter | None
    origin_rad: Finite

    @model_validator(mode="after")
    def _check_length(self) -> Self:
        if self.outcome == "done" and self.end_row is None:
            raise out_of_range(f"motion {self.motion_id} is done and has no last row")
        if self.end_row is not None and not 0 <= self.end_row - self.start_row <= MAX_ROWS_PER_MOTION:
            raise out_of_range(
                f"motion {self.motion_id} of rows {self.start_row} to {self.end_row}: a motion has at most "
                f"{MAX_ROWS_PER_MOTION}"
            )
        return self


class Limits(Part):
    """What the module does not exceed: its type's limits, or narrower ones that its owner has configured.

    Positions beyond them are refused; speed and effort are clamped, configured ones by the module itself.
    """

    max_speed_rad_s: Positive
    max_effort_nm: Positive
    min_position_rad: Finite | None
    max_position_rad: Finite | None


class Info(Message):
    """Type, limits, gains and rates of a module. Answer to an `Ask` on `info`.

    Its user gives a module its name, and the same family to all of one robot.
    """

    module_type: Name
    firmware: Name
    feedback_rate_hz: Positive
    batch_rows: Annotated[int, Field(ge=1, le=64)]
    history_rows: Counter
    tick_ns: Nanoseconds
    imu_period_ns: Nanoseconds
    lifetime_ns: Nanoseconds
    expiry_action: ExpiryAction
    limits: Limits
    gains: GainSet
    t_ns: Nanoseconds
    name: Name = ""
    family: Name = ""


class Feedback(Message):
    """A run of consecutive feedback rows, `first_row` first: one block of `feedback_rows.ROW` records.

    Published on `feedback`; also the answer to a `HistoryRequest`.
    """

    first_row: Counter
    count: Annotated[int, Field(ge=0, le=MAX_BATCH_ROWS)]
    rows: Annotated[bytes, Field(max_length=MAX_ROWS_BYTES)]

    @classmethod
    def checked(cls, fields: dict[str, Any]) -> Self:
        """Return the message with these fields, which the caller has checked: all of them, and no others.

        `model_construct` does the same in twice the time of all other decoding.
        """
        message = cls.__new__(cls)
        _set(message, "__dict__", fields)
        _set(message, "__pydantic_fields_set__", _FEEDBACK_FIELDS)
        _set(message, "__pydantic_extra__", None)
        _set(message, "__pydantic_private__", None)
        return message


_FEEDBACK_FIELDS = set(Feedback.model_fields)


class Status(Message):
    """The state of a module. Published on `status` at every change and twice a second at least, and on `Ask`.

    While an exploration motion runs, and for some seconds after it, the same is published on `motion`, for
    the other modules.

    `re` is the sequence number of the question that this answers, 0 when published. `limits` are the limits
    that have bounded the motor's PWM since the last published one, such as "position" (see `LimitState`).
    """

    re: Counter = 0
    t_ns: Nanoseconds
    state: State
    holder: Name | None
    lease_left_ns: Nanoseconds
    token: Counter
    next_row: Counter
    motion: MotionRecord | None
    refusals: dict[Name, Counter]
    expiries: Counter
    dropped_events: Counter
    limits: Annotated[tuple[Name, ...], Field(max_length=8)] = ()
    note: Text = ""


class CircleEstimate(Part):
    """A circle point analysis of one joint in one IMU's frame, with its quality figures.

    `axis` is the direction about which the IMU's body turns when the joint's position grows; `radial_m`
    points from the joint's axis to the IMU; `sigma_*` are one standard deviation.
    """

    axis: Vector3
    tangent: Vector3
    radial_m: Vector3
    distance_m: Finite
    sigma_axis_rad: Annotated[float, Field(ge=0.0, le=10.0)]
    sigma_distance_m: Annotated[float, Field(ge=0.0, le=1e3)]
    residual_rms_m_s2: Annotated[float, Field(ge=0.0, le=1e6)]
    singular_values: Vector3
    delay_s: Finite
    samples: Counter


class RegressionEstimate(Part):
    """A joint regression of one joint in one IMU's frame (`estimate.joint_regression`).

    `axis`, `radial_m` and `sigma_*` mean what they mean in a `CircleEstimate`; `covariance` is the upper
    triangle, row by row, of that of axis and radial vector (6 x 6, in the IMU's frame). `gravity_m_s2` is the
    specific force of rest with the joint at zero. A motion of frequency f turns the IMU by
    `compliance_s2` (2 pi f)^2 more than the encoder says. `delay_s` is that of the IMU's samples beyond the
    rough mapping of the clocks, in the last motion. `base_shakes`: the shake of the joint's base was measured
    by the joint's own module, and subtracted.
    """

    axis: Vector3
    radial_m: Vector3
    distance_m: Finite
    sigma_axis_rad: Annotated[float, Field(ge=0.0, le=10.0)]
    sigma_distance_m: Annotated[float, Field(ge=0.0, le=1e3)]
    covariance: Annotated[tuple[Finite, ...], Field(min_length=21, max_length=21)]
    gravity_m_s2: Vector3
    gyro_bias_rad_s: Vector3
    accel_bias_m_s2: Vector3
    compliance_s2: Finite
    delay_s: Finite
    base_shakes: bool
    samples: Counter


class Estimate(Message):
    """The estimate of this module (`serial`) from the motion of one joint (`joint`). Published on `estimate`.

    `circle` is the thesis' estimator, `regression` the one that reaches the sensors' limit.
    """

    joint: Name
    motion_ids: Annotated[tuple[Counter, ...], Field(min_length=1, max_length=16)]
    moved: bool
    rate_ratio: Annotated[float, Field(ge=0.0, le=1e6)]
    gravity_m_s2: Vector3
    circle: CircleEstimate | None
    regression: RegressionEstimate | None = None
    note: Text = ""

    @property
    def best(self) -> RegressionEstimate | CircleEstimate | None:
        """The regression, or where there is none the circle point analysis."""
        return self.circle if self.regression is None else self.regression


class Ack(Message):
    """The answer to a command, whose sequence number is `re`."""

    re: Counter
    accepted: bool
    reason: Name = ""
    detail: Text = ""
    t_ns: Nanoseconds
    holder: Name | None
    lease_left_ns: Nanoseconds
    token: Counter


class Ask(Message):
    """A question that takes no argument, on `info` and `status` (`boot` 0 = any)."""

    sender: Name


class EstimateRequest(Message):
    """Ask for this module's estimate from the latest motion of `joint`."""

    sender: Name
    joint: Serial


class HistoryRequest(Message):
    """Ask for feedback rows `first_row` up to and without `end_row`, all at once up to 256."""

    sender: Name
    first_row: Counter
    end_row: Counter


class LeaseRequest(Message):
    """Acquire (which arms), renew (the keep-alive of a motion) or release the command of a joint.

    A sender that acquires with a `secret` must end every later command with its proof (see `proof`).
    """

    sender: Name
    action: Literal["acquire", "renew", "release"]
    token: Counter
    echo_ns: Nanoseconds
    duration_ns: Annotated[int, Field(gt=0, le=10_000_000_000)] = 1_000_000_000
    secret: Annotated[bytes, Field(max_length=32)] = b""


class MotionCommand(Message):
    """Start a motion that runs on the module. The same `motion_id` again is the same command.

    Without an `effort` the effort loop is off, as with a `Setpoint` that leaves it unset.
    """

    sender: Name
    token: Counter
    echo_ns: Nanoseconds
    motion_id: Annotated[int, Field(gt=0, lt=2**32)]
    pattern: Pattern
    effort: EffortProfile | None = None


class Setpoint(Message):
    """One streamed setpoint; an unset value disables its loop."""

    sender: Name
    token: Counter
    echo_ns: Nanoseconds
    position_rad: Finite | None
    velocity_rad_s: Finite | None
    effort_nm: Finite | None


class Stop(Message):
    """Stop at once. Needs no lease; holds until the lease is acquired again."""

    sender: Name
    why: Text = ""


class GainsCommand(Message):
    """Replace the gains; needs the lease and no motion. The gains in force are part of `Info`.

    They end with the lease, or with the boot if the module is to `keep` them.
    """

    sender: Name
    token: Counter
    echo_ns: Nanoseconds
    gains: GainSet
    keep: bool = False


class Identify(Message):
    """Show by its LED which module this is, or show it no longer. Needs no lease."""

    sender: Name
    on: bool


# What the holder of a lease sends: checked for lease, proof, sequence and age.
COMMANDS = (LeaseRequest, MotionCommand, Setpoint, GainsCommand)
