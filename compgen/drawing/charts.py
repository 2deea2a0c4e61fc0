"""Charts as SVG for pages: axes with round numbers, lines, points, bands, bars and heat maps.

A page needs no plotting library, prints well and can be read without a script. Coordinates are those of the data;
:class:`Plot` maps them to the picture. Colours are roles (``line``, ``before`` ...): CSS variables with a light and a dark
value in the style sheet ``templates/_report/style.css``. ``templates/_report/charts.js`` adds zoom to every element of
the class ``axes``.
"""

from __future__ import annotations

import base64
import hashlib
import math
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from html import unescape
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import ArrayLike, NDArray

from compgen.resources import data_folder
from compgen.units import Inch, factor_of, unit_in

#: Roles of colours.
ROLES = ("ink", "muted", "grid", "line", "band", "fit", "table", "before", "after", "c0", "c1", "c2", "c3", "c4", "c5")
#: Roles of lines in one picture.
CYCLE = ("c0", "c1", "c2", "c3", "c4", "c5")
#: Units as written on pages.
LABEL = {"um": "µm", "urad": "µrad"}
#: Width and height of a picture and the part for the axes (left, top, right, bottom), for pages with several pictures
#: in a row. All have the same width, hence text of the same size.
SIZE, BOX = (250.0, 150.0), (46.0, 10.0, 243.0, 121.0)
FONT = 9.0
DASHED, DOTTED = "5 3", "2 2"
#: Colours of heat maps from the smallest to the largest value: cividis, uniform in brightness for any kind of colour
#: vision (Nunez, Anderton and Renslow 2018).
HEAT = ("00224e", "1a386f", "434e6c", "61656f", "7d7c78", "9b9476", "bcae6c", "dec958", "fee838")
#: Colours from negative over zero to positive (Moreland 2009).
DIVERGING = ("3b4cc0", "8db0fe", "dddcdc", "f4987a", "b40426")
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Picture:
    """A drawn picture: markup, heading, a note, and the data for the script of the page."""

    key: str
    title: str
    svg: Markup
    data: Mapping[str, Any] = field(default_factory=dict)
    note: str = ""


def ticks(low: float, high: float, count: int = 5, *, around: bool = False) -> list[float]:
    """Return round numbers within the interval, about ``count``: steps of 1, 2 or 5 times a power of ten.

    ``around`` the interval instead: the first at or below it, the last at or above it; also where it has no length.

    >>> ticks(-3.0, 11.0), ticks(-3.0, 11.0, around=True)
    ([-2.0, 0.0, 2.0, 4.0, 6.0, 8.0, 10.0], [-5.0, 0.0, 5.0, 10.0, 15.0])
    """
    if around and not high > low:
        low, high = low - 0.5 * max(abs(low), 1.0), high + 0.5 * max(abs(high), 1.0)
    raw = (high - low) / count or 1.0
    power = 10.0 ** math.floor(math.log10(raw))
    least = raw * (0.999 if around else 0.7)
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least)
    if around:
        first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    else:
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def tick_texts(values: Sequence[float]) -> list[str]:
    """Return the numbers of ticks, all with as many decimals as their step needs.

    >>> tick_texts([0.0, 0.5, 1.0]), tick_texts([-2000.0, 0.0])
    (['0.0', '0.5', '1.0'], ['−2000', '0'])
    """
    step = min((abs(b - a) for a, b in zip(values, values[1:], strict=False)), default=0.0) or 1.0
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return [f"{value + 0.0:.{decimals}f}".replace("-", "−") for value in values]


