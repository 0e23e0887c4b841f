"""PyBullet, imported without the greeting that its C code prints to standard output.

Standard output belongs to results, some of them machine-readable.
"""

import ctypes
import importlib
import os
import sys
from typing import Any


def _imported_quietly() -> Any:
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        return importlib.import_module("pybullet")
    finally:
        # The greeting waits in the C library's buffer.
        ctypes.CDLL(None).fflush(None)
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


pybullet: Any = _imported_quietly()
