"""Splitting CSV text into fields: a fast way for files as programs write them, a thorough one for all others."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from compgen.errors import InputError

#: Quotes, comments and all white space of ASCII but the line feed.
_NOT_PLAIN = '"#\0\r\t\v\f \x1c\x1d\x1e\x1f'


@dataclass(frozen=True)
class CsvFile:
    """What stands in a file: its header, and the fields either by row or, one after the other, in ``flat``."""

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
    """Read a file as programs write it, several times faster than :func:`parse_any`; None if it is not one.

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
    count = _even_rows(body, len(names)) if body.isascii() and body.endswith("\n") else None
    if count is None or len(names) < 2:
        return None
    flat = body[:-1].replace("\n", ",").split(",")
    return CsvFile(number, names, range(number + 1, number + 1 + count), metadata, flat=flat)


def _even_rows(body: str, width: int) -> int | None:
    """Number of rows if every row of ``body`` has ``width`` fields of a reasonable length, else None."""
    text = np.frombuffer(body.encode("ascii"), dtype=np.uint8)
    ends = np.flatnonzero((text == ord(",")) | (text == ord("\n")))
    if len(ends) % width or np.diff(ends, prepend=-1).max() > csv.field_size_limit():
        return None
    is_line_end = text[ends].reshape(-1, width) == ord("\n")
    return len(is_line_end) if is_line_end[:, -1].all() and not is_line_end[:, :-1].any() else None


def _note_metadata(line: str, metadata: dict[str, str]) -> bool:
    """Whether a stripped line is a comment or empty; a comment ``# key = value`` goes to ``metadata``."""
    if line.startswith("#"):
        key, equals, value = line.lstrip("#").partition("=")
        if equals and value.strip():  # a date that nobody filled in is not a date
            metadata[key.strip()] = value.strip()
        return True
    return not line


def parse_any(source: Path, content: str) -> CsvFile:
    """Read any file of the dialect, line by line."""
    metadata: dict[str, str] = {}
    numbers: list[int] = []
    data: list[str] = []
    for number, line in enumerate(re.split(r"\r\n|\r|\n", content), start=1):
        if not _note_metadata(line.strip(), metadata):
            numbers.append(number)
            data.append(line)
    if not data:
        return CsvFile(0, [], [], metadata, rows=[])
    if "\0" in content:
        raise InputError("holds NUL bytes; it is not a text file", file=source)
    reader = csv.reader(data, strict=True, skipinitialspace=True)
    try:
        parsed = list(reader)
    except csv.Error as error:
        line_number = numbers[max(reader.line_num, 1) - 1]
        raise InputError(f"is not readable as CSV: {error}", file=source, line=line_number) from error
    if len(parsed) != len(data):
        raise InputError("a quoted field runs over a line end; write each row on one line", file=source)
    header = [name.strip() for name in parsed[0]]
    return CsvFile(numbers[0], header, numbers[1:], metadata, rows=parsed[1:])