def limits_of(*values: ArrayLike, margin: float = 0.07, zero: bool = False) -> tuple[float, float]:
    """Return the limits of an axis that shows all finite values, and zero if requested, with a margin."""
    known = np.concatenate([np.ravel(np.asarray(part, dtype=np.float64)) for part in (*values, [0.0] * zero)])
    known = known[np.isfinite(known)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    spare = margin * (high - low) or max(1.0, 0.1 * abs(high))
    return low - spare, high + spare


class Plot:
    """Axes in a picture: a rectangle ``box`` (left, top, right, bottom) of it with limits in units of the data.

    Ticks are (value, text); without them round numbers are chosen, and the axes can be zoomed. ``bare`` axes have
    neither ticks nor lines.
    """

    def __init__(
        self,
        x: tuple[float, float],
        y: tuple[float, float],
        box: tuple[float, float, float, float] = BOX,
        *,
        x_label: str = "",
        y_label: str = "",
        title: str = "",
        x_ticks: Sequence[tuple[float, str]] | None = None,
        y_ticks: Sequence[tuple[float, str]] | None = None,
        bare: bool = False,
    ) -> None:
        self.x, self.y, self.box, self.bare = x, y, box, bare
        self.labels, self.ticks = (x_label, y_label, title), (x_ticks, y_ticks)
        self.drawn: list[str] = []

    @property
    def data(self) -> dict[str, Any]:
        """Place of the axes in the picture, their limits and the units of these, for the script of the page."""
        found = {"frame": list(self.box), "limits": [*self.x, *self.y]}
        return found if self.bare else {**found, "units": [unit_in(label) for label in self.labels[:2]]}

    def _px(self, x: ArrayLike, y: ArrayLike) -> tuple[Values, Values]:
        (x0, x1), (y0, y1), (left, top, right, bottom) = self.x, self.y, self.box
        across = left + (np.asarray(x, dtype=np.float64) - x0) / (x1 - x0) * (right - left)
        return across, bottom - (np.asarray(y, dtype=np.float64) - y0) / (y1 - y0) * (bottom - top)

    def _stroke(self, path: str, role: str, width: float, more: str = "") -> None:
        # Lines keep their width when the picture or its axes are enlarged.
        self.drawn.append(
            f'<path d="{path}" fill="none" vector-effect="non-scaling-stroke" '
            f'style="stroke:var(--{role});stroke-width:{width:g}{more}"/>'
        )

    def line(self, x: ArrayLike, y: ArrayLike, role: str, *, width: float = 1.5, dash: str = "") -> None:
        """Draw a line through points (n,), with gaps where a value is not finite; or m lines (m, n)."""
        px, py = self._px(x, y)
        if px.ndim == 1:
            whole = np.isfinite(px + py)
            runs = np.split(np.arange(len(px)), np.flatnonzero(~whole))
            path = "".join(_path(px[run], py[run]) for run in (run[whole[run]] for run in runs) if len(run) > 1)
        else:
            path = _path(px, py)
        self._stroke(path, role, width, f";stroke-dasharray:{dash}" if dash else "")

    def dots(self, x: ArrayLike, y: ArrayLike, role: str, *, size: float = 4.0, square: bool = False) -> None:
        """Draw round or square points."""
        px, py = (np.ravel(part) for part in np.broadcast_arrays(*self._px(x, y)))
        known = np.isfinite(px + py)
        # A line without length with round or square ends: it keeps its shape when one axis is stretched.
        path = "".join(f"M{a:.2f} {b:.2f}h0" for a, b in zip(px[known].tolist(), py[known].tolist(), strict=True))
        self._stroke(path, role, size, f";stroke-linecap:{'square' if square else 'round'}")

    def spread(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, role: str, *, width: float = 1.0) -> None:
        """Draw vertical lines from ``low`` to ``high``, the uncertainty of points."""
        px, bottom = self._px(x, low)
        _, top = self._px(x, high)
        rows = np.column_stack([px, bottom, top])
        rows = rows[np.isfinite(rows).all(axis=1)].tolist()
        self._stroke("".join(f"M{a:.2f} {b:.2f}V{c:.2f}" for a, b, c in rows), role, width)

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, role: str = "band") -> None:
        """Fill between two lines."""
        px, bottom = self._px(x, low)
        _, top = self._px(x, high)
        path = _path(np.concatenate([px, px[::-1]]), np.concatenate([bottom, top[::-1]]))
        self.drawn.append(f'<path d="{path}Z" style="fill:var(--{role})"/>')

    def bars(self, left: ArrayLike, right: ArrayLike, low: ArrayLike, high: ArrayLike, role: str) -> None:
        """Fill rectangles."""
        (x0, y0), (x1, y1) = self._px(left, low), self._px(right, high)
        rows = np.column_stack(np.broadcast_arrays(*map(np.ravel, (x0, y0, x1, y1)))).tolist()
        path = "".join(f"M{a:.2f} {b:.2f}H{c:.2f}V{d:.2f}H{a:.2f}Z" for a, b, c, d in rows)
        self.drawn.append(f'<path d="{path}" style="fill:var(--{role})"/>')

    def across(self, value: float, role: str = "muted", *, width: float = 0.9, dash: str = "") -> None:
        """Draw a horizontal line."""
        self.line(self.x, (value, value), role, width=width, dash=dash)

    def upright(self, value: float, role: str = "muted", *, width: float = 0.9, dash: str = "") -> None:
        """Draw a vertical line."""
        self.line((value, value), self.y, role, width=width, dash=dash)

    def heat(self, x: tuple[float, float], y: tuple[float, float], shares: Values, colours: Sequence[str]) -> None:
        """Fill a rectangle with cells; ``shares`` (rows from ``y[0]`` up, columns) are 0 for the first colour, 1 the last."""
        (left, right), (bottom, top) = self._px(x, y)
        rgb = _colours(shares[::-1], colours)
        png = _png(rgb.tobytes(), rgb.shape[1])
        self.drawn.append(
            f'<image x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}" height="{bottom - top:.2f}" '
            f'preserveAspectRatio="none" style="image-rendering:pixelated" '
            f'href="data:image/png;base64,{png}"/>'
        )

    def coloured_dots(self, x: Values, y: Values, shares: Values, colours: Sequence[str], size: float = 3.0) -> None:
        """Draw points (n,) in the colours of a scale."""
        steps = 16
        index = np.rint(np.clip(shares, 0.0, 1.0) * steps).astype(int)
        found = _colours(np.arange(steps + 1) / steps, colours)
        for k in sorted(range(steps + 1), key=lambda k: abs(k - steps / 2)):  # the ends of the scale are on top
            rgb = found[k]
            if (index == k).any():
                self.dots(x[index == k], y[index == k], "ink", size=size)
                self.drawn[-1] = self.drawn[-1].replace("var(--ink)", "#" + bytes(rgb.tolist()).hex())

    def text(
        self,
        x: float,
        y: float,
        text: str,
        *,
        anchor: str = "start",
        shift: tuple[float, float] = (0, 0),
        unit: str = "",
    ) -> None:
        """Write a text at a point, moved by ``shift`` units of the picture; ``unit`` is that of bare numbers in it."""
        px, py = self._px(x, y)
        more = f' data-unit="{unit}"' if unit else ""
        self.drawn.append(_text(float(px) + shift[0], float(py) + shift[1], text, anchor, more))

    def layer(self, name: str, start: int) -> None:
        """Turn what was drawn since ``start`` (an earlier ``len(drawn)``) into a layer that the page can show and hide."""
        self.drawn[start:] = [f'<g class="layer layer-{name}">', *self.drawn[start:], "</g>"]

    def markup(self) -> str:
        """Return the SVG of the axes and of what was drawn on them."""
        left, top, right, bottom = self.box
        x_label, y_label, title = self.labels
        head = ' data-bare="1"' if self.bare else ' data-fixed="1"' if any(self.ticks) else ""
        head += _numbers_of_axes(self.box, (*self.x, *self.y))
        if not self.bare:
            auto = [name if given is None else "" for name, given in zip(self.data["units"], self.ticks, strict=True)]
            head += f' data-units="{",".join(self.data["units"])}" data-scaled="{",".join(auto)}"'
        size = f'x="{left:g}" y="{top:g}" width="{right - left:g}" height="{bottom - top:g}"'
        view = f'viewBox="{left:g} {top:g} {right - left:g} {bottom - top:g}"'
        parts = [f'<g class="axes"{head}>', *([] if self.bare else [f'<g class="scale">{self._scale()}</g>'])]
        # A nested svg clips what is outside its box.
        parts += [f'<svg {size} {view} preserveAspectRatio="none"><g class="drawn">', *self.drawn, "</g></svg>"]
        if x_label:
            parts.append(_text(0.5 * (left + right), bottom + 2.6 * FONT, x_label, "middle"))
        if y_label:
            parts.append(
                _text(
                    8.0, 0.5 * (top + bottom), y_label, "middle", f' transform="rotate(-90 8 {(top + bottom) / 2:g})"'
                )
            )
        if title:
            parts.append(_text(0.5 * (left + right), top - 3.0, title, "middle"))
        return "".join([*parts, "</g>"])

    def _scale(self) -> str:
        """Grid, ticks with their numbers, and the lines left and below."""
        left, top, right, bottom = self.box
        x_ticks, y_ticks = (
            _labelled(given, limits, room)
            for given, limits, room in zip(self.ticks, (self.x, self.y), _rooms(self.box), strict=True)
        )
        across = [(float(self._px(value, self.y[0])[0]), text) for value, text in x_ticks]
        up = [(float(self._px(self.x[0], value)[1]), text) for value, text in y_ticks]
        return (
            f'<path d="{_grid_across(self.box, across)}{_grid_up(self.box, up)}" fill="none" '
            'style="stroke:var(--grid);stroke-width:.6"/>'
            f'<path d="M{left:g} {top:g}V{bottom:g}H{right:g}" fill="none" style="stroke:var(--muted);stroke-width:.7"/>'
            + _texts_across(self.box, across)
            + _texts_up(self.box, up)
        )


