"""Pictures of errors, tables, volume and measurement as SVG."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup, escape

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.names import AXES, COVERAGE, CURVE_NAMES, error_named
from compgen.report.html.folder import ReadingResiduals, TableCurve, Volume

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Figures of matplotlib as SVG inside a page: colours by role as CSS variables, text as text, ids of their own.


#: What a colour is for. The style sheet gives each role its colour, one for light and one for dark pages.
ROLES = ("ink", "muted", "grid", "line", "band", "fit", "table", "before", "after", "c0", "c1", "c2", "c3", "c4", "c5")
#: Roles of lines that are drawn next to each other.
CYCLE = ("c0", "c1", "c2", "c3", "c4", "c5")
#: Colours that mark roles while a figure is drawn; no picture uses them otherwise.
_FIRST = 0x010200

#: Prefix of the gid of a group that the page can show and hide.
LAYER = "layer-"

_NUMBER = re.compile(r"(-?\d+\.\d\d)\d+")
_FAMILY = re.compile(r"font-family: [^;\"]*;? ?")
_IMAGE_ID = re.compile(r' id="image[0-9a-f]+"')
_ID = re.compile(r'\bid="([^"]+)"')
_LINK = re.compile(r'(url\(#|href="#)')
_LAYER_ID = re.compile(rf'id="[^"]*?({LAYER}[a-z0-9-]+?)(?:_\d+)?"')


def colour(role: str) -> str:
    """Return the colour that marks a role while a figure is drawn."""
    return f"#{_FIRST + ROLES.index(role):06x}"


@contextmanager
def drawing() -> Iterator[None]:
    """Settings of matplotlib for the pictures of the report; restored afterwards."""
    import matplotlib

    settings: dict[Any, Any] = {
        "svg.fonttype": "none",
        "svg.hashsalt": "compgen",
        "text.parse_math": False,
        "font.size": 8.0,
        "axes.linewidth": 0.6,
        "axes.edgecolor": colour("muted"),
        "axes.labelcolor": colour("ink"),
        "axes.facecolor": "none",
        "figure.facecolor": "none",
        "text.color": colour("ink"),
        "xtick.color": colour("muted"),
        "ytick.color": colour("muted"),
        "xtick.labelcolor": colour("ink"),
        "ytick.labelcolor": colour("ink"),
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "grid.color": colour("grid"),
        "grid.linewidth": 0.5,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "lines.linewidth": 1.2,
        "axes.unicode_minus": True,
        "image.composite_image": False,
    }
    with matplotlib.rc_context(settings):
        yield


def new_figure(width_pt: float, height_pt: float) -> Figure:
    """Return an empty figure of the given size in points; no window system is involved."""
    from matplotlib.figure import Figure as MatplotlibFigure

    return MatplotlibFigure(figsize=(width_pt / 72.0, height_pt / 72.0))


def to_svg(figure: Figure, key: str, title: str) -> Markup:
    """Return a figure as SVG markup for a page.

    Parameters
    ----------
    figure : drawn with the colours of :func:`colour`.
    key : unique on the page; put before every id.
    title : what the picture shows, for readers that do not see it.
    """
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r"<defs>\s*</defs>", "", text)
    text = _LAYER_ID.sub(lambda found: f'class="layer {found.group(1)}"', text)
    text = _IMAGE_ID.sub("", text)
    text = _ID.sub(rf'id="{key}-\1"', text)
    text = _LINK.sub(rf"\g<1>{key}-", text)
    text = _FAMILY.sub("", text)
    text = _NUMBER.sub(r"\1", text).replace(" \n", " ").replace("\n  ", "\n")
    for role in ROLES:
        text = text.replace(colour(role), f"var(--{role})")
    head = re.search(r'viewBox="[^"]+"', text)
    box = head.group(0) if head else ""
    body = text[text.index(">", text.index("<svg")) + 1 :]
    opening = f'<svg class="plot" {box} role="img" aria-labelledby="{key}-title"><title id="{key}-title">'
    return Markup(opening + str(escape(title)) + "</title>" + re.sub(r"\n\s*", "\n", body))


def frame(axes: Axes) -> list[float]:
    """Return where the axes are in the picture, in its own units: left, top, right, bottom."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    width, height = (72.0 * side for side in figure.get_size_inches())
    box = axes.get_position()
    return [round(v, 2) for v in (box.x0 * width, (1 - box.y1) * height, box.x1 * width, (1 - box.y0) * height)]


