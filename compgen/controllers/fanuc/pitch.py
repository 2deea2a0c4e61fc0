"""FANUC stored pitch error compensation: positioning of X, Y and Z, whole-number increments per section of travel.

What the control is taken to do, and how sure that is, stands in ``templates/fanuc-pitch/format.toml``.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.controllers.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controllers.fanuc.pitch_build import tables_of, wanted_curves
from compgen.controllers.fanuc.pitch_context import backlash_rows, pitch_context
from compgen.controllers.fanuc.pitch_grid import pitch_grid
from compgen.controllers.fanuc.pitch_limits import pitch_usage, pitch_violations
from compgen.controllers.fanuc.pitch_settings import PitchSettings, read_pitch_settings
from compgen.controllers.fanuc.pitch_tables import PitchBlock, PitchTables, parse_pitch
from compgen.controllers.fanuc.sample import as_sample
from compgen.controllers.terms import one_dimensional_terms
from compgen.controllers.transfer_plan import plan_contradictions
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.points import Points
from compgen.core.reversal import ReversalCurves
from compgen.errors import CompgenWarning


class FanucPitch(Controller[PitchSettings, PitchTables]):
    """Tables X(x), Y(y), Z(z) as numbers of counts, zero at the reference point."""

    name = "fanuc-pitch"
    anchored = True
    bidirectional = True
    sample_setting = "style_from"

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
        return tables_of(machine, settings, wanted_curves(machine, settings, basis, values))

    def reversal_in_tables(self, settings: PitchSettings, reversal: ReversalCurves) -> ReversalCurves:
        """Return the reversal of each axis along itself if ``bidirectional`` is set, else none."""
        along = {key: curve for key, curve in reversal.curves.items() if key[0] == key[1]}
        return ReversalCurves(along if settings.bidirectional else {})

    def with_reversal(
        self, machine: Machine, settings: PitchSettings, tables: PitchTables, reversal: ReversalCurves
    ) -> PitchTables:
        """Return the tables of both directions, each the best whole numbers for its own curve."""
        return tables_of(machine, settings, tables.wanted, reversal)

    def context(self, machine: Machine, settings: PitchSettings, tables: PitchTables) -> dict[str, Any]:
        """Return records, the plan point number -> value, the parameters to set and the statement of the sign."""
        return pitch_context(machine, settings, tables)

    def parse(self, machine: Machine, settings: PitchSettings, files: Sequence[SourceFile]) -> PitchTables:
        """Read parameters 3620 ... 3624 and the points they name; a ``.json`` plan is passed over."""
        return parse_pitch(settings, files)

    def contradictions(
        self, machine: Machine, settings: PitchSettings, tables: PitchTables, files: Sequence[SourceFile]
    ) -> list[str]:
        """Say where a plan beside the text differs from it."""
        return plan_contradictions(files, lambda: self.context(machine, settings, tables)["plan"])

    def remarks(
        self, machine: Machine, settings: PitchSettings, tables: PitchTables, files: Sequence[SourceFile]
    ) -> list[str]:
        """Say which unit was assumed, which axes were kept apart, and how many records were passed over."""
        return list(tables.remarks)

    def emulate(self, machine: Machine, settings: PitchSettings, tables: PitchTables, points: Points) -> FloatArray:
        """Return sign * count * A at each point, A held beyond the first and the last section end."""
        added = np.zeros((len(points), 3))
        unknown = []
        for axis, block in enumerate(tables.blocks):
            if block is None:
                continue
            along = points.position_mm[:, axis] - machine.reference_point_mm[axis]
            count_mm = block.magnification * settings.detection_unit_um * MM_PER_UM
            up, down = (
                _output(settings, block, curve, along) for curve in block.curves(settings.reference_return[axis])
            )
            travel = np.zeros(len(points)) if points.approach is None else np.sign(points.approach[:, axis])
            counts = np.where(travel > 0, up, np.where(travel < 0, down, 0.5 * (up + down)))
            added[:, axis] = settings.sign * count_mm * counts
            if np.any((travel == 0) & (up != down)):
                unknown.append(AXES[axis])
        if unknown:
            message = (
                f"the tables of {', '.join(unknown)} differ between the directions of travel, and some points do not say "
                "from where they were approached: there the mean is taken; give approach_x, approach_y, approach_z"
            )
            warnings.warn(message, CompgenWarning, stacklevel=2)
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

    def keeping_others(
        self, machine: Machine, settings: PitchSettings, tables: PitchTables, files: Sequence[Path]
    ) -> dict[str, dict[str, Any]]:
        """Return ``style_from`` with these files if they show points of other axes."""
        return as_sample(machine, files, ("fanuc-pitch", "fanuc-straightness")) if tables.others else {}

    def resolution_mm(self, settings: PitchSettings) -> float:
        """Return half a count: the bound of :mod:`compgen.controllers.integers` where the limit does not bind."""
        return 0.5 * max(settings.count_mm(axis) for axis in range(3))


def _output(settings: PitchSettings, block: PitchBlock, curve: NDArray[np.int64], along_mm: FloatArray) -> FloatArray:
    """Counts of a cumulative curve (m,) at positions (n,) from the reference point, shape (n,)."""
    if settings.interpolation == "linear":
        return np.interp(along_mm, block.curve_mm, curve)
    return _staircase(block, curve, along_mm).astype(np.float64)


def _staircase(block: PitchBlock, curve: NDArray[np.int64], along_mm: FloatArray) -> NDArray[np.int64]:
    """Curve where a section's value is put out at its beginning: A[n] for ((n-1-ref) d, (n-ref) d], shape (n,)."""
    section = np.ceil(along_mm / float(block.interval_mm) - 1e-9) + block.reference
    inside = np.clip(section, block.curve_numbers[0], block.last).astype(np.int64)
    return np.asarray(curve[inside - block.curve_numbers[0]], dtype=np.int64)
