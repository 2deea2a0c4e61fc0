"""Geometry of the pages' charts: plain numbers that a template turns into SVG; colours stand in the style sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

#: Size of a chart and its margins (left, right, top, bottom), px.
WIDTH, HEIGHT = 620.0, 200.0
MARGINS = (64.0, 16.0, 12.0, 30.0)
#: How pages write the units of files.
UNITS = {"um": "\N{MICRO SIGN}m", "urad": "\N{MICRO SIGN}rad"}


@dataclass(frozen=True)
class Series:
    """One line: x, y and, where known, the half width of the interval around y (nan where it is not known).

    ``marked``: whether its points are drawn.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    u: Sequence[float] = ()
    marked: bool = True


@dataclass(frozen=True)
class Mark:
    """One point in px; ``low`` and ``high`` are the ends of its interval."""

    x: float
    y: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Chart:
    """Everything in px: ticks as (place, text), lines as the text of ``points``, marks with their intervals.

    ``left_out`` are points that do not count, at the edge if they lie outside the scale.
    """

    title: str
    x_ticks: Sequence[tuple[float, str]]
    y_ticks: Sequence[tuple[float, str]]
    lines: Sequence[tuple[str, str, Sequence[Mark]]]
    width: float = WIDTH
    height: float = HEIGHT
    left: float = MARGINS[0]
    right: float = WIDTH - MARGINS[1]
    top: float = MARGINS[2]
    bottom: float = HEIGHT - MARGINS[3]
    left_out: Sequence[Mark] = ()


def chart(
    title: str,
    series: Sequence[Series],
    x_ticks: Sequence[tuple[float, str]] | None = None,
    left_out: Series | None = None,
) -> Chart | None:
    """Return the chart of some lines; None if there is no point to draw.

    ``x_ticks`` are places and texts below the axis; without them round numbers are chosen. The scale of y does not reach
    for points that are ``left_out``.
    """
    kept = [_finite(item) for item in series]
    xs = [x for item in kept for x in item.x]
    if not xs:
        return None
    grey = None if left_out is None else _finite(left_out)
    xs += [] if grey is None else grey.x
    ys = [y + side * u for item in kept for y, u in zip(item.y, item.u, strict=True) for side in (-1.0, 1.0)]
    y_marks = ticks(min(ys), max(ys))
    low, high = min(*ys, y_marks[0]), max(*ys, y_marks[-1])
    across = _Scale(min(xs), max(xs), MARGINS[0] + 8, WIDTH - MARGINS[1] - 8)
    up = _Scale(low, high, HEIGHT - MARGINS[3], MARGINS[2])
    x_marks = [(x, number(x)) for x in ticks(min(xs), max(xs))] if x_ticks is None else x_ticks
    return Chart(
        title,
        [(across(x), text) for x, text in x_marks if min(xs) <= x <= max(xs)],
        [(up(y), number(y)) for y in y_marks],
        [_line(item, across, up) for item in kept],
        left_out=[] if grey is None else [_at_edge(mark) for mark in _line(grey, across, up)[2]],
    )


def _at_edge(mark: Mark) -> Mark:
    """Return a point that lies outside the scale at its edge, without its interval."""
    y = min(max(mark.y, MARGINS[2]), HEIGHT - MARGINS[3])
    return mark if y == mark.y else Mark(mark.x, y, None, None)


class _Scale:
    """Linear map from values to px; values that are all the same stand in the middle."""

    def __init__(self, low: float, high: float, start: float, end: float) -> None:
        self.low, self.span, self.start, self.end = low, high - low, start, end

    def __call__(self, value: float) -> float:
        part = (value - self.low) / self.span if self.span > 0.0 else 0.5
        return round(self.start + part * (self.end - self.start), 1)


def _finite(item: Series) -> Series:
    u = item.u or [0.0] * len(item.x)
    rows = [row for row in zip(item.x, item.y, u, strict=True) if math.isfinite(row[0]) and math.isfinite(row[1])]
    spread = [row[2] if math.isfinite(row[2]) else 0.0 for row in rows]
    return Series(item.label, [row[0] for row in rows], [row[1] for row in rows], spread, item.marked)


def _line(item: Series, across: _Scale, up: _Scale) -> tuple[str, str, list[Mark]]:
    marks = []
    for x, y, u in zip(item.x, item.y, item.u, strict=True):
        low, high = (up(y - u), up(y + u)) if u > 0.0 else (None, None)
        marks.append(Mark(across(x), up(y), low, high))
    return item.label, " ".join(f"{mark.x},{mark.y}" for mark in marks), marks if item.marked else []


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Return round numbers that cover the interval: steps of 1, 2 or 5 times a power of ten."""
    if not high > low:
        low, high = low - 0.5 * max(abs(low), 1.0), high + 0.5 * max(abs(high), 1.0)
    raw = (high - low) / wanted
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [k * step for k in range(first, last + 1)]


def number(value: float) -> str:
    """Return a short text of a number; no minus before a zero."""
    text = f"{value:.4g}"
    return "0" if float(text) == 0.0 else text.replace("-", "\N{MINUS SIGN}")