Box = tuple[float, float, float, float]


def _rooms(box: Box) -> tuple[float, float]:
    """How many ticks the two axes have room for."""
    return (box[2] - box[0]) / 40, (box[3] - box[1]) / 24


def _numbers_of_axes(box: Sequence[float], limits: Sequence[float]) -> str:
    """Attributes with the place of axes in the picture, and their limits."""
    return "".join(
        f' data-{key}="{" ".join(f"{v:.9g}" for v in part)}"' for key, part in (("frame", box), ("limits", limits))
    )


def _grid_across(box: Box, places: Sequence[tuple[float, str]]) -> str:
    return "".join(f"M{a:.1f} {box[1]:g}V{box[3]:g}" for a, _ in places)


def _grid_up(box: Box, places: Sequence[tuple[float, str]]) -> str:
    return "".join(f"M{box[0]:g} {b:.1f}H{box[2]:g}" for b, _ in places)


def _texts_across(box: Box, places: Sequence[tuple[float, str]]) -> str:
    return "".join(_text(a, box[3] + 1.2 * FONT, text, "middle") for a, text in places)


def _texts_up(box: Box, places: Sequence[tuple[float, str]]) -> str:
    return "".join(_text(box[0] - 4.0, b + 0.35 * FONT, text, "end") for b, text in places)


