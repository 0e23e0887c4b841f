"""One holder at a time: what a lease grants, to which sender, until when, and what it never grants."""

from typing import Any

import pytest

from module_agent.firmware.admission import NEVER_NS, SENDERS_REMEMBERED, Admission, Lease
from module_agent.wire.codec import MAX_COMMAND_BYTES, MAX_MESSAGE_BYTES, encode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ask, LeaseRequest, Setpoint, Stop
from module_agent.wire.proof import SECRET_BYTES, proven, secret_for
from module_agent.wire.refusal import Refusal, WireError

MS = 1_000_000
LIFETIME_NS = 250 * MS


def request(sender: str = "me", seq: int = 1, action: str = "acquire", **more: Any) -> LeaseRequest:
    head = {"serial": "A", "boot": 7, "seq": seq, "sender": sender, "token": 0, "echo_ns": 0}
    return LeaseRequest(**{**head, "action": action, "duration_ns": 300 * MS, **more})


def setpoint(**more: Any) -> Setpoint:
    head = {"serial": "A", "boot": 7, "seq": 5, "sender": "me", "token": 1, "echo_ns": 0}
    return Setpoint(**{**head, "position_rad": 0.1, "velocity_rad_s": None, "effort_nm": None, **more})


def reason(error: pytest.ExceptionInfo[WireError]) -> Refusal:
    return error.value.reason


def held(now_ns: int = 0, **more: Any) -> Lease:
    lease = Lease()
    assert lease.acquire(request(**more), now_ns)
    return lease


# ------------------------------------------------------------------ lease


def test_a_new_lease_has_no_holder_and_never_lapses() -> None:
    lease = Lease()
    assert lease.state(5) == {"holder": None, "lease_left_ns": 0, "token": 0}
    assert lease.until_ns == NEVER_NS == 2**63 - 1
    assert not lease.lapsed(NEVER_NS)


def test_a_lease_lapses_to_the_nanosecond() -> None:
    lease = held(now_ns=10)
    end = 10 + 300 * MS
    assert lease.until_ns == end
    assert lease.state(10) == {"holder": "me", "lease_left_ns": 300 * MS, "token": 1}
    assert (lease.left_ns(end - 1), lease.left_ns(end), lease.left_ns(end + 1)) == (1, 0, 0)
    assert not lease.lapsed(end - 1)
    assert lease.lapsed(end)


def test_a_renewal_never_shortens_a_lease() -> None:
    lease = held()
    lease.extend(100 * MS, 50 * MS)
    assert lease.until_ns == 300 * MS
    lease.extend(300 * MS, 50 * MS)
    assert lease.until_ns == 350 * MS


def test_every_grant_has_a_larger_token_and_a_released_one_none() -> None:
    lease = held()
    assert lease.acquire(request(seq=2), 0)
    assert lease.token == 2
    lease.release()
    assert (lease.holder, lease.token, lease.until_ns, lease.left_ns(0)) == (None, 2, NEVER_NS, 0)
    with pytest.raises(WireError, match="me holds no lease: acquire it first") as error:
        lease.check("me", 2, b"")
    assert reason(error) is Refusal.NO_LEASE
    # What was granted ends with the release: the next lease begins anew.
    assert lease.acquire(request("other"), 5)
    assert lease.until_ns == 5 + 300 * MS


def test_another_sender_is_told_the_holder_and_the_time_left() -> None:
    lease = held()
    with pytest.raises(WireError, match=r"held by me for another 0\.20 s") as error:
        lease.acquire(request("other"), 100 * MS)
    assert reason(error) is Refusal.HELD
    assert (lease.holder, lease.token) == ("me", 1)


def test_a_copy_of_the_present_grant_grants_nothing_and_is_no_fault() -> None:
    lease = held()
    assert lease.acquire(request(), 100 * MS) is False
    assert (lease.token, lease.until_ns) == (1, 300 * MS)


@pytest.mark.parametrize("seq", [1, 2])
def test_a_copy_of_an_older_grant_is_refused(seq: int) -> None:
    lease = held()
    assert lease.acquire(request(seq=3), 0)
    with pytest.raises(WireError, match=f"me was granted 3 before it asked {seq}") as error:
        lease.acquire(request(seq=seq), 0)
    assert reason(error) is Refusal.SEQUENCE
    assert lease.token == 2


def test_the_order_of_acquisitions_is_that_of_their_sender() -> None:
    lease = held(seq=10)
    with pytest.raises(WireError, match="me was granted 10 before it asked 5"):
        lease.acquire(request(seq=5), 0)


