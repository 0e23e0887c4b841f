"""Bytes on the wire: what goes in comes out, plain msgpack reads it, what is wrong is refused by reason."""

import json
import math
import struct
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from module_agent.control.motion import MAX_SAMPLES, effort_profile
from module_agent.model.errors import UsageError
from module_agent.wire import keys
from module_agent.wire.codec import MAX_COMMAND_BYTES, MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.feedback_rows import ROW, unpack
from module_agent.wire.information_messages import (
    MAX_MODULES,
    MAX_PART_BYTES,
    ChainPart,
    ClockPart,
    CollectRequest,
    Information,
    InformationRequest,
    RowRange,
    SpanPart,
)
from module_agent.wire.messages import (
    Ack,
    Ask,
    CircleEstimate,
    Estimate,
    EstimateRequest,
    Feedback,
    GainsCommand,
    GainSet,
    HistoryRequest,
    Identify,
    Info,
    LeaseRequest,
    Limits,
    Message,
    MotionCommand,
    MotionRecord,
    MultiSine,
    PidGains,
    RegressionEstimate,
    Rest,
    Setpoint,
    Sine,
    Status,
    Stop,
    WindowedSine,
)
from module_agent.wire.refusal import Refusal, WireError
from module_agent.wire.topics import PUBLISHED_BY_MODULE, PUBLISHED_TO_MODULE, SERVED, TOPICS

GOLDEN = Path(__file__).parent / "golden.json"
HEAD: dict[str, Any] = {"serial": "J1", "boot": 0xFEDCBA9876543210, "seq": 7}
COMMAND: dict[str, Any] = {**HEAD, "sender": "coordinator-1@host", "token": 3, "echo_ns": 123_456_789_012}
LOOP = PidGains(kp=1.5)
GAINS = GainSet(strategy=3, position=LOOP, velocity=LOOP, effort=LOOP)
RECORD = MotionRecord(
    motion_id=4,
    pattern=WindowedSine(amplitude=0.09),
    outcome="running",
    start_ns=1,
    start_row=2,
    end_row=None,
    origin_rad=0.5,
)
CIRCLE = CircleEstimate(
    axis=(0.0, 0.0, 1.0),
    tangent=(0.0, 1.0, 0.0),
    radial_m=(0.484, 0.0, 0.0),
    distance_m=0.484,
    sigma_axis_rad=0.001,
    sigma_distance_m=0.0005,
    residual_rms_m_s2=0.03,
    singular_values=(3.0, 0.1, 0.03),
    delay_s=0.002,
    samples=1400,
)
REGRESSION = RegressionEstimate(
    axis=(0.0, 0.0, 1.0),
    radial_m=(0.484, 0.0, 0.0),
    distance_m=0.484,
    sigma_axis_rad=0.001,
    sigma_distance_m=0.00025,
    covariance=tuple(1e-8 * (number + 1) for number in range(21)),
    gravity_m_s2=(0.0, 9.81, 0.0),
    gyro_bias_rad_s=(0.01, -0.02, 0.03),
    accel_bias_m_s2=(0.02, 0.0, -0.01),
    compliance_s2=2.5e-5,
    delay_s=0.002,
    base_shakes=True,
    samples=240,
)


def rows(count: int) -> "np.ndarray[Any, Any]":
    block = np.zeros(count, dtype=ROW)
    block["t_ns"] = 1_000_000_000 + 4_000_000 * np.arange(count)
    block["position_rad"] = 0.25
    block["accel_m_s2"] = [0.0, 0.0, 9.81]
    return block


