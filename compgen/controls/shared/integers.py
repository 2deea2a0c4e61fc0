"""The best whole numbers for a table: dynamic programming over the cumulative curve.

A table of counts A_k at nodes x_k acts as the polyline through them. Let v (in counts) be the projection of the
requested curve onto polylines with these nodes. It is orthogonal, so every table deviates by what the
projection misses plus

    J(A) = integral of w (polyline of A - v)^2 = sum over sections d^T G d,   d = A - v at both ends of a section,

so J alone decides. We look for whole numbers with A = 0 at the reference node and steps of at most ``limit``.

**Bound.** If no step of v exceeds the limit, neither does any step of the rounded v, because floor(a + m + 1/2) =
floor(a + 1/2) + m for whole m and rounding is monotone. So there are tables within half a count at every node and
hence, as polylines, everywhere; the one with the smallest J is taken. Where the limit is active on one side of the
reference node, there is none, and J alone is minimised on that side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import hat_entries
from compgen.data.machine import Machine

IntArray = NDArray[np.int64]

#: Largest rounding deviation at a node, in counts.
HALF = 0.5
#: Rounding noise of numbers in counts.
NOISE = 1e-9
#: Weight beyond the travel, so that nodes there continue the curve.
BEYOND = 1e-6


@dataclass(frozen=True)
class IntegerCurve:
    """Whole numbers at the nodes of a table, and how well they fit.

    Parameters
    ----------
    counts : cumulative curve A, shape (n,), zero at the reference node.
    rms, largest : deviation of the polyline from the requested one, in counts: weighted over the axis, and maximum.
    limited : whether the step limit prevents the table from staying within half a count.
    full_sections : with ``limited``, the sections (0 is the first) whose step equals the limit.
    """

    counts: IntArray
    rms: float
    largest: float
    limited: bool
    full_sections: tuple[int, ...] = ()


def section_weights(
    nodes_mm: FloatArray,
    range_mm: tuple[float, float],
    zone_mm: tuple[float, float] | None = None,
    zone_weight: float = 1.0,
) -> FloatArray:
    """Return G of every section as (n-1, 3): the integrals of h0^2, h0 h1, h1^2 with the two hat functions h, in mm.

    The weight is 1 within ``range_mm``, ``zone_weight`` in the zone, and nearly 0 beyond the range.
    """
    zone = () if zone_mm is None else zone_mm
    cuts = np.unique(np.clip([*nodes_mm, *range_mm, *zone], nodes_mm[0], nodes_mm[-1]))
    middle, half = 0.5 * (cuts[1:] + cuts[:-1]), 0.5 * np.diff(cuts)
    weight = np.where((middle > range_mm[0]) & (middle < range_mm[1]), 1.0, BEYOND)
    if zone_mm is not None:
        weight = np.where((middle > zone_mm[0]) & (middle < zone_mm[1]), weight * zone_weight, weight)
    result = np.zeros((len(nodes_mm) - 1, 3))
    for point in (-1.0 / np.sqrt(3.0), 1.0 / np.sqrt(3.0)):  # Gauss: exact for products of two lines
        left, share = hat_entries(nodes_mm, middle + half * point)
        products = np.column_stack([(1.0 - share) ** 2, (1.0 - share) * share, share**2])
        np.add.at(result, left, (weight * half)[:, None] * products)
    return result


def travel_weights(machine: Machine, axis: int, nodes_mm: FloatArray) -> FloatArray:
    """Return :func:`section_weights` for the travel of an axis and the work zone of the machine."""
    emphasis = machine.emphasis
    return section_weights(nodes_mm, machine.axes[axis].range_mm, emphasis.zone_mm[axis], emphasis.zone_weight)


def best_integers(requested: FloatArray, sections: FloatArray, reference: int, limit: int | None) -> IntegerCurve:
    """Return the whole numbers closest to a polyline, exact by dynamic programming.

    Parameters
    ----------
    requested : values v (n,) of the polyline at the nodes in counts, zero at the reference node.
    sections : G of the sections, shape (n-1, 3), from :func:`section_weights`.
    reference : index of the node where the table is zero.
    limit : largest step between neighbouring nodes in counts, or None.
    """
    counts = np.zeros(len(requested), dtype=np.int64)
    right, limited_right = _side(requested[reference:], sections[reference:], limit)
    left, limited_left = _side(requested[reference::-1], sections[:reference][::-1, ::-1], limit)
    counts[reference:], counts[reference::-1] = right, left
    limited = limited_left or limited_right
    steps = np.abs(np.diff(counts))
    total = float(np.sum(sections @ np.array([1.0, 2.0, 1.0])))
    return IntegerCurve(
        counts=counts,
        rms=float(np.sqrt(_square(counts - requested, sections) / total)) if total else 0.0,
        largest=float(np.max(np.abs(counts - requested))),
        limited=limited,
        full_sections=tuple(np.flatnonzero(steps == limit).tolist()) if limited else (),
    )


def _side(requested: FloatArray, sections: FloatArray, limit: int | None) -> tuple[IntArray, bool]:
    """Return the best counts (n,) from the reference node (first, count 0) outwards, and if the limit is active."""
    low = np.ceil(requested - HALF - NOISE).astype(np.int64)
    high = np.floor(requested + HALF + NOISE).astype(np.int64)
    low[0] = high[0] = 0
    found = _cheapest(requested, sections, low, high, limit)
    if found is not None or limit is None:
        assert found is not None  # without a limit every whole number can be reached
        return found, False
    # Windows that provably hold the best counts: with the real-valued curve u that a solver finds within the limit, and
    # any table A at least as good as the rounded one R, convexity gives (A-u)^T M (A-u) <= J(R) - J(u) + gap, with gap
    # the most that the gradient at u could still gain over all curves within the limit. Both sections of a node add
    # at least their smallest eigenvalue to M.
    curve, gap = _reachable(requested, sections, limit)
    rounded = np.floor(curve + 0.5).astype(np.int64)
    rounded[0] = 0
    for k in range(1, len(rounded)):  # no step larger than the limit
        rounded[k] = np.clip(rounded[k], rounded[k - 1] - limit, rounded[k - 1] + limit)
    room = max(_square(rounded - requested, sections) - _square(curve - requested, sections) + gap, 0.0)
    mean, half = 0.5 * (sections[:, 0] + sections[:, 2]), 0.5 * (sections[:, 0] - sections[:, 2])
    least = np.maximum(mean - np.hypot(half, sections[:, 1]), 0.0)
    stiffness = np.concatenate([[0.0], least]) + np.concatenate([least, [0.0]])
    radius = np.sqrt(room * (1.0 + NOISE) / np.maximum(stiffness, 1e-300)) + 1.0
    low, high = np.empty(len(requested), dtype=np.int64), np.empty(len(requested), dtype=np.int64)
    low[0] = high[0] = 0
    for k in range(1, len(requested)):
        low[k] = max(np.ceil(max(curve[k] - radius[k], -1e15)), low[k - 1] - limit)
        high[k] = min(np.floor(min(curve[k] + radius[k], 1e15)), high[k - 1] + limit)
    best = _cheapest(requested, sections, low, high, limit)
    assert best is not None  # the windows contain the rounded curve from which they were made
    return best, True


def _square(deviation: FloatArray, sections: FloatArray) -> float:
    """J of deviations (n,) at the nodes."""
    first, last = deviation[:-1], deviation[1:]
    parts = sections[:, 0] * first**2 + 2.0 * sections[:, 1] * first * last + sections[:, 2] * last**2
    return float(np.sum(parts))


def _cheapest(
    requested: FloatArray, sections: FloatArray, low: IntArray, high: IntArray, limit: int | None
) -> IntArray | None:
    """Return the counts within ``low`` ... ``high`` (n,) with the smallest J, or None if the limit allows none."""
    cost, choices = np.zeros(high[0] - low[0] + 1), []
    for k in range(1, len(requested)):
        reach = limit if limit is not None else int(max(high[k] - low[k - 1], high[k - 1] - low[k], 0))
        states = np.arange(low[k], high[k] + 1)
        before = states[:, None] + np.arange(-reach, reach + 1)
        index = before - low[k - 1]
        inside = (index >= 0) & (index < len(cost))
        first, last = before - requested[k - 1], (states - requested[k])[:, None]
        g0, g1, g2 = sections[k - 1]
        total = np.where(inside, cost[np.clip(index, 0, len(cost) - 1)], np.inf)
        total = total + g0 * first**2 + 2.0 * g1 * first * last + g2 * last**2
        choice = np.argmin(total, axis=1) if len(states) else np.zeros(0, dtype=np.int64)
        cost = total[np.arange(len(states)), choice]
        if not np.any(np.isfinite(cost)):
            return None
        choices.append(before[np.arange(len(states)), choice])
    counts = np.empty(len(requested), dtype=np.int64)
    counts[-1] = low[-1] + int(np.argmin(cost))
    for k in range(len(requested) - 1, 0, -1):
        counts[k - 1] = choices[k - 1][counts[k] - low[k]]
    return counts


def _reachable(requested: FloatArray, sections: FloatArray, limit: int) -> tuple[FloatArray, float]:
    """Return a real-valued curve (n,) of small J with steps within the limit, and a bound on the remaining gain."""
    import osqp  # imported here: slow to load, and only steep curves need it
    from scipy.sparse import csc_matrix, dia_matrix

    count = len(requested) - 1
    scale = 1.0 / float(np.max(sections))
    both, cross = sections[:, 2] + np.append(sections[1:, 0], 0.0), sections[1:, 1]
    bands = scale * np.array([np.append(cross, 0.0), both, np.append(0.0, cross)])
    matrix = csc_matrix(dia_matrix((bands, [-1, 0, 1]), shape=(count, count)))
    upper = csc_matrix(dia_matrix((bands[1:], [0, 1]), shape=(count, count)))
    difference = csc_matrix(dia_matrix((np.array([np.ones(count), -np.ones(count)]), [0, -1]), shape=(count, count)))
    bounds = np.full(count, float(limit))
    solver = osqp.OSQP()
    options = {"verbose": False, "eps_abs": 1e-6, "eps_rel": 1e-9, "max_iter": 20_000, "polishing": True}
    solver.setup(upper, -matrix @ requested[1:], difference, -bounds, bounds, **options)
    found = np.asarray(solver.solve(raise_error=False).x, dtype=np.float64)
    steps = np.clip(np.diff(np.nan_to_num(found), prepend=0.0), -limit, limit)
    gradient = 2.0 * np.cumsum((matrix @ (np.cumsum(steps) - requested[1:]))[::-1])[::-1] / scale
    gap = float(np.sum(np.abs(gradient) * limit + gradient * steps))
    return np.concatenate([[0.0], np.cumsum(steps)]), max(gap, 0.0)


def lowest_free(taken: Sequence[tuple[int, int]], start: int, count: int) -> int:
    """Return the lowest first number, from ``start`` on, of ``count`` numbers that overlap no used block.

    >>> lowest_free([(5, 9), (12, 12)], 1, 4), lowest_free([(5, 9), (12, 12)], 1, 5)
    (1, 13)
    """
    first = start
    for low, high in sorted(taken):
        if low < first + count and high >= first:
            first = high + 1
    return first
