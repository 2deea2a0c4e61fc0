"""Tables of controls: numbers over one axis or over a grid, and what follows from them for every control alike.

A control says which tables it has, in which unit and with which sign (:class:`Table1D`, :class:`TableGrid`); what they add,
their nodes and the travel that they do not cover follow from that. :class:`TableController` is for a control whose correction
is the sum of such tables, :class:`AxisTableController` for one table per axis, over its own position: X(x), Y(y), Z(z).

What is read from a file builds tables of its own. A table holds numbers only, none of its functions keeps anything, and what
wrote a file is not asked: the interpolation is arithmetic that both sides may use, since its truth is the control's manual.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from compgen.controls.shared.base import (
    Controller,
    Settings,
    SourceFile,
    Tables,
    Term,
    Usage,
    by_travel,
    coverage_violations,
    nodes_by_axis,
    travel_of,
)
from compgen.controls.shared.grids import equidistant_grid, rounded, uneven_nodes_mm
from compgen.controls.shared.scanner import check_size
from compgen.controls.shared.terms import one_dimensional_name, one_dimensional_terms
from compgen.data.csv_files import FloatArray, fixed
from compgen.data.error_table import WORTH_MM, Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.names import AXES
from compgen.errors import InputError

#: Positions that differ by less are the same one.
SAME_MM = 1e-6


def along_itself(reversal: ReversalCurves) -> ReversalCurves:
    """Return the part of a reversal that is along the axis that reverses: tables X(x), Y(y), Z(z) have room for no other."""
    return replace(reversal, curves={key: curve for key, curve in reversal.curves.items() if key[0] == key[1]})


@dataclass(frozen=True)
class Table1D:
    """Numbers of a control that move axis ``output`` as a function of the position of ``axis`` (both 0..2).

    Linear between nodes, outside end values or zero (``zero_outside``); a control with another rule overrides
    :meth:`interpolated`. Only what stands in a file is compared, and changed by the crash test: units, signs and axes are known
    from elsewhere.

    Parameters
    ----------
    nodes : ascending positions (n,), from ``origin_mm``, in units of ``node_mm``.
    positive : values (n,) that act after travel in positive direction, as the file has them.
    negative : after travel in negative direction; None: the same as ``positive``.
    value_mm : what the control ADDS to the command where a value is one, mm: the unit, with the sign of the control.
    """

    axis: int = field(compare=False)
    output: int = field(compare=False)
    nodes: FloatArray
    positive: FloatArray
    negative: FloatArray | None = None
    value_mm: float = field(default=1.0, compare=False)
    node_mm: float = field(default=1.0, compare=False)
    origin_mm: float = field(default=0.0, compare=False)
    zero_outside: bool = field(default=False, compare=False)

    @property
    def nodes_mm(self) -> FloatArray:
        """Positions of the nodes, machine coordinates, shape (n,), mm."""
        return self.origin_mm + self.node_mm * self.nodes

    @property
    def columns(self) -> tuple[FloatArray, FloatArray]:
        """Values after travel in positive and in negative direction, shape (n,) each."""
        return self.positive, self.positive if self.negative is None else self.negative

    def interpolated(self, along: FloatArray, values: FloatArray) -> FloatArray:
        """Value at positions (m,) in the unit of the nodes, between the values (n,) of one column."""
        found = np.interp(along, self.nodes, values)
        if not self.zero_outside:
            return found
        slack = SAME_MM / self.node_mm
        return np.where((along >= self.nodes[0] - slack) & (along <= self.nodes[-1] + slack), found, 0.0)

    def at(self, position_mm: FloatArray, direction: float | FloatArray = 1.0) -> FloatArray:
        """Value at positions (m,) of the axis, reached in a direction: +1, -1, or 0 (unknown: the mean of both)."""
        along = (np.asarray(position_mm, dtype=np.float64) - self.origin_mm) / self.node_mm
        positive = self.interpolated(along, self.positive)
        if self.negative is None:
            return positive
        return by_travel(np.asarray(direction), positive, self.interpolated(along, self.negative))

    def added_mm(self, points: Points) -> FloatArray:
        """What the control adds to axis ``output`` at each point, by the last travel of ``axis``, shape (m,), mm."""
        return self.value_mm * self.at(points.position_mm[:, self.axis], travel_of(points, self.axis))

    @property
    def largest(self) -> int:
        """Index of the largest value after positive travel."""
        return int(np.argmax(np.abs(self.positive)))


def largest_of(tables: Iterable[Table1D]) -> Table1D:
    """The table with the largest value after positive travel, for a worked example."""
    return max(tables, key=lambda table: float(np.max(np.abs(table.positive))))


@dataclass(frozen=True)
class TableGrid:
    """Numbers of a control over a regular grid of the positions of two or three axes.

    Linear along one axis after the other: bilinear or trilinear. Outside the values at the surface hold, or the outermost
    cell goes on (``extends``).

    Parameters
    ----------
    axes : the axes (0..2) of the first dimensions of ``values``, in their order.
    start : position of the first vertex along each axis, (d,), in units of ``node_mm``.
    step : spacing along each, (d,), or one number for all.
    values : numbers at the vertices, (n0, n1[, n2], k), as the file has them: k values for the axes ``outputs``.
    value_mm : what the control ADDS to the command where a value is one, mm; one number, or one for each of ``outputs``.
    """

    axes: tuple[int, ...] = field(compare=False)
    outputs: tuple[int, ...] = field(compare=False)
    start: FloatArray
    step: FloatArray | float
    values: FloatArray
    value_mm: float | FloatArray = field(default=1.0, compare=False)
    node_mm: float = field(default=1.0, compare=False)
    extends: bool = field(default=False, compare=False)

    def nodes_mm(self, place: int) -> FloatArray:
        """Positions of the vertices along the axis at this place of ``axes``, mm."""
        steps = np.broadcast_to(self.step, len(self.axes))
        return np.asarray(self.start[place] + steps[place] * np.arange(self.values.shape[place])) * self.node_mm

    @property
    def spans(self) -> list[tuple[int, FloatArray]]:
        """Each axis with the positions of its vertices, mm."""
        return [(axis, self.nodes_mm(place)) for place, axis in enumerate(self.axes)]

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Values at positions (m, 3), shape (m, k)."""
        cells, shares = [], []
        for place, (axis, step) in enumerate(zip(self.axes, np.broadcast_to(self.step, len(self.axes)), strict=True)):
            ratio = (position_mm[:, axis] / self.node_mm - self.start[place]) / step
            cell = np.clip(np.floor(ratio), 0, max(self.values.shape[place] - 2, 0))
            share = ratio - cell if self.extends else np.clip(ratio - cell, 0.0, 1.0)
            cells.append(cell.astype(np.intp))
            shares.append(share[:, None])
        return _between(self.values, cells, shares, [])

    def added_mm(self, points: Points) -> FloatArray:
        """What the control adds to the axes ``outputs`` at each point, shape (m, k), mm."""
        return self.value_mm * self.at(points.position_mm)


