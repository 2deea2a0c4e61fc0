"""Pictures of the report: errors, tables, volume and measurement, as SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.accuracy.circularity import about_centre, circle_groups
from compgen.data.circles import PLANES, Circles, arcs_of
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, hat_matrix
from compgen.data.names import AXES, COVERAGE, MM_PER_UM, describe_error, error_named
from compgen.drawing.charts import (
    BOX,
    CYCLE,
    DASHED,
    HEAT,
    LABEL,
    Picture,
    Plot,
    colour_bar,
    legend,
    limits_of,
    rounded,
    svg,
)
from compgen.errors import um_text
from compgen.kinematics.many_points import full_grid
from compgen.report.html.folder import ReadingResiduals, TableCurve, Volume

# Pictures of the 21 errors: identified with their uncertainty, smoothed, and as the tables contain them.


@dataclass(frozen=True)
class CurveSeries:
    """One line of a chart for hover and keyboard: its name, positions in mm, values and standard uncertainties."""

    name: str
    position_mm: FloatArray
    value: FloatArray
    u: FloatArray | None = None

    def data(self) -> dict[str, Any]:
        """Return the series as the page's script expects it."""
        found = {"name": self.name, "x": rounded(self.position_mm, 7), "y": rounded(self.value)}
        if self.u is not None and np.isfinite(self.u).any():
            found["U"] = rounded(COVERAGE * self.u, 2)
        return found


def draw_proposed(entries: Sequence[Mapping[str, Any]]) -> list[Picture]:
    """How the instruments of proposed measurements stand; entries that are damaged are left out."""
    if not entries:
        return []
    from compgen.planning.next_measurement import set_up_picture  # few folders propose something

    found = []
    for k, entry in enumerate(entries):
        with suppress(KeyError, TypeError, ValueError, IndexError):
            found.append(set_up_picture(entry, f"next-{k}"))
    return found


def draw_curve(
    name: str, identified: ErrorTable, fitted: ErrorTable | None, tables: Mapping[str, Sequence[TableCurve]]
) -> Picture:
    """One error in its file's unit: identified with its band, smoothed, and in each control that has a table of it."""
    error, curve = error_named(name), identified.curves[name]
    unit, axis, scale = LABEL[error.unit], AXES[error.axis], 1.0 / error.si_per_unit
    x, y, u = curve.position_mm, curve.value * scale, curve.u * scale
    series = [CurveSeries("identified", x, y, u)]
    if fitted is not None and name in fitted.curves:
        smooth = fitted.curves[name]
        series.append(CurveSeries("smoothed", smooth.position_mm, smooth.value * scale))
    by_control = {
        number: CurveSeries(f"table {control}", item.position_mm, item.value)
        for number, (control, curves) in enumerate(tables.items())
        for item in curves
        if item.error and item.name == name
    }
    series += by_control.values()
    spread = COVERAGE * u if np.isfinite(u).all() else np.zeros_like(u)
    limits = limits_of(y + spread, y - spread, *(item.value for item in series), zero=True)
    plot = Plot(limits_of(x, margin=0.02), limits, x_label=f"{axis} (mm)", y_label=unit)
    plot.band(x, y - spread, y + spread)
    plot.across(0.0)
    plot.line(x, y, "line")
    if len(x) <= 40:
        plot.dots(x, y, "line")
    if len(series) > len(by_control) + 1:
        plot.line(series[1].position_mm, series[1].value, "fit", dash=DASHED)
    for number, item in by_control.items():
        start = len(plot.drawn)
        plot.dots(item.position_mm, item.value, "table", size=3.0, square=True)
        plot.layer(f"control-{number}", start)
    title = f"{name}: {describe_error(name)}, {unit} over {axis} in mm"
    shown = [item.data() for item in series[: len(series) - len(by_control)]]
    shown += [{**item.data(), "control": number} for number, item in by_control.items()]
    data = {**plot.data, "unit": unit, "series": shown}
    return Picture(f"curve-{name}", name, svg(f"curve-{name}", title, [plot]), data, describe_error(name))


