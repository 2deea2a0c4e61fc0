"""FANUC three-dimensional error compensation (``fanuc-3d``): a grid of vertices with trilinear interpolation."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import pairwise, permutations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.controls.fanuc_records import (
    FanucSettings,
    FanucStyle,
    Punched,
    Record,
    frame_of,
    punched_file,
    read_records,
    spacing_of,
    type_word,
    whole_numbers_of,
    width_of,
)
from compgen.controls.shared.base import (
    Controller,
    SourceFile,
    Term,
    Usage,
    coverage_violations,
    nodes_by_axis,
)
from compgen.controls.shared.grids import STEP_QUANTUM, EquidistantGrid, equidistant_grid, loss_setting, trilinear
from compgen.controls.shared.scanner import check_size
from compgen.controls.shared.terms import field_on_grid, one_dimensional_terms, product_terms
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray, fixed
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import axis_setting, file_setting, multiple_of, setting, whole, word_for
from compgen.errors import InputError, one_line
from compgen.kinematics.first_order import tool_of

# Records of three-dimensional compensation data as in a file punched from the user's control.
#
# No public document describes that file. What a sample shows is used: the form of the records and the
# number of the first point. The order of the points cannot be seen; ``order`` in the machine file states it.


#: Parameters of the function: axes, points per axis, number of the reference point, magnification, interval.
PARAMETERS = range(10800, 10815)
#: Words of a record after its number and type word, and how such a file stores the three values of a point.
FORMS = {"APAPAP": "axis words", "XYZ": "axis letters", "P": "a record per value"}


@dataclass(frozen=True)
class VolumeStyle:
    """Style of the records, one of :data:`FORMS`, number of the first record, whether there are parameters too."""

    style: FanucStyle
    form: str
    first: int
    with_parameters: bool
    notes: tuple[str, ...]

    def records(self, axis_numbers: Sequence[int], values: Sequence[Sequence[int]]) -> list[str]:
        """Return the records of points in their order, from (x, y, z) values in counts."""
        found, number = [], self.first
        for point in values:
            texts = [self.style.whole(value) for value in point]
            if self.form == "P":
                rows = [[f"P{text}"] for text in texts]
            elif self.form == "XYZ":
                rows = [[f"{letter}{text}" for letter, text in zip(AXES, texts, strict=True)]]
            else:
                pairs = sorted(zip(axis_numbers, texts, strict=True))
                rows = [[word for axis, text in pairs for word in (f"A{axis}", f"P{text}")]]
            for row in rows:
                found.append(self.style.record(number, row, 0, point=True))
                number += 1
        return found


def read_volume_style(path: Path) -> VolumeStyle:
    """Return the style of punched three-dimensional data; InputError with the line of anything not understood."""
    return volume_style_of(punched_file(path))


def volume_style_of(file: SourceFile) -> VolumeStyle:
    """Return the style of punched data from their text; see :func:`read_volume_style`."""
    records = list(read_records(file))
    parameters, data = parted(records)
    if not data:
        raise file.fail("contains no compensation data; punch the table of three-dimensional compensation", 1)
    form = form_of(data[0])
    for before, record in zip(data, data[1:], strict=False):
        if form_of(record) != form:
            raise record.fail(f"its words differ from those of line {data[0].line}; the style is not clear")
        if record.number != before.number + 1:
            raise record.fail(f"does not follow N{before.number}; expected the records of one table in order")
    style = spacing_of(frame_of(file, records, data), data)
    texts = [text for record in data for letter, text in record.words() if letter in "PXYZ"]
    style = replace(whole_numbers_of(style, texts), point_digits=width_of(data, 5), digits=width_of(parameters, 5))
    notes = (
        f"{len(data)} records of the form {FORMS[form]}, starting with N{data[0].number}",
        f"parameters {'are' if parameters else 'are not'} in the same file",
        "the order of the points cannot be determined from the sample; set `order` in the machine file",
    )
    return VolumeStyle(style, form, data[0].number, bool(parameters), notes)


def parted(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """Split records into parameters 10800 ... 10814 and data, whose numbers may include that range.

    A record of type Q1 is a parameter, one of type Q0 is data. Without type words, a number in that range is data if
    the file also contains records numbered just before and just after the range.
    """
    numbers = {record.number for record in records}
    through = {PARAMETERS[0] - 1, PARAMETERS[-1] + 1} <= numbers
    found: tuple[list[Record], list[Record]] = ([], [])
    for record in records:
        kind, _ = type_word(record, record.words())
        parameter = record.number in PARAMETERS and (kind == 1 or (kind is None and not through))
        found[0 if parameter else 1].append(record)
    return found


def form_of(record: Record) -> str:
    """Return which of :data:`FORMS` a record has; InputError if none."""
    _, words = type_word(record, record.words())
    form = "".join(letter for letter, _ in words)
    if form not in FORMS:
        raise record.fail(f"words {form or 'none'} are not understood; expected A1P..A2P..A3P.., X..Y..Z.. or P..")
    for letter, text in words:
        record.whole(text, 1 if letter == "A" else -10_000_000, 10_000_000)
    return form


# Settings of ``[controllers.fanuc-3d]``: counts, the grid and its limits, the file style of the user's control.


@dataclass(frozen=True, kw_only=True)
class VolumeSettings(FanucSettings):
    """Settings of three-dimensional error compensation; ``sample`` is None without a file of the user's control."""

    sample: VolumeStyle | None = file_setting(
        read_volume_style,
        key="style_from",
        meaning="a file of three-dimensional data punched out by your control; the export follows its style",
    )
    magnification: tuple[int, int, int] = axis_setting(
        whole(1, 100),
        (1, 1, 1),
        meaning="magnification of the values of an axis, e.g. { X = 2 }; one count is magnification times detection unit",
    )
    interval_mm: tuple[float | None, float | None, float | None] = axis_setting(
        multiple_of(STEP_QUANTUM), meaning="vertex spacing, e.g. { X = 50.0 }; default: chosen automatically"
    )
    loss_mm: float = loss_setting(
        "interpolation loss between vertices that does not justify another vertex, um at the tool"
    )
    most_points: int = setting(whole(2, 1000), 25, meaning="largest number of vertices along an axis")
    most_in_all: int = setting(whole(8, 50_000), 15625, meaning="largest number of vertices")
    value_low: int = setting(whole(-32768, -1), -128, meaning="smallest value, counts")
    value_high: int = setting(whole(1, 32767), 127, meaning="largest value, counts")
    order: tuple[int, int, int] = setting(
        word_for({"".join(AXES[axis] for axis in order): order for order in permutations(range(3))}),
        stated="XYZ",
        meaning="axes in the order of the point numbers, fastest-varying axis first",
    )

    def count_mm(self, axis: int) -> float:
        """One count of the values of an axis, mm."""
        return self.magnification[axis] * self.detection_unit_um * MM_PER_UM


