"""Curves of one axis on common nodes: one look-up per position, then all values of that axis from neighbouring rows.

A field is a sum over axes and groups, ``factor_g(position) * table_a,g(position of axis a)``, with three values per
table. For E = C P the factors are 1, the coordinates and the tool offset (:func:`field_tables`); the exact model takes
the motion itself, a translation and a rotation per axis (:func:`motion_tables`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERRORS, error_named
from compgen.model.volumetric import coefficients

#: Groups of a first-order field: factor 1, coordinates x, y, z, tool offset x, y, z.
ONE, COORDINATES, TOOL = 0, (1, 2, 3), (4, 5, 6)
_MOST_BUCKETS = 4096


@dataclass(frozen=True)
class NodeIndex:
    """Finds the interval of a position among ascending ``nodes_mm`` (n,), n > 1, in constant time.

    Even nodes need a multiplication only. Others are looked up in buckets of the shortest interval, so that at most
    one node lies inside a bucket (``single``), or in as many buckets as are allowed.
    """

    nodes_mm: FloatArray

    @property
    def last(self) -> int:
        """Number of the last interval."""
        return len(self.nodes_mm) - 2

    @cached_property
    def even(self) -> bool:
        """Whether the nodes are equidistant up to rounding."""
        due = np.linspace(self.nodes_mm[0], self.nodes_mm[-1], len(self.nodes_mm))
        return bool(np.abs(self.nodes_mm - due).max() <= 4 * np.spacing(np.abs(self.nodes_mm).max()))

    @cached_property
    def buckets_per_mm(self) -> float:
        """Inverse width of a bucket; for even nodes a bucket is an interval."""
        gaps, length = np.diff(self.nodes_mm), float(self.nodes_mm[-1] - self.nodes_mm[0])
        if self.even:
            return (self.last + 1) / length
        return float(min(_MOST_BUCKETS - 1.0, 1.001 * length / gaps.min())) / length

    def _bucket(self, inside_mm: FloatArray) -> NDArray[np.intp]:
        with np.errstate(invalid="ignore"):  # nan stays nan in the share
            bucket: NDArray[np.intp] = ((inside_mm - self.nodes_mm[0]) * self.buckets_per_mm).astype(np.intp)
        return bucket

    @cached_property
    def start(self) -> NDArray[np.intp]:
        """First interval of each bucket: that of the last node which lies in a lower bucket; not for even nodes."""
        if self.even:
            return np.zeros(1, dtype=np.intp)
        buckets = self._bucket(self.nodes_mm)
        first = np.searchsorted(buckets, np.arange(buckets[-1] + 1), side="left") - 1
        return np.clip(first, 0, self.last).astype(np.intp)

    @cached_property
    def single(self) -> bool:
        """Whether no bucket holds more than one node that begins an interval."""
        return bool(np.bincount(self._bucket(self.nodes_mm)[1:-1]).max(initial=0) <= 1)

    @cached_property
    def upper_mm(self) -> FloatArray:
        """Upper end of each interval, infinite for the last."""
        return np.append(self.nodes_mm[1:-1], np.inf)

    @cached_property
    def per_gap(self) -> FloatArray:
        """Inverse length of each interval."""
        return 1.0 / np.diff(self.nodes_mm)

    def locate(self, position_mm: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """Interval (m,) and share (m,) of its upper node of positions (m,); the end values hold outside the nodes.

        A position that is nan has the share nan and any interval; take with ``mode="clip"``.
        """
        inside = np.clip(position_mm, self.nodes_mm[0], self.nodes_mm[-1])
        if self.even:
            share = (inside - self.nodes_mm[0]) * self.buckets_per_mm
            with np.errstate(invalid="ignore"):
                cell = share.astype(np.intp)
            np.minimum(cell, self.last, out=cell)
            share -= cell
            return cell, share
        if self.single:
            cell = self.start.take(self._bucket(inside), mode="clip")
            cell += inside >= self.upper_mm.take(cell)
        else:
            cell = np.searchsorted(self.upper_mm[:-1], inside, side="right")
        inside -= self.nodes_mm.take(cell)
        inside *= self.per_gap.take(cell)
        return cell, inside


@dataclass(frozen=True)
class Channel:
    """One value of one group over the intervals of an axis: ``left + share * step``, both (n - 1,)."""

    group: int
    output: int
    left: FloatArray
    step: FloatArray


@dataclass(frozen=True)
class AxisTable:
    """What one axis adds to a field: ``values`` (n, groups, 3) at the nodes of ``index``, linear in between."""

    index: NodeIndex
    values: FloatArray

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Values at positions (m,): shape (m, groups, 3)."""
        cell, share = self.index.locate(position_mm)
        left = self.values[:-1].take(cell, axis=0, mode="clip")
        step = np.diff(self.values, axis=0).take(cell, axis=0, mode="clip")
        return left + share[:, None, None] * step

    @cached_property
    def groups(self) -> tuple[int, ...]:
        """Groups that are not zero everywhere."""
        return tuple(int(group) for group in np.flatnonzero(np.any(self.values != 0.0, axis=(0, 2))))

    @cached_property
    def channels(self) -> tuple[Channel, ...]:
        """All values that are not zero everywhere."""
        used = np.argwhere(np.any(self.values != 0.0, axis=0))
        columns = [(int(group), int(output), self.values[:, group, output]) for group, output in used]
        return tuple(Channel(group, output, column[:-1].copy(), np.diff(column)) for group, output, column in columns)

    def packed(self, groups: tuple[int, ...]) -> FloatArray:
        """Return the values of ``groups`` as flat rows for the kernels, per interval and group left (4), step (4)."""
        rows = np.zeros((len(self.values) - 1, len(groups), 2, 4))
        rows[:, :, 0, :3] = self.values[:-1, groups]
        rows[:, :, 1, :3] = np.diff(self.values[:, groups], axis=0)
        return rows.reshape(-1)


