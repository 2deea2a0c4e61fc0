"""The other columns of a foreign table: temperatures, times, tool, feed, load and labels, in the project's units.

:func:`row_data_of` reads one column after the other. A column that cannot be read is skipped with the reason, unless the
user named it; a column of numbers that is not understood is an open question for the user.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.errors import InputError
from compgen.foreign.answers import Kind
from compgen.foreign.column_names import (
    CELSIUS,
    CHANNEL,
    KG_PER_MASS,
    MM_MIN_PER_FEED,
    MM_PER_LENGTH,
    S_PER_TIME,
    NamedColumn,
    covariate_unit,
    is_index,
    quantity_of,
    split_name,
    way,
)
from compgen.foreign.findings import TableFindings
from compgen.foreign.questions import Choice, date_orders
from compgen.foreign.source import (
    Order,
    Written,
    header_date,
    iso,
    moment,
    order_of,
    parse_number,
    read_date,
    serial_date,
    shown,
)

# Columns other than the readings of a foreign table, as numbers in the units of the contract.


#: Temperatures of a workshop and its machines, degC; for a column without a unit, the unit with values in this range is
#: assumed.
USUAL_C = (5.0, 45.0)
#: Beyond these a unit is wrong, or a sensor was not connected.
POSSIBLE_C = (-30.0, 120.0)
_CHANNEL_WORDS = {
    "ambient": ["ambient", "air", "luft", "room", "raum", "umgebung", "hall", "halle", "environment", "ambiente", "aria",
                "delair", "dellaria", "delaire", "\u73af\u5883", "\u7a7a\u6c14"],
    "spindle": ["spindle", "spindel", "spdl", "mandrin", "mandrino", "husillo", "broche"],
    "material": ["material", "mat", "workpiece", "werkstuck", "part", "teil"],
}  # fmt: skip
_FILLERS = re.compile(
    r"temperatur(?:en|es|e|a)?|temp|sensor|fuhler|scale|massstab|axis|achse|channel|kanal|celsius|\u6e29\u5ea6"
)


def is_temperature(column: NamedColumn) -> bool:
    """Whether a column holds a temperature, by its unit or its name."""
    return (column.unit in CELSIUS) or (column.unit is None and quantity_of(column.word) == "temperature")


def channel_of(word: str) -> str:
    """Return the name of a channel by the word of its column.

    >>> channel_of("temperaturxachse"), channel_of("airtemp"), channel_of("mattemp1"), channel_of("t3"), channel_of("temp")
    ('x', 'ambient', 'material_1', '3', 'measured')
    """
    rest = _FILLERS.sub("", word)
    for part in (rest, rest.removeprefix("t")):
        stem = part.rstrip("0123456789")
        number = part[len(stem) :]
        if stem in ("x", "y", "z") and not number:
            return stem
        name = next((name for name, words in _CHANNEL_WORDS.items() if stem in words), None)
        if name:
            return f"{name}_{number}" if number else name
    rest = rest[1:] if re.fullmatch(r"t\d*", rest) else rest
    return rest[:30] or "measured"


def celsius_of(findings: TableFindings, key: str, channel: str, column: NamedColumn) -> FloatArray:
    """Return temperatures in degC: by option, by the unit in the name, otherwise by the only unit with usual values."""
    raw = np.array(findings.table.numbers(column.name))
    name = channel.removesuffix("_c")
    unit = findings.options.given_unit(name, key, among=CELSIUS, what="temperature")
    declared = unit or column.unit
    if declared is not None and declared not in CELSIUS:
        raise InputError(f"{declared} is not a unit of temperature")
    if declared is None:
        fitting = [
            u
            for u, (f, o) in CELSIUS.items()
            if USUAL_C[0] <= (f * raw + o).min() and (f * raw + o).max() <= USUAL_C[1]
        ]
        if len(fitting) != 1:
            raise InputError(
                f"the file states no unit; give --map {name}={column.name} --unit {name}=degC (or K, degF)"
            )
        declared = fitting[0]
        findings.notes.append(
            f"{shown(column.name)} is read as {declared}, in which {raw.min():g} to {raw.max():g} is usual"
        )
    factor, offset = CELSIUS[declared]
    values = factor * raw + offset
    if unit is None and (values.min() < POSSIBLE_C[0] or values.max() > POSSIBLE_C[1]):
        low_high = f"{values.min():.4g} to {values.max():.4g} degC"
        raise InputError(
            f"in {declared} it would range from {low_high}: another unit (--unit {name}=...), or no sensor"
        )
    return values


def amount_of(
    findings: TableFindings, key: str, what: str, scales: Mapping[str, float], usual: str | None = None
) -> FloatArray:
    """Return numbers in the native unit; the unit is given, or in the file, or that of the positions (``usual``)."""
    column = findings.fields[key]
    unit = findings.options.given_unit(key, among=scales, what=what) or column.unit or usual
    if unit is None or unit not in scales:
        raise InputError(f"its unit is not given; --unit {key}= one of {', '.join(scales)}")
    values: FloatArray = np.array(findings.table.numbers(column.name)) * scales[unit]
    if key == "u_value" and values.min() <= 0:
        raise InputError(f"{values.min():g} um is not a standard uncertainty")
    return values


def labels_of(findings: TableFindings, column: NamedColumn) -> NDArray[np.int64]:
    """Return whole numbers unchanged; words are numbered in order of occurrence."""
    cells = findings.table.column(column.name)
    numbers = [parse_number(cell) for cell in cells]
    if all(value is not None and value == int(value) and abs(value) < 2**53 for value in numbers):
        return np.array([int(value) for value in numbers if value is not None], dtype=np.int64)
    names = {cell: k for k, cell in enumerate(dict.fromkeys(cells), start=1)}
    return np.array([names[cell] for cell in cells], dtype=np.int64)


def directions_of(findings: TableFindings, column: NamedColumn, *, empty: bool = True) -> NDArray[np.int64]:
    """Directions of travel, +1, -1, or with ``empty`` 0 where the cell is empty or zero."""
    table, ways = findings.table, []
    for cell, line in zip(table.column(column.name), table.lines, strict=True):
        one = 0 if empty and cell in ("", "0", "0.0") else way(cell)
        if one is None:
            message = f"{shown(cell)} is not a direction{'' if cell else table.grid.empty}; write + or -, +1 or -1, forward or "
            raise table.grid.fail(f"{message}backward (known in several languages)", line, column.name)
        ways.append(one)
    return np.array(ways, dtype=np.int64)


# The column of times of a foreign table as seconds since its first reading.


_DAY_S = 86400.0
#: Keys of a header that give the day of the measurement, the time of day, or both.
_DATE_KEYS = (
    "measured_at", "measured at", "measurement date", "messdatum", "date/time", "date time", "datum/zeit",
    "datum/uhrzeit", "date", "datum", "test date", "date of measurement", "start time", "created",
)  # fmt: skip
_CLOCK_KEYS = ("time", "zeit", "uhrzeit", "messzeit")


def times_of(
    findings: TableFindings, time: NamedColumn | None, date: NamedColumn | None
) -> tuple[FloatArray | None, str | None]:
    """Return seconds since the earliest reading (rows,), None if only a day is known, and that reading's date in ISO form.

    Raises
    ------
    InputError
        for numbers without a unit, text that is not a date, times of day that cross midnight without a date.
    """
    column = time or date
    if column is None:
        raise InputError("no column of times")
    cells = findings.table.column(column.name)
    if time is not None and date is not None:
        cells = [
            f"{day.removesuffix('T00:00:00')} {clock}"
            for day, clock in zip(findings.table.column(date.name), cells, strict=True)
        ]
    numbers = [parse_number(cell) for cell in cells]
    if all(value is not None for value in numbers):
        # seconds, minutes, ... by the unit; without one days of a spreadsheet, where all of them are of this century
        values = np.array(numbers, dtype=np.float64)
        unit = findings.options.given_unit("time", among=S_PER_TIME, what="time") or column.unit
        if unit in S_PER_TIME:
            return values * S_PER_TIME[unit], None
        days = [found for value in values if (found := serial_date(float(value))) is not None]
        if len(days) < len(values):
            what = "give --unit time=s (ms, min, h)" if time is not None else "it is not a date"
            raise InputError(f"it contains numbers without a unit; {what}")
        findings.notes.append(
            f"the numbers in {shown(column.name)} are taken as days of a spreadsheet (1 is 1900-01-01)"
        )
        return _of_dates(findings, days)
    written = [read_date(cell) for cell in cells]
    wrong = next((k for k, item in enumerate(written) if item is None), None)
    if wrong is not None:
        line = findings.table.lines[wrong]
        raise InputError(f"{shown(cells[wrong])} is not a date or time (line {line})")
    return _of_dates(findings, [item for item in written if item is not None])


def _of_dates(findings: TableFindings, dates: Sequence[Written]) -> tuple[FloatArray | None, str | None]:
    with_day = [bool(date.days) for date in dates]
    if any(with_day) != all(with_day) or len({bool(date.zone) for date in dates}) > 1:
        raise InputError("some cells have a date or a time zone and some do not")
    if not all(with_day):
        clock = np.array([date.clock_s for date in dates], dtype=np.float64)
        if np.any(np.diff(clock) < 0):
            raise InputError(
                "the times of day are not ascending and have no date: the order of the readings is unknown"
            )
        return clock - clock[0], None
    order = order_of(dates, findings.options.dates)
    if order is None:  # times within one day do not depend on the order; others need the user's choice
        days = sorted({tuple(sorted(day.date().isoformat() for day in date.days.values())) for date in dates})
        found = f"{shown(dates[0].text)} may be {' or '.join(dict.fromkeys(days[0]))}"
        if len(days) > 1:
            findings.ask(found, "dates", date_orders(), "give --dates dmy, mdy or ymd")
            return None, None
        findings.notes.append(f"the date {found}: it is left out; give --dates dmy, mdy or ymd to keep it")
        if any(date.clock_s is None for date in dates):
            return None, None
        clock = np.array([date.clock_s for date in dates], dtype=np.float64)
        return clock - clock.min(), None
    at = [_seconds(date, order) for date in dates]
    first = int(np.argmin(at))
    clocked = all(date.clock_s is not None for date in dates)
    return (np.array(at) - at[first] if clocked else None), iso(dates[first], order)


def _seconds(date: Written, order: Order) -> float:
    at = moment(date, order)
    ahead = 0.0
    if date.zone and date.zone != "Z":
        sign = -1.0 if date.zone[0] == "-" else 1.0
        ahead = sign * (3600.0 * int(date.zone[1:3]) + 60.0 * int(date.zone[-2:]))
    return (
        float(at.toordinal()) * _DAY_S
        + (at - at.replace(hour=0, minute=0, second=0, microsecond=0)).total_seconds()
        - ahead
    )


def date_in_header(findings: TableFindings) -> str | None:
    """Return the date of the measurement in ISO form from the lines above the table, None if it is not clear."""
    metadata = findings.table.metadata
    text = next((metadata[key] for key in _DATE_KEYS if metadata.get(key)), "")
    clock = next((metadata[key] for key in _CLOCK_KEYS if metadata.get(key)), "")
    both = f"{text} {clock}" if text and clock and (found := read_date(text)) and found.clock_s is None else text
    found_iso, against = header_date(both, findings.options.dates)
    if against:
        findings.notes.append(against)
    return found_iso


# Air, material and time in a laser file: sections ENVIRONMENT and EQUIPMENT, and the date of USER-TEXT.
#
# There is no public specification. Programs that read such files expect two numbers for each key, at the beginning and
# at the end of the test, and for some keys a third one of unknown meaning (apparently the unit); older descriptions
# have one. So everything is shown, and only temperatures that must be degC, and unambiguous dates, are used.


#: Channels by key; the air and up to three sensors on the machine or the workpiece.
_HEADER_CHANNELS = {
    "air temp": "temp_ambient_c",
    "mat temp 1": "temp_material_1_c",
    "mat temp 2": "temp_material_2_c",
    "mat temp 3": "temp_material_3_c",
}
#: Beginning and end may differ by this much for their mean to represent the whole test, K.
STEADY_K = 1.0
_QUOTED = re.compile(r"\"([^\"]{4,60})\"")


def surroundings_of(
    environment: Mapping[str, str], user_date: str, chosen: Order | None
) -> tuple[dict[str, float], str | None, list[str]]:
    """Return temperatures of the whole test by contract name (degC), its date in ISO form if it is clear, and remarks.

    Parameters
    ----------
    environment : values by lower-case key.
    user_date : the date in USER-TEXT, empty if there is none.
    chosen : order of day, month and year that the user gave.
    """
    temperatures: dict[str, float] = {}
    notes: list[str] = []
    unused = []
    for key, channel in _HEADER_CHANNELS.items():
        text = environment.get(key, "")
        words = text.split()
        numbers = [value for word in words if (value := parse_number(word)) is not None]
        # beginning and end count where both are usual in degC and close together; a third number is a code, 0 for degC
        ends = numbers[:2] if len(numbers) == len(words) <= 3 and numbers[2:] in ([], [0.0]) else []
        usual = bool(ends) and all(USUAL_C[0] <= value <= USUAL_C[1] for value in ends)
        if usual and max(ends) - min(ends) <= STEADY_K:
            temperatures[channel] = sum(ends) / len(ends)
        elif text:
            unused.append(f"{key} {shown(text)}")
    if unused:
        notes.append(f"not used (no temperature in degC, no sensor, or not steady): {', '.join(unused)}")
    at, against = _date(environment.get("date time", ""), user_date, chosen)
    if against:
        notes.append(against)
    if environment.get("exp coeff"):
        notes.append(
            f"its software has the expansion coefficient {shown(environment['exp coeff'])}: if it compensated the material, "
            "the readings already refer to 20 degC; nothing is corrected here"
        )
    return temperatures, at, notes


def _date(stamps: str, user_date: str, chosen: Order | None) -> tuple[str | None, str | None]:
    """Return the beginning of the test; the date of the user text if it is clear, otherwise the stamp of the software."""
    at, against = header_date(user_date, chosen)
    first = next(iter(_QUOTED.findall(stamps)), stamps)
    stamped, _ = header_date(first, chosen)
    dated = read_date(user_date)
    if stamped and (at is None or (dated is not None and dated.clock_s is None and stamped[:10] == at[:10])):
        return stamped, None
    if stamped and at and stamped[:10] != at[:10]:
        return at, f"the user's date is {at}, the software's stamp {stamped}: the user's is used"
    return at, against


# Contents of a foreign table in addition to positions and readings: temperatures, times, tool, feed, load, labels.
#
# A column with a place in the native file is kept; every other one is listed as not used, with the reason.


#: Reason for a column excluded by the user.
LEFT_OUT = "excluded by --ignore"
#: Parts of names of columns that contain no readings, in the languages of FIELDS; such columns may be skipped.
_HARMLESS = (
    "deadpath", "totstrecke", "totweg", "pressure", "druck", "pression", "presion", "humid", "feuchte", "umidita", "humedad",
    "wavelength", "wellenlange", "refractive", "brechung", "intensity", "intensitat", "signal", "quality", "strength", "beam",
    "snr", "power", "leistung", "torque", "expansion", "ausdehnung", "voltage", "spannung",
    "status", "flag", "uncertainty", "unsicherheit", "remark", "comment", "bemerkung", "kommentar", "note", "nota",
    "remarque", "osservazioni", "operator", "bediener", "serial", "dwell",
)  # fmt: skip
#: Fields of readings: an unused one may be what was meant.
_READINGS = ("actual", "deviation", "correction", "value", "length", "x", "y", "z", "dx", "dy", "dz", "xa", "ya", "za")
#: Units in brackets that are neither a length nor an angle.
_OTHER_UNIT = re.compile(r"(?i)[\[(]\s*(%|%\s?rh|rh|[hkm]?pa|m?bar|mmhg|ppm|m?v|m?a|k?w|k?n|hz|rpm|1/min|db)\s*[\])]")

#: Lines above a table that are kept, by the words of the key: of the instrument, and what a report to a customer names.
FACTS = {
    "operator": ("operator", "bediener", "prufer", "pruefer", "messtechniker", "gemessenvon", "measuredby", "inspector",
                 "technician", "operateur", "operatore", "operador", "bearbeiter", "\u64cd\u4f5c\u5458", "\u6d4b\u91cf\u5458",
                 "\u68c0\u6d4b\u5458"),
    "instrument": ("instrument", "messgerat", "messmittel", "messsystem", "gerat", "device", "laser", "laserinterferometer",
                   "interferometer", "equipment", "appareil", "strumento", "instrumento", "equipo", "\u4eea\u5668"),
    "serial_number": ("serialnumber", "serialno", "seriennummer", "seriennr", "laserseriennummer", "serial", "sn",
                      "laserserialno", "lasersn",
                      "instrumentserialnumber", "gerateseriennummer",
                      "numerodeserie", "nodeserie", "matricola",
                      "numerodiserie", "\u5e8f\u5217\u53f7", "\u4eea\u5668\u7f16\u53f7"),
    "customer": ("customer", "client", "kunde", "auftraggeber", "endkunde", "cliente", "orderedby", "\u5ba2\u6237"),
    "order_number": ("order", "orderno", "ordernumber", "auftrag", "auftragsnr", "auftragsnummer", "bestellnr", "bestellnummer",
                     "jobno", "jobnumber", "job", "commande", "ordine", "pedido"),
    "certificate_number": ("certificate", "certificateno", "certificatenumber", "reportno", "reportnumber", "protokollnr",
                           "protokollnummer", "prufprotokollnr", "kalibrierschein", "kalibrierscheinnr", "zertifikat",
                           "zertifikatnr", "messprotokollnr", "berichtsnr", "prufberichtnr", "certificat", "certificado"),
    "machine_manufacturer": ("manufacturer", "machinemanufacturer", "machinemaker", "maker", "hersteller", "maschinenhersteller",
                             "fabricant", "costruttore", "fabricante"),
    "machine_serial_number": ("machineno", "machinenumber", "machineserial", "machineserialno", "machineserialnumber",
                              "machinesn", "maschinennr", "maschinennummer", "fabriknummer", "fabriknr", "maschnr",
                              "numeromachine"),
    "place": ("place", "location", "site", "ort", "messort", "standort", "aufstellort", "aufstellungsort", "lieu",
              "luogo", "lugar"),
    "laboratory": ("laboratory", "lab", "labor", "messlabor", "kalibrierlabor", "laboratoire", "laboratorio"),
}  # fmt: skip
_EXPANSION = ("expansion", "expansioncoefficient", "expcoeff", "coefficientofthermalexpansion", "cte", "materialexpansion",
              "ausdehnung", "ausdehnungskoeffizient", "wak", "langenausdehnungskoeffizient", "dilatation",
              "coefficientdedilatation", "coefficientededilatazione", "dilatazione", "coeficientededilatacion",
              "\u81a8\u80c0\u7cfb\u6570", "\u7ebf\u81a8\u80c0\u7cfb\u6570")  # fmt: skip
#: An expansion below this is one per kelvin, not one in a million; um/(m K) of any material of machines.
_FRACTION, _LARGEST_EXPANSION = 1e-3, 100.0
_NUMBER = r"[+\-]?\d+(?:[.,]\d+)?(?:[eE][+\-]?\d+)?"

#: Numbers with a unit: what they are, the column of the contract, and its unit for each unit.
_AMOUNTS: Mapping[str, tuple[str, str, Mapping[str, float]]] = {
    "feed": ("feed", "feed_mm_min", MM_MIN_PER_FEED),
    "load": ("load", "load_kg", KG_PER_MASS),
    "u_value": ("length", "u_length_um", {name: 1e3 * mm for name, mm in MM_PER_LENGTH.items()}),
}
_LABELS = ("run", "repeat", "line", "block", "setup", "pose")
_MAIN: Mapping[str, tuple[str, ...]] = {
    "axis": ("position", "direction", "run", "axis"),
    "lengths": ("x", "y", "z", "length", "station", "point"),
    "deviations": ("x", "y", "z", "dx", "dy", "dz", "xa", "ya", "za"),
    "errors": ("error", "position", "value", "u_value"),
    "circle": ("angle", "radius", "plane", "deviation", "actual", "direction", "run"),
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
    "circle": ("time", "date", "feed"),
}


@dataclass
class RowData:
    """What n rows contain besides readings: numbers by contract name, labels, tool, approach (n, 3), and the first time."""

    covariates: dict[str, FloatArray] = field(default_factory=dict)
    labels: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    tool_mm: FloatArray | None = None
    approach: FloatArray | None = None
    measured_at: str | None = None


def row_data_of(findings: TableFindings, kind: Kind, *, once: bool = True) -> RowData:
    """Return what a table contains besides its readings, and record in ``findings`` what was used and what was not.

    Parameters
    ----------
    once : each row is one reading; False if the runs have separate columns, and nothing else has a place.
    """
    reader = _Reader(
        findings, kind, {findings.fields[key].name for key in _MAIN[kind] if key in findings.fields} | findings.used
    )
    if once:
        for take in (reader.times, reader.temperatures, reader.amounts, reader.labels, reader.vectors):
            take()
    reader.report(once=once)
    return reader.found


@dataclass
class _Reader:
    """Reads one column after the other from the rest of a table."""

    findings: TableFindings
    kind: Kind
    used: set[str]
    found: RowData = field(default_factory=RowData)
    reasons: dict[str, str] = field(default_factory=dict)

    def _try(self, key: str, column: NamedColumn, take: Callable[[], Any]) -> Any:
        """Return the result of ``take`` for a column; a column not given by the user is skipped if it cannot be read."""
        try:
            taken = take()
        except InputError as error:
            if key in self.findings.options.columns:
                raise
            self.reasons[column.name] = f"line {error.line} {error.message}" if error.line else error.message
            return None
        self.used.add(column.name)
        return taken

    def _column(self, key: str) -> NamedColumn | None:
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

    def _temperature(self, key: str, channel: str, column: NamedColumn) -> None:
        if self.kind not in _PLACES:
            return
        if channel in self.found.covariates:
            self.reasons[column.name] = f"{channel} is already in another column"
            return
        values = self._try(key, column, lambda: celsius_of(self.findings, key, channel, column))
        if values is not None:
            self.found.covariates[channel] = values
            if self.kind != "axis" and channel in ("temp_x_c", "temp_y_c", "temp_z_c"):
                text = f"{channel} is used as temperature of the scale of {channel[5].upper()}: identify corrects the readings to"
                self.findings.notes.append(f"{text} 20 degC if the machine file has expansion_um_per_m_k")
            low_high = [float(values.min()), float(values.max())]
            self.findings.understood.setdefault("temperatures_c", {})[channel] = low_high

    def amounts(self) -> None:
        """Take feed, load and the standard uncertainty of a length."""
        for key, (what, name, scales) in _AMOUNTS.items():
            if self._column(key) is not None:
                values = self._try(key, self.findings.fields[key], partial(amount_of, self.findings, key, what, scales))
                if values is not None:
                    self.found.covariates[name] = values

    def labels(self) -> None:
        """Take run, repeat, line, block, set-up and pose as whole numbers; words are numbered in order of occurrence."""
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
            usual = str(self.findings.understood.get("position_unit", "mm"))
            parts = []
            for key, column in zip(("tool_x", "tool_y", "tool_z"), tool, strict=True):
                read = partial(amount_of, self.findings, key, "length", MM_PER_LENGTH, usual)
                parts.append(self._try(key, column, read))
            if all(part is not None for part in parts):
                self.found.tool_mm = np.column_stack(parts)
        else:
            lacking = "a tool offset has three columns, x, y and z; give them with --map tool_x=..."
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
        taken = self._try(key, column, lambda: directions_of(self.findings, column))
        return None if taken is None else np.asarray(taken, dtype=np.float64)

    def report(self, *, once: bool) -> None:
        """List the columns that were not used."""
        why = "the native format has no column for it" if once else "there is one value for several runs"
        unused = {}
        other_fields = [column for key, column in self.findings.fields.items() if key not in _READINGS]
        for name in self.findings.table.header:
            column = split_name(name)
            if name in self.used or (name.startswith("column ") and not any(self.findings.table.column(name))):
                continue
            letters = re.sub(r"[^a-z]", "", column.word)
            # a column whose name shows that it contains no readings may be skipped
            understood = (
                column in other_fields
                or is_temperature(column)
                or covariate_unit(column.unit or "") is not None
                or any(word in letters for word in _HARMLESS)
                or is_index(name)
                or _OTHER_UNIT.search(name) is not None
            )
            reason = self.reasons.get(name, why)
            if name in self.findings.options.ignore:
                reason = LEFT_OUT
            elif name not in self.reasons and column.word in ("uncertainty", "unsicherheit", "u"):
                reason = f"{reason}; a standard uncertainty (k = 1) of lengths is given by --map u_value=..."
            elif name not in self.reasons and not understood and self.findings.is_numeric(name):
                # what looks like data is never skipped without the user's consent
                reason = "it is not understood"
                run = " --map run1-=... (a run and its direction)," if self.kind == "axis" else ""
                self.findings.ask(
                    f"column {shown(name)} contains numbers but is not understood",
                    "ignore",
                    (Choice(name, f"leave {shown(name)} out"),),
                    f"identify it with --map FIELD={name},{run} or exclude it: --ignore {shown(name)}",
                    picture="columns",
                )
            unused[name] = reason
        if unused:
            self.findings.understood["not_used"] = unused
            self.findings.notes.append(f"not used: {', '.join(unused)}")


def metadata_of(findings: TableFindings, row_data: RowData) -> dict[str, str]:
    """Return the comments of the native file: those of the file itself, the lines above its table, source and date.

    Comments ``# key = value`` are used by other commands (``u_length_um``, ``reference_point_mm``) and kept unchanged.
    Temperatures, operator, instrument, its serial number and the expansion coefficient are kept if they are clear; a
    temperature above a table corrects nothing.
    """
    comments = dict(findings.table.comments)
    for key, text in comments.items():  # a number with a decimal comma becomes one with a point
        value = parse_number(text) if text.count(",") == 1 and "." not in text else None
        comments[key] = text if value is None else repr(value)
    above = {name: value for key, text in findings.table.metadata.items() for name, value in _fact(key, text).items()}
    at = row_data.measured_at or date_in_header(findings)
    if at:
        findings.understood["measured_at"] = at
    dated = {"measured_at": at, "date": at} if at else {}
    return {**above, **comments, "source": findings.table.grid.path.name, **dated}


def _fact(key: str, text: str) -> dict[str, str]:
    """Return a line above a table with native name and unit; nothing if it is not clear."""
    column = split_name(key)
    name = next((name for name, words in FACTS.items() if column.word in words), None)
    if name is not None and text:
        return {name: text}
    numbers = [value for word in re.findall(_NUMBER, text) if (value := parse_number(word)) is not None]
    if column.word in _EXPANSION and numbers:
        value = numbers[0] * (1e6 if abs(numbers[0]) < _FRACTION else 1.0)
        return {"material_expansion_um_per_m_k": f"{value:g}"} if 0 < value <= _LARGEST_EXPANSION else {}
    if not is_temperature(column) or not numbers:
        return {}
    rest = re.sub(_NUMBER, " ", text).strip()
    unit = column.unit or covariate_unit(next(iter(rest.split()), ""), "temperature")
    usual = [scale for name, scale in CELSIUS.items() if unit in (None, name)]
    found = [[factor * value + offset for value in numbers] for factor, offset in usual]
    fitting = [values for values in found if all(POSSIBLE_C[0] < value < POSSIBLE_C[1] for value in values)]
    if unit is None:
        fitting = [values for values in fitting if all(USUAL_C[0] <= value <= USUAL_C[1] for value in values)]
    if len(fitting) != 1 or max(fitting[0]) - min(fitting[0]) > STEADY_K:
        return {}
    return {f"temp_{channel_of(column.word)}_c": f"{sum(fitting[0]) / len(numbers):.6g}"}
