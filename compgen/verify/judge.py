"""The judgement on a correction: the best that a control could do is prepared once, any correction is held against it.

It knows nothing of files: ``verify`` gives it what parsed tables do, the sign crash test what wrong ones would do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.controllers import AnyController
from compgen.controllers.grids import curve_nodes_mm
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.export.synthesis import Projector, best_values, projector
from compgen.model.exact import exact_error
from compgen.model.grid import VolumeGrid, volume_grid
from compgen.model.volumetric import tool_of
from compgen.verify.components import components, rms
from compgen.verify.residuals import residuals, without_rigid_motion
from compgen.verify.scan import displacement_uncertainty, point_reasons, scan_lines

#: One entry of a table may move the tip by this share of the largest correction without its linear part, or this much.
GOAL_SHARE, GOAL_MM = 0.03, 1.0 * MM_PER_UM
#: A component of the correction may miss the best possible one by this share of it ...
COMPONENT_SHARE = 0.3
#: ... or by this much, whichever is larger; the quantum of the format comes on top, and this many standard
#: uncertainties of the errors (what smoothing may take away), up to COMPONENT_SHARE of the whole correction.
COMPONENT_FLOOR_MM = 0.2 * MM_PER_UM
COMPONENT_UNCERTAINTIES = 0.5


@dataclass(frozen=True)
class Judge:
    """What a correction is held against: the best one of the control, on a grid over the volume and on lines.

    Parameters
    ----------
    solver, values : the control's basis over the volume, and the best values in it before rounding.
    grid, best_mm : points (n, 3) over the volume, nodes and middles, and the best correction there (n, 3).
    line_mm, line_best_mm : points (m, 3) on lines along the axes, and the best correction there (m, 3).
    bent_mm : largest range of the best correction of an axis without its linear part.
    goal_mm : what one entry of a table may move the tip by and still pass.
    slack_mm, u_mm : what quantum and uncertainty explain of a component, and the uncertainty of E, shapes (3,).
    resolution_mm : largest error of the format's rounding.
    """

    machine: Machine
    errors: ErrorTable
    solver: Projector
    values: FloatArray
    grid: VolumeGrid
    best_mm: FloatArray
    line_mm: FloatArray
    line_best_mm: FloatArray
    bent_mm: float
    goal_mm: float
    slack_mm: FloatArray
    u_mm: FloatArray
    resolution_mm: float

    def reasons(self, grid_correction_mm: FloatArray, line_correction_mm: FloatArray) -> list[str]:
        """Say why a correction, given on the grid (n, 3) and on the lines (m, 3), is not acceptable; empty if it is."""
        return [
            *self.shrink_reasons(grid_correction_mm),
            *self.component_reasons(grid_correction_mm),
            *point_reasons(
                self.line_mm, line_correction_mm, self.line_best_mm, self.bent_mm, self.u_mm, self.resolution_mm
            ),
        ]

    def component_reasons(self, correction_mm: FloatArray) -> list[str]:
        """Name every component of the correction (n, 3) that misses the best possible one by more than its share."""
        fields = (correction_mm - self.best_mm, self.best_mm, correction_mm)
        miss, best, own = (components(self.grid, part) for part in fields)
        reasons = []
        for name in miss:
            limit = max(COMPONENT_SHARE * rms(best[name]), COMPONENT_FLOOR_MM) + self.slack_mm[AXES.index(name[0])]
            if rms(miss[name]) > limit:
                ratio = np.sum(own[name] * best[name]) / max(float(np.sum(best[name] ** 2)), 1e-30)
                hint = "; its sign is reversed" if abs(ratio + 1) < 0.1 else ""
                reasons.append(
                    f"correction {name}: {rms(own[name]) / MM_PER_UM:.2f} um rms in the table, "
                    f"{rms(best[name]) / MM_PER_UM:.2f} um rms needed, they differ by "
                    f"{rms(miss[name]) / MM_PER_UM:.2f} um{hint}"
                )
        return reasons

    def shrink_reasons(self, correction_mm: FloatArray) -> list[str]:
        """Say so if the exact residual grows with the correction (n, 3), rigid motion taken out."""
        position_mm = self.grid.position_mm
        nominal = position_mm + tool_of(self.machine, None)
        before = exact_error(self.machine, self.errors, position_mm)
        after = exact_error(self.machine, self.errors, position_mm + correction_mm) + correction_mm
        rms_before, rms_after = (
            residuals(without_rigid_motion(nominal, error)).rms_um * MM_PER_UM for error in (before, after)
        )
        if rms_after <= rms_before + 1e-9 or rms_after <= self.resolution_mm:
            return []
        return [
            f"the residual does not shrink: {rms_before / MM_PER_UM:.2f} um rms before, {rms_after / MM_PER_UM:.2f} um "
            "rms after (rigid motion taken out)"
        ]


def judge_of(machine: Machine, control: AnyController, errors: ErrorTable, tables: Any = None) -> Judge:
    """Prepare the judgement for the tables of one control on a machine with these errors.

    ``tables`` are the parsed ones: where a control has room for some tables only, there is more than one good choice.
    """
    settings = control.read_settings(machine)
    given = (machine, settings, errors)
    basis = control.basis(*given) if tables is None else control.basis_of(*given, tables)
    solver = projector(machine, basis, anchored=control.anchored)
    values = best_values(machine, errors, solver)
    nodes = _nodes(machine, errors, solver)
    grid = volume_grid(machine, nodes)
    line_mm = scan_lines(machine, nodes)
    best_mm = solver.field(values, grid.position_mm)
    bent_mm = _without_linear_part(grid.position_mm, best_mm)
    resolution_mm = control.resolution_mm(settings)
    grid_u_mm = COMPONENT_UNCERTAINTIES * displacement_uncertainty(machine, errors, grid.position_mm)
    return Judge(
        machine=machine,
        errors=errors,
        solver=solver,
        values=values,
        grid=grid,
        best_mm=best_mm,
        line_mm=line_mm,
        line_best_mm=solver.field(values, line_mm),
        bent_mm=float(np.ptp(bent_mm, axis=0).max()),
        goal_mm=max(GOAL_MM, GOAL_SHARE * float(np.max(np.linalg.norm(bent_mm, axis=1)))),
        slack_mm=resolution_mm + np.minimum(grid_u_mm, COMPONENT_SHARE * np.std(best_mm, axis=0)),
        u_mm=displacement_uncertainty(machine, errors, line_mm),
        resolution_mm=resolution_mm,
    )


def _without_linear_part(position_mm: FloatArray, field_mm: FloatArray) -> FloatArray:
    """Take the best-fit constant and slopes (squareness, pitch) out of a field (n, 3) at points (n, 3)."""
    columns = np.column_stack([np.ones(len(position_mm)), position_mm - position_mm.mean(axis=0)])
    linear, *_ = np.linalg.lstsq(columns, field_mm, rcond=None)
    return np.asarray(field_mm - columns @ linear)


def _nodes(machine: Machine, errors: ErrorTable, solver: Projector) -> tuple[FloatArray, ...]:
    """Return the positions of the curves and of the control's tables, by axis."""
    return tuple(
        np.unique(
            np.concatenate(
                [curve_nodes_mm(machine, errors, axis), *(t.nodes_mm for t in solver.basis if t.axis == axis)]
            ).round(6)
        )
        for axis in range(3)
    )
