"""The CSV dialect of native files: comma, a header, ``# key = value`` comments, strict numbers.

A text is split into fields (:func:`parse_plain` for files written by programs, :func:`parse_any` for all others) and
becomes a :class:`CsvTable` whose columns are checked when they are requested; :func:`format_csv` writes the same
dialect.
"""

from __future__ import annotations

import csv
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import path_of
from compgen.data.files import LONGEST_LINE, decoded, read_text
from compgen.data.names import LARGEST, SMALLEST
from compgen.errors import CompgenWarning, InputError, Message, doubled, nearest, visible_line

#: How much of a large file is in memory at a time, bytes.
PART_BYTES = 1 << 22
_LINE_END = re.compile(r"\r\n|\r|\n")
#: Quotes, comments and all ASCII white space except the line feed.
_NOT_PLAIN = '"#\0\r\t\v\f \x1c\x1d\x1e\x1f'


@dataclass(frozen=True)
class CsvFile:
    """The contents of a file: its header, and the fields either by row or in sequence in ``flat``."""

    header_line: int
    header: list[str]
    lines: Sequence[int]
    metadata: dict[str, str]
    rows: list[list[str]] | None = None
    flat: list[str] = field(default_factory=list)

    def column(self, k: int) -> list[str]:
        """Return the fields of one column."""
        if self.rows is None:
            return self.flat[k :: len(self.header)]
        return [row[k].strip() for row in self.rows]


def parse_plain(content: str) -> CsvFile | None:
    """Read a file written by a program, several times faster than :func:`parse_any`; None for other files.

    Such a file is ASCII without quotes or spaces below its header, has at least two columns, the
    same number in each row, no comment between rows, and ends with a line end.
    """
    unix = content.replace("\r\n", "\n")
    metadata: dict[str, str] = {}
    start = number = 0
    header = ""
    while not header:
        end = unix.find("\n", start)
        if end < 0:
            return None
        line, start, number = unix[start:end].strip(), end + 1, number + 1
        if not _note_metadata(line, metadata):
            header = line
    names, body = [name.strip() for name in header.split(",")], unix[start:]
    if any(mark in unix[:start] for mark in "\r\0") or '"' in header or any(mark in body for mark in _NOT_PLAIN):
        return None
    width = len(names)
    if width < 2 or not body.isascii() or not body.endswith("\n"):
        return None
    marks = np.frombuffer(body.encode("ascii"), dtype=np.uint8)
    ends = np.flatnonzero((marks == ord(",")) | (marks == ord("\n")))
    if len(ends) % width or np.diff(ends, prepend=-1).max() > csv.field_size_limit():
        return None
    is_line_end = marks[ends].reshape(-1, width) == ord("\n")
    if not is_line_end[:, -1].all() or is_line_end[:, :-1].any():  # rows of different lengths
        return None
    count = len(is_line_end)
    flat = body[:-1].replace("\n", ",").split(",")
    return CsvFile(number, names, range(number + 1, number + 1 + count), metadata, flat=flat)


def _note_metadata(line: str, metadata: dict[str, str]) -> bool:
    """Whether a stripped line is a comment or empty; a comment ``# key = value`` goes to ``metadata``."""
    if line.startswith("#"):
        metadata.update([found] if (found := comment_of(line)) else [])
        return True
    return not line


def comment_of(line: str) -> tuple[str, str] | None:
    """Return key and value of a comment ``# key = value``; None for another line, and for an empty value.

    >>> comment_of("# operator = A. Example"), comment_of("# a note")
    (('operator', 'A. Example'), None)
    """
    key, equals, value = line.lstrip("#").partition("=")
    # an empty value is not set
    return (key.strip(), value.strip()) if line.startswith("#") and equals and value.strip() else None


def comments_of(path: str | Path) -> dict[str, str]:
    """Return the comments ``# key = value`` of a text file; none of a file of another kind, or that cannot be read."""
    try:
        with open(path, encoding="utf-8-sig", errors="replace") as lines:
            return dict(found for line in lines if (found := comment_of(line.strip())))
    except OSError:
        return {}