def draw_tables(control: str, number: int, curves: Sequence[TableCurve]) -> list[Picture]:
    """Return pictures of the tables of one control that contain corrections, one for each axis and unit."""
    groups: dict[tuple[str, str], list[TableCurve]] = {}
    for curve in curves:
        if curve.axis is not None and not curve.error:
            groups.setdefault((curve.axis, curve.unit), []).append(curve)
    pictures = []
    for (axis, unit), group in sorted(groups.items()):
        x = limits_of(*(item.position_mm for item in group), margin=0.02)
        y = limits_of(*(item.value for item in group), zero=True)
        box = (BOX[0], BOX[1], 190.0, BOX[3])
        plot = Plot(x, y, box, x_label=f"{axis} (mm)", y_label=LABEL[unit])
        for k, item in enumerate(group):
            plot.line(item.position_mm, item.value, CYCLE[k % len(CYCLE)])
            if len(item.position_mm) <= 60:
                plot.dots(item.position_mm, item.value, CYCLE[k % len(CYCLE)], square=k % 2 > 0)
        names = legend(198.0, 18.0, [(CYCLE[k % len(CYCLE)], item.name) for k, item in enumerate(group)])
        key = f"table-{number}-{axis}-{unit}"
        title = f"Tables of {control} over {axis}: corrections in {LABEL[unit]}"
        series = [CurveSeries(c.name, c.position_mm, c.value).data() for c in group]
        data = {**plot.data, "unit": LABEL[unit], "series": series}
        drawn = svg(key, title, [plot], more=names)
        pictures.append(Picture(key, f"over {axis}, {LABEL[unit]}", drawn, data))
    return pictures


def draw_squareness(identified: ErrorTable) -> list[Picture]:
    """Return the squareness errors as bars with expanded uncertainty; nothing if there are none."""
    names = list(identified.squareness)
    if not names:
        return []
    value, u = (np.array([identified.squareness[name][k] for name in names]) * 1e6 for k in range(2))
    spread, at = COVERAGE * np.nan_to_num(u), np.arange(len(names))
    marks = [(float(k), name) for k, name in enumerate(names)]
    limits = limits_of(value - spread, value + spread, zero=True)
    plot = Plot((-0.6, len(names) - 0.4), limits, y_label="µrad", x_ticks=marks)
    plot.bars(at - 0.25, at + 0.25, np.zeros(len(names)), value, "line")
    plot.spread(at, value - spread, value + spread, "ink")
    plot.across(0.0)
    drawn = svg("squareness", "Squareness errors in µrad with expanded uncertainty", [plot])
    return [Picture("squareness", "Squareness", drawn, note="bars: U (k = 2)")]


# Polar diagrams of circular tests.


#: Picture of a circle, and the part of it for the polar diagram.
ROUND, ROUND_BOX = (680.0, 420.0), (130.0, 5.0, 540.0, 415.0)
#: Share of the radius of the picture at which the nominal circle is drawn.
NOMINAL = 0.62


def draw_circle(name: str, circles: Circles, own: NDArray[np.bool_]) -> Picture:
    """Return the polar diagram: radial deviations about the least-squares centre, enlarged, over the nominal circle."""
    radial = about_centre(circles, own) / MM_PER_UM
    angle, direction, run = circles.angle_rad[own], circles.direction[own], circles.run[own]
    # a round number of um for a division, three of which contain all readings
    third = float(np.max(np.abs(radial))) / 3.0 or 1.0
    power = 10.0 ** math.floor(math.log10(third))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= 0.999 * third)
    per_um = (0.88 - NOMINAL) / (3.0 * step)
    plot = Plot((-1.0, 1.0), (-1.0, 1.0), ROUND_BOX, bare=True)
    turn = np.linspace(0.0, 2.0 * np.pi, 361)
    for division in range(-3, 4):
        radius = NOMINAL + division * step * per_um
        role, width = ("muted", 1.1) if division == 0 else ("grid", 0.6)
        plot.line(radius * np.cos(turn), radius * np.sin(turn), role, width=width)
    first, second = (AXES[k] for k in PLANES[name.split()[0]])
    for text, x, y in ((f"+{first}", 1, 0), (f"−{first}", -1, 0), (f"+{second}", 0, 1), (f"−{second}", 0, -1)):
        plot.line((0.0, 0.9 * x), (0.0, 0.9 * y), "grid", width=0.6)
        plot.text(0.95 * x, 0.95 * y, text, anchor="middle", shift=(0.0, 3.0))
    for sign, role in ((1, "c0"), (-1, "c1")):
        for number in np.unique(run[direction == sign]).tolist():
            for arc in arcs_of(angle, np.flatnonzero((direction == sign) & (run == number))):
                place = NOMINAL + radial[arc] * per_um
                plot.line(place * np.cos(angle[arc]), place * np.sin(angle[arc]), role, width=1.3)
    for division in (-3, 0, 3):  # on top of the lines
        at = (NOMINAL + division * step * per_um) * math.sqrt(0.5)
        plot.text(at, at, f"{division * step:+g} µm" if division else "0", shift=(2.0, -2.0))
    drawn = [(1, ("c0", "counter-clockwise")), (-1, ("c1", "clockwise"))]
    names = legend(8.0, 20.0, [item for sign, item in drawn if (direction == sign).any()])
    magnification = per_um / MM_PER_UM * float(circles.radius_mm[own][0]) / NOMINAL
    scale = f"about the centre of least squares, {step:g} µm per division, magnification {magnification:.0f}"
    key, title = f"circle-{name.replace(' ', '-')}", f"Radial deviation {name}"
    return Picture(key, title, svg(key, f"{title}, {scale}", [plot], ROUND, more=names), note=scale)


