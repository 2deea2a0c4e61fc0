"""LinuxCNC leadscrew compensation: one COMP_FILE per joint, positioning and reversal of X, Y and Z.

Source: LinuxCNC 2.9 (Debian 12), manual "INI Configuration", section [JOINT_n], and runs of the control itself.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controllers.grids import take_loss_mm, uneven_nodes_mm
from compgen.controllers.linuxcnc.comp_notes import dead_zone_warnings, parameters, sign_statement
from compgen.controllers.linuxcnc.comp_table import MOST_ROWS, CompTable, parse_comp
from compgen.controllers.linuxcnc.text import MM_PER_UNIT, take_machine_units
from compgen.controllers.terms import one_dimensional_name, one_dimensional_terms
from compgen.core import tomlio
from compgen.core.csvio import FloatArray, fixed
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.points import Points
from compgen.core.reversal import WORTH_MM, ReversalCurves
from compgen.errors import InputError

#: Names of the files; joint 0, 1, 2 is X, Y, Z as in ``trivkins coordinates=XYZ``.
FILES = ("joint0-x.comp", "joint1-y.comp", "joint2-z.comp")
POSITION_DIGITS, VALUE_DIGITS = 9, 9
#: Decimals, and float32: a trim of 1 mm is kept to 3e-8 mm, its slope likewise.
_RESOLUTION_MM = 1e-7
_AXIS_OF_NAME = re.compile(r"joint_?([012])(?!\d)|(?<![a-z])([xyz])(?![a-z])", re.IGNORECASE)


#: The letter of an axis at the end of a name, behind small letters (screwcompX) or a mark (screw_x).
_LAST_LETTER = re.compile(r"((?<=[a-z0-9])[XYZ]|(?<=[_.-])[xyzXYZ])$")


@dataclass(frozen=True)
class CompSettings:
    """Settings ``[controllers.linuxcnc-comp]``.

    Parameters
    ----------
    comp_file_type : INI key of that name; 1: the file holds trims, 0: nominal and actual positions.
    loss_mm : loss by interpolation between rows that is worth no further row.
    servo_period_us : [EMCMOT] SERVO_PERIOD, for the warning about small reversal steps.
    max_acceleration_mm_s2 : [JOINT_n] MAX_ACCELERATION of X, Y, Z, for the same, or None if not stated.
    machine_units : [TRAJ] LINEAR_UNITS, ``"mm"`` or ``"inch"``: what the numbers of the files mean to the control.
    comp_files : COMP_FILE of X, Y, Z in the INI file, for reading tables of the control under any name.
    """

    comp_file_type: int
    loss_mm: float
    servo_period_us: float
    max_acceleration_mm_s2: tuple[float, float, float] | None
    machine_units: str
    comp_files: tuple[str | None, str | None, str | None] = (None, None, None)

    @property
    def mm_per_unit(self) -> float:
        """Length of one machine unit, mm."""
        return MM_PER_UNIT[self.machine_units]


@dataclass(frozen=True)
class CompTables:
    """Tables by axis 0..2; an axis without one is not corrected."""

    tables: Mapping[int, CompTable]


class LinuxcncComp(Controller[CompSettings, CompTables]):
    """``linuxcnc-comp``: positioning of each joint, with its reversal."""

    name = "linuxcnc-comp"
    bidirectional = True

    def read_settings(self, machine: Machine) -> CompSettings:
        """Check the settings; all have defaults."""
        section = machine.controller_settings(self.name)
        settings = CompSettings(
            comp_file_type=section.take("comp_file_type", tomlio.whole(0, 1), 1),
            loss_mm=take_loss_mm(section),
            servo_period_us=section.take("servo_period_us", tomlio.positive, 1000.0),
            max_acceleration_mm_s2=section.take("max_acceleration_mm_s2", _positive3, None),
            machine_units=take_machine_units(section),
            comp_files=_comp_files(section),
        )
        section.finish()
        return settings

    def basis(self, machine: Machine, settings: CompSettings, errors: ErrorTable) -> list[Term]:
        """Return X(x), Y(y), Z(z) with rows where the curves need them."""
        nodes = [
            _written_mm(uneven_nodes_mm(machine, errors, axis, loss_mm=settings.loss_mm, most=MOST_ROWS), settings)
            for axis in range(3)
        ]
        return one_dimensional_terms(machine, errors, nodes, [(axis, axis) for axis in range(3)])

    def build(
        self, machine: Machine, settings: CompSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> CompTables:
        """Return the trims, rounded as they are written; both directions alike."""
        found = {}
        for axis in range(3):
            term = next(item for item in basis if item.name == one_dimensional_name(axis, axis))
            trims = values[term.name]
            found[axis] = _as_written(settings, term.nodes_mm, trims, trims)
        return CompTables(found)

    def reversal_in_tables(self, settings: CompSettings, reversal: ReversalCurves) -> ReversalCurves:
        """Return the reversal of each axis along itself; a displacement across has no place in a COMP_FILE."""
        return replace(reversal, curves={key: part for key, part in reversal.curves.items() if key[0] == key[1]})

    def with_reversal(
        self, machine: Machine, settings: CompSettings, tables: CompTables, reversal: ReversalCurves
    ) -> CompTables:
        """Return the tables with -B/2 in the forward and +B/2 in the reverse column (B: reversal value)."""
        found = dict(tables.tables)
        for (axis, _), curve in reversal.curves.items():
            if np.max(np.abs(curve.value)) < WORTH_MM:
                continue
            table = found[axis]
            low, high = machine.axes[axis].range_mm
            inside = curve.position_mm[(curve.position_mm >= low) & (curve.position_mm <= high)]
            nodes = np.union1d(table.nominal_mm, _written_mm(inside, settings))
            nodes = table.nominal_mm if len(nodes) > MOST_ROWS else nodes
            half = 0.5 * curve.at(nodes)
            forward = np.interp(nodes, table.nominal_mm, table.forward_mm) - half
            reverse = np.interp(nodes, table.nominal_mm, table.reverse_mm) + half
            found[axis] = _as_written(settings, nodes, forward, reverse)
        return CompTables(found)

    def backlash_parameters(
        self, machine: Machine, settings: CompSettings, reversal: ReversalCurves
    ) -> list[dict[str, str]]:
        """Return none: a joint with a COMP_FILE ignores BACKLASH, and what is left lies across the axis."""
        return []

    def context(self, machine: Machine, settings: CompSettings, tables: CompTables) -> dict[str, Any]:
        """Return rows by axis letter, INI lines, and what to know of small reversal steps."""
        return {
            "sign_statement": sign_statement(settings.comp_file_type, settings.machine_units, tables.tables),
            "parameters": parameters(
                settings.comp_file_type, settings.machine_units, settings.servo_period_us, tables.tables, FILES
            ),
            "warnings": dead_zone_warnings(settings.servo_period_us, settings.max_acceleration_mm_s2, tables.tables),
            "comp_file_type": settings.comp_file_type,
            "unit": settings.machine_units,
            "tables": [
                {"letter": AXES[axis], "joint": axis, "file": FILES[axis], "rows": _rows(settings, table)}
                for axis, table in sorted(tables.tables.items())
            ],
        }

    def parse(self, machine: Machine, settings: CompSettings, files: Sequence[SourceFile]) -> CompTables:
        """Read one file per joint; its name says which: ``joint0`` or the letter, as in ``joint0-x.comp``."""
        found: dict[int, CompTable] = {}
        for source in files:
            axis = _axis_of(source)
            if axis in found:
                raise source.fail(f"is a second file for {AXES[axis]}; give one per joint")
            found[axis] = parse_comp(source, settings.comp_file_type, settings.mm_per_unit)
        if not found:
            raise InputError(f"no COMP_FILE was given; {', '.join(FILES)} are due")
        return CompTables(found)

    def parse_foreign(
        self, machine: Machine, settings: CompSettings, files: Sequence[SourceFile]
    ) -> tuple[CompTables, list[str]]:
        """Read COMP_FILEs under any name: ``comp_files`` says whose they are, else a letter at the end of the name."""
        found: dict[int, CompTable] = {}
        remarks = []
        for source in files:
            axis = _axis_of_foreign(source, settings.comp_files)
            if axis in found:
                raise source.fail(f"is a second file for {AXES[axis]}; give one per joint")
            found[axis] = parse_comp(source, settings.comp_file_type, settings.mm_per_unit)
            remarks.append(f"{source.path.name} was taken for {AXES[axis]}, type {settings.comp_file_type}")
        return CompTables(found), remarks

    def emulate(self, machine: Machine, settings: CompSettings, tables: CompTables, points: Points) -> FloatArray:
        """Return the trims at the commanded positions in the direction of the last travel; its mean if unknown.

        This is the settled correction; what the control's filter does with small steps from standstill is
        :func:`compgen.controllers.linuxcnc.comp_table.standstill_outcome`.
        """
        added = np.zeros((len(points), 3))
        for axis, table in tables.tables.items():
            position = points.position_mm[:, axis]
            forward, reverse = table.at(position, 1), table.at(position, -1)
            travel = np.zeros(len(points)) if points.approach is None else np.sign(points.approach[:, axis])
            added[:, axis] = np.select([travel > 0, travel < 0], [forward, reverse], 0.5 * (forward + reverse))
        return added

    def violations(self, machine: Machine, settings: CompSettings, tables: CompTables) -> list[str]:
        """Return joints without a table, and travel that a table leaves out: that of a file in another unit among them."""
        found = [f"there is no COMP_FILE for {AXES[axis]}" for axis in range(3) if axis not in tables.tables]
        for axis, table in sorted(tables.tables.items()):
            first, last = table.nominal_mm[0], table.nominal_mm[-1]
            left_out = coverage_violations(machine, axis, first, last, f"the COMP_FILE of {AXES[axis]}")
            other = "inch" if settings.machine_units == "mm" else "mm"
            share = MM_PER_UNIT[other] / settings.mm_per_unit
            if left_out and not coverage_violations(machine, axis, first * share, last * share, ""):
                left_out = [f"{text}; in {other} it would cover it: is machine_units right?" for text in left_out]
            found += left_out
        return found

    def resolution_mm(self, settings: CompSettings) -> float:
        """Half of the last decimal, and what float32 takes away."""
        return _RESOLUTION_MM

    def table_nodes_mm(self, machine: Machine, settings: CompSettings, tables: CompTables) -> tuple[FloatArray, ...]:
        """Return the nominal positions of each joint."""
        return nodes_by_axis((axis, table.nominal_mm) for axis, table in tables.tables.items())

    def usage(self, machine: Machine, settings: CompSettings, tables: CompTables) -> list[Usage]:
        """Return the rows of each joint against the 256 that LinuxCNC takes."""
        return [
            Usage(f"rows of {AXES[axis]}", len(table.nominal_mm), MOST_ROWS, "rows")
            for axis, table in sorted(tables.tables.items())
        ]


def _positive3(value: Any) -> tuple[float, float, float]:
    x, y, z = tomlio.vector3(value)
    if min(x, y, z) <= 0:
        raise ValueError("three numbers above zero, for X, Y and Z, are expected")
    return x, y, z


def _written(values: FloatArray, digits: int = POSITION_DIGITS) -> FloatArray:
    return np.array([float(fixed(value, digits)) for value in values.tolist()])


def _written_mm(position_mm: FloatArray, settings: CompSettings) -> FloatArray:
    """Positions as the file has them, in mm: two that are equal in the file are equal here, to the last bit."""
    return _written(position_mm / settings.mm_per_unit) * settings.mm_per_unit


def _as_written(
    settings: CompSettings, nominal_mm: FloatArray, forward_mm: FloatArray, reverse_mm: FloatArray
) -> CompTable:
    """Return the table of these positions and trims as it is read back from its text."""
    unit = settings.mm_per_unit
    table = CompTable(nominal_mm / unit, forward_mm / unit, reverse_mm / unit, unit)
    nominal, forward, reverse = (_written(column) for column in np.array(_rows(settings, table)).T)
    if settings.comp_file_type == 0:
        forward, reverse = nominal - forward, nominal - reverse
    return CompTable(nominal, forward, reverse, unit)


def _rows(settings: CompSettings, table: CompTable) -> list[list[float]]:
    """Rows of the file, in machine units: nominal, then trims (type 1) or actual positions (type 0)."""
    forward, reverse = table.forward, table.reverse
    if settings.comp_file_type == 0:
        forward, reverse = table.nominal - forward, table.nominal - reverse
    return [list(row) for row in zip(table.nominal.tolist(), forward.tolist(), reverse.tolist(), strict=True)]


def _comp_files(section: tomlio.Section) -> tuple[str | None, str | None, str | None]:
    """``comp_files = { X = "screw.dat" }``: file names, without a folder."""
    part = section.section("comp_files", required=False)
    x, y, z = (part.take(letter, tomlio.text, None) for letter in AXES)
    part.finish()
    return x, y, z


def _axis_of_foreign(source: SourceFile, comp_files: tuple[str | None, ...]) -> int:
    """The axis of a file: as the machine file states it, by our own rule, or by the last letter of its name."""
    if source.path.name in comp_files:
        return comp_files.index(source.path.name)
    last = _LAST_LETTER.search(source.path.stem)
    if last and not _AXIS_OF_NAME.search(source.path.name):
        return AXES.index(last.group(1).upper())
    try:
        return _axis_of(source)
    except InputError:
        message = (
            "the name does not say which joint it belongs to; state it in the machine file: [controllers.linuxcnc-comp] "
            f'comp_files = {{ X = "{source.path.name}" }}'
        )
        raise source.fail(message) from None


def _axis_of(source: SourceFile) -> int:
    matches = list(_AXIS_OF_NAME.finditer(source.path.name))
    if not matches:
        raise source.fail(f"the name does not say which joint it belongs to; a name such as {FILES[0]!r} is due")
    joint, letter = matches[-1].groups()
    return int(joint) if joint else AXES.index(letter.upper())
