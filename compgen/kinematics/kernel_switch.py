"""Compiled or plain kernels, LAPACK, and one BLAS thread."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from compgen.errors import InputError, Message
from compgen.resources import cache_folder

# The switch between compiled kernels (numba, ``pip install compgen[fast]``) and their plain forms (numpy).
#
# Both forms of a calculation agree to rounding, not in every bit. Which form is used is therefore decided by the
# environment variable ``COMPGEN_KERNELS`` and the call itself, never by what the process did before:
#
# * ``auto`` (default): compiled if there are enough points or readings for loading the kernels to pay off in a single
#   call, otherwise plain, as without numba;
# * ``compiled``: always compiled; an error if numba is not installed;
# * ``plain``: never compiled.
#
# The variable is read at every call. Machine code is kept on disk, so that a computer compiles a kernel only once.


VARIABLE = "COMPGEN_KERNELS"
AUTO, COMPILED, PLAIN = "auto", "compiled", "plain"
#: Sums may be taken in another order, and a*b + c in one step; infinities and nan keep their meaning.
FAST = {"contract", "reassoc", "arcp"}
#: rad^2; below, factors of a rotation are the first terms of their series, in both forms: the next ones are less than 1e-21
#: (f1, f2) and 1e-16 (f3) of the result.
SERIES_BELOW = 1e-4
Function = TypeVar("Function", bound=Callable[..., Any])


def kernel_choice() -> str:
    """Value of ``COMPGEN_KERNELS``: auto, compiled or plain; InputError for anything else."""
    choice = os.environ.get(VARIABLE, "").strip().lower() or AUTO
    if choice not in (AUTO, COMPILED, PLAIN):
        raise InputError(
            Message(
                "kernels-unknown-choice",
                "{value} is {choice!r}; set it to auto, compiled or plain",
                value=VARIABLE,
                choice=choice,
            )
        )
    return choice


def use_compiled(size: int, enough: int) -> bool:
    """Whether to use the compiled form for a job of this size, in ``auto`` from ``enough`` on.

    Raises
    ------
    InputError
        if ``COMPGEN_KERNELS`` is ``compiled`` and numba cannot be imported, or is none of the three values.
    """
    choice = kernel_choice()
    if choice == PLAIN or (choice == AUTO and size < enough):
        return False
    if has_numba():
        return True
    if choice == COMPILED:
        raise InputError(
            Message(
                "kernels-no-numba",
                "{value} is 'compiled', but numba cannot be imported; install compgen[fast] or set it to auto or plain",
                value=VARIABLE,
            )
        )
    return False


def has_numba() -> bool:
    """Whether numba can be imported; it is imported to find out, which takes a third of a second."""
    try:
        importlib.import_module("numba")
    except ImportError:
        return False
    return True


@contextmanager
def _settings() -> Iterator[None]:
    """Vectorise within a row, and keep the code in :func:`cache_folder` unless the environment names another folder.

    Code that is loaded from there is run. So a folder counts only if ``NUMBA_CACHE_DIR`` names it: numba would also take
    it from a file ``.numba_config.yaml`` in the working folder, where anybody's files may be.
    """
    import numba

    before = numba.config.SLP_VECTORIZE, numba.config.CACHE_DIR
    numba.config.SLP_VECTORIZE = 1
    numba.config.CACHE_DIR = os.environ.get("NUMBA_CACHE_DIR") or str(cache_folder("numba"))
    try:
        yield
    finally:
        numba.config.SLP_VECTORIZE, numba.config.CACHE_DIR = before


def compile_for(function: Function, *signature: object, **options: object) -> Function:
    """Compile, for one signature if given, and keep the code on disk if a folder is writable."""
    import numba

    chosen = {"error_model": "numpy", "fastmath": {"contract"}} | options
    with _settings():
        try:
            kernel: Function = numba.njit(*signature, cache=True, **chosen)(function)
        except (RuntimeError, OSError):
            kernel = numba.njit(*signature, **chosen)(function)
    return kernel


def loop(**options: object) -> Callable[[Function], Function]:
    """Decorate a loop that is compiled, or loaded from disk, at the first call with given argument types."""
    return lambda function: compile_for(function, **options)


# LAPACK without the rest of scipy, which takes longer to load than any identification takes to compute.


@cache
def lapack() -> Any:
    """Return the routines of ``scipy.linalg.lapack``: the same functions, so the same bits.

    ``import scipy.linalg`` loads all of numpy's parts, which takes twice as long as loading numpy. The routines are in
    one compiled module of scipy that needs none of them and is loaded alone; if scipy keeps it elsewhere, or is already
    loaded, the routines come from ``scipy.linalg.lapack``.
    """
    if sys.platform == "win32":
        importlib.import_module("scipy")  # tells the system where scipy's libraries are
    name, package = "scipy.linalg._flapack", find_spec("scipy")
    folders = [] if package is None else [Path(folder) for folder in package.submodule_search_locations or ()]
    files = (folder / "linalg" / f"_flapack{suffix}" for folder in folders for suffix in EXTENSION_SUFFIXES)
    path = next((file for file in files if file.is_file()), None)
    spec = spec_from_file_location(name, path) if path else None
    if "scipy.linalg" in sys.modules or spec is None or spec.loader is None:
        return importlib.import_module("scipy.linalg.lapack")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules[name] = module  # where scipy.linalg finds it when something else needs that
    return module


# One BLAS thread: for matrices of a few hundred columns a second thread only waits, and rounding depends on the number.


@cache
def _controller() -> ThreadpoolController:
    """Numerical libraries of this process: numpy's, and scipy's, which is loaded with its LAPACK."""
    lapack()
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Limit the numerical libraries to one thread for the duration of a ``with`` block."""
    limiter: AbstractContextManager[object] = _controller().limit(limits=1)
    return limiter
