"""Tables of HEIDENHAIN controls as text: ``BEGIN name .COM MM``, a header of column names from ``NR`` on, ``[END]``.

A field starts where the name of its column starts in the header. The header row, blank-separated columns and the
last line ``[END]`` are documented (iTNC 530 HSCI technical manual, p. 670, 671, 684); the first line is usual in all
text tables of this manufacturer; field widths are not documented, so the layout of a table saved on the control can be
used as it is.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

from compgen.controls.shared.base import SourceFile
from compgen.controls.shared.scanner import fixed_point, plain_lines
from compgen.data.files import read_bytes
from compgen.errors import InputError, doubled, one_line

#: Limits far above any real table: length of the file, length of a line, lines before the header.
MOST_CHARACTERS, MOST_IN_LINE, MOST_BEFORE_HEADER = 2_000_000, 1000, 200
BEGIN, END, NUMBER_COLUMN = "BEGIN", "[END]", "NR"
UNITS = ("MM", "INCH", "IN")

_WORD = re.compile(r"[^ \t]+")
_NUMBER = re.compile(r"[+-]?\d{1,7}(?:\.\d{1,9})?", re.ASCII)
_COLUMN = re.compile(r"[A-Za-z0-9_.+-]{1,32}", re.ASCII)


@dataclass(frozen=True)
class TableColumn:
    """One column: its name and where its field starts; ``width`` is 0 for the last column, whose field is open."""

    name: str
    start: int
    width: int


@dataclass(frozen=True)
class Row:
    """One row: the cells by column name (without blank cells) and its line in the file."""

    cells: dict[str, str]
    line: int


@dataclass(frozen=True)
class TextTable:
    """A table as read from the file.

    ``words`` are the words of the first line, ``before`` the lines up to and including the header, ``after`` the lines
    from ``[END]`` on, ``header_line`` the line number of the header.
    """

    file: SourceFile
    words: tuple[str, ...]
    before: tuple[str, ...]
    columns: tuple[TableColumn, ...]
    rows: tuple[Row, ...]
    after: tuple[str, ...]

    @property
    def header_line(self) -> int:
        """Line of the header row, counting from 1."""
        return len(self.before)

    @property
    def kind(self) -> str:
        """Extension of the table's name in its first line, e.g. ``COM``; empty if there is none."""
        unit = next(k for k in range(2, len(self.words)) if self.words[k].upper() in UNITS)
        found = re.search(r"\.([A-Za-z]{1,4})$", self.words[unit - 1])
        return found.group(1).upper() if found else ""

    def number(self, row: Row, column: str) -> Decimal:
        """Return a cell as a number; InputError if it is blank or not a plain decimal number."""
        text = row.cells.get(column)
        if text is None:
            raise self.file.fail(
                f"column {column} is blank here; a column with values must have one in every row", row.line
            )
        return fixed_point(self.file, row.line, text, f"column {column}", _NUMBER)


def read_table(file: SourceFile) -> TextTable:
    """Read one table; InputError with the line if anything is malformed or truncated."""
    lines = plain_lines(SourceFile(file.path, file.text.removeprefix("\ufeff")), MOST_CHARACTERS, MOST_IN_LINE)
    words = tuple(lines[0].split())
    if len(words) < 3 or words[0] != BEGIN:
        raise file.fail(
            f"{one_line(lines[0])[:40]!r} is not a valid first line; expected e.g. 'BEGIN AXIS_Y .COM MM'", 1
        )
    unit = next((word.upper() for word in words[2:] if word.upper() in UNITS), "")
    if unit in ("INCH", "IN"):
        raise file.fail("the table is in inches; only tables in mm are read", 1)
    if unit != "MM":
        raise file.fail("the first line has no unit; expected MM after the name", 1)
    begins = [(line.split(maxsplit=1) or [""])[0] for line in lines[:MOST_BEFORE_HEADER]]
    before_end = begins[1 : begins.index(END, 1) if END in begins[1:] else None]
    if NUMBER_COLUMN not in before_end:
        message = f"no header row of column names that begins with {NUMBER_COLUMN}"
        raise file.fail(message, min(len(lines), 2))
    header = 1 + before_end.index(NUMBER_COLUMN)
    columns = _columns(file, lines[header], header + 1)
    rows: list[Row] = []
    for number, line in enumerate(lines[header + 1 :], start=header + 2):
        text = line.strip()
        if text == END:
            for place, rest in enumerate(lines[number:], start=number + 1):
                if rest.strip():
                    raise file.fail(f"{one_line(rest)[:20]!r} follows {END}, the end of the table", place)
            before, after = tuple(lines[: header + 1]), tuple(lines[number - 1 :])
            return TextTable(file, words, before, columns, tuple(rows), after)
        if text and not text.startswith(";"):
            rows.append(_row(file, columns, line, number, len(rows)))
    raise file.fail(f"the last line {END} is missing: the file is truncated", len(lines))


