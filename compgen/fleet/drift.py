"""Drift of one machine from its calibrations: changes, trends, steps, forecasts, in figures and in sentences.

See ``docs/drift.md``; :mod:`compgen.fleet.change` compares calibrations, :mod:`compgen.fleet.trend` fits and forecasts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from scipy.stats import norm

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.errors import InputError
from compgen.fleet.change import (
    Aligned,
    Calibration,
    Change,
    ErrorChange,
    MonitoredFigure,
    aligned,
    calibrations_of,
    change_between,
    changes,
    holm,
    with_all_errors,
)
from compgen.fleet.decisions import excluded
from compgen.fleet.records import MachineRecord, active_of
from compgen.fleet.store import Store
from compgen.fleet.trend import (
    DriftStep,
    Forecast,
    TimeSeries,
    Trend,
    fit_trend,
    forecast,
    usable_temperature,
    volume_forecast,
)

#: Mean length of a month.
DAYS_A_MONTH = 30.4375


def interval_of(value: float, u: float, confidence: float) -> tuple[float, float]:
    """Return the ends of the interval that holds the truth with this confidence."""
    reach = float(norm.ppf(0.5 + 0.5 * confidence)) * u
    return value - reach, value + reach


def moment_of(iso: str) -> str:
    """Return a time as people read it, e.g. ``2026-07-05 06:00 UTC``."""
    return f"{datetime.fromisoformat(iso).astimezone(UTC):%Y-%m-%d %H:%M} UTC"


def sentences(drift: Drift) -> list[str]:
    """Say what matters in words; every figure is given with its interval."""
    level = 1.0 - drift.settings.confidence
    warm = following_temperature(drift)
    logged = drift.temperature_c
    at = f", at {sum(logged) / len(logged):.1f} degC" if logged else ""
    told = _steps(drift)
    for item in drift.figures:
        if item.trend is not None and item.adjusted < level:
            value, u = (DAYS_A_MONTH * part for part in item.trend.slope)
            told.append(f"{item.figure.name} drifts by {_with_interval(drift, item.figure, value, u)} per month")
        if item.figure.name in warm and item.trend is not None and item.trend.per_kelvin is not None:
            size = _with_interval(drift, item.figure, *item.trend.per_kelvin)
            told.append(f"{item.figure.name} follows the temperature by {size} per K")
        if item.forecast is not None:
            told.append(item.forecast.words(item.figure.name) + (at if item.figure.name in warm else ""))
    if drift.volume_forecast is not None:
        told.append(drift.volume_forecast.words("the volume") + (at if warm else ""))
    return told + list(drift.notes)


def outlook(drift: Drift) -> tuple[str, str]:
    """Say what moves most certainly, and what leaves its tolerance first; each empty if there is nothing to say."""
    level = 1.0 - drift.settings.confidence
    moving = sorted((item for item in drift.figures if item.p_value < level), key=lambda item: item.p_value)
    told = ""
    if moving:
        item = moving[0]
        assert item.trend is not None
        scale = item.figure.scale
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


def _with_interval(drift: Drift, figure: MonitoredFigure, value: float, u: float) -> str:
    """Say a figure with its interval, e.g. ``+1.50 urad (95 % +1.20 to +1.80)``."""
    confidence = drift.settings.confidence
    scale = figure.scale
    low, high = interval_of(value, u, confidence)
    return f"{value * scale:+.2f} {figure.unit} ({100 * confidence:g} % {low * scale:+.2f} to {high * scale:+.2f})"


@dataclass(frozen=True)
class DriftSettings:
    """What the drift is judged by.

    Parameters
    ----------
    tolerances : by error name, mm or rad, and ``volume`` for the rms over the volume, mm.
    reference : number of the calibration that the active tables take out; the first if nothing says so.
    walk : whether a random walk is considered in addition to the line.
    confidence : of intervals and of what counts as significant.
    horizon_days : how far forecasts look.
    """

    tolerances: Mapping[str, float] = field(default_factory=dict)
    reference: int = 0
    walk: bool = True
    confidence: float = 0.95
    horizon_days: float = 730.0


@dataclass(frozen=True)
class FigureDrift:
    """Trend of one figure; None for too few calibrations. ``reference`` is what the active tables take out.

    ``adjusted`` is the error probability of the slope, all figures counted.
    """

    figure: MonitoredFigure
    series: TimeSeries
    reference: float
    trend: Trend | None
    adjusted: float
    tolerance: float | None = None
    forecast: Forecast | None = None

    @property
    def p_value(self) -> float:
        """Error probability of what is most certain about it, its slope or one of its steps; all figures counted."""
        steps = () if self.trend is None else self.trend.steps
        return min([self.adjusted, *(step.p_value for step in steps)])

    def line(self) -> tuple[FloatArray, FloatArray]:
        """Days and values of the line with its steps, each in the middle of its gap, at the mean temperature."""
        assert self.trend is not None
        days, slope = self.series.days, self.trend.slope[0]
        now = sum(part.share * part.state[0] for part in self.trend.components)
        corners = [(float(k), day) for k, day in enumerate(days)]
        for step in self.trend.steps:  # between readings after - 1 and after, just before and just behind the step
            middle = 0.5 * (days[step.after - 1] + days[step.after])
            corners += [(step.after - 0.6, middle), (step.after - 0.4, middle)]
        order, places = (np.array(part) for part in zip(*sorted(corners), strict=True))
        values = now + slope * (places - days[-1])
        for step in self.trend.steps:
            values -= np.where(order < step.after - 0.5, step.size, 0.0)
        return places, values

    def summary(self, times: Sequence[str], confidence: float) -> dict[str, Any]:
        """Return value, trend and forecast by name, in um or urad and days; ``times`` are those of the calibrations."""
        scale = self.figure.scale
        found: dict[str, Any] = {
            "figure": self.figure.name,
            "error": self.figure.error,
            "part": self.figure.part,
            "unit": self.figure.unit,
            "value": (self.series.value * scale).tolist(),
            "u": (self.series.u * scale).tolist(),
            "reference": self.reference * scale,
            "tolerance": None if self.tolerance is None else self.tolerance * scale,
            "forecast": None if self.forecast is None else self.forecast.summary(),
            "trend": None,
        }

        def interval(value: float, u: float) -> list[float]:
            return [end * scale for end in interval_of(value, u, confidence)]

        if self.trend is not None:
            slope, kelvin = self.trend.slope, self.trend.per_kelvin
            found["trend"] = {
                "per_day": slope[0] * scale,
                "u_per_day": slope[1] * scale,
                "interval_per_day": interval(*slope),
                "p_value": self.trend.p_value,
                "adjusted_p_value": self.adjusted,
                "random_walk_probability": self.trend.walk_share,
                "per_kelvin": None if kelvin is None else kelvin[0] * scale,
                "u_per_kelvin": None if kelvin is None else kelvin[1] * scale,
                "interval_per_kelvin": None if kelvin is None else interval(*kelvin),
                "steps": [
                    {
                        "between": [times[step.after - 1], times[step.after]],
                        "size": step.size * scale,
                        "u": step.u * scale,
                        "interval": interval(step.size, step.u),
                        "p_value": step.p_value,
                    }
                    for step in self.trend.steps
                ],
            }
        return found


@dataclass(frozen=True)
class Drift:
    """Everything that is known about the drift of one machine; ``gaps`` are the steps by the calibration after them."""

    machine: str
    times: tuple[str, ...]
    settings: DriftSettings
    since_last: tuple[ErrorChange, ...]
    since_first: tuple[ErrorChange, ...]
    volume_since_last: Change | None
    volume_since_first: Change | None
    volume_um: tuple[tuple[float, float], ...]
    volume_forecast: Forecast | None
    figures: tuple[FigureDrift, ...]
    temperature_c: tuple[float, ...] | None
    notes: tuple[str, ...]

    @property
    def gaps(self) -> dict[int, list[tuple[MonitoredFigure, DriftStep]]]:
        """Steps by the number of the calibration after them."""
        found: dict[int, list[tuple[MonitoredFigure, DriftStep]]] = {}
        for item in self.figures:
            for step in item.trend.steps if item.trend is not None else ():
                found.setdefault(step.after, []).append((item.figure, step))
        return dict(sorted(found.items()))

    def sentences(self) -> list[str]:
        """Say what matters in words."""
        return sentences(self)

    def outlook(self) -> tuple[str, str]:
        """Say what moves and when the first tolerance is left, each in a few words; empty for nothing and no tolerance."""
        return outlook(self)

    def summary(self) -> dict[str, Any]:
        """Return all figures for JSON, in um, urad, days."""
        return {
            "machine": self.machine,
            "times": list(self.times),
            "reference": self.times[self.settings.reference],
            "temperature_c": None if self.temperature_c is None else list(self.temperature_c),
            "since_last": [item.summary() for item in self.since_last],
            "since_first": [item.summary() for item in self.since_first],
            "volume": {
                "since_last": None if self.volume_since_last is None else self.volume_since_last.summary(),
                "since_first": None if self.volume_since_first is None else self.volume_since_first.summary(),
                "rms_um": [rms for rms, _ in self.volume_um],
                "expected_rms_um": [expected for _, expected in self.volume_um],
                "forecast": None if self.volume_forecast is None else self.volume_forecast.summary(),
            },
            "confidence": self.settings.confidence,
            "figures": [item.summary(self.times, self.settings.confidence) for item in self.figures],
            "sentences": self.sentences(),
        }


def drift_of_store(store: Store, machine: MachineRecord, settings: DriftSettings) -> Drift:
    """Return the drift of a machine of the store; the calibration behind its active tables is the reference."""
    (history, ids, model), tables, left_out = store.together(
        lambda: (calibrations_of(store, machine), store.tables(machine, figures=False), excluded(store, machine))
    )
    history, ids, fewer = with_all_errors(history, ids)
    active = active_of(tables)
    known = active is not None and active.identification_id in ids
    reference = ids.index(active.identification_id) if known and active is not None else 0
    found = drift_report(model, history, replace(settings, reference=reference), name=machine.name)
    return replace(found, notes=(*found.notes, *fewer, *left_out.values()))


def drift_report(
    machine: Machine, history: Sequence[Calibration], settings: DriftSettings | None = None, *, name: str = ""
) -> Drift:
    """Judge the drift over calibrations, oldest first.

    Parameters
    ----------
    machine : as the newest calibration has it.
    history : at least one calibration; trends need three, with temperatures five.
    settings : tolerances, reference, confidence; by default :class:`DriftSettings`.
    name : of the machine in reports; default that of its file.
    """
    chosen = settings or DriftSettings()
    if not history:
        raise InputError("a drift needs at least one calibration")
    if not 0 <= chosen.reference < len(history):
        raise InputError(f"the reference is calibration {chosen.reference}, but there are {len(history)}")
    data = aligned(machine, history)
    last, notes = len(history) - 1, []
    temperature = _temperature(history, data)
    if temperature is None and any(item.temperatures_c for item in history):
        notes.append("temperatures are too few or too even to tell their effect from the drift")
    if last < 2:
        notes.append("a trend needs three calibrations")
    figures = _figures(data, chosen, temperature)
    volume = [_volume(machine, history, k, chosen.reference, chosen.confidence) for k in range(len(history))]
    return Drift(
        machine=name or machine.name,
        times=tuple(item.at.isoformat(timespec="minutes") for item in history),
        settings=chosen,
        since_last=changes(data, last, last - 1) if last else (),
        since_first=changes(data, last, 0) if last else (),
        volume_since_last=_volume(machine, history, last, last - 1, chosen.confidence) if last else None,
        volume_since_first=_volume(machine, history, last, 0, chosen.confidence) if last else None,
        volume_um=tuple((item.rms_um, item.expected_rms_um) for item in volume),
        volume_forecast=_volume_forecast(data, chosen, figures, temperature),
        figures=figures,
        temperature_c=temperature,
        notes=tuple(notes),
    )


def _volume(machine: Machine, history: Sequence[Calibration], new: int, old: int, confidence: float) -> Change:
    if new == old:
        return Change(0.0, 0.0, 0.0, 1.0, confidence)
    pair = [(history[k].errors, history[k].covariance) for k in (new, old)]
    return change_between(machine, pair[0], pair[1], confidence)


def _temperature(history: Sequence[Calibration], data: Aligned) -> tuple[float, ...] | None:
    """Mean over the channels that every calibration logged; None if they do not show an effect."""
    channels = set.intersection(*({*item.temperatures_c} for item in history))
    if not channels:
        return None
    mean = [float(np.mean([item.temperatures_c[name] for name in sorted(channels)])) for item in history]
    return tuple(mean) if usable_temperature(data.days, np.array(mean)) else None


def _figures(data: Aligned, chosen: DriftSettings, temperature: tuple[float, ...] | None) -> tuple[FigureDrift, ...]:
    values, u = data.figure_values(), data.figure_u()
    warm = None if temperature is None else np.array(temperature) - np.mean(temperature)
    all_series = [TimeSeries(data.days, values[:, k], u[:, k], warm) for k in range(len(data.figures))]
    trends = [
        fit_trend(item, walk=chosen.walk, looks=len(all_series), level=1.0 - chosen.confidence) for item in all_series
    ]
    adjusted = iter(holm([item.p_value for item in trends if item is not None]))
    found = []
    for figure, series, trend in zip(data.figures, all_series, trends, strict=True):
        reference, tolerance = float(series.value[chosen.reference]), chosen.tolerances.get(figure.error)
        leaves = None
        if tolerance is not None and trend is not None:
            limits = {"horizon_days": chosen.horizon_days, "confidence": chosen.confidence}
            leaves = forecast(trend, reference, tolerance, **limits)
        p_value = 1.0 if trend is None else next(adjusted)
        found.append(FigureDrift(figure, series, reference, trend, p_value, tolerance, leaves))
    return tuple(found)


def _volume_forecast(
    data: Aligned, chosen: DriftSettings, figures: Sequence[FigureDrift], temperature: tuple[float, ...] | None
) -> Forecast | None:
    tolerance = chosen.tolerances.get("volume")
    if tolerance is None:
        return None
    steps = sorted({step.after for item in figures if item.trend is not None for step in item.trend.steps})
    warm = None if temperature is None else np.array(temperature) - np.mean(temperature)
    limits = (tolerance, chosen.horizon_days, chosen.confidence)
    return volume_forecast(data, chosen.reference, steps, warm, limits)