# Numbers of three-dimensional error compensation: a regular grid of vertices with three values each, and its files.
#
# Point numbers count from 1; the axis that ``order`` names first runs fastest.


COLUMNS = "point,x_mm,y_mm,z_mm,x_counts,y_counts,z_counts"
#: No table is this long, and no value this large.
MOST_CHARACTERS, MOST_ROWS, MOST_VALUE = 8_000_000, 50_000, 1_000_000
_ROW = re.compile(
    r"(\d{1,6}),(-?\d{1,6}(?:\.\d{1,6})?),(-?\d{1,6}(?:\.\d{1,6})?),(-?\d{1,6}(?:\.\d{1,6})?)((?:,-?\d{1,7}){3})"
)
_KEY = re.compile(r"#\s{0,9}([a-z_]{1,40})\s{0,9}=\s{0,9}([^\s].{0,300})")


@dataclass(frozen=True)
class VolumeTable:
    """``counts`` (nx, ny, nz, 3) at the grid vertices in machine coordinates; one count per ``magnification``."""

    grids: tuple[EquidistantGrid, ...]
    counts: NDArray[np.int64]
    magnification: tuple[int, ...]

    def __eq__(self, other: object) -> bool:
        """Compare numbers by value."""
        if not isinstance(other, VolumeTable):
            return NotImplemented
        same = self.magnification == other.magnification and self.counts.shape == other.counts.shape
        places = [(g.start, g.count, g.step if g.count > 1 else 0) for g in self.grids]
        return (
            same
            and places == [(g.start, g.count, g.step if g.count > 1 else 0) for g in other.grids]
            and bool(np.array_equal(self.counts, other.counts))
        )

    @property
    def start_mm(self) -> FloatArray:
        """Position of the first vertex, shape (3,)."""
        return np.array([float(grid.start) for grid in self.grids])

    @property
    def step_mm(self) -> FloatArray:
        """Spacing of the vertices, shape (3,)."""
        return np.array([float(grid.step) for grid in self.grids])

    def numbered(self, order: Sequence[int]) -> Iterator[tuple[int, tuple[int, int, int]]]:
        """Yield (point number, vertex index) in order of point number."""
        shape = tuple(self.counts.shape[axis] for axis in order)
        for number in range(int(np.prod(shape))):
            index, rest = [0, 0, 0], number
            for axis, size in zip(order, shape, strict=True):
                index[axis], rest = rest % size, rest // size
            yield number + 1, (index[0], index[1], index[2])


