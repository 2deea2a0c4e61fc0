"""``pmac``: leadscrew, cross-axis, two-dimensional and backlash tables of PMAC and Turbo PMAC.

Source: PMAC User Manual p. 79-83, PMAC 2 Software Reference p. 207-211, Turbo PMAC Software Reference p. 301-306. The
tables add to the commanded position of the target; they are zero at the motor's zero and repeat beyond their span.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controllers.pmac.basis import Ring, pmac_basis, ring_of, tables_from
from compgen.controllers.pmac.notes import pmac_notes, table_context
from compgen.controllers.pmac.settings import PmacSettings, read_pmac_settings
from compgen.controllers.pmac.tables import PER_COUNT, Backlash, IntArray, Line, PmacTables, Sheet
from compgen.controllers.pmac.text import parse_foreign_pmac, parse_pmac
from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.points import Points
from compgen.core.reversal import WORTH_MM, ReversalCurves
from compgen.errors import CompgenWarning, InputError

_MOST_PER_TARGET = 6
_SPAN_SLACK = 1e-6
#: Spacings of a pitch table are divided into at most so many parts to hold a reversal.
_MOST_PARTS = 64


class Pmac(Controller[PmacSettings, PmacTables]):
    """PMAC and Turbo PMAC ``DEFINE COMP``."""

    name = "pmac"
    anchored = True
    bidirectional = True

    def read_settings(self, machine: Machine) -> PmacSettings:
        """Check the settings; ``counts_per_mm`` is mandatory."""
        return read_pmac_settings(machine, self.name)

    def basis(self, machine: Machine, settings: PmacSettings, errors: ErrorTable) -> list[Term]:
        """Return pitch of every axis, functions of other axes, and products if tables of two dimensions are wanted."""
        return pmac_basis(machine, settings, errors)

    def build(
        self, machine: Machine, settings: PmacSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> PmacTables:
        """Return the tables in whole 1/16 counts."""
        return PmacTables(tuple(tables_from(machine, settings, basis, values)))

    def reversal_in_tables(self, settings: PmacSettings, reversal: ReversalCurves) -> ReversalCurves:
        """Only the reversal of an axis along itself goes into tables."""
        return ReversalCurves({key: curve for key, curve in reversal.curves.items() if key[0] == key[1]})

    def with_reversal(
        self, machine: Machine, settings: PmacSettings, tables: PmacTables, reversal: ReversalCurves
    ) -> PmacTables:
        """Return the tables with Ixx86 and, where the reversal varies, a backlash table and its half in the pitch table.

        With the reversal B the control takes -B off after negative travel, so both directions stand at +B/2 of the
        mean; -(B - B at zero)/2 goes into the pitch table, the rest is a constant. B, both halves and "positive" are those
        of the motor: a motor that counts against its axis sees the same B in its counts.
        """
        lines, backlash, constants = list(tables.tables), [], {}
        for (axis, _), curve in sorted(reversal.curves.items()):
            if np.max(np.abs(curve.value)) < WORTH_MM:
                continue
            motor = settings.motors[axis]
            place = next(k for k, t in enumerate(lines) if isinstance(t, Line) and t.motor == motor)
            lines[place], table, constants[motor] = _with_backlash(machine, settings, axis, lines[place], curve)
            backlash += [table] if table is not None else []
        backlash.sort(key=lambda table: -table.motor)
        return replace(tables, tables=tuple(lines), backlash=tuple(backlash), constants=constants)

    def context(self, machine: Machine, settings: PmacSettings, tables: PmacTables) -> dict[str, Any]:
        """Return the tables with their entries, the sign with a worked number, and what must be set."""
        letters = {motor: AXES[axis] for axis, motor in enumerate(settings.motors)}
        return {
            **pmac_notes(machine, settings, tables),
            "tables": [table_context(table, letters) for table in tables.tables],
            "backlash": [
                {
                    "motor": t.motor,
                    "length": t.length,
                    "letter": letters.get(t.motor, "?"),
                    "entries": t.entries.tolist(),
                }
                for t in tables.backlash
            ],
            "constants": sorted(tables.constants.items()),
            "table_count": len(tables.tables) + len(tables.backlash),
        }

    def parse(self, machine: Machine, settings: PmacSettings, files: Sequence[SourceFile]) -> PmacTables:
        """Read download files; motors that are no axis of the machine file cannot be sources or targets."""
        if not files:
            raise InputError("no file was given; comp.pmc is one")
        tables = parse_pmac(files)
        for table in (*tables.tables, *tables.backlash):
            unknown = sorted(_motors(table) - set(settings.motors))
            if unknown:
                raise files[0].fail(
                    f"the table of motor {table.motor} uses motor {unknown[0]}, which is no axis of the machine file "
                    f"(motors {settings.motors})"
                )
        return tables

    def parse_foreign(
        self, machine: Machine, settings: PmacSettings, files: Sequence[SourceFile]
    ) -> tuple[PmacTables, list[str]]:
        """Read a download file or backup of a real control; tables of other motors are kept apart and named."""
        tables, remarks = parse_foreign_pmac(files)
        known = set(settings.motors)
        apart = [t for t in (*tables.tables, *tables.backlash) if not _motors(t) <= known]
        kept = replace(
            tables,
            tables=tuple(t for t in tables.tables if _motors(t) <= known),
            backlash=tuple(t for t in tables.backlash if _motors(t) <= known),
            constants={motor: value for motor, value in tables.constants.items() if motor in known},
        )
        if apart:
            named = "; ".join(f"motor {t.motor} (uses {_listed(_motors(t))})" for t in apart)
            remarks.append(f"tables of motors that are no axis of the machine file, kept apart: {named}")
        if not kept.tables and not kept.backlash:
            raise files[0].fail(f"holds no table of the motors {_listed(known)}; {remarks[-1]}")
        return kept, remarks

    def emulate(self, machine: Machine, settings: PmacSettings, tables: PmacTables, points: Points) -> FloatArray:
        """Return the sum of all tables of each target, and minus the backlash after negative travel of a motor.

        Where the last direction of travel is unknown half of the backlash is taken off, with a CompgenWarning.
        """
        position = np.asarray(points.position_mm, dtype=np.float64)
        counts = settings.counts(position)
        total = {motor: np.zeros(len(position)) for motor in settings.motors}
        if tables.enabled is not False:
            for table in tables.tables:
                total[table.target] += table.at(counts)
        for motor in settings.motors:
            total[motor] -= self._backlash(settings, tables, motor, counts, points)
        scale = PER_COUNT * np.array(settings.counts_per_mm)
        return np.column_stack([total[motor] for motor in settings.motors]) / scale + 0.0

    @staticmethod
    def _backlash(
        settings: PmacSettings, tables: PmacTables, motor: int, counts: Mapping[int, FloatArray], points: Points
    ) -> FloatArray:
        size = np.full(len(points), float(tables.constants.get(motor, 0)))
        own = [table for table in tables.backlash if table.motor == motor and tables.enabled is not False]
        for table in own:
            size += table.at(counts)
        if not np.any(size):
            return size
        axis = settings.motors.index(motor)
        travel = np.zeros(len(points)) if points.approach is None else points.approach[:, axis]
        if np.any(travel == 0):
            message = (
                f"motor {motor} has backlash compensation, and some points do not say from where they were approached: "
                "half of it is taken off there; give approach_x, approach_y, approach_z"
            )
            warnings.warn(message, CompgenWarning, stacklevel=3)
        return np.asarray(size * 0.5 * (1.0 - np.sign(travel * settings.counts_per_mm[axis])))

    def violations(self, machine: Machine, settings: PmacSettings, tables: PmacTables) -> list[str]:
        """Return tables out of order, too long, shorter than the travel, or not enabled."""
        found = [] if tables.enabled else ["I51 is not 1: the tables do not act"]
        for kind, group in (("COMP", tables.tables), ("BLCOMP", tables.backlash)):
            owners = [table.motor for table in group]
            if owners != sorted(owners, reverse=True):
                found.append(
                    f"{kind} tables are defined in the order {owners}; from the highest motor down is due (ERR003)"
                )
            if owners and max(owners) > settings.motors_available:
                found.append(
                    f"motor {max(owners)} has a {kind} table; the control has {settings.motors_available} motors"
                )
        for table in tables.tables:
            found += self._table_violations(machine, settings, table)
        return found

    @staticmethod
    def _table_violations(machine: Machine, settings: PmacSettings, table: Line | Sheet) -> list[str]:
        found = []
        if (size := _entries(table)) > settings.max_entries:
            found.append(f"the table of motor {table.motor} has {size} entries, max_entries is {settings.max_entries}")
        for motor, span in _spans(table):
            axis = settings.motors.index(motor)
            low, high = machine.axes[axis].range_mm
            ends = sorted(settings.counts_per_mm[axis] * (end - settings.home_mm[axis]) for end in (low, high))
            needed = max(ends[1], 0.0) - min(ends[0], 0.0)
            if needed > span * (1.0 + _SPAN_SLACK):
                found.append(
                    f"the table of motor {table.motor} spans {span} counts of motor {motor}, the travel needs "
                    f"{needed:g}: positions roll over within the travel"
                )
        return found + _end_violations(table)

    def usage(self, machine: Machine, settings: PmacSettings, tables: PmacTables) -> list[Usage]:
        """Return the motors that own a table against those there are, and the longest table."""
        longest = max((_entries(table) for table in tables.tables), default=0)
        return [
            Usage("motors with a COMP table", len(tables.tables), settings.motors_available, "tables"),
            Usage("entries of one table", longest, settings.max_entries, "entries", stated=False),
        ]

    def anchor_mm(self, machine: Machine, settings: PmacSettings) -> FloatArray:
        """Return the motors' zero, where every table is zero."""
        return np.array(settings.home_mm)

    def table_nodes_mm(self, machine: Machine, settings: PmacSettings, tables: PmacTables) -> tuple[FloatArray, ...]:
        """Return the entries' positions over the travel and one beyond, by source."""
        found = []
        for table in (*tables.tables, *tables.backlash):
            for motor, step in _steps(table):
                axis = settings.motors.index(motor)
                ring = ring_of(machine, settings, axis, 1.0)
                step_mm = step / abs(settings.counts_per_mm[axis])
                low, high = machine.axes[axis].range_mm
                first = np.floor((low - settings.home_mm[axis]) / step_mm)
                last = np.ceil((high - settings.home_mm[axis]) / step_mm)
                found.append((ring.axis, settings.home_mm[axis] + step_mm * np.arange(first, last + 1)))
        return nodes_by_axis(found)

    def resolution_mm(self, settings: PmacSettings) -> float:
        """Half of 1/16 count for every table that may act on one axis."""
        most = _MOST_PER_TARGET if settings.two_dimensional else 3
        return most * 0.5 / (PER_COUNT * float(np.min(np.abs(settings.counts_per_mm))))


