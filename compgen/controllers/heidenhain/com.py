"""HEIDENHAIN compensation-value tables: .COM files over each axis and the .CMA file that assigns them.

Sources: TNC 407/415/425 technical manual (01.98), p. 151-156, 622; MANUALplus 620 technical manual, p. 708, 716, 718;
iTNC 530 HSCI technical manual (07.2013), p. 647-686. What none of them settles stands in
``templates/heidenhain-com/format.toml``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controllers.heidenhain.context import com_context, reversal_parameters
from compgen.controllers.heidenhain.grid import com_nodes_mm, written_positions
from compgen.controllers.heidenhain.settings import HeidenhainSettings, read_heidenhain_settings
from compgen.controllers.heidenhain.tables import ComTable, ComTables, com_usage, com_violations, parse_com
from compgen.controllers.terms import one_dimensional_name, one_dimensional_terms
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.points import Points
from compgen.core.reversal import WORTH_MM, ReversalCurves


class HeidenhainCom(Controller[HeidenhainSettings, ComTables]):
    """Tables of each axis over each axis: positioning, straightness, squareness; no products, no constant lever arm."""

    name = "heidenhain-com"
    bidirectional = True
    sample_setting = "template_from"

    def read_settings(self, machine: Machine) -> HeidenhainSettings:
        """Check ``[controllers.heidenhain-com]``."""
        return read_heidenhain_settings(machine)

    def basis(self, machine: Machine, settings: HeidenhainSettings, errors: ErrorTable) -> list[Term]:
        """Return nine terms: each axis as a function of each axis; those over one axis share their nodes."""
        nodes = [com_nodes_mm(machine, settings, errors, axis) for axis in range(3)]
        pairs = [(output, axis) for axis in range(3) for output in range(3)]
        return one_dimensional_terms(machine, errors, nodes, pairs)

    def build(
        self, machine: Machine, settings: HeidenhainSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> ComTables:
        """Round the entries, with the sign of the control, and let the end values go on beyond the ends."""
        terms = {term.name: term for term in basis}
        tables = {}
        for axis in range(3):
            nodes_mm = terms[one_dimensional_name(axis, axis)].nodes_mm
            positions, before = written_positions(settings, axis, nodes_mm)
            after = len(positions) - before - len(nodes_mm)
            columns = {
                output: _rounded(
                    np.pad(values[one_dimensional_name(output, axis)], (before, after), mode="edge") * settings.sign,
                    settings.decimals,
                )
                for output in range(3)
            }
            tables[axis] = ComTable(positions, columns)
        return ComTables(tables)

    def context(self, machine: Machine, settings: HeidenhainSettings, tables: ComTables) -> dict[str, Any]:
        """Return layouts and cells of the four files, parameters, sign with a number from the files, warnings."""
        return com_context(machine, settings, tables)

    def parse(self, machine: Machine, settings: HeidenhainSettings, files: Sequence[SourceFile]) -> ComTables:
        """Read the .CMA file and every .COM file that it names."""
        return parse_com(settings, files)

    def emulate(self, machine: Machine, settings: HeidenhainSettings, tables: ComTables, points: Points) -> FloatArray:
        """Return minus (``sign = "correction"``: plus) the sum of the entries, linear between nodes, held outside."""
        total = np.zeros((len(points), 3))
        for axis, table in tables.tables.items():
            along = points.position_mm[:, axis]
            for output in table.columns:
                total[:, output] += table.at(output, along)
            backlash = table.backlash_at(along)
            if backlash is not None:
                positive = table.at(axis, along) if axis in table.columns else np.zeros(len(points))
                step = backlash - positive if settings.backlash == "absolute" else backlash
                total[:, axis] += step * _share_of_negative(points, axis)
        return settings.sign * total

    def violations(self, machine: Machine, settings: HeidenhainSettings, tables: ComTables) -> list[str]:
        """Return broken limits: entries, tables, spacing of the older controls, travel left out."""
        return com_violations(machine, settings, tables)

    def table_nodes_mm(
        self, machine: Machine, settings: HeidenhainSettings, tables: ComTables
    ) -> tuple[FloatArray, ...]:
        """Return the positions of each table."""
        return nodes_by_axis((axis, table.nodes_mm) for axis, table in tables.tables.items())

    def reversal_in_tables(self, settings: HeidenhainSettings, reversal: ReversalCurves) -> ReversalCurves:
        """Return what the column BACKLASH takes: reversals along the axis itself, unless it stays empty."""
        if settings.backlash == "empty":
            return ReversalCurves({})
        own = {key: curve for key, curve in reversal.curves.items() if key[0] == key[1]}
        return ReversalCurves(own, reversal.metadata)

    def with_reversal(
        self, machine: Machine, settings: HeidenhainSettings, tables: ComTables, reversal: ReversalCurves
    ) -> ComTables:
        """Put half of each reversal into the axis' own column and the other direction into the column BACKLASH.

        With the reversal B the tool stands at +B/2 after positive travel, so the correction is -B/2 then and +B/2
        after negative travel, beside what the curves say.
        """
        found = dict(tables.tables)
        for (axis, component), curve in reversal.curves.items():
            if axis != component or np.max(np.abs(curve.value)) < WORTH_MM:
                continue
            table = found[axis]
            half = -0.5 * settings.sign * curve.at(table.nodes_mm)
            entries = np.array([float(value) for value in table.columns[axis]])
            positive = _rounded(entries + half, settings.decimals)
            negative = _rounded(entries - half, settings.decimals)
            if settings.backlash == "difference":
                negative = tuple(b - a for a, b in zip(positive, negative, strict=True))
            found[axis] = replace(table, columns={**table.columns, axis: positive}, backlash=negative)
        return ComTables(found)

    def backlash_parameters(
        self, machine: Machine, settings: HeidenhainSettings, reversal: ReversalCurves
    ) -> list[dict[str, str]]:
        """Return the backlash parameter of each axis with a reversal along itself that no table holds."""
        return reversal_parameters(settings, reversal)

    def usage(self, machine: Machine, settings: HeidenhainSettings, tables: ComTables) -> list[Usage]:
        """Return entries, tables and slope against the limits."""
        return com_usage(settings, tables)

    def resolution_mm(self, settings: HeidenhainSettings) -> float:
        """Half of the last decimal of each of the three tables that act on an axis."""
        return 3 * 0.5 * 10.0**-settings.decimals


def _rounded(values_mm: FloatArray, decimals: int) -> tuple[Decimal, ...]:
    return tuple(Decimal(int(count)).scaleb(-decimals) for count in np.rint(values_mm * 10**decimals))


def _share_of_negative(points: Points, axis: int) -> FloatArray:
    """1 after negative travel of the axis, 0 after positive travel, one half where it is not known: the mean."""
    if points.approach is None:
        return np.full(len(points), 0.5)
    return 0.5 - 0.5 * np.sign(points.approach[:, axis])
