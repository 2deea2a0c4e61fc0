"""``neutral``: the correction field on a grid and the 21 error curves, as CSV and JSON, for every other control.

The formats are this program's own; ``docs/files.md`` has their schemas. The field is what must be ADDED to the command,
the curves are the ERRORS (ISO 230-1) that it takes out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controllers.grids import take_loss_mm, uneven_nodes_mm
from compgen.controllers.neutral.tables import (
    CURVE_DIGITS,
    FIELD_DIGITS,
    POSITION_DIGITS,
    NeutralTables,
    curve_correction,
    curves_from,
    field_from,
)
from compgen.controllers.neutral.text import parse_neutral
from compgen.controllers.terms import error_terms
from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM, error_named
from compgen.core.points import Points

#: Field and curves may differ at the vertices by this much beside rounding, before it is reported.
AGREEMENT_MM = 1e-6
_TOOL_DIFFERENCE_MM = 1e-6


@dataclass(frozen=True)
class NeutralSettings:
    """``max_nodes`` per axis of the grid, and the loss between nodes that is worth no further one."""

    max_nodes: int
    loss_mm: float


class Neutral(Controller[NeutralSettings, NeutralTables]):
    """Neutral CSV and JSON: field on a grid, and curves."""

    name = "neutral"

    def read_settings(self, machine: Machine) -> NeutralSettings:
        """Check the settings; all have defaults."""
        section = machine.controller_settings(self.name)
        settings = NeutralSettings(section.take("max_nodes", tomlio.whole(2, 200), 61), take_loss_mm(section))
        section.finish()
        return settings

    def basis(self, machine: Machine, settings: NeutralSettings, errors: ErrorTable) -> list[Term]:
        """Return one term per error, with nodes where the curves need them."""
        nodes = [
            uneven_nodes_mm(machine, errors, axis, loss_mm=settings.loss_mm, most=settings.max_nodes)
            for axis in range(3)
        ]
        return error_terms(machine, errors, nodes)

    def build(
        self, machine: Machine, settings: NeutralSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> NeutralTables:
        """Return the curves, and the field that they give with the machine's tool, rounded as written."""
        curves = curves_from(basis, values)
        return NeutralTables(field_from(machine, curves, settings.loss_mm, settings.max_nodes), curves)

    def context(self, machine: Machine, settings: NeutralSettings, tables: NeutralTables) -> dict[str, Any]:
        """Return field and curves in the units of the files, and the signs with worked numbers."""
        return {
            "sign_statement": (
                "The field (cx_um, cy_um, cz_um) is what must be ADDED to the command at the commanded machine position: "
                "cx_um = -5 at X = 100 mm means that X = 99.995 mm must be commanded. The curves are ERRORS as ISO 230-1 "
                "defines them (actual minus commanded tool position relative to the workpiece): EXX = +5 um."
            ),
            "parameters": [],
            "warnings": [],
            "position_digits": POSITION_DIGITS,
            "field_digits": FIELD_DIGITS,
            "curve_digits": CURVE_DIGITS,
            "field": _field_context(tables),
            "errors": _curve_context(tables),
        }

    def parse(self, machine: Machine, settings: NeutralSettings, files: Sequence[SourceFile]) -> NeutralTables:
        """Read any of the four files."""
        return parse_neutral(files)

    def emulate(self, machine: Machine, settings: NeutralSettings, tables: NeutralTables, points: Points) -> FloatArray:
        """Return the trilinear field; the curves (E = C P) without a field, or for points with another tool."""
        position = np.asarray(points.position_mm, dtype=np.float64)
        other_tool = points.tool_mm is not None and bool(
            np.any(np.abs(points.tool_mm - np.array(machine.tool_offset_mm)) > _TOOL_DIFFERENCE_MM)
        )
        if tables.curves is not None and (tables.field is None or other_tool):
            return curve_correction(machine, tables.curves, position, points.tool_mm)
        assert tables.field is not None  # parse and build give one of the two at least
        return tables.field.at(position)

    def violations(self, machine: Machine, settings: NeutralSettings, tables: NeutralTables) -> list[str]:
        """Return files that contradict each other, and travel that the field or a curve does not cover."""
        found = list(tables.conflicts)
        if tables.field is not None:
            for axis, nodes in enumerate(tables.field.nodes_mm):
                found += coverage_violations(machine, axis, float(nodes[0]), float(nodes[-1]), "the field")
        if tables.curves is not None:
            for name, curve in tables.curves.curves.items():
                first, last = float(curve.position_mm[0]), float(curve.position_mm[-1])
                found += coverage_violations(machine, error_named(name).axis, first, last, name)
        if tables.field is not None and tables.curves is not None:
            lines = tables.field.nodes_mm
            vertices = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
            due = curve_correction(machine, tables.curves, vertices, None)
            miss = np.abs(due - tables.field.correction_um.reshape(-1, 3) * MM_PER_UM)
            if np.max(miss) > AGREEMENT_MM:
                worst = vertices[int(np.argmax(np.max(miss, axis=1)))]
                place = ", ".join(f"{letter} {value:g}" for letter, value in zip(AXES, worst, strict=True))
                found.append(
                    f"field and curves differ by {np.max(miss) / MM_PER_UM:.3f} um at {place} mm: they are of different "
                    "exports, or the machine file has another chain or tool"
                )
        return found

    def usage(self, machine: Machine, settings: NeutralSettings, tables: NeutralTables) -> list[Usage]:
        """Return the nodes of the field per axis against ``max_nodes``."""
        nodes = () if tables.field is None else tables.field.nodes_mm
        return [
            Usage(f"nodes of {letter}", len(line), settings.max_nodes, "nodes", stated=False)
            for letter, line in zip(AXES, nodes, strict=False)
        ]

    def resolution_mm(self, settings: NeutralSettings) -> float:
        """Half of the last digit of the field."""
        return 0.5 * 10.0**-FIELD_DIGITS * MM_PER_UM

    def table_nodes_mm(
        self, machine: Machine, settings: NeutralSettings, tables: NeutralTables
    ) -> tuple[FloatArray, ...]:
        """Return the nodes of field and curves."""
        pairs = list(enumerate(tables.field.nodes_mm)) if tables.field is not None else []
        if tables.curves is not None:
            pairs += [(error_named(name).axis, curve.position_mm) for name, curve in tables.curves.curves.items()]
        return nodes_by_axis(pairs)


def _field_context(tables: NeutralTables) -> dict[str, Any] | None:
    if tables.field is None:
        return None
    lines = tables.field.nodes_mm
    vertices = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    values = tables.field.correction_um.reshape(-1, 3)
    return {
        "nodes": [line.tolist() for line in lines],
        "positions": vertices.tolist(),
        "corrections": values.tolist(),
        "rows": len(vertices),
    }


def _curve_context(tables: NeutralTables) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for name in () if tables.curves is None else tables.curves.names:
        error = error_named(name)
        if tables.curves is not None and name in tables.curves.squareness:
            values: list[float] = [tables.curves.squareness[name][0] / error.si_per_unit]
            positions: list[float] = []
        elif tables.curves is not None:
            curve = tables.curves.curves[name]
            values, positions = (curve.value / error.si_per_unit).tolist(), curve.position_mm.tolist()
        found.append({"name": name, "unit": error.unit, "positions": positions, "values": values})
    return found
