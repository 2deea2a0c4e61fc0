"""ETALON_EXCHANGE (``etalon-exchange``): the exchange file of Etalon's software, for the ISG kernel and as error file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls.isg_kernel import (
    ANGLE_DIGITS,
    ARGUMENTS,
    CONTROL_NAMES,
    ISO_NAMES,
    LENGTH_DIGITS,
    POSITION_DIGITS,
    ErrorParameter,
    IsgTables,
    ParameterFile,
    VolumetricController,
    check_name,
    collect,
    is_rotary,
)
from compgen.controls.shared.base import SourceFile
from compgen.controls.shared.grids import ParameterGrid, grid_order
from compgen.controls.shared.scanner import check_complete, content_lines, floating, uses_exponent
from compgen.data.error_table import Curve, ErrorTable, read_errors
from compgen.data.files import read_text
from compgen.data.names import SQUARENESS_NAMES, error_named

# ETALON_EXCHANGE: the exchange file of Etalon's software, variant "Vendor" (ISG kernel help, page 296430091).
#
# ``[EXY]`` starts a parameter; ``VALUE = number`` gives a constant, ``Gridpoints = {`` rows ``argument value`` and ``}``
# a curve over the axis' own position. ``//`` starts a comment. :func:`errors_from_etalon` imports such a file.


_SECTION = re.compile(r"\[\s{0,9}([A-Za-z0-9_]{1,40})\s{0,9}\]")
_VALUE = re.compile(r"value\s{0,40}=\s{0,40}(\S+)", re.IGNORECASE)
_GRID = re.compile(r"gridpoints\s{0,40}=\s{0,40}\{", re.IGNORECASE)


@dataclass
class _Section:
    """One ``[NAME]`` while it is read; ``open`` between the braces of its grid points."""

    name: str
    line: int
    value: float | None = None
    rows: list[tuple[int, list[str]]] = field(default_factory=list)
    open: bool = False
    grid: bool = False


def parse_etalon(source: SourceFile) -> ParameterFile:
    """Read an ETALON_EXCHANGE file; InputError with file and line for anything that the grammar does not have."""
    sections: list[_Section] = []
    exponent: int | None = None
    for line, text in content_lines(source):
        _take_line(source, sections, line, text)
        if exponent is None and uses_exponent([word for word in text.split() if word[0] in "+-.0123456789"]):
            exponent = line
    if sections and sections[-1].open:
        raise source.fail(f"[{sections[-1].name}] has no closing brace: the file was cut", sections[-1].line)
    records = sum(len(section.rows) if section.grid else 1 for section in sections)
    parameters = []
    for section in sections:
        name, line = section.name, section.line
        if section.value is not None:
            parameters.append(ErrorParameter(name, ParameterGrid((), (), np.array(section.value)), source, line))
            continue
        if not section.rows:
            raise source.fail(f"[{name}] has no values; was the file cut?", line)
        if name in ISO_NAMES and ISO_NAMES[name] in SQUARENESS_NAMES:
            raise source.fail(f"[{name}] is a constant; expected 'VALUE = number'", line)
        pairs = np.array([[floating(source, at, word, name) for word in words] for at, words in section.rows])
        nodes, order = grid_order(source, [at for at, _ in section.rows], [pairs[:, 0]])
        axis = 0 if is_rotary(name) else ARGUMENTS.index(name[-1])
        parameters.append(ErrorParameter(name, ParameterGrid((axis,), nodes, pairs[order, 1]), source, line))
    check_complete(source, records)
    return ParameterFile(tuple(parameters), records, exponent)


def _take_line(source: SourceFile, sections: list[_Section], line: int, text: str) -> None:
    """Add one line to the section that is being read, or start a new one."""
    current = sections[-1] if sections else None
    header = _SECTION.match(text)
    if header and not (current and current.open):
        check_name(source, line, header.group(1))
        if len(header.group(1)) == 1:
            raise source.fail(f"[{header.group(1)}] is an argument; expected a parameter such as [EXX]", line)
        sections.append(_Section(header.group(1), line))
        if rest := text[header.end() :].strip():
            _take_entry(source, sections[-1], line, rest)
    elif current is None:
        raise source.fail(f"expected a parameter name in brackets such as [EXX], found {text[:40]!r}", line)
    elif current.open:
        row, brace, rest = text.partition("}")
        words = row.split()
        if rest or len(words) not in ((0, 2) if brace else (2,)):
            message = f"expected two numbers 'argument value' or '}}' in [{current.name}], got {text[:40]!r}"
            raise source.fail(message, line)
        if words:
            current.rows.append((line, words))
        current.open = not brace
    else:
        _take_entry(source, current, line, text)


def _take_entry(source: SourceFile, section: _Section, line: int, text: str) -> None:
    if section.grid or section.value is not None:
        raise source.fail(f"[{section.name}] has its value already; expected a new [NAME], got {text[:40]!r}", line)
    value = _VALUE.fullmatch(text)
    if value:
        section.value = floating(source, line, value.group(1), section.name)
    elif _GRID.fullmatch(text):
        section.grid = section.open = True
    else:
        message = f"expected 'VALUE = number' or 'Gridpoints = {{' in [{section.name}], got {text[:40]!r}"
        raise source.fail(message, line)


def is_exchange_text(text: str) -> bool:
    """Whether a text begins, after comments, with a parameter name in brackets, as an exchange file does."""
    for line in text[:20_000].split("\n"):
        content = line.partition("//")[0].strip()
        if content:
            return _SECTION.match(content) is not None
    return False


def errors_from_etalon(text: str, path: Path | None = None) -> ErrorTable:
    """Import an exchange file that a laser tracer's software wrote ("Vendor" variant).

    Parameters
    ----------
    text : contents of the file; lengths in mm, angles in rad, positions in mm.
    path : where it came from, for messages.

    Returns
    -------
    the errors as in the file, squareness in the convention of ISO 230-1 (X is the reference); uncertainties unknown.
    Errors of rotary axes are left out with a warning.
    """
    source = SourceFile(path or Path("exchange file"), text)
    fields, _ = collect(parse_etalon(source).parameters)
    curves = {name: _curve(item) for name, item in fields.items() if name not in SQUARENESS_NAMES}
    squareness = {name: (float(fields[name].values), np.nan) for name in SQUARENESS_NAMES if name in fields}
    return ErrorTable(curves, squareness, {"source": source.path.name, "format": "ETALON_EXCHANGE"})


def _curve(item: ParameterGrid) -> Curve:
    position = item.nodes_mm[0] if item.axes else np.zeros(1)
    value = np.atleast_1d(item.values)
    return Curve(position, value, np.full(len(value), np.nan))


class EtalonExchange(VolumetricController):
    """``etalon-exchange``: one section per parameter."""

    name = "etalon-exchange"
    file_format = "ETALON_EXCHANGE"
    parameter_file = "volcomp0.etalon.txt"

    def parse_parameters(self, source: SourceFile) -> ParameterFile:
        """Read one exchange file."""
        return parse_etalon(source)

    def count_records(self, fields: Mapping[str, ParameterGrid], constants: Mapping[str, float]) -> int:
        """One record per VALUE and per row of grid points."""
        return sum(int(np.size(item.values)) for item in fields.values()) + len(constants)

    def body(self, tables: IsgTables) -> dict[str, Any]:
        """Return the sections: squareness first, then the curves with their rows."""
        names = [*(name for name in SQUARENESS_NAMES if name in tables.fields)]
        names += [name for name in tables.fields if name not in names]
        return {"sections": [_section(name, tables.fields[name]) for name in names]}


def _section(name: str, item: ParameterGrid) -> dict[str, Any]:
    linear = error_named(name).kind == "linear"
    rows = list(zip(item.nodes_mm[0].tolist(), item.values.tolist(), strict=True)) if item.axes else []
    return {
        "name": CONTROL_NAMES[name],
        "unit": "mm" if linear else "rad",
        "digits": LENGTH_DIGITS if linear else ANGLE_DIGITS,
        "position_digits": POSITION_DIGITS,
        "value": None if item.axes else float(item.values),
        "rows": rows,
    }


# Errors from the files that users have: ``*.errors.csv``, or an exchange file that a laser tracer's software wrote.


def read_error_file(path: str | Path) -> ErrorTable:
    """Read an ``*.errors.csv`` file (um, urad) or an Etalon exchange file, variant Vendor (mm, rad).

    Which of the two it is shows in the text: an exchange file begins, after comments, with a name in brackets.
    """
    source = Path(path)
    text = read_text(source)
    return errors_from_etalon(text, source) if is_exchange_text(text) else read_errors(source)
