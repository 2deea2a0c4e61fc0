"""What PMAC tables can hold, and their numbers: rings of nodes from the motor's zero, negative travel at the far end."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.controllers.base import Term
from compgen.controllers.grids import equidistant_grid
from compgen.controllers.pmac.settings import PmacSettings
from compgen.controllers.pmac.tables import PER_COUNT, IntArray, Line, Sheet
from compgen.controllers.terms import continued, one_dimensional_terms, product_terms
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM

#: A function or product that moves its target by less than this (rms) needs no table.
NOTHING_MM = 0.02 * MM_PER_UM


@dataclass(frozen=True)
class Ring:
    """Nodes ``number * step`` counts from the motor's zero: those over the travel, and one more on either side.

    ``low`` ... ``high`` are the numbers over the travel, ``first`` <= 0 <= ``last`` all that the table holds; the
    position of the table is ``number`` modulo ``size``.
    """

    axis: int
    step: int
    low: int
    high: int

    @property
    def first(self) -> int:
        """Lowest number in the table."""
        return min(self.low, 0) - 1

    @property
    def last(self) -> int:
        """Highest number in the table."""
        return max(self.high, 0) + 1

    @property
    def size(self) -> int:
        """Number of entries; length / step."""
        return self.last - self.first + 1

    def nodes_mm(self, settings: PmacSettings) -> FloatArray:
        """Positions of the nodes over the travel in mm, ascending."""
        return np.sort(self.to_mm(settings, np.arange(self.low, self.high + 1)))

    def to_mm(self, settings: PmacSettings, numbers: IntArray) -> FloatArray:
        """Positions of nodes in mm."""
        return settings.home_mm[self.axis] + self.step * numbers / settings.counts_per_mm[self.axis]

    def positions_mm(self, settings: PmacSettings) -> FloatArray:
        """Where each place 0 ... size - 1 of the table takes its value, mm: nodes beyond the travel hold its end."""
        places = np.arange(self.size)
        numbers = np.where(places <= self.last, places, places - self.size)
        return self.to_mm(settings, np.clip(numbers, self.low, self.high))


def ring_of(machine: Machine, settings: PmacSettings, axis: int, step_mm: float) -> Ring:
    """Return the ring of an axis with nodes about ``step_mm`` apart (at least one count)."""
    scale = settings.counts_per_mm[axis]
    step = max(1, math.ceil(step_mm * abs(scale) - 1e-6))
    ends = sorted(scale * (end - settings.home_mm[axis]) for end in machine.axes[axis].range_mm)
    low, high = math.floor(ends[0] / step + 1e-9), math.ceil(ends[1] / step - 1e-9)
    return Ring(axis, step, low, max(high, low + 1))


def _step_mm(machine: Machine, settings: PmacSettings, errors: ErrorTable, axis: int, output: int) -> float:
    """Widest step from the motor's zero that loses nothing that matters."""
    home = list(machine.reference_point_mm)
    low, high = machine.axes[axis].range_mm
    home[axis] = min(max(settings.home_mm[axis], low), high)
    anchored = replace(machine, reference_point_mm=(home[0], home[1], home[2]))
    most = min(settings.max_entries, 400)
    grid = equidistant_grid(anchored, errors, axis, most=most, anchor=True, loss_mm=settings.loss_mm, output=output)
    return float(grid.step)


def pmac_basis(machine: Machine, settings: PmacSettings, errors: ErrorTable) -> list[Term]:
    """Return the functions and products that get a table: pitch, and as many others as there are motors to own them."""
    curves = [_curve(machine, settings, errors, output, axis) for output in range(3) for axis in range(3)]
    pitch = [term for term in curves if term.axis == term.carrier[0].output]
    groups = [[term] for term in curves if term.axis != term.carrier[0].output]
    if settings.two_dimensional:
        groups += _sheets(machine, settings, errors)
    sizes = [sum(_size(machine, term) ** 2 for term in group) for group in groups]
    ranked = sorted(range(len(groups)), key=lambda k: -sizes[k])[: len(settings.free_motors)]
    kept = [groups[k] for k in sorted(ranked) if sizes[k] > NOTHING_MM**2]
    terms = pitch + [term for group in kept for term in group]
    return [continued(term, machine.axes[term.axis or 0].range_mm) for term in terms]


def _curve(machine: Machine, settings: PmacSettings, errors: ErrorTable, output: int, axis: int) -> Term:
    ring = ring_of(machine, settings, axis, _step_mm(machine, settings, errors, axis, output))
    nodes = ring.nodes_mm(settings)
    lines = [nodes if k == axis else np.zeros(1) for k in range(3)]
    origin = settings.home_mm if settings.two_dimensional else None
    term = one_dimensional_terms(machine, errors, lines, [(output, axis)], lever_origin_mm=origin)[0]
    home = settings.home_mm[axis]
    if not nodes[0] - 1e-9 <= home <= nodes[-1] + 1e-9:
        return term
    start = term.start - np.interp(home, nodes, term.start)
    return replace(term, start=start, zero_at_mm=float(np.clip(home, nodes[0], nodes[-1])))


