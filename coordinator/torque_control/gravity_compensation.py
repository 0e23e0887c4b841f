"""Floating: the motors of a robot bear its own weight and nothing else, so that a hand can lead it.

Under torque control every spring is asked for what the bodies beyond it weigh, tau = C(q, qd) qd + g(q)
(thesis eq. 28 without acceleration). Friction and gear loss lie before the spring, inside the effort loop,
which makes up for them: what is left of them holds the arm where the model errs by less.

    loading   factory gains; holds where it is, and goes over from the torque that it bears to the calculated
    loaded    holds; waits for the gains of torque control
    freeing   the position loop lets go, little by little
    floating  the weight is borne, nothing else
    holding   the position loop takes hold again, where the robot is; if it had not let go yet, where it held
    held      holds
    returning goes to where it is told, held all the way

A robot floats until it is told to hold, or a joint goes too fast, nears the end of its range or would have to
bear more than it can. Before it is taken, and again before it is set free, its torque sensors are compared
with the weight: what they read beside it counts as their offset, and it is not set free if that is more than
an offset and the errors of scales. Whoever sinks while it is being set free is held too. Pure: time is an
argument, and nothing is sent from here.
"""

from typing import Literal, NamedTuple

import numpy as np

from coordinator.torque_control.gravity_model import GravityModel
from coordinator.torque_control.minimum_jerk import Way
from module_agent.model.chain import Array
from module_agent.model.errors import LostError, RobotError
from module_agent.wire.messages import Limits

Phase = Literal["loading", "loaded", "freeing", "floating", "holding", "held", "returning"]

# What a torque sensor reads beside the weight while the joint holds still, from this share of the ramp on, is
# its offset: it is borne with the weight from then on, or the effort loop would push by it.
TARED_FROM = 0.7
# How far from the calculated torque a joint may be that holds still: a share of its weight, four deviations
# of the scale of a torque sensor as delivered, and one of its type's largest torque, four of its offset.
# Springs lie beyond the motors' friction, so that friction hides nothing from them.
UNKNOWN_OF_WEIGHT = 0.08
UNKNOWN_OF_LARGEST = 0.02
# How far a joint may go while it is being loaded, and while it is being set free: nobody leads it yet. Heavy
# arms whose motors were off sink by 9 degrees as they are taken, into the soft gains of the factory, and by 1
# as they are set free.
MAX_SUNK_RAD, MAX_GIVEN_RAD = float(np.radians(15.0)), float(np.radians(5.0))
# How far a joint may lag on the way back: it is stopped by something then.
MAX_LAG_RAD = 0.08
# How fast the way back is gone at most, and as a share of the speed at which a joint is held.
BACK_RAD_S, BACK_SHARE = 0.5, 0.5


class CompensationRefused(RobotError):
    """The robot is not set free; the message names the joint, what is wrong and what would be right."""


class StaleFeedback(LostError):
    """A module has not been heard of for too long to say what its joints bear."""

    def __init__(self, serial: str, age_s: float, most_s: float):
        super().__init__(
            f"module {serial} was last heard {1e3 * age_s:.0f} ms ago, at most {1e3 * most_s:.0f} ms are "
            "taken: check the network"
        )
        self.serial = serial


class CompensationSettings(NamedTuple):
    """How a robot floats.

    damping_nm_s_rad: of every joint against its motion. max_speed_rad_s: a joint that goes faster is held.
    ramp_s: from holding to floating, in each of the two ramps. hold_s: the ramp back. stale_s: the oldest
    feedback to act on. margin_rad: how near a joint may come to the ends of its range.
    velocity_forces: whether C(q, qd) qd is borne too.
    """

    damping_nm_s_rad: float = 0.0
    max_speed_rad_s: float = 1.5
    ramp_s: float = 0.8
    hold_s: float = 0.3
    stale_s: float = 0.5
    margin_rad: float = 0.1
    velocity_forces: bool = False


