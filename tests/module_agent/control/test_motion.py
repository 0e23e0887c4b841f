"""A motion follows the module's clock, whatever the ticks; it may bring efforts that are fed forward."""

from typing import Any

import numpy as np
import pytest

from module_agent.control.gains import catalogue_limits
from module_agent.control.motion import (
    MAX_MOTION_S,
    MAX_SAMPLES,
    MAX_STEP_RAD,
    Motion,
    check_duration,
    check_setpoint,
    effort_at,
    effort_profile,
    profile_period_ns,
)
from module_agent.control.waveform import waveform
from module_agent.firmware.config import FirmwareConfig
from module_agent.firmware.firmware import Answer, Incoming, Publication
from module_agent.hardware.hardware import SensorSample
from module_agent.model.catalogue import CATALOGUE
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.feedback_rows import unpack
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import (
    Ack,
    ConstantMotion,
    EffortProfile,
    Feedback,
    GoTo,
    LeaseRequest,
    Limits,
    Message,
    MotionCommand,
    MultiSine,
    Rest,
    Setpoint,
    Sine,
    WindowedSine,
)
from module_agent.wire.refusal import Refusal, WireError
from tests.module_agent.wired_firmware import WiredFirmware

MS = 1_000_000
KIND = CATALOGUE["X5-9"]
RAMP = effort_profile([1.0, 3.0, -1.0], 100 * MS)


class HeldModule:
    """A module under command, and what it says; its joint stands still."""

    def __init__(self) -> None:
        config = FirmwareConfig("A", KIND, 1, catalogue_limits(KIND), feedback_rate_hz=1000.0)
        self._wired = WiredFirmware(config)
        self.firmware = self._wired.firmware
        self.now, self.seq = 0, 0
        self.commands: list[float] = []
        self.tell(Leaf.LEASE, LeaseRequest(**self.head(action="acquire")))

    def head(self, **more: Any) -> dict[str, Any]:
        self.seq += 1
        own = {"serial": "A", "boot": 1, "seq": self.seq, "sender": "me", "echo_ns": self.now}
        return {**own, "token": self.firmware.lease.token, **more}

    def tell(self, leaf: Leaf, message: Message) -> Ack:
        return decode(Ack, self.tick(Incoming(leaf, encode(message), 1))[0])

    def move(self, effort: EffortProfile | None) -> Ack:
        command = MotionCommand(**self.head(motion_id=self.seq, pattern=Rest(duration_s=0.2), effort=effort))
        return self.tell(Leaf.MOTION, command)

    def tick(self, *incoming: Incoming) -> list[bytes]:
        self.now += MS
        imu = self.now // (4 * MS) * 4 * MS
        sample = SensorSample(self.now, imu, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 25.0, 24.0, 0, 0, 0, 0, 0, 9.8)
        _, out = self._wired.tick(sample, incoming)
        for outgoing in out:
            if isinstance(outgoing, Publication) and outgoing.leaf is Leaf.FEEDBACK:
                feedback = decode(Feedback, outgoing.payload, MAX_MESSAGE_BYTES)
                self.commands += unpack(feedback)["effort_command_nm"].tolist()
        return [outgoing.payload for outgoing in out if isinstance(outgoing, Answer)]

    def played(self, ticks: int) -> list[float]:
        """Return the effort commands of the next ticks."""
        self.commands.clear()
        for _ in range(ticks):
            self.tick()
        return self.commands


def test_the_efforts_of_a_motion_are_played_between_its_samples_and_the_last_one_holds_on() -> None:
    module = HeldModule()
    assert module.move(RAMP).accepted
    played = np.array(module.played(150))
    # The row of the tick before the motion began has no effort.
    played = played[np.isfinite(played)]
    assert len(played) > 140
    expected = np.interp(np.arange(len(played)), [0.0, 100.0, 200.0], [1.0, 3.0, -1.0])
    # Rows hold 4-byte floats.
    np.testing.assert_allclose(played, expected, atol=1e-6)
    # The motion ends after 200 ms; without a keep-alive the module goes on until 250 ms.
    assert module.played(80)[-1] == -1.0