def draw_circles(circles: Circles | None) -> list[Picture]:
    """Return the polar diagram of each plane and set-up; nothing without circles."""
    return [] if circles is None else [draw_circle(name, circles, own) for name, own in circle_groups(circles).items()]


# Pictures of the volume: the moved grid in space before and after, and slices through the middle.


#: The largest displacement is drawn as this share of the longest side of the volume, enlarged at most so many times:
#: what is smaller than a ten-thousandth of a micrometre is not worth a picture.
DRAWN_SHARE, MOST_ENLARGED = 0.1, 1e6
#: Lines of the grid per axis, points along each line, and cells of a slice per side.
LINES, ALONG, CELLS = 5, 13, 24
#: Width and height of the pictures in space.
WIDE = (420.0, 250.0)


@dataclass(frozen=True)
class VolumeOnGrid:
    """A volume whose points fill a grid: levels of X, Y, Z in mm, and errors (nx, ny, nz, 3) before and after, mm.

    ``after_mm`` is None as long as there is no correction. ``u_um`` is the expanded uncertainty of what is left where it is
    largest: no picture is enlarged beyond it.
    """

    levels_mm: tuple[FloatArray, FloatArray, FloatArray]
    before_mm: FloatArray
    after_mm: FloatArray | None = None
    u_um: float | None = None

    @property
    def sides(self) -> tuple[FloatArray, ...]:
        """The errors before, and after if they are known."""
        return (self.before_mm,) if self.after_mm is None else (self.before_mm, self.after_mm)


def uncertainty_um(result: Mapping[str, Any]) -> float | None:
    """Return the largest expanded uncertainty after compensation that ``result.json`` states, um."""
    stated = result.get("after_uncertainty")
    value = stated.get("U_max_um") if isinstance(stated, Mapping) else None
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def grid_of(volume: Volume | None, u_um: float | None = None) -> VolumeOnGrid | None:
    """Return the grid that the points of a volume fill; None if they do not. ``u_um`` is its expanded uncertainty.

    If a point occurs several times (both directions of travel), the mean is used.
    """
    if volume is None:
        return None
    levels, index = [], []
    for axis in range(3):
        level, where = np.unique(volume.position_mm[:, axis], return_inverse=True)
        levels.append(level)
        index.append(where)
    shape = tuple(len(level) for level in levels)
    if min(shape) < 2 or np.prod(shape) > len(volume.position_mm):
        return None
    flat = np.ravel_multi_index(tuple(index), shape)
    count = np.bincount(flat, minlength=int(np.prod(shape)))
    if count.min() == 0:
        return None
    before, after = (
        np.stack([np.bincount(flat, part[:, k], len(count)) / count for k in range(3)], axis=-1).reshape(*shape, 3)
        for part in (volume.before_mm, volume.after_mm)
    )
    return VolumeOnGrid((levels[0], levels[1], levels[2]), before, after, u_um)


