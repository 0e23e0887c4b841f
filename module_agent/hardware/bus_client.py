"""The agent's end of the physics bus: the wires to modules that are simulated in another process."""

import socket
import time
from collections.abc import Sequence

from module_agent.hardware.bus_frames import (
    MAX_HANDSHAKE_BYTES,
    FrameError,
    TickFrames,
    pack_hello,
    unpack_welcome,
)
from module_agent.hardware.hardware import HardwareLost, Readings, WiredModule

_RETRY_S = 0.02


class BusRefused(HardwareLost):
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
            self._tick, self._modules = _greet(self._socket, path, serials, connect_timeout_s)
        except BaseException:
            self._socket.close()
            raise
        self._readings = Readings(len(self._modules))

    @property
    def modules(self) -> Sequence[WiredModule]:
        """The modules served, in the order asked for."""
        return self._modules

    def exchange(self, pwm: Sequence[float]) -> Readings:
        """Answer the last tick with one PWM in [-1, 1] per module and wait for the next.

        Raises:
            HardwareLost: the world ended, or dropped this agent because of a PWM out of range.
            ValueError: not one PWM per module.
        """
        if len(pwm) != len(self._modules):
            raise ValueError(f"{len(pwm)} PWM values for {len(self._modules)} modules")
        try:
            self._socket.send(self._frames.pack_pwm(self._tick, pwm))
            frame = self._socket.recv(self._frames.samples_bytes + 1)
        except OSError as error:
            raise HardwareLost(f"the physics bus is gone: {error.strerror or error}") from error
        if not frame:
            raise HardwareLost("the physics bus is gone: the world closed it")
        try:
            self._tick = self._frames.unpack_samples(frame, self._readings)
        except FrameError as error:
            raise HardwareLost(f"the physics bus is out of step: {error}") from error
        return self._readings

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
