"""A finished page in inch: its texts, tables, pictures, and the data for its scripts (:mod:`compgen.units`)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape, unescape
from typing import Any

from compgen.drawing.charts import rescaled
from compgen.resources import LANGUAGES
from compgen.units import Inch, cell_unit, column_unit, factor_of, unit_in

#: What a page in inch says of its units, below its first heading.
SAID = "Lengths in inch, deviations in 0.0001 inch, angles in arcsec. Files and fields keep the unit that they name."
#: Contents that are typed, belong to a file, or are for a script.
_KEPT = frozenset({"style", "script", "code", "pre", "textarea", "select", "option"})
_VOID = frozenset({"area", "base", "br", "col", "hr", "img", "input", "link", "meta", "source", "wbr"})
_TAG = re.compile(r"""(<!--.*?-->|<(?:"[^"]*"|'[^']*'|[^'">])*>)""", re.DOTALL)
_NAME = re.compile(r"[a-zA-Z][\w:-]*")
_SHOWN_ATTRIBUTES = re.compile(r'(?<=\s)((?:title|aria-label)=")([^"]*)(")')
_LANGUAGE = re.compile(r'<html[^>]*\slang="(\w+)"')
_DATA = re.compile(r'(<script type="application/json" id="data">)(.*?)(</script>)', re.DOTALL)


def page_in_inch(html: str) -> str:
    """Return a finished page in inch; one that is in inch already is returned as it is."""
    head = html[:2000]
    if 'data-units="' in head:
        return html
    language = found[1] if (found := _LANGUAGE.search(head)) else LANGUAGES[0]
    inch, said = Inch(language), SAID
    if language != LANGUAGES[0]:
        from compgen.language import texts_of

        said = texts_of(language).text(SAID)
    made = _DATA.sub(_data_in_inch, "".join(_Page(inch).pieces(html)))
    if made == html:  # nothing on it has a unit
        return html
    stated = " ".join(f'data-{key}="{value}"' for key, value in inch.script_units().items())
    made = made.replace("<html ", f"<html {stated} ", 1)
    return made.replace("</h1>", f'</h1>\n<p class="note units">{escape(said, quote=False)}</p>', 1)


def _data_in_inch(found: re.Match[str]) -> str:
    """Return the data of pictures, for the script of a page, in the units of their axes."""
    data = json.loads(found[2])
    if isinstance(data, dict):
        data = {key: picture_in_inch(item) if isinstance(item, dict) else item for key, item in data.items()}
    text = json.dumps(data, separators=(",", ":"))  # ASCII, so U+2028 and U+2029 are escaped
    return found[1] + text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026") + found[3]


def picture_in_inch(item: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of one picture: limits and series by the units of its axes, cells from um.

    >>> picture_in_inch({"units": ["mm", "um"], "limits": [0.0, 254.0, 0.0, 5.08], "frame": [0, 0, 9, 9]})["limits"]
    [0.0, 10.0, 0.0, 2.0]
    """
    units = item.get("units")
    if not isinstance(units, list):
        return dict(item)
    x, y = (factor_of(name) for name in units)
    made = {**item, "limits": [_scaled(value, by) for value, by in zip(item["limits"], (x, x, y, y), strict=True)]}
    if "series" in item:
        by = {"x": x, "y": y, "U": y}
        made["series"] = [
            {key: [_scaled(v, by[key]) for v in part] if key in by else part for key, part in one.items()}
            for one in item["series"]
        ]
    if isinstance(item.get("values"), list):
        made["values"] = [[_scaled(value, factor_of("um")) for value in row] for row in item["values"]]
    return made


def _scaled(value: float | None, by: float) -> float | None:
    return None if value is None else float(f"{value * by:.9g}")


@dataclass
class _Table:
    """What is known of a table before its cells: texts of its caption and of the headings of its columns."""

    caption: list[str] = field(default_factory=list)
    heads: list[list[str]] = field(default_factory=list)
    stated: list[str | None] = field(default_factory=list)
    column: int = 0

    def unit_of(self, column: int, *, is_name: bool) -> str | None:
        """Return the unit of bare numbers in a column, None if it is that of the row or of the table; names have none."""
        head = "".join(self.heads[column]) if column < len(self.heads) else ""
        stated = self.stated[column] if column < len(self.stated) else None
        unit = column_unit(head) if stated is None else stated
        return unit or "" if is_name else unit


@dataclass
class _Row:
    """The pieces of a row: only at its end is its unit known."""

    pieces: list[str] = field(default_factory=list)
    texts: list[tuple[int, str | None]] = field(default_factory=list)
    unit: str = ""


