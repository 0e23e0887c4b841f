"""The errors that a `Reply` without payload carries, the same whatever the transport."""

TIMEOUT = "Timeout"
NO_ANSWER = "nobody answers on this key"
CLOSED = "the transport is closed"
