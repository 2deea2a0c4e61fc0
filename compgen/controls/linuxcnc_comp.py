"""LinuxCNC leadscrew compensation (``linuxcnc-comp``): one COMP_FILE per joint, positioning and reversal of X, Y, Z."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from compgen.controls.shared.base import SourceFile, coverage_violations, parameter_row
from compgen.controls.shared.grids import loss_setting, rounded
from compgen.controls.shared.scanner import number_pattern
from compgen.controls.shared.tables import AxisTables, PerAxisController, Table1D, largest_of
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve
from compgen.data.machine import MM_PER_UNIT, Machine
from compgen.data.names import AXES, LARGEST, MM_PER_UM
from compgen.data.toml_files import (
    accepted,
    accepts,
    array_schema,
    axis_setting,
    choice,
    setting,
    whole,
)
from compgen.errors import InputError

T = TypeVar("T")
# Text for LinuxCNC: lines one by one, so garbage of any size fails at the first wrong line; numbers; units.


#: A number as read by C with %lf, except hexadecimal digits, ``inf`` and ``nan``.
_NUMBER = number_pattern(exponent=4)
_BLANK = re.compile(r"[ \t\r\n]*+")
#: Number of characters quoted from a wrong word.
SHOWN = 40


def units_setting(meaning: str) -> Any:
    """Declare ``machine_units``: [TRAJ] LINEAR_UNITS, in which LinuxCNC reads all numbers, ``"mm"`` or ``"inch"``.

    The default is that of the machine, or mm (:func:`with_units`).
    """
    return setting(choice(*MM_PER_UNIT), "mm", meaning=meaning)


def with_units(settings: T, section: toml_files.Section, machine: Machine) -> T:
    """Return settings of a control with the unit that the machine states, unless its section does."""
    return toml_files.unless_stated(settings, section, machine_units=machine.machine_units or "mm")


def check_size(source: SourceFile, most: int) -> None:
    """Raise InputError for a text that is longer than any file of its kind."""
    if len(source.text) > most:
        raise source.fail(f"has {len(source.text)} characters; a table has at most {most}", 1)


def lines_of(source: SourceFile) -> Iterator[tuple[int, str, bool]]:
    """Yield for each line its number (from 1), its text, and whether it has a line end (LF or CRLF).

    Only the first of consecutive blank lines is yielded.
    """
    text, start, number = source.text, 0, 1
    while start < len(text):
        blank = _BLANK.match(text, start)
        after = text.rfind("\n", start, blank.end() if blank else start) + 1
        if after > start:
            yield number, "", True
            start, number = after, number + text.count("\n", start, after)
            continue
        end = text.find("\n", start)
        last = len(text) if end < 0 else end
        yield number, text[start:last].removesuffix("\r"), end >= 0
        start, number = last + 1, number + 1


def number_in(source: SourceFile, line: int, word: str, what: str) -> float:
    """Return a finite number; InputError with the line for a decimal comma, nan, inf or anything else."""
    if _NUMBER.fullmatch(word) and math.isfinite(value := float(word)) and abs(value) <= LARGEST:
        return value
    hint = "; the decimal mark of LinuxCNC is '.'" if "," in word else ""
    raise source.fail(f"{word[:SHOWN]!r} is not a number; expected {what}{hint}", line)


def whole_in(source: SourceFile, line: int, word: str, what: str, limits: tuple[int, int]) -> int:
    """Return a whole number within ``limits`` (both included); else InputError with the line."""
    if not re.fullmatch(r"[0-9]{1,9}", word) or not limits[0] <= int(word) <= limits[1]:
        raise source.fail(f"{word[:SHOWN]!r} is not {what}; expected {limits[0]} ... {limits[1]}", line)
    return int(word)


# LinuxCNC's COMP_FILE: strict reading, and the control's rule in the control's arithmetic (float32 trims and slopes).
#
# Found by running LinuxCNC 2.9: trims and their slopes are stored as float32, positions as double; the table
# keeps its end values outside; a position p with ``nominal[i] <= p < nominal[i+1]`` is corrected by
# ``trim[i] + slope[i] * (p - nominal[i])``, forward while the joint moves up, reverse while it moves down. The correction is
# ADDED to the motor command.


#: Maximum number of rows that LinuxCNC keeps, and of characters it reads per line.
MOST_ROWS, LONGEST_LINE = 256, 254
_MOST_CHARACTERS = 1_000_000
#: A correction step at standstill acts at once below the first multiple of a T^2, is ramped above the second, and
#: never acts in between (a: joint acceleration, T: servo period).
AT_ONCE, RAMPED = 0.25, 0.5
#: Columns whose values grow by more than this fraction of the nominal position are positions, not trims.
_LIKE_POSITIONS = 0.9
_COLUMNS = ("the nominal position", "the forward value", "the reverse value")


@dataclass(frozen=True)
class CompTable(Table1D):
    """One COMP_FILE with the numbers of its text, in machine units, in which the control rounds too.

    ``nodes`` are the nominal positions; the values are the trims while the joint moves up and down, which are added.
    """

    def interpolated(self, along: FloatArray, values: FloatArray) -> FloatArray:
        """Return the trim at joint positions (m,), bit for bit as in the control."""
        trims = values.astype(np.float32)
        # slopes after each row: float32 of the float32 differences; zero after the last
        differences = (trims[1:] - trims[:-1]).astype(np.float64)
        slopes = np.append((differences / np.diff(self.nodes)).astype(np.float32), np.float32(0.0))
        row = np.searchsorted(self.nodes, along, side="right") - 1
        inside = np.clip(row, 0, len(trims) - 1)
        found = trims[inside].astype(np.float64) + slopes[inside].astype(np.float64) * (along - self.nodes[inside])
        return np.where(row < 0, np.float64(trims[0]), found)


def comp_table(
    axis: int, nominal: FloatArray, forward: FloatArray, reverse: FloatArray, mm_per_unit: float = 1.0
) -> CompTable:
    """Return the table of a joint with numbers in machine units of ``mm_per_unit``."""
    return CompTable(axis, axis, nominal, forward, reverse, mm_per_unit, mm_per_unit)


def steps_mm(table: Table1D) -> FloatArray:
    """Size of the step between forward and reverse at each row, shape (n,), mm."""
    forward, reverse = (table.value_mm * column for column in table.columns)
    return np.abs(forward - reverse)


def standstill_outcome(step_mm: float, acceleration_mm_s2: float, period_s: float) -> str:
    """Say how a correction step acts from standstill: ``"at once"``, ``"never"`` or ``"ramped"``.

    LinuxCNC ramps the correction with half the joint acceleration. A step of at most 0.25 a T^2 is applied at once,
    above 0.5 a T^2 it is ramped; in between the filter keeps its velocity of zero (found by running LinuxCNC 2.9).

    >>> [standstill_outcome(step, 5000.0, 1e-3) for step in (0.001, 0.002, 0.003)]
    ['at once', 'never', 'ramped']
    """
    unit_mm = acceleration_mm_s2 * period_s**2
    if abs(step_mm) <= AT_ONCE * unit_mm:
        return "at once"
    return "never" if abs(step_mm) <= RAMPED * unit_mm else "ramped"


def parse_comp(source: SourceFile, file_type: int, mm_per_unit: float = 1.0, axis: int = 0) -> CompTable:
    """Read a COMP_FILE strictly.

    Parameters
    ----------
    source : the text; CRLF, exponents and additional columns are accepted, as by the control.
    file_type : 0: nominal, actual forward, actual reverse (trim = nominal minus actual); 1: the trims themselves.
    mm_per_unit : machine unit used in the file; the file itself does not state it.
    axis : the axis 0..2 of the joint.

    Raises
    ------
    InputError
        with the line, for anything that makes the control silently stop (a comment, a blank line, text, a decimal
        comma), for rows that it drops (more than 256, or not increasing), and for a truncated file.
    """
    check_size(source, _MOST_CHARACTERS)
    rows: list[tuple[float, ...]] = []
    blank = 0
    for line, text, ended in lines_of(source):
        if not text.strip(" \t"):
            blank = blank or line
            continue
        if blank:
            raise source.fail("is blank: LinuxCNC stops reading there without a message. Remove the line", blank)
        rows.append(_row(source, line, text, rows))
        if not ended:
            raise source.fail("the last line has no line end; is the file truncated?", line)
    if not rows:
        raise source.fail("contains no row; is it the right file, or is it truncated?", 1)
    nominal, forward, reverse = np.array(rows).T
    # positions read as trims, and trims read as positions, cause errors of many mm
    span = float(np.ptp(nominal))
    slope = float(np.ptp(forward)) / span if span > 0.0 and len(nominal) > 2 else 0.5
    if slope > _LIKE_POSITIONS if file_type == 1 else slope < 1.0 - _LIKE_POSITIONS:
        message = "these are trims (file type 1), but comp_file_type is 0"
        if file_type == 1:
            message = "these are nominal and actual positions (file type 0), but comp_file_type is 1"
        largest = float(np.max(np.abs(forward if file_type == 1 else nominal - forward)))
        message += f": the trims would be up to {largest:g} machine units. Set comp_file_type in the machine file"
        raise source.fail(message, 1)
    if file_type == 0:
        forward, reverse = nominal - forward, nominal - reverse
    return comp_table(axis, nominal, forward, reverse, mm_per_unit)


def _row(source: SourceFile, line: int, text: str, above: list[tuple[float, ...]]) -> tuple[float, ...]:
    if len(text) > LONGEST_LINE:
        raise source.fail(f"has {len(text)} characters; LinuxCNC reads only {LONGEST_LINE} per line", line)
    words = text.split()
    if words[0][0] in "#;(%":
        raise source.fail("is a comment: LinuxCNC stops reading there without a message. Remove the line", line)
    if len(words) < 3:
        message = f"has {len(words)} columns; expected nominal, forward and reverse, got {text.strip()[:SHOWN]!r}"
        raise source.fail(message, line)
    row = tuple(number_in(source, line, word, what) for word, what in zip(words, _COLUMNS, strict=False))
    if above and row[0] <= above[-1][0]:
        message = f"the position {row[0]:g} is not above {above[-1][0]:g} in the row before; LinuxCNC drops such a row"
        raise source.fail(message, line)
    if len(above) == MOST_ROWS:
        raise source.fail(f"is row {MOST_ROWS + 1}; LinuxCNC accepts {MOST_ROWS} rows and drops the rest", line)
    return row


# Information for the user of a COMP_FILE: sign, INI lines, and reversal steps that the control may not apply.


_SECONDS_PER_US = 1e-6
#: A smaller step is ignored.
_NO_STEP_MM = 1e-9


def sign_statement(file_type: int, unit: str, tables: Mapping[int, Table1D]) -> str:
    """Return the sign in words, with a number from the file."""
    table = largest_of(tables.values())
    axis, row = table.axis, table.largest
    position, trim = float(table.nodes[row]), float(table.positive[row])
    places = 6 if unit == "mm" else 8
    written = f"the trim {trim:+.{places}f}" if file_type == 1 else f"the actual position {position - trim:.{places}f}"
    return (
        f"COMP_FILE_TYPE {file_type}: the trim is ADDED to the motor command. The file of {AXES[axis]} has {written} at "
        f"{position:.9g} {unit} (forward), so the motor is sent to {position + trim:.{places}f} {unit} there."
    )


def parameters(
    file_type: int, unit: str, servo_period_us: float, tables: Mapping[int, Table1D], files: Sequence[str]
) -> list[dict[str, str]]:
    """Return the INI lines of each joint, and the accelerations at which a reversal step may be lost, in machine units."""
    rows = [
        parameter_row(
            "[TRAJ] LINEAR_UNITS",
            unit,
            "unit of all numbers in the files; LinuxCNC reads them in its own unit, without a check",
        )
    ]
    for axis, table in sorted(tables.items()):
        section = f"[JOINT_{axis}]"
        rows.append(parameter_row(f"{section} COMP_FILE", files[axis], f"the file of {AXES[axis]}"))
        columns = "forward trim, reverse trim" if file_type == 1 else "actual forward, actual reverse"
        rows.append(parameter_row(f"{section} COMP_FILE_TYPE", str(file_type), f"nominal, {columns}"))
        rows.append(
            parameter_row(
                f"{section} BACKLASH",
                "0",
                "ignored for a joint with a COMP_FILE; a previous value must go into the file",
            )
        )
        steps = steps_mm(table)
        steps = steps[steps > _NO_STEP_MM]
        if len(steps):
            # range of accelerations for which some steps are in the dead zone
            square = (servo_period_us * _SECONDS_PER_US) ** 2
            low = float(steps.min()) / (RAMPED * square) / table.value_mm
            high = float(steps.max()) / (AT_ONCE * square) / table.value_mm
            rows.append(
                parameter_row(
                    f"{section} MAX_ACCELERATION",
                    f"not {low:.0f} ... {high:.0f} {unit}/s2",
                    f"for SERVO_PERIOD {servo_period_us:g} us: in this range, the reversal step of {AXES[axis]} "
                    "may not be applied from standstill",
                )
            )
    return rows


def dead_zone_warnings(
    servo_period_us: float, accelerations_mm_s2: Sequence[float] | None, tables: Mapping[int, Table1D]
) -> list[str]:
    """Return a warning for each joint whose reversal steps the control may not apply at the stated acceleration."""
    if accelerations_mm_s2 is None:
        return []
    found = []
    period_s = servo_period_us * _SECONDS_PER_US
    for axis, table in sorted(tables.items()):
        acceleration = accelerations_mm_s2[axis]
        lost = [
            step for step in steps_mm(table).tolist() if standstill_outcome(step, acceleration, period_s) == "never"
        ]
        if lost:
            unit_um = acceleration * period_s**2 / MM_PER_UM
            found.append(
                f"The reversal step of {AXES[axis]} ({max(lost) / MM_PER_UM:.3f} um) is between {AT_ONCE * unit_um:.3f} "
                f"and {RAMPED * unit_um:.3f} um: LinuxCNC does not apply such a step from standstill at MAX_ACCELERATION "
                f"{acceleration:g} mm/s2 and SERVO_PERIOD {servo_period_us:g} us. Up to {RAMPED * unit_um:.3f} um may "
                "remain uncorrected; change the acceleration or the period."
            )
    return found


# LinuxCNC leadscrew compensation: one COMP_FILE per joint, positioning and reversal of X, Y and Z.
#
# Source: LinuxCNC 2.9 (Debian 12), manual "INI Configuration", section [JOINT_n], and runs of the control itself.


#: Names of the files; joint 0, 1, 2 is X, Y, Z as in ``trivkins coordinates=XYZ``.
FILES = ("joint0-x.comp", "joint1-y.comp", "joint2-z.comp")
POSITION_DIGITS, VALUE_DIGITS = 9, 9
#: Decimals, and float32: a trim of 1 mm is kept to 3e-8 mm, and so is its slope.
_RESOLUTION_MM = 1e-7
_AXIS_OF_NAME = re.compile(r"joint_?([012])(?!\d)|(?<![a-z])([xyz])(?![a-z])", re.IGNORECASE)


#: The letter of an axis at the end of a name, after small letters (screwcompX) or a separator (screw_x).
_LAST_LETTER = re.compile(r"((?<=[a-z0-9])[XYZ]|(?<=[_.-])[xyzXYZ])$")


@accepts({**array_schema(accepted(toml_files.positive), 3), "maxItems": 3})
def _positive3(value: Any) -> tuple[float, float, float]:
    x, y, z = toml_files.vector3(value)
    if min(x, y, z) <= 0:
        raise ValueError("expected three numbers above zero, for X, Y and Z")
    return x, y, z


@dataclass(frozen=True)
class CompSettings:
    """Settings ``[controllers.linuxcnc-comp]``."""

    comp_file_type: int = setting(
        whole(0, 1), 1, meaning="INI key of that name; 1: the file contains trims, 0: nominal and actual positions"
    )
    loss_mm: float = loss_setting()
    servo_period_us: float = setting(
        toml_files.positive,
        1000.0,
        meaning="[EMCMOT] SERVO_PERIOD, us, for the warning about small steps at a reversal",
    )
    max_acceleration_mm_s2: tuple[float, float, float] | None = setting(
        _positive3, None, meaning="[JOINT_n] MAX_ACCELERATION of X, Y, Z, for the same warning"
    )
    machine_units: str = units_setting(
        "[TRAJ] LINEAR_UNITS, mm or inch: LinuxCNC reads the numbers of a COMP_FILE in machine units"
    )
    comp_files: tuple[str | None, str | None, str | None] = axis_setting(
        toml_files.text, meaning="file names of the COMP_FILEs of X, Y, Z on the control, to read them under any name"
    )

    @property
    def mm_per_unit(self) -> float:
        """Length of one machine unit, mm."""
        return MM_PER_UNIT[self.machine_units]


class LinuxcncComp(PerAxisController[CompSettings]):
    """``linuxcnc-comp``: positioning of each joint, with its reversal."""

    name = "linuxcnc-comp"
    settings_class = CompSettings
    bidirectional = True
    most, table_name, point_name = MOST_ROWS, "COMP_FILE", "rows"

    @classmethod
    def check_settings(cls, settings: CompSettings, section: toml_files.Section, machine: Machine) -> CompSettings:
        """Take the unit of the machine, unless the section states it."""
        return with_units(settings, section, machine)

    def positions_as_written(self, position_mm: FloatArray) -> FloatArray:
        """Return positions as in the file, in mm: those equal in the file are equal here to the last bit."""
        return rounded(position_mm / self.settings.mm_per_unit, POSITION_DIGITS) * self.settings.mm_per_unit

    def as_written(self, axis: int, nodes_mm: FloatArray, positive_mm: FloatArray, negative_mm: FloatArray) -> Table1D:
        """Return the table of these positions and trims as read back from its text."""
        unit = self.settings.mm_per_unit
        table = comp_table(axis, nodes_mm / unit, positive_mm / unit, negative_mm / unit, unit)
        nominal, forward, reverse = (rounded(column, VALUE_DIGITS) for column in np.array(self._rows(table)).T)
        if self.settings.comp_file_type == 0:
            forward, reverse = nominal - forward, nominal - reverse
        return comp_table(axis, nominal, forward, reverse, unit)

    def reversal_nodes_mm(self, table: Table1D, curve: Curve) -> FloatArray:
        """Return the rows of a table and those that its reversal needs, as far as the control takes so many."""
        low, high = self.machine.axes[table.axis].range_mm
        inside = curve.position_mm[(curve.position_mm >= low) & (curve.position_mm <= high)]
        nodes_mm = np.union1d(table.nodes_mm, self.positions_as_written(inside))
        return table.nodes_mm if len(nodes_mm) > MOST_ROWS else nodes_mm

    def context(self, tables: AxisTables) -> dict[str, Any]:
        """Return rows by axis letter, INI lines, and what to know about small reversal steps."""
        settings = self.settings
        return {
            "sign_statement": sign_statement(settings.comp_file_type, settings.machine_units, tables.tables),
            "parameters": parameters(
                settings.comp_file_type, settings.machine_units, settings.servo_period_us, tables.tables, FILES
            ),
            "warnings": dead_zone_warnings(settings.servo_period_us, settings.max_acceleration_mm_s2, tables.tables),
            "comp_file_type": settings.comp_file_type,
            "unit": settings.machine_units,
            "tables": [
                {"letter": AXES[axis], "joint": axis, "file": FILES[axis], "rows": self._rows(table)}
                for axis, table in sorted(tables.tables.items())
            ],
        }

    def parse(self, files: Sequence[SourceFile]) -> AxisTables:
        """Read one file per joint; its name identifies the joint: ``joint0`` or the letter, as in ``joint0-x.comp``."""
        found: dict[int, Table1D] = {}
        for source in files:
            axis = _axis_of(source)
            if axis in found:
                raise source.fail(f"is a second file for {AXES[axis]}; give one per joint")
            found[axis] = parse_comp(source, self.settings.comp_file_type, self.settings.mm_per_unit, axis)
        if not found:
            raise InputError(f"no COMP_FILE was given; expected {', '.join(FILES)}")
        return AxisTables(found)

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[AxisTables, list[str]]:
        """Read COMP_FILEs under any name: ``comp_files`` assigns them, else a letter at the end of the name."""
        settings = self.settings
        found: dict[int, Table1D] = {}
        remarks = []
        for source in files:
            last = _LAST_LETTER.search(source.path.stem)
            if source.path.name in settings.comp_files:
                axis = settings.comp_files.index(source.path.name)
            elif last and not _AXIS_OF_NAME.search(source.path.name):
                axis = AXES.index(last.group(1).upper())
            else:
                try:
                    axis = _axis_of(source)  # by our naming rule
                except InputError:
                    message = (
                        "the file name does not say which joint it belongs to; state it in the machine file: "
                        f'[controllers.linuxcnc-comp] comp_files = {{ X = "{source.path.name}" }}'
                    )
                    raise source.fail(message) from None
            if axis in found:
                raise source.fail(f"is a second file for {AXES[axis]}; give one per joint")
            found[axis] = parse_comp(source, settings.comp_file_type, settings.mm_per_unit, axis)
            remarks.append(f"{source.path.name} was read as the file of {AXES[axis]}, type {settings.comp_file_type}")
        return AxisTables(found), remarks

    def violations(self, tables: AxisTables) -> list[str]:
        """Return joints without a table, and travel that a table does not cover, e.g. with a file in another unit."""
        found = [f"there is no COMP_FILE for {AXES[axis]}" for axis in range(3) if axis not in tables.tables]
        for axis, table in sorted(tables.tables.items()):
            first, last = table.nodes_mm[[0, -1]]
            left_out = coverage_violations(self.machine, axis, first, last, f"the COMP_FILE of {AXES[axis]}")
            other = "inch" if self.settings.machine_units == "mm" else "mm"
            share = MM_PER_UNIT[other] / self.settings.mm_per_unit
            if left_out and not coverage_violations(self.machine, axis, first * share, last * share, ""):
                left_out = [
                    f"{text}; in {other} it would cover the travel: is machine_units right?" for text in left_out
                ]
            found += left_out
        return found

    def resolution_mm(self) -> float:
        """Half of the last decimal, plus float32 rounding."""
        return _RESOLUTION_MM

    def _rows(self, table: Table1D) -> list[list[float]]:
        """Rows of the file, in machine units: nominal, then trims (type 1) or actual positions (type 0)."""
        columns = table.columns
        if self.settings.comp_file_type == 0:
            columns = (table.nodes - columns[0], table.nodes - columns[1])
        return [list(row) for row in zip(*(column.tolist() for column in (table.nodes, *columns)), strict=True)]


def _axis_of(source: SourceFile) -> int:
    matches = list(_AXIS_OF_NAME.finditer(source.path.name))
    if not matches:
        raise source.fail(f"the file name does not say which joint it belongs to; expected a name such as {FILES[0]!r}")
    joint, letter = matches[-1].groups()
    return int(joint) if joint else AXES.index(letter.upper())
