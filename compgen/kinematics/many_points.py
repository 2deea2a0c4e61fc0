"""E = C P at many points and on grids: tables per axis, plain or compiled; points that fill the working volume."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import numbers, of_kind
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Emphasis, Machine
from compgen.data.names import ERRORS, error_named
from compgen.errors import InputError, Message
from compgen.kinematics.first_order import coefficients, tool_of
from compgen.kinematics.kernel_switch import one_thread, use_compiled

# Points that fill the working volume: where tables have their nodes, and between them.

#: A larger full grid is thinned to about this many points.
MOST_POINTS = 20_000


NO_EMPHASIS = Emphasis()
#: Gauss-Legendre points on each of the other two axes, for an axis with all of its levels.
LEAST_ACROSS, MOST_ACROSS = 4, 12
#: Fewer points than this in a plane of a thinned grid are not spread evenly enough.
LEAST_IN_PLANE = 144
#: Least number of intervals over an axis in a sample.
LEAST_INTERVALS = 10


@dataclass(frozen=True)
class VolumeSample:
    """Points (n, 3) in mm with weights (n,) of mean 1, for integrals over the volume."""

    position_mm: FloatArray
    weight: FloatArray


def levels_between(nodes_mm: FloatArray, low_mm: float, high_mm: float) -> FloatArray:
    """Return the nodes within the travel, its ends, and the middle of every interval, ascending."""
    inside = nodes_mm[(nodes_mm > low_mm + 1e-9) & (nodes_mm < high_mm - 1e-9)]
    ends = np.concatenate([[low_mm], np.unique(inside), [high_mm]])
    return np.sort(np.concatenate([ends, 0.5 * (ends[1:] + ends[:-1])]))


def full_grid(levels_mm: Sequence[FloatArray | Sequence[float]]) -> FloatArray:
    """Return the points of a full grid, (n1, n2, n3, 3), from its levels along the three axes; the last runs fastest."""
    return np.stack(np.meshgrid(*levels_mm, indexing="ij"), axis=-1)


@dataclass(frozen=True)
class VolumeGrid:
    """A full grid over the working volume; ``levels_mm`` per axis, points in C order (z runs fastest)."""

    levels_mm: tuple[FloatArray, FloatArray, FloatArray]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of levels of X, Y and Z."""
        x, y, z = (len(levels) for levels in self.levels_mm)
        return x, y, z

    @cached_property
    def position_mm(self) -> FloatArray:
        """All points, shape (n, 3)."""
        return full_grid(self.levels_mm).reshape(-1, 3)


def gauss_levels(ends_mm: FloatArray, count: int, axis: int, emphasis: Emphasis) -> tuple[FloatArray, FloatArray]:
    """Return ``count`` Gauss-Legendre points in each interval between ``ends_mm``, and their weights, of sum 1.

    A weighted sum over them is the mean over the axis, exact for functions that are of degree 2 ``count`` - 1 or less
    in every interval. The weight of the work zone of ``emphasis`` is part of the weights; its ends must be among
    ``ends_mm``.
    """
    points, weight = np.polynomial.legendre.leggauss(count)
    middle, half = 0.5 * (ends_mm[1:] + ends_mm[:-1])[:, None], 0.5 * np.diff(ends_mm)[:, None]
    weighted = emphasis.factor(axis, middle) * half * weight
    return (middle + half * points).ravel(), weighted.ravel() / np.sum(weighted)


def volume_grid(machine: Machine, nodes_mm: tuple[FloatArray, ...], most: int = MOST_POINTS) -> VolumeGrid:
    """Return the grid of the nodes and the midpoints between them; thinned evenly if it would exceed ``most``."""
    levels = [
        levels_between(np.asarray(nodes), *axis.range_mm) for nodes, axis in zip(nodes_mm, machine.axes, strict=True)
    ]
    while np.prod([len(level) for level in levels]) > most:
        longest = int(np.argmax([len(level) for level in levels]))
        count = max(2, int(0.8 * len(levels[longest])))
        picked = np.unique(np.round(np.linspace(0, len(levels[longest]) - 1, count)).astype(int))
        levels[longest] = levels[longest][picked]
    return VolumeGrid((levels[0], levels[1], levels[2]))