EXAMPLES: list[Message] = [
    Ask(**HEAD, sender="coordinator-1@host"),
    EstimateRequest(**HEAD, sender="coordinator-1@host", joint="J2"),
    HistoryRequest(**HEAD, sender="coordinator-1@host", first_row=10, end_row=20),
    LeaseRequest(**COMMAND, action="acquire"),
    MotionCommand(**COMMAND, motion_id=4, pattern=WindowedSine(amplitude=0.09)),
    Setpoint(**COMMAND, position_rad=0.5, velocity_rad_s=None, effort_nm=1.25),
    Stop(**HEAD, sender="anybody", why="test"),
    GainsCommand(**COMMAND, gains=GAINS),
    Identify(**HEAD, sender="coordinator-1@host", on=True),
    Info(
        **HEAD,
        module_type="X5-9",
        firmware="f",
        feedback_rate_hz=250.0,
        batch_rows=5,
        history_rows=15000,
        tick_ns=1_000_000,
        imu_period_ns=4_000_000,
        lifetime_ns=250_000_000,
        expiry_action="motor_off",
        limits=Limits(max_speed_rad_s=1.4, max_effort_nm=13.0, min_position_rad=None, max_position_rad=None),
        gains=GAINS,
        t_ns=5,
        name="elbow",
        family="arm",
    ),
    Feedback(**HEAD, first_row=100, count=2, rows=rows(2).tobytes()),
    Status(
        **HEAD,
        t_ns=5,
        state="moving",
        holder="coordinator-1@host",
        lease_left_ns=900_000_000,
        token=3,
        next_row=99,
        motion=RECORD,
        refusals={"stale": 2},
        expiries=1,
        dropped_events=0,
        limits=("position",),
    ),
    Estimate(
        **HEAD,
        joint="J2",
        motion_ids=(3, 4),
        moved=True,
        rate_ratio=0.99,
        gravity_m_s2=(0.0, 0.0, 9.81),
        circle=CIRCLE,
        regression=REGRESSION,
    ),
    Ack(
        **HEAD,
        re=6,
        accepted=False,
        reason="held",
        detail="d",
        t_ns=5,
        holder=None,
        lease_left_ns=0,
        token=3,
    ),
    CollectRequest(
        **HEAD,
        sender="coordinator-1@host",
        motion_id=4,
        rows=(RowRange(serial="J1", boot=9, first_row=10, end_row=20),),
    ),
    InformationRequest(
        **HEAD,
        sender="coordinator-1@host",
        chain=ChainPart(
            serials=("J1",),
            parent=(-1,),
            reversed=(False,),
            geometry=struct.pack("<22d", *range(22)),
            gravity_m_s2=(0.0, 0.0, 9.81),
        ),
        clocks=(ClockPart(origin_ns=5, offset_ns=-1.5, drift=1e-5),),
        motions=(SpanPart(motion_id=4, start_ns=-1, end_ns=90, first_ns=0, samples=20),),
        step_ns=4_000_000,
        cutoff_hz=12.0,
        offset=8,
    ),
    Information(
        **HEAD,
        digest=bytes(range(32)),
        motion_ids=(4,),
        total_bytes=16,
        offset=8,
        part=struct.pack("<d", 0.5),
    ),
]


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_a_message_survives_its_bytes(message: Message) -> None:
    assert decode(type(message), encode(message), MAX_MESSAGE_BYTES) == message


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_the_bytes_are_the_committed_ones_and_plain_msgpack_reads_them(message: Message) -> None:
    """A client in another language sees these very bytes: they change only with the schema version."""
    golden = bytes.fromhex(json.loads(GOLDEN.read_text())[type(message).__name__])
    assert encode(message) == golden
    plain = msgpack.unpackb(golden, use_list=False)
    assert plain == message.model_dump()


def test_every_message_of_the_topics_has_an_example() -> None:
    in_topics = {message for topic in TOPICS.values() for message in (topic.publication, topic.to_module)}
    in_topics |= {topic.reply for topic in TOPICS.values()}
    assert in_topics - {None} == {type(message) for message in EXAMPLES}


def test_every_leaf_is_a_topic_and_one_side_answers_it() -> None:
    assert set(TOPICS) == set(keys.Leaf)
    assert set(SERVED) | set(PUBLISHED_BY_MODULE) | set(PUBLISHED_TO_MODULE) == set(TOPICS) - {
        keys.Leaf.ALIVE
    }
    for topic in TOPICS.values():
        for exchange in ("publication", "request", "reply"):
            message = topic.message(exchange)
            example = next((one for one in EXAMPLES if type(one) is message), None)
            assert example is None or len(encode(example)) <= topic.max_bytes(exchange)


