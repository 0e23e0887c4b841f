"""Kernels: functions on plain arrays, compiled to machine code.

The code is kept on disk and reused until the kernel's own file changes. That check does not cover other
files, so kernels call each other within one file only. `x5-sim compile` compiles all of them in advance.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile a function when it is first called; IEEE arithmetic in the order written, as in Python.

    Other threads go on while it runs.
    """
    return _kernel(function)


def inlined(function: Function) -> Function:
    """Compile a function as a part of the kernels that call it, where its arrays' strides may be constants.

    Loops over arrays whose strides are constants become vector instructions.
    """
    return _kernel(function, inline=True)


def _kernel(function: Function, inline: bool = False) -> Function:
    try:
        kernel = numba.njit(cache=True, nogil=True, forceinline=inline)(function)
    except RuntimeError:
        # No folder for the code (a read-only installation without a home): compiled in each process.
        kernel = numba.njit(nogil=True, forceinline=inline)(function)
    return cast(Function, kernel)
