"""Findings of the monitor: kind, place, time, size, certainty and a sentence; and the log of those held.

The log reports a finding once, again when it has changed by enough, and when it ends.
"""

from collections.abc import Iterable
from typing import Literal, NamedTuple

from pydantic import BaseModel, ConfigDict

Kind = Literal[
    "collision", "payload", "friction", "wear", "unexplained", "torque-sensor", "gyro", "accelerometer"
]
# By what each kind's size is measured.
UNITS: dict[Kind, str] = {
    "collision": "Nm",
    "payload": "kg",
    "friction": "%",
    "wear": "mm",
    "unexplained": "Nm",
    "torque-sensor": "Nm",
    "gyro": "mrad/s",
    "accelerometer": "m/s^2",
}
# A sensor of a module that reads other than it did.
IMU_SENSORS: tuple[Kind, ...] = ("gyro", "accelerometer")
SENSORS: tuple[Kind, ...] = ("torque-sensor", *IMU_SENSORS)
# What IMUs show, of which one at a time holds; torques have the rest.
STRUCTURAL: tuple[Kind, ...] = ("wear", *IMU_SENSORS)
KINDS = tuple(UNITS)

Key = tuple[str, str | int]
# The key of the one finding that IMUs show.
STRUCTURE: Key = ("structure", 0)


class Finding(BaseModel):
    """One detected change of the robot or contact with it.

    serial: the module: for a collision, the last joint whose torque crossed its level: the contact is on a
    body that this joint moves; for a payload, the joint that moves the loaded body; for friction, the drive;
    for wear, the module whose link to its parent changed; for a sensor, its module.
    since_ns, detected_ns, reported_ns, until_ns: session time of its beginning, of the first and the last
    report, and of its end, None as long as it lasts.
    size, sigma: in `unit`, one standard deviation. gain: reduction of the residual's sum of squares in
    variances of the noise; `level` is the threshold for it that gives the rate of false alarms asked for. For
    a collision, the gain is the peak torque over its level.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Kind
    serial: str
    since_ns: int
    detected_ns: int
    reported_ns: int
    until_ns: int | None
    size: float
    sigma: float
    unit: str
    gain: float
    level: float
    summary: str

    @property
    def key(self) -> Key:
        """What makes it the same finding as an earlier one: a later word on it replaces the earlier."""
        if self.kind in ("collision", "friction"):
            return self.kind, self.since_ns if self.kind == "collision" else self.serial
        return STRUCTURE if self.kind in STRUCTURAL else ("load", 0)


class Detection(NamedTuple):
    """What a test detects, a `Finding` without its times; size and sigma in the kind's unit."""

    kind: Kind
    serial: str
    size: float
    sigma: float
    gain: float
    level: float
    summary: str

    def finding(self, since_ns: int, now_ns: int, until_ns: int | None = None) -> Finding:
        """Return the finding as reported first."""
        times = {"since_ns": since_ns, "detected_ns": now_ns, "reported_ns": now_ns, "until_ns": until_ns}
        return Finding.model_validate(self._asdict() | times | {"unit": UNITS[self.kind]})


# A size is said again when it moved by more than this share of itself, and by more than two sigmas; by how
# much a sensor is off depends on what it happens to measure.
REPORTED_CHANGE, REPORTED_SENSOR_CHANGE = 0.1, 1.0
# A change that no window has shown for so long is over: longer than the longest window.
OVER_NS = 8_000_000_000


class FindingLog:
    """Findings by key; `ended` are those that were over before the watch was."""

    def __init__(self) -> None:
        self.held: dict[Key, Finding] = {}
        self.ended: list[Finding] = []
        self._reported: dict[Key, Finding] = {}
        self._observed_ns: dict[Key, int] = {}

    @property
    def all(self) -> tuple[Finding, ...]:
        """All that was found and not withdrawn, in the order of time."""
        return tuple(sorted([*self.ended, *self.held.values()], key=lambda f: f.since_ns))

    def put(self, finding: Finding) -> list[Finding]:
        """Take in a finding; return it if it is worth saying."""
        earlier = self.held.get(finding.key)
        if earlier is not None and earlier.kind == finding.kind:
            known = {"since_ns": earlier.since_ns, "detected_ns": earlier.detected_ns}
            finding = finding.model_copy(update=known)
        self._observed_ns[finding.key] = finding.reported_ns
        self.held[finding.key] = finding
        if not _news(self._reported.get(finding.key), finding):
            return []
        self._reported[finding.key] = finding
        return [finding]

    def observe(self, key: Key, now_ns: int) -> None:
        """Note that a finding still holds."""
        self._observed_ns[key] = now_ns

    def withdraw(self, keys: Iterable[Key]) -> list[Key]:
        """Take back findings; return the keys of those that were held."""
        withdrawn = [key for key in keys if key in self.held]
        for key in withdrawn:
            del self.held[key]
            self._reported.pop(key, None)
        return withdrawn

    def end_unseen(self, now_ns: int) -> list[Finding]:
        """End the changes that have not been seen of late; return them."""
        findings = []
        for key, finding in list(self.held.items()):
            if finding.kind == "collision":
                if finding.until_ns is not None and now_ns - finding.until_ns > OVER_NS:
                    self._end(key, finding)
            elif now_ns - self._observed_ns[key] > OVER_NS:
                findings.append(finding.model_copy(update={"until_ns": self._observed_ns[key]}))
                self._end(key, findings[-1])
        return findings

    def _end(self, key: Key, finding: Finding) -> None:
        self.ended.append(finding)
        self.withdraw([key])


def _news(reported: Finding | None, finding: Finding) -> bool:
    if reported is None or (reported.kind, reported.serial) != (finding.kind, finding.serial):
        return True
    if (reported.until_ns is None) != (finding.until_ns is None):
        return True
    share = REPORTED_SENSOR_CHANGE if finding.kind in SENSORS else REPORTED_CHANGE
    least = max(share * abs(reported.size), 2.0 * reported.sigma)
    return finding.kind != "collision" and abs(finding.size - reported.size) > least
