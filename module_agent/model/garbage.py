"""Garbage collection in programs that keep time."""

import gc
from functools import cache


@cache
def leave_out_imports() -> None:
    """Leave all that lives by now, most of it imported, out of later collections; once in a process.

    A full collection of it takes 40 to 90 ms, in which no tick is run and no lease renewed.
    """
    gc.collect()
    gc.freeze()
