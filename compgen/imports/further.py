"""What stands in a foreign table beside positions and readings: temperatures, times, tool, feed, load, labels.

A column that has a place in the contract file is taken along; every other one is named as not used, with the reason.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.errors import InputError
from compgen.imports.amounts import (
    POSSIBLE_C,
    USUAL_C,
    amount_of,
    celsius_of,
    channel_of,
    directions_of,
    is_temperature,
    labels_of,
    tool_of,
    uncertainty_of,
)
from compgen.imports.columns import CHANNEL, Column, is_index, split_name
from compgen.imports.findings import Findings
from compgen.imports.moments import date_in_header, times_of
from compgen.imports.result import Kind
from compgen.imports.source import parse_number, shown
from compgen.imports.surroundings import STEADY_K
from compgen.imports.units import CELSIUS, KG_PER_MASS, MM_MIN_PER_FEED, Quantity, further_unit

#: Why a column is not used that the user left out.
LEFT_OUT = "left out by --ignore"
#: Parts of names of columns that hold no reading, in the languages of FIELDS; such columns may be left out.
_HARMLESS = (
    "deadpath", "totstrecke", "totweg", "pressure", "druck", "pression", "presion", "humid", "feuchte", "umidita", "humedad",
    "wavelength", "wellenlange", "refractive", "brechung", "intensity", "intensitat", "signal", "quality", "strength", "beam",
    "snr", "power", "leistung", "torque", "expansion", "ausdehnung", "voltage", "spannung",
    "status", "flag", "uncertainty", "unsicherheit", "remark", "comment", "bemerkung", "kommentar", "note", "nota",
    "remarque", "osservazioni", "operator", "bediener", "serial", "dwell",
)  # fmt: skip
#: Fields of readings: one that is left over may be what was meant.
_READINGS = ("actual", "deviation", "correction", "value", "length", "x", "y", "z", "dx", "dy", "dz", "xa", "ya", "za")
#: Units in brackets that are neither a length nor an angle.
_OTHER_UNIT = re.compile(r"(?i)[\[(]\s*(%|%\s?rh|rh|[hkm]?pa|m?bar|mmhg|ppm|m?v|m?a|k?w|k?n|hz|rpm|1/min|db)\s*[\])]")

#: What stands above a table and is kept, by the words of its key.
_FACTS = {
    "operator": ("operator", "bediener", "prufer", "pruefer", "messtechniker", "gemessenvon", "measuredby", "inspector",
                 "technician", "operateur", "operatore", "operador", "bearbeiter", "\u64cd\u4f5c\u5458", "\u6d4b\u91cf\u5458",
                 "\u68c0\u6d4b\u5458"),
    "instrument": ("instrument", "messgerat", "messmittel", "messsystem", "gerat", "device", "laser", "laserinterferometer",
                   "interferometer", "equipment", "appareil", "strumento", "instrumento", "equipo", "\u4eea\u5668"),
    "serial_number": ("serialnumber", "serialno", "seriennummer", "seriennr", "laserseriennummer", "serial", "sn",
                      "laserserialno",
                      "instrumentserialnumber", "gerateseriennummer",
                      "numerodeserie", "nodeserie", "matricola",
                      "numerodiserie", "\u5e8f\u5217\u53f7", "\u4eea\u5668\u7f16\u53f7"),
}  # fmt: skip
_EXPANSION = ("expansion", "expansioncoefficient", "expcoeff", "coefficientofthermalexpansion", "cte", "materialexpansion",
              "ausdehnung", "ausdehnungskoeffizient", "wak", "langenausdehnungskoeffizient", "dilatation",
              "coefficientdedilatation", "coefficientededilatazione", "dilatazione", "coeficientededilatacion",
              "\u81a8\u80c0\u7cfb\u6570", "\u7ebf\u81a8\u80c0\u7cfb\u6570")  # fmt: skip
#: An expansion below this is one per kelvin, not one in a million; um/(m K) of any material of machines.
_FRACTION, _LARGEST_EXPANSION = 1e-3, 100.0
_NUMBER = r"[+\-]?\d+(?:[.,]\d+)?(?:[eE][+\-]?\d+)?"

_LABELS = ("run", "repeat", "line", "block", "setup", "pose")
_MAIN: Mapping[str, tuple[str, ...]] = {
    "axis": ("position", "direction", "run", "axis"),
    "lengths": ("x", "y", "z", "length", "station", "point"),
    "deviations": ("x", "y", "z", "dx", "dy", "dz", "xa", "ya", "za"),
    "errors": ("error", "position", "value", "u_value"),
}
_SPACE = (
    "time",
    "date",
    "feed",
    "load",
    "direction",
    *_LABELS,
    *(f"{key}_{axis}" for key in ("tool", "approach") for axis in "xyz"),
)
_PLACES: Mapping[Kind, tuple[str, ...]] = {
    "axis": ("time", "date"),
    "lengths": (*_SPACE, "u_value"),
    "deviations": _SPACE,
}


@dataclass
class Further:
    """Beside n rows: numbers by contract name, labels, tool and directions of approach (n, 3), and the time of the first."""

    covariates: dict[str, FloatArray] = field(default_factory=dict)
    labels: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    tool_mm: FloatArray | None = None
    approach: FloatArray | None = None
    measured_at: str | None = None


def further_of(findings: Findings, kind: Kind, *, once: bool = True) -> Further:
    """Return what a table holds beside its readings, and say in ``findings`` what was taken and what was not.

    Parameters
    ----------
    once : each row is one reading; False where the runs have columns of their own, and nothing else has a place.
    """
    reader = _Reader(findings, kind, _used(findings, kind))
    if once:
        for take in (reader.times, reader.temperatures, reader.amounts, reader.labels, reader.vectors):
            take()
    reader.report(once=once)
    return reader.found


def _used(findings: Findings, kind: Kind) -> set[str]:
    """Names of columns that the reader of this kind takes itself."""
    return {findings.fields[key].name for key in _MAIN[kind] if key in findings.fields} | findings.used


@dataclass
class _Reader:
    """Takes one column after the other out of what is left of a table."""

    findings: Findings
    kind: Kind
    used: set[str]
    found: Further = field(default_factory=Further)
    reasons: dict[str, str] = field(default_factory=dict)

    def _given(self, key: str) -> bool:
        return key in self.findings.options.columns

    def _try(self, key: str, column: Column, take: Callable[[], Any]) -> Any:
        """Return what ``take`` makes of a column; a column that the user did not name is left out if it cannot be read."""
        try:
            taken = take()
        except InputError as error:
            if self._given(key):
                raise
            self.reasons[column.name] = f"line {error.line} {error.message}" if error.line else error.message
            return None
        self.used.add(column.name)
        return taken

    def _column(self, key: str) -> Column | None:
        return self.findings.fields.get(key) if key in _PLACES.get(self.kind, ()) else None

    def times(self) -> None:
        """Take time stamps: seconds since the first one, and when that was."""
        time, date = self._column("time"), self._column("date")
        first = time or date
        if first is None:
            return
        taken = self._try("time" if time else "date", first, lambda: times_of(self.findings, time, date))
        if taken is None:
            return
        seconds, self.found.measured_at = taken
        self.used |= {column.name for column in (time, date) if column}
        if seconds is not None:
            self.found.covariates["time_s"] = seconds
            self.findings.understood["time_s"] = [float(seconds.min()), float(seconds.max())]

    def temperatures(self) -> None:
        """Take every channel of temperature, in degC."""
        given = {
            key: column
            for key, column in self.findings.fields.items()
            if key == "temperature" or CHANNEL.fullmatch(key)
        }
        for key, column in given.items():
            self._temperature(key, "temp_measured_c" if key == "temperature" else f"{key.removesuffix('_c')}_c", column)
        for name in self.findings.table.header:
            column = split_name(name)
            if name not in self.used and name not in self.reasons and is_temperature(column):
                self._temperature("temperature", f"temp_{channel_of(column.word)}_c", column)

    def _temperature(self, key: str, channel: str, column: Column) -> None:
        if self.kind not in _PLACES:
            return
        if channel in self.found.covariates:
            self.reasons[column.name] = f"{channel} stands in another column already"
            return
        values = self._try(key, column, lambda: celsius_of(self.findings, key, channel, column))
        if values is not None:
            self.found.covariates[channel] = values
            if self.kind != "axis" and channel in ("temp_x_c", "temp_y_c", "temp_z_c"):
                text = f"{channel} counts as temperature of the scale of {channel[5].upper()}: identify brings the readings to"
                self.findings.notes.append(f"{text} 20 degC where the machine file has expansion_um_per_m_k")
            low_high = [float(values.min()), float(values.max())]
            self.findings.understood.setdefault("temperatures_c", {})[channel] = low_high

    def amounts(self) -> None:
        """Take feed, load and the standard uncertainty of a length."""
        amounts: tuple[tuple[str, Quantity, str, Mapping[str, float]], ...] = (
            ("feed", "feed", "feed_mm_min", MM_MIN_PER_FEED),
            ("load", "load", "load_kg", KG_PER_MASS),
        )
        for key, quantity, name, scales in amounts:
            column = self._column(key)
            if column is not None:
                values = self._try(key, column, partial(amount_of, self.findings, key, quantity, scales))
                if values is not None:
                    self.found.covariates[name] = values
        column = self._column("u_value")
        if column is not None:
            values = self._try("u_value", column, lambda: uncertainty_of(self.findings))
            if values is not None:
                self.found.covariates["u_length_um"] = values

    def labels(self) -> None:
        """Take run, repeat, line, block, set-up and pose as whole numbers; words are numbered as they come."""
        for key in _LABELS:
            column = self._column(key)
            if column is not None:
                labels = self._try(key, column, partial(labels_of, self.findings, column))
                if labels is not None:
                    self.found.labels[key] = labels

    def vectors(self) -> None:
        """Take the tool offset and the directions of approach."""
        if self.kind == "axis":
            return
        tool = [column for axis in "xyz" if (column := self._column(f"tool_{axis}")) is not None]
        if len(tool) == 3:
            read = partial(tool_of, self.findings)
            parts = [self._try(f"tool_{a}", c, partial(read, f"tool_{a}")) for a, c in zip("xyz", tool, strict=True)]
            if all(part is not None for part in parts):
                self.found.tool_mm = np.column_stack(parts)
        else:
            lacking = "a tool offset has three columns, x, y and z; --map tool_x=... names them"
            self.reasons |= {column.name: lacking for column in tool}
        rows = len(self.findings.table.rows)
        ways = {a: self._ways(f"approach_{a}") for a in "xyz"}
        if any(part is not None for part in ways.values()):
            self.found.approach = np.column_stack([np.zeros(rows) if part is None else part for part in ways.values()])
        last = self._ways("direction")
        if last is not None:
            self.found.covariates["approach"] = last

    def _ways(self, key: str) -> FloatArray | None:
        column = self._column(key)
        if column is None:
            return None
        taken: FloatArray | None = self._try(key, column, lambda: directions_of(self.findings, column))
        return taken

    def report(self, *, once: bool) -> None:
        """Name the columns that were not used."""
        why = "it has no place in the contract file" if once else "it stands once beside several runs"
        unused = {}
        for name in self.findings.table.header:
            column = split_name(name)
            if name in self.used or (name.startswith("column ") and not any(self.findings.table.column(name))):
                continue
            reason = self.reasons.get(name, why)
            if name in self.findings.options.ignore:
                reason = LEFT_OUT
            elif name not in self.reasons and column.word in ("uncertainty", "unsicherheit", "u"):
                reason = f"{reason}; a standard uncertainty (k = 1) of lengths is named by --map u_value=..."
            elif name not in self.reasons and not self._has_known_name(column) and self.findings.is_numeric(name):
                reason = self._not_understood(column)
            unused[name] = reason
        if unused:
            self.findings.understood["not_used"] = unused
            self.findings.notes.append(f"not used: {', '.join(unused)}")

    def _has_known_name(self, column: Column) -> bool:
        """Whether the name of a column says what it holds, and that it is no reading: so it may be left out."""
        words = re.sub(r"[^a-z]", "", column.word)
        known = [field for key, field in self.findings.fields.items() if key not in _READINGS]
        return (
            column in known
            or is_temperature(column)
            or further_unit(column.unit or "") is not None
            or any(word in words for word in _HARMLESS)
            or is_index(column.name)
            or _OTHER_UNIT.search(column.name) is not None
        )

    def _not_understood(self, column: Column) -> str:
        """Ask about a column of numbers: what looks like data is never left out without a word of the user."""
        run = " --map run1-=... (a run and its direction)," if self.kind == "axis" else ""
        name = shown(column.name)
        self.findings.doubts.append(
            f"column {name} holds numbers and is not understood; say what it is, --map FIELD={column.name},{run} or leave it "
            f"out: --ignore {name}"
        )
        return "it is not understood"


def metadata_of(findings: Findings, further: Further) -> dict[str, str]:
    """Return the comments of the contract file: those of the file itself, what stands above its table, source and date.

    Comments ``# key = value`` count for other commands (``u_length_um``, ``reference_point_mm``) and are kept as they are.
    Temperatures, operator, instrument, its serial number and the expansion coefficient are kept where they are clear; a
    temperature above a table corrects nothing.
    """
    comments = {key: _with_point(value) for key, value in findings.table.comments.items()}
    above = {name: value for key, text in findings.table.metadata.items() for name, value in _fact(key, text).items()}
    at = further.measured_at or date_in_header(findings)
    if at:
        findings.understood["measured_at"] = at
    dated = {"measured_at": at, "date": at} if at else {}
    return {**above, **comments, "source": findings.table.grid.path.name, **dated}


def _with_point(text: str) -> str:
    """Return a number with a decimal comma as one with a point; other text stays."""
    value = parse_number(text) if text.count(",") == 1 and "." not in text else None
    return text if value is None else repr(value)


def _fact(key: str, text: str) -> dict[str, str]:
    """Return what a line above a table says, by the name and in the unit of the contract; nothing if it is not clear."""
    column = split_name(key)
    name = next((name for name, words in _FACTS.items() if column.word in words), None)
    if name is not None and text:
        return {name: text}
    numbers = [value for word in re.findall(_NUMBER, text) if (value := parse_number(word)) is not None]
    if column.word in _EXPANSION and numbers:
        value = numbers[0] * (1e6 if abs(numbers[0]) < _FRACTION else 1.0)
        return {"material_expansion_um_per_m_k": f"{value:g}"} if 0 < value <= _LARGEST_EXPANSION else {}
    if not is_temperature(column) or not numbers:
        return {}
    rest = re.sub(_NUMBER, " ", text).strip()
    unit = column.unit or further_unit(next(iter(rest.split()), ""), "temperature")
    usual = [scale for name, scale in CELSIUS.items() if unit in (None, name)]
    found = [[factor * value + offset for value in numbers] for factor, offset in usual]
    fitting = [values for values in found if all(POSSIBLE_C[0] < value < POSSIBLE_C[1] for value in values)]
    if unit is None:
        fitting = [values for values in fitting if all(USUAL_C[0] <= value <= USUAL_C[1] for value in values)]
    if len(fitting) != 1 or max(fitting[0]) - min(fitting[0]) > STEADY_K:
        return {}
    return {f"temp_{channel_of(column.word)}_c": f"{sum(fitting[0]) / len(numbers):.6g}"}
