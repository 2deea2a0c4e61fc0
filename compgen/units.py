"""Units of what is shown: pages, tables of the terminal, pictures and questions in inch.

Results, files and pages are made in mm, um and urad; nothing in this module changes a file of data. Where something is
shown in inch, lengths are in inch, deviations in 0.0001 in ("tenths"), angles in arcsec. As a language is
(:mod:`compgen.language`), units are applied to what is finished, with the rule by which a reader finds the unit of a number:

- in a sentence it follows its number, or a list of numbers (``"12.3 / 4.5 um"``);
- a bare number in a table has the unit that the heading of its column states, else the unit that its row states in a cell of its
  own, else that of the caption; a bare number behind the name of a fact that of the name;
- numbers of an axis of a picture have the unit that the picture states.

What is typed stays as it is: code, commands, values of forms, contents of files.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from compgen.resources import LANGUAGES

#: Units of what is shown; the first one is that of the program.
UNITS = ("mm", "inch")
MM_PER_INCH = 25.4
_ARCSEC_PER_URAD = 648000.0 / math.pi * 1e-6


@dataclass(frozen=True)
class Unit:
    """A unit in inch pages: ``per`` of it are one of the unit of the program; its name in a heading and behind a number.

    ``decimals`` are those that a number gains: an inch is worth three more, a tenth none.
    """

    per: float
    heading: str
    behind: str
    decimals: int


_IN, _TENTHS = "in", "tenths"
#: By the names that texts and pages use; longer names first where one begins another.
_INCH: Mapping[str, Unit] = {
    "um/m": Unit(0.12, "0.0001 in/ft", "tenths/ft", 1),
    "urad/m": Unit(_ARCSEC_PER_URAD * 0.3048, "arcsec/ft", "arcsec/ft", 1),
    "mm/min": Unit(1.0 / MM_PER_INCH, "in/min", "in/min", 2),
    "mm/s": Unit(1.0 / MM_PER_INCH, "in/s", "in/s", 3),
    "um": Unit(1.0 / 2.54, "0.0001 in", _TENTHS, 0),
    "mm": Unit(1.0 / MM_PER_INCH, _IN, _IN, 3),
    "urad": Unit(_ARCSEC_PER_URAD, "arcsec", "arcsec", 1),
}
#: A number in another language than English has no jargon behind it: German "Zehntel" are 0.1 mm.
_TIMES = "× 0.0001 in"
#: Headings of columns that have no unit, although their table has one.
PLAIN = frozenset(
    {
        "factor", "en", "points", "readings", "runs", "line", "lines", "targets", "free", "smoothness", "at a bound", "p",
        "chosen by", "solver", "verdict", "best in", "station", "rank", "correlation", "count", "files", "bytes", "probability",
    }
)  # fmt: skip

_NAME = r"(?:[uµμ]m/m|[uµμ]rad/m|mm/min|mm/s|[uµμ]m|mm|[uµμ]rad)"
#: A unit ends where its name ends; rates of temperature and time keep what they are per.
_END = r"(?![\w²³^]|/(?!K\b|h\b|min\b|s\b|°C)|\.\w|-\w)"
_NUMBER = r"(?:\d{1,3}(?:\u202f\d{3})+|\d+)(?:\.\d+)?(?:e[+-]?\d+)?"
_SIGN = r"(?:[+\-−±<>≤≥~≈]|\+/?-|&lt;|&gt;)*\s?"
_BETWEEN = rf"(?:\s*(?:/|->|→|…|\.{{2,3}}|±|\+/?-)\s*|\s(?:to|bis|auf|a|and|und|y|or|oder)\s|,?\s[XYZ]\s?=?\s?){_SIGN}"
_LIST = rf"{_NUMBER}(?:{_BETWEEN}{_NUMBER})*"
_SPAN = rf"{_LIST}(?:\s\({_SIGN}{_LIST}\)|\s?\[{_SIGN}{_LIST}\])?"
_TUPLE = rf"\({_SIGN}{_NUMBER}(?:,\s{_SIGN}{_NUMBER})+\)"
_QUANTITY = re.compile(rf"(?<![\w.#&])(?P<all>{_SPAN}|{_TUPLE})(?P<blank>[\s\u202f\u00a0]?)(?P<unit>{_NAME}){_END}")
_HEADING = re.compile(rf"(?<![\w/`$\u202f])(?<!\d\s)(?P<unit>{_NAME}){_END}")
_ASCII_UM = re.compile(r"\bum\b")
_ANY_NUMBER = re.compile(rf"(?<![\w.]){_NUMBER}")
_WITHIN = re.compile(r"(?:[\s,;/±()\[\]…<>=~≈+\-−→.]|->|\b(?:to|bis|auf|a|x|[XYZ])\b)*")
_UNIT_CELL = re.compile(rf"\s*(?P<unit>{_NAME})\s*")
_CODE = re.compile(r"(`[^`]*`)")
#: A text that names inch compares units, or asks for one.
_OF_UNITS = re.compile(r"\b(?:inch|inches|Zoll|pulgadas?)\b")
_LENGTH = re.compile(r"\s*(?P<number>[-+−]?\d*[.,]?\d+(?:[eE][-+]?\d+)?)\s*(?P<unit>[a-zA-Z\"\u2033]*)\s*")
#: Units in which a length may be typed.
MM_PER: Mapping[str, float] = {
    "mm": 1.0, "cm": 10.0, "m": 1e3, "in": MM_PER_INCH, "inch": MM_PER_INCH, "inches": MM_PER_INCH, '"': MM_PER_INCH,
    "\u2033": MM_PER_INCH, "ft": 12.0 * MM_PER_INCH,
}  # fmt: skip


def typed_mm(text: str, usual: str = "mm") -> float:
    """Return a length that was typed, in mm; a number without a unit is in ``usual``. ValueError for anything else.

    >>> typed_mm("24in"), typed_mm("-30,5"), typed_mm("1", "inch")
    (609.6, -30.5, 25.4)
    """
    found = _LENGTH.fullmatch(text)
    if found is None or (unit := found["unit"].lower() or usual) not in MM_PER:
        raise ValueError(f"{text!r} is not a length such as 600, 600mm or 24in")
    # rounded: 24 * 25.4 is 609.5999999999999
    return round(float(found["number"].replace(",", ".").replace("−", "-")) * MM_PER[unit], 9)


def unit_named(name: str) -> str:
    """Return the unit of the program that a text names, with letters of ASCII.

    >>> unit_named("µm")
    'um'
    """
    return name.replace("µ", "u").replace("μ", "u")


def unit_in(text: str) -> str:
    """Return the only unit that a heading or caption states, empty without one or with several.

    >>> unit_in("at (mm)"), unit_in("µm or µrad"), unit_in("points")
    ('mm', '', '')
    """
    found = {unit_named(match["unit"]) for match in (*_HEADING.finditer(text), *_QUANTITY.finditer(text))}
    return found.pop() if len(found) == 1 else ""


def converted(number: str, name: str) -> str:
    """Return a number without sign in the inch unit of ``name``, with the digits that it is known by.

    Its decimals suit the unit, never fewer than two significant digits of what it had, never a trailing zero of a whole number.

    >>> converted("8.21", "um"), converted("1", "um"), converted("609.6", "mm"), converted("100", "urad")
    ('3.23', '0.4', '24', '20.6')
    """
    unit, plain = _INCH[name], number.replace("\u202f", "")
    value = float(plain) * unit.per
    mantissa, _, exponent = plain.partition("e")
    whole, _, part = mantissa.partition(".")
    had = len(part) - int(exponent or 0)
    decimals = had + unit.decimals + (1 if unit.decimals == 0 and had < 2 else 0)
    if name == "mm":
        decimals = min(decimals, max(4, had))
    known = max(1, min(2, len((whole + part).lstrip("0"))))
    if value:
        decimals = max(decimals, known - 1 - math.floor(math.log10(value)))
    text = f"{value:.{max(decimals, 0)}f}"
    # positions such as 24 in are whole; figures keep their decimals, so that columns stay in line
    return text.rstrip("0").rstrip(".") if name == "mm" and "." in text else text


class Inch:
    """Shows texts, tables, pictures and pages in inch. ``language`` is that of the texts.

    >>> Inch().text("largest 8.21 um at X 100 Y 200 Z -50 mm; lean 12 urad")
    'largest 3.23 tenths at X 3.937 Y 7.874 Z -1.969 in; lean 2.5 arcsec'
    >>> Inch().text("u (um), give `--radius 5 mm`")
    'u (0.0001 in), give `--radius 5 mm`'
    """

    def __init__(self, language: str = LANGUAGES[0]) -> None:
        self.language = language

    def text(self, text: str) -> str:
        """Return a text with its quantities and units in inch; what is between backticks, and what speaks of inch, stays."""
        if _OF_UNITS.search(text):
            return text
        if "`" in text:
            return "".join(part if part[:1] == "`" else self.text(part) for part in _CODE.split(text))
        return self._headings(_QUANTITY.sub(self._quantity, text))

    def _quantity(self, found: re.Match[str]) -> str:
        name = unit_named(found["unit"])
        behind = _INCH[name].behind
        if self.language != LANGUAGES[0]:
            behind = behind.replace(_TENTHS, _TIMES)
        return f"{self.numbers(found['all'], name)} {behind}"

    def _headings(self, text: str) -> str:
        return _HEADING.sub(
            # in other languages "um" is a word
            lambda found: (
                found[0]
                if self.language != LANGUAGES[0] and _ASCII_UM.fullmatch(found[0])
                else _INCH[unit_named(found["unit"])].heading
            ),
            text,
        )

    def numbers(self, text: str, name: str) -> str:
        """Return a text with all its numbers converted from the unit ``name``."""
        return _ANY_NUMBER.sub(lambda found: converted(found[0], name), text)

    def cell(self, text: str, name: str) -> str:
        """Return a cell of a table: bare numbers have the unit ``name`` (empty: none), others the one that follows them.

        >>> Inch().cell("12.30 ± 0.10", "um"), Inch().cell("3 of 17", "um"), Inch().cell("2 mm", "um")
        ('4.84 ± 0.039', '3 of 17', '0.079 in')
        """
        if name in _INCH and _ANY_NUMBER.search(text) and _WITHIN.fullmatch(_ANY_NUMBER.sub("", text)):
            return self.numbers(text, name)
        return self.text(text)

    def script_units(self) -> dict[str, str]:
        """Return what the scripts of pages need: names of the units, and how many of them a mm and a um are."""
        names = {"units": "inch", "length": _IN, "deviation": _TENTHS if self.language == LANGUAGES[0] else _TIMES}
        return names | {"per-mm": f"{_INCH['mm'].per:.12g}", "per-um": f"{_INCH['um'].per:.12g}"}


def column_unit(head: str) -> str | None:
    """Return the unit that the heading of a column states, empty for numbers without one, None if it is stated elsewhere."""
    return unit_in(head) or ("" if head.strip().lower() in PLAIN else None)


def units_of_cells(caption: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return the units of the bare numbers of a table, empty for none; the first column contains names.

    >>> units_of_cells("tool tip, um rms", ["control", "at (mm)", "max", "points"], [["mill 5", "254", "2.54", "12"]])
    [['', 'mm', 'um', '']]
    >>> units_of_cells("", ["error", "value", "unit"], [["EXX", "3", "um"], ["EAX", "4", "urad"]])
    [['', 'um', ''], ['', 'urad', '']]
    """
    of_table, of_columns = unit_in(caption), [column_unit(head) for head in heads]
    found = []
    for row in rows:
        of_row = next((unit for cell in row if (unit := cell_unit(cell))), "") or of_table
        units = [(of_row if k else "") if unit is None else unit for k, unit in enumerate(of_columns)]
        found.append(["" if cell_unit(cell) else unit for cell, unit in zip(row, units, strict=True)])
    return found


def cell_unit(cell: str) -> str:
    """Return the unit if a cell contains nothing else."""
    found = _UNIT_CELL.fullmatch(cell)
    return unit_named(found["unit"]) if found else ""


def factor_of(name: str) -> float:
    """Return how many of the inch unit are one of the unit ``name``; 1 for what has none."""
    return _INCH[name].per if name in _INCH else 1.0