def test_the_bytes_of_several_sines_at_once_are_the_committed_ones() -> None:
    """The one pattern that holds a list: tuples on the wire are plain msgpack arrays."""
    sines = (Sine(amplitude_rad=0.25, frequency_hz=0.5), Sine(amplitude_rad=0.0625, frequency_hz=2.0))
    command = MotionCommand(**COMMAND, motion_id=4, pattern=MultiSine(sines=sines, duration_s=12.0))
    golden = bytes.fromhex(json.loads(GOLDEN.read_text())["MotionCommand of several sines"])
    assert encode(command) == golden
    assert decode(MotionCommand, golden) == command
    assert msgpack.unpackb(golden, use_list=False) == command.model_dump()


def test_the_bytes_of_an_effort_that_is_fed_forward_are_the_committed_ones() -> None:
    """Samples are one block of little-endian floats, as `struct` reads them."""
    effort = effort_profile([2.25, -0.5, 1.0], 500_000_000)
    command = MotionCommand(**COMMAND, motion_id=4, pattern=Rest(duration_s=1.0), effort=effort)
    golden = bytes.fromhex(json.loads(GOLDEN.read_text())["MotionCommand with effort"])
    assert encode(command) == golden
    assert decode(MotionCommand, golden) == command
    plain = msgpack.unpackb(golden, use_list=False)["effort"]
    assert struct.unpack("<3f", plain["samples"]) == (2.25, -0.5, 1.0)


def test_a_motion_without_the_field_effort_has_no_effort() -> None:
    golden = bytes.fromhex(json.loads(GOLDEN.read_text())["MotionCommand without effort"])
    assert decode(MotionCommand, golden).effort is None


def test_messages_of_before_names_and_kept_gains_are_read() -> None:
    golden = json.loads(GOLDEN.read_text())
    info = decode(Info, bytes.fromhex(golden["Info without name"]))
    assert (info.name, info.family) == ("", "")
    assert not decode(GainsCommand, bytes.fromhex(golden["GainsCommand without keep"])).keep


def test_the_longest_effort_and_the_longest_pattern_fit_a_command() -> None:
    sines = (Sine(amplitude_rad=0.01, frequency_hz=1.5),) * 8
    command = MotionCommand(
        **COMMAND,
        motion_id=2**32 - 1,
        pattern=MultiSine(sines=sines, duration_s=12.0),
        effort=effort_profile([1.0] * MAX_SAMPLES, 10_000_000),
    )
    assert len(encode(command)) <= MAX_COMMAND_BYTES


def test_what_is_asked_of_64_modules_and_the_longest_answer_fit_a_message() -> None:
    names = tuple(f"{'X' * 60}-{number:03d}" for number in range(MAX_MODULES))
    chain = ChainPart(
        serials=names,
        parent=tuple(range(-1, MAX_MODULES - 1)),
        reversed=(False,) * MAX_MODULES,
        geometry=bytes(MAX_MODULES * 22 * 8),
        gravity_m_s2=(0.1, 0.2, 9.81),
    )
    clock = ClockPart(origin_ns=2**61, offset_ns=-1e18, drift=1e-4)
    span = SpanPart(motion_id=2**62, start_ns=2**61, end_ns=2**61, first_ns=2**61, samples=750)
    rows = tuple(RowRange(serial=s, boot=2**64 - 1, first_row=2**40, end_row=2**40 + 9) for s in names)
    head = {**HEAD, "sender": "s" * 64}
    for message in (
        CollectRequest(**head, motion_id=2**62, rows=rows),
        InformationRequest(
            **head, chain=chain, clocks=(clock,) * 64, motions=(span,) * 64, step_ns=4_000_000, cutoff_hz=12.0
        ),
        Information(
            **HEAD,
            digest=bytes(32),
            motion_ids=(2**62,) * 64,
            total_bytes=MAX_PART_BYTES,
            offset=0,
            part=bytes(MAX_PART_BYTES),
        ),
    ):
        assert decode(type(message), encode(message), MAX_MESSAGE_BYTES) == message


def test_the_error_names_the_wrong_element() -> None:
    """Not of the array, which lacks it then."""
    request = next(m for m in EXAMPLES if isinstance(m, InformationRequest)).model_dump()
    request["clocks"][0]["drift"] = 0.2
    with pytest.raises(WireError, match=r"clocks\.0\.drift: expected at most 0.1, found 0.2") as caught:
        decode(InformationRequest, msgpack.packb(request))
    assert caught.value.reason is Refusal.RANGE
    with pytest.raises(WireError, match="clocks: expected 1 or more entries, found 0") as caught:
        decode(InformationRequest, msgpack.packb({**request, "clocks": []}))
    assert caught.value.reason is Refusal.TYPES


