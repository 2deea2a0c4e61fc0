"""Adjustment in spite of gross errors: iteratively reweighted least squares, beam breaks, then plain least squares.

Weights of Huber (1964), which have one optimum, lead to those of Tukey (Beaton & Tukey 1974), which leave gross errors
without any weight. What then lies beyond the robust limit is rejected and all other readings count fully.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.errors import ConvergenceError
from compgen.identify.outliers import LIMIT, accepted_readings, standardised_spread
from compgen.identify.segments import Segment, kept_segments, rejected_runs, split_at_breaks
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
#: Rounds in which beam breaks may come to light.
BREAK_ROUNDS = 3
#: At the start, before the errors of the machine are known, a reading this many deviations off counts nothing.
FAR_AT_START = 10.0

P = TypeVar("P", bound=Problem)


@dataclass(frozen=True)
class Readings:
    """What the robust adjustment needs of n readings: dead length, weight and standard uncertainty of each, (n,)."""

    lengths: Lengths
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
    group = readings.group
    solution = _first(problem, start, readings, factor, disturbed=disturbed)
    residual = problem.residuals(solution.state)
    if not disturbed and (accepted := accepted_readings(residual / readings.sigma_mm)).all():
        return RobustFit(problem, group, solution, accepted, residual)
    for _ in range(BREAK_ROUNDS):
        solution = _reweighted(problem, solution, readings)
        split = split_at_breaks(readings.lengths, group, problem.residuals(solution.state))
        if split is None:
            break
        group, offset_mm = split
        problem = rebuild(group)
        solution = replace(solution, state=_with_dead_lengths(solution.state, readings.group, group, offset_mm))
    fit = _rejected(problem, group, solution, readings)
    return replace(fit, segments=_segments(fit, readings))


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
        centred = residual[own] - np.median(residual[own])
        near[own] = np.abs(centred) <= FAR_AT_START * max(1.4826 * float(np.median(np.abs(centred))), 1e-6)
    return solve(problem.weighted(readings.weight * near), start)


def _reweighted(problem: Problem, solution: Solution, readings: Readings) -> Solution:
    """Iteratively reweighted least squares: Huber's weights first, then Tukey's until the same readings count."""
    kept: NDArray[np.bool_] | None = None
    for step in range(HUBER_STEPS + TUKEY_STEPS):
        standardised = _standardised(problem, solution, readings)
        size = np.abs(standardised) / standardised_spread(standardised)
        if step < HUBER_STEPS:
            weight = np.minimum(1.0, HUBER / np.maximum(size, HUBER))
        else:
            weight = np.clip(1.0 - (size / LIMIT) ** 2, 0.0, None) ** 2
            if kept is not None and np.array_equal(kept, weight > 0):
                break
            kept = weight > 0
            _check_share(kept, readings)
        solution = solve(problem.weighted(readings.weight * weight), solution.state)
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
        solution = solve(problem.weighted(readings.weight * accepted), solution.state)
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


def _check_share(keep: NDArray[np.bool_], readings: Readings) -> None:
    lengths = readings.lengths
    total = np.bincount(lengths.station, minlength=len(lengths.stations))
    out = np.bincount(lengths.station, ~keep, minlength=len(lengths.stations)) / np.maximum(total, 1)
    share = 1.0 - np.count_nonzero(keep) / len(keep)
    if share <= MOST_REJECTED and out.max() <= MOST_REJECTED_OF_STATION:
        return
    worst = int(np.argmax(out))
    listed = ", ".join(f"{name} {100 * part:.0f} %" for name, part in zip(lengths.stations, out, strict=True))
    if np.count_nonzero(out > MOST_REJECTED) > len(out) / 2:
        advice = "most stations are concerned: check chain, travel and errors of the machine file, the axis order and "
        advice += "the units before anything is rejected"
    else:
        advice = f"check station {lengths.stations[worst]!r}: its label, its unit, and whether readings of another "
        advice += "station stand under its name"
    raise ConvergenceError(
        f"{np.count_nonzero(~keep)} of {len(keep)} readings do not fit the model; the most suspicious station is "
        f"{lengths.stations[worst]!r} ({listed} rejected); {advice}"
    )
