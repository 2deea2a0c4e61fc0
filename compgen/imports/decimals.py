"""Decimal commas and marks between thousands in the cells of a foreign table."""

from __future__ import annotations

import re
from collections.abc import Sequence

from compgen.errors import InputError
from compgen.imports.source import shown

_THOUSANDS_COMMA = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d+")
_THOUSANDS_POINT = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d+")
#: Thousands parted by a blank or an apostrophe can be read in one way only.
_THOUSANDS_BLANK = re.compile(r"[+-]?\d{1,3}([ \u00a0\u202f'\u2019]\d{3})+([.,]\d+)?")
_BLANKS = re.compile(r"[ \u00a0\u202f'\u2019]")
#: A number that may have a decimal comma or thousands.
_EITHER = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_POINT = re.compile(r"[+-]?\d*\.\d+([eE][+-]?\d+)?")


def plain_decimals(rows: list[list[str]], lines: Sequence[int], decimal: str | None) -> tuple[list[list[str]], bool]:
    """Turn decimal commas into points if the rows use them, and take marks between thousands out.

    ``decimal`` is what the user says, "comma" or "point". Raises InputError for rows that mix both, and for numbers that may
    be either (1,000).
    """
    together = "".join(map("".join, rows))
    if _BLANKS.search(together):
        rows = [[_BLANKS.sub("", c) if _THOUSANDS_BLANK.fullmatch(c) else c for c in row] for row in rows]
    if decimal is not None:
        return [
            [_said(cell, decimal, line) for cell in row] for row, line in zip(rows, lines, strict=True)
        ], decimal == "comma"
    if "," not in together:
        return rows, False
    comma, point, either = _first_lines(rows, lines)
    if comma and point:
        message = f"a decimal comma stands here, a decimal point in line {point}; write all numbers in one way, or say --decimal"
        raise InputError(f"{message} comma or point (the other parts thousands)", line=comma)
    if either and not (comma or point):
        raise InputError(
            "numbers such as 1,000 may be 1000 or 1.000; say --decimal point (1000) or comma (1.000)", line=either
        )
    changed = comma or any(_THOUSANDS_COMMA.fullmatch(cell) for row in rows for cell in row)
    return [[_plain(cell) for cell in row] for row in rows] if changed else rows, bool(comma)


def _first_lines(rows: list[list[str]], lines: Sequence[int]) -> tuple[int, int, int]:
    """Return the lines of the first decimal comma, decimal point, and number that may have a comma or thousands (0: none)."""
    comma = point = either = 0
    for row, line in zip(rows, lines, strict=True):
        for cell in row:
            if _EITHER.fullmatch(cell):
                either = either or line
            elif _COMMA.fullmatch(cell) or _THOUSANDS_POINT.fullmatch(cell):
                comma = comma or line
            elif _POINT.fullmatch(cell) or _THOUSANDS_COMMA.fullmatch(cell):
                point = point or line
    return (comma or either, point, 0) if point else (comma, point, either)


def _said(cell: str, decimal: str, line: int) -> str:
    """Return a number in the way that the user says; other text stays."""
    mark, other = (",", ".") if decimal == "comma" else (".", ",")
    if re.fullmatch(rf"[+-]?(\d*|[1-9]\d{{0,2}}([{other}]\d{{3}})+)([{mark}]\d*)?([eE][+-]?\d+)?", cell):
        return cell.replace(other, "").replace(mark, ".")
    if _COMMA.fullmatch(cell) or _POINT.fullmatch(cell):
        raise InputError(
            f"{shown(cell)} has no decimal {decimal}, and parts no thousands", line=line, field="--decimal"
        )
    return cell


def _plain(cell: str) -> str:
    if _COMMA.fullmatch(cell):
        return cell.replace(",", ".")
    if _THOUSANDS_POINT.fullmatch(cell):
        return cell.replace(".", "").replace(",", ".")
    return cell.replace(",", "") if _THOUSANDS_COMMA.fullmatch(cell) else cell
