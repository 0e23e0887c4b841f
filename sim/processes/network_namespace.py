"""Linux network namespaces: a separate network for some processes, and an interface to its packets."""

import ctypes
import fcntl
import os
import shutil
import signal
import struct
import subprocess
import threading
import time
from contextlib import suppress
from ipaddress import IPv4Interface
from pathlib import Path

from module_agent.model.errors import RobotError

OPEN_TIMEOUT_S = 10.0
INTERFACE = "x5"
_TUN = "/dev/net/tun"
_TOOLS = ("ip", "nsenter", "unshare")
_CLONE_NEWNET = 0x40000000
_PR_SET_PDEATHSIG = 1
# linux/if_tun.h
_TUNSETIFF = 0x400454CA
_IFF_TUN = 0x0001
_IFF_NO_PI = 0x1000


class NamespaceError(RobotError):
    """The machine cannot make network namespaces or interfaces; the message names what is missing."""


class NetworkNamespace:
    """A network namespace without any connection, for as long as this lives. Use as a context manager.

    A process that sleeps in it keeps it and ends with this one; it ends with the last process in it.

    Raises:
        NamespaceError: the machine does not allow it.
    """

    def __init__(self) -> None:
        missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
        if missing:
            raise NamespaceError(f"not installed: {', '.join(missing)}")
        self._holder = subprocess.Popen(
            ["unshare", "--net", "sleep", "infinity"],
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            preexec_fn=_end_with_parent,
        )
        self._wait()

    @property
    def pid(self) -> int:
        """The process that keeps the namespace; `/proc/PID/net` shows the namespace's counters."""
        return self._holder.pid

    @property
    def path(self) -> Path:
        """The path of the namespace, as `nsenter` takes it."""
        return Path(f"/proc/{self._holder.pid}/ns/net")

    @property
    def prefix(self) -> tuple[str, ...]:
        """The command that runs the command after it in the namespace."""
        return ("nsenter", f"--net={self.path}")

    def close(self) -> None:
        """End the holder. May be called twice."""
        self._holder.kill()
        self._holder.wait()
        if self._holder.stderr is not None:
            self._holder.stderr.close()

    def __enter__(self) -> "NetworkNamespace":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait(self) -> None:
        own = os.readlink("/proc/self/ns/net")
        end_s = time.monotonic() + OPEN_TIMEOUT_S
        while self._holder.poll() is None and time.monotonic() < end_s:
            # Its namespace is another as soon as `unshare` has done its work; a dying process has none.
            with suppress(FileNotFoundError):
                if os.readlink(self.path) != own:
                    return
            time.sleep(0.005)
        if self._holder.poll() is None:
            self._holder.kill()
        reason = self._holder.communicate()[1].decode(errors="replace").strip()
        raise NamespaceError(
            f"no network namespace: {reason or f'unshare is not ready after {OPEN_TIMEOUT_S:.0f} s'}"
        )


def open_tun(namespace: Path, address: IPv4Interface) -> int:
    """Give a namespace an interface with this address; return the descriptor of its packets, not blocking.

    A read returns one IP packet that was sent in the namespace to the address' network; a written packet
    arrives there. The interface ends when the descriptor is closed.

    Raises:
        NamespaceError: the machine does not allow it.
    """
    # In another thread, because a thread that has entered a namespace would have to return from it.
    opened: list[int | OSError] = []
    thread = threading.Thread(target=lambda: opened.append(_tun_within(namespace)))
    thread.start()
    thread.join()
    (tun,) = opened
    if isinstance(tun, OSError):
        raise NamespaceError(f"no TUN interface: {tun}") from tun
    for arguments in (("addr", "add", str(address), "dev", INTERFACE), ("link", "set", INTERFACE, "up")):
        done = subprocess.run(
            ["nsenter", f"--net={namespace}", "ip", *arguments], capture_output=True, text=True, check=False
        )
        if done.returncode:
            os.close(tun)
            raise NamespaceError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")
    return tun


def _tun_within(namespace: Path) -> int | OSError:
    try:
        handle = os.open(namespace, os.O_RDONLY)
        try:
            libc = ctypes.CDLL(None, use_errno=True)
            if libc.setns(handle, _CLONE_NEWNET):
                number = ctypes.get_errno()
                return OSError(number, os.strerror(number), str(namespace))
        finally:
            os.close(handle)
        tun = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", INTERFACE.encode(), _IFF_TUN | _IFF_NO_PI))
        except OSError:
            os.close(tun)
            raise
        return tun
    except OSError as error:
        return error


def _end_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
