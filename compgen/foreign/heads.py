"""What files say beside their readings: for whom, with what, by whom. A report names all of it, as it stands in the files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from compgen.data.csv_files import comment_of
from compgen.errors import CompgenError
from compgen.foreign.source import decode_head, native_format, read_head

#: Lines of a file that are kept, and characters of each: more are no head, but a text.
MOST_LINES, MOST_CHARACTERS = 60, 300
#: Comment of a native file with the lines of the file that it was converted from, and what separates them.
SAYS, BETWEEN = "says", " | "
#: A number that is a cell of a table, not a part of a date, a name or a serial number.
_NUMBER = re.compile(r"(?<![\w.:/-])[+\-\u2212]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?(?![\w/:-])")
_LETTERS = re.compile(r"[^\W\d_]{2,}")
_WORD = re.compile(r"[^\W\d_]{3,}")
_GAP = re.compile(r"\s*\t\s*|\s{2,}|\s*;[;\s]*")
_APART, _COUNTED = re.compile(r";? : ?"), re.compile(r"\w{1,40}\[[\d, ]{1,40}\]")
_CELLS = re.compile(r"\s*[;\t|]\s*|\s{2,}|,(?=\S)")
#: A number without a colon, as in "Auftrag Nr. 12345".
_NUMBERED = re.compile(r"(.*?\b(?:Nr|No|N\u00b0|Number|Nummer)\b)(\.?\s*)([\w/.-]*\d[\w/.-]*)", re.IGNORECASE)
_OF_NUMBER = re.compile(r"\s*(nr|no)\b\.?:?\s*", re.IGNORECASE)
_UNITS = ("mm", "um", "\u00b5m", "\u03bcm", "nm", "in", "urad", "mrad")
#: Comments of native files that are about the numbers in them, or are shown elsewhere.
_OF_NUMBERS = re.compile(
    r"rows|source|machine|seed|method|squareness|calibrated|measured|.*_(?:mm|um|c|s|k|urad|um_per_m)"
)


@dataclass(frozen=True)
class FileHead:
    """What one file says beside its readings.

    ``stated`` are facts by the names of :data:`compgen.foreign.covariates.FACTS`, and the date; ``lines`` all lines of text
    as they are.
    """

    file: str
    stated: dict[str, str] = field(default_factory=dict)
    lines: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Return the entry of ``identify.json``."""
        return {"file": self.file, **self.stated, "lines": list(self.lines)}


def heads_of(paths: Sequence[str | Path]) -> list[FileHead]:
    """Return what each file says; a file that cannot be read as text or workbook says nothing."""
    return [_head(Path(path)) for path in paths]


def _head(path: Path) -> FileHead:
    try:
        if native_format(path) is not None:
            return _of_native(path)
        rows = list(_rows_of_sheets(path)) if read_head(path).startswith(b"PK\x03\x04") else _rows_of_text(path)
    except (CompgenError, OSError, ValueError):
        return FileHead(path.name)
    lines = said(rows)
    return FileHead(path.name, facts_in(lines), lines)


def _rows_of_text(path: Path) -> list[str]:
    text = decode_head(read_head(path))
    return [] if text.lstrip("\ufeff \n").startswith("<") else text.splitlines()  # of a markup the tags would be listed


def _rows_of_sheets(path: Path) -> Iterator[str]:
    from compgen.foreign.cells import read_sheets

    for _, grid in read_sheets(path)[0]:
        yield from (
            "; ".join(filled) for row in grid.rows if (filled := [cell.strip() for cell in row if cell.strip()])
        )
        yield ""


def _of_native(path: Path) -> FileHead:
    """Return the comments of a native file; those of the file that it was converted from are lines of their own."""
    from compgen.foreign.covariates import FACTS

    lines = decode_head(read_head(path)).lstrip("\ufeff").splitlines()
    comments = dict(found for line in lines if (found := comment_of(line.strip())) is not None)
    earlier = tuple(part for part in comments.pop(SAYS, "").split(BETWEEN) if part)
    stated = {key: comments[key] for key in (*FACTS, "date") if comments.get(key)}
    own = tuple(
        f"{key}: {text}"[:MOST_CHARACTERS]
        for key, text in comments.items()
        if text and key not in stated and not _OF_NUMBERS.fullmatch(key)
    )
    return FileHead(path.name, {**stated, **facts_in(earlier)}, (*earlier, *own)[:MOST_LINES])


def said(rows: Sequence[str]) -> tuple[str, ...]:
    r"""Return the lines of a file that are neither rows of numbers nor the names above them.

    >>> said(["Kunde: Muster GmbH", "Nr. 12345", "", "Position; Wert", "0,0; 0,5", "100,0; 1,5", "Bemerkung: kalt"])
    ('Kunde: Muster GmbH', 'Nr. 12345', 'Bemerkung: kalt')
    """
    plain = [_APART.sub(": ", " ".join(_GAP.sub("; ", row.strip("#% \t")).split())).strip(";, ") for row in rows]
    kept = []
    for k, (row, text) in enumerate(zip(rows, plain, strict=True)):
        if not _LETTERS.search(text) or text.endswith("::") or _is_row(text) or _is_units(text) or _COUNTED.match(text):
            continue
        below = next((other for other in plain[k + 1 :] if other), "")
        if len(_CELLS.split(row.strip())) > 1 and ":" not in text and (_is_row(below) or _is_units(below)):
            continue
        kept.append(text[:MOST_CHARACTERS])
    return tuple(dict.fromkeys(kept))[:MOST_LINES]


def _is_row(text: str) -> bool:
    """Whether a line is a row of numbers, perhaps behind the name of a feature."""
    numbers, words = len(_NUMBER.findall(text)), len([word for word in _LETTERS.findall(text) if word not in _UNITS])
    return numbers > words and (numbers >= 3 or not words) and (":" not in text or numbers > 3)


def _is_units(text: str) -> bool:
    """Whether a line has nothing but units, as below the names of columns."""
    return bool(text) and not _WORD.search(text) and any(unit in text for unit in (*_UNITS, "°", "m]"))


def facts_in(lines: Sequence[str]) -> dict[str, str]:
    """Return the facts that lines ``key: value``, ``key = value`` or ``key; value`` state, by the names of native comments.

    >>> facts_in(["Auftraggeber: Muster GmbH, Ulm", "Laser S/N; 99AZ12"])
    {'customer': 'Muster GmbH, Ulm', 'serial_number': '99AZ12'}
    """
    from compgen.foreign.column_names import split_name
    from compgen.foreign.covariates import FACTS

    found: dict[str, str] = {}
    for line in lines:
        for part in re.split(r"; (?=[^;:=]*[:=])", line):
            key, mark, value = next(
                (cut for sign in (":", "=", "; ") if (cut := part.partition(sign))[1]), (part, "", "")
            )
            if not mark and (number := _NUMBERED.fullmatch(part)):
                key, mark, value = number.groups()
            elif number := _OF_NUMBER.match(value):  # Messprotokoll; Nr. 12345
                key, value = f"{key} {number[1]}", value[number.end() :]
            word = split_name(key.strip()).word
            name = next((name for name, words in FACTS.items() if word in words), None)
            value = value.strip(" ;:")
            if mark and name and value:
                found.setdefault(name, value)
    return found


def with_head(text: str, head: FileHead) -> str:
    """Return the text of a native file with the lines of the file that it was converted from as a comment."""
    lines = [line.replace(BETWEEN.strip(), "/") for line in head.lines]
    return f"# {SAYS} = {BETWEEN.join(lines)}\n{text}" if lines else text