def _sheets(machine: Machine, settings: PmacSettings, errors: ErrorTable) -> list[list[Term]]:
    """Products by output and pair of axes, levers from the motor's zero; each group fits one two-dimensional table."""
    groups: dict[tuple[int, int, int], list[Term]] = {}
    for output in range(3):
        rings = [ring_of(machine, settings, k, _step_mm(machine, settings, errors, k, output)) for k in range(3)]
        nodes = [ring.nodes_mm(settings) for ring in rings]
        for term in product_terms(machine, errors, nodes, settings.home_mm):
            if term.carrier[0].output == output:
                groups.setdefault((output, *_pair(term)), []).append(term)
    return [group for _, group in sorted(groups.items())]


def _pair(term: Term) -> tuple[int, int]:
    lever = term.carrier[0].lever
    first, second = sorted((term.axis or 0, lever or 0))
    return first, second


def _size(machine: Machine, term: Term) -> float:
    """Rms of a term over the volume without a constant, mm."""
    lever = term.carrier[0].lever
    factor = 1.0 if lever is None or lever > 2 else machine.axes[lever].length_mm / math.sqrt(12.0)
    return float(np.std(term.start)) * factor


def tables_from(
    machine: Machine, settings: PmacSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
) -> list[Line | Sheet]:
    """Return the tables, from the highest motor to the lowest, in whole 1/16 counts."""
    free = iter(settings.free_motors)
    found: list[Line | Sheet] = []
    products: dict[tuple[int, int, int], list[Term]] = {}
    for term in basis:
        part = term.carrier[0]
        if part.lever is not None:
            products.setdefault((part.output, *_pair(term)), []).append(term)
            continue
        owner = settings.motors[part.output] if part.output == term.axis else next(free)
        found.append(_line(machine, settings, owner, term, np.asarray(values[term.name])))
    for (output, *pair), terms in products.items():
        found.append(_sheet(machine, settings, next(free), output, (pair[0], pair[1]), terms, values))
    return sorted(found, key=lambda table: -table.motor)


def ring_from(machine: Machine, settings: PmacSettings, axis: int, nodes_mm: FloatArray) -> Ring:
    """Return the ring whose nodes over the travel these are."""
    step = round(abs(settings.counts_per_mm[axis]) * float(nodes_mm[1] - nodes_mm[0]))
    ring = ring_of(machine, settings, axis, step / abs(settings.counts_per_mm[axis]))
    return replace(ring, step=step)


def sixteenths(settings: PmacSettings, axis: int, values_mm: FloatArray) -> IntArray:
    """Return displacements of an axis in whole 1/16 counts of its motor."""
    return np.rint(PER_COUNT * settings.counts_per_mm[axis] * np.asarray(values_mm)).astype(np.int64)


def _line(machine: Machine, settings: PmacSettings, owner: int, term: Term, values: FloatArray) -> Line:
    axis, output = int(term.axis or 0), term.carrier[0].output
    ring = ring_from(machine, settings, axis, term.nodes_mm)
    at = sixteenths(settings, output, np.interp(ring.positions_mm(settings), term.nodes_mm, values))
    at[0] = 0
    return Line(
        motor=owner,
        source=settings.motors[axis],
        target=settings.motors[output],
        length=ring.step * ring.size,
        entries=np.append(at[1:], 0),
        desired=settings.desired,
    )


def _sheet(
    machine: Machine,
    settings: PmacSettings,
    owner: int,
    output: int,
    pair: tuple[int, int],
    terms: Sequence[Term],
    values: Mapping[str, FloatArray],
) -> Sheet:
    """Two-dimensional table with the row motor of the first axis of the pair; the far edges repeat the zero edges."""
    rings = [_lever_ring(machine, settings, axis, terms) for axis in pair]
    along = [ring.positions_mm(settings) for ring in rings]
    second, first = np.meshgrid(along[1], along[0], indexing="ij")
    position_mm = np.zeros((first.size, 3))
    position_mm[:, pair[0]], position_mm[:, pair[1]] = first.ravel(), second.ravel()
    total = np.zeros(first.size)
    for term in terms:
        carrier = term.carrier_field(position_mm, np.zeros(3))[:, output]
        total += carrier * term.curve(np.asarray(values[term.name]), position_mm)
    inner = sixteenths(settings, output, total).reshape(first.shape)
    inner[0, 0] = 0
    row, column = (settings.motors[axis] for axis in pair)
    return Sheet(
        motor=owner,
        row=row,
        column=column,
        target=settings.motors[output],
        row_span=rings[0].step * rings[0].size,
        column_span=rings[1].step * rings[1].size,
        values=np.pad(inner, ((0, 1), (0, 1)), mode="wrap"),
        row_desired=settings.desired,
        column_desired=settings.desired,
    )


def _lever_ring(machine: Machine, settings: PmacSettings, axis: int, terms: Sequence[Term]) -> Ring:
    """Ring of one axis of a two-dimensional table: that of its functions, or a wide one if it is a lever only."""
    nodes = next((term.nodes_mm for term in terms if term.axis == axis), None)
    if nodes is not None:
        return ring_from(machine, settings, axis, nodes)
    return ring_of(machine, settings, axis, 0.5 * machine.axes[axis].length_mm)