Row = tuple[int, tuple[Decimal, Decimal, Decimal], tuple[int, int, int], int]


def _rows(file: SourceFile) -> tuple[dict[str, tuple[str, int]], list[Row]]:
    """Return the ``# key = value`` comments and the rows of the file."""
    keys: dict[str, tuple[str, int]] = {}
    rows: list[Row] = []
    header = False
    for line, text in enumerate(file.text.splitlines(), start=1):
        bare = text.strip(" \t\ufeff")
        if bare.startswith("#"):
            key = _KEY.fullmatch(bare)
            if key is not None:
                keys[key[1]] = key[2], line
        elif not header and bare:
            if bare != COLUMNS:
                raise file.fail(f"expected the header {COLUMNS}, found {one_line(bare[:60])!r}", line)
            header = True
        elif bare:
            rows.append(_row(file, bare, line))
            if len(rows) > MOST_ROWS:
                raise file.fail(f"has more than {MOST_ROWS} rows; a table has fewer", line)
    if not rows:
        raise file.fail("contains no vertex", len(file.text.splitlines()) or 1)
    declared = keys.get("rows", ("none", 1))
    if declared[0] != str(len(rows)):
        raise file.fail(
            f"declares {one_line(declared[0])} rows but contains {len(rows)}: is it truncated?", declared[1]
        )
    if not file.text.endswith(("\n", "\r")):
        raise file.fail("the last line has no line end: the file is truncated", rows[-1][3])
    return keys, rows


def _row(file: SourceFile, text: str, line: int) -> Row:
    found = _ROW.fullmatch(text) if len(text) < 200 else None
    if found is None:
        what = one_line(text[:60])
        raise file.fail(f"{what!r} is not a row; expected a point number, three positions and three whole counts", line)
    x, y, z = (Decimal(found[k]) for k in (2, 3, 4))
    p, q, r = (int(value) for value in found[5].split(",")[1:])
    return int(found[1]), (x, y, z), (p, q, r), line


# Template content for three-dimensional compensation: vertices, plan, what to set, worked example.


MEANINGS = (
    "axis {}",
    "vertices along {}",
    "number of the reference vertex of {}",
    "magnification of {}",
    "interval along {}, mm",
)


def _place(table: VolumeTable, index: tuple[int, int, int]) -> str:
    return ",".join(f"{grid.start + k * grid.step:.4f}" for grid, k in zip(table.grids, index, strict=True))


# FANUC three-dimensional error compensation: a grid of vertices over X, Y, Z with trilinear interpolation.
#
# The formula is documented, the file is not: the grid is written as neutral CSV and JSON plan, and as records only
# in the style of a file punched from the user's control. See ``templates/fanuc-3d/format.toml``.