def _motors(table: Line | Sheet | Backlash) -> set[int]:
    if isinstance(table, Backlash):
        return {table.motor}
    sources = {table.source} if isinstance(table, Line) else {table.row, table.column}
    return sources | {table.target}


def _listed(motors: set[int]) -> str:
    return ", ".join(f"#{motor}" for motor in sorted(motors))


def _entries(table: Line | Sheet) -> int:
    return len(table.entries) if isinstance(table, Line) else int(table.values.size) - 1


def _spans(table: Line | Sheet) -> list[tuple[int, int]]:
    if isinstance(table, Line):
        return [(table.source, table.length)]
    return [(table.row, table.row_span), (table.column, table.column_span)]


def _steps(table: Line | Sheet | Backlash) -> list[tuple[int, float]]:
    """Sources and the distance of their nodes in counts."""
    if isinstance(table, Sheet):
        rows, columns = (size - 1 for size in table.values.shape)
        return [(table.row, table.row_span / columns), (table.column, table.column_span / rows)]
    motor = table.motor if isinstance(table, Backlash) else table.source
    return [(motor, table.length / len(table.entries))]


def _end_violations(table: Line | Sheet) -> list[str]:
    """What happens at the roll-over: the last entry is the value at zero, far edges are the zero edges."""
    if isinstance(table, Line):
        if table.entries[-1] == 0:
            return []
        return [f"the table of motor {table.motor} ends with {table.entries[-1]}: the value jumps at zero, 0 is due"]
    values = table.values
    if np.array_equal(values[-1], values[0]) and np.array_equal(values[:, -1], values[:, 0]):
        return []
    return [f"the far edges of the table of motor {table.motor} are not its zero edges: the value jumps at zero"]


