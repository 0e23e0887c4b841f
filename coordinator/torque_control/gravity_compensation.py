"""Gravity compensation: the motors exert the robot's own weight, so that it can be led by hand.

Under torque control the commanded spring torque of every joint is that of the bodies beyond it,
tau = C(q, qd) qd + g(q) (eq. 28 without acceleration). Friction and gear loss act before the spring, inside
the effort loop, which compensates them; what remains holds the arm where the model's error is smaller.

    loading       factory gains; holds the position; the torque fades from the measured to the modelled one
    loaded        holds; waits for the gains of torque control
    releasing     the stiffness of the position loop fades to zero
    compensating  the modelled weight is exerted, nothing else
    holding       the position loop regains its stiffness, at the measured position, or still at the held one
    held          holds
    returning     moves to a given position under position control

Compensation lasts until `hold` is called, or a joint exceeds the speed limit, comes near the end of its
range, needs more torque than it has, or sinks during the release. Before the start, and again before the
release, the difference of torque sensors and model counts as the sensors' offset; the release is refused if
offsets and scale errors do not explain it. Pure: time is an argument, and nothing is sent from here.
"""

from typing import Literal, NamedTuple

import numpy as np

from coordinator.torque_control.gravity_model import GravityModel
from module_agent.control.waveform import minimum_jerk, minimum_jerk_duration_s
from module_agent.model.chain import Array
from module_agent.model.errors import LostError, RobotError
from module_agent.wire.messages import Limits

Phase = Literal["loading", "loaded", "releasing", "compensating", "holding", "held", "returning"]

# From this share of the ramp on, the difference between measured and modelled torque of the resting joint is
# averaged as the sensor's offset. It is added to the commanded torque; else the effort loop would push by it.
OFFSET_FROM = 0.7
# Largest accepted difference between measured and modelled torque at rest: a share of the modelled torque
# (four sigma of a torque sensor's scale as delivered) and a share of the type's maximum torque (four sigma of
# its offset). The springs measure beyond the motors' friction, so friction does not contribute.
MAX_OFFSET_OF_WEIGHT = 0.08
MAX_OFFSET_OF_EFFORT = 0.02
# How far a joint may move while loading and while releasing. Measured on heavy arms: 9 and 1 degrees.
MAX_LOADING_MOTION_RAD, MAX_RELEASE_MOTION_RAD = float(np.radians(15.0)), float(np.radians(5.0))
# Largest lag on the way back; more means that something blocks the joint.
MAX_LAG_RAD = 0.08
# Top speed of the way back, and the same as a share of the speed limit.
BACK_RAD_S, BACK_SHARE = 0.5, 0.5


class CompensationRefused(RobotError):
    """The robot is not released; the message names the joint, the measured and the accepted value."""


class StaleFeedback(LostError):
    """The newest feedback of a module is too old to compensate by; the message names the module."""


class CompensationSettings(NamedTuple):
    """Settings of gravity compensation.

    damping_nm_s_rad: viscous damping of every joint. max_speed_rad_s: the robot is held if a joint moves
    faster. ramp_s: duration of loading and of releasing. hold_s: duration of holding. stale_s: the oldest
    feedback to act on. margin_rad: the smallest distance of a joint from the ends of its range.
    velocity_forces: whether C(q, qd) qd is compensated too.
    """

    damping_nm_s_rad: float = 0.0
    max_speed_rad_s: float = 1.5
    ramp_s: float = 0.8
    hold_s: float = 0.3
    stale_s: float = 0.5
    margin_rad: float = 0.1
    velocity_forces: bool = False


class Reading(NamedTuple):
    """The newest feedback of n joints, (n,) each.

    age_s: time since it arrived, without its transit time.
    """

    age_s: Array
    q_rad: Array
    qd_rad_s: Array
    effort_nm: Array


class Targets(NamedTuple):
    """Set-points of n joints, (n,) each; position_rad None: the position loops are off."""

    position_rad: Array | None
    velocity_rad_s: Array
    effort_nm: Array