def test_a_copy_brings_no_released_lease_back() -> None:
    lease = held()
    lease.release()
    with pytest.raises(WireError) as error:
        lease.acquire(request(), 0)
    assert reason(error) is Refusal.SEQUENCE
    assert lease.holder is None


def test_a_copy_does_not_grant_what_another_has_had_since() -> None:
    lease = held()
    lease.release()
    assert lease.acquire(request("other", seq=1), 0)
    lease.release()
    with pytest.raises(WireError) as error:
        lease.acquire(request(), 0)
    assert reason(error) is Refusal.SEQUENCE


def test_the_last_senders_are_remembered_and_no_more() -> None:
    lease = Lease()
    for number in range(SENDERS_REMEMBERED + 1):
        lease.acquire(request(f"sender {number}"), 0)
        lease.release()
    # The one before the oldest that is remembered could come again, and the oldest could not.
    with pytest.raises(WireError):
        lease.acquire(request("sender 1"), 0)
    assert lease.acquire(request("sender 0"), 0)


def test_who_is_granted_again_is_remembered_as_the_newest() -> None:
    lease = Lease()
    for number in (*range(SENDERS_REMEMBERED), 0):
        lease.acquire(request(f"sender {number}", seq=1 if lease.token < SENDERS_REMEMBERED else 2), 0)
        lease.release()
    lease.acquire(request("new"), 0)
    lease.release()
    with pytest.raises(WireError):
        lease.acquire(request("sender 0", seq=2), 0)
    assert lease.acquire(request("sender 1"), 0)


# ------------------------------------------------------------------ holder and proof


@pytest.mark.parametrize(
    ("sender", "token", "refusal", "words"),
    [
        ("other", 1, Refusal.HELD, "held by me, not by other"),
        ("me", 0, Refusal.NO_LEASE, "token 0 is not the lease's token 1"),
        ("me", 2, Refusal.NO_LEASE, "token 2 is not"),
    ],
)
def test_only_the_holder_commands_and_only_under_its_token(
    sender: str, token: int, refusal: Refusal, words: str
) -> None:
    lease = held()
    lease.check("me", 1, b"any")
    with pytest.raises(WireError, match=words) as error:
        lease.check(sender, token, b"any")
    assert reason(error) is refusal


def test_a_holder_with_a_secret_proves_every_command_and_acquires_with_it_only() -> None:
    lease = held(secret=b"mine")
    lease.check("me", 1, proven(b"any", b"mine"))
    for payload in (b"any", proven(b"any", b"guessed"), b""):
        with pytest.raises(WireError, match="does not prove that it is from me") as error:
            lease.check("me", 1, payload)
        assert reason(error) is Refusal.UNPROVEN
    with pytest.raises(WireError, match="me holds the lease, and acquired it with another secret") as error:
        lease.acquire(request(seq=2, secret=b"guessed"), 0)
    assert reason(error) is Refusal.UNPROVEN
    lease.release()
    # The next holder has a secret of its own, or none.
    assert lease.acquire(request("other"), 0)
    lease.check("other", 2, b"any")


# ------------------------------------------------------------------ admission


def admission() -> Admission:
    return Admission("A", 7, LIFETIME_NS)


def test_what_is_meant_for_this_module_in_this_boot_is_read() -> None:
    assert admission().read(Leaf.SETPOINT, encode(setpoint())) == setpoint()
    # A stop and a question are for any boot.
    stop = Stop(serial="A", boot=0, seq=1, sender="x")
    assert admission().read(Leaf.STOP, encode(stop)) == stop
    ask = Ask(serial="A", boot=0, seq=1, sender="x")
    assert admission().read(Leaf.INFO, encode(ask)) == ask


@pytest.mark.parametrize(
    ("leaf", "message", "refusal", "words"),
    [
        (Leaf.SETPOINT, setpoint(serial="B"), Refusal.WRONG_SERIAL, "for B, this is A"),
        (Leaf.SETPOINT, setpoint(boot=8), Refusal.WRONG_BOOT, "for boot 0000000000000008 of A"),
        (Leaf.SETPOINT, setpoint(boot=0), Refusal.WRONG_BOOT, "booted anew as 0000000000000007"),
        (Leaf.STOP, Stop(serial="A", boot=8, seq=1, sender="x"), Refusal.WRONG_BOOT, "for boot"),
        (Leaf.FEEDBACK, setpoint(), Refusal.MALFORMED, "feedback takes no message"),
        (Leaf.ALIVE, setpoint(), Refusal.MALFORMED, "alive takes no message"),
    ],
)
def test_what_is_not_is_refused(leaf: Leaf, message: Any, refusal: Refusal, words: str) -> None:
    with pytest.raises(WireError, match=words) as error:
        admission().read(leaf, encode(message))
    assert reason(error) is refusal


