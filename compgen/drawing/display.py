"""Display of results: one line in a session, a table in a notebook, a picture by ``plot()``.

A class that inherits :class:`Displayed` provides the contents (``overview``, ``panels``); this module decides how they
look. Figures are in the units of reports: um, urad, mm.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from compgen.errors import InputError, Message

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Colours that can be distinguished with any kind of colour vision (Okabe and Ito 2008).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
PANELS_ACROSS = 3
PANEL_SIZE_INCH = (4.2, 3.0)
CELL = "padding:0.15em 0.8em;text-align:{side};border:none"
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Overview:
    """A result at a glance.

    Parameters
    ----------
    title : one line without a full stop.
    header, rows : a table; cells are texts, the first column contains names.
    notes : lines below the table.
    """

    title: str
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlottedLine:
    """Values over a coordinate, both of shape (n,); ``u`` is the standard uncertainty, drawn as a band of two of them."""

    label: str
    x: Values
    y: Values
    u: Values | None = None


@dataclass(frozen=True)
class Bars:
    """One value for each name; several ``Bars`` in a panel are drawn side by side."""

    label: str
    names: tuple[str, ...]
    values: tuple[float, ...]


@dataclass(frozen=True)
class Panel:
    """One picture: lines over a coordinate, or bars by name."""

    title: str
    y_label: str
    lines: tuple[PlottedLine, ...] = ()
    bars: tuple[Bars, ...] = ()
    x_label: str = ""
    x_scale: Literal["linear", "log"] = "linear"


def package(name: str, what: str) -> Any:
    """Return an optional package of other makers; ImportError that says how to install it.

    Raises
    ------
    ImportError
        if it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(f"{what} needs {name}, which is not installed: pip install {name}") from error


class Tabular(ABC):
    """A record that is a table: its columns are those of its file, with the unit in the name (um, urad, mm)."""

    @abstractmethod
    def to_columns(self) -> dict[str, Sequence[str] | Values]:
        """Return the columns by name, each (n,); numbers are not rounded."""

    def to_dataframe(self) -> Any:
        """Return the columns as a ``pandas.DataFrame``; ``attrs`` has the comments of the file.

        Raises
        ------
        ImportError
            if pandas is not installed.
        """
        frame = package("pandas", "to_dataframe()").DataFrame(dict(self.to_columns()))
        frame.attrs.update(getattr(self, "metadata", {}))
        return frame


class Displayed(ABC):
    """A result that is shown in a session or a notebook."""

    @abstractmethod
    def overview(self) -> Overview:
        """Return the overview; its title is the line of ``repr``."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.overview().title}>"

    def _repr_html_(self) -> str:
        """Return the table for a notebook."""
        return html_of(self.overview())


class Drawable(Displayed):
    """A result with a picture."""

    @abstractmethod
    def panels(self) -> Sequence[Panel]:
        """Return the panels to draw."""

    def plot(self, figure: Figure | None = None) -> Figure:
        """Draw this result, into ``figure`` or a new one, and return the figure.

        Raises
        ------
        ValueError
            if there is nothing to draw.
        """
        return drawn(self.panels(), self.overview().title, figure)


def html_of(overview: Overview) -> str:
    """Return an overview as HTML without scripts and style sheets; every text is escaped."""
    parts = [f"<p><b>{escape(overview.title)}</b></p>"]
    if overview.rows:
        head = _row(overview.header, "th") if overview.header else ""
        parts.append(f"<table>{head}{''.join(_row(row, 'td') for row in overview.rows)}</table>")
    parts += [f"<p>{escape(note)}</p>" for note in overview.notes]
    return "".join(parts)


def _row(cells: Sequence[str], tag: str) -> str:
    """Return one row: names on the left, figures on the right."""
    sides = ("left", *["right"] * (len(cells) - 1))
    return "<tr>{}</tr>".format(
        "".join(
            f'<{tag} style="{CELL.format(side=side)}">{escape(cell)}</{tag}>'
            for side, cell in zip(sides, cells, strict=True)
        )
    )


def drawn(panels: Sequence[Panel], title: str, figure: Figure | None = None) -> Figure:
    """Draw panels side by side, three in a row, and return the figure."""
    if not panels:
        raise ValueError(f"there is nothing to draw: {title}")
    across = min(PANELS_ACROSS, len(panels))
    down = -(-len(panels) // across)
    if figure is None:
        try:
            import matplotlib.pyplot as plt  # imported here: slow to load, and only pictures need it
        except ImportError as error:
            raise InputError(Message("no-matplotlib", "pictures need matplotlib; install compgen[plot]")) from error

        figure = plt.figure(figsize=(across * PANEL_SIZE_INCH[0], down * PANEL_SIZE_INCH[1]), layout="constrained")
    for place, panel in enumerate(panels, start=1):
        axes = figure.add_subplot(down, across, place)
        for line, colour in zip(panel.lines, COLOURS * len(panel.lines), strict=False):
            marker = "." if len(line.x) < 60 else ""
            axes.plot(line.x, line.y, color=colour, label=line.label, linewidth=1.4, marker=marker)
            if line.u is not None and np.isfinite(line.u).all():
                low, high = line.y - 2 * line.u, line.y + 2 * line.u
                axes.fill_between(line.x, low, high, color=colour, alpha=0.18, linewidth=0)
        width = 0.8 / max(1, len(panel.bars))
        for k, (item, colour) in enumerate(zip(panel.bars, COLOURS, strict=False)):
            at = np.arange(len(item.names)) + (k - 0.5 * (len(panel.bars) - 1)) * width
            axes.bar(at, item.values, width, color=colour, label=item.label)
            axes.set_xticks(range(len(item.names)), item.names)
        axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label, xscale=panel.x_scale)
        axes.grid(visible=True, axis="both" if panel.lines else "y", alpha=0.3)
        axes.set_axisbelow(True)
        if any([*(line.label for line in panel.lines), *(item.label for item in panel.bars)]):
            axes.legend(fontsize="small", frameon=False)
    figure.suptitle(title, fontsize="medium", wrap=True)
    return figure


def shortened(names: Sequence[str], most: int = 6) -> str:
    """Return names as one text: the first few, and how many more there are."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[:most])} and {len(names) - most} more"


def ranges_of(position_mm: Values) -> tuple[tuple[str, str, str], ...]:
    """Return rows of an overview: the range of positions (n, 3) along each axis, mm; none without positions."""
    if not len(position_mm):
        return ()
    low, high = position_mm.min(axis=0), position_mm.max(axis=0)
    return tuple((letter, f"{low[k]:g}", f"{high[k]:g}") for k, letter in enumerate("XYZ"))
