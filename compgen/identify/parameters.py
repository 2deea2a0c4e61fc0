"""The unknown curves: their basis, the constraints that fix the gauge, and where each stands in the vector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import ERROR_INDEX, SQUARENESS_NAMES, ErrorName, error_named
from compgen.model.basis import free_basis, hat_matrix, spline_matrix
from compgen.model.observability import modelled_errors, observable_errors
from compgen.model.volumetric import tool_of

#: Positions per node interval at which a cubic curve is written, so that linear interpolation loses nothing.
SUBDIVISION = 8


@dataclass(frozen=True)
class CurveParameters:
    """One unknown curve: coefficients = ``free`` (n, k) times its k unknowns, at ``columns`` of the vector."""

    error: ErrorName
    nodes_mm: FloatArray
    free: FloatArray
    columns: slice


@dataclass(frozen=True)
class ErrorParameters:
    """All unknown errors of a machine and their place in the vector of unknowns (curves first, then squareness).

    ``curves`` is the basis between nodes; ``size`` the number of unknowns.
    """

    machine: Machine
    curves: tuple[CurveParameters, ...]
    squareness: tuple[str, ...]
    size: int

    def basis(self, axis: int, position_mm: FloatArray) -> FloatArray:
        """Basis matrix of the curves of ``axis`` at positions (m,): shape (m, coefficients)."""
        nodes = self.machine.axes[axis].nodes_mm
        build = spline_matrix if self.machine.curves == "cubic" else hat_matrix
        return build(nodes, position_mm)

    def values(self, unknowns: FloatArray, bases: Sequence[FloatArray]) -> FloatArray:
        """All 21 errors at points whose basis matrices are ``bases`` (one per axis): shape (m, 21), mm and rad."""
        values = np.zeros((len(bases[0]), len(ERROR_INDEX)))
        for curve in self.curves:
            coefficients = curve.free @ unknowns[curve.columns]
            values[:, ERROR_INDEX[curve.error.name]] = bases[curve.error.axis] @ coefficients
        for k, name in enumerate(self.squareness):
            values[:, ERROR_INDEX[name]] = unknowns[self.size - len(self.squareness) + k]
        return values

    def design(self, columns: FloatArray, bases: Sequence[FloatArray]) -> FloatArray:
        """Derivative of the tip by the unknowns, shape (m, 3, size); ``columns`` (m, 3, 21) is dTip/dP."""
        design = np.empty((len(columns), 3, self.size))
        for curve in self.curves:
            reduced = bases[curve.error.axis] @ curve.free
            column = columns[:, :, ERROR_INDEX[curve.error.name]]
            design[:, :, curve.columns] = column[:, :, None] * reduced[:, None, :]
        for k, name in enumerate(self.squareness):
            design[:, :, self.size - len(self.squareness) + k] = columns[:, :, ERROR_INDEX[name]]
        return design

    def output_positions_mm(self, axis: int) -> FloatArray:
        """Positions at which the curves of an axis are written: the nodes, for cubic curves with more in between."""
        nodes = self.machine.axes[axis].nodes_mm
        if self.machine.curves == "linear":
            return nodes
        steps = np.arange(SUBDIVISION) / SUBDIVISION
        between = nodes[:-1, None] + np.diff(nodes)[:, None] * steps
        return np.append(between.ravel(), nodes[-1])


def error_parameters(machine: Machine, names: Sequence[str], *, several_tools: bool = False) -> ErrorParameters:
    """Lay out the unknowns for the errors ``names`` and fix the gauge by elimination.

    Constraints (Zha & Zhang 2024, eq. 25, taken together; 20 for 17 errors): positioning and angular curves are zero
    at the reference point, straightness curves at both ends of the travel. If several tools were used, the angular
    curves of the axis without any other axis in its lever arm stay free: with them comes the constant orientation
    between tool and workpiece, which the tools show.
    """
    single_tool = observable_errors(machine) if several_tools else ()
    bare = next(axis for axis in range(3) if not [lever for lever in machine.chain.lever_axes(axis) if lever != axis])
    curves: list[CurveParameters] = []
    known: dict[tuple[int, bool, bool], FloatArray] = {}
    size = 0
    for name in names:
        if name in SQUARENESS_NAMES:
            continue
        error = error_named(name)
        released = several_tools and error.kind == "angular" and error.axis == bare and name not in single_tool
        key = (error.axis, error.is_straightness, released)
        if key not in known:
            known[key] = _free_coefficients(machine, error, released=released)
        free = known[key]
        curves.append(
            CurveParameters(error, machine.axes[error.axis].nodes_mm, free, slice(size, size + free.shape[1]))
        )
        size += free.shape[1]
    squareness = tuple(name for name in names if name in SQUARENESS_NAMES)
    return ErrorParameters(machine, tuple(curves), squareness, size + len(squareness))


def common_tool(machine: Machine, tool_mm: FloatArray | None) -> FloatArray:
    """Return the tool offset of all rows (3,), or of each (n, 3) if several tools were used; None is the machine's."""
    offset_mm = tool_of(machine, tool_mm)
    one = offset_mm.ndim == 2 and not np.any(np.ptp(offset_mm, axis=0) > 1e-9)
    return offset_mm[0] if one else offset_mm


def parameters_for_tools(machine: Machine, tool_mm: FloatArray) -> ErrorParameters:
    """Lay out the errors that the machine's model contains for the tools that were used, (3,) or (n, 3)."""
    several = tool_mm.ndim == 2
    names = modelled_errors(machine, np.unique(tool_mm, axis=0) if several else None)
    return error_parameters(machine, names, several_tools=several)


def _free_coefficients(machine: Machine, error: ErrorName, *, released: bool) -> FloatArray:
    axis = machine.axes[error.axis]
    count = len(axis.nodes_mm)
    if released:
        return np.eye(count)
    zeros = axis.range_mm if error.is_straightness else (machine.reference_point_mm[error.axis],)
    held = (axis.nodes_mm[:, None] == np.array(zeros)).any(axis=1)
    if machine.curves == "linear" and np.count_nonzero(held) == len(zeros):
        return np.eye(count)[:, ~held]
    build = spline_matrix if machine.curves == "cubic" else hat_matrix
    rows = build(axis.nodes_mm, np.array(zeros))
    return free_basis(np.where(np.abs(rows) < 1e-14, 0.0, rows), count)
