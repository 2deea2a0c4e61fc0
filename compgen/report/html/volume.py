"""Pictures of the volume: the moved grid in space before and after, and slices through the middle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.report.html.curves import Picture
from compgen.report.html.folder import Volume
from compgen.report.html.svg import LAYER, colour, frame, new_figure, to_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: The largest displacement is drawn as this share of the longest side of the volume.
DRAWN_SHARE = 0.1
#: Lines of the grid per axis, points along each line, and cells of a slice per side.
LINES, ALONG, CELLS = 5, 21, 24


@dataclass(frozen=True)
class Grid:
    """A volume whose points fill a grid: levels of X, Y, Z in mm, and errors (nx, ny, nz, 3) before and after, mm."""

    levels_mm: tuple[FloatArray, FloatArray, FloatArray]
    before_mm: FloatArray
    after_mm: FloatArray


def grid_of(volume: Volume | None) -> Grid | None:
    """Return the grid that the points of a volume fill; None if they do not.

    Where points stand there several times (both directions of travel) their mean counts.
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
    return Grid((levels[0], levels[1], levels[2]), before, after)


def _at(grid: Grid, field_mm: FloatArray, position_mm: FloatArray) -> FloatArray:
    """Linear interpolation of a field (nx, ny, nz, 3) at positions (..., 3)."""
    from scipy.interpolate import RegularGridInterpolator

    return np.asarray(RegularGridInterpolator(grid.levels_mm, field_mm)(position_mm))


def projected(position_mm: FloatArray) -> FloatArray:
    """Parallel projection of (..., 3) to the picture (..., 2): X to the right front, Y to the right back, Z up."""
    a, b = np.radians(35.0), np.radians(24.0)
    x, y, z = position_mm[..., 0], position_mm[..., 1], position_mm[..., 2]
    across = np.cos(a) * x + np.sin(a) * y
    away = -np.sin(a) * x + np.cos(a) * y
    return np.stack([across, np.sin(b) * away + np.cos(b) * z], axis=-1)


def _lines(grid: Grid) -> FloatArray:
    """Lines of a coarse grid over the volume, shape (3 * LINES**2, ALONG, 3), mm."""
    low, high = np.array([level[0] for level in grid.levels_mm]), np.array([level[-1] for level in grid.levels_mm])
    shares, along = np.linspace(0, 1, LINES), np.linspace(0, 1, ALONG)
    lines = []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for first in shares:
            for second in shares:
                line = np.zeros((ALONG, 3))
                line[:, axis], line[:, others[0]], line[:, others[1]] = along, first, second
                lines.append(low + line * (high - low))
    return np.array(lines)


def nice(value: float) -> float:
    """Return 1, 2 or 5 times a power of ten, not above ``value``.

    >>> [nice(v) for v in (0.7, 1.9, 430.0, 9000.0)]
    [0.5, 1.0, 200.0, 5000.0]
    """
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-12)))


def _scale(grid: Grid, field_mm: FloatArray) -> float:
    longest = max(float(np.ptp(level)) for level in grid.levels_mm)
    largest = float(np.max(np.linalg.norm(field_mm, axis=-1)))
    return nice(DRAWN_SHARE * longest / max(largest, 1e-9))


def draw_space(grid: Grid, number: int) -> Picture:
    """Return the volume as a grid of lines, enlarged: before, after at the same scale, after at a scale of its own."""
    lines = _lines(grid)
    before_scale, after_scale = _scale(grid, grid.before_mm), _scale(grid, grid.after_mm)
    figure = new_figure(420, 300)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.96))
    axes.set_axis_off()
    axes.set_aspect("equal")
    _polylines(axes, lines, "grid", 0.5, None)
    _polylines(axes, lines + before_scale * _at(grid, grid.before_mm, lines), "before", 0.8, "before")
    after = _at(grid, grid.after_mm, lines)
    _polylines(axes, lines + before_scale * after, "after", 0.8, "after")
    _polylines(axes, lines + after_scale * after, "c3", 0.8, "own")
    _name_axes(axes, grid)
    axes.autoscale_view()
    often, more = (f"{scale:,.0f}".replace(",", " ") for scale in (before_scale, after_scale))
    title = f"The working volume, errors enlarged {often} times: before and after; after once more {more} times"
    data = {"before_scale": before_scale, "after_scale": after_scale}
    return Picture(f"space-{number}", "The volume in space", to_svg(figure, f"space-{number}", title), data, title)


def _polylines(axes: Axes, lines: FloatArray, role: str, width: float, layer: str | None) -> None:
    """Draw lines (m, n, 3) as one path."""
    flat = projected(lines)
    gap = np.full((len(flat), 1, 2), np.nan)
    path = np.concatenate([flat, gap], axis=1).reshape(-1, 2)
    drawn = axes.plot(path[:, 0], path[:, 1], color=colour(role), linewidth=width, solid_joinstyle="round")
    if layer:
        drawn[0].set_gid(LAYER + layer)