class Reading(NamedTuple):
    """The newest that is known of n joints, (n,) each.

    age_s: for how long nothing newer has come; how long it was on the way is not in it.
    """

    age_s: Array
    q_rad: Array
    qd_rad_s: Array
    effort_nm: Array


class Targets(NamedTuple):
    """Set-points of n joints, (n,) each; without positions the position loops are off."""

    position_rad: Array | None
    velocity_rad_s: Array
    effort_nm: Array


class GravityCompensator:
    """The course of one float; `step` is called at the rate of the set-points.

    phase: as above. why: why it holds or is held, empty before.
    """

    def __init__(self, weight: GravityModel, limits: tuple[Limits, ...], settings: CompensationSettings):
        self.phase: Phase = "loading"
        self.why = ""
        self.is_fault = False
        self._weight = weight
        self._serials = weight.chain.serials
        self._settings = settings
        self._most_nm = np.array([one.max_effort_nm for one in limits])
        self._low = _ends([one.min_position_rad for one in limits], -np.inf) + settings.margin_rad
        self._high = _ends([one.max_position_rad for one in limits], np.inf) - settings.margin_rad
        self._since_s = 0.0
        self._place: Array | None = None
        self._way: Way | None = None
        # What the position loops still pull with as it takes hold: all if they had not let go.
        self._grip = 1.0
        self._pull: float | None = None
        # What was asked of it when it was held before it could be set free.
        self._left_nm: Array | None = None
        self._borne, self._asked, self._tare = np.zeros((3, len(limits)))
        self._strangers: list[Array] = []

    @property
    def place_rad(self) -> Array:
        """Where it holds the joints, or last held them (n,).

        Raises:
            ValueError: it has not been stepped yet.
        """
        if self._place is None:
            raise ValueError("it holds nothing before its first step")
        return self._place

    def check_start(self, reading: Reading) -> None:
        """Check that the robot may be set free where it is; to be called before it is taken.

        `reading` is best the mean of some rows: its efforts are compared with the weight.

        Raises:
            FloatRefused: its weight is too much for a joint, or a joint stands at the end of its range or
            bears another load than the known one.
        """
        weight = self._weight.effort_nm(reading.q_rad, np.zeros_like(reading.q_rad))
        reason = (
            self._overload(weight)
            or self._at_an_end(reading.q_rad)
            or self._strange(reading.effort_nm, reading.effort_nm - weight)
        )
        if reason:
            raise CompensationRefused(reason)

    def step(self, t_s: float, reading: Reading) -> Targets:
        """Return the set-points of this moment.

        Raises:
            StaleFeedback: what is known of a joint is too old.
        """
        self._check_age(reading.age_s)
        rate = reading.qd_rad_s if self._settings.velocity_forces else np.zeros_like(reading.q_rad)
        weight = self._weight.effort_nm(reading.q_rad, rate)
        if self._place is None:
            self._begin(t_s, reading, weight)
        self._guard(t_s, reading, weight)
        if self.phase == "loading" and self._share(t_s, self._settings.ramp_s) >= TARED_FROM:
            self._strangers.append(reading.effort_nm - weight)
        self._go_on(t_s, reading)
        # What is too much is held by the position loop as far as the motor can.
        most = self._most_nm
        self._asked = np.clip(self._effort(t_s, weight + self._tare), -most, most)
        if self._way is not None:
            return Targets(*self._way.at(t_s - self._since_s), self._asked)
        return Targets(self._held(t_s, reading.q_rad), np.zeros_like(self._asked), self._asked)

    def _begin(self, t_s: float, reading: Reading, weight_nm: Array) -> None:
        self._since_s, self._place = t_s, reading.q_rad.copy()
        self._borne = self._asked = reading.effort_nm.copy()
        if self._left_nm is not None:
            self._left_nm = self._borne
        elif strange := self._strange(reading.effort_nm, reading.effort_nm - weight_nm):
            self._fault(t_s, reading, strange)

    def _effort(self, t_s: float, weight_nm: Array) -> Array:
        """Return what the springs are asked for: the weight, once the robot is known to weigh that."""
        if self.phase == "loading":
            return self._borne + self._share(t_s, self._settings.ramp_s) * (weight_nm - self._borne)
        if self._left_nm is None:
            return weight_nm
        # It was not set free: from what was asked last to what it bore by itself, without a step.
        gone = self._share(t_s, self._settings.hold_s) if self.phase == "holding" else 1.0
        return self._left_nm + gone * (self._borne - self._left_nm)

    def is_in(self, *phases: Phase) -> bool:
        """Whether it is in one of these phases."""
        return self.phase in phases

    def release(self, t_s: float) -> None:
        """Set the robot free: the gains of torque control are in force. Only from `loaded`."""
        if self.phase == "loaded":
            self._enter("freeing", t_s)

    def hold(self, t_s: float, why: str) -> None:
        """Take hold of the robot at the next step, if it is not held already.

        Where it is held, or is on its way, it stays there with full grip; where it is being set free the pull
        goes on as it is; where it is free it is taken hold of where it is.
        """
        if self.phase in ("holding", "held"):
            return
        self.why = self.why or why
        if self.phase == "loading":
            self._left_nm = self._asked
        elif self.phase == "freeing":
            self._pull = 1.0 - self._share(t_s, self._settings.ramp_s)
        elif self.phase == "floating":
            self._grip = self._pull = 0.0
        elif self._way is not None:
            self._place, self._way = self._way.at(t_s - self._since_s)[0], None
            self._grip = 1.0
        self._enter("holding", t_s)

    def lead_back(self, t_s: float, target_rad: Array) -> None:
        """Go to (n,) positions from where it holds. Only from `held`."""
        if self.phase == "held":
            speed = min(BACK_RAD_S, BACK_SHARE * self._settings.max_speed_rad_s)
            self._way = Way(self.place_rad, target_rad, speed)
            self._enter("returning", t_s)

    def _enter(self, phase: Phase, t_s: float) -> None:
        self.phase, self._since_s = phase, t_s

    def _share(self, t_s: float, length_s: float) -> float:
        return min(max((t_s - self._since_s) / length_s, 0.0), 1.0)

    def _held(self, t_s: float, q_rad: Array) -> Array | None:
        """Return where the position loops are to pull to, None when they are off.

        They pull with a share of their stiffness: to a place so much nearer than the one that they hold.
        """
        assert self._place is not None
        if self.phase == "floating":
            return None
        if self._pull is not None and self.phase == "holding":
            self._place, self._pull = q_rad + self._pull * (self._place - q_rad), None
        grip = 1.0
        if self.phase == "freeing":
            grip = 1.0 - self._share(t_s, self._settings.ramp_s)
        elif self.phase == "holding":
            grip = max(self._grip, self._share(t_s, self._settings.hold_s))
        return q_rad + grip * (self._place - q_rad)

    # ------------------------------------------------------------------ what ends it

    def _go_on(self, t_s: float, reading: Reading) -> None:
        self._arrive(t_s)
        settings = self._settings
        length_s = settings.hold_s if self.phase == "holding" else settings.ramp_s
        if self._share(t_s, length_s) < 1.0:
            return
        if self.phase == "loading":
            tare = np.mean(self._strangers, axis=0)
            strange = self._strange(reading.effort_nm, tare)
            if strange:
                self._fault(t_s, reading, strange)
            else:
                # It has given meanwhile, and stiffer gains are to come: they shall not snatch it back.
                self._place, self._tare = reading.q_rad.copy(), tare
                self._enter("loaded", t_s)
        elif self.phase == "freeing":
            self._enter("floating", t_s)
        elif self.phase == "holding":
            self._enter("held", t_s)

    def _arrive(self, t_s: float) -> None:
        if self._way is not None and t_s - self._since_s >= self._way.total_s:
            self._place, self._way = self._way.end_rad, None
            self._enter("held", t_s)

    def _guard(self, t_s: float, reading: Reading, weight_nm: Array) -> None:
        if self._way is not None:
            wanted = self._way.at(t_s - self._since_s)[0]
            reason = self._astray(reading.q_rad - wanted, MAX_LAG_RAD, "behind on its way back")
            reason = reason or self._too_fast(reading.qd_rad_s) or self._overload(weight_nm)
        elif self.phase in ("freeing", "floating"):
            reason = self._too_fast(reading.qd_rad_s) or self._at_an_end(reading.q_rad)
            reason = reason or self._overload(weight_nm)
        else:
            reason = ""
        if self.phase in ("loading", "freeing"):
            given = reading.q_rad - self.place_rad
            most_rad = MAX_SUNK_RAD if self.phase == "loading" else MAX_GIVEN_RAD
            reason = reason or self._astray(given, most_rad, "away before it was free")
        if reason:
            self._fault(t_s, reading, reason)

    def _fault(self, t_s: float, reading: Reading, why: str) -> None:
        was_on_its_way = self._way is not None
        if was_on_its_way:
            # The end had another reason; what has come between is the one to tell.
            self.why = ""
        self.is_fault = True
        self.hold(t_s, why)
        if was_on_its_way:
            # It does not push on against what has stopped it.
            self._place = reading.q_rad.copy()

    def _check_age(self, age_s: Array) -> None:
        worst = int(np.argmax(age_s))
        if age_s[worst] > self._settings.stale_s:
            raise StaleFeedback(self._serials[worst], float(age_s[worst]), self._settings.stale_s)

    def _overload(self, weight_nm: Array) -> str:
        over = np.abs(weight_nm) - self._most_nm
        worst = int(np.argmax(over))
        if over[worst] <= 0.0:
            return ""
        return (
            f"joint {self._serials[worst]} would have to bear {weight_nm[worst]:.2f} Nm here, it can bear "
            f"{self._most_nm[worst]:.2f} Nm; bring the arm to a lighter pose"
        )

    def _strange(self, effort_nm: Array, tare_nm: Array) -> str:
        weight = effort_nm - tare_nm
        over = np.abs(tare_nm) - UNKNOWN_OF_WEIGHT * np.abs(weight) - UNKNOWN_OF_LARGEST * self._most_nm
        worst = int(np.argmax(over))
        if over[worst] <= 0.0:
            return ""
        return (
            f"joint {self._serials[worst]} bears {effort_nm[worst]:.2f} Nm, {tare_nm[worst]:+.2f} Nm beside "
            "what the robot that is known weighs there: it carries something, leans on something, is being "
            "moved, or stands otherwise than when it was identified; identify it again as it is"
        )

    def _astray(self, away_rad: Array, most_rad: float, how: str) -> str:
        worst = int(np.argmax(np.abs(away_rad)))
        if abs(away_rad[worst]) <= most_rad:
            return ""
        return (
            f"joint {self._serials[worst]} was {np.degrees(abs(away_rad[worst])):.1f} degrees {how}, at most "
            f"{np.degrees(most_rad):.1f} are allowed: something pushes or stops it, or its load is another"
        )

    def _too_fast(self, rate_rad_s: Array) -> str:
        worst = int(np.argmax(np.abs(rate_rad_s)))
        if abs(rate_rad_s[worst]) <= self._settings.max_speed_rad_s:
            return ""
        return (
            f"joint {self._serials[worst]} went {abs(rate_rad_s[worst]):.2f} rad/s, at most "
            f"{self._settings.max_speed_rad_s:.2f} rad/s are allowed"
        )

    def _at_an_end(self, q_rad: Array) -> str:
        beyond = np.maximum(q_rad - self._high, self._low - q_rad)
        worst = int(np.argmax(beyond))
        if beyond[worst] <= 0.0:
            return ""
        margin = self._settings.margin_rad
        return (
            f"joint {self._serials[worst]} is at {q_rad[worst]:.2f} rad, within {margin:.2f} rad of the end "
            f"of its range, {self._low[worst] - margin:.2f} to {self._high[worst] + margin:.2f} rad"
        )


def _ends(values: list[float | None], otherwise: float) -> Array:
    return np.array([otherwise if value is None else value for value in values])
