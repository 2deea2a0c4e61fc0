"""The unknowns of an adjustment: error curves with their basis and gauge, stations, dead lengths; and the travel they cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import free_basis, hat_matrix, spline_matrix
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERROR_INDEX, ERROR_NAMES, SQUARENESS_NAMES, ErrorName, error_named
from compgen.data.records import POSITION_COLUMNS
from compgen.errors import InputError, Message
from compgen.kinematics.exact_chain import tip_position
from compgen.kinematics.first_order import modelled_errors, observable_errors, tool_of

# The unknown curves: basis, gauge constraints, and place in the vector of unknowns.


#: Positions per node interval at which a cubic curve is written, so that linear interpolation is accurate enough.
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
    """All unknown errors of a machine and their place in the vector of unknowns (curves, then squareness).

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

    def bases(self, position_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Basis matrices of the curves of X, Y, Z at positions (m, 3)."""
        x, y, z = (self.basis(axis, position_mm[:, axis]) for axis in range(3))
        return x, y, z

    def tips(self, unknowns: FloatArray, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """Tool tips of the exact model for the unknown errors, at positions (m, 3) with tools (3,) or (m, 3)."""
        return tip_position(self.machine, self.values(unknowns, self.bases(position_mm)), position_mm, tool_mm)

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

    def pulled(self, columns: FloatArray, bases: Sequence[FloatArray], force: FloatArray) -> FloatArray:
        """Product of the transposed :meth:`design` with one vector (m, 3) for each tip, without the matrix: (size,)."""
        by_error = np.einsum("mij,mi->jm", columns, force)
        sums = [by_error[ERROR_INDEX[c.error.name]] @ bases[c.error.axis] @ c.free for c in self.curves]
        return np.concatenate([*sums, [by_error[ERROR_INDEX[name]].sum() for name in self.squareness]])

    def columns(self) -> list[tuple[str, slice]]:
        """Name and columns of every unknown error."""
        first = self.size - len(self.squareness)
        squareness = [(name, slice(first + k, first + k + 1)) for k, name in enumerate(self.squareness)]
        return [*((curve.error.name, curve.columns) for curve in self.curves), *squareness]

    def value_rows(self, names: Sequence[str], position_mm: FloatArray) -> FloatArray:
        """Derivative of error values, by name and position (k,), by the unknowns: (k, size).

        Zero for errors that are not among the unknowns; the position of a squareness error means nothing.
        """
        rows, label = np.zeros((len(names), self.size)), np.array(names)
        curves = {curve.error.name: curve for curve in self.curves}
        for name, columns in self.columns():
            own = label == name
            if name in curves:
                rows[own, columns] = self.basis(curves[name].error.axis, position_mm[own]) @ curves[name].free
            else:
                rows[own, columns] = 1.0
        return rows

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

    Constraints (Zha & Zhang 2024, eq. 25, taken together; 20 for 17 errors): positioning and angular curves are zero at
    the reference point, straightness curves at both ends of the travel. If several tools were used, the angular curves
    of the axis without any other axis in its lever arm remain free: they contain the constant orientation between tool
    and workpiece, which the tools show.
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
        nodes_mm = machine.axes[error.axis].nodes_mm
        if key not in known:
            reference_mm = machine.reference_point_mm[error.axis]
            zeros = [*machine.axes[error.axis].range_mm] if error.is_straightness else [reference_mm]
            fixed = (nodes_mm[:, None] == np.array(zeros)).any(axis=1)
            if released:
                known[key] = np.eye(len(nodes_mm))
            elif machine.curves == "linear" and np.count_nonzero(fixed) == len(zeros):
                known[key] = np.eye(len(nodes_mm))[:, ~fixed]
            else:
                build = spline_matrix if machine.curves == "cubic" else hat_matrix
                rows = build(nodes_mm, np.array(zeros))
                known[key] = free_basis(np.where(np.abs(rows) < 1e-14, 0.0, rows), len(nodes_mm))
        free = known[key]
        curves.append(CurveParameters(error, nodes_mm, free, slice(size, size + free.shape[1])))
        size += free.shape[1]
    squareness = tuple(name for name in names if name in SQUARENESS_NAMES)
    return ErrorParameters(machine, tuple(curves), squareness, size + len(squareness))


def common_tool(machine: Machine, tool_mm: FloatArray | None) -> FloatArray:
    """Return the tool offset of all rows (3,), or of each (n, 3) if several tools were used; None is the machine's."""
    offset_mm = tool_of(machine, tool_mm)
    one = offset_mm.ndim == 2 and not np.any(np.ptp(offset_mm, axis=0) > 1e-9)
    return offset_mm[0] if one else offset_mm


def parameters_for_tools(machine: Machine, tool_mm: FloatArray) -> ErrorParameters:
    """Lay out the errors of the machine's model for the tools in use, (3,) or (n, 3)."""
    several = tool_mm.ndim == 2
    names = modelled_errors(machine, np.unique(tool_mm, axis=0) if several else None)
    return error_parameters(machine, names, several_tools=several)


# The values of all unknowns of an identification.


IntArray = NDArray[np.int64]


class TracerUnknowns:
    """Counts of the unknowns of tracer lengths: errors, three coordinates per station, one dead length per group.

    ``station_of`` (G,) is the station of each dead length.
    """

    parameters: ErrorParameters
    station_of: IntArray

    @property
    def stations(self) -> int:
        """Number of stations."""
        return int(self.station_of.max()) + 1

    @property
    def groups(self) -> int:
        """Number of dead lengths."""
        return len(self.station_of)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.parameters.size + 3 * self.stations + self.groups


@dataclass(frozen=True)
class State:
    """Current values of the unknowns: errors (size,), stations (S, 3), dead lengths (groups,); mm and rad."""

    errors: FloatArray
    stations_mm: FloatArray
    dead_length_mm: FloatArray

    def moved(self, step: FloatArray) -> State:
        """Return the state after a step (unknowns in the order errors, stations, dead lengths)."""
        first, second = len(self.errors), len(self.errors) + self.stations_mm.size
        return State(
            self.errors + step[:first],
            self.stations_mm + step[first:second].reshape(-1, 3),
            self.dead_length_mm + step[second:],
        )


@dataclass(frozen=True)
class KnownPositions:
    """Stations whose coordinates were observed: indices (k,), positions (k, 3) in mm, weight (k,) of each coordinate.

    A weight is on the scale of the weights of the readings.
    """

    station: IntArray
    position_mm: FloatArray
    weight: FloatArray

    def __len__(self) -> int:
        """Return the number of observed coordinates."""
        return 3 * len(self.station)

    def columns(self, errors: int) -> IntArray:
        """Places (k, 3) of the coordinates among the unknowns, ``errors`` of which come first."""
        return errors + 3 * self.station[:, None] + np.arange(3)

    def square_sum(self, state: State) -> float:
        """Weighted sum of squares of the coordinates."""
        return float(np.sum(self.weight[:, None] * (state.stations_mm[self.station] - self.position_mm) ** 2))

    def add_gradient(self, state: State, gradient: FloatArray) -> float:
        """Add the gradient to that of all unknowns (size,), and return half the weighted sum of squares."""
        away = state.stations_mm[self.station] - self.position_mm
        gradient[self.columns(len(state.errors))] += self.weight[:, None] * away
        return 0.5 * self.square_sum(state)

    def add_weight(self, state: State, matrix: FloatArray) -> None:
        """Add to the normal matrix (size, size)."""
        columns = self.columns(len(state.errors))
        matrix[columns, columns] += self.weight[:, None]


class LeastSquaresProblem(Protocol):
    """Interface of a least-squares problem for the solver; the unknowns are in the order of :meth:`State.moved`."""

    @property
    def parameters(self) -> ErrorParameters:
        """The unknown errors."""

    @property
    def size(self) -> int:
        """Number of unknowns."""

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares, and its gradient (size,)."""

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size), exact or close to it."""

    def residuals(self, state: State) -> FloatArray:
        """Model minus reading of every reading, mm."""

    def weighted(self, weight: FloatArray) -> LeastSquaresProblem:
        """Return the same problem with other weights of the readings, 1/mm^2."""


# Which pose and which dead length a reading belongs to.


@dataclass(frozen=True)
class DistinctPoses:
    """Distinct positions with their tools, (m, 3), ascending, and the pose ``of`` each reading, (n,)."""

    position_mm: FloatArray
    tool_mm: FloatArray
    of: IntArray


def distinct_poses(position_mm: FloatArray, tool_mm: FloatArray) -> DistinctPoses:
    """Number the distinct poses of readings at positions (n, 3) with tools (3,) or (n, 3)."""
    keys: FloatArray = np.column_stack([position_mm, np.broadcast_to(tool_mm, position_mm.shape)])
    unique, of = np.unique(keys, axis=0, return_inverse=True)
    return DistinctPoses(unique[:, :3], unique[:, 3:], of.ravel().astype(np.int64))


def dead_lengths_of(lengths: Lengths) -> IntArray:
    """Index of the dead length of every reading: one for every station and set-up."""
    setup = lengths.labels.get("setup")
    if setup is None or not np.any(setup != setup[0]):
        return lengths.station
    _, group = np.unique(np.column_stack([lengths.station, setup]), axis=0, return_inverse=True)
    return group.ravel().astype(np.int64)


# Measured positions must be within the travel of the machine.


_ROUNDING_MM = 1e-3


def check_travel(
    machine: Machine,
    position_mm: FloatArray,
    origin: Sequence[tuple[str, int]] = (),
    columns: Sequence[str] = POSITION_COLUMNS,
) -> None:
    """Raise InputError, with file, line and column, for the first position (n, 3) outside the travel.

    ``origin`` is file and line of each row; without it the message gives the number of the point. ``columns`` are those of
    the positions in the file.
    """
    for axis in range(3):
        along = np.ascontiguousarray(position_mm[:, axis])
        row = outside_travel(machine, axis, along)
        if row is None:
            continue
        low, high = machine.axes[axis].range_mm
        file, line = origin[row] if len(origin) else (None, None)
        raise InputError(
            Message(
                "outside-travel",
                "{along:g} mm{origin} is outside the travel {low:g} ... {high:g} mm of {value} of "
                "machine {name!r}: wrong machine file, wrong axis order or wrong unit?",
                along=along[row],
                origin="" if len(origin) else f" (point {row + 1})",
                low=low,
                high=high,
                value=AXES[axis],
                name=machine.name,
            ),
            file=file,
            line=line,
            field=f"column {columns[axis]}",
        )


def check_axis_travel(
    machine: Machine,
    axis: IntArray,
    position_mm: FloatArray,
    origin: Sequence[tuple[str, int]],
    field: str | None = None,
) -> None:
    """Do the same for readings along single axes: axis 0 ... 2 and position of each, both (n,)."""
    for k, letter in enumerate(AXES):
        rows = np.flatnonzero(axis == k)
        found = outside_travel(machine, k, position_mm[rows])
        if found is not None:
            row, (low, high) = int(rows[found]), machine.axes[k].range_mm
            file, line = origin[row] if len(origin) else (None, None)
            message = f"{position_mm[row]:g} mm is outside the travel of {letter}, {low:g} to {high:g} mm"
            raise InputError(message, file=file, line=line, field=field)


def outside_travel(machine: Machine, axis: int, position_mm: FloatArray) -> int | None:
    """Return the first row of positions (n,) along an axis outside its travel; None if all are within."""
    low, high = machine.axes[axis].range_mm
    if not len(position_mm) or (position_mm.min() >= low - _ROUNDING_MM and position_mm.max() <= high + _ROUNDING_MM):
        return None
    return int(np.flatnonzero((position_mm < low - _ROUNDING_MM) | (position_mm > high + _ROUNDING_MM))[0])


def state_names(machine: Machine) -> tuple[str, ...]:
    """Return the errors that a posterior contains: those of the model, and observable ones that the machine file leaves out."""
    wanted = {*modelled_errors(machine), *observable_errors(machine)}
    return tuple(name for name in ERROR_NAMES if name in wanted)