def _between(
    values: FloatArray, cells: Sequence[np.ndarray], shares: Sequence[FloatArray], corner: list[np.ndarray]
) -> FloatArray:
    """Value at positions in their cells: linear along the last axis, of what is linear along those before it."""
    if not cells:
        return np.asarray(values[tuple(reversed(corner))])
    *others, cell = cells
    *rest, share = shares
    upper = np.minimum(cell + 1, values.shape[len(others)] - 1)
    low, high = (_between(values, others, rest, [*corner, side]) for side in (cell, upper))
    return np.asarray(low * (1.0 - share) + high * share)


class TableController(Controller[Settings, Tables]):
    """A control whose correction is the sum of tables over one axis each and of grids."""

    def curves(self, tables: Tables) -> Sequence[Table1D]:
        """Return the tables over one axis that act, in the order in which they are added."""
        return ()

    def grids(self, tables: Tables) -> Sequence[TableGrid]:
        """Return the grids that act, in the order in which they are added."""
        return ()

    def emulate(self, tables: Tables, points: Points) -> FloatArray:
        """Return the sum of the tables at the commanded positions, by the direction of the last travel if it matters."""
        added = np.zeros((len(points), 3))
        for table in self.curves(tables):
            added[:, table.output] += table.added_mm(points)
        for grid in self.grids(tables):
            added[:, grid.outputs] += grid.added_mm(points)
        return added

    def table_nodes_mm(self, tables: Tables) -> tuple[FloatArray, ...]:
        """Return the nodes of all tables by the axis that they are over."""
        spans = [(table.axis, table.nodes_mm) for table in self.curves(tables)]
        return nodes_by_axis([*spans, *(span for grid in self.grids(tables) for span in grid.spans)])

    def not_covered(self, axis: int, nodes_mm: FloatArray, what: str) -> list[str]:
        """Return a message if nodes (n,) leave part of the travel of an axis uncovered."""
        return coverage_violations(self.machine, axis, float(nodes_mm[0]), float(nodes_mm[-1]), what)

    def reversal_in_tables(self, reversal: ReversalCurves) -> ReversalCurves:
        """Return the reversal of each axis along itself, if the control has a table for each direction."""
        return along_itself(reversal) if self.bidirectional else replace(reversal, curves={})