def _with_backlash(
    machine: Machine, settings: PmacSettings, axis: int, table: Line | Sheet, curve: Curve
) -> tuple[Line, Backlash | None, int]:
    """Pitch table with its part of the reversal, backlash table (None: constant) and Ixx86, in 1/16 count."""
    assert isinstance(table, Line)
    scale, home = abs(settings.counts_per_mm[axis]), settings.home_mm[axis]
    at_home = float(curve.at(np.array([home]))[0])
    constant = round(-PER_COUNT * scale * at_home)
    if len(curve.position_mm) == 1:
        return table, None, constant
    ring = _ring_for(machine, settings, axis, table, curve)
    counts = {motor: np.zeros(ring.size) for motor in settings.motors}
    counts[table.source] = settings.counts_per_mm[axis] * (ring.positions_mm(settings) - home)
    pitch = np.rint(table.at(counts)).astype(np.int64)
    varying = curve.at(ring.positions_mm(settings)) - at_home
    varying[0] = 0.0
    # In the motor's own counts a reversal B is |counts per mm| B, whichever way the motor counts: where it counts
    # against its axis, both the position and the direction of travel change their sign.
    size = np.rint(-PER_COUNT * scale * varying).astype(np.int64)
    half = np.rint(-0.5 * PER_COUNT * scale * varying).astype(np.int64)
    entries: IntArray = np.append(pitch[1:] + half[1:], 0)
    length = ring.step * ring.size
    own = Backlash(settings.motors[axis], length, np.append(size[1:], 0))
    return replace(table, entries=entries, length=length), own if np.any(size) else None, constant


def _ring_for(machine: Machine, settings: PmacSettings, axis: int, table: Line, curve: Curve) -> Ring:
    """Return the ring of a pitch table, its spacing divided as far as the reversal needs it."""
    scale, step = abs(settings.counts_per_mm[axis]), table.length // len(table.entries)
    where = np.unique(np.concatenate([np.array(machine.axes[axis].range_mm), curve.position_mm]))
    where = np.clip(where, *machine.axes[axis].range_mm)
    rings = []
    for part in (part for part in range(1, _MOST_PARTS + 1) if step % part == 0):
        ring = ring_of(machine, settings, axis, step / part / scale)
        nodes = ring.nodes_mm(settings)
        miss = float(np.max(np.abs(np.interp(where, nodes, curve.at(nodes)) - curve.at(where))))
        rings.append((miss, ring))
        if miss <= WORTH_MM:
            break
    return min(rings, key=lambda pair: pair[0])[1]
