"""Excel workbooks (.xlsx): checked as archives before they are opened, then read row by row without formulas."""

from __future__ import annotations

import datetime
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from compgen.core.text import nearest
from compgen.errors import InputError
from compgen.imports.grid import MOST_COLUMNS, MOST_ROWS, Grid
from compgen.imports.source import MEGABYTE, check_size, shown

#: Limits of the archive: packed, unpacked, and members; a workbook that is a bomb is refused before it is unpacked.
MOST_PACKED, MOST_UNPACKED, MOST_MEMBERS = 64 * MEGABYTE, 256 * MEGABYTE, 2_000
#: One sheet, unpacked: some one and a half million cells, half a minute of reading.
MOST_SHEET = 48 * MEGABYTE
#: Unpacked bytes for each packed one, above which a member of more than a megabyte is a bomb; sheets have up to 60.
MOST_RATIO = 300
_FORBIDDEN = (b"<!DOCTYPE", b"<!ENTITY", "<!DOCTYPE".encode("utf-16-le"), "<!DOCTYPE".encode("utf-16-be"))
_BLOCK = 1 << 20
_EMPTY = " (of merged cells only the first is filled; a formula that was never calculated is empty: open and save the workbook)"


def read_sheets(path: Path, name: str | None = None) -> tuple[list[tuple[str, Grid]], list[str]]:
    """Return name and cells of every sheet that holds any, and the names of hidden ones, which are left out.

    ``name`` is a sheet that is wanted though it be hidden. InputError for what is no workbook, or unsafe.

    Cells hold text; numbers have all their digits, whatever the format of the cell shows; formulas count with the value
    that was stored with them.
    """
    check_size(path, MOST_PACKED)
    _check_archive(path)
    with _opened(path) as book:
        hidden = [sheet.title for sheet in book.worksheets if sheet.sheet_state != "visible" and sheet.title != name]
        if len(hidden) == len(book.worksheets):
            hidden = []
        found = [(sheet.title, _grid(path, sheet)) for sheet in book.worksheets if sheet.title not in hidden]
    filled = [(name, grid) for name, grid in found if grid.rows]
    if not filled:
        raise InputError("is a workbook without any filled cell", file=path)
    return filled, hidden


def chosen_sheet(path: Path, sheets: list[tuple[str, Grid]], name: str | None) -> tuple[str, Grid] | None:
    """Return the sheet that the user named, the only one there is, or None if there are several."""
    if name is not None:
        for title, grid in sheets:
            if title == name:
                return title, grid
        raise InputError(
            f"has no sheet {shown(name)}; {nearest(name, [title for title, _ in sheets])}", file=path, field="--sheet"
        )
    return sheets[0] if len(sheets) == 1 else None


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a workbook; whatever the reader trips over becomes an InputError."""
    # reads .xlsx in a stream, without Excel; the one well-kept reader of that format; imported here: slow to load
    from openpyxl import load_workbook

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # styles and extensions that it does not know do not matter
            book = load_workbook(path, read_only=True, data_only=True, keep_links=False)
            try:
                yield book
            finally:
                book.close()
    except (InputError, MemoryError):
        raise
    except Exception as error:  # a damaged workbook shows as any of a dozen exceptions of three packages
        raise InputError(f"is a damaged workbook: {type(error).__name__}: {error}"[:300], file=path) from error


def _check_archive(path: Path) -> None:
    """Unpack every part once, in blocks, and count: what is declared may be wrong."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            names = {member.filename for member in members}
            if "[Content_Types].xml" not in names or not any(name.startswith("xl/") for name in names):
                raise InputError("is a zip archive but no .xlsx workbook", file=path)
            declared = sum(member.file_size for member in members)
            if len(members) > MOST_MEMBERS or declared > MOST_UNPACKED:
                text = f"unpacks to {declared / MEGABYTE:.0f} MB in {len(members)} parts; at most "
                raise InputError(f"{text}{MOST_UNPACKED / MEGABYTE:.0f} MB in {MOST_MEMBERS} are read", file=path)
            for member in members:
                _check_member(path, archive, member)
    except InputError:
        raise
    except (zipfile.BadZipFile, OSError, ValueError, RuntimeError, NotImplementedError, EOFError) as error:
        raise InputError(f"is a damaged or cut workbook: {error}", file=path) from error
    except Exception as error:  # zlib.error and its kin
        raise InputError(f"is a damaged workbook: {type(error).__name__}", file=path) from error


def _check_member(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    if member.file_size > MEGABYTE and member.file_size > MOST_RATIO * max(1, member.compress_size):
        message = (
            f"{shown(member.filename)} unpacks to {member.file_size / max(1, member.compress_size):.0f} times its size"
        )
        raise InputError(f"{message}: it is no measurement (a zip bomb?)", file=path)
    if member.filename.startswith("xl/worksheets/") and member.file_size > MOST_SHEET:
        message = f"has a sheet of {member.file_size / MEGABYTE:.0f} MB unpacked; at most {MOST_SHEET / MEGABYTE:.0f} MB are read"
        raise InputError(f"{message}: save that sheet as CSV, which is read up to a million rows", file=path)
    if not member.filename.endswith((".xml", ".rels", ".vml")):
        return
    tail = b""
    with archive.open(member) as stream:
        while block := stream.read(_BLOCK):
            seen = (tail + block).upper() if b"<!" in tail + block or b"<\0" in tail + block else b""
            if any(mark.upper() in seen for mark in _FORBIDDEN):
                raise InputError(f"{shown(member.filename)} declares XML entities; it is refused", file=path)
            tail = block[-64:]


def _grid(path: Path, sheet: Any) -> Grid:
    rows, lines = [], []
    sheet.reset_dimensions()  # the stored size may be wrong
    for number, values in enumerate(sheet.iter_rows(values_only=True), start=1):
        if number > MOST_ROWS:
            raise InputError(f"sheet {shown(sheet.title)} has more than {MOST_ROWS} rows", file=path)
        cells = [_cell(value) for value in values[:MOST_COLUMNS]]
        if any(cells):
            rows.append(cells)
            lines.append(number)
    return Grid(path, rows, lines, (f"sheet {shown(sheet.title)}",), _EMPTY)


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, datetime.datetime | datetime.date | datetime.time):
        return value.isoformat()
    return " ".join(str(value).split())
