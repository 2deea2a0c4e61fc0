"""Statistical test of the positioning of one axis after VDI/DGQ 3441.

With U_i = |m_i(u) - m_i(d)|, s_i the mean of both estimators, P_s,i = 6 s_i and m_i the mean of both directions:

    P_a = max m_i - min m_i,   P = max [m_i + (U_i + P_s,i) / 2] - min [m_i - (U_i + P_s,i) / 2]
"""

from __future__ import annotations

import numpy as np

from compgen.accuracy.budget import NO_BUDGET, Budget
from compgen.accuracy.figure import Figure
from compgen.accuracy.runs import MEAN_DOWN, MEAN_UP, Combination, RunStatistics, combine, figure, largest, spread
from compgen.errors import InputError


def vdi_3441(statistics: RunStatistics, budget: Budget = NO_BUDGET) -> dict[str, Figure]:
    """Return ``P``, ``P_a``, ``P_s_max``, ``P_s_mean``, ``U_max``, ``U_mean`` in um.

    Raises
    ------
    InputError
        if a direction is missing or nothing was repeated: the guideline knows no such test.
    """
    if not (statistics.bidirectional and statistics.repeated):
        raise InputError("VDI/DGQ 3441 needs both directions, each repeated at every target")
    count = len(statistics.position_mm)
    signs = np.sign(statistics.values[MEAN_UP] - statistics.values[MEAN_DOWN]).tolist()
    middle = [[(0.5, MEAN_UP, i), (0.5, MEAN_DOWN, i)] for i in range(count)]
    reversal = [[(signs[i], MEAN_UP, i), (-signs[i], MEAN_DOWN, i)] for i in range(count)]
    scatter = [[(3.0, 2, i), (3.0, 3, i)] for i in range(count)]

    def edge(side: float) -> list[Combination]:
        half = [[(0.5 * side * f, row, k) for f, row, k in reversal[i] + scatter[i]] for i in range(count)]
        return [combine(statistics, middle[i] + half[i]) for i in range(count)]

    def mean(parts: list[list[tuple[float, int, int]]]) -> Combination:
        return combine(statistics, [(factor / count, row, i) for part in parts for factor, row, i in part])

    found = {
        "P": (spread(edge(1.0), edge(-1.0)), "positional uncertainty"),
        "P_a": (spread([combine(statistics, part) for part in middle]), "positional deviation"),
        "P_s_max": (largest([combine(statistics, part) for part in scatter]), "largest positional scatter"),
        "P_s_mean": (mean(scatter), "mean positional scatter"),
        "U_max": (largest([combine(statistics, part) for part in reversal]), "largest reversal"),
        "U_mean": (mean(reversal), "mean reversal"),
    }
    return {key: figure(statistics, item, f"{text}, VDI/DGQ 3441", budget) for key, (item, text) in found.items()}
