"""The proof that a command comes from the holder of a lease: a keyed hash that ends the message.

Who acquires a lease sends a secret with the request; every later command of that holder ends with
HMAC-SHA-256(secret, command), its first 16 bytes (RFC 2104, truncated as its section 5 allows), as one more
msgpack object behind the command's map. What modules publish does not contain the secret, so a program
that only listens cannot act in the holder's name; replays are refused by sequence number and age. Every
module is given a secret of its own. Who reads the link to one reads that one's, against which TLS helps.
"""

import hmac

SECRET_BYTES = 16
_PROOF_BYTES = 16
# A msgpack binary of 16 bytes.
_HEAD = b"\xc4\x10"
_END_BYTES = len(_HEAD) + _PROOF_BYTES


def secret_for(serial: str, secret: bytes) -> bytes:
    """Return what a program with a secret gives a module; it tells nothing of what others are given."""
    return hmac.digest(secret, serial.encode(), "sha256")[:SECRET_BYTES] if secret else b""


def proven(command: bytes, secret: bytes) -> bytes:
    """Return an encoded command with its proof; without a secret, the command."""
    return command + _HEAD + _proof(command, secret) if secret else command


def is_proof(end: bytes) -> bool:
    """Return whether these bytes, which follow the map of a command, have the form of a proof."""
    return len(end) == _END_BYTES and end.startswith(_HEAD)


def is_proven(message: bytes, secret: bytes) -> bool:
    """Return whether an encoded message ends with the proof of this secret."""
    command = message[:-_END_BYTES]
    return hmac.compare_digest(message[-_END_BYTES:], _HEAD + _proof(command, secret))


def _proof(command: bytes, secret: bytes) -> bytes:
    return hmac.digest(secret, command, "sha256")[:_PROOF_BYTES]
