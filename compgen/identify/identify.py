"""Joint identification of error curves, squareness, stations and dead lengths from tracer lengths.

Zha & Zhang 2024, section 5 (eq. 22-28), with the exact machine model in place of C P and the constraints of
``docs/conventions.md`` by elimination.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.errors import CompgenWarning, ConvergenceError, InputError, UndeterminedError
from compgen.identify.adjustment import Adjustment
from compgen.identify.affine_start import affine_start
from compgen.identify.covariance import with_systematic
from compgen.identify.grid_problem import GridProblem, grid_problem, start_moments
from compgen.identify.known_stations import HeldStations, KnownStations, hold, locate_stations, with_known_start
from compgen.identify.located import TracerReadings
from compgen.identify.noise import IdentifyOptions, ReadingNoise, reading_noise
from compgen.identify.outliers import belonging, explain_rejected
from compgen.identify.parameters import ErrorParameters, common_tool, parameters_for_tools
from compgen.identify.problem import LengthProblem, length_problem
from compgen.identify.rank import Rank, analyse_rank
from compgen.identify.reference import identify_at_reference
from compgen.identify.result import Identification, StationResult, worst_uncertainty
from compgen.identify.robust import Readings, RobustFit, fit_robustly
from compgen.identify.robust_start import robust_state
from compgen.identify.solver import Factor, factorise, solve
from compgen.identify.start import (
    StationStart,
    station_start,
    station_start_from_moments,
    station_starts_from_moments,
)
from compgen.identify.state import IntArray, State
from compgen.identify.tables import error_table, inverse, metadata_of, unobservable
from compgen.identify.threads import one_thread
from compgen.identify.travel import check_travel
from compgen.identify.two_step import solve_in_two_steps

AnyProblem = GridProblem | LengthProblem | HeldStations
MIN_STATIONS = 3
#: Reciprocal condition of the scaled normal matrix below which the rank is looked at in detail.
SUSPICIOUS_RCOND = 1e-10
#: Eigenvalue of the scaled normal matrix below which a combination is named when nothing converges.
HARDLY_DETERMINED = 1e-6


@dataclass(frozen=True)
class _Task:
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


def identify(machine: Machine, lengths: Lengths, options: IdentifyOptions | None = None) -> Identification:
    """Identify the errors of a machine, the stations and the dead lengths from tracer lengths.

    Parameters
    ----------
    machine : chain, nodes, reference point and which errors its model contains.
    lengths : readings of three or more stations (one tracer at three or more places counts as so many).
    options : uncertainty of the readings and of inputs that they share, rejection.

    Raises
    ------
    InputError
        for fewer than three stations, or positions outside the travel.
    UndeterminedError
        if the readings do not determine the unknowns; it names the combinations.
    ConvergenceError
        if no optimum is reached.
    """
    chosen = options or IdentifyOptions()
    with one_thread():
        found = identify_at_reference(
            machine,
            lengths,
            lambda readings: _identify(machine, readings, chosen),
            lambda readings: _rough(machine, readings),
            temperature=chosen.temperature,
        )
        return with_systematic(machine, lengths, found, chosen.systematic)


def _rough(machine: Machine, lengths: Lengths) -> tuple[ErrorParameters, State, IntArray]:
    """Return the unknown errors, start values of everything and the dead length of each reading."""
    task = _task(machine, lengths)
    start, _ = robust_state(_start(task)[0], lengths, task.target_mm, task.station, task.group)
    return task.problem.parameters, start, task.group


def _identify(machine: Machine, lengths: Lengths, options: IdentifyOptions) -> Identification:
    _check_readings(machine, lengths, 1 if options.stations is not None else MIN_STATIONS)
    task = _task(machine, lengths)
    start, searched = _start(task)
    if not searched and options.stations is None and options.method == "joint":
        found = _undisturbed(task, start, options)
        if found is not None:
            return found
    start, disturbed = robust_state(start, lengths, task.target_mm, task.station, task.group)
    noise = reading_noise(lengths, options)
    task, sigma_mm, weights = _with_weights(task, start, noise)
    if options.stations is not None:
        task, start = _with_known_stations(task, start, options.stations, float(sigma_mm.min()))
    factor, rank = _determined(task, start)
    start = _unmirrored(task, start, searched)
    if options.method == "two-step":
        return _two_step_result(task, start, sigma_mm, noise, options)
    readings = Readings(lengths, task.target_mm, task.group, weights, sigma_mm)
    try:
        fit = _fit(task, start, readings, factor, options, disturbed=disturbed)
    except ConvergenceError as error:
        raise ConvergenceError(f"{error}{_weakness(task, factor)}") from error
    task = replace(task, problem=fit.problem, group=fit.group)
    return _result(task, fit, sigma_mm, noise, rank)


def _with_weights(task: _Task, start: State, noise: ReadingNoise) -> tuple[_Task, FloatArray, FloatArray]:
    """Return the task with weighted readings, their standard uncertainty in mm and their weights, each (n,)."""
    sigma_mm = noise.sigma_mm(task.problem.distances(start))
    weights = (sigma_mm.min() / sigma_mm) ** 2
    return replace(task, problem=task.problem.weighted(weights)), sigma_mm, weights


def _undisturbed(task: _Task, start: State, options: IdentifyOptions) -> Identification | None:
    """Identify by plain least squares; None where a reading does not belong, or where it does not converge.

    Undisturbed readings are the rule, and need none of the search for gross errors.
    """
    if isinstance(task.problem, GridProblem):
        start = affine_start(task.problem, start)
    noise = reading_noise(task.lengths, options)
    task, sigma_mm, _ = _with_weights(task, start, noise)
    try:
        factor, rank = _determined(task, start)
        solution = solve(task.problem, start, factor)
    except (ConvergenceError, UndeterminedError):
        return None
    residual = task.problem.residuals(solution.state)
    if options.reject and not belonging(residual / sigma_mm):
        return None
    accepted = np.ones(len(residual), dtype=bool)
    return _result(task, RobustFit(task.problem, task.group, solution, accepted, residual), sigma_mm, noise, rank)


def _with_known_stations(
    task: _Task, start: State, stations: KnownStations | Literal["nominal"], sigma_mm: float
) -> tuple[_Task, State]:
    """Add the known stations to the problem and start from them."""
    known = stations if isinstance(stations, KnownStations) else locate_stations(task.machine, task.lengths)
    if known is not stations:
        message = "the stations were located with the machine taken as perfect: its errors are part of their positions"
        warnings.warn(f"{message} (to {known.u_mm.max() * 1e3:.1f} um)", CompgenWarning, stacklevel=5)
    assert not isinstance(task.problem, HeldStations)
    start = with_known_start(start, known, task.lengths, task.target_mm, task.group)
    return replace(task, problem=hold(task.problem, known, task.lengths.stations, sigma_mm)), start


def _two_step_result(
    task: _Task, start: State, sigma_mm: FloatArray, noise: ReadingNoise, options: IdentifyOptions
) -> Identification:
    """Identify by self-calibration, transformation and separation (Zha & Zhang 2024, sections 4 and 5)."""
    if options.stations is not None:
        raise InputError("known stations belong to the joint method; in two steps the tracers locate themselves")
    readings = TracerReadings(task.lengths, task.problem.parameters, task.group, sigma_mm, start)
    found = solve_in_two_steps(readings, reject=options.reject)
    residual = task.problem.residuals(found.solution.state)
    fit = RobustFit(task.problem, task.group, found.solution, found.accepted, residual)
    result = _result(task, fit, sigma_mm, noise, None)
    reasons = {item.row: item for item in found.rejected}
    return replace(
        result,
        rejected=tuple(reasons.get(item.row, item) for item in result.rejected),
        method="two-step",
        steps=found.summary,
        positions=found.located.deviations,
    )


def _fit(
    task: _Task, start: State, readings: Readings, factor: Factor, options: IdentifyOptions, *, disturbed: bool
) -> RobustFit[AnyProblem]:
    """Adjust with rejection and beam breaks, or with all readings as they are."""
    if not options.reject:
        solution = solve(task.problem, start, factor)
        accepted = np.ones(len(readings.group), dtype=bool)
        return RobustFit(task.problem, task.group, solution, accepted, task.problem.residuals(solution.state))

    def rebuilt(group: IntArray) -> AnyProblem:
        problem = _problem(task.machine, task.lengths, task.problem.parameters, group).weighted(readings.weight)
        return task.problem.rebuilt(problem) if isinstance(task.problem, HeldStations) else problem

    return fit_robustly(task.problem, start, readings, factor, rebuilt, disturbed=disturbed)


def _weakness(task: _Task, factor: Factor) -> str:
    """Say which combinations are hardly determined, where that may be why nothing converged."""
    rank = analyse_rank(task.problem, factor.matrix, task.lengths.stations, task.station, task.group, HARDLY_DETERMINED)
    if rank.rank == rank.size:
        return ""
    return (
        f"; hardly determined even at the start: {'; '.join(rank.combinations[:3])}; stations must not stand on a line, "
        "nor in a plane with an end of the travel"
    )


def _check_readings(machine: Machine, lengths: Lengths, least: int) -> None:
    if len(lengths.stations) < least:
        raise InputError(
            f"holds readings of {len(lengths.stations)} station(s) ({', '.join(lengths.stations)}); identification "
            f"needs at least {least}: with fewer unknown stations a function-valued ambiguity is left. Add the "
            "missing station, measure with the same tracer from further places, or give known stations",
            file=lengths.origin[0][0] if lengths.origin else None,
        )
    check_travel(machine, lengths.position_mm, lengths.origin)


def _task(machine: Machine, lengths: Lengths) -> _Task:
    tool_mm = common_tool(machine, lengths.tool_mm)
    layout = parameters_for_tools(machine, tool_mm)
    group = _groups(lengths)
    problem = _problem(machine, lengths, layout, group)
    return _Task(machine, lengths, problem, lengths.station, group)


def _problem(
    machine: Machine, lengths: Lengths, layout: ErrorParameters, group: IntArray
) -> GridProblem | LengthProblem:
    tool_mm = common_tool(machine, lengths.tool_mm)
    on_grid = grid_problem(layout, lengths.position_mm, tool_mm, lengths.station, group, lengths.length_mm)
    return on_grid or length_problem(machine, lengths, layout, group)


def _groups(lengths: Lengths) -> IntArray:
    """Index of the dead length of every reading: one for every station and set-up."""
    setup = lengths.labels.get("setup")
    if setup is None or not np.any(setup != setup[0]):
        return lengths.station
    _, group = np.unique(np.column_stack([lengths.station, setup]), axis=0, return_inverse=True)
    return group.ravel().astype(np.int64)


def _start(task: _Task) -> tuple[State, list[int]]:
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


def _start_by_search(task: _Task, station: int) -> StationStart:
    rows = task.station == station
    own, member = np.unique(task.group[rows], return_inverse=True)
    member = member.ravel().astype(np.int64)
    return station_start(task.target_mm[rows], task.lengths.length_mm[rows], member, len(own))


def _determined(task: _Task, start: State) -> tuple[Factor, Rank | None]:
    """Return the factor of the normal matrix at the start; UndeterminedError if it is singular.

    The detailed look at the rank is taken only where the condition gives reason.
    """
    matrix = task.problem.normal_matrix(start)
    try:
        factor = factorise(matrix)
        if factor.rcond > SUSPICIOUS_RCOND:
            return factor, None
    except LinAlgError:
        pass
    rank = analyse_rank(task.problem, matrix, task.lengths.stations, task.station, task.group)
    if rank.rank < rank.size:
        raise UndeterminedError(
            f"the readings determine {rank.rank} of {rank.size} unknowns; " + "; ".join(rank.combinations[:8]),
            list(rank.combinations),
        )
    return factorise(matrix), rank


def _unmirrored(task: _Task, start: State, searched: Sequence[int]) -> State:
    """Choose the side for stations whose targets all lie in a plane: its mirror image explains the readings as well.

    Only the machine's errors, seen from the other stations, tell the two apart; so both are tried.
    """
    for k in searched:
        targets = task.target_mm[task.station == k]
        centre = targets.mean(axis=0)
        _, spread, directions = np.linalg.svd(np.cov((targets - centre).T))
        if spread[2] > 1e-6 * spread[0]:
            continue
        across = directions[2]
        mirrored = start.stations_mm.copy()
        mirrored[k] -= 2.0 * across * float(across @ (mirrored[k] - centre))
        other = State(start.errors, mirrored, start.dead_length_mm)
        if _cost_from(task.problem, other) < _cost_from(task.problem, start):
            start = other
    return start


def _cost_from(problem: AnyProblem, start: State) -> float:
    try:
        return solve(problem, start).cost
    except ConvergenceError:
        return np.inf


def _result(
    task: _Task,
    fit: RobustFit[AnyProblem],
    sigma_mm: FloatArray,
    noise: ReadingNoise,
    rank: Rank | None,
) -> Identification:
    problem, layout = task.problem, task.problem.parameters
    solution, accepted, residual = fit.solution, fit.accepted, fit.residual_mm
    held = problem if isinstance(problem, HeldStations) else None
    freedom = int(np.count_nonzero(accepted)) - problem.size + (held.observations if held else 0)
    if freedom < 1:
        raise UndeterminedError(f"{np.count_nonzero(accepted)} readings for {problem.size} unknowns", [])
    used = residual if accepted.all() else residual[accepted]
    square_sum = float(np.sum((used / (sigma_mm if accepted.all() else sigma_mm[accepted])) ** 2))
    square_sum += held.square_sum(solution.state) / float(sigma_mm.min()) ** 2 if held else 0.0
    chi_square = square_sum / freedom
    u_scale = float(np.sqrt(chi_square)) if noise.source == "assumed" else max(1.0, float(np.sqrt(chi_square)))
    covariance = inverse(solution.factor) * (float(sigma_mm.min()) * u_scale) ** 2
    errors = error_table(layout, solution.state.errors, covariance[: layout.size, : layout.size])
    errors = errors.replace(metadata=metadata_of(task.machine, task.lengths.metadata))
    rejected = np.flatnonzero(~accepted)
    return Identification(
        errors=errors,
        stations=_stations(task, solution.state, covariance, residual, accepted),
        residual_mm=residual,
        accepted=accepted,
        rms_um=float(np.sqrt(np.mean(used**2))) / MM_PER_UM,
        degrees_of_freedom=freedom,
        reduced_chi_square=chi_square,
        u_source=noise.source,
        u_length_um=noise.constant_um,
        u_length_um_per_m=noise.proportional_um_per_m,
        u_scale=u_scale,
        unobservable=unobservable(layout),
        rejected=explain_rejected(
            task.lengths, layout, solution.state, task.group, rejected, residual, sigma_mm, fit.segments
        ),
        segments=fit.segments,
        rank=problem.size if rank is None else problem.size - (rank.size - rank.rank),
        unknowns=problem.size,
        condition=1.0 / solution.factor.rcond,
        iterations=solution.iterations,
        worst_u=worst_uncertainty(errors),
        covariance=covariance[: layout.size, : layout.size],
        layout=layout,
        adjustment=Adjustment(
            state=solution.state,
            factor=solution.factor,
            weight=(float(sigma_mm.min()) / sigma_mm) ** 2 * accepted,
            group=task.group,
            sigma_mm=float(sigma_mm.min()) * u_scale,
            held_weight=held.held_weight if held else None,
        ),
    )


def _stations(
    task: _Task, state: State, covariance: FloatArray, residual: FloatArray, accepted: NDArray[np.bool_]
) -> tuple[StationResult, ...]:
    u = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    first = task.problem.parameters.size
    second = first + state.stations_mm.size
    groups = len(state.dead_length_mm)
    used = np.bincount(task.group, accepted, groups)
    squares = np.bincount(task.group, residual**2 * accepted, groups)
    setups = task.lengths.labels.get("setup", np.zeros(len(task.lengths), dtype=np.int64))
    row_of = np.zeros(groups, dtype=np.int64)
    row_of[task.group] = np.arange(len(task.group))
    results: list[StationResult] = []
    for group in range(groups):
        k = int(task.station[row_of[group]])
        x, y, z = state.stations_mm[k].tolist()
        u_x, u_y, u_z = u[first + 3 * k : first + 3 * k + 3].tolist()
        results.append(
            StationResult(
                station=task.lengths.stations[k],
                setup=int(setups[row_of[group]]),
                position_mm=(x, y, z),
                u_position_mm=(u_x, u_y, u_z),
                dead_length_mm=float(state.dead_length_mm[group]),
                u_dead_length_mm=float(u[second + group]),
                readings=int(used[group]),
                rms_um=float(np.sqrt(squares[group] / max(used[group], 1.0))) / MM_PER_UM,
                segment=sum((r.station, r.setup) == (task.lengths.stations[k], setups[row_of[group]]) for r in results),
            )
        )
    return tuple(results)