def parse_any(source: Path, content: str) -> CsvFile:
    """Read any file of the dialect, line by line."""
    metadata: dict[str, str] = {}
    numbers: list[int] = []
    data: list[str] = []
    for number, line in enumerate(_LINE_END.split(content), start=1):
        if not _note_metadata(line.strip(), metadata):
            numbers.append(number)
            data.append(line)
    if not data:
        return CsvFile(0, [], [], metadata, rows=[])
    if "\0" in content:
        raise InputError(Message("file-binary", "contains NUL bytes; it is not a text file"), file=source)
    reader = csv.reader(data, strict=True, skipinitialspace=True)
    try:
        parsed = list(reader)
    except csv.Error as error:
        line_number = numbers[max(reader.line_num, 1) - 1]
        raise InputError(
            Message("csv-unreadable", "is not readable as CSV: {error}", error=error), file=source, line=line_number
        ) from error
    if len(parsed) != len(data):
        raise InputError(
            Message("csv-line-end-in-field", "a quoted field contains a line end; write each row on one line"),
            file=source,
        )
    header = [name.strip() for name in parsed[0]]
    return CsvFile(numbers[0], header, numbers[1:], metadata, rows=parsed[1:])


# The CSV dialect of the contract: comma, header, ``#`` comments with ``key = value`` metadata, strict numbers.


FloatArray = NDArray[np.float64]
_LARGEST_LABEL = 2.0**53
_ROWS_AT_ONCE = 10_000
#: Numbers below this size with at most so many decimals are written digit by digit, and rounded like any other: a
#: product with 10**digits is right to less than ``_TIE``.
_LARGEST_BY_DIGITS, _MOST_BY_DIGITS, _TIE = 9999.5, 8, 1e-3
#: A spreadsheet interprets a cell with such a beginning as a formula, in a comment also after a comma.
_FORMULA = re.compile(r"'*[=+\-@]")
_IN_COMMENT = re.compile(r"(?<=[,;])(?=[=+\-@])")
#: Limits: columns of a header; fields of a file, each of which takes some sixty bytes; characters of the header in a message;
#: ignored columns that are listed.
MOST_COLUMNS, MOST_FIELDS, _SHOWN, _NAMED = 10_000, 60_000_000, 200, 20


