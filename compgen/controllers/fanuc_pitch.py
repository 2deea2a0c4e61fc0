"""FANUC stored pitch error compensation: positioning of X, Y and Z, whole-number increments per section of travel.

What the control is taken to do, and how sure that is, stands in ``templates/fanuc-pitch/format.toml``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.controllers.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controllers.fanuc_pitch_context import backlash_rows, pitch_context
from compgen.controllers.fanuc_pitch_grid import pitch_grid
from compgen.controllers.fanuc_pitch_settings import PitchSettings, read_pitch_settings
from compgen.controllers.fanuc_pitch_tables import (
    PitchBlock,
    PitchTables,
    Shortfall,
    parse_pitch,
    pitch_usage,
    pitch_violations,
)
from compgen.controllers.integers import IntegerCurve, best_integers, section_weights
from compgen.controllers.terms import one_dimensional_name, one_dimensional_terms
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.core.points import Points
from compgen.core.reversal import ReversalCurves


class FanucPitch(Controller[PitchSettings, PitchTables]):
    """Tables X(x), Y(y), Z(z) as numbers of counts, zero at the reference point."""

    name = "fanuc-pitch"
    anchored = True

    def read_settings(self, machine: Machine) -> PitchSettings:
        """Check ``[controllers.fanuc-pitch]``."""
        return read_pitch_settings(machine)

    def basis(self, machine: Machine, settings: PitchSettings, errors: ErrorTable) -> list[Term]:
        """Return one table per axis whose nodes are the section ends, the reference point one of them."""
        nodes = [pitch_grid(machine, settings, errors, axis).nodes_mm for axis in range(3)]
        return one_dimensional_terms(machine, errors, nodes, [(axis, axis) for axis in range(3)], anchored=True)

    def build(
        self, machine: Machine, settings: PitchSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> PitchTables:
        """Find the best whole cumulative curves within the limit, and give the axes consecutive point numbers."""
        terms = {term.name: term for term in basis}
        blocks: list[PitchBlock | None] = [None, None, None]
        shortfalls: list[Shortfall] = []
        free = settings.first_number
        for axis in range(3):
            name = one_dimensional_name(axis, axis)
            if name in terms:
                nodes_mm = terms[name].nodes_mm
                best = _best_counts(machine, settings, axis, nodes_mm, values[name])
                block = _block(settings, nodes_mm - machine.reference_point_mm[axis], best.counts, free)
                blocks[axis], free = block, block.last + 1
                if best.limited:
                    sections = tuple(int(block.curve_numbers[k + 1]) for k in best.full_sections)
                    shortfalls.append(Shortfall(axis, best.largest, sections))
        return PitchTables((blocks[0], blocks[1], blocks[2]), shortfalls=tuple(shortfalls))

    def context(self, machine: Machine, settings: PitchSettings, tables: PitchTables) -> dict[str, Any]:
        """Return records, the plan point number -> value, the parameters to set and the statement of the sign."""
        return pitch_context(machine, settings, tables)

    def parse(self, machine: Machine, settings: PitchSettings, files: Sequence[SourceFile]) -> PitchTables:
        """Read parameters 3620 ... 3624 and the points they name; a ``.json`` plan among the files is passed over."""
        return parse_pitch(settings, files)

    def emulate(self, machine: Machine, settings: PitchSettings, tables: PitchTables, points: Points) -> FloatArray:
        """Return sign * count * A at each point, A held beyond the first and the last section end."""
        added = np.zeros((len(points), 3))
        for axis, block in enumerate(tables.blocks):
            if block is None:
                continue
            along = points.position_mm[:, axis] - machine.reference_point_mm[axis]
            count_mm = block.magnification * settings.detection_unit_um * MM_PER_UM
            if settings.interpolation == "linear":
                counts = np.interp(along, block.curve_mm, block.curve)
            else:
                counts = _staircase(block, along).astype(np.float64)
            added[:, axis] = settings.sign * count_mm * counts
        return added

    def violations(self, machine: Machine, settings: PitchSettings, tables: PitchTables) -> list[str]:
        """Return broken limits: change per section, 16 bits, point numbers, overlaps, interval, travel left out."""
        return pitch_violations(machine, settings, tables)

    def table_nodes_mm(self, machine: Machine, settings: PitchSettings, tables: PitchTables) -> tuple[FloatArray, ...]:
        """Return the section ends of each axis."""
        blocks = ((axis, block) for axis, block in enumerate(tables.blocks) if block is not None)
        return nodes_by_axis((axis, machine.reference_point_mm[axis] + block.curve_mm) for axis, block in blocks)

    def backlash_parameters(
        self, machine: Machine, settings: PitchSettings, reversal: ReversalCurves
    ) -> list[dict[str, str]]:
        """Return parameter 1851 of each axis with a reversal along itself."""
        return backlash_rows(settings, reversal)

    def usage(self, machine: Machine, settings: PitchSettings, tables: PitchTables) -> list[Usage]:
        """Return change per section, point numbers and interval against their limits."""
        return pitch_usage(settings, tables)

    def resolution_mm(self, settings: PitchSettings) -> float:
        """Return half a count: the bound of :mod:`compgen.controllers.integers` where the limit does not bind."""
        return 0.5 * settings.count_mm


def _best_counts(
    machine: Machine, settings: PitchSettings, axis: int, nodes_mm: FloatArray, values_mm: FloatArray
) -> IntegerCurve:
    """Return the best cumulative curve in counts at the section ends for corrections (n,), zero at the reference."""
    below = _reference_node(nodes_mm - machine.reference_point_mm[axis])
    wanted = settings.sign * (np.asarray(values_mm) - values_mm[below]) / settings.count_mm
    emphasis = machine.emphasis
    sections = section_weights(nodes_mm, machine.axes[axis].range_mm, emphasis.zone_mm[axis], emphasis.zone_weight)
    return best_integers(wanted, sections, below, settings.increment_limit)


def _reference_node(along_mm: FloatArray) -> int:
    return int(np.argmin(np.abs(along_mm)))


def _block(settings: PitchSettings, along_mm: FloatArray, curve: NDArray[np.int64], free: int) -> PitchBlock:
    """Table of one axis from counts (n,) at section ends (n,) from the reference point, numbers from ``free``."""
    below = _reference_node(along_mm)
    # The reference number itself is always kept, also where no travel lies on its negative side.
    steps = np.diff(curve, prepend=[0]) if below == 0 else np.diff(curve)
    interval = Decimal(repr(float(along_mm[-1] - along_mm[0]))) / (len(along_mm) - 1)
    written = interval.quantize(settings.interval_quantum_mm).normalize()
    return PitchBlock(
        reference=free + (below if settings.total else max(below - 1, 0)),
        first=free,
        values=tuple(int(value) for value in (curve if settings.total else steps)),
        total=settings.total,
        magnification=settings.magnification,
        interval_mm=Decimal(f"{written:f}"),
    )


def _staircase(block: PitchBlock, along_mm: FloatArray) -> NDArray[np.int64]:
    """Curve where a section's value is put out at its beginning: A[n] for ((n-1-ref) d, (n-ref) d], shape (n,)."""
    section = np.ceil(along_mm / float(block.interval_mm) - 1e-9) + block.reference
    inside = np.clip(section, block.curve_numbers[0], block.last).astype(np.int64)
    return np.asarray(block.curve[inside - block.curve_numbers[0]], dtype=np.int64)