def volume_sample(
    machine: Machine,
    nodes_mm: tuple[FloatArray, ...],
    most: int = MOST_POINTS,
    emphasis: Emphasis = NO_EMPHASIS,
) -> VolumeSample:
    """Return points that determine tables with the given nodes; weighted sums over them are integrals over the volume.

    Along each axis there are two Gauss-Legendre points between neighbouring nodes: tables that are linear there are
    integrated exactly. If the full grid has more than ``most`` points, only points (i, j, k) with i + j + k a multiple
    of a whole number are used. Each plane of the grid then has points evenly distributed over the other two axes, and
    a function of one axis is orthogonal to functions of the others as it is over the volume; with a random sample,
    errors that the tables cannot represent would make their values ragged.

    The weight of the work zone of ``emphasis`` is part of the weights, interval by interval: its ends are nodes. Points
    at the nodes, on lines along the axes through corners and middles of the travel, follow with weight 0: the largest
    error is usually there.
    """
    nodes_mm = tuple(np.append(nodes, emphasis.ends_mm(axis)) for axis, nodes in enumerate(nodes_mm))
    sides = []
    for axis, nodes in enumerate(nodes_mm):
        # two Gauss-Legendre points in each interval between nodes within the travel; their weights sum to 1; if there
        # are few intervals they are divided, because the errors are less smooth than the tables
        low, high = machine.axes[axis].range_mm
        inside = nodes[(nodes > low + 1e-9) & (nodes < high - 1e-9)]
        ends = np.concatenate([[low], np.unique(inside), [high]])
        parts = -(-LEAST_INTERVALS // (len(ends) - 1))
        ends = np.interp(np.arange(parts * (len(ends) - 1) + 1) / parts, np.arange(len(ends)), ends)
        middle, half = 0.5 * (ends[1:] + ends[:-1])[:, None], 0.5 * np.diff(ends)[:, None]
        weighted = emphasis.factor(axis, middle) * half * np.ones(2)
        points = (middle + half * np.array([-1.0, 1.0]) / np.sqrt(3.0)).ravel()
        sides.append((points, weighted.ravel() / np.sum(weighted)))
    counts = [len(points) for points, _ in sides]
    every = -(-math.prod(counts) // most)
    if every > 1 and most < LEAST_IN_PLANE * max(counts):
        inner = _three_grids(machine, sides, most, emphasis)
    else:
        thinned = _lattice(counts, every)
        position_mm = np.stack([side[0][part] for side, part in zip(sides, thinned, strict=True)], axis=1)
        weight = np.prod([side[1][part] for side, part in zip(sides, thinned, strict=True)], axis=0)
        inner = VolumeSample(position_mm, weight)
    lines_mm = _lines(machine, nodes_mm)
    weight = np.concatenate([inner.weight, np.zeros(len(lines_mm))])
    return VolumeSample(np.concatenate([inner.position_mm, lines_mm]), weight * (len(weight) / weight.sum()))


def _lines(machine: Machine, nodes_mm: Sequence[FloatArray]) -> FloatArray:
    """Points (m, 3) at the nodes within the travel and its ends, on nine lines along each axis."""
    ends = [np.array([low, 0.5 * (low + high), high]) for low, high in (axis.range_mm for axis in machine.axes)]
    found = []
    for axis, nodes in enumerate(nodes_mm):
        levels = list(ends)
        levels[axis] = np.unique(np.clip(np.concatenate([nodes, ends[axis]]), *machine.axes[axis].range_mm))
        found.append(VolumeGrid((levels[0], levels[1], levels[2])).position_mm)
    return np.unique(np.concatenate(found), axis=0)


def _lattice(counts: Sequence[int], every: int) -> list[NDArray[np.int64]]:
    """Indices (m,) of the points of a grid, for its three axes, whose sum is a multiple of ``every``."""
    kept = np.indices(tuple(counts)).sum(axis=0) % every == 0
    return [np.asarray(part, dtype=np.int64) for part in np.nonzero(kept)]


def _three_grids(
    machine: Machine, sides: Sequence[tuple[FloatArray, FloatArray]], most: int, emphasis: Emphasis
) -> VolumeSample:
    """Three grids, one for each axis: all its points times a few Gauss-Legendre points of the other two.

    For tables with so many nodes that a thinned grid would leave too few points in a plane.
    """
    positions, weights = [], []
    for axis in range(3):
        count = int(np.clip(np.sqrt(most / len(sides[axis][0])), LEAST_ACROSS, MOST_ACROSS))
        parts = list(sides)
        for k in {0, 1, 2} - {axis}:  # about ``count`` points over the axis, within and outside of the work zone
            ends = np.unique([*machine.axes[k].range_mm, *emphasis.ends_mm(k)])
            parts[k] = gauss_levels(ends, max(LEAST_ACROSS, count // (len(ends) - 1)), k, emphasis)
        grid = VolumeGrid((parts[0][0], parts[1][0], parts[2][0]))
        positions.append(grid.position_mm)
        weights.append(np.einsum("i,j,k->ijk", parts[0][1], parts[1][1], parts[2][1]).ravel())
    joined = np.concatenate(weights)
    return VolumeSample(np.concatenate(positions), joined * (len(joined) / joined.sum()))


# Curves of one axis on common nodes: one look-up per position, then all values of the axis from neighbouring rows.
#
# A field is a sum over axes and groups, ``factor_g(position) * table_a,g(position of axis a)``, with three values per
# table. For E = C P the factors are 1, the coordinates and the tool offset (:func:`field_tables`); the exact model takes
# the motion itself, a translation and a rotation per axis (:func:`motion_tables`).


#: Groups of a first-order field: factor 1, coordinates x, y, z, tool offset x, y, z.
ONE, COORDINATES, TOOL = 0, (1, 2, 3), (4, 5, 6)
_MOST_BUCKETS = 4096


@dataclass(frozen=True)
class NodeIndex:
    """Finds the interval of a position among ascending ``nodes_mm`` (n,), n > 1, in constant time.

    Equidistant nodes only need a multiplication. Others are looked up in buckets as long as the shortest interval, with
    at most one node inside a bucket (``single``), or in the largest allowed number of buckets.
    """

    nodes_mm: FloatArray

    @property
    def last(self) -> int:
        """Number of the last interval."""
        return len(self.nodes_mm) - 2

    @cached_property
    def even(self) -> bool:
        """Whether the nodes are equidistant up to rounding."""
        regular = np.linspace(self.nodes_mm[0], self.nodes_mm[-1], len(self.nodes_mm))
        return bool(np.abs(self.nodes_mm - regular).max() <= 4 * np.spacing(np.abs(self.nodes_mm).max()))

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
        """First interval of each bucket: starts at the last node in a lower bucket; not for equidistant nodes."""
        if self.even:
            return np.zeros(1, dtype=np.intp)
        buckets = self._bucket(self.nodes_mm)
        first = np.searchsorted(buckets, np.arange(buckets[-1] + 1), side="left") - 1
        return np.clip(first, 0, self.last).astype(np.intp)

    @cached_property
    def single(self) -> bool:
        """Whether no bucket contains more than one node that begins an interval."""
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
        """Interval (m,) and share (m,) of its upper node of positions (m,); outside the nodes the end values apply.

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
class AxisChannel:
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

    @cached_property
    def groups(self) -> tuple[int, ...]:
        """Groups that are not zero everywhere."""
        return tuple(int(group) for group in np.flatnonzero(np.any(self.values != 0.0, axis=(0, 2))))

    @cached_property
    def channels(self) -> tuple[AxisChannel, ...]:
        """All values that are not zero everywhere."""
        used = np.argwhere(np.any(self.values != 0.0, axis=0))
        columns = [(int(group), int(output), self.values[:, group, output]) for group, output in used]
        return tuple(
            AxisChannel(group, output, column[:-1].copy(), np.diff(column)) for group, output, column in columns
        )

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
    """All nodes of the curves of each axis; at least two nodes."""
    positions: tuple[list[FloatArray], ...] = ([], [], [])
    for name, curve in errors.curves.items():
        positions[error_named(name).axis].append(curve.position_mm)
    unions = [np.unique(np.concatenate(found)) if found else np.zeros(1) for found in positions]
    x, y, z = (NodeIndex(nodes if len(nodes) > 1 else nodes[0] + np.array([0.0, 1.0])) for nodes in unions)
    return x, y, z


def field_tables(machine: Machine, errors: ErrorTable, tool_mm: FloatArray | None) -> AxisTables:
    """Return tables of E = C P with seven groups; a tool offset (3,) is folded into group ``ONE``, as are constants.

    Without ``tool_mm`` the groups ``TOOL`` remain, for a tool offset at each point.
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
            # the constant goes into a table that already has the group, else into the first
            table = next((table for table in tables if np.any(table.values[:, 1 + term.lever])), tables[0])
            table.values[:, 1 + term.lever, term.output] += term.sign * errors.squareness[term.error][0]
    return tables[0], tables[1], tables[2]


def grid_tables(
    machine: Machine, errors: ErrorTable, tool_mm: FloatArray, levels_mm: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return the tables of E = C P at the levels of a grid, (n, 4, 3) per axis: groups ``ONE`` and ``COORDINATES``.

    Like :func:`field_tables` at these positions, without tables for positions in between.
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
    numbers = ((name, curve.position_mm, curve.value) for name, curve in errors.curves.items())
    return _motion_tables(*((name, *(np.asarray(k, np.float64).tobytes() for k in two)) for name, *two in numbers))


@lru_cache(maxsize=8)
def _motion_tables(*curves: tuple[str, bytes, bytes]) -> AxisTables:
    """The tables of curves: names, nodes in mm, values. Many small calculations ask for those of the same errors."""
    numbers = ((name, np.frombuffer(nodes), np.frombuffer(values)) for name, nodes, values in curves)
    errors = ErrorTable({name: Curve(nodes_mm, value, np.zeros(len(value))) for name, nodes_mm, value in numbers})
    tables = [AxisTable(index, np.zeros((len(index.nodes_mm), 2, 3))) for index in _indices(errors)]
    for error in ERRORS:
        if error.name in errors.curves:
            table = tables[error.axis]
            group = 0 if error.kind == "linear" else 1
            table.values[:, group, error.direction] = _at_nodes(errors.curves[error.name], table)
    return tables[0], tables[1], tables[2]


# Calls of the compiled kernels of :mod:`compgen.kinematics.compiled_kernels`;
# :mod:`compgen.kinematics.kernel_switch` decides when they are used.
#
# Importing this does not import numba: that alone takes a third of a second.


_ROW = 8  # numbers per group and interval


def _axis(table: AxisTable, groups: tuple[int, ...]) -> tuple[Any, ...]:
    """One axis in the form that the kernels use."""
    index = table.index
    ends = float(index.nodes_mm[0]), float(index.nodes_mm[-1]), index.buckets_per_mm
    nodes = np.array(index.nodes_mm), index.upper_mm, index.per_gap
    return (*ends, np.uint64(index.last), index.start, *nodes, table.packed(groups))


def _even(tables: AxisTables) -> tuple[bool, bool, bool]:
    x, y, z = (table.index.even for table in tables)
    return x, y, z


def field_at(tables: AxisTables, position_mm: FloatArray, tool_mm: FloatArray | None, out: FloatArray) -> None:
    """Write E = C P at points (n, 3), with a tool offset each (n, 3) or folded into the tables, to ``out`` (n, 3)."""
    from compgen.kinematics.compiled_kernels import field_kernel

    used = [
        tuple(group for group in table.groups if tool_mm is not None or group <= max(COORDINATES)) for table in tables
    ]
    offsets = tuple(
        (*(_ROW * groups.index(group) if group in groups else -1 for group in range(7)), _ROW * len(groups))
        for groups in used
    )
    axes = tuple(_axis(table, groups) for table, groups in zip(tables, used, strict=True))
    tool = np.zeros((1, 3)) if tool_mm is None else np.ascontiguousarray(tool_mm)
    field_kernel(offsets, _even(tables), tool_mm is not None)(axes, _apart(position_mm, out), _apart(tool, out), out)


def field_on_grid(at_levels: Sequence[FloatArray], levels_mm: Sequence[FloatArray], out: FloatArray) -> None:
    """Write E = C P on a grid to ``out`` (nx, ny, nz, 3), from the tables at the levels, each (n, 4, 3)."""
    from compgen.kinematics.compiled_kernels import grid_kernel

    levels, values = map(np.ascontiguousarray, levels_mm), map(np.ascontiguousarray, at_levels)
    grid_kernel(bool(np.any(at_levels[2][:, 2])))(*levels, *values, out)


def exact_at(
    tables: AxisTables,
    order: Sequence[tuple[int, bool]],
    tilt: FloatArray,
    position_mm: FloatArray,
    tool_mm: FloatArray,
    out: FloatArray,
) -> None:
    """Write the exact error at points (n, 3) with tool offsets (1, 3) or (n, 3) to ``out`` (n, 3)."""
    from compgen.kinematics.compiled_kernels import exact_kernel

    axes = tuple(_axis(table, (0, 1)) for table in tables)
    passed = np.array([axis for axis, _ in order]), np.array([side for _, side in order])
    exact_kernel()(
        axes,
        np.array(_even(tables)),
        *passed,
        tilt,
        _apart(position_mm, out),
        _apart(np.ascontiguousarray(tool_mm), out),
        out,
    )


def _apart(values: FloatArray, out: FloatArray) -> FloatArray:
    """Return C-ordered values that do not share memory with ``out``: kernels write ahead of their reads."""
    return values.copy() if np.may_share_memory(values, out) else np.ascontiguousarray(values)


# E = C P at many points: sums of tables per axis, in blocks of constant memory.
#
# Every entry of C is 1, a coordinate or a tool offset, so with f = (1, x, y, z, tool offset)
#
#     E(x, y, z) = sum over g of f_g * (X_g(x) + Y_g(y) + Z_g(z)),
#
# each table a vector of three, including squareness and signs (:func:`field_tables`). A list of points costs one
# look-up per axis. On a full grid no points are formed: as a matrix of rows (x, y) against columns (z, component) E has
# a rank of at most nine. The kernels of :mod:`compgen.kinematics.many_points` do the same in one pass
# (:mod:`compgen.kinematics.kernel_switch` decides when).


#: Points per block: the intermediate arrays stay in the cache of one core.
BLOCK = 16_384
_GRID_BLOCK = 32_768
#: From this many points on, loading the kernels (half a second, at first some seconds) pays off in a single call.
_POINTS_FOR_KERNELS, _GRID_FOR_KERNELS = 20_000_000, 500_000_000


def checked_points(machine: Machine, errors: ErrorTable, position_mm: FloatArray) -> FloatArray:
    """Return positions as numbers, or raise if they are not of shape (n, 3), or the others are not what they should be."""
    of_kind("machine", machine, Machine)
    of_kind("errors", errors, ErrorTable)
    return numbers("position_mm", position_mm, None, 3, finite=False)


def checked_out(out: FloatArray | None, shape: tuple[int, ...]) -> FloatArray:
    """Return ``out``, or a new array if it is None; raise if the result does not fit into it."""
    if out is None:
        return np.empty(shape)
    if out.shape != shape or out.dtype != np.float64 or not out.flags.c_contiguous or not out.flags.writeable:
        raise InputError(
            Message(
                "out-array-unfit",
                "out has the shape {shape} and type {dtype}; expected a writeable C-ordered float64 array {shape2}",
                shape=out.shape,
                dtype=out.dtype,
                shape2=shape,
            )
        )
    return out


def blocks(count: int, size: int = BLOCK) -> Iterator[slice]:
    """Slices that cover ``count`` items, ``size`` at a time."""
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def volumetric_error(
    machine: Machine,
    errors: ErrorTable,
    position_mm: FloatArray,
    tool_mm: FloatArray | None = None,
    out: FloatArray | None = None,
) -> FloatArray:
    """Error E = C P of the tool tip against the workpiece at commanded positions.

    Parameters
    ----------
    machine, errors : the machine and its errors.
    position_mm : shape (n, 3).
    tool_mm : tool offset, shape (3,) or (n, 3), default the machine's.
    out : array (n, 3) for the result; new if not given.

    Returns
    -------
    array of shape (n, 3), mm.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> leaning = compgen.ErrorTable(squareness={"EC0Y": (2903e-6, 0.0)})
    >>> position_mm = np.array([[0.0, -1000.0, 0.0]])
    >>> compgen.volumetric_error(machine, leaning, position_mm).round(4).tolist()
    [[2.903, 0.0, 0.0]]
    """
    position = checked_points(machine, errors, position_mm)
    result = checked_out(out, position.shape)
    tool = tool_of(machine, tool_mm, len(position))
    each = None if tool.ndim == 1 else np.broadcast_to(tool, position.shape)
    tables = field_tables(machine, errors, tool if each is None else None)
    if use_compiled(len(position), _POINTS_FOR_KERNELS):
        field_at(tables, position, each, result)
        return result
    for part in blocks(len(position)):
        factors = list(np.ascontiguousarray(position[part].T))
        if each is not None:
            factors.extend(np.ascontiguousarray(each[part].T))
        sums = _group_sums(tables, factors)
        for output in range(3):
            total = sums.pop((ONE, output), None)
            for group, factor in enumerate(factors, start=1):
                term = sums.pop((group, output), None)
                if term is not None:
                    term *= factor
                    total = term if total is None else np.add(total, term, out=total)
            result[part, output] = 0.0 if total is None else total
    return result


def _group_sums(tables: AxisTables, coordinates: Sequence[FloatArray]) -> dict[tuple[int, int], FloatArray]:
    """X_g(x) + Y_g(y) + Z_g(z) by group and component, unless zero."""
    sums: dict[tuple[int, int], FloatArray] = {}
    value, left = np.empty((2, len(coordinates[0])))
    for table, coordinate in zip(tables, coordinates, strict=False):
        if not table.channels:
            continue
        cell, share = table.index.locate(coordinate)
        for channel in table.channels:
            key = channel.group, channel.output
            channel.step.take(cell, mode="clip", out=value)
            np.multiply(value, share, out=value)
            channel.left.take(cell, mode="clip", out=left)
            if key in sums:
                sums[key] += left
                sums[key] += value
            else:
                sums[key] = left + value
    return sums


def volumetric_error_on_grid(
    machine: Machine,
    errors: ErrorTable,
    levels_mm: Sequence[FloatArray],
    tool_mm: FloatArray | None = None,
    out: FloatArray | None = None,
) -> FloatArray:
    """Error E = C P of the tool tip on a full grid, in a single pass over the result.

    Parameters
    ----------
    machine, errors : the machine and its errors.
    levels_mm : positions of X, Y and Z, shapes (nx,), (ny,), (nz,), in any order.
    tool_mm : tool offset, shape (3,), default the machine's.
    out : array (nx, ny, nz, 3) for the result; new if not given.

    Returns
    -------
    array of shape (nx, ny, nz, 3), mm.
    """
    levels = [np.asarray(level, dtype=np.float64) for level in levels_mm]
    if len(levels) != 3 or any(level.ndim != 1 for level in levels):
        raise InputError(
            Message("grid-levels-missing", "a grid needs three lists of levels in mm: those of X, of Y and of Z")
        )
    tool = tool_of(machine, tool_mm)
    if tool.shape != (3,):
        raise InputError(
            Message(
                "grid-one-tool",
                "tool offsets have the shape {shape}; a grid has one tool, (3,) in mm",
                shape=tool.shape,
            )
        )
    shape = (len(levels[0]), len(levels[1]), len(levels[2]), 3)
    result = checked_out(out, shape)
    if result.size == 0:
        return result
    at_levels = grid_tables(machine, errors, tool, levels)
    if use_compiled(result.size // 3, _GRID_FOR_KERNELS):
        field_on_grid(at_levels, levels, result)
    else:
        _grid_by_rank(at_levels, levels, result)
    return result


def _grid_by_rank(at_levels: Sequence[FloatArray], levels: Sequence[FloatArray], out: FloatArray) -> None:
    """Write the field on a grid as a product: functions of (x, y) times functions of (z, component).

    E_o = 1 * [P_o(x, y)] + z * [Q_o(x, y)] + Z_1,o(z) * [1] + Z_x,o(z) * [x] + Z_y,o(z) * [y], where Z_1 takes z Z_z.
    """
    count_x, count_y, count_z, _ = out.shape
    z, values = levels[2], at_levels[2]
    components = np.tile(np.eye(3), count_z)
    own = values[:, 0] + z[:, None] * values[:, 3]
    functions = [own.reshape(1, -1), values[:, 1].reshape(1, -1), values[:, 2].reshape(1, -1)]
    columns = np.vstack([components, components * np.repeat(z, 3), *functions])  # (9, 3 nz)
    needed = np.any(columns != 0.0, axis=1)
    needed[3:6] &= np.any(at_levels[0][:, 3], axis=0) | np.any(at_levels[1][:, 3], axis=0)
    rows = out.reshape(count_x * count_y, 3 * count_z)
    plane = max(1, BLOCK // count_y)
    for part in blocks(count_x, plane):
        for inner in blocks(count_y, BLOCK):
            # the nine factors (P, Q, 1, x, y) of those functions, (nx, ny, 9)
            x, y = levels[0][part, None, None], levels[1][None, inner, None]
            along_x, along_y = at_levels[0][part, None], at_levels[1][None, inner]
            factors = np.empty((x.shape[0], y.shape[1], 9))
            factors[:, :, 0:3] = along_x[:, :, 0] + x * along_x[:, :, 1] + along_y[:, :, 0] + y * along_y[:, :, 2]
            factors[:, :, 0:3] += y * along_x[:, :, 2] + x * along_y[:, :, 1]
            factors[:, :, 3:6] = along_x[:, :, 3] + along_y[:, :, 3]
            factors[:, :, 6], factors[:, :, 7], factors[:, :, 8] = 1.0, x[:, :, 0], y[:, :, 0]
            left = factors.reshape(-1, 9)[:, needed]
            first = part.start * count_y + inner.start
            product, right = rows[first : first + len(left)], columns[needed]
            with one_thread():
                for some in blocks(len(left), max(1, 3 * _GRID_BLOCK // right.shape[1])):
                    np.matmul(left[some], right, out=product[some])