@dataclass(frozen=True)
class CsvTable:
    """The rows of one CSV file as columns of text; numbers are converted, and checked, on request.

    ``lines`` holds the line number of each row, ``metadata`` the ``# key = value`` comments.
    """

    path: Path
    columns: Mapping[str, Sequence[str]]
    lines: Sequence[int]
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.lines)

    def fail(self, row: int, column: str, message: str) -> InputError:
        """Return the error about one cell."""
        return InputError(message, file=self.path, line=self.lines[row], field=f"column {column}")

    def text(self, column: str) -> list[str]:
        """Return a column of labels, as passed to :func:`format_csv`; an empty cell is an error."""
        cells = self.words(column)
        for row, cell in enumerate(cells):
            if not cell:
                raise self.fail(row, column, Message("cell-empty", "is empty; every row needs a label here"))
        return [cell[1:] if cell[0] == "'" and _FORMULA.match(cell) else cell for cell in cells]

    def names(self, column: str) -> list[str]:
        """Return a column of names of stations: labels without "=", which separates a name from its value elsewhere."""
        found = self.text(column)
        if "=" in "".join(found):
            row = next(k for k, name in enumerate(found) if "=" in name)
            cell = visible_line(found[row])[:40]
            raise self.fail(
                row, column, Message("cell-not-name", "{cell!r} is not a valid name; remove the '='", cell=cell)
            )
        return found

    def numbers(self, column: str, *, empty: float | None = None, most: float = LARGEST) -> FloatArray:
        """Return a column as finite numbers up to ``most``, shape (rows,); empty cells become ``empty`` if it is given."""
        cells, values = self.columns[column], self.parsed(column, empty)
        if not (np.abs(values) <= most).all():
            row = next((k for k in range(len(cells)) if cells[k] and not abs(values[k]) <= most), None)
            if row is not None:
                finite = math.isfinite(values[row])
                what = f"is larger than {most:g}, the largest number allowed" if finite else "is not a finite number"
                raise self.fail(row, column, f"{cells[row]!r} {what}")
        values[np.abs(values) < SMALLEST] = 0.0  # too small for a measured value, and its square would underflow
        return values

    def words(self, column: str) -> Sequence[str]:
        """Return the cells of a column as text."""
        return self.columns[column]

    def parsed(self, column: str, empty: float | None) -> FloatArray:
        """Return a column as numbers of any size, shape (rows,); empty cells become ``empty`` if it is given."""
        cells = self.columns[column]
        filled = list(cells) if empty is None else [cell or repr(empty) for cell in cells]
        try:
            values = np.array(filled, dtype=np.float64)
        except ValueError:
            raise self._bad_number(column, filled) from None
        together = "".join(filled)
        if (
            "_" in together or not together.isascii()
        ):  # Python accepts 1_000 and digits of other scripts; files must not have them
            raise self._bad_number(column, filled)
        return values

    def _bad_number(self, column: str, cells: Sequence[str]) -> InputError:
        for row, cell in enumerate(cells):
            if not _is_number(cell):
                if not cell:
                    return self.fail(
                        row, column, Message("cell-no-number", "is empty; expected a number with '.' as decimal point")
                    )
                shown = visible_line(cell)[:40]
                return self.fail(
                    row,
                    column,
                    Message(
                        "cell-not-number",
                        "{cell!r} is not a number; expected a number with '.' as decimal point",
                        cell=shown,
                    ),
                )
        return InputError(
            Message("csv-text-for-number", "contains text; expected numbers"), file=self.path, field=f"column {column}"
        )

    def labels(self, column: str) -> NDArray[np.int64]:
        """Return a column of whole-number labels, shape (rows,)."""
        values = self.numbers(column, most=np.finfo(np.float64).max)
        wrong = np.flatnonzero((values != np.round(values)) | (np.abs(values) > _LARGEST_LABEL))
        if wrong.size:
            row = int(wrong[0])
            cell = self.columns[column][row]
            raise self.fail(
                row, column, Message("cell-not-whole", "{cell!r} is not a whole number below 2^53", cell=cell)
            )
        return values.astype(np.int64)

    def signs(self, column: str) -> FloatArray:
        """Return a column of directions of travel, +1, -1 or 0 (unknown), shape (rows,)."""
        values = self.numbers(column)
        wrong = np.flatnonzero(~np.isin(values, (-1.0, 0.0, 1.0)))
        if wrong.size:
            row = int(wrong[0])
            cell = self.columns[column][row]
            raise self.fail(
                row,
                column,
                Message("cell-not-direction", "{cell!r} is not a direction; expected 1, -1 or 0", cell=cell),
            )
        return values


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell


def whole_number(text: str, digits: int = 9) -> int | None:
    """Return a whole number of at most so many plain digits, without a sign; None for anything else.

    >>> whole_number("007"), whole_number("\u00b2"), whole_number("9" * 5000)
    (7, None, None)
    """
    return int(text) if text.isascii() and text.isdigit() and len(text) <= digits else None


def names_in_header(text: str) -> set[str]:
    """Return the names in the first line of a text that is not a comment; empty without one."""
    lines = (line.strip() for line in text.splitlines())
    header = next((line for line in lines if line and not line.startswith("#")), "")
    return {name.strip().strip('"') for name in header.split(",")}


def read_csv(
    path: str | Path, required: Iterable[str], optional: Iterable[str] = (), prefixes: Iterable[str] = ()
) -> CsvTable:
    """Read a CSV file strictly.

    Parameters
    ----------
    path : the file.
    required, optional : column names; others are left out with a warning.
    prefixes : further allowed columns begin with one of these (e.g. ``temp_``), or match one that holds a ``*``.

    Raises
    ------
    InputError
        for an empty file, a missing or doubled column, a row with too few or too many fields, a truncated last line.
    """
    source = path_of("path", path)
    return csv_table(source, read_text(source), required, optional, prefixes)


