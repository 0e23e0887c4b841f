"""What is wrong with a sensor, or a held joint: serial, kind of sickness, where it shows, and how surely."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from coordinator.recording.journal import Purpose
from module_agent.model.errors import EXIT_SUSPECT, DataError

# The sensor and what is wrong with it, for programs; sentences are for people.
Sickness = Literal[
    "gyro_stuck",
    "gyro_saturated",
    "gyro_contradicts",
    "accelerometer_stuck",
    "accelerometer_saturated",
    "accelerometer_contradicts",
    "imu_place",
    "imu_error",
    "encoder_stuck",
    "encoder_jump",
    "encoder_sign",
    "encoder_scale",
    "encoders_exchanged",
    "effort_sign",
    "effort_stuck",
    "joint_gives",
    "joint_halted",
    "clock_jump",
    "type_mislabelled",
    "not_finite",
    "messages_missing",
]

# With one of these, if it is serious, nothing of a module can be used for the chain.
UNUSABLE: frozenset[Sickness] = frozenset(
    {
        "gyro_stuck",
        "gyro_saturated",
        "gyro_contradicts",
        "accelerometer_stuck",
        "accelerometer_saturated",
        "accelerometer_contradicts",
        "encoder_stuck",
        "encoder_jump",
        "clock_jump",
        "messages_missing",
    }
)


def motion_of(purpose: Purpose) -> str:
    """Return what a finding calls a joint's own motion of a purpose."""
    return f"its {purpose} motion"


class Finding(NamedTuple):
    """A sensor that contradicts its catalogue or the others, or a joint that lets them seem to.

    motion: those in which it shows. measured, expected: in `unit`. sigmas: how far apart they are. remedy:
    what to check, as a phrase. kind: its sickness. serious: no claim is to be believed as usual, since the
    sensor is sick beyond doubt, or what is estimated in its place moves the robot by more than the claim.
    """

    serial: str
    motion: str
    what: str
    measured: float
    expected: float
    sigmas: float
    unit: str
    remedy: str
    kind: Sickness
    serious: bool = False

    @property
    def summary(self) -> str:
        """The finding as a sentence."""
        unit = f" {self.unit}" if self.unit else ""
        text = (
            f"{self.serial}: {self.what} is {self.measured:.4g}{unit} in {self.motion}, "
            f"{self.expected:.4g}{unit} is expected ({self.sigmas:.0f} sigmas apart)"
        )
        return f"{text}: {self.remedy}" if self.remedy else text


class SensorError(DataError):
    """Sensors whose readings cannot be used as they are; the message names them, and so do the findings."""

    exit_code = EXIT_SUSPECT

    def __init__(self, text: str, findings: Sequence[Finding] = ()):
        super().__init__(text)
        self.findings = tuple(findings)
