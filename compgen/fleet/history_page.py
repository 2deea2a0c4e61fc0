"""A machine's history as one self-contained page: what changed, trends with their tolerance, forecasts."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from markupsafe import Markup

from compgen.data.files import OutputFolder
from compgen.data.names import COVERAGE, describe_error
from compgen.drawing.charts import DASHED, DOTTED, LABEL, Picture, Plot, limits_of, page_assets, svg
from compgen.fleet.drift import Drift, FigureDrift, following_temperature, moment_of
from compgen.report.html.write import page_environment
from compgen.resources import LANGUAGES


def history_page(drift: Drift, language: str = LANGUAGES[0]) -> str:
    """Return the text of the page in a language; it loads nothing from elsewhere and runs no script."""
    environment = page_environment("history", language)
    environment.filters |= {"probability": probability, "moment": moment_of, "zip": zip}
    style, _, policy = page_assets()
    pictures = draw_history(drift)
    if language != LANGUAGES[0]:
        from compgen.language import texts_of

        pictures = [texts_of(language).picture(item) for item in pictures]
    return environment.get_template("history.html.j2").render(
        drift=drift.summary(), pictures=pictures, style=style, policy=policy
    )


def probability(value: float, level: float) -> Markup:
    """An error probability; bold below ``level``."""
    text = "&lt; 0.0001" if value < 1e-4 else f"{value:.4f}" if value < 0.1 else f"{value:.2f}"
    return Markup(f"<strong>{text}</strong>" if value < level else text)


def write_history_report(path: Path, drift: Drift, language: str = LANGUAGES[0]) -> Path:
    """Write the page to a file, completely or not at all."""
    folder = OutputFolder(path.parent)
    folder.add(path.name, history_page(drift, language))
    return next(iter(folder.commit().values()))


def draw_history(drift: Drift) -> list[Picture]:
    """Return the pictures: the volume, temperatures if they are used, and every figure, the important ones first."""
    days = drift.figures[0].series.days if drift.figures else np.arange(float(len(drift.times)))
    rms, expected = (np.array(part) for part in zip(*drift.volume_um, strict=True))
    tolerance = drift.settings.tolerances.get("volume")
    lines = [] if tolerance is None else [tolerance * 1e3]
    top = max(float(np.max([*rms, *expected, *lines])), 1e-3)
    plot = _over_days(limits_of(days, margin=0.03), (0.0, 1.07 * top), "µm rms")
    plot.line(days, expected, "muted", dash=DOTTED)
    for value in lines:
        plot.across(value, "table")
    plot.line(days, rms, "line")
    plot.dots(days, rms, "line", size=5.0)
    note = "change against the errors that the active tables correct; dotted: expected from the uncertainty alone"
    pictures = [Picture("volume", "Volume", svg("volume", f"Volume: {note}", [plot]), note=note)]
    if drift.temperature_c is not None:
        temperature = np.array(drift.temperature_c)
        plot = _over_days(limits_of(days, margin=0.03), limits_of(temperature), "°C")
        plot.line(days, temperature, "c1")
        plot.dots(days, temperature, "c1", size=5.0)
        note = "mean over the channels that every measurement logged"
        drawn = svg("temperature", f"Temperature: {note}", [plot])
        pictures.append(Picture("temperature", "Temperature", drawn, note=note))
    warm = following_temperature(drift)
    ordered = sorted(drift.figures, key=lambda item: (item.tolerance is None, item.p_value))
    return pictures + [_figure(item, warm) for item in ordered]


def _over_days(x: tuple[float, float], y: tuple[float, float], unit: str) -> Plot:
    return Plot(x, y, x_label="days since the first calibration", y_label=unit)


def _figure(item: FigureDrift, warm: Collection[str]) -> Picture:
    """Values with their uncertainty, values at the mean temperature, trend, steps, tolerance and forecast."""
    series, trend, unit = item.series, item.trend, LABEL[item.figure.unit]
    scale, days = item.figure.scale, np.asarray(series.days)
    value, spread = series.value * scale, COVERAGE * series.u * scale
    shown, end = [value - spread, value + spread], float(days[-1])
    ahead, following = None, None
    at, level = (days[:0], days[:0]) if trend is None else item.line()
    if trend is not None:
        if item.figure.name in warm and trend.per_kelvin is not None and series.temperature_k is not None:
            following = (series.value - trend.per_kelvin[0] * series.temperature_k) * scale
        if item.forecast is not None and item.forecast.low_days < (reach := max(end - float(days[0]), 1.0)):
            # The interval of the forecast within the range of the picture, and the trend up to there.
            reach = min(item.forecast.high_days, reach)
            state = sum(part.share * part.state[0] for part in trend.components)
            ahead = np.array([0.0, reach]), (state + trend.slope[0] * np.array([0.0, reach])) * scale
            shown.append(ahead[1])
            end += reach
    limits = [limit * scale for limit in item.limits]
    shown += [level * scale, np.array(limits), value if following is None else following]
    plot = _over_days(limits_of(days, end, margin=0.03), limits_of(*shown), unit)
    if ahead is not None and item.forecast is not None:
        low, high = plot.y
        plot.band([days[-1] + item.forecast.low_days, end], [low, low], [high, high])
        plot.line(days[-1] + ahead[0], ahead[1], "fit", dash=DOTTED)
    for step in () if trend is None else trend.steps:
        plot.upright(0.5 * (days[step.after - 1] + days[step.after]), "before", dash=DOTTED)
    for limit in limits:
        plot.across(limit, "table")
    plot.line(at, level * scale, "fit", dash=DASHED)
    plot.spread(days, value - spread, value + spread, "line")
    plot.dots(days, value, "line", size=5.0)
    if following is not None:  # open points
        plot.dots(days, following, "fit", size=6.0)
        plot.dots(days, following, "page", size=3.5)
    key = f"figure-{item.figure.name.replace(' ', '-')}"
    note = describe_error(item.figure.error)
    title = f"{item.figure.name}: {note}, {unit} over days"
    return Picture(key, item.figure.name, svg(key, title, [plot]), note=note)
