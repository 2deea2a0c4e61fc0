"""The neutral formats as data: the correction field on a grid, and the 21 error curves that it comes from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.controllers.base import Term
from compgen.controllers.isg.parameters import Field
from compgen.core.csvio import FloatArray, fixed
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_NAMES, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.model.volumetric import volumetric_error

POSITION_DIGITS = 6
FIELD_DIGITS = 6
CURVE_DIGITS = 9


@dataclass(frozen=True)
class FieldGrid:
    """What must be added to the command at the vertices of a grid, for one tool offset.

    Parameters
    ----------
    nodes_mm : ascending positions of X, Y, Z, any distances.
    correction_um : shape (nx, ny, nz, 3).
    """

    nodes_mm: tuple[FloatArray, FloatArray, FloatArray]
    correction_um: FloatArray

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Trilinear correction at positions (n, 3), values of the surface held outside: shape (n, 3), mm."""
        parts = [Field((0, 1, 2), self.nodes_mm, self.correction_um[..., k]).at(position_mm) for k in range(3)]
        return np.column_stack(parts) * MM_PER_UM

    def same_as(self, other: FieldGrid) -> bool:
        """Whether another grid holds the same numbers at the same positions."""
        pairs = [(self.correction_um, other.correction_um), *zip(self.nodes_mm, other.nodes_mm, strict=True)]
        return all(np.array_equal(mine, theirs) for mine, theirs in pairs)


@dataclass(frozen=True)
class NeutralTables:
    """The field, the curves (mm and rad, squareness reference X), or both; ``conflicts`` between files, in words."""

    field: FieldGrid | None
    curves: ErrorTable | None
    conflicts: tuple[str, ...] = ()


def same_curves(one: ErrorTable, other: ErrorTable) -> bool:
    """Whether two tables hold the same errors at the same positions."""
    if one.names != other.names or any(one.squareness[name][0] != other.squareness[name][0] for name in one.squareness):
        return False
    pairs = [(one.curves[name], other.curves[name]) for name in one.curves]
    return all(np.array_equal(a.position_mm, b.position_mm) and np.array_equal(a.value, b.value) for a, b in pairs)


def curves_from(basis: Sequence[Term], values: Mapping[str, FloatArray]) -> ErrorTable:
    """Return the errors of all terms, rounded as they are written."""
    curves, squareness = {}, {}
    terms = {term.name: term for term in basis}
    for name in (name for name in ERROR_NAMES if name in terms):
        unit = error_named(name).si_per_unit
        rounded = np.array([float(fixed(v / unit, CURVE_DIGITS)) * unit for v in np.asarray(values[name]).tolist()])
        if name in SQUARENESS_NAMES:
            squareness[name] = (float(rounded[0]), math.nan)
        else:
            nodes = np.array([float(fixed(node, POSITION_DIGITS)) for node in terms[name].nodes_mm.tolist()])
            curves[name] = Curve(nodes, rounded, np.full(len(nodes), np.nan))
    return ErrorTable(curves, squareness)


def curve_correction(
    machine: Machine, curves: ErrorTable, position_mm: FloatArray, tool_mm: FloatArray | None
) -> FloatArray:
    """Return minus E = C P of the curves (squareness reference X) at positions (n, 3): shape (n, 3), mm."""
    return -volumetric_error(replace(machine, squareness_reference="X"), curves, position_mm, tool_mm) + 0.0


def field_from(machine: Machine, curves: ErrorTable, loss_mm: float, most: int) -> FieldGrid:
    """Return the field of the curves with the machine's tool, on nodes between which hardly anything is lost."""
    lines = [_nodes_mm(machine, curves, axis, loss_mm, most) for axis in range(3)]
    position_mm = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    added = curve_correction(machine, curves, position_mm.reshape(-1, 3), None) / MM_PER_UM
    flat = np.array([float(fixed(value, FIELD_DIGITS)) for value in added.ravel().tolist()])
    return FieldGrid((lines[0], lines[1], lines[2]), flat.reshape(position_mm.shape))


def _nodes_mm(machine: Machine, curves: ErrorTable, axis: int, loss_mm: float, most: int) -> FloatArray:
    """Nodes of the curves of an axis, divided where an angle acts at its own axis' travel (a parabola in between)."""
    own = [curve for name, curve in curves.curves.items() if error_named(name).axis == axis]
    nodes = np.unique(np.concatenate([np.array(machine.axes[axis].range_mm), *(curve.position_mm for curve in own)]))
    if axis not in machine.chain.lever_axes(axis):
        return nodes
    bent = np.zeros(len(nodes) - 1)
    for name, curve in curves.curves.items():
        error = error_named(name)
        if error.axis == axis and error.kind == "angular" and error.direction != axis:
            bent = np.maximum(bent, 0.25 * np.abs(np.diff(curve.at(nodes))) * np.diff(nodes))
    loss = loss_mm
    while True:
        parts = np.maximum(1, np.ceil(np.sqrt(bent / loss))).astype(int)
        if np.sum(parts) < most or np.all(parts == 1):
            break
        loss *= 2.0
    pieces = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(nodes[:-1], nodes[1:], parts, strict=True)]
    return np.unique(np.round(np.concatenate([*pieces, nodes[-1:]]), POSITION_DIGITS))
