"""Pictures of the 21 errors: identified with their uncertainty, smoothed, and as the tables hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.names import AXES, CURVE_NAMES, error_named
from compgen.report.html.svg import CYCLE, LAYER, colour, frame, limits, new_figure, rounded, to_svg
from compgen.report.html.tables import TableCurve

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Coverage factor of the bands and of every expanded uncertainty in the report.
COVERAGE = 2.0
SIZE_PT = (250.0, 150.0)
LABEL = {"um": "µm", "urad": "µrad"}


@dataclass(frozen=True)
class Series:
    """One line of a picture for hover and keyboard: its name, positions in mm, values and standard uncertainties."""

    name: str
    position_mm: FloatArray
    value: FloatArray
    u: FloatArray | None = None

    def data(self) -> dict[str, Any]:
        """Return the series as the page's script takes it."""
        found = {"name": self.name, "x": rounded(self.position_mm.tolist(), 7), "y": rounded(self.value.tolist())}
        if self.u is not None and np.isfinite(self.u).any():
            found["U"] = rounded((COVERAGE * self.u).tolist(), 2)
        return found


@dataclass(frozen=True)
class Picture:
    """A drawn picture: markup, heading, a word on what it shows, and the data for hover and keyboard."""

    key: str
    title: str
    svg: Markup
    data: Mapping[str, Any]
    note: str = ""


def describe_error(name: str) -> str:
    """Say in words what an error is, e.g. ``"Straightness of X in Y"``."""
    error = error_named(name)
    axis = AXES[error.axis]
    if error.kind == "linear":
        return (
            f"Straightness of {axis} in {AXES[error.direction]}" if error.is_straightness else f"Positioning of {axis}"
        )
    if error.kind == "squareness":
        return {"EC0Y": "Squareness of Y to X", "EB0Z": "Squareness of Z to X", "EA0Z": "Squareness of Z to Y"}[name]
    return {True: f"Roll of {axis}"}.get(
        error.direction == error.axis, f"Rotation of {axis} about {AXES[error.direction]}"
    )


def curve_series(
    name: str, identified: ErrorTable, fitted: ErrorTable | None, tables: Mapping[str, Sequence[TableCurve]]
) -> list[Series]:
    """Return what is drawn of one error in its file's unit: identified, smoothed, and each control that holds it so."""
    scale = 1.0 / error_named(name).si_per_unit
    curve = identified.curves[name]
    found = [Series("identified", curve.position_mm, curve.value * scale, curve.u * scale)]
    if fitted is not None and name in fitted.curves:
        smooth = fitted.curves[name]
        found.append(Series("smoothed", smooth.position_mm, smooth.value * scale))
    for control, curves in tables.items():
        found += [Series(f"table {control}", t.position_mm, t.value) for t in curves if t.error and t.name == name]
    return found


def draw_curves(
    identified: ErrorTable, fitted: ErrorTable | None, tables: Mapping[str, Sequence[TableCurve]]
) -> list[Picture]:
    """Return one picture for each of the 18 functions that was identified."""
    canvas = _Canvas(list(tables))
    return [
        canvas.draw(name, curve_series(name, identified, fitted, tables))
        for name in CURVE_NAMES
        if name in identified.curves
    ]