# Pictures in other units: what is drawn stays, the numbers of its axes become round ones of the unit that is shown.

_AXES = re.compile(
    r'(?P<head><g class="axes"[^>]*? data-frame=")(?P<frame>[^"]*)(?P<mid>" data-limits=")(?P<limits>[^"]*)'
    r'(?P<tail>" data-units="[^"]*" data-scaled="(?P<scaled>[^"]*)"[^>]*><g class="scale">)(?P<scale>.*?)(?P<end></g>)'
)
_BAR = re.compile(r'(<g class="bar" data-frame="([^"]*)" data-limits="([^"]*)" data-units="([^"]*)">).*?(</g>)')
_SVG_TEXT = re.compile(r"(<text(?P<head>[^>]*)>)(?P<text>[^<]*)(?=</text>)")


def rescaled(svg: str, inch: Inch) -> str:
    """Return a finished picture with its axes, scales of colours and texts in inch."""
    kept: list[str] = []  # numbers of axes, which are no texts that state a unit

    def keep(markup: str) -> str:
        kept.append(markup)
        return f"\0{len(kept) - 1}\0"

    def axes(found: re.Match[str]) -> str:
        box, limits = (tuple(map(float, found[key].split())) for key in ("frame", "limits"))
        x, y = (factor_of(name) for name in found["scaled"].split(","))
        given = [value * by for value, by in zip(limits, (x, x, y, y), strict=True)]
        scale = _scale_of(found["scale"], box, given, [bool(name) for name in found["scaled"].split(",")])  # type: ignore[arg-type]
        stated = " ".join(f"{value:.9g}" for value in given)
        return f"{found['head']}{found['frame']}{found['mid']}{stated}{found['tail']}{keep(scale)}{found['end']}"

    def bar(found: re.Match[str]) -> str:
        left, top, bottom = map(float, found[2].split())
        limits = [float(value) * factor_of(found[4]) for value in found[3].split()]
        return found[1] + keep(_bar_numbers(left, top, bottom, (limits[0], limits[1]))) + found[5]

    def text(found: re.Match[str]) -> str:
        stated = re.search(r'data-unit="(\w+)"', found["head"])
        plain = unescape(found["text"])
        return f"{found[1]}{escape(inch.numbers(plain, stated[1]) if stated else inch.text(plain))}"

    made = _SVG_TEXT.sub(text, _BAR.sub(bar, _AXES.sub(axes, svg)))
    made = re.sub(
        r"(<title[^>]*>)([^<]*)", lambda found: f"{found[1]}{escape(inch.text(unescape(found[2])))}", made, count=1
    )
    return re.sub("\0(\\d+)\0", lambda found: kept[int(found[1])], made)


