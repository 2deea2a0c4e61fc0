"""Stations whose machine coordinates are known beforehand: from a file, or located with the machine taken as perfect.

A known coordinate is one more observation, s = s0 with standard uncertainty u. It is not more than that: which errors
one or two stations determine is for the rank to say (``docs/method.md``, "One or two stations").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from compgen.core.csvio import FloatArray, read_csv
from compgen.core.lengths import POSITION_COLUMNS, Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.core.text import nearest
from compgen.errors import InputError
from compgen.identify.grid_problem import GridProblem
from compgen.identify.parameters import ErrorParameters
from compgen.identify.problem import LengthProblem
from compgen.identify.start import station_start
from compgen.identify.state import IntArray, State
from compgen.model.volumetric import tool_of

#: A station without a stated uncertainty is held to this: a nanometre is nothing for a tracer.
HELD_MM = 1e-6

#: Columns of ``stations.csv`` of an identification.
U_OF_IDENTIFY = ("u_x_um", "u_y_um", "u_z_um")
OF_IDENTIFY = (*U_OF_IDENTIFY, "setup", "segment", "dead_length_mm", "u_dead_length_um", "readings", "residual_rms_um")


@dataclass(frozen=True)
class KnownStations:
    """Names (k), positions in the machine frame (k, 3) and standard uncertainty of each coordinate (k,), mm."""

    names: tuple[str, ...]
    position_mm: FloatArray
    u_mm: FloatArray

    def indices(self, stations: Sequence[str]) -> IntArray:
        """Return where the known ones stand among ``stations``; InputError for a name that is not there."""
        for name in self.names:
            if name not in stations:
                message = f"station {name!r} is known, but the measurement has no such station"
                raise InputError(f"{message}; {nearest(name, stations)}")
        return np.array([list(stations).index(name) for name in self.names], dtype=np.int64)


def read_stations(path: str | Path) -> KnownStations:
    """Read known stations: CSV with ``station, x_mm, y_mm, z_mm`` and, if they are not exact, ``u_mm``.

    ``stations.csv`` of an identification will do: its uncertainties are taken, and its further rows of a station.
    """
    optional = ("u_mm", *OF_IDENTIFY)
    table = read_csv(path, required=("station", *POSITION_COLUMNS), optional=optional)
    names = table.names("station")
    position_mm = np.column_stack([table.numbers(name) for name in POSITION_COLUMNS])
    kept: list[int] = []
    for row, name in enumerate(names):
        first = names.index(name)
        if first == row:
            kept.append(row)
        elif "dead_length_mm" not in table.columns or np.max(np.abs(position_mm[row] - position_mm[first])) > 1e-6:
            raise table.fail(row, "station", f"{name!r} stands already in line {table.lines[first]}")
    u_mm = np.zeros(len(table))
    if "u_mm" in table.columns:
        u_mm = table.numbers("u_mm")
    elif all(name in table.columns for name in U_OF_IDENTIFY):
        u_mm = np.max([table.numbers(name) for name in U_OF_IDENTIFY], axis=0) * MM_PER_UM
    for row in np.flatnonzero(u_mm < 0)[:1]:
        raise table.fail(int(row), "u_mm", f"{u_mm[row]:g} is negative; a standard uncertainty is not")
    return KnownStations(tuple(names[row] for row in kept), position_mm[kept], np.maximum(u_mm[kept], HELD_MM))


def locate_stations(machine: Machine, lengths: Lengths) -> KnownStations:
    """Locate every station with the machine taken as perfect (single-station method of Zha & Zhang 2024, section 1).

    The machine's own errors go into the positions. They are smooth over the volume, so that more readings do not average
    them out: the uncertainty is what errors of the size of the residual RMS do if all of them act in the worst way,
    the root of n times that of independent ones.
    """
    target = lengths.position_mm + tool_of(machine, lengths.tool_mm)
    setup = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
    positions, u = [], []
    for k, name in enumerate(lengths.stations):
        rows = lengths.station == k
        _, group = np.unique(setup[rows], return_inverse=True)
        position, uncertainty = _locate(name, target[rows], lengths.length_mm[rows], group.ravel().astype(np.int64))
        positions.append(position)
        u.append(uncertainty)
    return KnownStations(lengths.stations, np.array(positions), np.array(u))


def _locate(name: str, target_mm: FloatArray, length_mm: FloatArray, group: IntArray) -> tuple[FloatArray, float]:
    groups = int(group.max()) + 1
    freedom = len(length_mm) - 3 - groups
    if freedom < 1:
        raise InputError(f"station {name!r} has only {len(length_mm)} reading(s); it cannot be located")
    start = station_start(target_mm, length_mm, group, groups)
    unknowns = np.concatenate([start.position_mm, start.dead_length_mm])
    for _ in range(20):
        sight = target_mm - unknowns[:3]
        distance = np.linalg.norm(sight, axis=1)
        residual = distance - unknowns[3 + group] - length_mm
        jacobian = np.column_stack([-sight / distance[:, None], -(group[:, None] == np.arange(groups)).astype(float)])
        step = np.linalg.lstsq(jacobian, -residual, rcond=1e-12)[0]
        unknowns = unknowns + step
        if np.abs(step).max() < 1e-9:
            break
    rms = float(np.sqrt(np.sum(residual**2) / freedom))
    cofactor = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14)
    worst = float(np.sqrt(len(length_mm) * np.linalg.eigvalsh(cofactor[:3, :3]).max()))
    return unknowns[:3], max(rms * worst, HELD_MM)


def with_known_start(
    start: State, known: KnownStations, lengths: Lengths, target_mm: FloatArray, group: IntArray
) -> State:
    """Return the start with the known positions, and the dead lengths that go with them."""
    stations, dead = start.stations_mm.copy(), start.dead_length_mm.copy()
    for k, position in zip(known.indices(lengths.stations).tolist(), known.position_mm, strict=True):
        stations[k] = position
        rows = np.flatnonzero(lengths.station == k)
        rest = np.linalg.norm(target_mm[rows] - position, axis=1) - lengths.length_mm[rows]
        for own in np.unique(group[rows]).tolist():
            dead[own] = float(np.median(rest[group[rows] == own]))
    return State(start.errors, stations, dead)


@dataclass(frozen=True)
class HeldStations:
    """A problem with known stations as further observations; it has the interface of ``state.Problem``.

    ``station`` (k,) are the indices of the known ones, ``position_mm`` (k, 3) where they stand, ``weight`` (k,) the
    weight of each coordinate on the scale of the weights of the readings.
    """

    problem: GridProblem | LengthProblem
    station: IntArray
    position_mm: FloatArray
    weight: FloatArray

    @property
    def parameters(self) -> ErrorParameters:
        """The unknown errors."""
        return self.problem.parameters

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.problem.size

    @property
    def observations(self) -> int:
        """Number of coordinates that are known."""
        return 3 * len(self.station)

    def _columns(self) -> IntArray:
        return self.parameters.size + 3 * self.station[:, None] + np.arange(3)

    @property
    def held_weight(self) -> FloatArray:
        """Weight of each unknown as an observation of its own (size,), zero for those that are not known."""
        weight = np.zeros(self.size)
        weight[self._columns()] += self.weight[:, None]
        return weight

    def square_sum(self, state: State) -> float:
        """Weighted sum of squares of the known coordinates."""
        return float(np.sum(self.weight[:, None] * (state.stations_mm[self.station] - self.position_mm) ** 2))

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares, and its gradient (size,)."""
        cost, gradient = self.problem.evaluate(state)
        away = self.weight[:, None] * (state.stations_mm[self.station] - self.position_mm)
        gradient = gradient.copy()
        gradient[self._columns()] += away
        return cost + 0.5 * self.square_sum(state), gradient

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size)."""
        matrix = self.problem.normal_matrix(state)
        columns = self._columns()
        matrix[columns, columns] += self.weight[:, None]
        return matrix

    def residuals(self, state: State) -> FloatArray:
        """Model minus reading of every reading, mm."""
        return self.problem.residuals(state)

    def weighted(self, weight: FloatArray) -> HeldStations:
        """Return the same problem with other weights of the readings."""
        return replace(self, problem=self.problem.weighted(weight))

    def distances(self, state: State) -> FloatArray:
        """Return the distance to the station of every reading, mm."""
        return self.problem.distances(state)

    def rebuilt(self, problem: GridProblem | LengthProblem) -> HeldStations:
        """Return the same known stations over another problem."""
        return replace(self, problem=problem)


def hold(
    problem: GridProblem | LengthProblem, known: KnownStations, stations: Sequence[str], sigma_mm: float
) -> HeldStations:
    """Add known stations to a problem in which a reading of standard uncertainty ``sigma_mm`` has weight 1."""
    return HeldStations(problem, known.indices(stations), known.position_mm, (sigma_mm / known.u_mm) ** 2)
