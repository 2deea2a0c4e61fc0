"""HEIDENHAIN compensation-value tables (``heidenhain-com``): a .COM file per axis, assigned by the .CMA file."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from itertools import pairwise
from typing import Any

import numpy as np

from compgen.controls.heidenhain_text import (
    NUMBER_COLUMN,
    ComLayout,
    TextTable,
    default_layout,
    read_table,
    template_layout,
)
from compgen.controls.shared.base import SourceFile, Term, Usage, parameter_row
from compgen.controls.shared.grids import (
    EquidistantGrid,
    curve_nodes_mm,
    fewest_nodes,
    loss_setting,
    nearly_best,
    worth_mm,
)
from compgen.controls.shared.tables import Table1D, TableController, along_itself
from compgen.controls.shared.terms import one_dimensional_name, one_dimensional_terms
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, ErrorTable, ReversalCurves
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.data.toml_files import (
    accepts,
    axis_setting,
    choice,
    file_setting,
    setting,
    whole,
    word_for,
)
from compgen.errors import CompgenWarning, InputError

# Settings ``[controllers.heidenhain-com]``: generation, sign, node positions, limits, tables saved on the control.


POSITION, BACKLASH, ACTIVE = "AXISPOS", "BACKLASH", "ACTIVE"
#: Spacings on the older controls are 2^n times this (TNC 407 technical manual, p. 153).
SPACING_UNIT_MM = Decimal("0.0001")
SMALLEST_EXPONENT, LARGEST_EXPONENT = 6, 23
#: Entries of one .COM file (TNC 407 technical manual, p. 622, error 3 of module 9095).
MOST_ENTRIES = 256


@accepts({"type": "string", "pattern": "^[A-Za-z0-9_]{1,12}$"})
def name_on_control(value: Any) -> str:
    """The name of an axis, which is also the name of its column."""
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9_]{1,12}", value, re.ASCII):
        raise ValueError("expected a name of letters and digits")
    return value


def check_names(section: toml_files.Section, names: tuple[str, str, str]) -> None:
    """Raise InputError unless the names of the axes differ from each other and from the other columns."""
    if len({*names, "NR", POSITION, BACKLASH, ACTIVE}) < 7:
        raise section.fail(
            "axis_names", f"{', '.join(names)}: expected three different names, none of them the name of another column"
        )


@accepts({"type": "number", "exclusiveMinimum": -(10**7), "exclusiveMaximum": 10**7})
def _position(value: Any) -> Decimal:
    exact = Decimal(repr(toml_files.number(value)))
    if exact % SPACING_UNIT_MM or abs(exact) >= 10**7:
        raise ValueError(f"expected a position that is a multiple of {SPACING_UNIT_MM} mm")
    return exact


@dataclass(frozen=True, kw_only=True)
class HeidenhainSettings:
    """Settings ``[controllers.heidenhain-com]``.

    Parameters
    ----------
    older : True for the older controls (datum and power-of-two spacing), False for free positions.
    subtracts : True if the entries are errors, which the control subtracts; False if it adds them.
    datum_mm, exponent : first node and n of the spacing 2^n x 0.0001 mm per axis; None: chosen automatically.
    com, cma : layouts of tables saved on the control, None: the default layout.
    keep_name : whether to keep the name in the first line of such a table, or to write the name of the file.
    """

    com: ComLayout | None = file_setting(
        lambda path: template_layout(path, "COM"),
        key="template_from",
        meaning="an empty .COM table saved on the control, to be filled in",
    )
    cma: ComLayout | None = file_setting(
        lambda path: template_layout(path, "CMA"),
        key="cma_template_from",
        meaning="an empty .CMA table saved on the control, to be filled in",
    )
    older: bool = setting(
        word_for({"free": False, "power-of-two": True}),
        key="generation",
        stated="free",
        meaning='node positions: "free" (newer controls), or "power-of-two", at datum + k 2^n x 0.0001 mm (older ones)',
    )
    subtracts: bool = setting(
        word_for({"error": True, "correction": False}),
        key="sign",
        stated="error",
        meaning='what the entries are: "error" (the control subtracts them) or "correction" (it adds them)',
    )
    axis_names: tuple[str, str, str] = axis_setting(
        name_on_control, AXES, meaning="names of X, Y, Z in CfgAxes/axisList, also the names of the columns"
    )
    decimals: int = setting(whole(3, 6), 4, meaning="decimals of the entries in mm")
    loss_mm: float = loss_setting()
    max_points: int = setting(whole(4, 100_000), MOST_ENTRIES, meaning="largest number of entries in one .COM file")
    max_tables: int | None = setting(
        whole(1, 1000), None, meaning="largest number of .COM files on the control; checked if set"
    )
    max_total_points: int | None = setting(
        whole(12, 1_000_000), None, meaning="largest number of entries in all .COM files together; checked if set"
    )
    backlash: str = setting(
        choice("empty", "absolute", "difference"),
        "empty",
        key="backlash_column",
        meaning='column BACKLASH: "empty" (zeros are written), "absolute" (entries for negative travel) or '
        '"difference" (negative minus positive travel)',
    )
    datum_mm: tuple[Decimal | None, Decimal | None, Decimal | None] = axis_setting(
        _position, meaning="older controls: first node of each axis"
    )
    exponent: tuple[int | None, int | None, int | None] = axis_setting(
        whole(SMALLEST_EXPONENT, LARGEST_EXPONENT),
        key="spacing_exponent",
        meaning="older controls: n of the spacing 2^n x 0.0001 mm of each axis",
    )
    keep_name: bool = setting(
        word_for({"keep": True, "file": False}),
        key="begin_name",
        stated="keep",
        meaning='name in the first line: "keep" that of the saved table, or write that of the "file"',
    )

    @property
    def sign(self) -> int:
        """Sign with which the control adds an entry to the command."""
        return -1 if self.subtracts else 1

    @property
    def has_positions(self) -> bool:
        """Whether the tables have a position column."""
        return self.com is None or POSITION in self.com.names

    def com_layout(self, axis: int) -> ComLayout:
        """Layout of the .COM file of an input axis."""
        name = f"AXIS_{AXES[axis]}"
        if self.com is not None:
            return self._named(self.com, name)
        columns = [("NR", 5), (POSITION, 13), (BACKLASH, 11), *((item, 11) for item in self.axis_names)]
        return default_layout(name, "COM", _wide(columns))

    def cma_layout(self) -> ComLayout:
        """Layout of the .CMA file."""
        if self.cma is not None:
            return self._named(self.cma, "CONFIG")
        return default_layout(
            "CONFIG", "CMA", _wide([("NR", 5), (ACTIVE, 9), *((item, 13) for item in self.axis_names)])
        )

    def _named(self, layout: ComLayout, name: str) -> ComLayout:
        if self.keep_name:
            return layout
        first = re.sub(r"^(\s*BEGIN\s+)[^\s.]+", rf"\g<1>{name}", layout.before[0])
        return ComLayout((first, *layout.before[1:]), layout.columns, layout.after, layout.crlf, layout.source)


def _wide(columns: list[tuple[str, int]]) -> list[tuple[str, int]]:
    return [(name, max(width, len(name) + 2)) for name, width in columns]


def _check_templates(section: toml_files.Section, settings: HeidenhainSettings) -> None:
    """Check that the saved tables have the required columns; errors point at their header line."""
    for layout, expected in ((settings.com, settings.axis_names), (settings.cma, (ACTIVE, *settings.axis_names))):
        missing = [] if layout is None else [name for name in expected if name not in layout.names]
        if layout is not None and missing:
            raise layout.fail(
                f"the table has no column {', '.join(missing)} (it has {', '.join(layout.names)}); columns are named "
                "like the axes of the control, see axis_names"
            )
    if settings.com is None:
        return
    if settings.backlash != "empty" and BACKLASH not in settings.com.names:
        raise settings.com.fail(
            'the table has no column BACKLASH; set backlash_column = "empty", or save a table with this column'
        )
    if POSITION not in settings.com.names:
        if not settings.older:
            raise settings.com.fail(
                'the table has no column AXISPOS; if it is from an older control, set generation = "power-of-two"'
            )
        if None in settings.datum_mm or None in settings.exponent:
            raise section.fail(
                "datum_mm",
                "and spacing_exponent are required for X, Y and Z: the saved table has no column AXISPOS, so only the "
                "datum and the spacing 2^n x 0.0001 mm in its head define the positions",
            )


# Node positions of HEIDENHAIN tables: free positions where the curves need them, or datum and power-of-two spacing.
#
# Power of two: TNC 407 technical manual, p. 153. For a requested spacing of 7 mm the largest spacing 2^n x 0.0001 mm
# that is not wider is 6.5536 mm (n = 16).


#: Candidate nodes between those of the curves: the effect of an angle with its own travel as lever is curved there.
MOST_CANDIDATES, MOST_PARTS = 200, 4
#: Tables with free positions extend this far beyond both ends with the end value: behaviour outside does not matter.
MARGIN_MM = Decimal(10)
#: Adjacent entries of the oldest tables may differ by at most this fraction of their distance (TNC 407 manual, p. 156).
GRADIENT_SHARE = 1.0 / 64.0
QUANTUM_MM = Decimal("0.0001")


def spacing_mm(exponent: int) -> Decimal:
    """Spacing 2^n x 0.0001 mm.

    >>> spacing_mm(16)
    Decimal('6.5536')
    """
    return SPACING_UNIT_MM * Decimal(2) ** exponent


def intervals(travel_mm: float, spacing: Decimal) -> int:
    """Return how many intervals cover a travel; the number of nodes is one more.

    >>> intervals(500.0, spacing_mm(16)), intervals(800.0, spacing_mm(16))
    (77, 123)
    """
    return int((Decimal(repr(travel_mm)) / spacing).to_integral_value(rounding=ROUND_CEILING))


# Compensation-value tables (.COM) and their assignment (.CMA): contents, reader, limits.
#
# [axis of the column in the .COM] = F([axis of the column in the .CMA that names this .COM]) (MANUALplus 620 technical
# manual, p. 718). Several tables may correct one axis; they add up.


#: Changes to names and extensions by an export or by the serial transfer of older controls.
PREFIXES = ("NOT-ACCEPTED-", "PREVIOUS-")
EXTENSIONS = {"COM": "COM", "V": "COM", "CMA": "CMA", "S": "CMA"}


@dataclass(frozen=True)
class ComTable:
    """One .COM file: entries in mm, exactly as in the file.

    Parameters
    ----------
    positions : positions of the input axis, ascending.
    columns : entries by corrected axis 0..2.
    backlash : entries of the column BACKLASH, None if it is blank or missing.
    """

    positions: tuple[Decimal, ...]
    columns: Mapping[int, tuple[Decimal, ...]]
    backlash: tuple[Decimal, ...] | None = None

    @property
    def nodes_mm(self) -> FloatArray:
        """Positions, shape (n,), mm."""
        return _floats(self.positions)

    def column(self, axis: int, values: Sequence[Decimal], output: int, value_mm: float) -> Table1D:
        """Entries over the input axis ``axis`` that move ``output``: linear between nodes, end values held outside."""
        return Table1D(axis, output, self.nodes_mm, _floats(values), value_mm=value_mm)

    @property
    def steepest(self) -> float:
        """Largest change of an entry per travel, mm/mm."""
        steps = np.diff(self.nodes_mm)
        slopes = [np.abs(np.diff(_floats(values))) / steps for values in self.columns.values()]
        return float(max((slope.max(initial=0.0) for slope in slopes), default=0.0))


@dataclass(frozen=True)
class ComTables:
    """The active tables by input axis 0..2."""

    tables: Mapping[int, ComTable]

    @property
    def total_points(self) -> int:
        """Number of entries in all tables."""
        return sum(len(table.positions) for table in self.tables.values())


def file_stem(name: str) -> str:
    """Return the name of a file in capitals, without extension and without the prefix added by an export.

    >>> file_stem("NOT-ACCEPTED-axis_y.com")
    'AXIS_Y'
    """
    for prefix in PREFIXES:
        name = name.removeprefix(prefix)
    return name.rsplit(".", 1)[0].upper()


def _kind(file: SourceFile, table: TextTable) -> str:
    """COM or CMA, from the first line of the file, else from the file extension."""
    found = EXTENSIONS.get(table.kind) or EXTENSIONS.get(file.path.suffix[1:].upper())
    if found is None:
        raise file.fail("is neither a .COM nor a .CMA table, judging by its first line and its name", 1)
    return found


# Data for the templates of HEIDENHAIN tables: cells in their fields, parameters to set, worked examples, warnings.


#: Totals reported for older controls; no document confirms them.
USUAL_TOTAL, USUAL_TABLES = 640, 10
POSITION_DECIMALS = 4


def _fixed(value: Decimal, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def _exponent(step: Decimal) -> int | None:
    return next((n for n in range(SMALLEST_EXPONENT, LARGEST_EXPONENT + 1) if spacing_mm(n) == step), None)


def _largest(tables: ComTables) -> tuple[int, int, int]:
    """Input axis, corrected axis and row of the largest entry."""
    sizes = {
        (axis, output): np.abs(_floats(values))
        for axis, table in tables.tables.items()
        for output, values in table.columns.items()
    }
    axis, output = max(sizes, key=lambda key: float(np.max(sizes[key])))
    return axis, output, int(np.argmax(sizes[axis, output]))


# HEIDENHAIN compensation-value tables: .COM files over each axis and the .CMA file that assigns them.
#
# Sources: TNC 407/415/425 technical manual (01.98), p. 151-156, 622; MANUALplus 620 technical manual, p. 708, 716, 718;
# iTNC 530 HSCI technical manual (07.2013), p. 647-686. Points that none of them settles are in
# ``templates/heidenhain-com/format.toml``.


class HeidenhainCom(TableController[HeidenhainSettings, ComTables]):
    """Tables of each axis over each axis: positioning, straightness, squareness; no products, no fixed lever arm."""

    name = "heidenhain-com"
    settings_class = HeidenhainSettings
    bidirectional = True
    sample_setting = "template_from"

    @classmethod
    def read_settings(cls, machine: Machine) -> HeidenhainSettings:
        """Read ``[controllers.heidenhain-com]``; every key has a default."""
        section = machine.controller_settings(cls.name)
        settings = toml_files.read_settings(HeidenhainSettings, section)
        check_names(section, settings.axis_names)
        if settings.older and settings.backlash != "empty":
            raise section.fail(
                "backlash_column", 'only newer controls are known to have a column BACKLASH (generation = "free")'
            )
        for key, values in (("datum_mm", settings.datum_mm), ("spacing_exponent", settings.exponent)):
            if not settings.older and any(value is not None for value in values):
                raise section.fail(
                    key,
                    'applies only to generation = "power-of-two"; tables with free positions have no datum and no '
                    "spacing",
                )
        _check_templates(section, settings)
        return settings

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return nine terms: each axis as a function of each axis; terms over one axis share their nodes."""
        nodes = [self._com_nodes_mm(errors, axis) for axis in range(3)]
        pairs = [(output, axis) for axis in range(3) for output in range(3)]
        return one_dimensional_terms(self.machine, errors, nodes, pairs)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> ComTables:
        """Round the entries, with the sign of the control, and extend the end values beyond the ends."""
        terms = {term.name: term for term in basis}
        tables = {}
        for axis in range(3):
            nodes_mm = terms[one_dimensional_name(axis, axis)].nodes_mm
            exact = [Decimal(repr(float(node))).quantize(QUANTUM_MM) for node in nodes_mm]
            # at least one more node beyond each end, with the end value: tables end with zero slope
            step, before = (exact[1] - exact[0] if self.settings.older else MARGIN_MM), 1
            datum = self.settings.datum_mm[axis]
            if self.settings.older and datum is not None:
                before = max(0, int((exact[0] - datum) / step))
            positions = (*(exact[0] - k * step for k in range(before, 0, -1)), *exact, exact[-1] + step)
            columns = {
                output: _rounded(
                    np.pad(values[one_dimensional_name(output, axis)], (before, 1), mode="edge") * self.settings.sign,
                    self.settings.decimals,
                )
                for output in range(3)
            }
            tables[axis] = ComTable(positions, columns)
        return ComTables(tables)

    def context(self, tables: ComTables) -> dict[str, Any]:
        """Return the additional context: ``com`` has layout and rows by axis letter, ``cma`` those of the .CMA."""
        settings = self.settings
        com = {}
        for axis in range(3):
            layout = settings.com_layout(axis)
            low, high = (Decimal(repr(end)).quantize(QUANTUM_MM) for end in self.machine.axes[axis].range_mm)
            nothing = ComTable((low, high), {axis: (Decimal(0), Decimal(0))})  # no correction over this axis
            rows = self._com_rows(layout, axis, tables.tables.get(axis, nothing))
            com[AXES[axis]] = {"layout": layout, "rows": rows}
        cma = settings.cma_layout()
        names = {settings.axis_names[axis]: f"AXIS_{AXES[axis]}.COM" for axis in sorted(tables.tables)}
        line = [{NUMBER_COLUMN: "0", ACTIVE: "*", **names}.get(name, "") for name in cma.names]
        cma.check(line)
        return {
            "sign_statement": self._sign_statement(tables),
            "parameters": self._parameters(tables),
            "warnings": self._warnings(tables),
            "com": com,
            "cma": {"layout": cma, "rows": [line]},
            "older": settings.older,
            "subtracts": settings.subtracts,
            "template": settings.com.source.name if settings.com and settings.com.source else "",
            "backlash_column": settings.backlash,
            "tables": [self._summary(axis, table) for axis, table in sorted(tables.tables.items())],
        }

    def parse(self, files: Sequence[SourceFile]) -> ComTables:
        """Read the .CMA file and every .COM file that it names."""
        read = [(file, read_table(file)) for file in files]
        assignments = [(file, table) for file, table in read if _kind(file, table) == "CMA"]
        if not assignments:
            first = files[0].path if files else None
            raise InputError("no .CMA file was given; it says which .COM file belongs to which axis", file=first)
        if len(assignments) > 1:
            raise assignments[1][0].fail(f"is a second .CMA file; the first is {assignments[0][0].path.name}", 1)
        coms: dict[str, tuple[SourceFile, TextTable]] = {}
        for file, table in read:
            if _kind(file, table) == "COM":
                name = file_stem(file.path.name)
                if name in coms:
                    raise file.fail(f"is the same table as {coms[name][0].path}", 1)
                coms[name] = file, table
        active = self._active(assignments[0][1], set(coms))
        unused = sorted(set(coms) - set(active.values()))
        if unused:
            warnings.warn(
                f"{', '.join(unused)}: not in the active line of the .CMA file, therefore not used",
                CompgenWarning,
                stacklevel=3,
            )
        return ComTables({axis: self._com_table(axis, coms[name][1]) for axis, name in sorted(active.items())})

    def curves(self, tables: ComTables) -> list[Table1D]:
        """Return every column, with the sign of the settings, and what the column BACKLASH adds after negative travel."""
        found, sign = [], float(self.settings.sign)
        for axis, table in tables.tables.items():
            found += [table.column(axis, values, output, sign) for output, values in table.columns.items()]
            if table.backlash is None or not any(table.backlash):
                continue
            step = table.column(axis, table.backlash, axis, sign)
            nothing = np.zeros(len(table.positions))
            entries = step.positive
            if self.settings.backlash == "absolute" and axis in table.columns:
                entries = entries - _floats(table.columns[axis])
            found.append(replace(step, positive=nothing, negative=entries))
        return found

    def violations(self, tables: ComTables) -> list[str]:
        """Return broken limits: entries, tables, spacing of the older controls, travel not covered."""
        settings = self.settings
        found = []
        for axis, table in sorted(tables.tables.items()):
            what = f"the table over {AXES[axis]}"
            if len(table.positions) > settings.max_points:
                found.append(
                    f"{what} has {len(table.positions)} entries; the limit is {settings.max_points} (module 9095, "
                    "error 3)"
                )
            steps = {b - a for a, b in pairwise(table.positions)}
            if settings.older and (len(steps) > 1 or _exponent(*steps) is None):
                shown = ", ".join(f"{step:f}" for step in sorted(steps)[:3])
                found.append(
                    f"{what} has the spacing {shown} mm; expected one power of two times 0.0001 mm (6.5536 mm: n = 16)"
                )
            found += self.not_covered(axis, table.nodes_mm, what)
        if settings.max_total_points is not None and tables.total_points > settings.max_total_points:
            found.append(
                f"all tables have {tables.total_points} entries; the limit is {settings.max_total_points} (module "
                "9095, error 4)"
            )
        if settings.max_tables is not None and len(tables.tables) > settings.max_tables:
            found.append(
                f"{len(tables.tables)} tables are needed; the limit is {settings.max_tables} (module 9095, error 5)"
            )
        return found

    def reversal_in_tables(self, reversal: ReversalCurves) -> ReversalCurves:
        """Return what goes into the column BACKLASH: reversals along the axis itself, unless it stays empty."""
        return ReversalCurves({}) if self.settings.backlash == "empty" else along_itself(reversal)

    def with_reversal(self, tables: ComTables, reversal: ReversalCurves) -> ComTables:
        """Put half of each reversal into the column of the axis and the other direction into the column BACKLASH.

        With reversal B the tool is at +B/2 after positive travel, so the correction is -B/2 then and +B/2 after
        negative travel, in addition to the curves.
        """
        settings = self.settings
        found = dict(tables.tables)
        for (axis, component), curve in reversal.curves.items():
            if axis != component or np.max(np.abs(curve.value)) < WORTH_MM:
                continue
            table = found[axis]
            half = -0.5 * settings.sign * curve.at(table.nodes_mm)
            entries = _floats(table.columns[axis])
            positive = _rounded(entries + half, settings.decimals)
            negative = _rounded(entries - half, settings.decimals)
            if settings.backlash == "difference":
                negative = tuple(b - a for a, b in zip(positive, negative, strict=True))
            found[axis] = replace(table, columns={**table.columns, axis: positive}, backlash=negative)
        return ComTables(found)

    def backlash_parameters(self, reversal: ReversalCurves) -> list[dict[str, str]]:
        """Return the backlash parameter for the mean reversal of each axis along itself; its sign is not documented.

        Names and ranges: TNC 426/430 technical manual p. 366, iTNC 530 HSCI p. 650, MANUALplus 620 p. 708.
        """
        settings = self.settings
        name = "MP710 (iTNC 530: MP750)" if settings.older else "MP_backLash"
        return [
            parameter_row(
                f"{name} of {settings.axis_names[axis]}",
                f"{abs(reversal.mean_mm(axis)):.4f} mm in size",
                "position reached in positive travel minus that in negative travel: "
                f"{reversal.mean_mm(axis):+.4f} mm; which sign corrects it is not documented: test it with "
                "a dial gauge. If a value was active while the machine was measured, add this one to it",
            )
            for axis in range(3)
            if abs(reversal.mean_mm(axis)) >= WORTH_MM
        ]

    def usage(self, tables: ComTables) -> list[Usage]:
        """Return entries, their total, tables and slope against the limits, where known."""
        settings = self.settings
        longest = max(len(table.positions) for table in tables.tables.values())
        found = [Usage("entries of the longest table", longest, settings.max_points, "entries")]
        if settings.max_total_points is not None:
            found.append(Usage("entries of all tables", tables.total_points, settings.max_total_points, "entries"))
        if settings.max_tables is not None:
            found.append(Usage("tables", len(tables.tables), settings.max_tables, "tables"))
        steepest = 100.0 * max(table.steepest for table in tables.tables.values())
        return [*found, Usage("change of an entry per travel", steepest, 100.0 * GRADIENT_SHARE, "%", False)]

    def resolution_mm(self) -> float:
        """Half of the last decimal of each of the three tables that act on an axis."""
        return 3 * 0.5 * 10.0**-self.settings.decimals

    def _com_nodes_mm(self, errors: ErrorTable, axis: int) -> FloatArray:
        """Return the nodes of the corrections over an axis, ascending, mm; nodes beyond the ends are added later."""
        candidates = self._candidates_mm(errors, axis)
        terms = one_dimensional_terms(self.machine, errors, [candidates] * 3, [(output, axis) for output in range(3)])
        requested = np.array([term.start for term in terms])
        tolerances = np.array([worth_mm(errors, axis, self.settings.loss_mm, output) for output in range(3)])
        if self.settings.older:
            # nodes with the widest power-of-two spacing that stays within the permitted loss
            scaled, stated = requested / tolerances[:, None], self.settings.exponent[axis]
            tried: list[tuple[float, EquidistantGrid]] = []
            for exponent in range(LARGEST_EXPONENT, SMALLEST_EXPONENT - 1, -1) if stated is None else (stated,):
                grid = self._grid(axis, spacing_mm(exponent))
                if grid.count > self.settings.max_points - 2 and tried:
                    break
                at = grid.nodes_mm
                lost = [np.interp(candidates, at, np.interp(at, candidates, row)) - row for row in scaled]
                tried.append((float(np.max(np.abs(lost))), grid))
                if tried[-1][0] <= 1.0:
                    return grid.nodes_mm
            return (nearly_best(tried) or tried[-1][1]).nodes_mm
        reference = np.flatnonzero(np.abs(candidates - self.machine.reference_point_mm[axis]) < 1e-6).tolist()
        chosen = candidates
        while True:
            chosen = candidates[fewest_nodes(candidates, requested, tolerances, reference)]
            if len(chosen) <= self.settings.max_points - 2:
                return chosen
            tolerances = 1.3 * tolerances

    def _candidates_mm(self, errors: ErrorTable, axis: int) -> FloatArray:
        """Candidate nodes: those of the curves and some in between, in whole 0.0001 mm, over the whole travel."""
        nodes = curve_nodes_mm(self.machine, errors, axis, MOST_CANDIDATES)
        parts = int(np.clip(MOST_CANDIDATES // len(nodes), 1, MOST_PARTS))
        fine = np.interp(np.arange(parts * (len(nodes) - 1) + 1) / parts, np.arange(len(nodes)), nodes)
        return np.unique(np.round(fine, 4))

    def _grid(self, axis: int, step: Decimal) -> EquidistantGrid:
        """Equidistant nodes from the last one at or below the start of the travel to the first at or above its end."""
        low, high = (Decimal(repr(end)) for end in self.machine.axes[axis].range_mm)
        stated = self.settings.datum_mm[axis]
        datum = low.quantize(QUANTUM_MM, rounding=ROUND_FLOOR) if stated is None else stated
        first = max(datum, datum + step * ((low - datum) / step).to_integral_value(rounding=ROUND_FLOOR))
        count = int(((high - first) / step).to_integral_value(rounding=ROUND_CEILING)) + 1
        return EquidistantGrid(first, step, max(count, 2))

    def _active(self, table: TextTable, present: set[str]) -> dict[int, str]:
        """Stem of the .COM file by input axis, from the marked line; every named file must be present."""
        marked: list[int] = []
        lines: list[dict[int, str]] = []
        if ACTIVE not in [column.name for column in table.columns]:
            raise table.file.fail(f"the table has no column {ACTIVE}", table.header_line)
        for row in table.rows:
            mark = row.cells.get(ACTIVE)
            if mark not in (None, "*"):
                raise table.file.fail(f"column {ACTIVE} contains {str(mark)[:20]!r}; expected '*' or nothing", row.line)
            named = {}
            for column, cell in row.cells.items():
                if column in (NUMBER_COLUMN, ACTIVE):
                    continue
                axis, stem = self._axis(table, column, row.line), file_stem(cell)
                if not re.fullmatch(r"[A-Za-z0-9_-]{1,32}\.(COM|V)", cell, re.ASCII | re.IGNORECASE):
                    raise table.file.fail(f"{cell[:40]!r} is not the name of a .COM file", row.line)
                if stem not in present:
                    raise table.file.fail(f"names {cell}, which is not among the given files", row.line)
                named[axis] = stem
            lines.append(named)
            marked += [len(lines) - 1] if mark else []
            if len(marked) > 1:
                raise table.file.fail(
                    f"a second line is marked in column {ACTIVE}; exactly one may be active", row.line
                )
        if not marked:
            raise table.file.fail(f"no line is marked with '*' in column {ACTIVE}", table.header_line)
        if not lines[marked[0]]:
            raise table.file.fail("the active line contains no .COM file", table.rows[marked[0]].line)
        return lines[marked[0]]

    def _axis(self, table: TextTable, column: str, line: int) -> int:
        if column not in self.settings.axis_names:
            known = ", ".join(self.settings.axis_names)
            raise table.file.fail(f"column {column} is not an axis of the machine file ({known}; see axis_names)", line)
        return self.settings.axis_names.index(column)

    def _com_table(self, axis: int, table: TextTable) -> ComTable:
        """Read the entries of one .COM file over an input axis."""
        if len(table.rows) < 2:
            raise table.file.fail(f"contains {len(table.rows)} entries; expected at least 2", table.header_line)
        positions = self._positions(axis, table)
        filled: dict[int, tuple[Decimal, ...]] = {}
        backlash = None
        for column in table.columns:
            if column.name in (NUMBER_COLUMN, POSITION):
                continue
            first = next((row for row in table.rows if column.name in row.cells), None)
            if first is None:
                continue
            values = tuple(table.number(row, column.name) for row in table.rows)
            if column.name == BACKLASH:
                backlash = values
            elif any(values) or column.name in self.settings.axis_names:
                filled[self._axis(table, column.name, first.line)] = values
        if not filled:
            raise table.file.fail("no column of an axis is filled", table.header_line)
        if backlash is not None and any(backlash) and self.settings.backlash == "empty":
            message = (
                'the column BACKLASH is filled; set backlash_column to the meaning of its values ("absolute" or '
                '"difference")'
            )
            raise table.file.fail(message, table.header_line)
        return ComTable(positions, filled, backlash)

    def _positions(self, axis: int, table: TextTable) -> tuple[Decimal, ...]:
        """Positions of the rows, ascending: column AXISPOS, else datum and spacing from the machine file."""
        if POSITION in [column.name for column in table.columns]:
            found = [table.number(row, POSITION) for row in table.rows]
            for k in range(1, len(found)):
                if found[k] <= found[k - 1]:
                    message = f"{POSITION} {found[k]} is not above {found[k - 1]}; positions ascend"
                    raise table.file.fail(message, table.rows[k].line)
            return tuple(found)
        datum, exponent = self.settings.datum_mm[axis], self.settings.exponent[axis]
        if datum is None or exponent is None:
            raise table.file.fail(
                f"has no column {POSITION}; set datum_mm and spacing_exponent of {AXES[axis]} in the machine file",
                table.header_line,
            )
        return tuple(datum + k * spacing_mm(exponent) for k in range(len(table.rows)))

    def _com_rows(self, layout: ComLayout, axis: int, table: ComTable) -> list[list[str]]:
        """Cells of every row in the order of the layout's columns."""
        settings = self.settings
        zero = f"{0:.{settings.decimals}f}"
        columns: dict[str, list[str]] = {
            NUMBER_COLUMN: [str(k) for k in range(len(table.positions))],
            POSITION: [_fixed(position, POSITION_DECIMALS) for position in table.positions],
            BACKLASH: [zero] * len(table.positions)
            if table.backlash is None
            else [_fixed(value, settings.decimals) for value in table.backlash],
        }
        for output, values in table.columns.items():
            columns[settings.axis_names[output]] = [_fixed(value, settings.decimals) for value in values]
        blank = [""] * len(table.positions)
        rows = [list(row) for row in zip(*(columns.get(name, blank) for name in layout.names), strict=True)]
        for row in rows:
            layout.check(row)
        return rows

    def _summary(self, axis: int, table: ComTable) -> dict[str, Any]:
        settings = self.settings
        step = table.positions[1] - table.positions[0]
        return {
            "axis": AXES[axis],
            "file": f"AXIS_{AXES[axis]}.COM",
            "column": settings.axis_names[axis],
            "outputs": ", ".join(settings.axis_names[output] for output in sorted(table.columns)),
            "entries": len(table.positions),
            "first_mm": float(table.positions[0]),
            "last_mm": float(table.positions[-1]),
            "step_mm": f"{step:f}" if settings.older else "",
            "exponent": _exponent(step) if settings.older else None,
        }

    def _sign_statement(self, tables: ComTables) -> str:
        settings = self.settings
        axis, output, node = _largest(tables)
        table = tables.tables[axis]
        value = float(table.columns[output][node])
        if settings.subtracts:
            kind = (
                "An entry is the measured error, actual minus nominal, in mm; the control SUBTRACTS it from the command"
            )
        else:
            kind = "An entry is the correction in mm; the control ADDS it to the command"
        return (
            f"{kind} (setting sign). A column corrects the axis that it is named after, as a function of the axis to "
            "which the .CMA file assigns the table; several tables into one axis add up. Example: "
            f"AXIS_{AXES[axis]}.COM, column {settings.axis_names[output]}, at {AXES[axis]} = "
            f"{float(table.positions[node]):.4f} mm: the entry is {value:+.4f} mm, so the control moves {AXES[output]} "
            f"by {settings.sign * value:+.4f} mm."
        )

    def _parameters(self, tables: ComTables) -> list[dict[str, str]]:
        if not self.settings.older:
            return [
                parameter_row(
                    "CfgAxes/axisList",
                    ", ".join(self.settings.axis_names),
                    "keys of X, Y, Z; the columns of .COM and .CMA have these names",
                ),
                parameter_row(
                    "MP_refPosition",
                    "unchanged",
                    "AXISPOS counts from the machine datum, as must the positions in the machine file",
                ),
                parameter_row("column ACTIVE of CONFIG.CMA", "* in line 0", "exactly one line is active"),
                parameter_row(
                    "linear axis error compensation",
                    "off",
                    "for X, Y, Z: an axis has either linear or non-linear compensation",
                ),
            ]
        rows = [
            parameter_row(
                f"MP730 bit {axis}",
                "1",
                f"{AXES[axis]}: non-linear axis error compensation; switches the linear one (MP720) off",
            )
            for axis in range(3)
        ]
        for axis, table in sorted(tables.tables.items()):
            step = table.positions[1] - table.positions[0]
            rows.append(
                parameter_row(
                    f"datum, spacing of AXIS_{AXES[axis]}.COM",
                    f"{table.positions[0]:f} mm, {step:f} mm",
                    f"spacing 2^{_exponent(step)} x 0.0001 mm; both count from the machine datum. Check "
                    "that the head of the table on the control shows them",
                )
            )
        return rows

    def _warnings(self, tables: ComTables) -> list[str]:
        settings = self.settings
        found = [
            "The sign of the entries is probable, but public documents do not prove it: check it with one table first "
            "(part 3)."
        ]
        steepest = max(table.steepest for table in tables.tables.values())
        if steepest > GRADIENT_SHARE:
            found.append(
                f"Neighbouring entries differ by up to {100 * steepest:.2f} % of their distance; the oldest tables "
                f"allow 1/64 = {100 * GRADIENT_SHARE:.2f} %, the limit of .COM files is not known."
            )
        if settings.older and settings.max_total_points is None and tables.total_points > USUAL_TOTAL:
            found.append(
                f"All tables together have {tables.total_points} entries. The limit of the control is not documented "
                f"(error 4 of module 9095; from memory {USUAL_TOTAL}): set max_total_points."
            )
        if settings.com is not None and settings.keep_name:
            found.append(
                f"The first line of the .COM files is that of the saved table ({settings.com.before[0].strip()}); if "
                'the control expects the file name there, set begin_name = "file".'
            )
        if settings.older and settings.has_positions:
            found.append(
                "It is not documented how a file of an older control states datum and spacing; these files have a "
                "column AXISPOS. Save an empty table on the control and export with --template-from."
            )
        return found


def _floats(values: Sequence[Decimal]) -> FloatArray:
    return np.array([float(value) for value in values])


def _rounded(values_mm: FloatArray, decimals: int) -> tuple[Decimal, ...]:
    return tuple(Decimal(int(count)).scaleb(-decimals) for count in np.rint(values_mm * 10**decimals))
