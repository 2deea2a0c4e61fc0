"""One figure of accuracy with its uncertainty, and how two of them compare."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from compgen.data.names import COVERAGE, MM_PER_UM
from compgen.identify.covariance import normalized_error

Verdict = Literal["better", "worse", "not separated", "smaller", "larger", "same"]


@dataclass(frozen=True)
class Figure:
    """A figure in the unit of reports, um or urad.

    Parameters
    ----------
    value : the figure.
    u : its standard uncertainty, nan where it is not known.
    unit : "um" or "urad".
    meaning : what it is, and the standard that defines it.
    contributions : standard uncertainties by source; their root sum of squares is ``u``.
    """

    value: float
    u: float
    unit: str
    meaning: str
    contributions: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of_mm(cls, value_mm: float, u_mm: float, meaning: str) -> Figure:
        """Return a figure in um."""
        return cls(float(value_mm) / MM_PER_UM, u_mm / MM_PER_UM, "um", meaning)

    @property
    def expanded(self) -> float:
        """Expanded uncertainty U (k = 2)."""
        return COVERAGE * self.u

    def summary(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        found: dict[str, Any] = {
            "value": self.value,
            "u": self.u,
            "U_k2": self.expanded,
            "unit": self.unit,
            "meaning": self.meaning,
        }
        if self.contributions:
            found["contributions"] = dict(self.contributions)
        return found


@dataclass(frozen=True)
class ComparedFigure:
    """The same figure before and after; sizes count, so -12 urad to +3 urad is an improvement by 4."""

    before: Figure
    after: Figure

    @property
    def factor(self) -> float:
        """How many times smaller the figure became: |before| / |after|; infinite if nothing is left."""
        before, after = abs(self.before.value), abs(self.after.value)
        if after == 0.0:
            return 1.0 if before == 0.0 else math.inf
        return before / after

    @property
    def u_factor(self) -> float:
        """Standard uncertainty of the factor, to first order; nan where it is not known."""
        before, after = abs(self.before.value), abs(self.after.value)
        if before == 0.0 or after == 0.0:
            return math.nan
        return self.factor * math.hypot(self.before.u / before, self.after.u / after)

    @property
    def gain(self) -> float:
        """|before| - |after|, um or urad."""
        return abs(self.before.value) - abs(self.after.value)

    @property
    def en(self) -> float:
        """E_n number (ISO/IEC 17043): |gain| over the root sum of squares of both expanded uncertainties."""
        joint = np.hypot(self.before.expanded, self.after.expanded)
        return float(normalized_error(np.asarray(self.gain), joint))

    @property
    def separated(self) -> bool:
        """Whether the bands value +/- U of both do not meet; E_n is above 1 then."""
        return abs(self.gain) > self.before.expanded + self.after.expanded

    @property
    def verdict(self) -> Verdict:
        """Say "better" or "worse" only where the bands separate; without uncertainties "smaller", "larger", "same"."""
        if math.isnan(self.en):
            return "same" if self.gain == 0.0 else "smaller" if self.gain > 0.0 else "larger"
        if not self.separated:
            return "not separated"
        return "better" if self.gain > 0.0 else "worse"

    def summary(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {
            "before": self.before.summary(),
            "after": self.after.summary(),
            "factor": self.factor,
            "u_factor": self.u_factor,
            "en": self.en,
            "verdict": self.verdict,
        }
