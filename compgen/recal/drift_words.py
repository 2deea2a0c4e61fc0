"""What matters of a drift, in sentences: steps, trends, what follows the temperature, forecasts."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

from scipy.stats import norm

from compgen.core.names import error_named
from compgen.recal.drift_change import holm
from compgen.recal.drift_data import Figure

if TYPE_CHECKING:
    from compgen.recal.drift import Drift, FigureDrift

DAYS_A_MONTH = 30.4375


def interval_of(value: float, u: float, confidence: float) -> tuple[float, float]:
    """Return the ends of the interval that holds the truth with this confidence."""
    reach = float(norm.ppf(0.5 + 0.5 * confidence)) * u
    return value - reach, value + reach


def moment_of(iso: str) -> str:
    """Return a time as people read it, e.g. ``2026-07-05 06:00 UTC``."""
    return f"{datetime.fromisoformat(iso).astimezone(UTC):%Y-%m-%d %H:%M} UTC"


def sentences(drift: Drift) -> list[str]:
    """Say what matters in words; every figure stands with its interval."""
    level = 1.0 - drift.settings.confidence
    warm = following_temperature(drift)
    told = _steps(drift)
    for item in drift.figures:
        if item.trend is not None and item.adjusted < level:
            value, u = (DAYS_A_MONTH * part for part in item.trend.slope)
            told.append(f"{item.figure.name} drifts by {_with_interval(drift, item.figure, value, u)} per month")
        if item.figure.name in warm and item.trend is not None and item.trend.per_kelvin is not None:
            size = _with_interval(drift, item.figure, *item.trend.per_kelvin)
            told.append(f"{item.figure.name} follows the temperature by {size} per K")
        if item.forecast is not None:
            told.append(item.forecast.words(item.figure.name) + _at_temperature(drift, item, warm))
    if drift.volume_forecast is not None:
        at = f", at {_mean_c(drift):.1f} degC" if warm else ""
        told.append(drift.volume_forecast.words("the volume") + at)
    return told + list(drift.notes)


def outlook(drift: Drift) -> tuple[str, str]:
    """Say what moves most certainly, and what leaves its tolerance first; each empty if there is nothing to say."""
    level = 1.0 - drift.settings.confidence
    moving = sorted((item for item in drift.figures if item.p_value < level), key=lambda item: item.p_value)
    told = ""
    if moving:
        item = moving[0]
        assert item.trend is not None
        scale = 1.0 / error_named(item.figure.error).si_per_unit
        if item.adjusted < level:
            told = f"{item.figure.name} {item.trend.slope[0] * DAYS_A_MONTH * scale:+.2f} {item.figure.unit} a month"
        else:
            step = min(item.trend.steps, key=lambda step: step.p_value)
            told = f"{item.figure.name} step of {step.size * scale:+.2f} {item.figure.unit} before {drift.times[step.after][:10]}"
        told += f", and {len(moving) - 1} more" if len(moving) > 1 else ""
    known = [(item.figure.name, item.forecast) for item in drift.figures if item.forecast is not None]
    if drift.volume_forecast is not None:
        known.append(("the volume", drift.volume_forecast))
    if not known:
        return told, ""
    name, first = min(known, key=lambda each: (-(each[1].outside_now > 0.5), each[1].median_days, each[1].low_days))
    return told, first.words(name)


def following_temperature(drift: Drift) -> set[str]:
    """Return the figures that follow the temperature significantly, all that were looked at counted."""
    found = {}
    for item in drift.figures:
        if item.trend is not None and item.trend.per_kelvin is not None:
            value, u = item.trend.per_kelvin
            found[item.figure.name] = float(2.0 * norm.sf(abs(value) / u))
    adjusted = holm(list(found.values()))
    level = 1.0 - drift.settings.confidence
    return {name for name, p_value in zip(found, adjusted, strict=True) if p_value < level}


def _steps(drift: Drift) -> list[str]:
    told = []
    for after, steps in drift.gaps.items():
        listed = "; ".join(f"{f.name} {_with_interval(drift, f, step.size, step.u)}" for f, step in steps)
        before, since = (moment_of(drift.times[k]) for k in (after - 1, after))
        told.append(f"step between {before} and {since}: {listed}")
    return told


def _with_interval(drift: Drift, figure: Figure, value: float, u: float) -> str:
    """Say a figure with its interval, e.g. ``+1.50 urad (95 % +1.20 to +1.80)``."""
    confidence = drift.settings.confidence
    scale = 1.0 / error_named(figure.error).si_per_unit
    low, high = interval_of(value, u, confidence)
    return f"{value * scale:+.2f} {figure.unit} ({100 * confidence:g} % {low * scale:+.2f} to {high * scale:+.2f})"


def _at_temperature(drift: Drift, item: FigureDrift, warm: set[str]) -> str:
    return f", at {_mean_c(drift):.1f} degC" if item.figure.name in warm else ""


def _mean_c(drift: Drift) -> float:
    assert drift.temperature_c is not None
    return sum(drift.temperature_c) / len(drift.temperature_c)
