"""Figures of matplotlib as SVG inside a page: colours by role as CSS variables, text as text, ids of their own."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: What a colour is for. The style sheet gives each role its colour, one for light and one for dark pages.
ROLES = ("ink", "muted", "grid", "line", "band", "fit", "table", "before", "after", "c0", "c1", "c2", "c3", "c4", "c5")
#: Roles of lines that stand beside each other.
CYCLE = ("c0", "c1", "c2", "c3", "c4", "c5")
#: Colours that stand for roles while a figure is drawn; no picture uses them otherwise.
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
    """Return the colour that stands for a role while a figure is drawn."""
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
    """Return where the axes stand in the picture, in its own units: left, top, right, bottom."""
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
