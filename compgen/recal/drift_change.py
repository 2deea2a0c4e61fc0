"""Change between two calibrations: of each error with the joint covariance of its values, and of the volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from compgen.core.csvio import FloatArray
from compgen.core.names import error_named
from compgen.recal.drift_data import Aligned

#: Directions of the covariance with less than this share of the largest standard uncertainty are rounding.
ROUNDING = 1e-7


@dataclass(frozen=True)
class ErrorChange:
    """Change of one error in the common gauge.

    ``largest`` is the change of the value that changed most (mm or rad, with its sign), ``u`` its standard uncertainty,
    ``p_value`` the probability of at least this change of the whole curve if there was none, ``adjusted`` the same when
    all errors that are looked at count (Holm 1979, Scandinavian Journal of Statistics 6).
    """

    error: str
    largest: float
    u: float
    p_value: float
    adjusted: float

    def summary(self) -> dict[str, Any]:
        """Return the figures in um or urad."""
        name = error_named(self.error)
        sizes = {"unit": name.unit, "largest": self.largest / name.si_per_unit, "u": self.u / name.si_per_unit}
        return {"error": self.error, **sizes, "p_value": self.p_value, "adjusted_p_value": self.adjusted}


def changes(data: Aligned, new: int, old: int) -> tuple[ErrorChange, ...]:
    """Return the change of every error from calibration ``old`` to ``new``; both are taken as independent."""
    difference = data.value[new] - data.value[old]
    factor = np.hstack([data.factor[new], data.factor[old]])
    names = list(dict.fromkeys(data.error))
    found = []
    for name in names:
        columns = data.columns(name)
        part, spread = difference[columns], factor[columns]
        k = int(np.argmax(np.abs(part)))
        found.append((float(part[k]), float(np.linalg.norm(spread[k])), chi_square_p(part, spread)))
    adjusted = holm([item[2] for item in found])
    return tuple(ErrorChange(name, *item, each) for name, item, each in zip(names, found, adjusted, strict=True))


def chi_square_p(difference: FloatArray, factor: FloatArray) -> float:
    """Probability of at least this difference (m,) under a normal distribution with covariance F F^T (m, m)."""
    vectors, sizes, _ = np.linalg.svd(factor, full_matrices=False)
    kept = sizes > ROUNDING * sizes[0]
    if not kept.any():
        return 1.0
    score = vectors[:, kept].T @ difference / sizes[kept]
    return float(chi2.sf(score @ score, int(np.count_nonzero(kept))))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return the error probabilities that count all that were looked at.

    >>> holm([0.01, 0.5, 0.02])
    [0.03, 0.5, 0.04]
    """
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    result, highest = [1.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[k]))
        result[k] = highest
    return result
