"""Positioning tables of small controls: screws of Smoothieware, ecmc, Aerotech, Weihong, Mach4, Fagor and Centroid."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compgen.controls.shared.base import (
    Settings,
    SourceFile,
    Term,
    parameter_row,
)
from compgen.controls.shared.grids import equidistant_grid, loss_setting, rounded
from compgen.controls.shared.scanner import check_complete, content_lines, fixed_point, floating
from compgen.controls.shared.tables import AxisTableController, AxisTables, Table1D
from compgen.controls.shared.terms import one_dimensional_name
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray, whole_number
from compgen.data.error_table import ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import Section, accepts, axis_setting, choice, setting, whole

#: How often the correction at the corrected position is looked up again: a slope of 1e-3 leaves 1e-3 of it each time.
_STEPS = 12


class ScrewControl(AxisTableController[Settings]):
    """One polyline over each axis, zero at the reference point: a constant would only move the axis when it is switched on."""

    anchored = True


def axis_named(source: SourceFile, line: int, word: str) -> int:
    """Return the number of the axis with this letter; InputError for anything else."""
    if word.upper() not in AXES or len(word) != 1:
        raise source.fail(f"{word[:40]!r} is not an axis; expected X, Y or Z", line)
    return AXES.index(word.upper())


def sign_setting(values: str) -> Any:
    """Declare ``sign``, which the user must state: no document of the vendor settles it."""
    return setting(
        choice("error", "correction"),
        meaning=f'what the {values} are: "error", actual minus nominal, which the control subtracts, or "correction", '
        "which it adds; check it at the machine",
    )


class StatedSign(ScrewControl[Settings]):
    """A control whose sign the machine file must state, with a table for each direction of travel."""

    bidirectional = True
    digits = 4

    @classmethod
    def settings_section(cls, machine: Machine) -> Section:
        """Return the section, which must state the sign."""
        section = super().settings_section(machine)
        if "sign" not in section:
            raise section.fail(
                "sign",
                "is missing: no document of the vendor says whether the control adds or subtracts the values; set sign = "
                '"error" (actual minus nominal, subtracted) or "correction" (added). The card (volcomp controllers NAME) says '
                "what speaks for which; check it at the machine",
                kind="missing",
                instead="error",
            )
        return section

    def __init__(self, machine: Any, settings: Settings | None = None) -> None:
        super().__init__(machine, settings)
        self.sign = -1.0 if getattr(self.settings, "sign") == "error" else 1.0  # noqa: B009

    def reservations(self, tables: AxisTables) -> list[str]:
        """Say that the sign comes from the machine file."""
        return [
            f'the sign of the values is the one that the machine file states ("{getattr(self.settings, "sign")}"); '  # noqa: B009
            "no document of the vendor settles it: do the check in preflight.md first"
        ]

    def sign_words(self) -> str:
        """Return what the machine file says."""
        if self.sign < 0.0:
            return 'sign = "error": the values are actual minus nominal; the control SUBTRACTS them from the command.'
        return 'sign = "correction": the values are nominal minus actual; the control ADDS them to the command.'


class SheetControl(StatedSign[Settings]):
    """A control whose values are typed in: the file is a sheet of them, CSV."""

    HEADER = "axis,position_mm,positive_mm,negative_mm"

    def read_file(self, source: SourceFile) -> dict[int, list[tuple[float, float, float]]]:
        """Read the sheet; a comment declares how many rows it has."""
        found: dict[int, list[tuple[float, float, float]]] = {}
        lines = content_lines(source, "#")
        if lines[0][1] != self.HEADER:
            raise source.fail(f"expected the header {self.HEADER}", lines[0][0])
        for line, text in lines[1:]:
            cells = [cell.strip() for cell in text.split(",")]
            if len(cells) != 4:
                raise source.fail(f"expected 4 columns separated by commas, got {len(cells)}", line)
            position, positive, negative = (
                float(fixed_point(source, line, cell, "a value in mm")) for cell in cells[1:]
            )
            if positive != negative and not self.bidirectional:
                message = (
                    f"{positive:g} and {negative:g} differ, but the machine file says that one value holds for both"
                )
                raise source.fail(f"{message} directions (both_directions)", line)
            found.setdefault(axis_named(source, line, cells[0]), []).append((position, positive, negative))
        check_complete(source, len(lines) - 1)
        return found


@dataclass(frozen=True)
class WeihongSettings:
    """Settings ``[controllers.weihong]``."""

    sign: str = sign_setting("numbers of axeserr.dat")
    loss_mm: float = loss_setting()


class Weihong(StatedSign[WeihongSettings]):
    """``weihong``: the screw error file axeserr.dat of NcStudio."""

    name = "weihong"
    settings_class = WeihongSettings
    table_name = "section"

    def read_file(self, source: SourceFile) -> dict[int, list[tuple[float, float, float]]]:
        """Read ``unit = mm``, then a section per axis with rows of nominal position, forward and backward value."""
        found: dict[int, list[tuple[float, float, float]]] = {}
        rows: list[tuple[float, float, float]] | None = None
        unit = False
        for line, text in content_lines(source, ";"):
            if re.fullmatch(r"unit\s*=\s*mm", text, re.IGNORECASE):
                unit = True
            elif head := re.fullmatch(r"\[\s*(\w{1,9})\s*\]", text):
                axis = axis_named(source, line, head.group(1))
                if axis in found:
                    raise source.fail(f"the section [{AXES[axis]}] is given a second time", line)
                rows = found[axis] = []
            elif not unit:
                raise source.fail(f"expected 'unit = mm' before the first row, got {text[:40]!r}", line)
            elif rows is None:
                raise source.fail(f"expected a section [X], [Y] or [Z], got {text[:40]!r}", line)
            else:
                cells = [cell.strip() for cell in text.split(",")]
                if len(cells) != 3:
                    message = f"expected nominal position, forward and backward value, got {len(cells)} columns"
                    raise source.fail(message, line)
                position, positive, negative = (
                    float(fixed_point(source, line, cell, "a value in mm")) for cell in cells
                )
                if rows and position <= rows[-1][0]:
                    raise source.fail(f"the position {position:g} is not above {rows[-1][0]:g} before it", line)
                rows.append((position, positive, negative))
        return found


@dataclass(frozen=True)
class CentroidSettings:
    """Settings ``[controllers.centroid]``."""

    sign: str = sign_setting("values of the table")
    values: str = setting(
        choice("mm", "counts"),
        meaning='unit of the values: "mm", as the positions, or "counts" of the encoder; no document that we have states it '
        "for version 3",
    )
    counts_per_mm: tuple[float, float, float] = axis_setting(
        toml_files.positive,
        (0.0, 0.0, 0.0),
        meaning="encoder counts per mm of each axis; needed for values in counts",
    )
    most_points: int = setting(
        whole(2, 1000), 200, meaning="most points of one axis; no document that we have states a limit"
    )
    loss_mm: float = loss_setting()


class Centroid(StatedSign[CentroidSettings]):
    """``centroid``: laser compensation of CNC10, CNC11 and CNC12, version 3 of the .tab files, one for each axis."""

    name = "centroid"
    settings_class = CentroidSettings
    even, digits, table_name = True, 6, "compensation table"
    HEAD = "CNC10 TAB FILE VERSION 3"
    KEYS = ("AXIS", "UNITS", "INTERVAL", "ENTRIES")

    @classmethod
    def settings_section(cls, machine: Machine) -> Section:
        """Return the section, which must state sign and unit of the values."""
        section = super().settings_section(machine)
        if "values" not in section:
            raise section.fail(
                "values",
                'is missing: no document that we have states the unit of the values; set values = "mm" or "counts" as your '
                "control's own file of a measured axis shows it (whole numbers of tens and hundreds are counts)",
                kind="missing",
                instead="mm",
            )
        return section

    @classmethod
    def check_settings(cls, settings: CentroidSettings, section: Section, machine: Machine) -> CentroidSettings:
        """Ask for the counts per mm where the values are counts."""
        if settings.values == "counts" and 0.0 in settings.counts_per_mm:
            raise section.fail(
                "counts_per_mm",
                "is missing: values in counts need it for all axes, e.g. counts_per_mm = { X = 2000, Y = 2000, Z = 2000 }",
                kind="missing",
                instead=dict.fromkeys(AXES, 2000.0),
            )
        return settings

    def mm_per_value(self, axis: int) -> float:
        """Return the size of one value, mm."""
        return 1.0 if self.settings.values == "mm" else 1.0 / self.settings.counts_per_mm[axis]

    def nodes_mm(self, errors: ErrorTable, axis: int) -> FloatArray:
        """Return positions from one end of the travel to the other: the control counts them from where the axis is homed."""
        most, loss_mm = self.most_points, self.settings.loss_mm
        return equidistant_grid(self.machine, errors, axis, most=most, loss_mm=loss_mm, anchor=False).nodes_mm

    def resolution_mm(self) -> float:
        """Half of a count, or of the last decimal in mm."""
        if self.settings.values == "mm":
            return super().resolution_mm()
        return 0.5 * max(self.mm_per_value(axis) for axis in range(3))

    def as_written(self, axis: int, nodes_mm: FloatArray, positive_mm: FloatArray, negative_mm: FloatArray) -> Table1D:
        """Return the table as it comes back from the file: whole counts, or with its decimals."""
        table, size = super().as_written(axis, nodes_mm, positive_mm, negative_mm), self.mm_per_value(axis)
        if self.settings.values == "mm":
            return table
        return self.table_of(axis, nodes_mm, *(np.round(column / size) * size for column in table.columns))

    def context(self, tables: AxisTables) -> dict[str, Any]:
        """Return the rows in the order of the file: from the end that is nearer to machine zero, where the axis is homed."""
        digits = self.digits if self.settings.values == "mm" else 0
        shown = []
        for axis, table in sorted(tables.tables.items()):
            columns = (table.nodes, *(part / self.mm_per_value(axis) for part in table.columns))
            rows = list(zip(*(column.tolist() for column in columns), strict=True))
            outward = abs(table.nodes[0]) <= abs(table.nodes[-1])
            interval = (table.nodes[-1] - table.nodes[0]) / (len(rows) - 1)
            shown.append({"letter": AXES[axis], "interval": interval, "rows": rows if outward else rows[::-1]})
        return {**super().context(tables), "tables": {part["letter"]: part for part in shown}, "digits": digits}

    def read_file(self, source: SourceFile) -> dict[int, list[tuple[float, float, float]]]:
        """Read the four lines of the head, then rows of position, forward and reverse value, rising or falling."""
        lines = content_lines(source, "//")
        if lines[0][1].upper() != self.HEAD:
            raise source.fail(
                f"expected {self.HEAD!r}, got {lines[0][1][:40]!r}; other versions are not read", lines[0][0]
            )
        keys: dict[str, tuple[int, str]] = {}
        rows: list[tuple[float, float, float]] = []
        axis, size = 0, 1.0
        for line, text in lines[1:]:
            words = text.split()
            if len(keys) < len(self.KEYS):
                expected = self.KEYS[len(keys)]
                if len(words) != 2 or words[0].upper() != expected:
                    raise source.fail(f"expected {expected} with its value, got {text[:40]!r}", line)
                keys[expected] = line, words[1]
                if expected == "AXIS":
                    axis = axis_named(source, line, words[1])
                    size = self.mm_per_value(axis)
                elif expected == "UNITS" and words[1].upper() != "MM":
                    raise source.fail(f"UNITS {words[1][:20]}: only files in MM are read", line)
                continue
            if len(words) != 3:
                raise source.fail(f"expected position, forward and reverse value, got {len(words)} columns", line)
            position, positive, negative = (float(fixed_point(source, line, word, "a number")) for word in words)
            if self.settings.values == "counts" and not (positive.is_integer() and negative.is_integer()):
                raise source.fail(f"{text[:40]!r}: counts are whole numbers; are the values in mm?", line)
            rows.append((position, positive * size, negative * size))
        self._check_head(source, keys, [row[0] for row in rows])
        falling = len(rows) > 1 and rows[1][0] < rows[0][0]
        return {axis: rows[::-1] if falling else rows}

    def _check_head(self, source: SourceFile, keys: Mapping[str, tuple[int, str]], positions: Sequence[float]) -> None:
        """Check ENTRIES and INTERVAL of the head against the positions of the rows, mm."""
        if len(keys) < len(self.KEYS):
            raise source.fail(f"{self.KEYS[len(keys)]} is missing: the file is truncated")
        line, word = keys["ENTRIES"]
        if whole_number(word, 6) != len(positions):
            raise source.fail(
                f"declares {word[:20]} entries but has {len(positions)}: it is truncated or was edited", line
            )
        line, word = keys["INTERVAL"]
        interval = float(fixed_point(source, line, word, "INTERVAL"))
        if len(positions) > 1 and np.any(
            np.abs(np.abs(np.diff(positions)) - interval) > 4.0 * 10.0**-self.position_digits
        ):
            raise source.fail(f"INTERVAL {interval:g} is not the distance between the positions", line)

    def reservations(self, tables: AxisTables) -> list[str]:
        """Say also where the table does not begin at machine zero, as the only file seen does."""
        found = super().reservations(tables)
        for axis, table in sorted(tables.tables.items()):
            if not np.isclose(np.abs(table.nodes[[0, -1]]).min(), 0.0, atol=10.0**-self.position_digits):
                found.append(
                    f"the table of {AXES[axis]} does not begin at machine zero, where the axis is homed, as the only public file "
                    "does: check that the control takes its positions"
                )
        return found


@dataclass(frozen=True)
class Mach4Settings:
    """Settings ``[controllers.mach4]``."""

    sign: str = sign_setting("values that are typed in")
    both_directions: bool = setting(
        toml_files.flag, False, meaning="the build has a map for each direction (after 4780 of 2021-11-29)"
    )
    most_points: int = setting(whole(2, 1000), 60, meaning="most points of one axis that you are willing to type in")
    loss_mm: float = setting(
        toml_files.positive,
        key="loss_um",
        unit=MM_PER_UM,
        stated=0.5,
        meaning="interpolation loss between points that does not justify typing in another one, um",
    )


class Mach4(SheetControl[Mach4Settings]):
    """``mach4``: the values of the plug-in Machine Calibration, Linear Compensation."""

    name = "mach4"
    settings_class = Mach4Settings
    even, table_name = True, "screw map"

    def __init__(self, machine: Any, settings: Mach4Settings | None = None) -> None:
        super().__init__(machine, settings)
        self.bidirectional = self.settings.both_directions

    def parameters(self, tables: AxisTables) -> list[dict[str, str]]:
        """Return start, length and number of points of each axis."""
        return [
            parameter_row(
                f"{AXES[axis]}: start, length, points",
                f"{table.nodes[0]:.4f}, {table.nodes[-1] - table.nodes[0]:.4f}, {len(table.nodes)}",
                "mm; the points are evenly spaced and include both ends",
            )
            for axis, table in sorted(tables.tables.items())
        ]


@dataclass(frozen=True)
class FagorSettings:
    """Settings ``[controllers.fagor-8055]``."""

    sign: str = sign_setting("errors of the table")
    most_points: int = setting(whole(2, 1000), 1000, meaning="axis parameter NPOINTS (P16)")
    loss_mm: float = loss_setting()


class Fagor8055(SheetControl[FagorSettings]):
    """``fagor-8055``: the leadscrew tables of the CNC 8055 and 8055i."""

    name = "fagor-8055"
    settings_class = FagorSettings
    table_name = "leadscrew table"

    def with_reversal(self, tables: AxisTables, reversal: ReversalCurves) -> AxisTables:
        """Return the tables with the reversal; a negative column of zeros alone would mean: as in positive travel."""
        found = {}
        for axis, table in super().with_reversal(tables, reversal).tables.items():
            if np.any(table.positive) and not np.any(table.negative):
                negative = table.columns[1].copy()
                negative[0] = 10.0**-self.digits
                table = replace(table, negative=negative)
            found[axis] = table
        return AxisTables(found)

    def curves(self, tables: AxisTables) -> Sequence[Table1D]:
        """Return the tables; a negative column of zeros means that the positive one holds for both directions."""
        return [
            table if np.any(table.columns[1]) else replace(table, negative=None) for table in super().curves(tables)
        ]

    def parameters(self, tables: AxisTables) -> list[dict[str, str]]:
        """Return the axis parameters that switch a table on."""
        return [
            row
            for axis, table in sorted(tables.tables.items())
            for row in (
                parameter_row(f"{AXES[axis]}: NPOINTS (P16)", str(len(table.nodes)), "points of the table"),
                parameter_row(f"{AXES[axis]}: LSCRWCOM (P15)", "ON", "switches the table on"),
            )
        ]


@accepts({"type": "string", "pattern": r"^[0-9]+(\.[0-9]+){0,3}$"})
def _version(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[0-9]{1,4}(\.[0-9]{1,4}){0,3}", value):
        raise ValueError('expected a version such as "10.0.0" or "9.6.8", in quotes')
    return value


@dataclass(frozen=True)
class EcmcLookupSettings:
    """Settings ``[controllers.ecmc]``."""

    version: str = setting(
        _version,
        meaning="release of ecmc that runs: up to 9.6.8 the table is added to the encoder, from 10.0.0 on subtracted",
    )
    loss_mm: float = loss_setting()


class EcmcLookup(ScrewControl[EcmcLookupSettings]):
    """``ecmc``: lookup tables of the encoders, one file per axis."""

    name = "ecmc"
    settings_class = EcmcLookupSettings
    at_axes = True
    least, digits = 3, 9
    table_name = "lookup table"
    #: First release that subtracts the table.
    SUBTRACTS_FROM = 10

    @classmethod
    def settings_section(cls, machine: Machine) -> Section:
        """Return the section, which must state the release."""
        section = super().settings_section(machine)
        if "version" not in section:
            raise section.fail(
                "version",
                'is missing: release 10.0.0 reversed the sign of the table; set the release that runs, e.g. version = "11.0.8"',
                kind="missing",
                instead="10.0.0",
            )
        return section

    def __init__(self, machine: Any, settings: EcmcLookupSettings | None = None) -> None:
        super().__init__(machine, settings)
        # the axis stands where encoder - table = command, so the control adds the table to the command
        self.sign = 1.0 if self.subtracts else -1.0

    @property
    def subtracts(self) -> bool:
        """Whether this release subtracts the table from the encoder."""
        return int(self.settings.version.partition(".")[0]) >= self.SUBTRACTS_FROM

    def read_file(self, source: SourceFile) -> dict[int, list[tuple[float, float, float]]]:
        """Read rows of position and value, separated by blanks or commas, with ``PREC=n`` and comments in column one."""
        named = re.findall(r"(?<![a-z])([xyz])(?![a-z])", source.path.stem, re.IGNORECASE)
        if not named:
            raise source.fail("the file name does not say which axis it is for; expected a name such as ecmc-x.lut", 1)
        rows: list[tuple[float, float, float]] = []
        for line, text in content_lines(source, "#"):
            if re.fullmatch(r"PREC=[0-9]{1,3}", text):
                continue
            words = text.replace(",", " ").split()
            if len(words) != 2:
                raise source.fail(f"expected a position and a value, got {len(words)} columns", line)
            position, value = (floating(source, line, word, "a number in mm") for word in words)
            if rows and position <= rows[-1][0]:
                raise source.fail(f"the position {position:g} is not above {rows[-1][0]:g} before it", line)
            rows.append((position, value, value))
        return {AXES.index(named[-1].upper()): rows}

    def emulate(self, tables: AxisTables, points: Points) -> FloatArray:
        """Return encoder minus command where the corrected encoder shows the command."""
        added = np.zeros((len(points), 3))
        for _ in range(_STEPS):
            added = super().emulate(tables, Points(points.position_mm + added))
        return added

    def parameters(self, tables: AxisTables) -> list[dict[str, str]]:
        """Return the commands that load the tables."""
        return [
            parameter_row("ecmc", self.settings.version, "release for which the sign was chosen"),
            parameter_row("Cfg.SetAxisEncLookupTableScale", "1", "another scale multiplies the table, -1 reverses it"),
            parameter_row("Cfg.SetAxisEncLookupTableRange", "0", "with a range the table repeats"),
        ]

    def sign_words(self) -> str:
        """Return what this release does with a value."""
        if self.subtracts:
            return f"ecmc {self.settings.version} SUBTRACTS the value from the encoder position: value = encoder minus true."
        return f"ecmc {self.settings.version} ADDS the value to the encoder position: value = true minus encoder."


@dataclass(frozen=True)
class AerotechSettings:
    """Settings ``[controllers.aerotech]``."""

    axis_numbers: tuple[int, int, int] = axis_setting(
        whole(1, 32),
        (1, 2, 3),
        differ="the three axis numbers must differ, got {}",
        meaning="numbers of the axes in the file, from 1",
    )
    reversed_axes: tuple[bool, bool, bool] = axis_setting(
        toml_files.flag, (False, False, False), meaning="ReverseMotionDirection of the axis: tables follow the encoder"
    )
    loss_mm: float = loss_setting()

    def way(self, axis: int) -> float:
        """Return +1, or -1 where the encoder counts against the axis."""
        return -1.0 if self.reversed_axes[axis] else 1.0


class Aerotech(ScrewControl[AerotechSettings]):
    """``aerotech``: one-dimensional axis calibration of A3200 and Automation1."""

    name = "aerotech"
    settings_class = AerotechSettings
    even, table_name = True, "calibration table"

    def context(self, tables: AxisTables) -> dict[str, Any]:
        """Return the tables as in the file: in the direction of the encoder, six values a line."""
        shown = []
        for axis, table in sorted(tables.tables.items()):
            way = self.settings.way(axis)
            step = (table.nodes[-1] - table.nodes[0]) / (len(table.nodes) - 1)
            values = [way * value for value in table.positive.tolist()]
            shown.append(
                {
                    "letter": AXES[axis],
                    "number": self.settings.axis_numbers[axis],
                    "sample_mm": way * step,
                    "offset_mm": -way * float(table.nodes[0]),
                    "lines": [values[k : k + 6] for k in range(0, len(values), 6)],
                }
            )
        return {**super().context(tables), "tables": shown}

    def read_file(self, source: SourceFile) -> dict[int, list[tuple[float, float, float]]]:
        """Read all tables ``:START`` ... ``:END``."""
        found: dict[int, list[tuple[float, float, float]]] = {}
        keys: dict[str, float] = {}
        values: list[float] = []
        axis: int | None = None
        begun = 0
        for line, text in content_lines(source, "'"):
            words = text.split()
            if words[0].upper() == ":START":
                if values:
                    raise source.fail(":START within the values; is :END missing?", line)
                begun = line
                for word in words[1:]:
                    key, _, number = word.upper().partition("=")
                    if not number and axis is None and key.isdigit():
                        if whole_number(key, 2) not in self.settings.axis_numbers:
                            raise source.fail(f"axis {key[:9]} is none of {self.settings.axis_numbers}", line)
                        axis = self.settings.axis_numbers.index(int(key))
                    elif (key, number) in (("POSUNIT", "PRIMARY"), ("CORUNIT", "PRIMARY")):
                        keys.setdefault("unit", 1.0)
                    elif (key, number) == ("CORUNIT", "PRIMARY/1000"):
                        keys["unit"] = 1e-3
                    elif key in ("SAMPLEDIST", "OFFSET") and key not in keys:
                        keys[key] = float(fixed_point(source, line, number, key))
                    else:
                        raise source.fail(
                            f"{word[:40]!r} is not understood or given twice; it may change the table", line
                        )
            elif words == [":END"]:
                if axis is None or "SAMPLEDIST" not in keys or "OFFSET" not in keys:
                    raise source.fail("the table needs an axis number, SAMPLEDIST and OFFSET", line)
                if axis in found:
                    raise source.fail(f"is a second table of axis {self.settings.axis_numbers[axis]}", line)
                way = self.settings.way(axis)
                step, first = way * keys["SAMPLEDIST"], -way * keys["OFFSET"]
                if step <= 0.0:
                    raise source.fail(
                        f"SAMPLEDIST {keys['SAMPLEDIST']:g} does not fit reversed_axes of {AXES[axis]}", line
                    )
                found[axis] = [
                    (round(first + k * step, 9), way * keys["unit"] * value, way * keys["unit"] * value)
                    for k, value in enumerate(values)
                ]
                keys, values, axis, begun = {}, [], None, 0
            elif begun:
                values += [float(fixed_point(source, line, word, "a correction value")) for word in words]
            else:
                raise source.fail(f"expected :START, got {text[:40]!r}", line)
        if begun:
            raise source.fail("the table that begins here has no :END; is the file truncated?", begun)
        check_complete(source, sum(map(len, found.values())))
        return found

    def sign_words(self) -> str:
        """Return what a value is, as far as public writers of such files show it."""
        return "A value is the correction, minus the measured error, in mm; the control ADDS it (inferred, see below)."


@dataclass(frozen=True)
class SmoothiewareSettings:
    """Settings ``[controllers.smoothieware]``."""

    most_points: int = setting(
        whole(2, 400), 40, meaning="largest number of nodes of one axis; each is written as two points"
    )
    loss_mm: float = loss_setting()


class Smoothieware(ScrewControl[SmoothiewareSettings]):
    """``smoothieware``: pitch_compensation.dat of Carvera and Smoothieware, multipliers of the position."""

    name = "smoothieware"
    settings_class = SmoothiewareSettings
    digits, table_name, points_per_node = 9, "list of points", 2
    #: Half the distance of the two points that make a bend, mm: the polyline is rounded over it.
    BEND_MM = 0.05

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return X(x), Y(y), Z(z), zero at machine zero, which is a node of each."""
        return [replace(term, zero_at_mm=0.0, start=term.start - np.interp(0.0, term.nodes_mm, term.start))
                for term in super().basis(errors)]  # fmt: skip

    def nodes_mm(self, errors: ErrorTable, axis: int) -> FloatArray:
        """Add machine zero, from which the control integrates, and keep nodes far enough apart for their bends."""
        nodes = super().nodes_mm(errors, axis)
        if not nodes[0] <= 0.0 <= nodes[-1]:
            nodes = np.union1d(nodes, [0.0])
        apart = np.concatenate([[True], np.diff(nodes) > 4.0 * self.BEND_MM])
        apart[-1] = True
        return np.asarray(nodes[apart])

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> AxisTables:
        """Return the multipliers: constant between two nodes, changing linearly over a bend at each node between.

        The integral of the multipliers then passes through every node but for the rounding of its bend.
        """
        found = {}
        for axis, term in enumerate(basis):
            nodes, added = term.nodes_mm, np.asarray(values[one_dimensional_name(axis, axis)])
            slopes = 1.0 + np.diff(added) / np.diff(nodes)
            bends = [position for node in nodes[1:-1] for position in (node - self.BEND_MM, node + self.BEND_MM)]
            positions = np.array([nodes[0], *bends, nodes[-1]])
            column = rounded(np.repeat(slopes, 2), self.digits)
            found[axis] = Table1D(axis, axis, rounded(positions, self.position_digits), column)
        return AxisTables(found)

    def emulate(self, tables: AxisTables, points: Points) -> FloatArray:
        """Return the integral of the multipliers minus the position: ``integrate`` of PitchCompensation.cpp, in float32."""
        added = np.zeros((len(points), 3))
        for axis, table in tables.tables.items():
            position = table.nodes.astype(np.float32)
            multiplier = table.positive.astype(np.float32)
            dx = np.diff(position).astype(np.float64)
            mean = (multiplier[1:] + multiplier[:-1]).astype(np.float64) / 2.0
            integral = np.concatenate([[0.0], np.cumsum(dx * mean)])
            where = np.append(points.position_mm[:, axis], 0.0)
            k = np.clip(np.searchsorted(position.astype(np.float64), where, side="right") - 1, 0, len(dx) - 1)
            beyond = np.clip(where, float(position[0]), float(position[-1]))
            along = beyond - position[k].astype(np.float64)
            bend = (multiplier[k + 1] - multiplier[k]).astype(np.float64) / dx[k]
            total = integral[k] + multiplier[k].astype(np.float64) * along + 0.5 * bend * along**2
            ends = np.where(where < position[0], multiplier[0], multiplier[-1]).astype(np.float64)
            total += ends * (where - beyond)
            added[:, axis] = total[:-1] - total[-1] - where[:-1]
        return added

    def violations(self, tables: AxisTables) -> list[str]:
        """Return also multipliers that the control skips."""
        found = super().violations(tables)
        for axis, table in sorted(tables.tables.items()):
            if np.any(np.abs(table.positive - 1.0) > 0.5):
                found.append(f"{AXES[axis]} has a multiplier outside 0.5 ... 1.5, which the control skips")
        return found

    def read_file(self, source: SourceFile) -> dict[int, list[tuple[float, float, float]]]:
        """Read lines such as ``X 10.5 1.00034``."""
        found: dict[int, list[tuple[float, float, float]]] = {}
        for line, text in content_lines(source, "#"):
            words = text.split()
            if len(words) != 3:
                raise source.fail(f"expected axis, position and multiplier, got {len(words)} columns", line)
            rows = found.setdefault(axis_named(source, line, words[0]), [])
            position, multiplier = (floating(source, line, word, "a number") for word in words[1:])
            if rows and position <= rows[-1][0]:
                raise source.fail(f"the position {position:g} is not above {rows[-1][0]:g} before it", line)
            rows.append((position, multiplier, multiplier))
        return found

    def anchor_mm(self) -> FloatArray:
        """Return machine zero, from which the control integrates."""
        return np.zeros(3)

    def resolution_mm(self) -> float:
        """Half a step of float32 near 1 over the travel, and the rounding of a bend."""
        reach = float(np.abs([self.machine.lower_mm, self.machine.upper_mm]).max())
        step = math.ulp(1.0) * 2.0**29  # of float32 between 1 and 2
        return 0.5 * step * reach + 1e-5

    def sign_words(self) -> str:
        """Return what a number is."""
        return "A number is a multiplier of the distance from machine zero: above 1 the axis is sent further out."
