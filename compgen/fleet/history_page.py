"""A machine's history as one page without any other file: what changed, trends with their tolerance, forecasts."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from compgen.data.csv_files import FloatArray
from compgen.data.files import OutputFolder
from compgen.data.messages import number_text
from compgen.data.names import COVERAGE, error_named
from compgen.fleet.drift import Drift, FigureDrift, following_temperature, moment_of
from compgen.report.html.pictures import LABEL, Picture, colour, describe_error, drawing, new_figure, to_svg
from compgen.resources import data_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE_PT = (300.0, 170.0)
BOX = (0.15, 0.19, 0.82, 0.74)


def history_page(drift: Drift) -> str:
    """Return the text of the page; nothing in it is fetched from elsewhere and no script runs."""
    environment = Environment(
        loader=FileSystemLoader(data_folder("templates") / "_report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number_text, "probability": probability, "moment": moment_of, "zip": zip}
    assert environment.loader is not None
    style = environment.loader.get_source(environment, "style.css")[0]
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    return environment.get_template("history.html.j2").render(
        drift=drift.summary(), pictures=draw_history(drift), style=Markup(style), policy=policy
    )


def probability(value: float, level: float) -> Markup:
    """An error probability; bold below ``level``."""
    text = "&lt; 0.0001" if value < 1e-4 else f"{value:.4f}" if value < 0.1 else f"{value:.2f}"
    return Markup(f"<strong>{text}</strong>" if value < level else text)


def write_history_report(path: Path, drift: Drift) -> Path:
    """Write the page to a file, whole or not at all."""
    folder = OutputFolder(path.parent)
    folder.add(path.name, history_page(drift))
    return next(iter(folder.commit().values()))


def draw_history(drift: Drift) -> list[Picture]:
    """Return the pictures: the volume, temperatures if they count, and every figure, those that matter first."""
    with drawing():
        pictures = [_volume(drift)]
        if drift.temperature_c is not None:
            pictures.append(_temperature(drift))
        warm = following_temperature(drift)
        ordered = sorted(drift.figures, key=lambda item: (item.tolerance is None, item.p_value))
        return pictures + [_figure(item, warm) for item in ordered]


def _days(drift: Drift) -> FloatArray:
    return drift.figures[0].series.days if drift.figures else np.arange(float(len(drift.times)))


def _axes(label: str) -> tuple[Any, Axes]:
    figure = new_figure(*SIZE_PT)
    axes = figure.add_axes(BOX)
    axes.set_xlabel("days since the first calibration", labelpad=1)
    axes.set_ylabel(label, labelpad=1)
    axes.locator_params(nbins=6)
    return figure, axes


def _volume(drift: Drift) -> Picture:
    figure, axes = _axes("µm rms")
    rms, expected = (np.array(part) for part in zip(*drift.volume_um, strict=True))
    axes.plot(_days(drift), rms, color=colour("line"), marker="o", markersize=3)
    axes.plot(_days(drift), expected, color=colour("muted"), linestyle=(0, (2, 2)))
    tolerance = drift.settings.tolerances.get("volume")
    if tolerance is not None:
        axes.axhline(tolerance * 1e3, color=colour("table"), linewidth=0.9)
    axes.set_ylim(bottom=0.0)
    note = "change against what the active tables take out; dotted: by uncertainty alone"
    return Picture("volume", "Volume", to_svg(figure, "volume", f"Volume: {note}"), {}, note)


def _temperature(drift: Drift) -> Picture:
    figure, axes = _axes("°C")
    axes.plot(_days(drift), np.array(drift.temperature_c), color=colour("c1"), marker="o", markersize=3)
    note = "mean over the channels that every measurement logged"
    return Picture("temperature", "Temperature", to_svg(figure, "temperature", f"Temperature: {note}"), {}, note)


def _figure(item: FigureDrift, warm: Collection[str]) -> Picture:
    error = error_named(item.figure.error)
    scale, series = 1.0 / error.si_per_unit, item.series
    figure, axes = _axes(LABEL[error.unit])
    style = {"color": colour("line"), "marker": "o", "markersize": 3, "linestyle": "none", "capsize": 2}
    axes.errorbar(series.days, series.value * scale, yerr=COVERAGE * series.u * scale, **style)  # type: ignore[arg-type]
    if item.trend is not None:
        if item.figure.name in warm and item.trend.per_kelvin is not None and series.temperature_k is not None:
            value = series.value - item.trend.per_kelvin[0] * series.temperature_k
            style = {"markerfacecolor": "none", "markeredgecolor": colour("fit"), "markersize": 4, "linestyle": "none"}
            axes.plot(series.days, value * scale, marker="o", **style)  # type: ignore[arg-type]
        _line(axes, item, scale)
    if item.tolerance is not None:
        for sign in (-1.0, 1.0):
            axes.axhline((item.reference + sign * item.tolerance) * scale, color=colour("table"), linewidth=0.9)
    key = f"figure-{item.figure.name.replace(' ', '-')}"
    note = describe_error(item.figure.error)
    title = f"{item.figure.name}: {note}, {LABEL[error.unit]} over days"
    return Picture(key, item.figure.name, to_svg(figure, key, title), {}, note)


def _line(axes: Axes, item: FigureDrift, scale: float) -> None:
    """Draw the line with its steps at the reference temperature, and where the random walk is now."""
    assert item.trend is not None
    days, (slope, _) = item.series.days, item.trend.slope
    state = sum(part.share * part.state[0] for part in item.trend.components)
    for step in item.trend.steps:
        middle = 0.5 * (days[step.after - 1] + days[step.after])
        axes.axvline(middle, color=colour("before"), linewidth=0.9, linestyle=(0, (1, 2)))
    at, level = item.line()
    axes.plot(at, level * scale, color=colour("fit"), linestyle=(0, (4, 2)))
    if item.forecast is not None:
        reach = _exit(axes, item, days)
        if reach > 0.0:
            ahead = np.array([0.0, reach])
            axes.plot(days[-1] + ahead, (state + slope * ahead) * scale, color=colour("fit"), linestyle=(0, (1, 2)))


def _exit(axes: Axes, item: FigureDrift, days: Sequence[float] | FloatArray) -> float:
    """Shade the interval of the forecast as far as the picture should reach; return how many days that is ahead."""
    assert item.forecast is not None
    low, high = item.forecast.low_days, item.forecast.high_days
    reach = max(float(days[-1] - days[0]), 1.0)
    if low >= reach:
        return 0.0
    axes.axvspan(days[-1] + low, days[-1] + min(high, reach), color=colour("band"), linewidth=0)
    return min(high, reach)