def test_a_motion_that_is_broken_off_is_not_fed_forward_any_more() -> None:
    module = HeldModule()
    module.move(RAMP)
    module.played(50)
    assert module.tell(Leaf.LEASE, LeaseRequest(**module.head(action="acquire"))).accepted
    assert np.isnan(module.played(20)[-1])


def test_a_motion_without_efforts_leaves_the_effort_loop_off() -> None:
    module = HeldModule()
    module.move(None)
    assert np.isnan(module.played(100)).all()


@pytest.mark.parametrize(
    ("samples", "reason", "detail"),
    [
        (b"123456789", Refusal.TYPES, "an effort profile of 9 bytes; a sample is 4 bytes long"),
        (
            np.array([0.0, np.nan], "<f4").tobytes(),
            Refusal.NOT_FINITE,
            "sample 1 of the effort profile is nan",
        ),
        (
            np.array([np.inf, 0.0], "<f4").tobytes(),
            Refusal.NOT_FINITE,
            "sample 0 of the effort profile is inf",
        ),
    ],
)
def test_efforts_that_are_no_numbers_are_refused_and_nothing_moves(
    samples: bytes, reason: Refusal, detail: str
) -> None:
    module = HeldModule()
    ack = module.move(EffortProfile(period_ns=10 * MS, samples=samples))
    assert (ack.accepted, ack.reason, ack.detail) == (False, reason.value, detail)
    assert module.firmware.state == "armed"


@pytest.mark.parametrize(
    "pattern",
    [
        WindowedSine(amplitude=0.1, frequency_hz=8.0, centre_s=1e-3, sigma_s=5e-324),
        MultiSine(sines=(Sine(amplitude_rad=0.1, frequency_hz=1.0),), duration_s=5e-324),
        # Its positions are finite, its speeds are not.
        WindowedSine(amplitude=0.1, frequency_hz=8.0, centre_s=1e-3, sigma_s=1e-160),
    ],
)
def test_a_motion_that_computes_to_no_number_is_refused(pattern: Any) -> None:
    with np.errstate(all="raise"), pytest.raises(WireError, match="no finite targets"):
        Motion(pattern, 0.0, 0)


@pytest.mark.parametrize(("duration_s", "steps"), [(2e-4, 1), (0.0625, 62), (0.4, 400), (59.999, 59_999)])
def test_a_motion_is_sampled_every_millisecond_from_its_start_to_its_end(
    duration_s: float, steps: int
) -> None:
    motion = Motion(Rest(duration_s=duration_s), 0.3, 7)
    assert motion.span_ns == (7, 7 + steps * MS)
    assert motion.targets.shape == (3, steps + 1)


def test_what_comes_last_in_a_motion_is_its_end() -> None:
    # Without ramps it ends at full speed, and with efforts that still fall.
    motion = Motion(ConstantMotion(velocity_rad_s=1.5, duration_s=0.15, ramp_s=0.0), 0.3, 7, RAMP)
    position, _, effort = motion.targets
    assert motion.last_position_rad == position[-1] > position[-2]
    assert motion.last_effort_nm == effort[-1] < effort[-2]


def test_a_motion_of_a_minute_is_taken_and_no_longer_one() -> None:
    longest = GoTo(target_rad=1.0, max_speed_rad_s=1.875 / MAX_MOTION_S)
    check_duration(longest, 0.0)
    with pytest.raises(WireError, match="the motion would take 61 s, at most 60 s are taken") as refused:
        check_duration(longest.model_copy(update={"max_speed_rad_s": 1.875 / 61.0}), 0.0)
    assert refused.value.reason is Refusal.LIMIT


def _limits(**changes: float) -> Limits:
    return catalogue_limits(KIND).model_copy(update=changes)


def _setpoint(**values: float) -> Setpoint:
    asked = {"position_rad": None, "velocity_rad_s": None, "effort_nm": None, **values}
    head = {"serial": "A", "boot": 1, "seq": 1, "sender": "me", "token": 1, "echo_ns": 0}
    return Setpoint.model_validate({**head, **asked})


