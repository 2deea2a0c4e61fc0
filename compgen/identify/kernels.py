"""Access to the compiled inner loops of :mod:`compgen.identify.compiled`, which need numba.

Loading them takes a third of a second, and about 13 s for the first time on a computer, when they are compiled. They are
loaded for large data, and for a process that identifies repeatedly; a single small identification from the command line
is faster without.
"""

from __future__ import annotations

import importlib
from types import ModuleType

from compgen.core.steady import is_steady

#: Readings from which the compiled loops pay at once.
LARGE = 100_000
_state: dict[str, int] = {"calls": 0, "allowed": 1, "large": 0}
_loaded: dict[str, ModuleType | None] = {}


def allow(compiled: bool) -> None:
    """Allow or forbid the compiled loops; for tests and benchmarks that compare both paths."""
    _state["allowed"] = int(compiled)


def count_identification() -> None:
    """Say that an identification begins; from the second of a process on the compiled loops are loaded."""
    _state["calls"] += 1
    _state["large"] = 0


def compiled_loops(readings: int = 0) -> ModuleType | None:
    """Return the compiled module, or None where numpy serves; it is loaded where so many ``readings`` come at once.

    In a steady block (:func:`compgen.core.steady.steady`) the readings of this identification alone count.
    """
    _state["large"] |= int(readings >= LARGE)
    if not _state["allowed"] or (is_steady() and not _state["large"]):
        return None
    if "module" not in _loaded and (_state["calls"] > 1 or _state["large"]):
        try:
            _loaded["module"] = importlib.import_module("compgen.identify.compiled")
        except ImportError:
            _loaded["module"] = None
    return _loaded.get("module")
