"""Arguments of the Python interface, checked where they come in: arrays of numbers, and objects of this program."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compgen.errors import InputError, visible_line

if TYPE_CHECKING:  # NumPy is loaded where arrays are checked: help and completion of commands do without
    import numpy as np
    from numpy.typing import NDArray

#: What makes an object that is expected, by its name.
_MADE_BY = {
    "Machine": "compgen.load_machine",
    "ErrorTable": "compgen.read_errors",
    "Lengths": "compgen.read_lengths",
    "Deviations": "compgen.read_deviations",
    "Points": "compgen.read_points",
    "ReversalCurves": "compgen.read_reversal",
    "Scenario": "compgen.read_scenario",
    "ReadTables": "compgen.read_tables",
}
#: Kinds in words.
_WORDS = {"float": "a number", "int": "a number", "floating": "a number", "NoneType": "None", "Mapping": "a mapping",
          "tuple": "a sequence", "list": "a sequence"}  # fmt: skip
#: Kinds of NumPy numbers that are real: whole and floating ones.
_REAL = "iuf"


def of_kind(name: str, value: Any, *kinds: type) -> None:
    """Raise InputError with the name of an argument that is not of one of the kinds; say what makes one."""
    if isinstance(value, kinds):
        return
    expected = " or ".join(dict.fromkeys(_WORDS.get(kind.__name__, kind.__name__) for kind in kinds))
    made = next((_MADE_BY[kind.__name__] for kind in kinds if kind.__name__ in _MADE_BY), "")
    hint = f"; {made}(...) reads one from a file" if made else ""
    raise InputError(f"expected {expected}, got {_described(value)}{hint}", field=name)


def of_kinds(kinds: Mapping[str, tuple[Any, type]]) -> None:
    """Check several arguments, each with its value and kind, see :func:`of_kind`; None passes for none of them."""
    for name, (value, kind) in kinds.items():
        of_kind(name, value, kind)


def text_of(name: str, value: Any) -> str:
    """Return an argument that must be a text that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"expected a name, got {_described(value)}", field=name)
    return value


def path_of(name: str, value: Any) -> Path:
    """Return an argument that must be the path of a file or folder."""
    if not isinstance(value, str | PathLike) or not str(value):
        raise InputError(f"expected a path, got {_described(value)}", field=name)
    return Path(value)


def paths_of(name: str, value: Any) -> list[str | Path]:
    """Return one path, or several, as a list."""
    if isinstance(value, str | PathLike):
        return [path_of(name, value)]
    if not isinstance(value, Sequence) or isinstance(value, bytes):
        raise InputError(f"expected paths, got {_described(value)}", field=name)
    return [path_of(f"{name}[{k}]", item) for k, item in enumerate(value)]


def names_of(name: str, value: Any) -> list[str]:
    """Return one name, or several, as a list."""
    given = [value] if isinstance(value, str) else labels_of(name, value)
    return [text_of(f"{name}[{k}]", item) for k, item in enumerate(given)]


def labels_of(name: str, value: Any) -> Sequence[str]:
    """Return an argument that must be a sequence of texts, not a single one."""
    if _is_array(value) and value.ndim == 1 and value.dtype.kind in "UO":
        value = value.tolist()
    if isinstance(value, str | bytes) or not isinstance(value, Sequence):
        raise InputError(f"expected a sequence of names, got {_described(value)}", field=name)
    strange = next((item for item in value if not isinstance(item, str)), None)
    if strange is not None:
        raise InputError(f"contains {_described(strange)}; expected names", field=name)
    return value


def numbers(
    name: str, value: Any, *shape: int | None, unknown: bool = False, least: float = -math.inf, finite: bool = True
) -> NDArray[np.float64]:
    """Return an argument that must be an array of real, finite numbers.

    Parameters
    ----------
    name : of the argument, in messages.
    value : an array, or what NumPy makes one of; the same object if it is an array of float64.
    shape : size of each dimension, None for any.
    unknown : nan is allowed, for what is not known.
    least : smallest number.
    finite : False: any real numbers; what depends on an infinite or unknown one is that, too.
    """
    import numpy as np

    found = _real(name, value)
    if found.ndim != len(shape) or any(size not in (None, own) for size, own in zip(shape, found.shape, strict=True)):
        expected = ", ".join("n" if size is None else str(size) for size in shape)
        comma = "," if len(shape) == 1 else ""
        raise InputError(f"has the shape {found.shape}; expected ({expected}{comma})", field=name)
    if finite and not np.isfinite(found.sum()):  # a sum over millions of numbers is much faster than a look at each
        good = np.isfinite(found) | (np.isnan(found) if unknown else False)
        if not good.all():
            hint = " (nan: unknown)" if unknown else ""
            raise InputError(
                f"contains {found[~good][0]:g}, which is not finite; give finite numbers{hint}", field=name
            )
    if least > -math.inf and (found < least).any():
        raise InputError(f"contains {np.nanmin(found):g}; expected numbers of at least {least:g}", field=name)
    return found


def vectors(name: str, value: Any) -> NDArray[np.float64]:
    """Return an argument that must be one vector (3,), or several (n, 3), of any real numbers."""
    found = _real(name, value)
    return numbers(name, found, *((3,) if found.ndim == 1 else (None, 3)), finite=False)


def whole_numbers(name: str, value: Any, size: int) -> NDArray[np.int64]:
    """Return an argument that must be an array of ``size`` whole numbers; the same object if it is one of int64."""
    import numpy as np

    if type(value) is np.ndarray and value.dtype.kind in "iu" and value.shape == (size,):
        return value.astype(np.int64, copy=False)
    found = numbers(name, value, size)
    if not (np.round(found) == found).all() or (np.abs(found) >= 2.0**53).any():
        raise InputError("contains a number that is not whole", field=name)
    return found.astype(np.int64)


def _real(name: str, value: Any) -> NDArray[np.float64]:
    """Return an argument as an array of float64; InputError for masked, complex, boolean and ragged ones, and for text."""
    import numpy as np

    if isinstance(value, np.ma.MaskedArray):
        raise InputError("is a masked array; give the numbers alone, or nan where that is allowed", field=name)
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    try:
        found = np.asarray(value)
    except ValueError:
        raise InputError("has rows of different lengths; expected an array of numbers", field=name) from None
    if found.dtype.kind not in _REAL and found.size:
        what = {"c": "complex numbers", "b": "truth values", "O": "objects", "U": "text", "S": "text"}
        kind = what.get(found.dtype.kind, f"{found.dtype}")
        got = kind if found.ndim else _described(value)
        raise InputError(f"contains {got}; expected an array of real numbers", field=name)
    return found.astype(np.float64)


def _is_array(value: Any) -> bool:
    return type(value).__module__.partition(".")[0] == "numpy" and hasattr(value, "dtype") and hasattr(value, "shape")


def _described(value: Any) -> str:
    """Return what was given, in a few words."""
    if isinstance(value, str | PathLike):
        return f"{'a path' if not isinstance(value, str) else 'the text'} {visible_line(value)[:60]!r}"
    if _is_array(value):
        return f"an array of shape {value.shape}"
    return "None" if value is None else f"an object of type {type(value).__name__}"
