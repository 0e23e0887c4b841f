"""Packets on a connected socket, and the steady clock, from within kernels: the system calls alone.

Whatever is not a whole packet sent or received is left to Python, which repeats the call on the same socket
and raises what there is to raise, signals among it.
"""

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from module_agent.model.compiled import compiled

_send: Any = types.ExternalFunction("send", types.intp(types.int32, types.uintp, types.uintp, types.int32))
_recv: Any = types.ExternalFunction("recv", types.intp(types.int32, types.uintp, types.uintp, types.int32))
_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.uintp))
_clock_nanosleep: Any = types.ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, types.uintp, types.uintp)
)
# Of Linux; kernels take no constants from modules written in C.
_DONTWAIT, _NOSIGNAL, _TRUNC = 0x40, 0x4000, 0x20
_MONOTONIC, _ABSOLUTE = 1, 1
_S = 1_000_000_000

Words = NDArray[np.int64]


@compiled
def send(descriptor: int, words: Words, count: int, waits: bool) -> bool:
    """Send the first `count` words as one packet; return whether that was done."""
    flags = _NOSIGNAL if waits else _NOSIGNAL | _DONTWAIT
    return bool(_send(descriptor, words.ctypes.data, 8 * count, flags) == 8 * count)


@compiled
def receive(descriptor: int, words: Words, count: int) -> int:
    """Receive a packet of `count` words; return its length [bytes], 0 at the end, -1 when there is none."""
    return int(_recv(descriptor, words.ctypes.data, 8 * count, _TRUNC))


@compiled
def now_ns(clock: Words) -> int:
    """Return the time of the steady clock, that of `time.monotonic_ns`; clock (2,) is work space."""
    _clock_gettime(_MONOTONIC, clock.ctypes.data)
    return int(clock[0] * _S + clock[1])


@compiled
def sleep_until(t_ns: int, clock: Words) -> bool:
    """Sleep until a time of the steady clock; return whether it has come: a signal ends sleep early."""
    clock[0], clock[1] = t_ns // _S, t_ns % _S
    return bool(_clock_nanosleep(_MONOTONIC, _ABSOLUTE, clock.ctypes.data, 0) == 0)


def work_space() -> Words:
    """Return what `now_ns` and `sleep_until` need."""
    return np.zeros(2, np.int64)