class _Page:
    """Goes once through the tags and texts of a page."""

    #: Whether texts of an element stay: never, because it is a form, always.
    SHOWN, FORM, KEPT = 0, 1, 2

    def __init__(self, inch: Inch) -> None:
        self.inch = inch
        self.open: list[tuple[str, int]] = []
        self.tables: list[_Table] = []
        self.row: _Row | None = None
        self.cell: str | None = ""
        self.fact: list[str] = []

    def pieces(self, html: str) -> Iterator[str]:
        """Yield the pieces of the page in inch."""
        drawn, depth = list[str](), 0
        for k, piece in enumerate(_TAG.split(html)):
            is_tag = k % 2 == 1
            if is_tag and (depth or piece.startswith('<svg class="plot"')):
                depth += piece.startswith("<svg") - piece.startswith("</svg")
                drawn.append(piece)
                if not depth:
                    picture, drawn = "".join(drawn), []
                    yield from self._put(picture if self._keeps() else rescaled(picture, self.inch))
            elif depth:
                drawn.append(piece)
            elif is_tag:
                yield from self._put(self._tag(piece))
                if piece.startswith("</tr") and self.row is not None:
                    yield from self._end_of_row()
            elif piece:
                yield from self._text(piece)

    def _keeps(self) -> bool:
        return bool(self.open) and self.open[-1][1] != self.SHOWN

    def _within(self, name: str) -> bool:
        return any(tag == name for tag, _ in self.open)

    def _put(self, piece: str) -> Iterator[str]:
        if self.row is None:
            yield piece
        else:
            self.row.pieces.append(piece)

    def _text(self, piece: str) -> Iterator[str]:
        plain = unescape(piece)
        if self._keeps() or not plain.strip():
            yield from self._put(piece)
            return
        if self.row is not None:
            table = self.tables[-1]
            if self._within("thead") and table.heads:
                table.heads[-1].append(plain)
            self.row.unit = self.row.unit or cell_unit(plain)
            self.row.texts.append((len(self.row.pieces), self.cell))
            self.row.pieces.append(piece)
            return
        if self.tables and self._within("caption"):
            self.tables[-1].caption.append(plain)
        if self._within("dt"):
            self.fact.append(plain)
        yield self._shown(piece, unit_in("".join(self.fact)) if self._within("dd") else "")

    def _shown(self, piece: str, unit: str) -> str:
        plain = unescape(piece)
        shown = self.inch.cell(plain, unit)
        return piece if shown == plain else escape(shown, quote=False)

    def _end_of_row(self) -> Sequence[str]:
        row = self.row
        assert row is not None
        unit = row.unit or unit_in("".join(self.tables[-1].caption))
        for place, own in row.texts:
            row.pieces[place] = self._shown(row.pieces[place], unit if own is None else own)
        self.row = None
        return row.pieces

    def _tag(self, piece: str) -> str:
        found = _NAME.search(piece)
        if piece.startswith("<!") or found is None:
            return piece
        name = found[0].lower()
        if piece.startswith("</"):
            self._close(name)
            return piece
        shown = piece if self._keeps() else _SHOWN_ATTRIBUTES.sub(self._attribute, piece)
        if name not in _VOID and not piece.endswith("/>"):
            self._begin(name, piece)
        return shown

    def _attribute(self, found: re.Match[str]) -> str:
        return found[1] + escape(self.inch.text(unescape(found[2]))) + found[3]

    def _begin(self, name: str, piece: str) -> None:
        state = self.open[-1][1] if self.open else self.SHOWN
        if name in _KEPT or "data-as-in-file" in piece:
            state = self.KEPT
        elif name == "form" and state == self.SHOWN:  # a field names the unit in which it is filled in
            state = self.FORM
        elif name in ("table", "figure") and state == self.FORM:
            state = self.SHOWN
        self.open.append((name, state))
        if name == "dt":
            self.fact = []
        if name == "table":
            self.tables.append(_Table())
        elif name == "tr" and self.tables:
            self.row, self.tables[-1].column = _Row(), 0
            if self._within("thead"):
                self.tables[-1].heads, self.tables[-1].stated = [], []
        elif name in ("td", "th") and self.tables:
            self._begin_cell(name, piece)

    def _begin_cell(self, name: str, piece: str) -> None:
        table, span = self.tables[-1], int(found[1]) if (found := re.search(r'colspan="(\d+)"', piece)) else 1
        stated = found[1] if (found := re.search(r'data-unit="([^"]*)"', piece)) else None
        if self._within("thead"):
            table.heads += [[] for _ in range(span)]
            table.stated += [stated] * span
            self.cell = ""
        else:
            self.cell = table.unit_of(table.column, is_name=name == "th") if stated is None else stated
        table.column += span

    def _close(self, name: str) -> None:
        while self.open and self.open.pop()[0] != name:
            pass
        if name == "table" and self.tables:
            self.tables.pop()
