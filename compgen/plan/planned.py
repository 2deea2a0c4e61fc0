"""The least-squares problem of a measurement that has not been made: its normal matrix, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.points import Points
from compgen.errors import InputError
from compgen.identify.grid_problem import GridProblem, grid_problem
from compgen.identify.noise import ReadingNoise
from compgen.identify.parameters import error_parameters
from compgen.identify.problem import LengthProblem, length_problem
from compgen.identify.rank import ZERO_EIGENVALUE, Rank, describe_rank, unknown_names
from compgen.identify.state import State
from compgen.model.observability import modelled_errors
from compgen.model.volumetric import c_matrix, tool_of
from compgen.plan.stations import PlannedStations

#: A target nearer to a station than this can not be measured; the line of sight has no direction there.
NEAREST_MM = 1.0
#: A quantity with more than this share of its size in directions without data is not determined.
UNDETERMINED_SHARE = 1e-4


@dataclass(frozen=True)
class Planned:
    """A planned measurement as a least-squares problem whose errors are zero.

    Parameters
    ----------
    machine, stations, noise : what measures what, and how well.
    lengths : the readings that it will have, without errors.
    problem : all weights 1; the weights follow the distances, so they change with the stations.
    tool_mm : tool offsets, (3,) or (n, 3).
    """

    machine: Machine
    stations: PlannedStations
    noise: ReadingNoise
    lengths: Lengths
    problem: GridProblem | LengthProblem
    tool_mm: FloatArray

    def normal_matrix(self, stations_mm: FloatArray) -> FloatArray:
        """Normal matrix (size, size) in 1/mm^2 with the stations at the given places (S, 3)."""
        distance = np.linalg.norm(self.lengths.position_mm + self.tool_mm - stations_mm[self.lengths.station], axis=1)
        weight = 1.0 / self.noise.sigma_mm(distance) ** 2
        state = State(np.zeros(self.problem.parameters.size), stations_mm, np.zeros(self.problem.groups))
        return self.problem.weighted(weight).normal_matrix(state)

    def distances_mm(self) -> FloatArray:
        """Distance of station and target of each reading, (n,)."""
        centre = self.stations.position_mm[self.lengths.station]
        return np.asarray(np.linalg.norm(self.lengths.position_mm + self.tool_mm - centre, axis=1))

    def error_rows(self, position_mm: FloatArray) -> FloatArray:
        """Derivative of E by the unknown errors at commanded points (n, 3): C B, shape (n, 3, errors)."""
        layout = self.problem.parameters
        bases = [layout.basis(axis, position_mm[:, axis]) for axis in range(3)]
        return layout.design(c_matrix(self.machine, position_mm), bases)

    def nodes_without_data(self) -> dict[str, list[float]]:
        """Nodes in mm by axis whose coefficient no reading touches."""
        found = {}
        for axis, name in enumerate(AXES):
            basis = self.problem.parameters.basis(axis, np.unique(self.lengths.position_mm[:, axis]))
            empty = np.abs(basis).max(axis=0) < 1e-12
            found[name] = self.machine.axes[axis].nodes_mm[empty].tolist()
        return {name: nodes for name, nodes in found.items() if nodes}


def planned(machine: Machine, stations: PlannedStations, points: Points, noise: ReadingNoise) -> Planned:
    """Set up the problem of a planned measurement: every station reads every point once in each of its passes.

    Raises
    ------
    InputError
        for a point outside the travel, or a station at a point.
    """
    _check_travel(machine, points)
    count, passes = len(points), len(stations.passes)
    tool = tool_of(machine, points.tool_mm)
    several = tool.ndim == 2 and bool(np.any(np.ptp(tool, axis=0) > 1e-9))
    if tool.ndim == 2 and not several:
        tool = tool[0]
    names = modelled_errors(machine, np.unique(tool, axis=0) if several else None)
    station, setup = np.repeat(stations.passes, count, axis=0).T
    position_mm = np.tile(points.position_mm, (passes, 1))
    tools = np.tile(tool, (passes, 1)) if several else tool
    distance = np.linalg.norm(position_mm + tools - stations.position_mm[station], axis=1)
    lengths = Lengths(
        stations=stations.names,
        station=station,
        point=[str(k + 1) for k in range(count)] * passes,
        position_mm=position_mm,
        length_mm=distance,
        tool_mm=tools if several else np.broadcast_to(tools, position_mm.shape),
        labels={"setup": setup},
    )
    layout = error_parameters(machine, names, several_tools=several)
    _, group = np.unique(np.column_stack([station, setup]), axis=0, return_inverse=True)
    problem = grid_problem(layout, position_mm, tools, station, group.ravel(), distance)
    found = Planned(machine, stations, noise, lengths, problem or length_problem(machine, lengths, layout), tools)
    _check_distance(found)
    return found


def _check_travel(machine: Machine, points: Points) -> None:
    outside = (points.position_mm < machine.lower_mm - 1e-3) | (points.position_mm > machine.upper_mm + 1e-3)
    if outside.any():
        row, axis = np.argwhere(outside)[0].tolist()
        first, last = machine.axes[axis].range_mm
        raise InputError(
            f"{points.position_mm[row, axis]:g} mm (point {row + 1}) lies outside the travel {first:g} ... {last:g} mm "
            f"of {AXES[axis]} of machine {machine.name!r}; choose points within it",
            field=f"column {AXES[axis].lower()}_mm",
        )


def _check_distance(found: Planned) -> None:
    distance = found.distances_mm()
    k = int(np.argmin(distance))
    if distance[k] < NEAREST_MM:
        where = ", ".join(f"{value:g}" for value in found.lengths.position_mm[k])
        raise InputError(
            f"station {found.stations.names[found.lengths.station[k]]!r} stands in the target at ({where}) mm; move it"
        )


@dataclass(frozen=True)
class Prediction:
    """What a normal matrix says about the unknowns.

    ``scale`` (size,) gives the matrix a unit diagonal, ``eigenvalues`` (size,) and ``vectors`` (size, size) are those
    of the scaled matrix; directions with an eigenvalue below the limit are not determined.
    """

    scale: FloatArray
    eigenvalues: FloatArray
    vectors: FloatArray

    @property
    def null(self) -> NDArray[np.bool_]:
        """Which directions have no data, (size,)."""
        return np.asarray(self.eigenvalues < ZERO_EIGENVALUE)

    @cached_property
    def factor(self) -> FloatArray:
        """F (size, rank) with F F^T the covariance of what is determined, mm and rad."""
        kept = ~self.null
        return np.asarray(self.scale[:, None] * self.vectors[:, kept] / np.sqrt(self.eigenvalues[kept]))

    def u(self, rows: FloatArray) -> FloatArray:
        """Standard uncertainty of linear functions of the unknowns, rows (..., size): shape (...,), nan if open."""
        spread = rows @ self.factor
        u = np.sqrt(np.einsum("...k,...k->...", spread, spread))
        if self.null.any():
            scaled = rows * self.scale
            lost = np.linalg.norm(scaled @ self.vectors[:, self.null], axis=-1)
            u = np.where(lost > UNDETERMINED_SHARE * np.linalg.norm(scaled, axis=-1), np.nan, u)
        return np.asarray(u)


def predict_unknowns(matrix: FloatArray) -> Prediction:
    """Return the prediction of a normal matrix (size, size)."""
    diagonal = np.diag(matrix)
    empty = diagonal <= 1e-14 * np.median(diagonal[diagonal > 0])
    scale = 1.0 / np.sqrt(np.where(empty, 1.0, diagonal))
    scaled = np.where(empty[:, None] | empty, 0.0, matrix * scale * scale[:, None])
    return Prediction(scale, *np.linalg.eigh(scaled))


def planned_rank(found: Planned, matrix: FloatArray) -> Rank:
    """Return the rank with the combinations in words."""
    lengths = found.lengths
    _, group = np.unique(np.column_stack([lengths.station, lengths.labels["setup"]]), axis=0, return_inverse=True)
    return describe_rank(matrix, unknown_names(found.problem, lengths.stations, lengths.station, group.ravel()))
