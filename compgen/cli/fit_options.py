"""What ``volcomp fit`` and ``volcomp run`` may be told about the fit, and where the fit finds the covariance."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import NUMBER, Command
from compgen.core.error_table import ErrorTable
from compgen.core.files import read_bytes, sha256_of
from compgen.errors import CompgenWarning, InputError
from compgen.fit import FitOptions
from compgen.identify import Covariance, read_covariance

_WHERE = "NAME is an error (EXX), or linear or angular for all of that kind; may be given several times."
_HELP = {
    "smoothness": "Dimensionless weight of the second differences (0 keeps the data); default: chosen from the data.",
    "max_abs": f"Largest magnitude of a fitted curve, um or urad. {_WHERE}",
    "max_slope": "Largest slope of a fitted curve, um/m or urad/m. NAME as above.",
    "max_curvature": "Largest second derivative of a fitted curve, um/m^2 or urad/m^2. NAME as above.",
    "monotone": "NAME=increasing or NAME=decreasing: the fitted curve goes one way only. NAME is an error, no straightness.",
    "robust": "Huber's loss instead of squares: single nodes far off do not bend the curve.",
}
_BOUNDS = ("max_abs", "max_slope", "max_curvature", "monotone")


def fitting_options(command: Command) -> Command:
    """Add smoothness, bounds and loss; the command receives ``fitting``, a FitOptions."""

    @functools.wraps(command)
    def wrapper(*args: Any, smoothness: float | None, robust: bool, **options: Any) -> Any:
        pairs = {key: _pairs(key, options.pop(key)) for key in _BOUNDS}
        largest, steepest, bent = (
            {name: _number(key, name, text) for name, text in pairs[key].items()} for key in _BOUNDS[:3]
        )
        fitting = FitOptions.from_file_units(smoothness, largest, steepest, bent, pairs["monotone"], robust=robust)
        return command(*args, fitting=fitting, **options)

    decorated: Any = click.option("--robust", is_flag=True, help=_HELP["robust"])(wrapper)
    for key in reversed(_BOUNDS):
        value = "NAME=WAY" if key == "monotone" else "NAME=LIMIT"
        option = f"--{key.replace('_', '-')}"
        decorated = click.option(option, key, metavar=value, multiple=True, help=_HELP[key])(decorated)
    return click.option("--smoothness", type=NUMBER, help=_HELP["smoothness"])(decorated)  # type: ignore[no-any-return]


def _pairs(key: str, given: Sequence[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for text in given:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals and value):
            raise InputError(f"{text!r} is not of the form NAME=VALUE, for example EXX=20", field=_option(key))
        if name in found:
            raise InputError(f"{name} is given twice; give it once", field=_option(key))
        found[name] = value
    return found


def _number(key: str, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{text!r} for {name} is not a number; give one above 0", field=_option(key)) from None


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"


def covariance_options(command: Command) -> Command:
    """Add --covariance and --independent."""
    given = click.option(
        "--covariance",
        type=click.Path(path_type=Path),
        help="Covariance of ERRORS (default: the file beside it that it names, if that belongs to it).",
    )
    none = click.option("--independent", is_flag=True, help="Use no covariance: u_value, node by node.")
    return given(none(command))


def covariance_of(errors: Path, table: ErrorTable, given: Path | None, *, independent: bool) -> Covariance | None:
    """Return the covariance of an errors file: the one given, else the one that it names, else None.

    A file that is named and beside, but belongs to other errors, is not used, with a warning.
    """
    if independent:
        if given is not None:
            raise InputError("--covariance and --independent exclude each other; give one of them")
        return None
    if given is not None:
        return read_covariance(given, errors)
    name = table.metadata.get("covariance")
    beside = errors.parent / name if name else None
    if beside is None or not beside.is_file():
        return None
    found = read_covariance(beside)
    if found.errors_sha256 == sha256_of(read_bytes(errors)):
        return found
    warnings.warn(
        f"{beside} belongs to another version of {errors.name}, so u_value is taken as independent from node to node",
        CompgenWarning,
        stacklevel=2,
    )
    return None
