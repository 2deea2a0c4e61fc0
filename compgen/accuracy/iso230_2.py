"""Positioning accuracy and repeatability of one axis after ISO 230-2.

With x_ij(u), x_ij(d) the deviations of run j at target i in positive and negative approach, m(u), m(d) their means, s(u),
s(d) their estimators (n - 1), k the coverage factor of the edition:

    B_i = m_i(u) - m_i(d),  B = max |B_i|,  mean reversal = mean of B_i,  M = max - min of (m_i(u) + m_i(d)) / 2
    R_i(u) = 2 k s_i(u),    R_i = max{ k s_i(u) + k s_i(d) + |B_i|; R_i(u); R_i(d) },  R = max R_i
    E(u) = max - min of m_i(u),  E = max - min of the means of both directions together
    A(u) = max [m_i(u) + k s_i(u)] - min [m_i(u) - k s_i(u)],  A = the same over both directions together

k is 2 since the edition of 1997 and was 3 in that of 1988. The edition of 2014 says "error" where the earlier ones say
"deviation" or "value"; the formulas did not change. Two slips of public programs give other numbers: R as the larger of
R(u) and R(d), and E as the larger or smaller of E(u) and E(d).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.accuracy.budget import NO_BUDGET, Budget
from compgen.accuracy.figure import Figure
from compgen.accuracy.runs import (
    MEAN_DOWN,
    MEAN_UP,
    Combination,
    RunStatistics,
    combine,
    figure,
    largest,
    spread,
)
from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.errors import InputError

#: Coverage factor by edition.
EDITIONS = {1988: 3.0, 1997: 2.0, 2006: 2.0, 2014: 2.0}
LATEST = 2014
_SIGNS = {MEAN_UP: "up", MEAN_DOWN: "down"}


@dataclass(frozen=True)
class PositioningTest:
    """Figures of one axis (um) by key, and the values at each target.

    Keys: ``B``, ``B_mean``, ``M``, ``R``, ``R_up``, ``R_down``, ``E``, ``E_up``, ``E_down``, ``A``, ``A_up``, ``A_down``
    as far as the runs show them: both directions for those without an ending, at least two runs for R and A.
    ``targets`` has the columns position_mm, mean_up_um, mean_down_um, s_up_um, s_down_um, B_um, mean_um, R_um, R_up_um,
    R_down_um, and from the scatter the standard uncertainties u_mean_up_um, u_mean_down_um, u_B_um (shared sources left
    out), each (m,), nan where unknown.
    """

    edition: int
    statistics: RunStatistics
    figures: dict[str, Figure]
    targets: dict[str, FloatArray]


def positioning_test(statistics: RunStatistics, edition: int = LATEST, budget: Budget = NO_BUDGET) -> PositioningTest:
    """Return all figures of ISO 230-2 for one axis.

    Parameters
    ----------
    statistics : means and estimators at the targets.
    edition : 1988, 1997, 2006 or 2014.
    budget : what the set-up adds to the uncertainties.
    """
    if edition not in EDITIONS:
        raise InputError(f"there is no edition {edition} of ISO 230-2 here; known are {', '.join(map(str, EDITIONS))}")
    k = EDITIONS[edition]
    found: dict[str, tuple[Combination, str]] = {}
    if statistics.bidirectional:
        found |= _reversal(statistics)
    for way in statistics.directions:
        found |= _one_way(statistics, way, k)
    if statistics.bidirectional:
        found |= _both_ways(statistics, k)
    figures = {
        key: figure(statistics, item, f"{meaning}, ISO 230-2:{edition}", budget)
        for key, (item, meaning) in found.items()
    }
    _check_identities(figures)
    return PositioningTest(edition, statistics, figures, _targets(statistics, k))


def _means(statistics: RunStatistics, ways: Sequence[int], k: float = 0.0) -> list[Combination]:
    """Every mean + k s of the given directions."""
    count = len(statistics.position_mm)
    return [combine(statistics, [(1.0, way, i), (k, 2 + way, i)]) for way in ways for i in range(count)]


def _reversal(statistics: RunStatistics) -> dict[str, tuple[Combination, str]]:
    gaps = statistics.values[MEAN_UP] - statistics.values[MEAN_DOWN]
    each = range(len(gaps))
    signed = [[(float(np.sign(gaps[i])), MEAN_UP, i), (-float(np.sign(gaps[i])), MEAN_DOWN, i)] for i in each]
    sizes = [combine(statistics, parts) for parts in signed]
    share = 1.0 / len(gaps)
    mean = combine(
        statistics, [(sign * share, way, i) for way, sign in ((MEAN_UP, 1.0), (MEAN_DOWN, -1.0)) for i in each]
    )
    middles = [combine(statistics, [(0.5, MEAN_UP, i), (0.5, MEAN_DOWN, i)]) for i in each]
    return {
        "B": (largest(sizes), "reversal error, largest"),
        "B_mean": (mean, "mean reversal error"),
        "M": (spread(middles), "mean bidirectional positioning error"),
    }


def _one_way(statistics: RunStatistics, way: int, k: float) -> dict[str, tuple[Combination, str]]:
    end, text = _SIGNS[way], f"unidirectional, {'positive' if way == MEAN_UP else 'negative'} approach"
    found = {f"E_{end}": (spread(_means(statistics, [way])), f"systematic positioning error, {text}")}
    if statistics.repeated:
        count = len(statistics.position_mm)
        widths = [combine(statistics, [(2.0 * k, 2 + way, i)]) for i in range(count)]
        accuracy = spread(_means(statistics, [way], k), _means(statistics, [way], -k))
        found[f"R_{end}"] = (largest(widths), f"positioning repeatability, {text}")
        found[f"A_{end}"] = (accuracy, f"positioning accuracy, {text}")
    return found


def _both_ways(statistics: RunStatistics, k: float) -> dict[str, tuple[Combination, str]]:
    ways = (MEAN_UP, MEAN_DOWN)
    found = {"E": (spread(_means(statistics, ways)), "systematic positioning error, bidirectional")}
    if statistics.repeated:
        count = len(statistics.position_mm)
        accuracy = spread(_means(statistics, ways, k), _means(statistics, ways, -k))
        repeatability = largest([_repeatability_at(statistics, i, k) for i in range(count)])
        found["R"] = (repeatability, "positioning repeatability, bidirectional")
        found["A"] = (accuracy, "positioning accuracy, bidirectional")
    return found


def _repeatability_at(statistics: RunStatistics, target: int, k: float) -> Combination:
    """R_i as the largest of its three candidates."""
    sign = float(np.sign(statistics.values[MEAN_UP, target] - statistics.values[MEAN_DOWN, target]))
    both = [(k, 2, target), (k, 3, target), (sign, MEAN_UP, target), (-sign, MEAN_DOWN, target)]
    single = [[(2.0 * k, 2, target)], [(2.0 * k, 3, target)]]
    return largest([combine(statistics, parts) for parts in (both, *single)])


def _targets(statistics: RunStatistics, k: float) -> dict[str, FloatArray]:
    up, down, s_up, s_down = statistics.values / MM_PER_UM
    with np.errstate(divide="ignore", invalid="ignore"):
        u_up, u_down = (s_up, s_down) / np.sqrt(statistics.count)
    wide = np.maximum(np.maximum(2.0 * k * s_up, 2.0 * k * s_down), k * (s_up + s_down) + np.abs(up - down))
    return {
        "position_mm": statistics.position_mm,
        "mean_up_um": up,
        "mean_down_um": down,
        "s_up_um": s_up,
        "s_down_um": s_down,
        "B_um": up - down,
        "mean_um": 0.5 * (up + down),
        "R_um": wide,
        "R_up_um": 2.0 * k * s_up,
        "R_down_um": 2.0 * k * s_down,
        "u_mean_up_um": u_up,
        "u_mean_down_um": u_down,
        "u_B_um": np.hypot(u_up, u_down),
    }


def _check_identities(figures: dict[str, Figure]) -> None:
    """What must hold between the figures whatever the readings are; a broken one is a bug, not bad input."""
    above = [("A", "E"), ("A", "A_up"), ("A", "A_down"), ("E", "E_up"), ("E", "E_down"), ("E", "M")]
    above += [("R", "R_up"), ("R", "R_down"), ("R", "B")]
    for large, small in above:
        if large in figures and small in figures:
            assert figures[large].value >= figures[small].value - 1e-9, f"{large} is below {small}"
    if "E" in figures:
        assert figures["E"].value <= figures["M"].value + figures["B"].value + 1e-9
