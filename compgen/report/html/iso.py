"""Figures of ISO 230 in the report: those that stand in the folder, else those of the identified errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compgen.accuracy.errors import axis_figures, diagonal_figures
from compgen.accuracy.evaluate import groups_of_errors, statements_of, volume_fields
from compgen.accuracy.field import volume_figures
from compgen.accuracy.figure import Figure
from compgen.accuracy.source import Correction, error_source
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.errors import CompgenError
from compgen.report.html.folder import ResultFolder
from compgen.report.html.tables import read_back
from compgen.verify.verdict import coverage_of

#: Reference line of straightness and squareness.
LINE = "ls"
GROUPS = {
    "volume": "Volume (ISO 230-1)",
    "orientation": "Orientation of the tool over the volume (ISO 230-1)",
    "axes": "Positioning on the line through the reference point (ISO 230-2)",
    "diagonals": "Body diagonals (ISO 230-6)",
    "errors": "Single errors",
    "straightness": "Straightness by three reference lines",
    "reversal": "Reversal: both directions (ISO 230-2, ISO 230-6)",
    "squareness indication": "Squareness, an indication from the diagonals",
}

#: Groups that every error of the machine has a part in: without all of them they would claim what was not measured.
VOLUMETRIC = ("volume", "orientation", "diagonals", "squareness indication")


def accuracy_groups(source: ResultFolder) -> dict[str, Any]:
    """Return the figures by group with rows ``key, value, U, unit, meaning``, and what they stand for in words.

    Those of ``accuracy.json`` where it is there; else the machine as it was identified, and beside its positioning and
    diagonals what they become with the tables of each control as they were read back.
    """
    if source.accuracy:
        figures = source.accuracy.get("figures", {})
        groups = [{"name": GROUPS.get(name, name), "rows": _rows(group)} for name, group in figures.items()]
        return {"groups": groups, "statements": list(source.accuracy.get("statements", [])), "with_tables": []}
    if source.machine is None or source.identified is None:
        return {}
    try:
        return _of_errors(source, source.machine, source.identified)
    except (CompgenError, ValueError, LookupError):  # errors that do not fit the machine file of the folder
        return {}


def _of_errors(source: ResultFolder, machine: Machine, errors: ErrorTable) -> dict[str, Any]:
    given = error_source(machine, errors)
    ((full, pairs),) = volume_fields(machine, (given,), "axes")
    found: dict[str, Mapping[str, Figure]] = {"volume": volume_figures(full, pairs), **groups_of_errors(given, LINE)}
    found.pop("errors")  # they are shown with their curves
    coverage = coverage_of(machine, errors)
    for name in VOLUMETRIC if coverage.missing else ():
        found.pop(name, None)
    partial = f"{coverage.text}: no figure of the volume and its diagonals is given, for the other errors are not known"
    groups = [
        {"name": GROUPS[name], "rows": _rows({key: item.summary() for key, item in group.items()})}
        for name, group in found.items()
    ]
    independent = "uncertainties from those of the single values, taken as independent"
    return {
        "groups": groups,
        "statements": [
            *statements_of(machine, full, LINE),
            independent,
            "the machine as it was identified, without tables",
            *([partial] if coverage.missing else []),
        ],
        "with_tables": _with_tables(source, machine, errors),
    }


def _with_tables(source: ResultFolder, machine: Machine, errors: ErrorTable) -> list[dict[str, Any]]:
    """Positioning and diagonals of the machine with the tables of each control, um, by the name of the control."""
    found = []
    for control in source.controls:
        correction: Correction | None = read_back(machine, control)
        if correction is not None:
            moved = error_source(machine, errors, None, correction)
            figures = {**axis_figures(moved), **diagonal_figures(moved)}
            found.append({"name": control.name, "figures": {key: item.value for key, item in figures.items()}})
    return found


def _rows(group: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for key, item in group.items():
        if isinstance(item, Mapping):
            row = {name: item.get(name) for name in ("value", "unit", "meaning")}
            rows.append({"key": str(key), **row, "U": item.get("U_k2")})
    return rows


def comparison_groups(source: ResultFolder) -> dict[str, Any]:
    """Return ``compare.json`` in the order of the page: verdict, statements, groups of figures before and after."""
    data = source.compare
    if not data:
        return {}
    return {
        "kind": str(data.get("kind", "")),
        "verdict": str(data.get("verdict", "")),
        "improved": bool(data.get("improved")),
        "decided_by": [str(item) for item in data.get("decided_by", [])],
        "statements": [str(item) for item in data.get("statements", [])],
        "groups": [_compared(name, group) for name, group in dict(data.get("figures", {})).items()],
        "prediction": data.get("prediction"),
    }


def _compared(name: str, group: Any) -> dict[str, Any]:
    rows = []
    for key, item in group.items() if isinstance(group, Mapping) else ():
        before, after = item.get("before") or {}, item.get("after") or {}
        row = {"key": str(key), "unit": before.get("unit", ""), "meaning": before.get("meaning", "")}
        row |= {"before": before.get("value"), "before_U": before.get("U_k2")}
        row |= {"after": after.get("value"), "after_U": after.get("U_k2")}
        rows.append({**row, **{name: item.get(name) for name in ("factor", "u_factor", "en", "verdict")}})
    return {"name": GROUPS.get(name, name), "rows": rows}