class _Canvas:
    """One figure that all curves are drawn on, one after the other; making axes takes longer than drawing on them."""

    def __init__(self, controls: Sequence[str]) -> None:
        self.controls = controls
        self.figure: Figure = new_figure(*SIZE_PT)
        self.axes: Axes = self.figure.add_axes((0.185, 0.19, 0.785, 0.74))
        self.axes.axhline(0.0, color=colour("muted"), linewidth=0.6)
        self.axes.locator_params(nbins=5)

    def draw(self, name: str, series: Sequence[Series]) -> Picture:
        """Draw the series of one error and take them away again."""
        error = error_named(name)
        axes, unit = self.axes, LABEL[error.unit]
        drawn = self._draw_identified(series[0])
        for item in series[1:]:
            drawn += self._draw_other(item)
        self._limit(series)
        axes.set_xlabel(f"{AXES[error.axis]} (mm)", labelpad=1)
        axes.set_ylabel(unit, labelpad=1)
        title = f"{name}: {describe_error(name)}, {unit} over {AXES[error.axis]} in mm"
        svg = to_svg(self.figure, f"curve-{name}", title)
        data = {"frame": frame(axes), "limits": limits(axes), "unit": unit, "series": [s.data() for s in series]}
        for artist in drawn:
            artist.remove()
        return Picture(f"curve-{name}", name, svg, data, describe_error(name))

    def _draw_identified(self, item: Series) -> list[Artist]:
        x, y, u = item.position_mm, item.value, item.u
        drawn: list[Artist] = []
        if u is not None and np.isfinite(u).all():
            band = self.axes.fill_between(x, y - COVERAGE * u, y + COVERAGE * u, color=colour("band"), linewidth=0)
            drawn.append(band)
        style = {"marker": "o", "markersize": 2.4} if len(x) <= 40 else {}
        return [*drawn, *self.axes.plot(x, y, color=colour("line"), **style)]  # type: ignore[arg-type]

    def _draw_other(self, item: Series) -> list[Artist]:
        if item.name == "smoothed":
            return [*self.axes.plot(item.position_mm, item.value, color=colour("fit"), linestyle=(0, (4, 2)))]
        number = self.controls.index(item.name.removeprefix("table "))
        dots = self.axes.plot(
            item.position_mm, item.value, color=colour("table"), linestyle="none", marker="x", markersize=4
        )
        dots[0].set_gid(f"{LAYER}control-{number}")
        return [*dots]

    def _limit(self, series: Sequence[Series]) -> None:
        x = np.concatenate([item.position_mm for item in series[:1]])
        values = [item.value for item in series]
        if series[0].u is not None and np.isfinite(series[0].u).all():
            values += [series[0].value + COVERAGE * series[0].u, series[0].value - COVERAGE * series[0].u]
        low, high = float(np.min(np.concatenate(values))), float(np.max(np.concatenate(values)))
        low, high = min(low, 0.0), max(high, 0.0)
        margin = 0.07 * (high - low) or 1.0
        width = float(x[-1] - x[0]) or 1.0
        self.axes.set_xlim(float(x[0]) - 0.02 * width, float(x[-1]) + 0.02 * width)
        self.axes.set_ylim(low - margin, high + margin)


def draw_tables(control: str, number: int, curves: Sequence[TableCurve]) -> list[Picture]:
    """Return pictures of the tables of one control that hold corrections, those of one axis and unit together."""
    groups: dict[tuple[str, str], list[TableCurve]] = {}
    for curve in curves:
        if curve.axis is not None and not curve.error:
            groups.setdefault((curve.axis, curve.unit), []).append(curve)
    return [_draw_table_group(control, number, axis, unit, group) for (axis, unit), group in sorted(groups.items())]


def _draw_table_group(control: str, number: int, axis: str, unit: str, group: Sequence[TableCurve]) -> Picture:
    figure = new_figure(*SIZE_PT)
    axes = figure.add_axes((0.195, 0.19, 0.60, 0.74))
    for k, curve in enumerate(group):
        style = {"color": colour(CYCLE[k % len(CYCLE)]), "marker": "osx^vD"[k % 6], "markersize": 3}
        axes.plot(curve.position_mm, curve.value, label=curve.name, **style)  # type: ignore[arg-type]
    axes.set_xlabel(f"{axis} (mm)", labelpad=1)
    axes.set_ylabel(LABEL[unit], labelpad=1)
    axes.locator_params(nbins=5)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), frameon=False, handlelength=1.2, borderaxespad=0.2)
    key = f"table-{number}-{axis}-{unit}"
    title = f"Tables of {control} over {axis}: corrections in {LABEL[unit]}"
    data = {
        "frame": frame(axes),
        "limits": limits(axes),
        "unit": LABEL[unit],
        "series": [Series(c.name, c.position_mm, c.value).data() for c in group],
    }
    return Picture(key, f"over {axis}, {LABEL[unit]}", to_svg(figure, key, title), data, title)


def draw_squareness(identified: ErrorTable, fitted: ErrorTable | None) -> Picture | None:
    """Return the squareness errors as bars with expanded uncertainty; None where there are none."""
    items = list(identified.squareness.items())
    if not items:
        return None
    figure = new_figure(*SIZE_PT)
    axes = figure.add_axes((0.195, 0.14, 0.775, 0.78))
    value = np.array([pair[0] for _, pair in items]) * 1e6
    u = np.nan_to_num(np.array([pair[1] for _, pair in items]) * 1e6)
    at = np.arange(len(items))
    axes.bar(at, value, width=0.5, color=colour("line"), yerr=COVERAGE * u, ecolor=colour("ink"), capsize=3)
    axes.axhline(0.0, color=colour("muted"), linewidth=0.6)
    axes.set_xticks(at, [name for name, _ in items])
    axes.set_ylabel("µrad", labelpad=1)
    title = "Squareness errors in µrad with expanded uncertainty"
    svg = to_svg(figure, "squareness", title)
    return Picture("squareness", "Squareness", svg, {}, "EC0Y: Y to X, EB0Z: Z to X, EA0Z: Z to Y")
