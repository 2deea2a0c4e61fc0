"""Better places for the stations, and the smallest trajectory that reaches a volumetric uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.linalg import LinAlgError

from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.errors import InputError, Message
from compgen.identification.adjust.solver import factorise
from compgen.identification.options import ReadingNoise
from compgen.kinematics.kernel_switch import lapack, one_thread
from compgen.kinematics.many_points import volume_grid
from compgen.planning.prediction import NEAREST_MM, Plan, Planned, plan_of, planned
from compgen.planning.stations import PlannedStations, Region
from compgen.simulation.trajectory import Line, Trajectory, trajectory_points

Criterion = Literal["worst", "rms"]
Progress = Callable[[str], None]

#: Points of the volume for the search; its result is evaluated on the full grid.
SEARCH_POINTS = 200
#: Share of the evaluations for places spread over the regions; the rest improves the best of them.
SPREAD_SHARE = 0.4
#: Reciprocal condition below which an arrangement counts as undetermined in the search.
LEAST_RCOND = 1e-13
DEFAULT_EVALUATIONS = 400


@dataclass(frozen=True)
class Suggestion:
    """Result of a search: the plan for the places found, and how it was found.

    ``start_um`` and ``found_um`` are the criterion at the given stations and at those found, on the search's points;
    ``improved`` says whether the places differ from the given ones.
    """

    plan: Plan
    criterion: Criterion
    start_um: float
    found_um: float
    evaluations: int
    improved: bool

    def summary(self) -> dict[str, Any]:
        """Return the object ``suggestion`` of ``plan.json``."""
        return {
            "criterion": self.criterion,
            "improved": self.improved,
            "criterion_before_um": self.start_um if np.isfinite(self.start_um) else None,
            "criterion_after_um": self.found_um if np.isfinite(self.found_um) else None,
            "evaluations": self.evaluations,
            "determined": self.plan.determined,
            "stations": self.plan.summary()["stations"],
            "volume": self.plan.volume.summary(),
        }


class _Search:
    """The criterion as a function of numbers between 0 and 1; keeps the best and limits the evaluations."""

    def __init__(self, found: Planned, regions: Sequence[Region], criterion: Criterion, limit: int) -> None:
        self.found, self.regions, self.criterion, self.limit = found, regions, criterion, limit
        nodes = [axis.nodes_mm for axis in found.machine.axes]
        grid = volume_grid(found.machine, (nodes[0], nodes[1], nodes[2]), SEARCH_POINTS).position_mm
        self.rows = found.error_rows(grid)
        self.count = 0
        self.best_um, self.best_mm = np.inf, found.stations.position_mm

    def places_mm(self, unit: FloatArray) -> FloatArray:
        """Places (S, 3) of numbers (3 S,)."""
        return np.array([region.place(part) for region, part in zip(self.regions, unit.reshape(-1, 3), strict=True)])

    def at_units(self, unit: FloatArray) -> float:
        """Return the criterion in um for numbers (3 S,); StopIteration when the limit is reached."""
        if self.count >= self.limit:
            raise StopIteration
        return self.at(self.places_mm(unit))

    def at(self, stations_mm: FloatArray) -> float:
        """Return the criterion in um for places (S, 3), remember the best."""
        self.count += 1
        value = self._value(stations_mm)
        if value < self.best_um:
            self.best_um, self.best_mm = value, stations_mm
        return value

    def _value(self, stations_mm: FloatArray) -> float:
        found = self.found
        sight = found.lengths.position_mm + found.tool_mm - stations_mm[found.lengths.station]
        if float(np.einsum("ij,ij->i", sight, sight).min()) < NEAREST_MM**2:
            return np.inf
        try:
            factor = factorise(found.normal_matrix(stations_mm))
        except LinAlgError:
            return np.inf
        if factor.rcond < LEAST_RCOND:
            return np.inf
        inverse, _ = lapack().dtrtri(factor.lower, lower=1)
        size = found.problem.parameters.size
        spread = self.rows @ (factor.scale[:size, None] * np.tril(inverse).T[:size])
        square = np.einsum("nij,nij->n", spread, spread)
        return float(np.sqrt(square.max() if self.criterion == "worst" else square.mean())) / MM_PER_UM


def suggest(
    start: Planned,
    regions: Sequence[Region],
    *,
    criterion: Criterion = "worst",
    evaluations: int = DEFAULT_EVALUATIONS,
    seed: int = 1,
    progress: Progress = lambda _: None,
) -> Suggestion:
    """Search for better places of the stations of a planned measurement: first spread, then Powell's method.

    Parameters
    ----------
    start : the measurement with the given stations, which are one candidate wherever they are.
    regions : where each station may be placed.
    criterion : ``"worst"`` or ``"rms"`` of the standard uncertainty of E over the volume.
    evaluations : number of arrangements to evaluate.
    seed : of the spread places; the same seed gives the same result.
    progress : called with the progress of the search.
    """
    from scipy.optimize import minimize  # imported here: slow to load

    with one_thread():
        search = _Search(start, regions, criterion, evaluations)
        start_um = search.at(start.stations.position_mm)
        _spread(search, seed, progress)
        # Powell's method from the best so far, until the limit; the best is kept
        start_unit = np.concatenate([r.unit(place) for r, place in zip(search.regions, search.best_mm, strict=True)])

        def cost(unit: FloatArray) -> float:
            value = search.at_units(np.clip(unit, 0.0, 1.0))
            progress(f"searching station positions: {search.count} of {search.limit}, best {search.best_um:.3g} um")
            return float(np.log(value)) if np.isfinite(value) else 50.0

        with suppress(StopIteration):
            limits = [(0.0, 1.0)] * len(start_unit)
            minimize(cost, start_unit, method="Powell", bounds=limits, options={"xtol": 0.02, "ftol": 1e-4})
        better = search.best_um < start_um
        found = plan_of(_moved(start, search.best_mm)) if better else plan_of(start)
    return Suggestion(found, criterion, start_um, search.best_um, search.count, better)


def _spread(search: _Search, seed: int, progress: Progress) -> None:
    from scipy.stats import qmc  # imported here: slow to load, and few commands need it

    count = max(1, int(SPREAD_SHARE * search.limit))
    samples = qmc.Sobol(3 * len(search.regions), seed=seed).random_base2(int(np.ceil(np.log2(count))))
    for k, unit in enumerate(samples[:count]):
        if search.count >= search.limit:
            return
        search.at_units(unit)
        progress(f"searching station positions: {k + 1} of {search.limit}, best {search.best_um:.3g} um")


def _moved(start: Planned, stations_mm: FloatArray) -> Planned:
    return planned(start.machine, start.stations.moved(stations_mm), points_of(start), start.noise)


def points_of(found: Planned) -> Points:
    """Return the points of one pass."""
    count = len(found.lengths) // len(found.stations.passes)
    tool = found.lengths.tool_mm
    several = found.tool_mm.ndim == 2 and tool is not None
    return Points(found.lengths.position_mm[:count], tool[:count] if several and tool is not None else None)


# --- trajectories --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrajectoryCandidate:
    """A trajectory with its number of points and what it would reach; ``worst_um`` is infinite if undetermined.

    ``worst_um`` and ``rms_um`` are what the noise of the readings makes of u(E), ``volume_um`` is the largest u(E) with what
    the curves do between their nodes, which no trajectory changes; None without a prior.
    """

    name: str
    position_mm: FloatArray
    determined: bool
    worst_um: float
    rms_um: float
    volume_um: float | None = None

    def summary(self) -> dict[str, Any]:
        """Return one entry of ``trajectories`` of ``plan.json``."""
        return {
            "name": self.name,
            "points": len(self.position_mm),
            "determined": self.determined,
            "u_max_um": self.worst_um if np.isfinite(self.worst_um) else None,
            "u_rms_um": self.rms_um if np.isfinite(self.rms_um) else None,
            "u_max_over_volume_um": self.volume_um,
        }


def candidate_trajectories(machine: Machine) -> dict[str, FloatArray]:
    """Return trajectories (n, 3) by name, each point once: lines, edges, lattices, faces, the grid of all nodes.

    A lattice of k x k has all nodes along every axis on k x k lines; the 12 edges are the one of 2 x 2.
    """
    found = {"12 edges": trajectory_points(Trajectory("frame"), machine)}
    # three lines through the middle of the volume along the axes, and its four body diagonals
    lower, upper = machine.lower_mm, machine.upper_mm
    most, cross = max(len(axis.nodes_mm) for axis in machine.axes), [found["12 edges"]]
    for k, axis in enumerate(machine.axes):
        along = np.tile(0.5 * (lower + upper), (len(axis.nodes_mm), 1))
        along[:, k] = axis.nodes_mm
        cross.append(along)
    diagonals = []
    for corner in ((0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)):
        turned = np.array(corner, dtype=bool)
        a, b = np.where(turned, upper, lower), np.where(turned, lower, upper)
        diagonals.append(Line(tuple(a.tolist()), tuple(b.tolist()), most))
    cross.append(trajectory_points(Trajectory("lines", lines=tuple(diagonals)), machine))
    found["12 edges and cross lines"] = np.concatenate(cross)
    for count in (3, 4, 5, 7):
        if count < min(len(axis.nodes_mm) for axis in machine.axes):
            found[f"lattice {count} x {count}"] = _lattice(machine, count)
    found["6 faces"] = trajectory_points(Trajectory("faces"), machine)
    found["full grid"] = trajectory_points(Trajectory("grid"), machine)
    first = {name: np.unique(points, axis=0, return_index=True)[1] for name, points in found.items()}
    unique = {name: points[np.sort(first[name])] for name, points in found.items()}  # each point once
    return dict(sorted(unique.items(), key=lambda item: len(item[1])))


def _lattice(machine: Machine, count: int) -> FloatArray:
    """All nodes along every axis on count x count lines, ends included."""
    blocks = []
    for axis in range(3):
        levels = []
        for other in range(3):
            nodes = machine.axes[other].nodes_mm
            picked = np.unique(np.round(np.linspace(0, len(nodes) - 1, count)).astype(int))
            levels.append(nodes if other == axis else nodes[picked])
        trajectory = Trajectory("grid", levels_mm=(levels[0], levels[1], levels[2]))
        blocks.append(trajectory_points(trajectory, machine))
    return np.concatenate(blocks)


def judge_trajectories(
    machine: Machine,
    stations: PlannedStations,
    noise: ReadingNoise,
    *,
    target_um: float,
    progress: Progress = lambda _: None,
) -> tuple[list[TrajectoryCandidate], TrajectoryCandidate | None]:
    """Evaluate the candidates from the smallest, and return them with the first that reaches the target, if any.

    ``target_um`` is the largest allowed standard uncertainty of E in the volume, um.
    """
    if not (np.isfinite(target_um) and target_um > 0):
        raise InputError(
            Message(
                "target-not-positive",
                "the target is {target_um:g} um; expected a number above zero",
                target_um=target_um,
            )
        )
    judged: list[TrajectoryCandidate] = []
    with one_thread():
        for name, position_mm in candidate_trajectories(machine).items():
            progress(f"judging trajectory: {name}")
            result = plan_of(planned(machine, stations, Points(position_mm), noise))
            worst, rms = result.from_readings.worst_um, result.from_readings.rms_um
            over_volume = None if result.posterior is None else result.volume.worst_um
            judged.append(TrajectoryCandidate(name, position_mm, result.determined, worst, rms, over_volume))
            if result.determined and worst <= target_um:
                return judged, judged[-1]
    return judged, None