def csv_table(
    source: Path, content: str, required: Iterable[str], optional: Iterable[str] = (), prefixes: Iterable[str] = ()
) -> CsvTable:
    """Read the text ``content`` of the file ``source`` as :func:`read_csv` does."""
    fields = content.count(",")
    if fields > MOST_FIELDS:
        raise InputError(
            Message(
                "csv-too-large",
                "has {fields} fields; at most {value} are read: leave out columns or rows",
                fields=fields,
                value=MOST_FIELDS,
            ),
            file=source,
        )
    file = parse_plain(content) or parse_any(source, content)
    required = list(required)
    _check_header(source, file.header_line, file.header, required)
    if not file.lines:
        raise InputError(Message("csv-no-rows", "has a header but no rows"), file=source, line=file.header_line)
    _check_widths(source, file, last=file.lines[-1])
    _check_complete(source, content, file, len(file.lines))
    kept = kept_columns(source, file.header_line, file.header, required, optional, prefixes)
    return CsvTable(source, {name: file.column(k) for k, name in kept.items()}, file.lines, file.metadata)


def csv_parts(
    path: str | Path, required: Iterable[str], optional: Iterable[str] = (), prefixes: Iterable[str] = ()
) -> Iterator[CsvTable]:
    """Read a CSV file of any size as strictly as :func:`read_csv`, with only a part of it in memory.

    The parts have the line numbers of the file and share ``metadata``, which is complete after the last one.
    """
    source, kept, header, metadata = Path(path), dict[int, str](), "", dict[str, str]()
    required = list(required)
    count, before, header_line, content, file = 0, 0, 0, "", CsvFile(0, [], [], metadata)
    for content in _parts(source):
        # every part is read like a file that begins with the header; ``before`` are the lines above it
        skipped = before - bool(header)
        text = f"{header}\n{content}" if header else content
        try:
            part = parse_plain(text) or parse_any(source, text)
        except InputError as error:
            line = None if error.line is None else error.line + skipped
            raise InputError(error.message, file=source, line=line, field=error.field) from error
        metadata.update(part.metadata)
        before += len(_LINE_END.findall(content)) if "\r" in content else content.count("\n")
        if part.header and not header:
            header_line = part.header_line + skipped
            _check_header(source, header_line, part.header, required)
            header = _LINE_END.split(text, part.header_line)[part.header_line - 1]
        if part.lines:
            file = replace(part, lines=[line + skipped for line in part.lines], metadata=metadata)
            _check_widths(source, file, last=None)
            if not count:
                kept = kept_columns(source, header_line, part.header, required, optional, prefixes)
            count += len(file.lines)
            yield CsvTable(source, {name: file.column(k) for k, name in kept.items()}, file.lines, metadata)
    if not header:
        _check_header(source, 0, [], required)
    if not count:
        raise InputError(Message("csv-no-rows", "has a header but no rows"), file=source, line=header_line)
    _check_complete(source, content, file, count)


def _parts(source: Path) -> Iterator[str]:
    """Yield a text in parts of about :data:`PART_BYTES`, each of whole lines; the last one also has the end of the file."""
    lines, held, rest, encoding = 0, b"", b"", "utf-8-sig"
    try:
        with source.open("rb") as stream:
            while block := stream.read(PART_BYTES):
                whole, end, rest = (rest + block).rpartition(b"\n")
                if len(rest) > min(LONGEST_LINE, PART_BYTES):
                    line = lines + held.count(b"\n") + 1
                    raise InputError(
                        Message("file-line-too-long", "is too long for a line; is it a text file?"),
                        file=source,
                        line=line,
                    )
                if not end:
                    continue
                if held:
                    yield decoded(held, source, encoding, lines)
                    encoding, lines = "utf-8", lines + held.count(b"\n")
                held = whole + end
    except OSError as error:
        raise InputError(
            Message("file-unreadable", "cannot be read: {strerror}", strerror=error.strerror or error), file=source
        ) from error
    yield decoded(held + rest, source, encoding, lines)


def kept_columns(
    source: Path,
    line: int,
    header: Sequence[str],
    required: Iterable[str],
    optional: Iterable[str] = (),
    prefixes: Iterable[str] = (),
) -> dict[int, str]:
    """Return number and name of the columns of a header that are read; InputError for an invalid one."""
    required, patterns = list(required), tuple(prefixes)
    known = {*required, *optional}
    _check_header(source, line, header, required)
    strange = [name for name in header if not _is_allowed(name, known, patterns)]
    for name in strange[:_NAMED]:
        message = f"column {_shown(name)!r} is unknown and ignored; {nearest(name[:_SHOWN], known)}"
        warnings.warn(f"{source}:{line}: {message}", CompgenWarning, stacklevel=5)
    if len(strange) > _NAMED:
        warnings.warn(
            Message(
                "csv-columns-ignored",
                "{source}:{line}: {strange} more columns are ignored",
                source=source,
                line=line,
                strange=len(strange) - _NAMED,
            ),
            CompgenWarning,
            stacklevel=5,
        )
    return {k: name for k, name in enumerate(header) if _is_allowed(name, known, patterns)}


