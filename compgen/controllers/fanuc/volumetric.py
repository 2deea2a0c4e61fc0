"""FANUC three-dimensional error compensation: a grid of vertices over X, Y, Z with trilinear interpolation.

The formula is documented, the file is not: the grid is written as a neutral CSV and as a JSON plan, and as records only
in the style of a file that was punched from the user's own control. See ``templates/fanuc-3d/format.toml``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controllers.fanuc.volumetric_context import volume_context
from compgen.controllers.fanuc.volumetric_settings import VolumeSettings, read_volume_settings
from compgen.controllers.fanuc.volumetric_tables import VolumeTable, parse_volume, volume_usage, volume_violations
from compgen.controllers.grids import STEP_QUANTUM, Grid, equidistant_grid
from compgen.controllers.terms import one_dimensional_terms, product_terms
from compgen.controllers.transfer_plan import plan_contradictions
from compgen.controllers.trilinear import trilinear
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.points import Points
from compgen.model.volumetric import tool_of


class Fanuc3d(Controller[VolumeSettings, VolumeTable]):
    """Corrections of X, Y and Z at the vertices of a grid, zero at the vertex of the reference point."""

    name = "fanuc-3d"
    anchored = True
    sample_setting = "style_from"

    def read_settings(self, machine: Machine) -> VolumeSettings:
        """Check ``[controllers.fanuc-3d]``."""
        return read_volume_settings(machine)

    def basis(self, machine: Machine, settings: VolumeSettings, errors: ErrorTable) -> list[Term]:
        """Return curves of one axis, alone and times the coordinate of another; a trilinear grid holds them exactly.

        Their nodes are the vertices. All vanish at the reference point, one of the vertices.
        """
        nodes = [
            equidistant_grid(
                machine,
                errors,
                axis,
                most=settings.most_points,
                step_mm=settings.interval_mm[axis],
                anchor=True,
                loss_mm=settings.loss_mm,
            ).nodes_mm
            for axis in range(3)
        ]
        origin = machine.reference_point_mm
        pairs = [(output, axis) for output in range(3) for axis in range(3)]
        single = one_dimensional_terms(machine, errors, nodes, pairs, anchored=True, lever_origin_mm=origin)
        return single + product_terms(machine, errors, nodes, origin)

    def build(
        self, machine: Machine, settings: VolumeSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> VolumeTable:
        """Round the field at every vertex.

        Trilinear interpolation is a weighted mean of the corners of a box, so that no point is off by more than a
        vertex: half a count. No other whole numbers stay within half a count at every vertex.
        """
        nodes = [next(term.nodes_mm for term in basis if term.axis == axis) for axis in range(3)]
        position = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)
        tool = tool_of(machine, None)
        field = np.zeros_like(position)
        for term in basis:
            field += term.carrier_field(position, tool) * term.curve(values[term.name], position)[:, None]
        count_mm = np.array([settings.count_mm(axis) for axis in range(3)])
        counts = np.floor(settings.sign * field / count_mm + 0.5).astype(np.int64)
        shape = (len(nodes[0]), len(nodes[1]), len(nodes[2]), 3)
        grids = [_grid(machine, axis, nodes[axis]) for axis in range(3)]
        return VolumeTable((grids[0], grids[1], grids[2]), counts.reshape(shape), settings.magnification)

    def context(self, machine: Machine, settings: VolumeSettings, tables: VolumeTable) -> dict[str, Any]:
        """Return the vertices, the plan point number -> values, what to set, and the statement of the sign."""
        return volume_context(machine, settings, tables)

    def parse(self, machine: Machine, settings: VolumeSettings, files: Sequence[SourceFile]) -> VolumeTable:
        """Read the CSV, and records in the style of the control, which must hold the same."""
        return parse_volume(machine, settings, files)

    def contradictions(
        self, machine: Machine, settings: VolumeSettings, tables: VolumeTable, files: Sequence[SourceFile]
    ) -> list[str]:
        """Say where a plan beside the text differs from it."""
        return plan_contradictions(files, lambda: self.context(machine, settings, tables)["plan"])

    def emulate(self, machine: Machine, settings: VolumeSettings, tables: VolumeTable, points: Points) -> FloatArray:
        """Return sign * count * trilinear value, that of the grid's surface outside."""
        count_mm = np.array(tables.magnification) * settings.count_mm(0) / settings.magnification[0]
        value = trilinear(tables.counts.astype(np.float64), tables.start_mm, tables.step_mm, points.position_mm)
        return np.asarray(settings.sign * count_mm * value)

    def violations(self, machine: Machine, settings: VolumeSettings, tables: VolumeTable) -> list[str]:
        """Return values out of range, too many vertices, travel left out."""
        return volume_violations(machine, settings, tables)

    def table_nodes_mm(self, machine: Machine, settings: VolumeSettings, tables: VolumeTable) -> tuple[FloatArray, ...]:
        """Return the vertices along each axis."""
        return nodes_by_axis((axis, grid.nodes_mm) for axis, grid in enumerate(tables.grids))

    def usage(self, machine: Machine, settings: VolumeSettings, tables: VolumeTable) -> list[Usage]:
        """Return values and vertices against their limits."""
        return volume_usage(settings, tables)

    def resolution_mm(self, settings: VolumeSettings) -> float:
        """Return half a count, see :meth:`build`."""
        return 0.5 * max(settings.count_mm(axis) for axis in range(3))


def _grid(machine: Machine, axis: int, nodes_mm: FloatArray) -> Grid:
    """Exact grid of nodes (n,), one of them at the reference point."""
    length = Decimal(repr(round(float(nodes_mm[-1] - nodes_mm[0]), 9)))
    step = (length / (len(nodes_mm) - 1)).quantize(STEP_QUANTUM)
    reference = machine.reference_point_mm[axis]
    below = int(np.argmin(np.abs(nodes_mm - reference)))
    return Grid(Decimal(repr(reference)) - below * step, step, len(nodes_mm))
