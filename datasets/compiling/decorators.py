"""How functions of ours are compiled: one decorator, so that one decision holds for all."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeAlias, TypeVar

from numba import njit as typed_njit

from .cache import CodeCache, NoPlaceError

Records: TypeAlias = Any
"""An array of records; NumPy's types know nothing of their fields."""

njit: Any = typed_njit
"""Its type knows fewer options than it has."""
F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Return the function, compiled by numba when it is first called, and kept in the cache of compiled code.

    A division by zero gives infinity or NaN, as in NumPy, instead of raising: that saves a branch at every division. No
    wrapper for calls from C is made; nobody calls from there.
    """
    return _kept(njit(error_model="numpy", no_cfunc_wrapper=True)(function))


def inner(function: F) -> F:
    """Return the function, compiled as by `compiled`, to be called from compiled code only.

    Without the wrapper that Python calls by, it compiles a quarter of a second faster. Called from Python it would
    crash the interpreter; call its `py_func`, which does the same.
    """
    return _kept(njit(error_model="numpy", no_cfunc_wrapper=True, no_cpython_wrapper=True)(function))


def _kept(dispatcher: Any) -> Any:
    """Have numba keep the code of a function in our cache, if any; what `cache=True` does with numba's own."""
    with suppress(NoPlaceError):
        dispatcher._cache = CodeCache(dispatcher.py_func)
    return dispatcher
