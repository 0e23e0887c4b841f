"""The agent's end of the physics bus: the wires to modules that are simulated in another process."""

import socket
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from module_agent.hardware import packet_kernel as packets
from module_agent.hardware.bus_frames import (
    MAX_HANDSHAKE_BYTES,
    FrameError,
    TickFrames,
    pack_hello,
    unpack_welcome,
)
from module_agent.hardware.hardware import HardwareLost, Readings, WiredModule
from module_agent.model.compiled import compiled_with
from module_agent.model.errors import UsageError

# What kernels and Python keep of a bus: the tick to answer, whether it is answered, the last packet's length.
TICK, ANSWERED, LENGTH = range(3)
_RETRY_S = 0.02


class BusRefused(UsageError):
    """The world does not serve these modules; the message is the world's reason."""


class BusClient:
    """`Wires` over a Unix socket, in lock-step with the world.

    Args:
        path: the world's socket.
        serials: the modules of this agent, in the order of `exchange`.
        connect_timeout_s: how long to wait for a world that is not there yet.

    Raises:
        HardwareLost: no world listens in time, or it speaks another version.
        BusRefused: the world has no such serial, or another agent serves it.
    """

    def __init__(self, path: str, serials: Sequence[str], connect_timeout_s: float = 10.0):
        self._frames = TickFrames.of(len(serials))
        self._socket = _connect(path, connect_timeout_s)
        try:
            tick, self._modules = _greet(self._socket, path, serials, connect_timeout_s)
        except BaseException:
            self._socket.close()
            raise
        count = len(self._modules)
        self._answer = np.zeros(1 + count)
        self._words = np.zeros(self._frames.samples_bytes // 8)
        self.readings = Readings(count, self._words[1:])
        self._state = np.array([tick, 0, 0])

    @property
    def kernel_state(self) -> tuple[Any, ...]:
        """What `answer` and `receive` need: descriptor, words out as floats and integers, words in, state."""
        out, own = self._answer, self._words.view(np.int64)
        return self._socket.fileno(), out, out.view(np.int64), own, self._state

    @property
    def modules(self) -> Sequence[WiredModule]:
        """The modules served, in the order asked for."""
        return self._modules

    def exchange(self, pwm: Sequence[float]) -> Readings:
        """Answer the last tick with one PWM in [-1, 1] per module and wait for the next.

        A tick that a kernel has answered already is not answered again.

        Raises:
            HardwareLost: the world ended, or dropped this agent because of a PWM out of range.
            ValueError: not one PWM per module.
        """
        if len(pwm) != len(self._modules):
            raise ValueError(f"{len(pwm)} PWM values for {len(self._modules)} modules")
        if self._state[LENGTH] > 0:
            raise HardwareLost(f"the physics bus is out of step: a frame of {self._state[LENGTH]} bytes came")
        try:
            if not self._state[ANSWERED]:
                self._socket.send(self._frames.pack_pwm(int(self._state[TICK]), pwm))
                self._state[ANSWERED] = 1
            frame = self._socket.recv(self._frames.samples_bytes + 1)
        except OSError as error:
            raise HardwareLost(f"the physics bus is gone: {error.strerror or error}") from error
        if not frame:
            raise HardwareLost("the physics bus is gone: the world closed it")
        try:
            self._state[:2] = self._frames.unpack_samples(frame, self.readings), 0
        except FrameError as error:
            raise HardwareLost(f"the physics bus is out of step: {error}") from error
        return self.readings

    def close(self) -> None:
        """Release the modules; a thread that waits in `exchange` gets `HardwareLost`. May be called twice."""
        try:
            # Closing alone would not wake a thread inside recv.
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            # The world was first, or this is the second call: nothing is left to shut down.
            pass
        finally:
            self._socket.close()


@compiled_with(packets)
def answer(bus: Any, pwm: NDArray[np.float64]) -> bool:
    """Answer the last tick of a bus, see `kernel_state`, with the PWM of its n modules; return whether it is.

    One that has been answered already is not answered again.
    """
    descriptor, out, out_words, _, state = bus
    if not state[ANSWERED]:
        out_words[0] = state[TICK]
        for i in range(len(pwm)):
            out[1 + i] = pwm[i]
        state[ANSWERED] = packets.send(descriptor, out_words, len(out), True)
    return bool(state[ANSWERED])


@compiled_with(packets)
def receive(bus: Any) -> bool:
    """Wait for the samples of the next tick, which go into `readings`; return whether they have come."""
    descriptor, _, _, own, state = bus
    state[LENGTH] = packets.receive(descriptor, own, len(own))
    if state[LENGTH] != 8 * len(own):
        return False
    state[TICK], state[ANSWERED], state[LENGTH] = own[0], 0, 0
    return True


def _connect(path: str, timeout_s: float) -> socket.socket:
    deadline_s = time.monotonic() + timeout_s
    while True:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connection.connect(path)
            return connection
        except (FileNotFoundError, ConnectionRefusedError, BlockingIOError) as error:
            connection.close()
            if time.monotonic() >= deadline_s:
                raise HardwareLost(
                    f"no world listens on {path} within {timeout_s} s; start it first, or give its --bus path"
                ) from error
        except OSError as error:
            connection.close()
            raise HardwareLost(f"cannot connect to the world on {path}: {error}") from error
        time.sleep(_RETRY_S)


def _greet(
    connection: socket.socket, path: str, serials: Sequence[str], timeout_s: float
) -> tuple[int, tuple[WiredModule, ...]]:
    connection.settimeout(timeout_s)
    try:
        connection.send(pack_hello(serials))
        answer = unpack_welcome(connection.recv(MAX_HANDSHAKE_BYTES))
    except TimeoutError as error:
        raise HardwareLost(
            f"the world on {path} does not answer within {timeout_s} s; is it paused?"
        ) from error
    except (OSError, FrameError) as error:
        raise HardwareLost(f"the world on {path} does not welcome this agent: {error}") from error
    if isinstance(answer, str):
        raise BusRefused(f"the world on {path} refuses this agent: {answer}")
    connection.settimeout(None)
    return answer
