"""Statistics of positioning runs at each target, and figures as combinations of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from compgen.accuracy.budget import NO_BUDGET, Budget
from compgen.accuracy.figure import Figure
from compgen.core.axis_runs import AxisRuns
from compgen.core.csvio import FloatArray
from compgen.core.names import AXES, MM_PER_UM
from compgen.errors import InputError

#: Targets closer than this are the same one, mm.
SAME_TARGET_MM = 1e-4
#: Rows of the statistics: means of positive and negative approach, then the estimators of both.
MEAN_UP, MEAN_DOWN, S_UP, S_DOWN = range(4)


@dataclass(frozen=True)
class RunStatistics:
    """Means and standard deviations (n - 1) of the deviations at m targets, mm.

    Parameters
    ----------
    position_mm : targets, ascending, (m,).
    values : shape (4, m): mean of positive, of negative approach, estimator s of positive, of negative approach; nan for
        a direction without readings, and for s of a single reading.
    count : readings of positive and negative approach, (2, m).
    """

    position_mm: FloatArray
    values: FloatArray
    count: FloatArray

    @property
    def directions(self) -> tuple[int, ...]:
        """Directions that were measured: rows 0 (positive), 1 (negative) of the means."""
        return tuple(row for row in (MEAN_UP, MEAN_DOWN) if not np.isnan(self.values[row]).any())

    @property
    def bidirectional(self) -> bool:
        """Whether both directions were measured."""
        return len(self.directions) == 2

    @property
    def repeated(self) -> bool:
        """Whether every target has at least two readings in each measured direction, so that s is known."""
        return all(bool(np.all(self.count[row] > 1)) for row in self.directions)


def run_statistics(position_mm: FloatArray, direction: FloatArray, deviation_mm: FloatArray) -> RunStatistics:
    """Return the statistics of readings (n,) at targets (n,) that were reached in directions (n,), +1 or -1.

    Raises
    ------
    InputError
        if a direction was measured at some of the targets only, or there are fewer than two targets.
    """
    position, target = _targets(np.asarray(position_mm, dtype=np.float64))
    values, count = np.full((4, len(position)), np.nan), np.zeros((2, len(position)))
    for row, sign in enumerate((1, -1)):
        for k in range(len(position)):
            here = deviation_mm[(target == k) & (np.sign(direction) == sign)]
            count[row, k] = len(here)
            if len(here):
                values[row, k] = here.mean()
            if len(here) > 1:
                values[2 + row, k] = here.std(ddof=1)
        if 0 < np.count_nonzero(count[row]) < len(position):
            missing = position[np.flatnonzero(count[row] == 0)[0]]
            raise InputError(f"no reading at {missing:g} mm in direction {sign:+d}; every target needs both directions")
    if len(position) < 2:
        raise InputError("a positioning test has at least two targets")
    return RunStatistics(position, values, count)


def _targets(position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Targets (m,), and the number of the target of each reading (n,)."""
    order = np.argsort(position_mm, kind="stable")
    new = np.concatenate([[False], np.diff(position_mm[order]) > SAME_TARGET_MM])
    number = np.empty(len(order))
    number[order] = np.cumsum(new)
    first = order[np.concatenate([[0], np.flatnonzero(new)])]
    return position_mm[first], number


def axis_statistics(runs: AxisRuns) -> dict[str, RunStatistics]:
    """Return the statistics of every measured axis by its letter; InputError names the axis."""
    found = {}
    for axis in runs.axes:
        own = runs.axis == axis
        try:
            found[AXES[axis]] = run_statistics(runs.position_mm[own], runs.direction[own], runs.deviation_mm[own])
        except InputError as error:
            file = runs.origin[int(np.flatnonzero(own)[0])][0] if runs.origin else None
            raise InputError(f"{AXES[axis]}: {error.message}", file=file) from None
    return found


@dataclass(frozen=True)
class Combination:
    """A figure as sum(weight * statistics.values): its value, and its derivative by every mean and s, shape (4, m)."""

    value: float
    weight: FloatArray


def combine(statistics: RunStatistics, parts: Sequence[tuple[float, int, int]]) -> Combination:
    """Return sum of factor * values[row, target] over ``parts`` of (factor, row, target)."""
    weight = np.zeros(statistics.values.shape)
    value = 0.0
    for factor, row, target in parts:
        if factor:
            weight[row, target] += factor
            value += factor * float(statistics.values[row, target])
    return Combination(value, weight)


def largest(candidates: Sequence[Combination]) -> Combination:
    """Return the combination with the largest value."""
    return max(candidates, key=lambda item: item.value)


def minus(first: Combination, second: Combination) -> Combination:
    """Return first - second."""
    return Combination(first.value - second.value, first.weight - second.weight)


def spread(candidates: Sequence[Combination], lower: Sequence[Combination] | None = None) -> Combination:
    """Return the largest of the candidates minus the smallest of ``lower`` (default the same ones)."""
    return minus(largest(candidates), min(lower or candidates, key=lambda item: item.value))


def figure(statistics: RunStatistics, item: Combination, meaning: str, budget: Budget = NO_BUDGET) -> Figure:
    """Return a combination in um with its standard uncertainty.

    The scatter gives s^2 / n for a mean and s^2 (1 - c4^2) for an estimator s (normal readings); the rest is the
    budget's. A single reading has no scatter of its own: u is nan then.
    """
    counts, scatter = statistics.count, statistics.values[2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        variances = np.concatenate([scatter**2 / counts, scatter**2 * _estimator_variance(counts)])
    used = item.weight != 0.0
    repeatability = math.sqrt(float(np.sum(item.weight[used] ** 2 * variances[used])))
    parts = {"repeatability": repeatability / MM_PER_UM}
    for name, u_mm in budget.contributions(statistics.position_mm, item.weight[:2]):
        parts[name] = u_mm / MM_PER_UM
    u = math.sqrt(sum(value**2 for value in parts.values()))
    return Figure(item.value / MM_PER_UM, u, "um", meaning, parts)


def _estimator_variance(count: FloatArray) -> FloatArray:
    """Variance of s over sigma^2 for n normal readings: 1 - c4(n)^2, c4^2 = 2 / (n - 1) (G(n/2) / G((n-1)/2))^2."""
    n = np.maximum(count, 2.0)
    c4_square = 2.0 / (n - 1.0) * np.exp(2.0 * (gammaln(0.5 * n) - gammaln(0.5 * (n - 1.0))))
    return np.asarray(np.where(count > 1, 1.0 - c4_square, np.nan))