def resampled(grid: VolumeOnGrid, places_mm: Sequence[FloatArray]) -> list[FloatArray]:
    """Interpolate the errors of each side linearly to another grid (nx, ny, nz, 3), given by its positions along X, Y and Z."""
    found = np.concatenate(grid.sides, axis=-1)
    shrinking = sorted(range(3), key=lambda axis: len(places_mm[axis]) / len(grid.levels_mm[axis]))
    for axis in shrinking:  # the numbers of points that are left are the smallest in this order
        weights = hat_matrix(grid.levels_mm[axis], places_mm[axis])
        found = np.moveaxis(np.tensordot(weights, found, axes=(1, axis)), 0, axis)
    return np.split(found, len(grid.sides), axis=-1)


def projected(position_mm: FloatArray) -> FloatArray:
    """Parallel projection of (..., 3) to the picture (..., 2): X to the right front, Y to the right back, Z up."""
    a, b = np.radians(35.0), np.radians(24.0)
    x, y, z = position_mm[..., 0], position_mm[..., 1], position_mm[..., 2]
    across = np.cos(a) * x + np.sin(a) * y
    away = -np.sin(a) * x + np.cos(a) * y
    return np.stack([across, np.sin(b) * away + np.cos(b) * z], axis=-1)


def nice(value: float) -> float:
    """Return 1, 2 or 5 times a power of ten, not above ``value``.

    >>> [nice(v) for v in (0.7, 1.9, 430.0, 9000.0)]
    [0.5, 1.0, 200.0, 5000.0]
    """
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-12)))


def thousands(value: float) -> str:
    """Return a large number with its thousands separated.

    >>> thousands(2e6).split()
    ['2', '000', '000']
    """
    return f"{value:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def draw_space(grid: VolumeOnGrid, number: int) -> Picture:
    """Return the volume as a grid of lines, enlarged: before, after at the same scale, after at its own scale."""
    longest = max(float(np.ptp(level)) for level in grid.levels_mm)
    known_mm = (grid.u_um or 0.0) * 1e-3
    scales = [
        min(nice(DRAWN_SHARE * longest / max(float(np.linalg.norm(part, axis=-1).max()), floor)), MOST_ENLARGED)
        for part, floor in zip(grid.sides, (1e-9, max(1e-9, known_mm)), strict=False)
    ]
    before_scale, after_scale = scales[0], scales[-1]
    drawn = [list[FloatArray]() for _ in (None, *grid.sides)]
    for axis in range(3):
        places = [
            np.linspace(level[0], level[-1], ALONG if k == axis else LINES) for k, level in enumerate(grid.levels_mm)
        ]
        for found, lines in zip(drawn, (full_grid(places), *resampled(grid, places)), strict=True):
            found.append(np.moveaxis(lines, axis, 2).reshape(-1, ALONG, 3))
    commanded, *moved = (np.concatenate(part) for part in drawn)
    layers = [
        (name, role, projected(commanded + scale * moved[side]))
        for name, role, side, scale in (
            ("before", "before", 0, before_scale), ("after", "after", -1, before_scale), ("own", "c3", -1, after_scale)
        )[: 1 if grid.after_mm is None else 3]
    ]  # fmt: skip
    plot = _space([projected(commanded), *(lines for _, _, lines in layers)])
    grey = projected(commanded[:, [0, -1]])
    plot.line(grey[..., 0], grey[..., 1], "grid", width=0.8)
    for name, role, lines in layers:
        start = len(plot.drawn)
        plot.line(lines[..., 0], lines[..., 1], role, width=1.1)
        plot.layer(name, start)
    # The travel of each axis at the middle of an edge.
    low, high = (np.array([level[end] for level in grid.levels_mm]) for end in (0, -1))
    for axis, corner, anchor, shift in (
        (0, low, "middle", (0, 22)), (1, np.array([high[0], low[1], low[2]]), "start", (14, 14)), (2, low, "end", (-12, 0)),
    ):  # fmt: skip
        place = corner.copy()
        place[axis] = 0.5 * (low[axis] + high[axis])
        text = f"{AXES[axis]} {low[axis]:g} … {high[axis]:g} mm".replace("-", "−")
        x, y = projected(place).tolist()
        plot.text(x, y, text, anchor=anchor, shift=shift)
    title = f"The working volume, errors enlarged {thousands(before_scale)} times"
    if grid.after_mm is not None:
        title = (
            f"The working volume, errors enlarged {thousands(before_scale)} times: before and after; after once more "
            f"{thousands(after_scale)} times"
        )
    data = {"before_scale": before_scale, "after_scale": after_scale}
    key = f"space-{number}"
    return Picture(key, "The volume in space", svg(key, title, [plot], WIDE), data, title)


