"""Adjustment in spite of gross errors: iteratively reweighted least squares, beam breaks, then plain least squares.

Weights of Huber (1964), which have one optimum, lead to those of Tukey (Beaton & Tukey 1974), which leave gross errors
without any weight. What then lies beyond the robust limit is rejected and all other readings count fully.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.errors import CompgenWarning, ConvergenceError
from compgen.identify.outliers import LIMIT, accepted_readings, standardised_spread
from compgen.identify.robust_start import robust_spread
from compgen.identify.segments import Segment, kept_segments, merged_groups, rejected_runs, split_at_breaks
from compgen.identify.solver import Factor, Solution, solve
from compgen.identify.state import IntArray, Problem, State

#: Huber's constant: 95 % efficiency for normal readings.
HUBER = 1.345
HUBER_STEPS = 5
TUKEY_STEPS = 15
HARD_STEPS = 20
#: Share of all readings, and of those of one station, that may be rejected.
MOST_REJECTED = 0.3
MOST_REJECTED_OF_STATION = 0.5
#: Shares from which a warning is given.
MANY_REJECTED = 0.1
MANY_REJECTED_OF_STATION = 0.25
#: A reading of less weight is named as one that does not fit when nothing converges.
SUSPICIOUS_WEIGHT = 0.2
#: Rounds in which beam breaks may come to light.
BREAK_ROUNDS = 6
#: At the start, before the errors of the machine are known, a reading this many deviations off counts nothing.
FAR_AT_START = 10.0

P = TypeVar("P", bound=Problem)


@dataclass(frozen=True)
class Readings:
    """What the robust adjustment needs of n readings.

    ``target_mm`` (n, 3) are the nominal targets; dead length, weight and standard uncertainty of each have shape (n,).
    """

    lengths: Lengths
    target_mm: FloatArray
    group: IntArray
    weight: FloatArray
    sigma_mm: FloatArray


@dataclass(frozen=True)
class RobustFit(Generic[P]):
    """The problem with the dead lengths that beam breaks added, its optimum, and what became of the readings.

    ``accepted`` (n,) marks those that were used, ``residual_mm`` (n,) is model minus reading of all.
    """

    problem: P
    group: IntArray
    solution: Solution
    accepted: NDArray[np.bool_]
    residual_mm: FloatArray
    segments: tuple[Segment, ...] = ()


def fit_robustly(
    problem: P,
    start: State,
    readings: Readings,
    factor: Factor | None,
    rebuild: Callable[[IntArray], P],
    *,
    disturbed: bool,
) -> RobustFit[P]:
    """Adjust, reject what does not belong, and give the readings behind a beam break a dead length of their own.

    Parameters
    ----------
    problem : all readings with their weights.
    start, factor : start values and the factor of the normal matrix there.
    rebuild : makes the problem, weighted, for another index of dead lengths (n,).
    disturbed : whether gross errors are known to be among the readings.

    Raises
    ------
    ConvergenceError
        if more than 30 % of the readings, or more than half of those of a station, do not fit.
    """
    solution = _first(problem, start, readings, factor, disturbed=disturbed)
    residual = problem.residuals(solution.state)
    if not disturbed and (accepted := accepted_readings(residual / readings.sigma_mm)).all():
        return RobustFit(problem, readings.group, solution, accepted, residual)
    problem, group, solution = _split(problem, solution, readings, rebuild)
    solution = _tukey(problem, solution, readings)
    problem, group, solution = _merged(problem, group, solution, readings, rebuild)
    fit = _rejected(problem, group, solution, readings)
    _warn_of_many(fit, readings)
    return replace(fit, segments=_segments(fit, readings))


def _split(
    problem: P, solution: Solution, readings: Readings, rebuild: Callable[[IntArray], P]
) -> tuple[P, IntArray, Solution]:
    """Reweighted adjustment in which beam breaks get dead lengths of their own until no more come to light."""
    group = readings.group
    for _ in range(BREAK_ROUNDS):
        solution = _huber(problem, solution, readings)
        state = solution.state
        sight = readings.target_mm - state.stations_mm[readings.lengths.station]
        sight = sight / np.linalg.norm(sight, axis=1)[:, None]
        split = split_at_breaks(readings.lengths, group, problem.residuals(state), sight)
        if split is None:
            break
        group, offset_mm = split
        problem = rebuild(group)
        solution = replace(solution, state=_with_dead_lengths(state, readings.group, group, offset_mm))
    return problem, group, solution


def _merged(
    problem: P, group: IntArray, solution: Solution, readings: Readings, rebuild: Callable[[IntArray], P]
) -> tuple[P, IntArray, Solution]:
    """Take dead lengths together that turn out to be the same."""
    spread = standardised_spread(_standardised(problem, solution, readings))
    dead = solution.state.dead_length_mm
    again = merged_groups(readings.group, group, dead, LIMIT * spread * float(np.median(readings.sigma_mm)))
    if again is None:
        return problem, group, solution
    kept = np.zeros(int(again.max()) + 1)
    kept[again[::-1]] = dead[group[::-1]]
    problem = rebuild(again)
    solution = replace(solution, state=replace(solution.state, dead_length_mm=kept))
    return problem, again, _tukey(problem, solution, readings)


def _standardised(problem: Problem, solution: Solution, readings: Readings) -> FloatArray:
    return np.asarray(problem.residuals(solution.state) / readings.sigma_mm)


def _first(problem: Problem, start: State, readings: Readings, factor: Factor | None, *, disturbed: bool) -> Solution:
    """Least squares from the start; readings that are far off there, where that is known, do not take part."""
    if not disturbed:
        return solve(problem, start, factor)
    residual = problem.residuals(start)
    near = np.ones(len(residual), dtype=bool)
    for k in range(int(readings.group.max()) + 1):
        own = readings.group == k
        near[own] = np.abs(residual[own]) <= FAR_AT_START * max(robust_spread(residual[own]), 1e-6)
    return _weighted(problem, start, readings, near)


def _huber(problem: Problem, solution: Solution, readings: Readings) -> Solution:
    """Iteratively reweighted least squares with Huber's weights."""
    for _ in range(HUBER_STEPS):
        standardised = _standardised(problem, solution, readings)
        size = np.abs(standardised) / standardised_spread(standardised)
        weight = HUBER / np.maximum(size, HUBER)
        solution = _weighted(problem, solution.state, readings, weight)
    return solution


