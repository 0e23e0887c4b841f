"""Linux network namespaces: a separate network for some processes."""

import ctypes
import os
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

from tests.emulated_network.interfaces import NamespaceError

OPEN_TIMEOUT_S = 10.0
_TOOLS = ("ip", "nsenter", "unshare")
_PR_SET_PDEATHSIG = 1


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


def _end_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
