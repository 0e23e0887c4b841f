"""Kernels: functions on plain arrays, compiled to machine code.

The code is kept on disk and reused until the kernel's own file changes, or one of the files whose kernels it
calls and which it names, see `compiled_with`. `x5-sim compile` compiles all of them in advance.
"""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile a function when it is first called; IEEE arithmetic in the order written, as in Python.

    Other threads go on while it runs.
    """
    return _kernel(function)


def compiled_with(*modules: ModuleType, inline: bool = False) -> Callable[[Function], Function]:
    """Return `compiled` for a function that calls kernels of other modules: their code becomes part of it.

    All of them must be named, those that they call in turn too: else code that is kept outlives a change.
    With `inline` it becomes a part of the kernels that call it, as with `inlined`.
    """

    def decorate(function: Function) -> Function:
        kernel: Any = _kernel(function, inline)
        # Numba compares the stamp of what it has kept with this one.
        index = _index(kernel)
        if index is not None:
            index._source_stamp = (index._source_stamp, *map(_stamp, modules))
            _compare_first(kernel)
        return cast(Function, kernel)

    return decorate


def _index(kernel: Any) -> Any:
    """Return numba's index of the code that it keeps of a kernel; None without one."""
    return getattr(getattr(kernel, "_cache", None), "_cache_file", None)


def _compare_first(kernel: Any) -> None:
    """Let numba compare the stamp together with its version.

    It reads the index of an older file before it compares stamps, and fails where that names types of
    arguments that are gone.
    """
    index = _index(kernel)
    if index is not None:
        index._version = (numba.__version__, index._source_stamp)


def _stamp(module: ModuleType) -> tuple[float, int]:
    """Return what changes with a module's file."""
    assert module.__file__ is not None
    stat = Path(module.__file__).stat()
    return stat.st_mtime, stat.st_size


def inlined(function: Function) -> Function:
    """Compile a function as a part of the kernels that call it, where its arrays' strides may be constants.

    Loops over arrays whose strides are constants become vector instructions.
    """
    return _kernel(function, inline=True)


def _kernel(function: Function, inline: bool = False) -> Function:
    try:
        kernel = numba.njit(cache=True, nogil=True, forceinline=inline)(function)
        _compare_first(kernel)
    except RuntimeError:
        # No folder for the code (a read-only installation without a home): compiled in each process.
        kernel = numba.njit(nogil=True, forceinline=inline)(function)
    return cast(Function, kernel)