def _space(points: Sequence[FloatArray]) -> Plot:
    """Return the axes of a picture in space: one scale for both directions, and a margin for texts."""
    left, top, right, bottom = box = (0.0, 0.0, *WIDE)
    flat = np.concatenate([part.reshape(-1, 2) for part in points])
    low, high = np.nanmin(flat, axis=0), np.nanmax(flat, axis=0)
    mm_per_px = max(*(high - low) / (right - left - 170.0, bottom - top - 40.0), 1e-9)
    half = 0.5 * mm_per_px * np.array([right - left, bottom - top])
    (x0, y0), (x1, y1) = 0.5 * (low + high) - half, 0.5 * (low + high) + half
    return Plot((float(x0), float(x1)), (float(y0), float(y1)), box, bare=True)


def draw_slices(grid: VolumeOnGrid, number: int, known: dict[bytes, str]) -> list[Picture]:
    """Return |error| on the three middle planes before and after, all before and all after on one scale of colours.

    ``known`` are the keys of the pictures that the page has of the same numbers: it contains these once.
    """
    pictures = []
    cut = [(axis, *_plane(grid, axis)) for axis in (2, 1, 0)]
    for side, when in zip(range(len(grid.sides)), ("before", "after"), strict=False):
        planes = [(axis, edges, both_um[side]) for axis, edges, both_um in cut]
        top_um = max(float(np.linalg.norm(errors_um, axis=-1).max()) for *_, errors_um in planes) or 1.0
        u_um = grid.u_um if when == "after" else None
        top_um = max(top_um, u_um or 0.0)  # what is smaller than U is not known to be there
        digits = 3 if not u_um else min(3, max(0, 1 - math.floor(math.log10(u_um))))
        for axis, edges, errors_um in planes:
            across, up = (k for k in range(3) if k != axis)
            middle = 0.5 * (grid.levels_mm[axis][0] + grid.levels_mm[axis][-1])
            box = (BOX[0], BOX[1], 200.0, BOX[3])
            x, y = ((float(edges[k][0]), float(edges[k][-1])) for k in (across, up))
            plot = Plot(x, y, box, x_label=f"{AXES[across]} (mm)", y_label=f"{AXES[up]} (mm)")
            length_um = np.linalg.norm(errors_um, axis=-1)
            plot.heat(x, y, length_um / top_um, HEAT)
            key, name = f"slice-{number}-{when}-{axis}", f"{AXES[across]}{AXES[up]} at {AXES[axis]} = {middle:g} mm"
            name = name.replace("-", "−")
            title = f"Length of the error vector in µm, {when}, {name}"
            drawn = svg(key, title, [plot], more=colour_bar(210.0, BOX[1], BOX[3], (0.0, top_um), "µm", HEAT))
            first = known.setdefault(errors_um.tobytes() + bytes([digits]), key)
            cells = {
                "axes": [AXES[across], AXES[up]],
                "cells": [len(edges[across]) - 1, len(edges[up]) - 1],
                "values": rounded(np.round(errors_um.reshape(-1, 3), digits), 3) if first == key else first,
            }
            note = f"{name}, at most {um_text(float(length_um.max()), whole_from=100.0, u_um=u_um)} µm"
            note += f", U {um_text(u_um)} µm" if u_um else ""
            pictures.append(Picture(key, when.capitalize(), drawn, {**plot.data, **cells}, note))
    return pictures