def _check_widths(source: Path, file: CsvFile, last: int | None) -> None:
    if file.rows is not None:
        for row, line in zip(file.rows, file.lines, strict=True):
            if len(row) != len(file.header):
                doubt = " (the last line: is the file truncated?)" if line == last else ""
                message = f"has {len(row)} fields, the header has {len(file.header)}{doubt}"
                raise InputError(message, file=source, line=line)


def _shown(text: str) -> str:
    """Return the beginning of a user's text on one line: a message does not repeat megabytes."""
    return visible_line(text[: 2 * _SHOWN])[:_SHOWN] + (" ..." if len(text) > _SHOWN else "")


def _is_allowed(name: str, known: set[str], patterns: tuple[str, ...]) -> bool:
    return name in known or any(fnmatchcase(name, p if "*" in p else f"{p}*") for p in patterns)


def _check_header(source: Path, line: int, header: Sequence[str], required: Iterable[str]) -> None:
    if not header:
        raise InputError(
            Message("csv-empty", "is empty; expected a header line with {required}", required=", ".join(required)),
            file=source,
        )
    if len(header) > MOST_COLUMNS:
        message = f"the header has {len(header)} columns; at most {MOST_COLUMNS} are allowed: is this a table?"
        raise InputError(message, file=source, line=line)
    twice = doubled(header)
    if twice is not None:
        raise InputError(
            Message("csv-column-twice", "the header contains {twice!r} twice", twice=_shown(twice)),
            file=source,
            line=line,
        )
    missing = [name for name in required if name not in header]
    if missing:
        needed, present = ", ".join(required), _shown(", ".join(header))
        hint = "; separate columns by commas" if len(header) == 1 and re.search(r"[;\t]", header[0]) else ""
        message = f"column {missing[0]!r} is missing; required are {needed}; the header has {present}{hint}"
        raise InputError(message, file=source, line=line)


def _check_complete(source: Path, content: str, file: CsvFile, count: int) -> None:
    """Refuse a truncated file of ``count`` rows: by its declared rows, or by a shorter last number without line end.

    A file that declares its rows was written by a program and ends with a line end; other files may lack it.
    """
    declared, last_line = file.metadata.get("rows"), file.lines[-1]
    if declared is not None and declared != str(count):
        raise InputError(
            Message(
                "csv-truncated",
                "declares {declared} rows but contains {count}: is it truncated?",
                declared=visible_line(declared),
                count=count,
            ),
            file=source,
        )
    if content.endswith(("\n", "\r")):
        return
    if declared is not None:
        message = "the last line has no line end: the file is truncated; if it is complete, end the line"
        raise InputError(message, file=source, line=last_line)
    *before, last = [len(cell.partition(".")[2]) for cell in file.column(len(file.header) - 1)]
    if len(before) > 1 and last < min(before):
        message = "the last line has no line end and fewer decimals than the others: the file is truncated"
        raise InputError(message, file=source, line=last_line)


