"""A command ends with a proof that only who knows the secret can make, and is told from one without."""

import hashlib

import pytest

from module_agent.wire.proof import SECRET_BYTES, is_proof, is_proven, proven, secret_for

SECRET = b"0123456789abcdef"


def _hmac_sha_256(key: bytes, text: bytes) -> bytes:
    """RFC 2104: H((K xor opad) H((K xor ipad) text)) with blocks of 64 bytes."""
    padded = key.ljust(64, b"\0")
    inner = hashlib.sha256(bytes(byte ^ 0x36 for byte in padded) + text).digest()
    return hashlib.sha256(bytes(byte ^ 0x5C for byte in padded) + inner).digest()


def test_the_proof_is_the_keyed_hash_of_rfc_2104_behind_the_command() -> None:
    # The second test case of RFC 4231, truncated as its fifth is.
    assert proven(b"what do ya want for nothing?", b"Jefe")[-16:].hex() == "5bdcc146bf60754e6a042426089575c7"
    assert proven(b"stop", SECRET) == b"stop" + b"\xc4\x10" + _hmac_sha_256(SECRET, b"stop")[:16]


def test_without_a_secret_nothing_is_proven_and_no_module_is_given_one() -> None:
    assert proven(b"stop", b"") == b"stop"
    assert secret_for("A", b"") == b""


def test_every_module_is_given_a_secret_of_its_own() -> None:
    given = [secret_for(serial, SECRET) for serial in ("A", "B")]
    assert given == [_hmac_sha_256(SECRET, serial)[:SECRET_BYTES] for serial in (b"A", b"B")]


def test_only_an_unchanged_command_of_the_holder_is_proven() -> None:
    message = proven(b"stop", SECRET)
    assert is_proven(message, SECRET)
    for changed in (b"stoP" + message[4:], message[:-1] + b"?", message[:-18], message + b"?", b""):
        assert not is_proven(changed, SECRET)
    assert not is_proven(message, SECRET[::-1])


@pytest.mark.parametrize(
    ("end", "has_the_form"),
    [
        (b"\xc4\x10" + bytes(16), True),
        (b"\xc4\x10" + bytes(15), False),
        (b"\xc4\x10" + bytes(17), False),
        (b"\xc4\x11" + bytes(16), False),
        (b"\xc5\x10" + bytes(16), False),
        (b"", False),
    ],
)
def test_a_proof_is_told_from_other_bytes_behind_a_command(end: bytes, has_the_form: bool) -> None:
    assert is_proof(end) is has_the_form
