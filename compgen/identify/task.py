"""The readings of an identification with the problem that they pose, and start values in closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.errors import InputError
from compgen.identify.grid_problem import GridProblem, grid_problem
from compgen.identify.grid_start import start_moments
from compgen.identify.known_stations import HeldStations
from compgen.identify.noise import ReadingNoise
from compgen.identify.parameters import ErrorParameters, common_tool, parameters_for_tools
from compgen.identify.problem import LengthProblem, length_problem
from compgen.identify.start import (
    StationStart,
    station_start,
    station_start_from_moments,
    station_starts_from_moments,
)
from compgen.identify.state import IntArray, State
from compgen.identify.travel import check_travel

AnyProblem = GridProblem | LengthProblem | HeldStations


@dataclass(frozen=True)
class Task:
    """The readings with everything that the stages share."""

    machine: Machine
    lengths: Lengths
    problem: AnyProblem
    station: IntArray
    group: IntArray

    @cached_property
    def target_mm(self) -> FloatArray:
        """Nominal target of every reading, (n, 3)."""
        return self.lengths.position_mm + common_tool(self.machine, self.lengths.tool_mm)


def check_readings(machine: Machine, lengths: Lengths, least: int) -> None:
    """Raise InputError for fewer than ``least`` stations, and for positions outside the travel."""
    if len(lengths.stations) < least:
        raise InputError(
            f"holds readings of {len(lengths.stations)} station(s) ({', '.join(lengths.stations)}); identification "
            f"needs at least {least}: with fewer unknown stations a function-valued ambiguity is left. Add the "
            "missing station, measure with the same tracer from further places, or give known stations",
            file=lengths.origin[0][0] if lengths.origin else None,
        )
    check_travel(machine, lengths.position_mm, lengths.origin)


def task_of(machine: Machine, lengths: Lengths) -> Task:
    """Lay out the unknowns for the readings, all with weight 1."""
    tool_mm = common_tool(machine, lengths.tool_mm)
    layout = parameters_for_tools(machine, tool_mm)
    group = dead_lengths_of(lengths)
    problem = problem_of(machine, lengths, layout, group)
    return Task(machine, lengths, problem, lengths.station, group)


def problem_of(
    machine: Machine, lengths: Lengths, layout: ErrorParameters, group: IntArray
) -> GridProblem | LengthProblem:
    """Return the least-squares problem of the readings: on a grid of levels where they form one, else point by point."""
    tool_mm = common_tool(machine, lengths.tool_mm)
    on_grid = grid_problem(layout, lengths.position_mm, tool_mm, lengths.station, group, lengths.length_mm)
    return on_grid or length_problem(machine, lengths, layout, group)


def dead_lengths_of(lengths: Lengths) -> IntArray:
    """Index of the dead length of every reading: one for every station and set-up."""
    setup = lengths.labels.get("setup")
    if setup is None or not np.any(setup != setup[0]):
        return lengths.station
    _, group = np.unique(np.column_stack([lengths.station, setup]), axis=0, return_inverse=True)
    return group.ravel().astype(np.int64)


def start_values(task: Task) -> tuple[State, list[int]]:
    """Return the start values, and the stations that the closed form could not locate."""
    stations = np.zeros((len(task.lengths.stations), 3))
    groups = int(task.group.max()) + 1
    dead = np.zeros(groups)
    station_of = np.zeros(groups, dtype=np.int64)
    station_of[task.group] = task.station
    moments = start_moments(task.problem) if isinstance(task.problem, GridProblem) else None
    readings = np.bincount(task.station, minlength=len(stations))
    searched: list[int] = []
    at_once: list[StationStart | None] = [None] * len(stations)
    if moments is not None and groups == len(stations):
        at_once = station_starts_from_moments(*moments)
    for k in range(len(stations)):
        own = np.flatnonzero(station_of == k)
        if readings[k] < 4 + len(own):
            origin = task.lengths.origin
            file = origin[int(np.flatnonzero(task.station == k)[0])][0] if origin else None
            message = f"station {task.lengths.stations[k]!r} has only {readings[k]} reading(s); it cannot be located"
            raise InputError(message, file=file)
        found = at_once[k]
        if found is None and moments is not None:
            sums, offset, centre, scale = moments
            found = station_start_from_moments(sums[own], offset[own], centre, scale)
        if found is None:
            found = _start_by_search(task, k)
            searched.append(k)
        stations[k], dead[own] = found.position_mm, found.dead_length_mm
    return State(np.zeros(task.problem.parameters.size), stations, dead), searched


def _start_by_search(task: Task, station: int) -> StationStart:
    rows = task.station == station
    own, member = np.unique(task.group[rows], return_inverse=True)
    member = member.ravel().astype(np.int64)
    return station_start(task.target_mm[rows], task.lengths.length_mm[rows], member, len(own))


def with_weights(task: Task, start: State, noise: ReadingNoise) -> tuple[Task, FloatArray, FloatArray]:
    """Return the task with weighted readings, their standard uncertainty in mm and their weights, each (n,)."""
    if noise.uniform_mm is not None:  # the problem came with weights 1
        count = len(task.lengths)
        return task, np.full(count, noise.uniform_mm), np.ones(count)
    sigma_mm = noise.sigma_mm(task.problem.distances(start))
    weights = (sigma_mm.min() / sigma_mm) ** 2
    return replace(task, problem=task.problem.weighted(weights)), sigma_mm, weights
