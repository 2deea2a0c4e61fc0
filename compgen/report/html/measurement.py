"""Pictures of the measurement: residuals, and stations with their rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.report.html.curves import Picture
from compgen.report.html.folder import ReadingResiduals
from compgen.report.html.svg import CYCLE, colour, new_figure, to_svg
from compgen.report.html.volume import projected

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BINS = 41
#: Rays drawn for each station.
RAYS = 60
#: Panels of the histogram: stations beyond this number are drawn together.
MOST_PANELS = 8


def residual_groups(residuals: ReadingResiduals) -> dict[str, FloatArray]:
    """Return the residuals of the used readings by station, um; all together where they have none or too many."""
    used = residuals.used
    if not residuals.station:
        return {"all readings": residuals.residual_mm[used] * 1e3}
    names = np.array(residuals.station)
    found = {
        str(name): residuals.residual_mm[used & (names == name)] * 1e3 for name in dict.fromkeys(residuals.station)
    }
    if len(found) > MOST_PANELS:
        return {"all stations": residuals.residual_mm[used] * 1e3}
    return {name: values for name, values in found.items() if len(values)}


def histogram(residuals_um: FloatArray, half_width_um: float) -> tuple[FloatArray, FloatArray]:
    """Return edges in um and counts over -half_width ... +half_width."""
    counts, edges = np.histogram(residuals_um, np.linspace(-half_width_um, half_width_um, BINS + 1))
    return edges, counts.astype(np.float64)


def draw_residuals(residuals: ReadingResiduals) -> Picture | None:
    """Return the histograms of the residuals by station, with the normal curve of the same spread."""
    groups = residual_groups(residuals)
    largest = max((float(np.max(np.abs(values))) for values in groups.values() if len(values)), default=0.0)
    if not groups or largest <= 0.0:
        return None
    columns = min(len(groups), 2 if len(groups) <= 4 else 4)
    rows = -(-len(groups) // columns)
    figure = new_figure(160.0 * columns, 130.0 * rows)
    for k, values in enumerate(groups.values()):
        row, column = divmod(k, columns)
        width, height = 1.0 / columns, 1.0 / rows
        box = ((column + 0.2) * width, 1.0 - (row + 0.76) * height, 0.74 * width, 0.6 * height)
        _draw_histogram(figure.add_axes(box), values, largest, k)
    title = "Residuals of the readings, measurement minus model, in µm, one panel per station in the order of the table"
    return Picture("residuals", "Residuals", to_svg(figure, "residuals", title), {}, title)


def _draw_histogram(axes: Axes, values_um: FloatArray, half_width_um: float, number: int) -> None:
    edges, counts = histogram(values_um, half_width_um)
    axes.stairs(counts, edges, fill=True, color=colour(CYCLE[number % len(CYCLE)]))
    spread = float(np.sqrt(np.mean(values_um**2))) or 1.0
    x = np.linspace(-half_width_um, half_width_um, 81)
    step = float(edges[1] - edges[0])
    normal = len(values_um) * step / (spread * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (x / spread) ** 2)
    axes.plot(x, normal, color=colour("ink"), linewidth=0.8)
    axes.set_title(f"station {number + 1}", fontsize=8, pad=2)
    axes.set_xlabel("µm", labelpad=1)
    axes.locator_params(nbins=4)


def draw_stations(stations: Sequence[Mapping[str, Any]], residuals: ReadingResiduals | None) -> Picture | None:
    """Return the stations in space with rays to some of the points that they saw; None where nothing is known."""
    places = {str(item["station"]): np.array(item["position_mm"], dtype=np.float64) for item in stations}
    if not places:
        return None
    figure = new_figure(420, 300)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.96))
    axes.set_axis_off()
    axes.set_aspect("equal")
    if residuals is not None and residuals.position_mm is not None:
        _draw_rays(axes, places, residuals)
    for k, place in enumerate(places.values()):
        x, y = projected(place)
        axes.plot([x], [y], marker="^", markersize=8, color=colour(CYCLE[k % len(CYCLE)]), linestyle="none")
        axes.annotate(str(k + 1), (x, y), xytext=(7, 5), textcoords="offset points", fontsize=9)
    axes.autoscale_view()
    title = "Stations (triangles, numbered as in the table) and some of their rays to the measured points, seen from outside"
    return Picture("stations", "Stations and rays", to_svg(figure, "stations", title), {}, title)


def _draw_rays(axes: Axes, places: Mapping[str, FloatArray], residuals: ReadingResiduals) -> None:
    assert residuals.position_mm is not None
    names = np.array(residuals.station)
    for k, (name, place) in enumerate(places.items()):
        seen = np.flatnonzero((names == name) & residuals.used)
        if not len(seen):
            continue
        picked = residuals.position_mm[seen[np.unique(np.linspace(0, len(seen) - 1, RAYS).astype(int))]]
        rays = np.stack([np.broadcast_to(place, picked.shape), picked, np.full_like(picked, np.nan)], axis=1)
        flat = projected(rays.reshape(-1, 3))
        axes.plot(flat[:, 0], flat[:, 1], color=colour(CYCLE[k % len(CYCLE)]), linewidth=0.35)
        points = projected(picked)
        axes.plot(points[:, 0], points[:, 1], ".", color=colour("muted"), markersize=1.5)