def _plane(grid: VolumeOnGrid, axis: int) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the middle plane across ``axis``: edges of its cells along each axis, mm, and errors (up, across, 3), um."""
    edges = [np.linspace(level[0], level[-1], 2 if k == axis else CELLS + 1) for k, level in enumerate(grid.levels_mm)]
    centres = [0.5 * (part[:-1] + part[1:]) for part in edges]
    return edges, [part.squeeze(axis).swapaxes(0, 1) * 1e3 for part in resampled(grid, centres)]


# Pictures of the measurement: residuals, and stations with their rays.


BINS = 41
#: Rays drawn for each station.
RAYS = 60
#: Histograms: more stations than this are drawn together.
MOST_PANELS = 8


def residual_groups(residuals: ReadingResiduals) -> dict[str, FloatArray]:
    """Return the residuals of the used readings by station, um; all together if they have none or too many."""
    used = residuals.used
    names = np.array(residuals.station)
    stations = list(dict.fromkeys(residuals.station))
    if not stations or len(stations) > MOST_PANELS:
        return {"all stations" if stations else "all readings": residuals.residual_mm[used] * 1e3}
    found = {name: residuals.residual_mm[used & (names == name)] * 1e3 for name in stations}
    return {name: values for name, values in found.items() if len(values)}


def histogram(residuals_um: FloatArray, half_width_um: float) -> tuple[FloatArray, FloatArray]:
    """Return edges in um and counts over -half_width ... +half_width."""
    counts, edges = np.histogram(residuals_um, np.linspace(-half_width_um, half_width_um, BINS + 1))
    return edges, counts.astype(np.float64)


def draw_residuals(residuals: ReadingResiduals) -> list[Picture]:
    """Return a histogram of the residuals of each station, with the normal curve of the same spread."""
    groups = residual_groups(residuals)
    largest = max((float(np.max(np.abs(values))) for values in groups.values() if len(values)), default=0.0)
    pictures: list[Picture] = []
    for k, (name, values_um) in enumerate(groups.items() if largest > 0.0 else ()):
        edges, counts = histogram(values_um, largest)
        spread = float(np.sqrt(np.mean(values_um**2))) or 1.0
        x = np.linspace(-largest, largest, 81)
        area = len(values_um) * float(edges[1] - edges[0])
        normal = area / (spread * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (x / spread) ** 2)
        plot = Plot(
            limits_of(edges, margin=0.02), (0.0, 1.07 * float(max(counts.max(), normal.max()))),
            x_label="residual (µm)", y_label="readings",
        )  # fmt: skip
        plot.bars(edges[:-1], edges[1:], np.zeros(BINS), counts, CYCLE[k % len(CYCLE)])
        plot.line(x, normal, "ink", width=1.0)
        title = f"Residuals of {name}, measurement minus model, in µm"
        note = f"{spread:.3g} µm rms"
        pictures.append(Picture(f"residuals-{k}", name, svg(f"residuals-{k}", title, [plot]), note=note))
    return pictures


def draw_stations(stations: Sequence[Mapping[str, Any]], residuals: ReadingResiduals | None) -> list[Picture]:
    """Return the stations in space with rays to some of their points; nothing if none is known."""
    places = {str(item["station"]): np.array(item["position_mm"], dtype=np.float64) for item in stations}
    if not places:
        return []
    rays: dict[int, FloatArray] = {}
    names = np.array(() if residuals is None else residuals.station)
    for k, (name, place) in enumerate(places.items()):
        if residuals is None or residuals.position_mm is None:
            break
        seen = np.flatnonzero((names == name) & residuals.used)
        picked = residuals.position_mm[
            seen[np.unique(np.linspace(0, len(seen) - 1, RAYS).astype(int))] if len(seen) else seen
        ]
        rays[k] = projected(np.stack([np.broadcast_to(place, picked.shape), picked], axis=1))
    points = projected(np.array(list(places.values())))
    plot = _space([points, *rays.values()])
    for k, lines in rays.items():
        plot.line(lines[..., 0], lines[..., 1], CYCLE[k % len(CYCLE)], width=0.5)
        plot.dots(lines[:, 1, 0], lines[:, 1, 1], "muted", size=2.0)
    for k, (x, y) in enumerate(points.tolist()):
        plot.dots(x, y, CYCLE[k % len(CYCLE)], size=9.0, square=True)
        plot.text(x, y, str(k + 1), shift=(9, -5))
    title = "Stations (squares, numbered as in the table) and some of their rays to the measured points"
    return [Picture("stations", "Stations and rays", svg("stations", title, [plot], WIDE), note=title)]
