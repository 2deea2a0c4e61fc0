"""When a figure leaves its tolerance: the distribution of the first exit, drawn from the trend and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.recal.drift_trend import Trend

#: Paths that are drawn, and times at which each is looked at.
PATHS, TIMES = 2000, 300
SEED = 20260101


@dataclass(frozen=True)
class Forecast:
    """First exit from the tolerance, in days after the last reading; infinite for later than ``horizon_days``.

    ``outside_now`` is the probability that it is outside already; ``within_horizon`` that it leaves by the horizon.
    """

    median_days: float
    low_days: float
    high_days: float
    outside_now: float
    within_horizon: float
    confidence: float
    horizon_days: float

    def summary(self) -> dict[str, Any]:
        """Return the fields by name; None for later than the horizon."""
        days = {"median_days": self.median_days, "low_days": self.low_days, "high_days": self.high_days}
        return {
            **{name: value if np.isfinite(value) else None for name, value in days.items()},
            "outside_now": self.outside_now,
            "within_horizon": self.within_horizon,
            "confidence": self.confidence,
            "horizon_days": self.horizon_days,
        }

    def words(self, name: str) -> str:
        """Say it in one sentence, e.g. ``EC0Y leaves tolerance in about 7 weeks, 95 % 5-11``."""
        percent = f"{100.0 * self.confidence:g} %"
        if self.outside_now > 0.5:
            return f"{name} is outside its tolerance already (probability {self.outside_now:.2f})"
        if not np.isfinite(self.low_days):
            return f"{name} stays within tolerance for the next {_span(self.horizon_days)} ({percent})"
        divisor, unit = _unit(self.median_days if np.isfinite(self.median_days) else self.low_days)
        high = f"-{self.high_days / divisor:.0f}" if np.isfinite(self.high_days) else " or later"
        if not np.isfinite(self.median_days):
            at_first = f"{self.low_days / divisor:.0f} {unit}"
            rather = f"rather later than {_span(self.horizon_days)}"
            return f"{name} may leave tolerance after {at_first} at the earliest ({percent}), {rather}"
        about = f"{self.median_days / divisor:.0f}"
        word = unit.removesuffix("s") if about == "1" else unit
        return f"{name} leaves tolerance in about {about} {word}, {percent} {self.low_days / divisor:.0f}{high}"


def _unit(days: float) -> tuple[float, str]:
    if days < 14.0:
        return 1.0, "days"
    return (7.0, "weeks") if days < 182.0 else (30.4375, "months")


def _span(days: float) -> str:
    divisor, unit = _unit(days)
    return f"{days / divisor:.0f} {unit}"


def forecast(
    trend: Trend, reference: float, tolerance: float, *, horizon_days: float = 730.0, confidence: float = 0.95
) -> Forecast:
    """Forecast when |figure - reference| exceeds the tolerance.

    Parameters
    ----------
    trend : of the figure.
    reference : value that the active tables take out (or 0).
    tolerance : in the unit of the figure, positive.
    horizon_days : later exits count as infinitely late.
    confidence : of the interval, which leaves equal shares on both sides.
    """
    days = exit_grid(horizon_days)
    exits = np.concatenate([_exits(trend, k, reference, tolerance, days) for k in range(len(trend.components))])
    return forecast_of(exits, horizon_days, confidence)


def exit_grid(horizon_days: float) -> FloatArray:
    """Times at which paths are looked at, closer together at the beginning."""
    return np.asarray(horizon_days * np.linspace(0.0, 1.0, TIMES) ** 1.5)


def forecast_of(exits_days: FloatArray, horizon_days: float, confidence: float) -> Forecast:
    """Return the forecast of drawn exits; infinite ones come after the horizon."""
    ordered = np.sort(exits_days)
    tail = (1.0 - confidence) / 2.0
    low, median, high = (ordered[min(int(p * len(ordered)), len(ordered) - 1)] for p in (tail, 0.5, 1.0 - tail))
    inside = float(np.mean(np.isfinite(ordered)))
    now = float(np.mean(ordered <= 0.0))
    return Forecast(float(median), float(low), float(high), now, inside, confidence, horizon_days)


def _exits(trend: Trend, k: int, reference: float, tolerance: float, days: FloatArray) -> FloatArray:
    """Draw exits of one component; their number follows its share."""
    part = trend.components[k]
    generator = np.random.default_rng([SEED, k])
    count = max(int(round(PATHS * part.share)), 1)
    values, vectors = np.linalg.eigh(part.state_covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    state = part.state + generator.standard_normal((count, 2)) @ root.T
    path = state[:, :1] - reference + state[:, 1:] * days
    if part.q > 0.0:
        steps = generator.standard_normal((count, len(days) - 1)) * np.sqrt(part.q * np.diff(days))
        path[:, 1:] += np.cumsum(steps, axis=1)
    return first_exit(path, tolerance, days)


def first_exit(path: FloatArray, tolerance: float, days: FloatArray) -> FloatArray:
    """First time at which each path (m, times) exceeds the tolerance, linear in between; infinite if never."""
    size = np.abs(path)
    outside = size > tolerance
    first = np.argmax(outside, axis=1)
    never = ~outside.any(axis=1)
    rows = np.arange(len(path))
    late, early = size[rows, first], size[rows, np.maximum(first - 1, 0)]
    share = np.clip((tolerance - early) / np.where(late > early, late - early, 1.0), 0.0, 1.0)
    at = days[np.maximum(first - 1, 0)] + share * (days[first] - days[np.maximum(first - 1, 0)])
    return np.where(never, np.inf, np.where(first == 0, 0.0, at))