def limits(axes: Axes) -> list[float]:
    """Return the limits of the axes: left, right, bottom, top, in the units of the data."""
    return [*map(float, axes.get_xlim()), *map(float, axes.get_ylim())]


def rounded(values: Sequence[float], digits: int = 4) -> list[float | None]:
    """Return numbers with ``digits`` significant digits for the page's data; None for what is not a number."""
    return [float(f"{value:.{digits}g}") if value == value else None for value in values]


# Pictures of the 21 errors: identified with their uncertainty, smoothed, and as the tables hold them.


SIZE_PT = (250.0, 150.0)
LABEL = {"um": "µm", "urad": "µrad"}


@dataclass(frozen=True)
class CurveSeries:
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
) -> list[CurveSeries]:
    """Return what is drawn of one error in its file's unit: identified, smoothed, and each control that holds it so."""
    scale = 1.0 / error_named(name).si_per_unit
    curve = identified.curves[name]
    found = [CurveSeries("identified", curve.position_mm, curve.value * scale, curve.u * scale)]
    if fitted is not None and name in fitted.curves:
        smooth = fitted.curves[name]
        found.append(CurveSeries("smoothed", smooth.position_mm, smooth.value * scale))
    for control, curves in tables.items():
        found += [CurveSeries(f"table {control}", t.position_mm, t.value) for t in curves if t.error and t.name == name]
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

    def draw(self, name: str, series: Sequence[CurveSeries]) -> Picture:
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

    def _draw_identified(self, item: CurveSeries) -> list[Artist]:
        x, y, u = item.position_mm, item.value, item.u
        drawn: list[Artist] = []
        if u is not None and np.isfinite(u).all():
            band = self.axes.fill_between(x, y - COVERAGE * u, y + COVERAGE * u, color=colour("band"), linewidth=0)
            drawn.append(band)
        style = {"marker": "o", "markersize": 2.4} if len(x) <= 40 else {}
        return [*drawn, *self.axes.plot(x, y, color=colour("line"), **style)]  # type: ignore[arg-type]

    def _draw_other(self, item: CurveSeries) -> list[Artist]:
        if item.name == "smoothed":
            return [*self.axes.plot(item.position_mm, item.value, color=colour("fit"), linestyle=(0, (4, 2)))]
        number = self.controls.index(item.name.removeprefix("table "))
        dots = self.axes.plot(
            item.position_mm, item.value, color=colour("table"), linestyle="none", marker="x", markersize=4
        )
        dots[0].set_gid(f"{LAYER}control-{number}")
        return [*dots]

    def _limit(self, series: Sequence[CurveSeries]) -> None:
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
        "series": [CurveSeries(c.name, c.position_mm, c.value).data() for c in group],
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


# Pictures of the volume: the moved grid in space before and after, and slices through the middle.


#: The largest displacement is drawn as this share of the longest side of the volume.
DRAWN_SHARE = 0.1
#: Lines of the grid per axis, points along each line, and cells of a slice per side.
LINES, ALONG, CELLS = 5, 21, 24


@dataclass(frozen=True)
class VolumeOnGrid:
    """A volume whose points fill a grid: levels of X, Y, Z in mm, and errors (nx, ny, nz, 3) before and after, mm."""

    levels_mm: tuple[FloatArray, FloatArray, FloatArray]
    before_mm: FloatArray
    after_mm: FloatArray


def grid_of(volume: Volume | None) -> VolumeOnGrid | None:
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
    return VolumeOnGrid((levels[0], levels[1], levels[2]), before, after)


def _at(grid: VolumeOnGrid, field_mm: FloatArray, position_mm: FloatArray) -> FloatArray:
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


def _lines(grid: VolumeOnGrid) -> FloatArray:
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


def _scale(grid: VolumeOnGrid, field_mm: FloatArray) -> float:
    longest = max(float(np.ptp(level)) for level in grid.levels_mm)
    largest = float(np.max(np.linalg.norm(field_mm, axis=-1)))
    return nice(DRAWN_SHARE * longest / max(largest, 1e-9))


def draw_space(grid: VolumeOnGrid, number: int) -> Picture:
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


def _name_axes(axes: Axes, grid: VolumeOnGrid) -> None:
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


def draw_slices(grid: VolumeOnGrid, number: int) -> Picture:
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


def _slice(grid: VolumeOnGrid, field_mm: FloatArray, axis: int) -> Plane:
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


# Pictures of the measurement: residuals, and stations with their rays.


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