def format_csv(
    columns: Mapping[str, Sequence[str] | FloatArray],
    metadata: Mapping[str, object] | None = None,
    decimals: Mapping[str, int] | None = None,
) -> str:
    """Return CSV text with ``# key = value`` comments, the number of rows among them, and a final line end.

    Numbers are written with ``decimals`` digits after the point (6 if not given), text unchanged; but a label that a
    spreadsheet would interpret as a formula gets an apostrophe before it, which :meth:`CsvTable.text` removes again.
    """
    digits = decimals or {}
    sizes = {len(values) for values in columns.values()}
    if len(sizes) > 1:
        raise ValueError(
            Message(
                "table-columns-differ",
                "columns differ in length: {columns}",
                columns=", ".join(f"{k} {len(v)}" for k, v in columns.items()),
            )
        )
    rows = max(sizes, default=0)
    facts = {**(metadata or {}), "rows": rows}
    noted = [f"# {visible_line(key)} = {visible_line(value)}" for key, value in facts.items()]
    comments = [_IN_COMMENT.sub(" ", line) for line in noted]
    text = ["\n".join([*comments, ",".join(columns)]), "\n"]
    for start in range(0, rows, _ROWS_AT_ONCE):
        some = {name: values[start : start + _ROWS_AT_ONCE] for name, values in columns.items()}
        pieces = [piece for name, values in some.items() for piece in (*_cells(values, digits.get(name, 6)), b",")]
        # rows of bytes of one length: what a shorter cell does not need is zero, and taken out
        widths = [len(piece) if isinstance(piece, bytes) else piece.itemsize for piece in pieces]
        block = np.empty(min(_ROWS_AT_ONCE, rows - start), [(f"{k}", f"S{width}") for k, width in enumerate(widths)])
        for k, piece in enumerate([*pieces[:-1], b"\n"]):
            block[f"{k}"] = piece
        text.append(block.tobytes().translate(None, b"\0").decode())
    return "".join(text)


def _cells(values: Sequence[str] | FloatArray, digits: int) -> list[bytes | NDArray[np.bytes_]]:
    """Return the cells of a column as UTF-8, in one piece or in several that follow each other, each (n,)."""
    if not isinstance(values, np.ndarray):
        texts = [str(value) for value in values]
        cells = {}
        for text in set(texts):  # a column has few different labels
            # one line, in quotes where it needs them, and never a formula for a spreadsheet
            flat = " ".join(text.replace("\0", " ").split())
            if _FORMULA.match(flat) and flat not in ("+", "-") and not _is_number(flat):
                flat = f"'{flat}"
            cells[text] = '"' + flat.replace('"', '""') + '"' if any(char in flat for char in ',"#') else flat
        return [np.array([cells[text].encode() for text in texts], dtype=np.bytes_)]
    numbers = np.asarray(values, dtype=np.float64)
    size = np.abs(numbers)
    if digits > _MOST_BY_DIGITS or not (size < _LARGEST_BY_DIGITS).all():  # also if one is nan
        return [np.array([fixed(value, digits).encode() for value in numbers.tolist()], dtype=np.bytes_)]
    scaled = size * 10.0**digits
    whole = np.rint(scaled)
    # the product is rounded: where that could matter, the number itself decides
    for k in np.flatnonzero(np.abs(np.abs(scaled - whole) - 0.5) < _TIE):
        whole[k] = float(f"{size[k]:.{digits}f}".replace(".", ""))
    left = np.floor(whole / 10.0**digits)
    fraction, high_digits = whole - left * 10.0**digits, max(digits - 4, 0)
    high = np.floor(fraction / 10_000.0)
    minus = np.where((numbers < 0.0) & (whole > 0.0), b"-", b"\0")
    parts: list[bytes | NDArray[np.bytes_]] = [minus, _digits(0)[left.astype(np.intp)]]
    parts += [b"."] if digits else []
    parts += [_digits(high_digits)[high.astype(np.intp)]] if high_digits else []
    return [*parts, _digits(min(digits, 4))[(fraction - 10_000.0 * high).astype(np.intp)]] if digits else parts


@cache
def _digits(width: int) -> NDArray[np.bytes_]:
    """Return 0 ... 9999 (or as many as there are) as ``width`` digits; for 0 without leading zeros, zero bytes before them."""
    shown = [str(k).rjust(4, "\0") if width == 0 else str(k).zfill(width) for k in range(10 ** (width or 4))]
    return np.array(shown, dtype=np.bytes_)


def fixed(value: float, digits: int) -> str:
    """Return ``value`` in fixed-point notation without exponent and without a negative zero.

    >>> fixed(-0.0000001, 3), fixed(12.5, 2), fixed(float("nan"), 2)
    ('0.000', '12.50', '')
    """
    if math.isnan(value):
        return ""
    if math.isinf(value):
        raise ValueError(Message("table-infinite", "an infinite number cannot be written to a table"))
    text = f"{value:.{digits}f}"
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text