@pytest.mark.parametrize(
    ("values", "limits", "measured_rad"),
    [
        # From where the joint is, however far that is from zero, one turn and no more.
        ({"position_rad": 9.0}, {}, 9.0),
        ({"position_rad": MAX_STEP_RAD}, {}, 0.0),
        # Without a velocity none is compared, nor is an effort.
        ({"position_rad": 0.0}, {"max_speed_rad_s": 0.01, "max_effort_nm": 0.01}, 0.0),
        ({"velocity_rad_s": 5.0}, {"max_speed_rad_s": 0.5}, 0.0),
        ({"effort_nm": -5.0}, {"max_effort_nm": 0.5}, 0.0),
        ({"position_rad": -1.0}, {"min_position_rad": -1.0, "max_position_rad": 1.0}, 0.0),
        ({"position_rad": 1.0}, {"min_position_rad": -1.0, "max_position_rad": 1.0}, 0.0),
    ],
)
def test_a_setpoint_at_a_limit_is_taken(
    values: dict[str, float], limits: dict[str, float], measured_rad: float
) -> None:
    check_setpoint(_setpoint(**values), measured_rad, _limits(**limits))


@pytest.mark.parametrize(
    ("values", "limits", "said"),
    [
        ({"position_rad": -6.3}, {}, "position -6.3 rad is 6.3 rad from where the joint is"),
        ({"velocity_rad_s": -5.1}, {"max_speed_rad_s": 0.5}, "5.1 rad/s is over 10 times .*, 0.50 rad/s"),
        ({"effort_nm": 5.1}, {"max_effort_nm": 0.5}, "5.1 Nm is over 10 times .*, 0.50 Nm"),
        ({"position_rad": -1.1}, {"min_position_rad": -1.0}, r"position -1.100 rad is outside -1.0 .. None"),
        ({"position_rad": 1.1}, {"max_position_rad": 1.0}, r"position 1.100 rad is outside None .. 1.0"),
    ],
)
def test_a_setpoint_beyond_a_limit_is_refused_with_what_it_asks_and_what_is_allowed(
    values: dict[str, float], limits: dict[str, float], said: str
) -> None:
    with pytest.raises(WireError, match=said) as refused:
        check_setpoint(_setpoint(**values), 0.0, _limits(**limits))
    assert refused.value.reason is Refusal.LIMIT


@pytest.mark.parametrize("tick_ns", [1 * MS, 4 * MS, 2_700_001])
def test_a_motion_follows_time_and_not_a_count_of_ticks(tick_ns: int) -> None:
    pattern, start_ns = ConstantMotion(velocity_rad_s=1.5, duration_s=0.4, ramp_s=0.1), 123
    motion = Motion(pattern, 0.3, start_ns)
    end_ns = start_ns + 600 * MS
    for now_ns in range(start_ns, end_ns, tick_ns):
        command = motion.command(now_ns)
        assert command is not None
        exact = 0.3 + waveform(pattern, 0.3, np.array([1e-9 * (now_ns - start_ns)])).offset_rad[0]
        # Samples are 1 ms apart, each of which holds until the next.
        assert 0.0 <= exact - command.position_rad < 1.5e-3 + 1e-12
        assert np.isnan(command.effort_nm)
    assert motion.command(end_ns) is None


@pytest.mark.parametrize("total_s", [0.2, 5.6, 7.99, 8.0, 60.0])
def test_every_motion_that_a_module_takes_fits_a_profile(total_s: float) -> None:
    period_ns = profile_period_ns(total_s)
    count = int(np.ceil(total_s * 1e9 / period_ns)) + 1
    assert count <= MAX_SAMPLES
    assert period_ns % MS == 0
    profile = effort_profile(np.zeros(max(count, 2)), period_ns)
    assert effort_at(profile, np.array([0.0, total_s])).tolist() == [0.0, 0.0]


def test_a_profile_is_no_coarser_than_its_motion_needs() -> None:
    # 799 periods of 11 ms, and a nanosecond more.
    assert profile_period_ns(8.789) == 11 * MS
    assert profile_period_ns(8.789000001) == 12 * MS
    assert profile_period_ns(7.99) == 10 * MS


def test_too_many_efforts_are_refused_with_how_many_there_may_be() -> None:
    with pytest.raises(ValueError, match=r"shape \(801,\); a profile is 2 to 800 finite numbers"):
        effort_profile(np.zeros(801), 10 * MS)
