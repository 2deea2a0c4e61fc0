"""Levels of compensation that controls sell, as bases of terms, and the best that each could do for given errors.

A level knows neither quantum nor limits: it is what any control of that kind can reach at most. Each level holds the one
before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.controllers import Term
from compgen.controllers.grids import curve_nodes_mm
from compgen.controllers.terms import error_terms, one_dimensional_terms, product_terms
from compgen.core.csvio import FloatArray
from compgen.core.emphasis import Emphasis, Interval
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, ERROR_NAMES, MM_PER_UM
from compgen.core.reversal import ReversalCurves
from compgen.errors import InputError
from compgen.export.synthesis import Projector, basis_field, projector, wanted_correction
from compgen.model.volumetric import volumetric_error

Zone = tuple[Interval | None, Interval | None, Interval | None]

#: Levels in their order: key and what the tables of that level hold.
LABELS = {
    "nothing": "no table",
    "pitch": "positioning",
    "straightness": "+ straightness",
    "squareness": "+ squareness",
    "products": "+ angles, as products of tables",
    "volumetric": "full volumetric",
    "directional": "+ direction-dependent",
}
#: Between the nodes of the curves the bases get further nodes, as long as an axis has no more than this many: curves
#: that act at their own axis' travel are bent there.
MOST_NODES = 81
MOST_PARTS = 4


@dataclass(frozen=True)
class Level:
    """The best tables of one level: ``values`` of the terms in ``solver``; no solver: no tables.

    ``pitch`` is there for tables without squareness only: it fits the positioning again after the lines are out.
    """

    key: str
    solver: Projector | None = None
    values: FloatArray | None = None
    pitch: Projector | None = None
    reversal: ReversalCurves | None = None

    @property
    def label(self) -> str:
        """What the tables hold, in words."""
        return LABELS[self.key]

    def correction(self, position_mm: FloatArray, approach: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """Return what such a control would add at points (n, 3), reached in directions (n, 3), with a tool (3,): mm.

        Only the volumetric levels know the tool that is in use; the others were made for the machine's own.
        """
        added = np.zeros_like(position_mm)
        if self.solver is not None and self.values is not None:
            added += basis_field(self.solver.basis, self.values, position_mm, tool_mm)
        if self.reversal is not None:
            added -= self.reversal.displacement(position_mm, approach)
        return added

    def left_alone_um(
        self, machine: Machine, errors: ErrorTable, tools_mm: Sequence[FloatArray], *, anchored: bool = False
    ) -> list[dict[str, float]]:
        """Return the largest displacement (um, first order) that each error by itself leaves, for each tool (3,).

        With ``anchored`` the mean over the volume does not count: such tables cannot hold a constant.
        """
        if self.key in ("volumetric", "directional"):  # the control evaluates E = C P with the tool in use
            return [dict.fromkeys(errors.names, 0.0) for _ in tools_mm]
        position_mm = _points(machine, errors) if self.solver is None else self.solver.position_mm
        weight = None if self.solver is None else self.solver.weight
        found: list[dict[str, float]] = [{} for _ in tools_mm]
        for name in errors.names:
            part = errors.only(name)
            added = np.zeros_like(position_mm)
            if self.solver is not None:
                wanted = -volumetric_error(machine, part, position_mm)
                added = self.solver.field(_best(self.solver, self.pitch, wanted))
            for tool, left in zip(tools_mm, found, strict=True):
                rest = volumetric_error(machine, part, position_mm, tool) + added
                rest = rest - np.average(rest, axis=0, weights=weight) if anchored else rest
                left[name] = float(np.sqrt(np.max(np.einsum("ij,ij->i", rest, rest)))) / MM_PER_UM
        return found


def in_zone(machine: Machine, zone_mm: Zone | None) -> Machine:
    """Return the machine with its travel cut to a zone (ranges of X, Y, Z, None: all); InputError if it leaves it."""
    if zone_mm is None:
        return machine
    axes = []
    for letter, axis, part in zip(AXES, machine.axes, zone_mm, strict=True):
        low, high = axis.range_mm if part is None else part
        if not axis.range_mm[0] <= low < high <= axis.range_mm[1]:
            raise InputError(
                f"the zone goes from {low:g} to {high:g} mm in {letter}; it must lie within the travel "
                f"{axis.range_mm[0]:g} ... {axis.range_mm[1]:g} mm, the lower end first"
            )
        inside = axis.nodes_mm[(axis.nodes_mm > low) & (axis.nodes_mm < high)]
        axes.append(replace(axis, range_mm=(low, high), nodes_mm=np.array([low, *inside, high])))
    x, y, z = axes
    return replace(machine, axes=(x, y, z), emphasis=Emphasis())


def level_nodes_mm(machine: Machine, errors: ErrorTable) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the nodes of the bases, by axis: those of the curves within the travel, and some between them."""
    x, y, z = (_refined(curve_nodes_mm(machine, errors, axis)) for axis in range(3))
    return x, y, z


