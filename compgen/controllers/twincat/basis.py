"""What TwinCAT axis lists can hold: which table of a slave axis takes which function, and the numbers of the tables.

A slave has one leadscrew table, one cross table (one master) and one plane (two masters; one of them may be the slave).
The plane takes the products function-of-one-axis times lever-of-another that matter most.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compgen.controllers.base import Term
from compgen.controllers.grids import equidistant_grid, uneven_nodes_mm
from compgen.controllers.terms import continued, one_dimensional_terms, product_terms
from compgen.controllers.twincat.settings import TwincatSettings
from compgen.controllers.twincat.tables import MM_PER_UNIT, AxisList, Cross, Plane, Screw, units_outwards
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM

#: A function or product that moves the slave by less than this (rms) needs no table.
NOTHING_MM = 0.02 * MM_PER_UM


@dataclass(frozen=True)
class Layout:
    """Tables of one slave: its leadscrew, the master of its cross table, the masters of its plane."""

    slave: int
    cross: int
    plane: tuple[int, int] | None

    @property
    def plane_curves(self) -> tuple[int, ...]:
        """Axes whose one-dimensional function stands in the plane."""
        return tuple(axis for axis in self.plane or () if axis not in (self.slave, self.cross))


def layouts(machine: Machine, settings: TwincatSettings, errors: ErrorTable) -> list[Layout]:
    """Return the tables of the three slaves: every plane takes the pair of masters that needs it most."""
    probe = [np.linspace(*axis.range_mm, 41) for axis in machine.axes]
    origin = machine.reference_point_mm
    products = product_terms(machine, errors, probe, (0.5 * (machine.lower_mm + machine.upper_mm)).tolist())
    found = []
    for slave in range(3):
        others = [axis for axis in range(3) if axis != slave]
        pairs = [(slave, axis) for axis in others]
        curves = one_dimensional_terms(machine, errors, probe, pairs, lever_origin_mm=origin)
        sizes = [float(np.std(term.start)) for term in curves]
        plane = settings.planes[slave] if settings.crosscomp2 else None
        if plane == "auto":
            plane = _plane(slave, [(term, _size(machine, term)) for term in products], others, sizes)
        masters = None if plane is None or isinstance(plane, str) else plane
        found.append(Layout(slave, _cross(others, sizes, masters), masters))
    return found


def _size(machine: Machine, term: Term) -> float:
    """Rms of a product over the volume without what functions of one axis hold of it, mm."""
    lever = term.carrier[0].lever
    length = machine.axes[lever].length_mm if lever is not None and lever < 3 else 0.0
    return float(np.std(term.start)) * length / math.sqrt(12.0)


def _masters(term: Term) -> tuple[int, int]:
    lever = term.carrier[0].lever
    first, second = sorted((term.axis or 0, lever or 0))
    return first, second


def _plane(
    slave: int, products: Sequence[tuple[Term, float]], others: Sequence[int], sizes: Sequence[float]
) -> tuple[int, int] | None:
    captured: dict[tuple[int, int], float] = {}
    for term, size in products:
        if term.carrier[0].output == slave:
            captured[_masters(term)] = captured.get(_masters(term), 0.0) + size**2
    best = max(captured, key=lambda pair: captured[pair], default=None)
    if best is not None and captured[best] > NOTHING_MM**2:
        return best
    return (others[0], others[1]) if min(sizes) > NOTHING_MM else None


def _cross(others: Sequence[int], sizes: Sequence[float], plane: tuple[int, int] | None) -> int:
    """Master of the cross table: the axis that the plane leaves out, else the one with the larger function."""
    free = [axis for axis in others if plane is not None and axis not in plane]
    return free[0] if free else others[int(np.argmax(sizes))]


def twincat_basis(machine: Machine, settings: TwincatSettings, errors: ErrorTable) -> list[Term]:
    """Return the terms of all three slaves, nodes in whole units of 0.1 um."""
    terms: list[Term] = []
    for layout in layouts(machine, settings, errors):
        terms += _terms(machine, settings, errors, layout)
    return [continued(term, machine.axes[term.axis or 0].range_mm) for term in terms]


def _terms(machine: Machine, settings: TwincatSettings, errors: ErrorTable, layout: Layout) -> list[Term]:
    slave, origin = layout.slave, machine.reference_point_mm
    alone = [
        (slave, _screw_nodes_mm(machine, settings, errors, slave)),
        (layout.cross, _cross_nodes_mm(machine, settings, errors, layout.cross)),
    ]
    found = [
        one_dimensional_terms(machine, errors, _at(axis, nodes), [(slave, axis)], lever_origin_mm=origin)[0]
        for axis, nodes in alone
    ]
    if layout.plane is None:
        return found
    nodes = plane_nodes_mm(machine, settings, errors, layout)
    pairs = [(slave, axis) for axis in layout.plane_curves]
    found += one_dimensional_terms(machine, errors, nodes, pairs, lever_origin_mm=origin)
    products = product_terms(machine, errors, nodes, origin)
    return found + [t for t in products if t.carrier[0].output == slave and set(_masters(t)) == set(layout.plane)]


def _at(axis: int, nodes_mm: FloatArray) -> list[FloatArray]:
    """Nodes of one axis in a list for three."""
    return [nodes_mm if axis == k else np.zeros(1) for k in range(3)]


def _screw_nodes_mm(machine: Machine, settings: TwincatSettings, errors: ErrorTable, axis: int) -> FloatArray:
    if settings.own_setpoints:
        return _cross_nodes_mm(machine, settings, errors, axis)
    grid = equidistant_grid(machine, errors, axis, most=settings.most.ssfk - 1, loss_mm=settings.loss_mm, output=axis)
    start, step, count = even_units(machine, axis, float(grid.step) / MM_PER_UNIT)
    return np.asarray((start + step * np.arange(count)) * MM_PER_UNIT, dtype=np.float64)


def _cross_nodes_mm(machine: Machine, settings: TwincatSettings, errors: ErrorTable, axis: int) -> FloatArray:
    most = min(settings.most.crosscomp, settings.most.ssfk)
    nodes_mm = uneven_nodes_mm(machine, errors, axis, loss_mm=settings.loss_mm, most=most)
    return units_outwards(machine, axis, nodes_mm) * MM_PER_UNIT


def even_units(machine: Machine, axis: int, step: float) -> tuple[int, int, int]:
    """Return start, step and number of equidistant nodes in units of 0.1 um that cover the travel."""
    low, high = (end / MM_PER_UNIT for end in machine.axes[axis].range_mm)
    start, whole = math.floor(low + 1e-3), max(1, round(step))
    return start, whole, max(1, math.ceil((high - 1e-3 - start) / whole)) + 1


def plane_nodes_mm(machine: Machine, settings: TwincatSettings, errors: ErrorTable, layout: Layout) -> list[FloatArray]:
    """Return the nodes of both masters (and any of the third axis): one distance for both, within the control's limit."""
    masters = layout.plane or (0, 1)
    most = max(3, settings.most.crosscomp2 // 2 - 1)
    steps = [
        float(equidistant_grid(machine, errors, axis, most=most, loss_mm=settings.loss_mm, output=layout.slave).step)
        for axis in masters
    ]
    step = min(steps) / MM_PER_UNIT
    while True:
        grids = [even_units(machine, axis, step) for axis in masters]
        if grids[0][2] * grids[1][2] <= settings.most.crosscomp2:
            break
        step *= 1.02
    nodes = [np.zeros(1)] * 3
    for axis, (start, whole, count) in zip(masters, grids, strict=True):
        nodes[axis] = np.asarray((start + whole * np.arange(count)) * MM_PER_UNIT, dtype=np.float64)
    return nodes


def lists_from(
    machine: Machine, settings: TwincatSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
) -> dict[int, AxisList]:
    """Return the numbers of all tables, rounded as they are written; cross and plane tables of zeros are left out."""
    return {slave: _list_of(machine, settings, slave, basis, values) for slave in range(3)}


def _list_of(
    machine: Machine, settings: TwincatSettings, slave: int, basis: Sequence[Term], values: Mapping[str, FloatArray]
) -> AxisList:
    own = [term for term in basis if term.carrier[0].output == slave]
    screw_term, cross_term, *plane_terms = own
    cross = Cross(
        int(cross_term.axis or 0),
        _units(cross_term.nodes_mm),
        rounded(settings, settings.cross_factor * values[cross_term.name]),
    )
    plane = None
    if plane_terms:
        masters = _masters_of(settings, slave, plane_terms, cross.master)
        plane = _plane_table(machine, settings, masters, plane_terms, values)
    nodes = _units(screw_term.nodes_mm)
    return AxisList(
        Screw(
            nodes,
            rounded(settings, settings.screw_factor * values[screw_term.name]),
            interval=0.0 if settings.own_setpoints else float(nodes[1] - nodes[0]),
        ),
        cross if np.any(cross.values) else None,
        plane if plane is not None and np.any(plane.values) else None,
    )


def _masters_of(settings: TwincatSettings, slave: int, terms: Sequence[Term], cross: int) -> tuple[int, int]:
    """First and second master of a plane: as the machine file has them, else in the order X, Y, Z."""
    stated = settings.planes[slave]
    if isinstance(stated, tuple):
        return stated
    axes = {axis for term in terms for axis in (term.axis, term.carrier[0].lever) if axis is not None}
    first, second = sorted(axes if len(axes) == 2 else {*axes, cross})
    return first, second


def _plane_table(
    machine: Machine,
    settings: TwincatSettings,
    masters: tuple[int, int],
    terms: Sequence[Term],
    values: Mapping[str, FloatArray],
) -> Plane:
    """Return the sum of the terms at the nodes of a plane; between nodes it is bilinear, as each of the terms is."""
    step = float(np.diff(_units(terms[0].nodes_mm))[0])
    grids = [even_units(machine, axis, step) for axis in masters]
    lines = [(start + whole * np.arange(count)) * MM_PER_UNIT for start, whole, count in grids]
    second, first = np.meshgrid(lines[1], lines[0], indexing="ij")
    position_mm = np.zeros((first.size, 3))
    position_mm[:, masters[0]], position_mm[:, masters[1]] = first.ravel(), second.ravel()
    total = np.zeros(first.size)
    for term in terms:
        carrier = term.carrier_field(position_mm, np.zeros(3))[:, term.carrier[0].output]
        total += carrier * term.curve(np.asarray(values[term.name]), position_mm)
    starts = (float(grids[0][0]), float(grids[1][0]))
    numbers = rounded(settings, settings.cross_factor * total.reshape(first.shape))
    return Plane(masters, starts, step, numbers)


def _units(nodes_mm: FloatArray) -> FloatArray:
    return np.rint(nodes_mm / MM_PER_UNIT)


def rounded(settings: TwincatSettings, values_mm: FloatArray) -> FloatArray:
    """Return values in 0.1 um as they are written."""
    return np.round(np.asarray(values_mm) / MM_PER_UNIT, settings.digits) + 0.0