def _tukey(problem: Problem, solution: Solution, readings: Readings) -> Solution:
    """Iteratively reweighted least squares with Tukey's weights, until the same readings count."""
    kept: NDArray[np.bool_] | None = None
    for _ in range(TUKEY_STEPS):
        standardised = _standardised(problem, solution, readings)
        weight = np.clip(1.0 - (standardised / (LIMIT * standardised_spread(standardised))) ** 2, 0.0, None) ** 2
        if kept is not None and np.array_equal(kept, weight > 0):
            break
        kept = weight > 0
        _check_share(kept, readings)
        solution = _weighted(problem, solution.state, readings, weight)
    return solution


def _rejected(problem: P, group: IntArray, solution: Solution, readings: Readings) -> RobustFit[P]:
    """Least squares of the readings within the limit, until the same ones are kept."""
    accepted: NDArray[np.bool_] | None = None
    for _ in range(HARD_STEPS):
        residual = problem.residuals(solution.state)
        keep = accepted_readings(residual / readings.sigma_mm)
        _check_share(keep, readings)
        if accepted is not None and np.array_equal(keep, accepted):
            break
        accepted = keep
        solution = _weighted(problem, solution.state, readings, accepted)
    assert accepted is not None
    return RobustFit(problem, group, solution, accepted, residual)


def _with_dead_lengths(state: State, first: IntArray, group: IntArray, offset_mm: FloatArray) -> State:
    """Add dead lengths for the groups that a break split off; ``offset_mm`` says how much their readings are off."""
    known = len(state.dead_length_mm)
    dead = np.concatenate([state.dead_length_mm, np.zeros(len(offset_mm) - known)])
    main = np.zeros(len(offset_mm), dtype=np.int64)
    main[group] = first
    dead[known:] = state.dead_length_mm[main[known:]] - offset_mm[known:]
    return replace(state, dead_length_mm=dead)


def _segments(fit: RobustFit[P], readings: Readings) -> tuple[Segment, ...]:
    spread = standardised_spread(fit.residual_mm / readings.sigma_mm) * readings.sigma_mm
    kept = kept_segments(readings.lengths, readings.group, fit.group, fit.solution.state.dead_length_mm)
    return kept + rejected_runs(readings.lengths, fit.group, fit.accepted, fit.residual_mm, spread)


def _weighted(problem: Problem, start: State, readings: Readings, weight: FloatArray | NDArray[np.bool_]) -> Solution:
    """Adjust with other weights; an error names the stations whose readings were left out."""
    try:
        return solve(problem.weighted(readings.weight * weight), start)
    except ConvergenceError as error:
        keep = np.asarray(weight > SUSPICIOUS_WEIGHT)
        if keep.all():
            raise
        raise ConvergenceError(f"{_suspicion(keep, readings)}; as for the rest, {error}") from error


def _suspicion(keep: NDArray[np.bool_], readings: Readings) -> str:
    out, names = _shares(keep, readings), readings.lengths.stations
    listed = ", ".join(f"{name} {100 * part:.0f} %" for name, part in zip(names, out, strict=True))
    return (
        f"{np.count_nonzero(~keep)} of {len(keep)} readings do not fit the model; the most suspicious station is "
        f"{names[int(np.argmax(out))]!r} ({listed} rejected)"
    )


def _shares(keep: NDArray[np.bool_], readings: Readings) -> FloatArray:
    """Share of the readings of each station that does not fit, (S,)."""
    station, count = readings.lengths.station, len(readings.lengths.stations)
    return np.asarray(np.bincount(station, ~keep, count) / np.maximum(np.bincount(station, minlength=count), 1))


def _check_share(keep: NDArray[np.bool_], readings: Readings) -> None:
    out = _shares(keep, readings)
    share = 1.0 - np.count_nonzero(keep) / len(keep)
    if share <= MOST_REJECTED and out.max() <= MOST_REJECTED_OF_STATION:
        return
    name = readings.lengths.stations[int(np.argmax(out))]
    if np.count_nonzero(out > MOST_REJECTED) > len(out) / 2:
        advice = "most stations are concerned: check chain, travel and errors of the machine file, the axis order and "
        advice += "the units before anything is rejected"
    else:
        advice = f"check station {name!r}: its label, its unit, and whether readings of another station stand under "
        advice += "its name"
    raise ConvergenceError(f"{_suspicion(keep, readings)}; {advice}")


def _warn_of_many(fit: RobustFit[P], readings: Readings) -> None:
    """Warn when so many readings were rejected that a mistake is more likely than disturbed readings."""
    out = _shares(fit.accepted, readings)
    if 1.0 - np.mean(fit.accepted) > MANY_REJECTED or out.max() > MANY_REJECTED_OF_STATION:
        warnings.warn(
            f"{_suspicion(fit.accepted, readings)}; they were left out, but so many point to a mistake in the "
            "readings, their labels or the machine file",
            CompgenWarning,
            stacklevel=5,
        )