@dataclass(frozen=True)
class AxisTables:
    """Tables by axis 0..2; an axis without one is not corrected."""

    tables: Mapping[int, Table1D]


class PerAxisController(TableController[Settings, AxisTables]):
    """A control with one table per axis, over its own position, perhaps with a column for each direction of travel.

    A control states the class variables below and reads its files (``parse``); the rest follows.
    """

    #: True if the positions must be evenly spaced; most and least points of an axis; decimals of a position and a value.
    even, most, least, position_digits, digits = False, 1000, 2, 6, 6
    #: +1 if the control adds the values to the command, -1 if it subtracts them; unit of a value, mm.
    sign, unit_mm = 1.0, 1.0
    #: A table and one of its rows in messages; how many points of the file one node makes.
    table_name, point_name, points_per_node = "table", "points", 1

    @property
    def most_points(self) -> int:
        """Return the largest number of points of one axis."""
        return self.points_per_node * int(getattr(self.settings, "most_points", self.most))

    def curves(self, tables: AxisTables) -> Sequence[Table1D]:
        """Return the tables in the order of the axes."""
        return [table for _, table in sorted(tables.tables.items())]

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return X(x), Y(y), Z(z)."""
        nodes = [self.nodes_mm(errors, axis) for axis in range(3)]
        pairs = [(axis, axis) for axis in range(3)]
        return one_dimensional_terms(self.machine, errors, nodes, pairs, anchored=self.anchored)

    def nodes_mm(self, errors: ErrorTable, axis: int) -> FloatArray:
        """Return the positions of a table: where the curves need them, evenly spaced where the control wants it."""
        loss_mm, most = getattr(self.settings, "loss_mm", 0.0), self.most_points // self.points_per_node
        if self.even:
            grid = equidistant_grid(self.machine, errors, axis, most=most, loss_mm=loss_mm, anchor=self.anchored)
            return grid.nodes_mm
        nodes = self.positions_as_written(uneven_nodes_mm(self.machine, errors, axis, loss_mm=loss_mm, most=most))
        if len(nodes) < self.least:
            nodes = np.union1d(nodes, self.positions_as_written(np.linspace(nodes[0], nodes[-1], self.least)))
        return nodes

    def positions_as_written(self, position_mm: FloatArray) -> FloatArray:
        """Return positions as read back from the file, mm."""
        return rounded(position_mm, self.position_digits)

    def as_written(self, axis: int, nodes_mm: FloatArray, positive_mm: FloatArray, negative_mm: FloatArray) -> Table1D:
        """Return the table as read back from the file; values in mm with the sign of the control."""
        columns = (rounded(column / self.unit_mm, self.digits) for column in (positive_mm, negative_mm))
        return self.table_of(axis, nodes_mm, *columns)

    def table_of(self, axis: int, nodes_mm: FloatArray, positive: FloatArray, negative: FloatArray) -> Table1D:
        """Return a table with the numbers of its file."""
        both = negative if self.bidirectional else None
        return Table1D(axis, axis, nodes_mm, positive, both, self.sign * self.unit_mm)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> AxisTables:
        """Return the values, rounded as written, the same in both directions."""
        found: dict[int, Table1D] = {}
        for term in basis:
            axis = term.carrier[0].output
            column = self.sign * np.asarray(values[one_dimensional_name(axis, axis)])
            found[axis] = self.as_written(axis, term.nodes_mm, column, column)
        return AxisTables(found)

    def with_reversal(self, tables: AxisTables, reversal: ReversalCurves) -> AxisTables:
        """Return the tables with half of the reversal less after positive travel and half more after negative travel.

        With reversal B (position reached in positive minus in negative travel) the tool is at +B/2 after positive travel.
        """
        found = dict(tables.tables)
        for (axis, _), curve in reversal.curves.items():
            if np.max(np.abs(curve.value)) >= WORTH_MM:
                table = found[axis]
                nodes_mm = self.reversal_nodes_mm(table, curve)
                scale = self.sign * table.value_mm  # from stored values to mm with the sign of the control
                half = 0.5 * self.sign * curve.at(nodes_mm)
                positive, negative = (scale * np.interp(nodes_mm, table.nodes_mm, column) for column in table.columns)
                found[axis] = self.as_written(axis, nodes_mm, positive - half, negative + half)
        return AxisTables(found)

    def reversal_nodes_mm(self, table: Table1D, curve: Curve) -> FloatArray:
        """Return the nodes of a table with a reversal: those that it has."""
        return table.nodes_mm

    def context(self, tables: AxisTables) -> dict[str, Any]:
        """Return the rows by axis, and the sign with a worked number."""
        shown = [
            {
                "letter": AXES[table.axis],
                "rows": list(zip(*(column.tolist() for column in (table.nodes, *table.columns)), strict=True)),
            }
            for _, table in sorted(tables.tables.items())
        ]
        return {
            "sign_statement": self.sign_statement(tables),
            "parameters": self.parameters(tables),
            "warnings": [],
            "tables": shown,
            "records": sum(len(part["rows"]) for part in shown),
            "digits": self.digits,
            "settings": self.settings,
        }

    def parameters(self, tables: AxisTables) -> list[dict[str, str]]:
        """Return what must be set on the control besides the tables."""
        return []

    def violations(self, tables: AxisTables) -> list[str]:
        """Return axes without a table, travel that a table does not cover, too many points, uneven spacing."""
        what = f"the {self.table_name}"
        found = [f"there is no {self.table_name} for {AXES[axis]}" for axis in range(3) if axis not in tables.tables]
        for table in self.curves(tables):
            found += self.not_covered(table.axis, table.nodes_mm, what)
            if len(table.nodes) > self.most_points:
                found.append(
                    f"{what} of {AXES[table.axis]} has {len(table.nodes)} points; at most {self.most_points} are possible"
                )
            steps = np.diff(table.nodes_mm)
            if self.even and np.ptp(steps) > 2.0 * 10.0**-self.position_digits:
                found.append(
                    f"the positions of {AXES[table.axis]} are not evenly spaced: {steps.min():g} ... {steps.max():g} mm"
                )
        return found

    def usage(self, tables: AxisTables) -> list[Usage]:
        """Return the points of each axis against the limit."""
        return [
            Usage(f"{self.point_name} of {AXES[table.axis]}", len(table.nodes), self.most_points, self.point_name)
            for table in self.curves(tables)
        ]

    def resolution_mm(self) -> float:
        """Half of the last decimal of a value."""
        return 0.5 * 10.0**-self.digits * self.unit_mm

    def sign_words(self) -> str:
        """Return what a value is, in words."""
        return ""

    def sign_statement(self, tables: AxisTables) -> str:
        """Return what a value is, with the largest one of the file as a worked example."""
        table = largest_of(self.curves(tables))
        axis, k = table.axis, table.largest
        position = np.tile(0.5 * (self.machine.lower_mm + self.machine.upper_mm), (1, 1))
        position[0, axis] = np.clip(table.nodes_mm[k], *self.machine.axes[axis].range_mm)
        added = float(self.emulate(tables, Points(position, approach=np.ones_like(position)))[0, axis])
        return (
            f"{self.sign_words()} Example: at {AXES[axis]} {table.nodes_mm[k]:.6f} mm the file has "
            f"{fixed(float(table.positive[k]), self.digits)}; for the command {AXES[axis]} {position[0, axis]:.4f} mm in "
            f"positive travel the axis goes to {fixed(float(position[0, axis]) + added, 5)} mm."
        )


class AxisTableController(PerAxisController[Settings]):
    """The same for a control whose file has rows of position and value: :meth:`read_file` is all that it needs."""

    #: Longest text of a file.
    most_characters = 5_000_000

    @abstractmethod
    def read_file(self, source: SourceFile) -> dict[int, list[tuple[float, float, float]]]:
        """Return position (mm) and the values in both directions of each row, by axis."""

    def parse(self, files: Sequence[SourceFile]) -> AxisTables:
        """Read the tables strictly; positions must rise."""
        found: dict[int, Table1D] = {}
        for source in files:
            check_size(source, self.most_characters)
            for axis, rows in self.read_file(source).items():
                if axis in found:
                    raise source.fail(f"is a second {self.table_name} of {AXES[axis]}", 1)
                columns = np.array(rows, dtype=np.float64).reshape(-1, 3).T
                if np.any(np.diff(columns[0]) <= 0.0):
                    k = int(np.argmax(np.diff(columns[0]) <= 0.0))
                    message = (
                        f"the position {columns[0, k + 1]:g} of {AXES[axis]} is not above {columns[0, k]:g} before it"
                    )
                    raise source.fail(message, 1)
                if len(rows) < self.least:
                    message = f"the {self.table_name} of {AXES[axis]} has {len(rows)} points; at least {self.least} are needed"
                    raise source.fail(message, 1)
                found[axis] = self.table_of(axis, *columns)
        if not found:
            raise files[0].fail("contains no table", 1) if files else InputError("no file was given")
        return AxisTables(found)