class _Way(NamedTuple):
    """Minimum-jerk paths from `start_rad` to `end_rad`, (n,), that begin and end together."""

    start_rad: Array
    end_rad: Array
    total_s: float

    def at(self, t_s: float) -> tuple[Array, Array]:
        """Return positions [rad] and velocities [rad/s], (n,) each, at a time from the beginning."""
        travel = self.end_rad - self.start_rad
        share, rate = minimum_jerk(1.0, self.total_s, t_s)
        return self.start_rad + share * travel, rate * travel


class GravityCompensator:
    """The state machine of gravity compensation; `step` is called at the rate of the set-points.

    phase: as above. why: the reason for holding, empty before.
    """

    def __init__(self, model: GravityModel, limits: tuple[Limits, ...], settings: CompensationSettings):
        self.phase: Phase = "loading"
        self.why = ""
        self.is_fault = False
        self._model = model
        self._serials = model.chain.serials
        self._settings = settings
        self._max_effort_nm = np.array([one.max_effort_nm for one in limits])
        self._low = _ends([one.min_position_rad for one in limits], -np.inf) + settings.margin_rad
        self._high = _ends([one.max_position_rad for one in limits], np.inf) - settings.margin_rad
        self._since_s = 0.0
        self._way: _Way | None = None
        # The stiffness share at the beginning of holding: 1 if the position loops were not released.
        self._stiffness_share = 1.0
        self._held_share: float | None = None
        # The torque commanded when loading was aborted.
        self._aborted_nm: Array | None = None
        # The held, or last held, positions; the first step sets them.
        self._has_begun = False
        self._place, self._initial_nm, self._asked, self._offset = np.zeros((4, len(limits)))
        self._offsets: list[Array] = []

    def check_start(self, reading: Reading) -> None:
        """Check that the robot can be compensated in its pose, before leases are taken.

        `reading` should be the mean of some rows, since its torques are compared with the model.

        Raises:
            CompensationRefused: a joint is overloaded, at the end of its range, or not loaded as modelled.
        """
        weight_nm = self._model.effort_nm(reading.q_rad, np.zeros_like(reading.q_rad))
        reason = (
            self._overload(weight_nm)
            or self._at_an_end(reading.q_rad)
            or self._unexplained_offset(reading.effort_nm, weight_nm)
        )
        if reason:
            raise CompensationRefused(reason)

    def step(self, t_s: float, reading: Reading) -> Targets:
        """Return the set-points at a time.

        Raises:
            StaleFeedback: the feedback of a joint is too old.
        """
        self._check_age(reading.age_s)
        rate = reading.qd_rad_s if self._settings.velocity_forces else np.zeros_like(reading.q_rad)
        weight_nm = self._model.effort_nm(reading.q_rad, rate)
        if not self._has_begun:
            self._begin(t_s, reading, weight_nm)
        self._guard(t_s, reading, weight_nm)
        if self.phase == "loading" and self._share(t_s, self._settings.ramp_s) >= OFFSET_FROM:
            self._offsets.append(reading.effort_nm - weight_nm)
        self._go_on(t_s, reading)
        most = self._max_effort_nm
        self._asked = np.clip(self._effort(t_s, weight_nm + self._offset), -most, most)
        if self._way is not None:
            return Targets(*self._way.at(t_s - self._since_s), self._asked)
        return Targets(self._held(t_s, reading.q_rad), np.zeros_like(self._asked), self._asked)

    def _begin(self, t_s: float, reading: Reading, weight_nm: Array) -> None:
        self._has_begun, self._since_s, self._place = True, t_s, reading.q_rad.copy()
        self._initial_nm = self._asked = reading.effort_nm.copy()
        if self._aborted_nm is not None:
            self._aborted_nm = self._initial_nm
        elif unknown := self._unexplained_offset(reading.effort_nm, weight_nm):
            self._fault(t_s, reading, unknown)

    def _effort(self, t_s: float, weight_nm: Array) -> Array:
        """Return the commanded spring torques: the weight, faded in by loading and out by an abort."""
        if self.phase == "loading":
            return self._initial_nm + self._share(t_s, self._settings.ramp_s) * (weight_nm - self._initial_nm)
        if self._aborted_nm is None:
            return weight_nm
        # Aborted: from the last commanded torque to the initially measured one, without a step.
        gone = self._share(t_s, self._settings.hold_s) if self.phase == "holding" else 1.0
        return self._aborted_nm + gone * (self._initial_nm - self._aborted_nm)

    def is_in(self, *phases: Phase) -> bool:
        """Return whether the phase is one of these."""
        return self.phase in phases

    def release(self, t_s: float) -> None:
        """Begin the release; the gains of torque control must be in force. Only from `loaded`."""
        if self.phase == "loaded":
            self._enter("releasing", t_s)

    def hold(self, t_s: float, why: str) -> None:
        """Hold the robot from the next step on.

        If loading or returning: keep the set-point at full stiffness. If releasing: keep the current
        stiffness. If compensating: hold at the measured position. If holding or held: nothing changes.
        """
        if self.phase in ("holding", "held"):
            return
        self.why = self.why or why
        if self.phase == "loading":
            self._aborted_nm = self._asked
        elif self.phase == "releasing":
            self._held_share = 1.0 - self._share(t_s, self._settings.ramp_s)
        elif self.phase == "compensating":
            self._stiffness_share = self._held_share = 0.0
        elif self._way is not None:
            self._place, self._way = self._way.at(t_s - self._since_s)[0], None
            self._stiffness_share = 1.0
        self._enter("holding", t_s)

    def return_to(self, t_s: float, target_rad: Array) -> None:
        """Move to positions (n,). Only from `held`."""
        if self.phase == "held":
            speed = min(BACK_RAD_S, BACK_SHARE * self._settings.max_speed_rad_s)
            farthest_rad = float(np.abs(target_rad - self._place).max())
            self._way = _Way(self._place, target_rad, minimum_jerk_duration_s(farthest_rad, speed))
            self._enter("returning", t_s)

    def _enter(self, phase: Phase, t_s: float) -> None:
        self.phase, self._since_s = phase, t_s

    def _share(self, t_s: float, length_s: float) -> float:
        return min(max((t_s - self._since_s) / length_s, 0.0), 1.0)

    def _held(self, t_s: float, q_rad: Array) -> Array | None:
        """Return the set-points: a share of the stiffness is that share of the way to the held position."""
        if self.phase == "compensating":
            return None
        if self._held_share is not None and self.phase == "holding":
            self._place, self._held_share = q_rad + self._held_share * (self._place - q_rad), None
        share = 1.0
        if self.phase == "releasing":
            share = 1.0 - self._share(t_s, self._settings.ramp_s)
        elif self.phase == "holding":
            share = max(self._stiffness_share, self._share(t_s, self._settings.hold_s))
        return q_rad + share * (self._place - q_rad)

    # ------------------------------------------------------------------ transitions

    def _go_on(self, t_s: float, reading: Reading) -> None:
        if self._way is not None and t_s - self._since_s >= self._way.total_s:
            self._place, self._way = self._way.end_rad, None
            self._enter("held", t_s)
        settings = self._settings
        length_s = settings.hold_s if self.phase == "holding" else settings.ramp_s
        if self._share(t_s, length_s) < 1.0:
            return
        if self.phase == "loading":
            offset = np.mean(self._offsets, axis=0)
            if unknown := self._unexplained_offset(reading.effort_nm, reading.effort_nm - offset):
                self._fault(t_s, reading, unknown)
            else:
                # Stiffer gains follow, and must not pull back a joint that has yielded meanwhile.
                self._place, self._offset = reading.q_rad.copy(), offset
                self._enter("loaded", t_s)
        elif self.phase == "releasing":
            self._enter("compensating", t_s)
        elif self.phase == "holding":
            self._enter("held", t_s)

    def _guard(self, t_s: float, reading: Reading, weight_nm: Array) -> None:
        reason = ""
        if self._way is not None:
            wanted = self._way.at(t_s - self._since_s)[0]
            reason = self._astray(reading.q_rad - wanted, MAX_LAG_RAD, "behind on the way back")
            reason = reason or self._too_fast(reading.qd_rad_s) or self._overload(weight_nm)
        elif self.phase in ("releasing", "compensating"):
            reason = self._too_fast(reading.qd_rad_s) or self._at_an_end(reading.q_rad)
            reason = reason or self._overload(weight_nm)
        if self.phase in ("loading", "releasing"):
            given = reading.q_rad - self._place
            max_rad = MAX_LOADING_MOTION_RAD if self.phase == "loading" else MAX_RELEASE_MOTION_RAD
            reason = reason or self._astray(given, max_rad, "from its held position before the release")
        if reason:
            self._fault(t_s, reading, reason)

    def _fault(self, t_s: float, reading: Reading, why: str) -> None:
        self.is_fault = True
        if self._way is None:
            self.hold(t_s, why)
        else:
            # This fault, not the end of the session, is the reason now; do not push against an obstacle.
            self.why = ""
            self.hold(t_s, why)
            self._place = reading.q_rad.copy()

    def _check_age(self, age_s: Array) -> None:
        worst = int(np.argmax(age_s))
        if age_s[worst] > self._settings.stale_s:
            raise StaleFeedback(
                f"module {self._serials[worst]}: newest feedback is {1e3 * age_s[worst]:.0f} ms old, at most "
                f"{1e3 * self._settings.stale_s:.0f} ms are accepted; check the network"
            )

    def _about(self, k: int, excess: float, text: str) -> str:
        return "" if excess <= 0.0 else f"joint {self._serials[k]}: {text}"

    def _overload(self, weight_nm: Array) -> str:
        most = self._max_effort_nm
        k = int(np.argmax(np.abs(weight_nm) - most))
        text = f"this pose needs {weight_nm[k]:.2f} Nm, the limit is {most[k]:.2f} Nm. "
        return self._about(k, abs(weight_nm[k]) - most[k], text + "Move the arm to a pose with less load.")

    def _unexplained_offset(self, effort_nm: Array, weight_nm: Array) -> str:
        explained = MAX_OFFSET_OF_WEIGHT * np.abs(weight_nm) + MAX_OFFSET_OF_EFFORT * self._max_effort_nm
        excess = np.abs(effort_nm - weight_nm) - explained
        k = int(np.argmax(excess))
        text = (
            f"measured {effort_nm[k]:.2f} Nm, model predicts {weight_nm[k]:.2f} Nm. Remove any payload or "
            "contact, or identify the robot again (base orientation changed?)."
        )
        return self._about(k, excess[k], text)

    def _astray(self, away_rad: Array, max_rad: float, how: str) -> str:
        k = int(np.argmax(np.abs(away_rad)))
        text = (
            f"{np.degrees(abs(away_rad[k])):.1f} degrees {how}, at most {np.degrees(max_rad):.1f} are "
            "allowed. Remove obstacles; identify again if the load changed."
        )
        return self._about(k, abs(away_rad[k]) - max_rad, text)

    def _too_fast(self, rate_rad_s: Array) -> str:
        k, most = int(np.argmax(np.abs(rate_rad_s))), self._settings.max_speed_rad_s
        speed = abs(rate_rad_s[k])
        text = f"moved at {speed:.2f} rad/s, at most {most:.2f} rad/s are allowed (--max-speed)"
        return self._about(k, speed - most, text)

    def _at_an_end(self, q_rad: Array) -> str:
        margin, beyond = self._settings.margin_rad, np.maximum(q_rad - self._high, self._low - q_rad)
        k = int(np.argmax(beyond))
        text = (
            f"position {q_rad[k]:.2f} rad is within {margin:.2f} rad of the end of its range, "
            f"{self._low[k] - margin:.2f} to {self._high[k] + margin:.2f} rad"
        )
        return self._about(k, beyond[k], text)


def _ends(values: list[float | None], otherwise: float) -> Array:
    return np.array([otherwise if value is None else value for value in values])
