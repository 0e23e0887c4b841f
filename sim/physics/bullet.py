"""PyBullet, imported without the greeting that its C code prints.

Standard output belongs to results, some of them machine-readable, and standard error to what a person must
know.
"""

import ctypes
import importlib
import os
import sys
from typing import Any


def _imported_quietly() -> Any:
    streams = (1, 2)
    sys.stdout.flush()
    sys.stderr.flush()
    kept, nowhere = [os.dup(n) for n in streams], os.open(os.devnull, os.O_WRONLY)
    try:
        for number in streams:
            os.dup2(nowhere, number)
        return importlib.import_module("pybullet")
    finally:
        # The greeting waits in the C library's buffer.
        ctypes.CDLL(None).fflush(None)
        for number, copy in zip(streams, kept, strict=True):
            os.dup2(copy, number)
            os.close(copy)
        os.close(nowhere)


pybullet: Any = _imported_quietly()
