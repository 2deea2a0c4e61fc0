"""Drift of one machine: changes, trends, forecasts, steps, from its calibrations (``docs/drift.md``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import error_named
from compgen.errors import InputError
from compgen.recal.change import Change, change_between
from compgen.recal.drift_change import ErrorChange, changes, holm
from compgen.recal.drift_data import Aligned, Calibration, Figure, aligned, calibrations_of, with_all_errors
from compgen.recal.drift_forecast import Forecast, forecast
from compgen.recal.drift_trend import Series, Step, Trend, fit_trend, usable_temperature
from compgen.recal.drift_volume import volume_forecast
from compgen.recal.drift_words import interval_of, outlook, sentences
from compgen.recal.exclude import excluded
from compgen.recal.records import MachineRecord, TableRecord
from compgen.recal.store import Store


@dataclass(frozen=True)
class DriftSettings:
    """What the drift is judged by.

    Parameters
    ----------
    tolerances : by error name, mm or rad, and ``volume`` for the rms over the volume, mm.
    reference : number of the calibration that the active tables take out; the first if nothing says so.
    walk : whether a random walk is weighed beside the line.
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

    figure: Figure
    series: Series
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
    def gaps(self) -> dict[int, list[tuple[Figure, Step]]]:
        """Steps by the number of the calibration after them."""
        found: dict[int, list[tuple[Figure, Step]]] = {}
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
            "figures": [_figure_summary(item, self.times, self.settings.confidence) for item in self.figures],
            "sentences": self.sentences(),
        }


def _figure_summary(item: FigureDrift, times: Sequence[str], confidence: float) -> dict[str, Any]:
    scale = 1.0 / error_named(item.figure.error).si_per_unit
    found: dict[str, Any] = {
        "figure": item.figure.name,
        "error": item.figure.error,
        "part": item.figure.part,
        "unit": item.figure.unit,
        "value": (item.series.value * scale).tolist(),
        "u": (item.series.u * scale).tolist(),
        "reference": item.reference * scale,
        "tolerance": None if item.tolerance is None else item.tolerance * scale,
        "forecast": None if item.forecast is None else item.forecast.summary(),
        "trend": None,
    }

    def interval(value: float, u: float) -> list[float]:
        return [end * scale for end in interval_of(value, u, confidence)]

    if item.trend is not None:
        slope, kelvin = item.trend.slope, item.trend.per_kelvin
        found["trend"] = {
            "per_day": slope[0] * scale,
            "u_per_day": slope[1] * scale,
            "interval_per_day": interval(*slope),
            "p_value": item.trend.p_value,
            "adjusted_p_value": item.adjusted,
            "random_walk_probability": item.trend.walk_share,
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
                for step in item.trend.steps
            ],
        }
    return found


def drift_of_store(store: Store, machine: MachineRecord, settings: DriftSettings) -> Drift:
    """Return the drift of a machine of the store; the calibration behind its active tables is the reference."""

    def read() -> tuple[tuple[list[Calibration], list[int], Machine], list[TableRecord], list[str]]:
        found = calibrations_of(store, machine)
        return found, store.tables(machine, figures=False), [*excluded(store, machine).values()]

    (history, ids, model), tables, left_out = store.together(read)
    history, ids, fewer = with_all_errors(history, ids)
    active = next((table for table in tables if table.state == "active"), None)
    known = active is not None and active.identification_id in ids
    reference = ids.index(active.identification_id) if known and active is not None else 0
    found = drift_report(model, history, replace(settings, reference=reference), name=machine.name)
    return replace(found, notes=(*found.notes, *fewer, *left_out))


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
        raise InputError("a drift needs calibrations; none is given")
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
    all_series = [Series(data.days, values[:, k], u[:, k], warm) for k in range(len(data.figures))]
    trends = [
        fit_trend(item, walk=chosen.walk, looks=len(all_series), level=1.0 - chosen.confidence) for item in all_series
    ]
    adjusted = iter(holm([item.p_value for item in trends if item is not None]))
    found = []
    for figure, series, trend in zip(data.figures, all_series, trends, strict=True):
        item = FigureDrift(figure, series, float(series.value[chosen.reference]), trend, 1.0)
        found.append(item if trend is None else replace(item, adjusted=next(adjusted)))
    return tuple(_with_forecast(item, chosen) for item in found)


def _with_forecast(item: FigureDrift, chosen: DriftSettings) -> FigureDrift:
    tolerance = chosen.tolerances.get(item.figure.error)
    if tolerance is None or item.trend is None:
        return replace(item, tolerance=tolerance)
    limits = {"horizon_days": chosen.horizon_days, "confidence": chosen.confidence}
    return replace(item, tolerance=tolerance, forecast=forecast(item.trend, item.reference, tolerance, **limits))


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
