"""Interfaces to the packets of Linux network namespaces."""

import ctypes
import fcntl
import os
import struct
import subprocess
import threading
from ipaddress import IPv4Interface
from pathlib import Path

from module_agent.model.errors import RobotError

INTERFACE = "x5"
_TUN = "/dev/net/tun"
_CLONE_NEWNET = 0x40000000
# linux/if_tun.h
_TUNSETIFF = 0x400454CA
_IFF_TUN = 0x0001
_IFF_NO_PI = 0x1000


class NamespaceError(RobotError):
    """The machine cannot make network namespaces or interfaces; the message names what is missing."""


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