def test_a_request_has_the_same_digest_for_every_module_and_part() -> None:
    request = next(m for m in EXAMPLES if isinstance(m, InformationRequest))
    again = request.model_copy(update={"serial": "J2", "boot": 1, "seq": 99, "offset": 0, "sender": "b"})
    assert again.digest() == request.digest()
    assert request.model_copy(update={"cutoff_hz": 11.0}).digest() != request.digest()


def test_plain_struct_knowledge_reads_the_rows() -> None:
    """The block is what `ROW` says: 101 bytes a row, little-endian, packed."""
    data = rows(3).tobytes()
    assert len(data) == 3 * 101
    assert int.from_bytes(data[101:109], "little", signed=True) == 1_004_000_000
    assert np.frombuffer(data[202 + 21 : 202 + 29], "<f8")[0] == 0.25


def test_unknown_fields_are_ignored() -> None:
    message = EXAMPLES[0]
    data = msgpack.packb({**message.model_dump(), "later": {"x": 1}})
    assert decode(Ask, data) == message


def test_another_schema_version_is_refused_by_name() -> None:
    data = msgpack.packb({**EXAMPLES[0].model_dump(), "v": 2, "something": "new"})
    with pytest.raises(WireError, match="module J1 speaks v2, v1 is spoken here") as caught:
        decode(Ask, data)
    assert caught.value.reason is Refusal.VERSION


def changed(**values: Any) -> bytes:
    packed: bytes = msgpack.packb({**EXAMPLES[5].model_dump(), **values})
    return packed


def nested(depth: int) -> Any:
    return [nested(depth - 1)] if depth else 1


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"x" * 5000, Refusal.TOO_LONG),
        (b"", Refusal.MALFORMED),
        (b"\xc1", Refusal.MALFORMED),
        (msgpack.packb([1, 2]), Refusal.MALFORMED),
        (b"\x91" * 4000 + b"\x01", Refusal.MALFORMED),
        (changed(why=nested(8)), Refusal.MALFORMED),
        (changed(why=list(range(100))), Refusal.MALFORMED),
        (msgpack.packb({1: 2}), Refusal.MALFORMED),
        (changed(v=None), Refusal.VERSION),
        (changed(position_rad="far"), Refusal.TYPES),
        (changed(position_rad=True), Refusal.TYPES),
        (changed(token=1.5), Refusal.TYPES),
        (changed(position_rad=math.nan), Refusal.NOT_FINITE),
        (changed(effort_nm=math.inf), Refusal.NOT_FINITE),
        (changed(effort_nm=-math.inf), Refusal.NOT_FINITE),
        (changed(effort_nm=1e9), Refusal.RANGE),
        (changed(seq=-1), Refusal.RANGE),
        # Types come before finiteness, finiteness before ranges.
        (changed(seq=-1, effort_nm=math.nan), Refusal.NOT_FINITE),
        (changed(seq="x", effort_nm=math.nan), Refusal.TYPES),
    ],
)
def test_what_is_wrong_is_refused_by_the_first_reason(data: bytes, reason: Refusal) -> None:
    with pytest.raises(WireError) as caught:
        decode(Setpoint, data)
    assert caught.value.reason is reason


@given(st.binary(max_size=600))
def test_no_bytes_whatever_raise_anything_but_a_wire_error(data: bytes) -> None:
    for kind in (Setpoint, MotionCommand, Status):
        with pytest.raises(WireError):
            decode(kind, data)


def _examples(kind: type[Message]) -> dict[str, Any]:
    """The first example of a kind, as plain msgpack has it."""
    found: dict[str, Any] = msgpack.unpackb(encode(next(one for one in EXAMPLES if type(one) is kind)))
    return found


def test_an_estimate_is_of_a_motion_at_least() -> None:
    wrong = msgpack.packb(_examples(Estimate) | {"motion_ids": ()})
    with pytest.raises(WireError, match="motion_ids"):
        decode(Estimate, wrong)