def _scale_of(scale: str, box: Box, limits: Sequence[float], fresh: Sequence[bool]) -> str:
    """Return the markup of ticks with round numbers between other limits; axes that are not ``fresh`` keep theirs."""
    path = re.match(r'<path d="([^"]*)"', scale)
    assert path is not None
    grid, texts = re.findall(r"M[\d.-]+ [\d.-]+[VH][\d.-]+", path[1]), re.findall(r"<text.*?</text>", scale)
    parts = []
    for axis, (letter, anchor) in enumerate((("V", "middle"), ("H", "end"))):
        low, high = limits[2 * axis : 2 * axis + 2]
        lines, numbers = [part for part in grid if letter in part], [part for part in texts if f'"{anchor}"' in part]
        if fresh[axis]:
            ends = (box[0], box[2]) if axis == 0 else (box[3], box[1])
            places = [
                (ends[0] + (value - low) / (high - low) * (ends[1] - ends[0]), shown)
                for value, shown in _labelled(None, (low, high), _rooms(box)[axis])
            ]
            lines = [(_grid_across, _grid_up)[axis](box, places)]
            numbers = [(_texts_across, _texts_up)[axis](box, places)]
        parts.append(("".join(lines), "".join(numbers)))
    rest = re.sub(r"<text.*?</text>", "", scale[path.end() :])
    return f'<path d="{"".join(lines for lines, _ in parts)}"{rest}{"".join(numbers for _, numbers in parts)}'


def svg(key: str, title: str, plots: Sequence[Plot], size: tuple[float, float] = SIZE, more: str = "") -> Markup:
    """Return the markup of a picture.

    Parameters
    ----------
    key : unique on the page; put before every id.
    title : contents of the picture, for screen readers.
    more : additional SVG, e.g. of :func:`legend`.
    """
    head = f'<svg class="plot" viewBox="0 0 {size[0]:g} {size[1]:g}" font-size="{FONT:g}" role="img"'
    return Markup(
        f'{head} aria-labelledby="{key}-title"><title id="{key}-title">{escape(title)}</title>'
        + "".join(plot.markup() for plot in plots)
        + more
        + "</svg>"
    )


def legend(left: float, top: float, names: Sequence[tuple[str, str]]) -> str:
    """Return a list of (role, text) with a point each, as SVG."""
    return "".join(
        f'<circle cx="{left:g}" cy="{top + 12 * k - 3:g}" r="2.6" style="fill:var(--{role})"/>'
        + _text(left + 6.0, top + 12 * k, text, "start")
        for k, (role, text) in enumerate(names)
    )


def colour_bar(
    left: float, top: float, bottom: float, limits: tuple[float, float], label: str, colours: Sequence[str]
) -> str:
    """Return an upright scale of colours with round numbers and their unit, as SVG."""
    bar = Plot((0.0, 1.0), limits, (left, top, left + 8.0, bottom), bare=True)
    bar.heat((0.0, 1.0), limits, np.linspace(0.0, 1.0, 32)[:, None], colours)
    stated = f'data-frame="{left:g} {top:g} {bottom:g}" data-limits="{limits[0]:.9g} {limits[1]:.9g}"'
    numbers = f'<g class="bar" {stated} data-units="{unit_in(label)}">{_bar_numbers(left, top, bottom, limits)}</g>'
    # Only an image of the bar: it has no axes to zoom.
    return "".join(bar.drawn) + numbers + _text(left + 4.0, top - 3.0, label, "middle")


