"""Columns beside the readings of a foreign table as numbers in the units of the contract."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.errors import InputError
from compgen.imports.columns import MM_PER_LENGTH, Column, quantity_of
from compgen.imports.findings import Findings
from compgen.imports.run_names import way
from compgen.imports.source import parse_number, shown
from compgen.imports.units import CELSIUS, Quantity, further_unit, units_of

#: Temperatures of a workshop and its machines, degC; a column without a unit is taken in the one that puts it here.
USUAL_C = (5.0, 45.0)
#: Beyond these a unit is wrong, or a sensor was not connected.
POSSIBLE_C = (-30.0, 120.0)
_CHANNELS = {
    "ambient": [
        "ambient",
        "air",
        "luft",
        "room",
        "raum",
        "umgebung",
        "hall",
        "halle",
        "environment",
        "ambiente",
        "aria",
        "delair",
        "dellaria",
        "delaire",
        "\u73af\u5883",
        "\u7a7a\u6c14",
    ],
    "spindle": ["spindle", "spindel", "spdl", "mandrin", "mandrino", "husillo", "broche"],
    "material": ["material", "mat", "workpiece", "werkstuck", "part", "teil"],
}
_FILLERS = re.compile(
    r"temperatur(?:en|es|e|a)?|temp|sensor|fuhler|scale|massstab|axis|achse|channel|kanal|celsius|\u6e29\u5ea6"
)


def is_temperature(column: Column) -> bool:
    """Whether a column holds a temperature, by its unit or its name."""
    return (column.unit in CELSIUS) or (column.unit is None and quantity_of(column.word) == "temperature")


def channel_of(word: str) -> str:
    """Return the name of a channel by the word of its column.

    >>> channel_of("temperaturxachse"), channel_of("airtemp"), channel_of("mattemp1"), channel_of("t3"), channel_of("temp")
    ('x', 'ambient', 'material_1', '3', 'measured')
    """
    rest = _FILLERS.sub("", word)
    for part in (rest, rest.removeprefix("t")):
        stem, number = re.fullmatch(r"(.*?)(\d*)", part).groups()  # type: ignore[union-attr]
        if stem in ("x", "y", "z") and not number:
            return str(stem)
        name = next((name for name, words in _CHANNELS.items() if stem in words), None)
        if name:
            return f"{name}_{number}" if number else name
    rest = rest[1:] if re.fullmatch(r"t\d*", rest) else rest
    return rest[:30] or "measured"


def _numbers(findings: Findings, column: Column) -> FloatArray:
    """Return the numbers of a column; InputError with the line for one that has other cells."""
    return np.array(findings.table.numbers(column.name))


def _given_unit(findings: Findings, key: str, quantity: Quantity) -> str | None:
    given = findings.options.units.get(key)
    if given is None:
        return None
    unit = further_unit(given, quantity)
    if unit is None:
        raise InputError(f"{given!r} is no unit of it; {', '.join(units_of(quantity))} are", field=f"--unit {key}")
    return unit


def celsius_of(findings: Findings, key: str, channel: str, column: Column) -> FloatArray:
    """Temperatures in degC: by the user's word, the unit in the name, else by the only unit in which they are usual."""
    raw = _numbers(findings, column)
    name = channel.removesuffix("_c")
    unit = _given_unit(findings, name, "temperature") or _given_unit(findings, key, "temperature")
    declared = unit or column.unit
    if declared is not None and declared not in CELSIUS:
        raise InputError(f"{declared} is no unit of temperature")
    if declared is None:
        fitting = [
            u
            for u, (f, o) in CELSIUS.items()
            if USUAL_C[0] <= (f * raw + o).min() and (f * raw + o).max() <= USUAL_C[1]
        ]
        if len(fitting) != 1:
            raise InputError(
                f"no unit stands in the file; say --map {name}={column.name} --unit {name}=degC (or K, degF)"
            )
        declared = fitting[0]
        findings.notes.append(
            f"{shown(column.name)} is taken as {declared}, in which {raw.min():g} to {raw.max():g} is usual"
        )
    factor, offset = CELSIUS[declared]
    values = factor * raw + offset
    if unit is None and (values.min() < POSSIBLE_C[0] or values.max() > POSSIBLE_C[1]):
        low_high = f"{values.min():.4g} to {values.max():.4g} degC"
        raise InputError(f"in {declared} it would go from {low_high}: another unit (--unit {name}=...), or no sensor")
    return values


def amount_of(findings: Findings, key: str, quantity: Quantity, scales: Mapping[str, float]) -> FloatArray:
    """Feed or load in the unit of the contract; the unit must stand in the file or be given."""
    column = findings.fields[key]
    unit = _given_unit(findings, key, quantity) or (column.unit if column.unit in scales else None)
    if unit is None:
        raise InputError(f"its unit is not said; --unit {key}= one of {', '.join(scales)}")
    return _numbers(findings, column) * scales[unit]


def uncertainty_of(findings: Findings) -> FloatArray:
    """Standard uncertainties of lengths, um."""
    column = findings.fields["u_value"]
    unit = findings.given_unit("u_value") or column.unit
    if unit not in MM_PER_LENGTH:
        raise InputError("its unit is not said; --unit u_value=um")
    values = _numbers(findings, column) * MM_PER_LENGTH[unit] * 1e3
    if values.min() <= 0:
        raise InputError(f"{values.min():g} um is no standard uncertainty")
    return values


def labels_of(findings: Findings, column: Column) -> NDArray[np.int64]:
    """Whole numbers as they are; words are numbered as they come."""
    cells = findings.table.column(column.name)
    numbers = [parse_number(cell) for cell in cells]
    if all(value is not None and value == int(value) and abs(value) < 2**53 for value in numbers):
        return np.array([int(value) for value in numbers if value is not None], dtype=np.int64)
    names = {cell: k for k, cell in enumerate(dict.fromkeys(cells), start=1)}
    return np.array([names[cell] for cell in cells], dtype=np.int64)


def tool_of(findings: Findings, key: str) -> FloatArray:
    """One component of the tool offset, mm; without a unit of its own in that of the positions."""
    column = findings.fields[key]
    unit = findings.given_unit(key) or column.unit or str(findings.understood.get("position_unit", "mm"))
    if unit not in MM_PER_LENGTH:
        raise InputError(f"{unit} is no length")
    return _numbers(findings, column) * MM_PER_LENGTH[unit]


def directions_of(findings: Findings, column: Column) -> FloatArray:
    """Directions of travel, +1, -1, or 0 where the cell is empty or zero."""
    ways = []
    for cell, line in zip(findings.table.column(column.name), findings.table.lines, strict=True):
        one = 0 if cell in ("", "0", "0.0") else way(cell)
        if one is None:
            raise findings.table.grid.fail(f"{shown(cell)} is no direction; +1 or -1 is due", line, column.name)
        ways.append(float(one))
    return np.array(ways)