def _refined(nodes_mm: FloatArray) -> FloatArray:
    parts = int(np.clip((MOST_NODES - 1) // (len(nodes_mm) - 1), 1, MOST_PARTS))
    where = np.arange(parts * (len(nodes_mm) - 1) + 1) / parts
    return np.asarray(np.interp(where, np.arange(len(nodes_mm)), nodes_mm))


def _points(machine: Machine, errors: ErrorTable) -> FloatArray:
    levels = [curve_nodes_mm(machine, errors, axis, most=25) for axis in range(3)]
    return np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, 3)


def _basis(key: str, machine: Machine, errors: ErrorTable, nodes_mm: Sequence[FloatArray]) -> list[Term]:
    if key == "volumetric":
        return error_terms(machine, errors, nodes_mm)
    pairs = [(output, axis) for output in range(3) for axis in range(3) if output == axis or key != "pitch"]
    origin_mm = (0.5 * (machine.lower_mm + machine.upper_mm)).tolist()
    terms = one_dimensional_terms(machine, errors, nodes_mm, pairs, lever_origin_mm=origin_mm)
    return terms + product_terms(machine, errors, nodes_mm, origin_mm) if key == "products" else terms


def _best(solver: Projector, pitch: Projector | None, wanted_mm: FloatArray) -> FloatArray:
    """Table values (parameters,) closest to a wanted field (n, 3); with ``pitch`` those without squareness."""
    values = solver.project(wanted_mm)
    if pitch is not None:
        _take_lines_out(solver, values)
        values[_columns(solver, along=True)] = pitch.project(wanted_mm - solver.field(values))
    return values


def _columns(solver: Projector, *, along: bool) -> list[int]:
    """Numbers of the values that belong to tables of an axis along itself, or across."""
    found: list[int] = []
    first = 0
    for term in solver.basis:
        last = first + len(term.nodes_mm)
        if (term.carrier[0].output == term.axis) == along:
            found += range(first, last)
        first = last
    return found


def _take_lines_out(solver: Projector, values: FloatArray) -> None:
    """Make every straightness table zero at its ends, in place: its line is squareness; positioning becomes zero."""
    first = 0
    for term in solver.basis:
        own = values[first : first + len(term.nodes_mm)]
        if term.carrier[0].output == term.axis:
            own[:] = 0.0
        else:
            own -= np.interp(term.nodes_mm, term.nodes_mm[[0, -1]], own[[0, -1]])
        first += len(term.nodes_mm)


def levels_of(machine: Machine, errors: ErrorTable, reversal: ReversalCurves | None = None) -> list[Level]:
    """Return the best tables of every level over the machine's travel; the last only where a reversal is known.

    Straightness without squareness has the straightness of the level that follows, zero at both ends of the travel.
    """
    nodes_mm = level_nodes_mm(machine, errors)
    solvers = {
        key: projector(machine, _basis(key, machine, errors, nodes_mm), anchored=False)
        for key in ("pitch", "squareness", "products", "volumetric")
    }
    found = [Level("nothing")]
    for key, solver in solvers.items():
        wanted = wanted_correction(machine, errors, solver.position_mm)
        if key == "squareness":
            values = _best(solver, solvers["pitch"], wanted)
            found.append(Level("straightness", solver, values, solvers["pitch"]))
        start = np.concatenate([term.start for term in solver.basis])
        found.append(Level(key, solver, solver.project(wanted, start)))
    if reversal is not None:
        found.append(replace(found[-1], key="directional", reversal=reversal))
    return found


def level_key(basis: Sequence[Term]) -> str:
    """Return the level that a control's tables belong to, from its basis."""
    if any(term.name in ERROR_NAMES for term in basis):
        return "volumetric"
    if any(part.lever is not None for term in basis for part in term.carrier):
        return "products"
    if any(part.output != term.axis for term in basis for part in term.carrier):
        return "squareness"
    return "pitch"