def _at_nodes(curve: Curve, table: AxisTable) -> FloatArray:
    nodes_mm = table.index.nodes_mm
    return curve.value if len(curve.value) == len(nodes_mm) else curve.at(nodes_mm)


AxisTables = tuple[AxisTable, AxisTable, AxisTable]


def _indices(errors: ErrorTable) -> tuple[NodeIndex, NodeIndex, NodeIndex]:
    """All nodes of the curves of each axis; two nodes at least."""
    positions: tuple[list[FloatArray], ...] = ([], [], [])
    for name, curve in errors.curves.items():
        positions[error_named(name).axis].append(curve.position_mm)
    unions = [np.unique(np.concatenate(found)) if found else np.zeros(1) for found in positions]
    x, y, z = (NodeIndex(nodes if len(nodes) > 1 else nodes[0] + np.array([0.0, 1.0])) for nodes in unions)
    return x, y, z


def _carrier(tables: list[AxisTable], group: int) -> AxisTable:
    """Table that takes a constant of ``group``: one that has the group anyway, else the first."""
    return next((table for table in tables if np.any(table.values[:, group])), tables[0])


def field_tables(machine: Machine, errors: ErrorTable, tool_mm: FloatArray | None) -> AxisTables:
    """Return tables of E = C P with seven groups; a tool offset (3,) is folded into group ``ONE``, as are constants.

    Without ``tool_mm`` the groups ``TOOL`` wait for a tool offset at each point.
    """
    tables = [AxisTable(index, np.zeros((len(index.nodes_mm), 7, 3))) for index in _indices(errors)]
    for term in coefficients(machine.chain, machine.squareness_reference):
        if term.error in errors.curves:
            table = tables[error_named(term.error).axis]
            values = term.sign * _at_nodes(errors.curves[term.error], table)
            group = ONE if term.lever is None else 1 + term.lever
            if group in TOOL and tool_mm is not None:
                group, values = ONE, values * tool_mm[group - TOOL[0]]
            table.values[:, group, term.output] += values
    for term in coefficients(machine.chain, machine.squareness_reference):
        if term.error in errors.squareness and term.lever is not None:
            table = _carrier(tables, 1 + term.lever)
            table.values[:, 1 + term.lever, term.output] += term.sign * errors.squareness[term.error][0]
    return tables[0], tables[1], tables[2]


def grid_tables(
    machine: Machine, errors: ErrorTable, tool_mm: FloatArray, levels_mm: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return the tables of E = C P at the levels of a grid, (n, 4, 3) per axis: groups ``ONE`` and ``COORDINATES``.

    As :func:`field_tables` at these positions, without tables for positions in between.
    """
    values = {name: curve.at(levels_mm[error_named(name).axis]) for name, curve in errors.curves.items()}
    tables = [np.zeros((1 + len(COORDINATES), 3, len(level))) for level in levels_mm]
    for term in coefficients(machine.chain, machine.squareness_reference):
        group = ONE if term.lever is None else 1 + term.lever
        if term.error in values:
            factor = term.sign * (tool_mm[group - TOOL[0]] if group in TOOL else 1.0)
            if factor != 0.0:
                entry = tables[error_named(term.error).axis][ONE if group in TOOL else group, term.output]
                entry += values[term.error] if factor == 1.0 else factor * values[term.error]
        elif term.error in errors.squareness and term.lever is not None:
            tables[0][group, term.output] += term.sign * errors.squareness[term.error][0]
    return [np.ascontiguousarray(table.transpose(2, 0, 1)) for table in tables]


def motion_tables(errors: ErrorTable) -> AxisTables:
    """Return tables of the small motions: group 0 the translation in mm, group 1 the rotation vector in rad."""
    tables = [AxisTable(index, np.zeros((len(index.nodes_mm), 2, 3))) for index in _indices(errors)]
    for error in ERRORS:
        if error.name in errors.curves:
            table = tables[error.axis]
            group = 0 if error.kind == "linear" else 1
            table.values[:, group, error.direction] = _at_nodes(errors.curves[error.name], table)
    return tables[0], tables[1], tables[2]