def _name_axes(axes: Axes, grid: Grid) -> None:
    low, high = np.array([level[0] for level in grid.levels_mm]), np.array([level[-1] for level in grid.levels_mm])
    middle = 0.5 * (low + high)
    places = (
        (0, np.array([middle[0], low[1], low[2]])),
        (1, np.array([high[0], middle[1], low[2]])),
        (2, np.array([low[0], low[1], middle[2]])),
    )
    for axis, place in places:
        x, y = projected(place)
        text = f"{AXES[axis]} {low[axis]:g} … {high[axis]:g} mm".replace("-", "−")
        offset = ((0, -14), (10, -12), (-8, 0))[axis]
        align = ("center", "left", "right")[axis]
        axes.annotate(text, (x, y), xytext=offset, textcoords="offset points", ha=align, va="center", fontsize=8)


def draw_slices(grid: Grid, number: int) -> Picture:
    """Return |error| on the three middle planes, before above after, each row on a scale of its own."""
    figure = new_figure(620, 330)
    data: dict[str, Any] = {"slices": []}
    for row, (when, field_mm) in enumerate((("before", grid.before_mm), ("after", grid.after_mm))):
        planes = [_slice(grid, field_mm, axis) for axis in (2, 1, 0)]
        top_um = max(float(np.max(np.linalg.norm(plane[2], axis=-1))) for plane in planes) * 1e3 or 1.0
        for column, plane in enumerate(planes):
            axes = figure.add_axes((0.085 + 0.292 * column, 0.575 - 0.475 * row, 0.215, 0.345))
            image = _draw_slice(axes, plane, top_um)
            axes.set_title(f"{plane[3]}, {when}", fontsize=8, pad=3)
            data["slices"].append(_slice_data(axes, plane))
        bar = figure.add_axes((0.915, 0.575 - 0.475 * row, 0.014, 0.345))
        figure.colorbar(image, cax=bar).set_label("µm", labelpad=1)
        bar.grid(visible=False)
    title = (
        "Length of the error vector in µm on the three middle planes: before above, after below, on scales of their own"
    )
    svg = to_svg(figure, f"slices-{number}", title)
    return Picture(f"slices-{number}", "Slices through the middle", svg, data, title)


Plane = tuple[tuple[int, int], tuple[FloatArray, FloatArray], FloatArray, str]


def _slice(grid: Grid, field_mm: FloatArray, axis: int) -> Plane:
    """The middle plane across ``axis``: axes across and up, their positions (CELLS,), errors (CELLS, CELLS, 3), name."""
    across, up = (k for k in range(3) if k != axis)
    lines = [np.linspace(level[0], level[-1], CELLS + 1) for level in grid.levels_mm]
    centres = [0.5 * (line[:-1] + line[1:]) for line in lines]
    middle = 0.5 * (grid.levels_mm[axis][0] + grid.levels_mm[axis][-1])
    where = np.zeros((CELLS, CELLS, 3))
    where[..., across], where[..., up] = np.meshgrid(centres[across], centres[up])
    where[..., axis] = middle
    name = f"{AXES[across]}{AXES[up]} at {AXES[axis]} = {middle:g} mm"
    return (across, up), (centres[across], centres[up]), _at(grid, field_mm, where), name


def _draw_slice(axes: Axes, plane: Plane, top_um: float) -> Any:
    (across, up), (x, y), errors_mm, _ = plane
    half_x, half_y = 0.5 * float(x[1] - x[0]), 0.5 * float(y[1] - y[0])
    extent = (float(x[0]) - half_x, float(x[-1]) + half_x, float(y[0]) - half_y, float(y[-1]) + half_y)
    size_um = np.linalg.norm(errors_mm, axis=-1) * 1e3
    image = axes.imshow(
        size_um,
        origin="lower",
        extent=extent,
        aspect="auto",
        cmap="cividis",
        vmin=0.0,
        vmax=top_um,
        interpolation="none",
    )
    axes.grid(visible=False)
    axes.locator_params(nbins=4)
    axes.set_xlabel(f"{AXES[across]} (mm)", labelpad=1)
    axes.set_ylabel(f"{AXES[up]} (mm)", labelpad=1)
    return image


def _slice_data(axes: Axes, plane: Plane) -> dict[str, Any]:
    (across, up), (x, y), errors_mm, name = plane
    values = [[float(f"{v:.3g}") for v in row] for row in (errors_mm.reshape(-1, 3) * 1e3).tolist()]
    ends = [float(x[0]), float(x[-1]), float(y[0]), float(y[-1])]
    return {
        "frame": frame(axes),
        "axes": [AXES[across], AXES[up]],
        "ends": ends,
        "cells": CELLS,
        "values": values,
        "name": name,
    }