def _columns(file: SourceFile, header: str, line: int) -> tuple[TableColumn, ...]:
    found = list(_WORD.finditer(header))
    names = [match.group() for match in found]
    for name in names:
        if not _COLUMN.fullmatch(name):
            raise file.fail(f"{name[:40]!r} is not the name of a column", line)
    twice = doubled(names)
    if twice is not None:
        raise file.fail(f"column {twice} is given twice", line)
    starts = [match.start() for match in found]
    ends = [*starts[1:], starts[-1]]
    return tuple(TableColumn(name, start, end - start) for name, start, end in zip(names, starts, ends, strict=True))


def _row(file: SourceFile, columns: Sequence[TableColumn], line: str, number: int, expected: int) -> Row:
    """Cells of one row: one word per column in order, or by field position if some cells are blank."""
    found = list(_WORD.finditer(line))
    if len(found) > len(columns):
        raise file.fail(f"{len(found)} values are given for {len(columns)} columns", number)
    if len(found) == len(columns):
        cells = {column.name: match.group() for column, match in zip(columns, found, strict=True)}
    else:
        cells = {}
        for match in found:
            column = next((item for item in reversed(columns) if item.start <= match.start()), columns[0])
            if column.name in cells or (column.width and match.end() > column.start + column.width):
                what = one_line(match.group())[:40]
                message = f"{what!r} extends beyond the field of its column (fields start where the header words start)"
                raise file.fail(message, number)
            cells[column.name] = match.group()
    counted = cells.get(NUMBER_COLUMN, "")
    if not re.fullmatch(r"\d{1,6}", counted, re.ASCII) or int(counted) != expected:
        message = (
            f"{NUMBER_COLUMN} is {one_line(counted)[:20] or 'blank'}; expected {expected}, because rows are numbered 0, 1, "
            "2 ..."
        )
        raise file.fail(message, number)
    return Row(cells, number)


# --- writing: default layouts, and layouts of tables saved on a control -----------------------------------------------


@dataclass(frozen=True)
class ComLayout:
    """A table without its rows: lines before and after, fields of the columns, line ends."""

    before: tuple[str, ...]
    columns: tuple[TableColumn, ...]
    after: tuple[str, ...] = (END, "")
    crlf: bool = False
    source: Path | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(column.name for column in self.columns)

    def fail(self, message: str) -> InputError:
        """Return the error that points at the header line."""
        return InputError(message, file=self.source, line=len(self.before))

    def check(self, row: Sequence[str]) -> None:
        """Raise InputError if a cell and one following blank do not fit in its field."""
        for column, cell in zip(self.columns, row, strict=True):
            if column.width and len(cell) >= column.width:
                raise self.fail(
                    f"column {column.name} has {column.width} characters, {cell!r} needs {len(cell) + 1}; save a table "
                    "with wider columns, or write fewer decimals (decimals)"
                )


def default_layout(name: str, kind: str, columns: Sequence[tuple[str, int]]) -> ComLayout:
    """Return a default layout from name, extension, and (column, field width) in order."""
    header = "".join(f"{column:<{width}}" for column, width in columns).rstrip()
    starts = [sum(width for _, width in columns[:k]) for k in range(len(columns))]
    last = len(columns) - 1
    fields = tuple(
        TableColumn(column, starts[k], 0 if k == last else width) for k, (column, width) in enumerate(columns)
    )
    return ComLayout((f"{BEGIN} {name} .{kind} MM", header), fields)


def template_layout(path: Path, kind: str) -> ComLayout:
    """Return the layout of an empty table saved on a control; InputError with the line if it is not usable.

    Parameters
    ----------
    path : the saved table.
    kind : extension that its first line must have, ``COM`` or ``CMA``.
    """
    content = read_bytes(path)
    try:
        text = content.decode("ascii")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError("contains a byte that is not ASCII", file=path, line=line) from None
    file = SourceFile(path, text)
    table = read_table(file)
    if table.kind != kind:
        raise file.fail(f"is a table of type {table.kind or 'unknown'}; expected an empty .{kind} table", 1)
    for row in table.rows:
        filled = [cell for name, cell in row.cells.items() if name != NUMBER_COLUMN and cell.strip("-+0.")]
        if filled:
            message = f"contains {one_line(filled[0])[:20]!r}; expected a table without values as a template"
            raise file.fail(message, row.line)
    ends = [line.endswith("\r") for line in file.text.split("\n")[:-1]]
    if len(set(ends)) > 1:
        message = "does not end like the first line (CR LF and LF are mixed)"
        raise file.fail(message, ends.index(not ends[0]) + 1)
    fields = tuple(
        TableColumn(column.name, column.start, 0 if k == len(table.columns) - 1 else column.width)
        for k, column in enumerate(table.columns)
    )
    return ComLayout(table.before, fields, table.after, bool(ends and ends[0]), path)