class Fanuc3d(Controller[VolumeSettings, VolumeTable]):
    """Corrections of X, Y and Z at the vertices of a grid, zero at the vertex of the reference point."""

    name = "fanuc-3d"
    settings_class = VolumeSettings
    anchored = True
    has_plan = True
    sample_setting = "style_from"

    @classmethod
    def read_settings(cls, machine: Machine) -> VolumeSettings:
        """Check ``[controllers.fanuc-3d]``."""
        section = machine.controller_settings(cls.name)
        settings = toml_files.take_settings(VolumeSettings, section)
        settings.finish(section)
        return settings

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return curves of one axis, alone and times the coordinate of another; a trilinear grid fits them exactly.

        Their nodes are the vertices. All are zero at the reference point, one of the vertices.
        """
        machine = self.machine
        nodes = [
            equidistant_grid(
                machine,
                errors,
                axis,
                most=self.settings.most_points,
                step_mm=self.settings.interval_mm[axis],
                anchor=True,
                loss_mm=self.settings.loss_mm,
            ).nodes_mm
            for axis in range(3)
        ]
        origin = machine.reference_point_mm
        pairs = [(output, axis) for output in range(3) for axis in range(3)]
        single = one_dimensional_terms(machine, errors, nodes, pairs, anchored=True, lever_origin_mm=origin)
        return single + product_terms(machine, errors, nodes, origin)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> VolumeTable:
        """Round the field at every vertex.

        Trilinear interpolation is a weighted mean of the corners of a box, so no point is off by more than a
        vertex: half a count. No other whole numbers stay within half a count at every vertex.
        """
        nodes = [next(term.nodes_mm for term in basis if term.axis == axis) for axis in range(3)]
        field = field_on_grid(basis, values, dict(enumerate(nodes)), tool_of(self.machine, None))
        count_mm = np.array([self.settings.count_mm(axis) for axis in range(3)])
        counts = np.floor(self.settings.sign * field / count_mm + 0.5).astype(np.int64)
        grids = []
        for axis, nodes_mm in enumerate(nodes):  # in exact decimals; the reference point is one of the vertices
            length = Decimal(repr(round(float(nodes_mm[-1] - nodes_mm[0]), 9)))
            step = (length / (len(nodes_mm) - 1)).quantize(STEP_QUANTUM)
            reference = self.machine.reference_point_mm[axis]
            below = int(np.argmin(np.abs(nodes_mm - reference)))
            grids.append(EquidistantGrid(Decimal(repr(reference)) - below * step, step, len(nodes_mm)))
        return VolumeTable(tuple(grids), counts, self.settings.magnification)

    def context(self, tables: VolumeTable) -> dict[str, Any]:
        """Return the vertices, the plan point number -> values, what to set, and the sign statement."""
        settings = self.settings
        vertices = [(number, index, tables.counts[index].tolist()) for number, index in tables.numbered(settings.order)]
        parameters = self._parameters(tables)
        sample = settings.sample
        return {
            "sign_statement": self._sign_statement(tables),
            "parameters": [
                {
                    "name": str(number),
                    "value": text,
                    "meaning": f"{MEANINGS[k // 3].format(AXES[k % 3])} (number unverified)",
                }
                for k, (number, text) in enumerate(parameters.items())
            ],
            "warnings": self._warnings(),
            "overwrites": [
                "Of other axes: nothing, if the numbers below are right. The table of three-dimensional compensation "
                "in the control is replaced as a whole.",
                f"Parameters {', '.join(map(str, parameters))}",
                f"Points 1 to {len(vertices)}, three values each",
            ],
            "settings": settings,
            "order": "".join(AXES[axis] for axis in settings.order),
            "magnification": " ".join(map(str, tables.magnification)),
            "columns": COLUMNS,
            "vertices": [
                {"number": number, "place": _place(tables, index), "values": ",".join(map(str, values))}
                for number, index, values in vertices
            ],
            "grids": [
                {
                    "axis": AXES[axis],
                    "count": grid.count,
                    "first": fixed(float(grid.start), 4),
                    "last": fixed(float(grid.last), 4),
                    "step": fixed(float(grid.step), 4),
                    "low": int(tables.counts[..., axis].min()),
                    "high": int(tables.counts[..., axis].max()),
                }
                for axis, grid in enumerate(tables.grids)
            ],
            "plan": {
                "parameters": parameters,
                "points": {number: values for number, _, values in vertices},
                "stores": settings.stores,
                "detection_unit_um": settings.detection_unit_um,
            },
            "style_notes": list(sample.notes) if sample else [],
            "has_sample": sample is not None,
            "container": "records" if sample is not None else "grid",
            "file": self._punched(parameters, [values for _, _, values in vertices]),
            "check": self._check(tables),
        }

    def parse(self, files: Sequence[SourceFile]) -> VolumeTable:
        """Read the neutral CSV; records in the control's style must contain the same values; a plan is skipped."""
        texts = [file for file in files if file.path.suffix.lower() == ".csv"]
        punched = [file for file in files if file.path.suffix.lower() not in (".csv", ".json")]
        if len(texts) > 1:
            raise texts[1].fail("is a second table; give only one")
        table = self._read_csv(texts[0]) if texts else None
        for file in punched:
            read = self._read_records(file, table)
            if table is not None and not np.array_equal(read.counts, table.counts):
                place = tuple(int(k) for k in np.argwhere(np.any(read.counts != table.counts, axis=3))[0])
                raise file.fail(
                    f"vertex {place} has {read.counts[place].tolist()}, but the CSV has {table.counts[place].tolist()}"
                )
            table = read
        if table is None:
            raise InputError(
                "no table was given; expected VOLUME.csv (or a punched file with parameters 10800 to 10814)"
            )
        return table

    def emulate(self, tables: VolumeTable, points: Points) -> FloatArray:
        """Return sign * count * trilinear value; outside, the value at the grid's surface."""
        count_mm = np.array(tables.magnification) * self.settings.count_mm(0) / self.settings.magnification[0]
        value = trilinear(tables.counts.astype(np.float64), tables.start_mm, tables.step_mm, points.position_mm)
        return np.asarray(self.settings.sign * count_mm * value)

    def violations(self, tables: VolumeTable) -> list[str]:
        """Return values out of range, too many vertices, and travel that the grid does not cover."""
        settings = self.settings
        messages = []
        for axis, grid in enumerate(tables.grids):
            low, high = int(tables.counts[..., axis].min()), int(tables.counts[..., axis].max())
            if low < settings.value_low or high > settings.value_high:
                needed = int(
                    np.ceil(tables.magnification[axis] * max(low / settings.value_low, high / settings.value_high))
                )
                messages.append(
                    f"the values of {AXES[axis]} go from {low} to {high}, but must be within {settings.value_low} to "
                    f"{settings.value_high}; set magnification.{AXES[axis]} = {needed} or more (coarser counts)"
                )
            if grid.count > settings.most_points:
                messages.append(
                    f"{grid.count} vertices along {AXES[axis]}; at most {settings.most_points} are possible"
                )
            first, last = float(grid.start), float(grid.last)
            messages += coverage_violations(self.machine, axis, first, last, "the grid")
        total = int(np.prod(tables.counts.shape[:3]))
        if total > settings.most_in_all:
            messages.append(f"{total} vertices; at most {settings.most_in_all} are possible")
        return messages

    def table_nodes_mm(self, tables: VolumeTable) -> tuple[FloatArray, ...]:
        """Return the vertices along each axis."""
        return nodes_by_axis((axis, grid.nodes_mm) for axis, grid in enumerate(tables.grids))

    def usage(self, tables: VolumeTable) -> list[Usage]:
        """Return values and vertices against their limits, none of which is stated in a public document."""
        settings = self.settings
        total = int(np.prod(tables.counts.shape[:3]))
        found = [Usage("vertices", total, settings.most_in_all, "points", stated=False)]
        for axis, grid in enumerate(tables.grids):
            low, high = int(tables.counts[..., axis].min()), int(tables.counts[..., axis].max())
            share = max(low / settings.value_low, high / settings.value_high, 0.0) * settings.value_high
            found.append(Usage(f"value of {AXES[axis]}", share, settings.value_high, "counts", stated=False))
            found.append(
                Usage(f"vertices along {AXES[axis]}", grid.count, settings.most_points, "points", stated=False)
            )
        return found

    def resolution_mm(self) -> float:
        """Return half a count, see :meth:`build`."""
        return 0.5 * max(self.settings.count_mm(axis) for axis in range(3))

    def _read_csv(self, file: SourceFile) -> VolumeTable:
        check_size(file, MOST_CHARACTERS)
        keys, rows = _rows(file)
        text, line = keys.get("magnification", ("", None))
        if not re.fullmatch(r"\d{1,3} \d{1,3} \d{1,3}", text):
            raise file.fail("the line '# magnification = 1 1 1' (for X, Y and Z) is missing or wrong", line)
        grids = []
        for axis, letter in enumerate(AXES):
            nodes = sorted({row[1][axis] for row in rows})
            if len(nodes) < 2:
                raise file.fail(f"has only one position of {letter}; expected at least two")
            if any(after - before != nodes[1] - nodes[0] for before, after in pairwise(nodes)):
                raise file.fail(f"the positions of {letter} are not evenly spaced")
            grids.append(EquidistantGrid(nodes[0], nodes[1] - nodes[0], len(nodes)))
        shape = tuple(grid.count for grid in grids)
        if len(rows) != int(np.prod(shape)):
            raise file.fail(
                f"{len(rows)} vertices do not fill a grid of {' x '.join(map(str, shape))}: is it truncated?"
            )
        counts = np.zeros((*shape, 3), dtype=np.int64)
        seen: dict[Any, int] = {}
        for number, position, values, line in rows:
            index = tuple(int((position[k] - grids[k].start) / grids[k].step) for k in range(3))
            for what in (number, index):
                if what in seen:
                    raise file.fail(
                        f"point {number} or its position is given a second time (first in line {seen[what]})", line
                    )
                seen[what] = line
            counts[index] = values
        table = VolumeTable(tuple(grids), counts, tuple(map(int, text.split())))
        by_number = {row[0]: row for row in rows}
        for number, place in table.numbered(self.settings.order):
            expected = tuple(grids[k].start + place[k] * grids[k].step for k in range(3))
            if number not in by_number:
                raise file.fail(f"point {number} is missing")
            if by_number[number][1] != expected:
                order = "".join(AXES[k] for k in self.settings.order)
                raise file.fail(
                    f"point {number} is not at the position that order = {order!r} gives", by_number[number][3]
                )
        return table

    def _read_records(self, file: SourceFile, table: VolumeTable | None) -> VolumeTable:
        """Read records in the control's style; the grid is from parameters 10803 ... 10814, else from the CSV."""
        records, data = parted(list(read_records(file)))
        parameters: dict[int, tuple[str, Record]] = {}
        for record in records:
            _, words = type_word(record, record.words())
            if len(words) != 1 or words[0][0] != "P":
                raise record.fail("expected a single value word P, e.g. P11")
            if record.number in parameters:
                raise record.fail(f"is given a second time (first in line {parameters[record.number][1].line})")
            parameters[record.number] = words[0][1], record
        shape = self._frame(file, parameters) if parameters else table
        if shape is None:
            raise file.fail("contains no parameters 10800 to 10814; also give VOLUME.csv, which contains the grid")
        values = self._values(file, data)
        size = int(np.prod(shape.counts.shape[:3]))
        if len(values) != size:
            raise file.fail(
                f"contains {len(values)} points, the grid has {size}: is it truncated?", data[-1].line if data else 1
            )
        counts = np.zeros(shape.counts.shape, dtype=np.int64)
        for number, index in shape.numbered(self.settings.order):
            counts[index] = values[number - 1]
        return VolumeTable(shape.grids, counts, shape.magnification)

    def _frame(self, file: SourceFile, parameters: dict[int, tuple[str, Record]]) -> VolumeTable:
        """Empty table for the grid described by the parameters."""
        missing = [str(number) for number in PARAMETERS if number not in parameters]
        if missing:
            raise file.fail(f"parameter {', '.join(missing)} is missing")

        def whole(number: int, low: int, high: int) -> int:
            text, record = parameters[number]
            return record.whole(text, low, high)

        grids, magnification = [], []
        for axis in range(3):
            count = whole(10803 + axis, 2, 1000)
            reference = whole(10806 + axis, 1, count)
            text, record = parameters[10812 + axis]
            step = Decimal(text)
            if not 0 < step < 100000:
                raise record.fail(f"the interval {text} mm is not possible; expected a positive number")
            start = Decimal(repr(self.machine.reference_point_mm[axis])) - (reference - 1) * step
            grids.append(EquidistantGrid(start, step, count))
            magnification.append(whole(10809 + axis, 1, 100))
        counts = np.zeros((*(grid.count for grid in grids), 3), dtype=np.int64)
        return VolumeTable(tuple(grids), counts, tuple(magnification))

    def _values(self, file: SourceFile, data: Sequence[Record]) -> list[list[int]]:
        """Three values of each point, in order of record number."""
        settings = self.settings
        found: list[list[int]] = []
        before: Record | None = None
        for record in sorted(data, key=lambda item: item.number):
            if before is not None and record.number != before.number + 1:
                same = record.number == before.number
                raise record.fail(
                    f"is given a second time (first in line {before.line})" if same else "a number before it is missing"
                )
            before, form = record, form_of(record)
            _, words = type_word(record, record.words())
            texts = [(letter, text) for letter, text in words]
            if form == "APAPAP":
                pairs = {int(Decimal(a[1])): p[1] for a, p in zip(texts[::2], texts[1::2], strict=True)}
                if sorted(pairs) != sorted(settings.axis_numbers):
                    raise record.fail(f"has the axes {sorted(pairs)}; expected {sorted(settings.axis_numbers)}")
                texts = [("P", pairs[number]) for number in settings.axis_numbers]
            numbers = [record.whole(text, -MOST_VALUE, MOST_VALUE) for _, text in texts]
            if form == "P" and found and len(found[-1]) < 3:
                found[-1] += numbers
            else:
                found.append(numbers)
        if not found or len(found[-1]) != 3:
            raise file.fail("contains no complete point: is it truncated?", data[-1].line if data else 1)
        return found

    def _parameters(self, table: VolumeTable) -> dict[int, str]:
        """Parameters 10800 ... 10814 as text."""
        reference = [
            round((self.machine.reference_point_mm[axis] - float(grid.start)) / float(grid.step)) + 1
            for axis, grid in enumerate(table.grids)
        ]
        texts = [
            *map(str, self.settings.axis_numbers),
            *(str(grid.count) for grid in table.grids),
            *map(str, reference),
            *map(str, table.magnification),
            *(f"{grid.step:.4f}" for grid in table.grids),
        ]
        return dict(zip(PARAMETERS, texts, strict=True))

    def _punched(self, parameters: dict[int, str], values: list[list[int]]) -> Punched | None:
        """Text in the style of the sample, None without a sample."""
        sample = self.settings.sample
        if sample is None:
            return None
        records = [sample.style.record(number, [f"P{text}"], 1) for number, text in parameters.items()]
        return Punched(
            sample.style.file(
                records if sample.with_parameters else [], sample.records(self.settings.axis_numbers, values)
            )
        )

    def _sign_statement(self, table: VolumeTable) -> str:
        settings = self.settings
        stored = "correction, which the control is assumed to add"
        if settings.stores == "error":
            stored = "error, which the control is assumed to subtract"
        place = tuple(int(k) for k in np.unravel_index(int(np.argmax(np.abs(table.counts))), table.counts.shape))
        index, axis = (place[0], place[1], place[2]), place[3]
        value = int(table.counts[place])
        moved = settings.sign * value * table.magnification[axis] * settings.detection_unit_um
        at = _place(table, index).replace(",", ", ")
        return (
            f"The values are the {stored}; one count is magnification times {settings.detection_unit_um:g} um. Example: at "
            f"the vertex X, Y, Z = {at} mm the value {value:+d} of {AXES[axis]} moves {AXES[axis]} by {moved:+g} um. "
            "Assumed: trilinear between vertices; outside the grid the value at its surface."
        )

    def _warnings(self) -> list[str]:
        found = [
            "Public documents do not settle the sign, the order of the points, the parameter numbers and the behaviour "
            "outside the grid: first check single vertices (part 3), and read back the applied compensation (FOCAS "
            "cnc_rdvolccomp).",
            "These files replace stored pitch error and straightness compensation: X, Y and Z must not be corrected twice.",
        ]
        if self.settings.sample is not None:
            found.append("The style was taken from the sample: " + "; ".join(self.settings.sample.notes) + ".")
        return found

    def _check(self, table: VolumeTable) -> dict[str, Any]:
        """Trial: one value at the vertex of each axis farthest from the reference vertex, and what to expect there."""
        counts = 10
        last = (table.counts.shape[0] - 1, 0, 0)
        numbers = {index: number for number, index in table.numbered(self.settings.order)}
        return {
            "number": numbers[last],
            "place": _place(table, last).replace(",", ", "),
            "counts": counts,
            "change_um": self.settings.sign * counts * table.magnification[0] * self.settings.detection_unit_um,
            "second": numbers[0, table.counts.shape[1] - 1, 0],
            "second_place": _place(table, (0, table.counts.shape[1] - 1, 0)).replace(",", ", "),
        }