def test_what_is_longer_than_its_topic_allows_is_not_even_unpacked() -> None:
    for leaf, size, refusal in (
        (Leaf.LEASE, MAX_COMMAND_BYTES, Refusal.MALFORMED),
        (Leaf.LEASE, MAX_COMMAND_BYTES + 1, Refusal.TOO_LONG),
        (Leaf.COLLECT, MAX_MESSAGE_BYTES, Refusal.MALFORMED),
        (Leaf.COLLECT, MAX_MESSAGE_BYTES + 1, Refusal.TOO_LONG),
    ):
        with pytest.raises(WireError) as error:
            admission().read(leaf, b"\xc1" * size)
        assert reason(error) is refusal


def test_refusals_are_counted_by_reason() -> None:
    counts = admission()
    for one in (Refusal.STALE, Refusal.STALE, Refusal.HELD):
        counts.count(one)
    assert counts.refusals == {"stale": 2, "held": 1}


def test_an_acquisition_needs_no_lease_and_no_order_but_must_be_fresh() -> None:
    checks, lease = admission(), Lease()
    for _ in range(2):
        checks.check_command(request(), b"", lease, 0)
    with pytest.raises(WireError) as error:
        checks.check_command(request(), b"", lease, LIFETIME_NS + 1)
    assert reason(error) is Refusal.STALE


@pytest.mark.parametrize("action", ["renew", "release"])
def test_a_renewal_and_a_release_need_the_lease(action: str) -> None:
    with pytest.raises(WireError) as error:
        admission().check_command(request(action=action), b"", Lease(), 0)
    assert reason(error) is Refusal.NO_LEASE


def test_a_command_comes_once_and_in_order_of_its_kind_and_token() -> None:
    checks, lease = admission(), held()
    checks.check_command(setpoint(), b"", lease, 0)
    for seq in (4, 5):
        with pytest.raises(WireError, match=f"sequence {seq} comes after 5") as error:
            checks.check_command(setpoint(seq=seq), b"", lease, 0)
        assert reason(error) is Refusal.SEQUENCE
    checks.check_command(setpoint(seq=6), b"", lease, 0)
    checks.check_command(request(action="renew", seq=3, token=1), b"", lease, 0)
    # A renewal between two setpoints has not let the first one be forgotten.
    with pytest.raises(WireError):
        checks.check_command(setpoint(seq=6), b"", lease, 0)
    lease.acquire(request(seq=2), 0)
    checks.check_command(setpoint(seq=0, token=2), b"", lease, 0)


def test_a_sequence_of_zero_is_the_first_one() -> None:
    checks, lease = admission(), held()
    checks.check_command(setpoint(seq=0), b"", lease, 0)
    with pytest.raises(WireError):
        checks.check_command(setpoint(seq=0), b"", lease, 0)


@pytest.mark.parametrize(
    ("age_ns", "words"),
    [
        (LIFETIME_NS + 1, "last heard of this module 250 ms ago, at most 250 ms are accepted"),
        (400 * MS, "400 ms ago"),
        (-1, "echoes a module time 0 ms in the future"),
        (-5 * MS, "5 ms in the future"),
    ],
)
def test_a_command_is_as_old_as_what_its_sender_knew(age_ns: int, words: str) -> None:
    checks, lease, now_ns = admission(), held(), 1_000 * MS
    for fresh_ns in (0, LIFETIME_NS):
        checks.check_command(setpoint(seq=fresh_ns, echo_ns=now_ns - fresh_ns), b"", lease, now_ns)
    with pytest.raises(WireError, match=words) as error:
        checks.check_command(setpoint(seq=LIFETIME_NS + 1, echo_ns=now_ns - age_ns), b"", lease, now_ns)
    assert reason(error) is Refusal.STALE


def test_what_one_module_is_given_tells_nothing_of_what_another_is() -> None:
    own, other = (secret_for(serial, b"a-secret-of-16-b") for serial in ("A", "B"))
    assert own != other
    assert len(own) == len(other) == SECRET_BYTES
    assert own == secret_for("A", b"a-secret-of-16-b") != secret_for("A", b"a-guess-of-16-b!")
    # A program without a secret proves nothing.
    assert secret_for("A", b"") == b""