def test_a_motion_that_is_done_has_its_last_row() -> None:
    status = _examples(Status)
    assert status["motion"]["outcome"] == "running"
    decode(Status, msgpack.packb(status | {"motion": status["motion"] | {"end_row": None}}))
    done = status | {"motion": status["motion"] | {"outcome": "done", "end_row": None}}
    with pytest.raises(WireError, match="is done and has no last row"):
        decode(Status, msgpack.packb(done))


@pytest.mark.parametrize(
    ("wrong", "said"), [({"part": b""}, "part"), ({"offset": 9}, "8 bytes from 9 on are beyond the 16")]
)
def test_a_part_of_information_is_something_within_its_block(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(WireError, match=said):
        decode(Information, msgpack.packb(_examples(Information) | wrong))


def test_a_block_that_is_shorter_than_announced_is_refused() -> None:
    whole = Feedback(**HEAD, first_row=0, count=3, rows=rows(2).tobytes())
    with pytest.raises(WireError, match="3 rows"):
        unpack(whole)


def test_a_row_that_is_not_finite_is_refused_with_its_field() -> None:
    block = rows(2)
    block["gyro_rad_s"][1, 2] = np.nan
    with pytest.raises(WireError, match="gyro_rad_s of serial J1"):
        unpack(Feedback(**HEAD, first_row=0, count=2, rows=block.tobytes()))


def test_keys_are_built_and_taken_apart_alike() -> None:
    for leaf in keys.Leaf:
        assert keys.parse(keys.key("arm", "X5-01", leaf)) == ("arm", "X5-01", leaf)
    assert keys.every("arm", keys.Leaf.FEEDBACK) == "x5/arm/*/feedback"


@pytest.mark.parametrize("name", ["", "a/b", "*", "$x", "a b", "x" * 65, "-a"])
def test_a_name_that_cannot_stand_in_a_key_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="cannot be part of a key"):
        keys.key("arm", name, keys.Leaf.STATUS)


@pytest.mark.parametrize(
    "text",
    [
        "x5/arm/J1",
        "x5/arm/-bad/status",
        "x5/a b/J1/status",
        "x5/arm/J1/other",
        "y/arm/J1/status",
        "x5/a/b/c/status",
    ],
)
def test_a_foreign_key_is_refused(text: str) -> None:
    with pytest.raises(WireError, match="not a key"):
        keys.parse(text)


class ReadByTheModel(Feedback):
    """The same fields; only `Feedback` itself is read by hand."""


_WRONG = st.one_of(
    st.integers(-(2**63), 2**64 - 1),
    st.sampled_from(
        [0, 1, 2, 512, 513, 2**63 - 1, 2**63, True, None, 1.0, "1", "x" * 64, "x" * 65, b"", {}, []]
    ),
    st.binary(max_size=8),
)


@given(
    changes=st.dictionaries(st.sampled_from([*Feedback.model_fields, "more"]), _WRONG, max_size=3),
    missing=st.sets(st.sampled_from([*Feedback.model_fields]), max_size=1),
    cut=st.sampled_from([None, None, None, -1, 3]),
)
def test_feedback_read_by_hand_is_what_the_model_says(
    changes: dict[str, Any], missing: set[str], cut: int | None
) -> None:
    def outcome(kind: type[Feedback]) -> dict[str, Any] | tuple[Refusal, str]:
        try:
            return decode(kind, data, MAX_MESSAGE_BYTES).model_dump()
        except WireError as error:
            return error.reason, error.detail

    good = {"v": 1, "serial": "A", "boot": 7, "seq": 3, "first_row": 5, "count": 1, "rows": bytes(101)}
    fields = {name: value for name, value in (good | changes).items() if name not in missing}
    data = msgpack.packb(fields)[:cut]
    assert outcome(Feedback) == outcome(ReadByTheModel)


def test_feedback_read_by_hand_is_a_message_like_any_other() -> None:
    message = Feedback(serial="A", boot=2**64 - 1, seq=3, first_row=5, count=1, rows=bytes(101))
    read = decode(Feedback, encode(message), MAX_MESSAGE_BYTES)
    assert read == message
    assert hash(read) == hash(message)
    assert read.model_copy(update={"seq": 4}).seq == 4
    with pytest.raises(ValidationError, match="frozen"):
        read.seq = 5  # type: ignore[misc]