def _bar_numbers(left: float, top: float, bottom: float, limits: tuple[float, float]) -> str:
    """The round numbers beside a scale of colours."""
    marks = _labelled(None, limits, (bottom - top) / 24)
    places = [(bottom - (value - limits[0]) / (limits[1] - limits[0]) * (bottom - top), text) for value, text in marks]
    return "".join(_text(left + 11.0, place + 0.35 * FONT, text, "start") for place, text in places)


def picture_grid(pictures: Sequence[Picture], kind: str = "") -> str:
    """Return pictures as HTML, side by side if there is room; ``kind`` is "wide" for the full width of the page."""
    return '<div class="grid">{}</div>'.format(
        "\n".join(
            f'<figure class="picture {kind}" id="figure-{item.key}" tabindex="0"><figcaption>{escape(item.title)} '
            f'<span class="note">{escape(item.note)}</span></figcaption><div class="canvas">{item.svg}</div></figure>'
            for item in pictures
        )
    )


def page_assets(*scripts: str) -> tuple[Markup, Markup, str]:
    """Return style sheet, script and content security policy of a page in one file that fetches nothing."""
    folder = data_folder("templates") / "_report"
    style, script = (folder / "style.css").read_text("utf-8"), "".join((folder / n).read_text("utf-8") for n in scripts)
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    if scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        policy += f"; script-src 'sha256-{digest}'"
    return Markup(style), Markup(script), policy


def rounded(values: ArrayLike, digits: int = 4) -> list[Any]:
    """Return numbers with ``digits`` significant digits for the data of a page; None for non-numbers.

    >>> rounded([0.0, 123.456, -0.0012344, float("nan")])
    [0.0, 123.5, -0.001234, None]
    """
    numbers = np.asarray(values, dtype=np.float64)
    known = np.isfinite(numbers)
    size = np.abs(np.where(known & (numbers != 0.0), numbers, 1.0))
    power = 10.0 ** (digits - 1 - np.floor(np.log10(size)))
    found = (np.rint(numbers * power) / power).astype(object)
    found[~known] = None
    return list(found.tolist())


def _labelled(
    given: Sequence[tuple[float, str]] | None, limits: tuple[float, float], room: float
) -> Sequence[tuple[float, str]]:
    """Return the given ticks, otherwise as many round numbers as there is room for."""
    if given is not None:
        return given
    places = ticks(*limits, max(2, min(6, int(room))))
    return list(zip(places, tick_texts(places), strict=True))


def _path(x: Values, y: Values) -> str:
    """The path of a line through points (n,), or of lines (m, n)."""
    line = "M" + " ".join(["%.2f %.2f"] * x.shape[-1])
    count = int(x.size // x.shape[-1])
    return line * count % tuple(np.stack([x, y], axis=-1).ravel().tolist())


@lru_cache(maxsize=32)  # the pictures of many controls have a part in common
def _png(rgb: bytes, columns: int) -> str:
    """Return a picture as PNG in base64 (ISO/IEC 15948: 8 bits, true colour, no filter)."""
    rows = [rgb[start : start + 3 * columns] for start in range(0, len(rgb), 3 * columns)]
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", columns, len(rows), 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"".join(b"\0" + row for row in rows), 9)),
        (b"IEND", b""),
    )
    body = b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )
    return base64.b64encode(b"\x89PNG\r\n\x1a\n" + body).decode()


def _text(x: float, y: float, text: str, anchor: str, more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" style="fill:var(--ink)"{more}>{escape(text)}</text>'


def _colours(shares: Values, colours: Sequence[str]) -> NDArray[np.uint8]:
    """Return red, green and blue (..., 3), interpolated between equidistant colours."""
    rgb = np.array([list(bytes.fromhex(text)) for text in colours], dtype=np.float64)
    at = np.clip(shares, 0.0, 1.0) * (len(rgb) - 1)
    found = np.stack([np.interp(at, np.arange(len(rgb)), rgb[:, k]) for k in range(3)], axis=-1)
    return np.rint(found).astype(np.uint8)
