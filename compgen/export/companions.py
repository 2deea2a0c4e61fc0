"""Files that a user's own templates make beside those of a control: for controls whose format is not public.

Some volumetric compensations (SINUMERIK VCS) have no public file format. Whoever knows the format of the own control puts
a template ``<templates>/<control>/companion/<file name>.j2`` into a folder of templates; it gets the 21 errors as
``errors21`` beside everything that the control's own templates get. Such a file is written and named with its SHA-256,
but nothing can be read back from it: what is verified are the files of the control alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, ERRORS
from compgen.errors import InputError
from compgen.export.render import OWN_FILES, Format, render

FOLDER, SUFFIX, CRLF_SUFFIX = "companion", ".j2", ".crlf.j2"


def errors_context(machine: Machine, errors: ErrorTable) -> list[dict[str, Any]]:
    """Return all 21 errors in the order of ISO 230-1's names, in the conventions of the program.

    Each has ``name``, ``kind`` (linear, angular, squareness), ``axis`` (X, Y, Z, or "" for a squareness), ``unit``
    (mm or rad), ``position_mm`` and ``value`` (lists of one length; a squareness has no position and one value) and
    ``known``: an error that the input does not hold is zero.
    """
    return [_error(machine, errors, item.name, item.kind, item.axis) for item in ERRORS]


def _error(machine: Machine, errors: ErrorTable, name: str, kind: str, axis: int) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": name, "kind": kind, "unit": "mm" if kind == "linear" else "rad"}
    if kind == "squareness":
        known = name in errors.squareness
        value = [errors.squareness[name][0] if known else 0.0]
        return {**entry, "axis": "", "position_mm": [], "value": value, "known": known}
    curve = errors.curves.get(name)
    position = machine.axes[axis].nodes_mm if curve is None else curve.position_mm
    values = [0.0] * len(position) if curve is None else [float(value) for value in curve.value]
    where = [float(value) for value in position]
    return {**entry, "axis": AXES[axis], "position_mm": where, "value": values, "known": curve is not None}


def companion_files(
    card: Format, context: Mapping[str, Any], taken: Mapping[str, str], folder: Path | None
) -> dict[str, str]:
    """Render the templates ``<folder>/<control>/companion/*.j2`` and return the texts by file name.

    Parameters
    ----------
    card : format of the control.
    context : what the templates get.
    taken : files of the control, whose names are not free.
    folder : the user's templates, None: there are none.

    Raises
    ------
    InputError
        for a template that cannot be rendered, and a file name that is taken.
    """
    found: dict[str, str] = {}
    if folder is None:
        return found
    for path in sorted((folder / card.name / FOLDER).glob(f"*{SUFFIX}")):
        crlf = path.name.endswith(CRLF_SUFFIX)
        name = path.name.removesuffix(CRLF_SUFFIX if crlf else SUFFIX)
        if not name or name.startswith(".") or name.lower() in {*OWN_FILES, *map(str.lower, (*taken, *found))}:
            raise InputError(f"{name!r} is no free file name; name the template <file name>{SUFFIX}", file=path)
        text = render(card, f"{FOLDER}/{path.name}", context, folder)
        found[name] = text.replace("\n", "\r\n") if crlf else text
    return found
