"""Numbers of three-dimensional error compensation: a regular grid of vertices with three values each, and its files.

Point numbers count from 1; the axis that ``order`` names first runs fastest.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.controllers.base import SourceFile, Usage, coverage_violations
from compgen.controllers.fanuc.text import Record, read_records, type_word
from compgen.controllers.fanuc.volumetric_settings import VolumeSettings
from compgen.controllers.fanuc.volumetric_style import PARAMETERS, form_of, parted
from compgen.controllers.grids import Grid
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.text import one_line
from compgen.errors import InputError

COLUMNS = "point,x_mm,y_mm,z_mm,x_counts,y_counts,z_counts"
#: No table is as long as this, nor any value beyond this.
MOST_CHARACTERS, MOST_ROWS, MOST_VALUE = 8_000_000, 50_000, 1_000_000
_ROW = re.compile(
    r"(\d{1,6}),(-?\d{1,6}(?:\.\d{1,6})?),(-?\d{1,6}(?:\.\d{1,6})?),(-?\d{1,6}(?:\.\d{1,6})?)((?:,-?\d{1,7}){3})"
)
_KEY = re.compile(r"#\s{0,9}([a-z_]{1,40})\s{0,9}=\s{0,9}([^\s].{0,300})")


@dataclass(frozen=True)
class VolumeTable:
    """``counts`` (nx, ny, nz, 3) at the vertices of three grids in machine coordinates; one count per ``magnification``."""

    grids: tuple[Grid, Grid, Grid]
    counts: NDArray[np.int64]
    magnification: tuple[int, int, int]

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
        """Distances of the vertices, shape (3,)."""
        return np.array([float(grid.step) for grid in self.grids])

    def numbered(self, order: Sequence[int]) -> Iterator[tuple[int, tuple[int, int, int]]]:
        """Yield (point number, vertex index) in the order of the numbers."""
        shape = tuple(self.counts.shape[axis] for axis in order)
        for number in range(int(np.prod(shape))):
            index, rest = [0, 0, 0], number
            for axis, size in zip(order, shape, strict=True):
                index[axis], rest = rest % size, rest // size
            yield number + 1, (index[0], index[1], index[2])


def parse_volume(machine: Machine, settings: VolumeSettings, files: Sequence[SourceFile]) -> VolumeTable:
    """Read the neutral CSV; records beside it in the style of the control must hold the same; a plan is passed over."""
    texts = [file for file in files if file.path.suffix.lower() == ".csv"]
    punched = [file for file in files if file.path.suffix.lower() not in (".csv", ".json")]
    if len(texts) > 1:
        raise texts[1].fail("a second table; one is due")
    table = _read_csv(settings, texts[0]) if texts else None
    for file in punched:
        read = _read_records(machine, settings, file, table)
        if table is not None and not np.array_equal(read.counts, table.counts):
            place = tuple(int(k) for k in np.argwhere(np.any(read.counts != table.counts, axis=3))[0])
            raise file.fail(f"vertex {place} has {read.counts[place].tolist()}, the CSV {table.counts[place].tolist()}")
        table = read
    if table is None:
        raise InputError("no table is given; VOLUME.csv (or a punched file with parameters 10800 to 10814) is needed")
    return table


def _read_csv(settings: VolumeSettings, file: SourceFile) -> VolumeTable:
    if len(file.text) > MOST_CHARACTERS:
        raise file.fail(f"holds {len(file.text)} characters; that is no table (at most {MOST_CHARACTERS})")
    keys, rows = _rows(file)
    grids = tuple(_grid(file, axis, sorted({row[1][axis] for row in rows})) for axis in range(3))
    shape = tuple(grid.count for grid in grids)
    if len(rows) != int(np.prod(shape)):
        raise file.fail(f"{len(rows)} vertices do not fill a grid of {' x '.join(map(str, shape))}: is it truncated?")
    counts = np.zeros((*shape, 3), dtype=np.int64)
    seen: dict[Any, int] = {}
    for number, position, values, line in rows:
        index = tuple(int((position[k] - grids[k].start) / grids[k].step) for k in range(3))
        for what in (number, index):
            if what in seen:
                raise file.fail(
                    f"point {number} or its position stands here a second time (first in line {seen[what]})", line
                )
            seen[what] = line
        counts[index] = values
    table = VolumeTable((grids[0], grids[1], grids[2]), counts, _magnification(file, keys))
    by_number = {row[0]: row for row in rows}
    for number, place in table.numbered(settings.order):
        due = tuple(grids[k].start + place[k] * grids[k].step for k in range(3))
        if number not in by_number:
            raise file.fail(f"point {number} is missing")
        if by_number[number][1] != due:
            order = "".join(AXES[k] for k in settings.order)
            raise file.fail(f"point {number} does not stand where order = {order!r} has it", by_number[number][3])
    return table


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
                raise file.fail(f"{one_line(bare[:60])!r} stands where the header {COLUMNS} is due", line)
            header = True
        elif bare:
            rows.append(_row(file, bare, line))
            if len(rows) > MOST_ROWS:
                raise file.fail(f"holds more than {MOST_ROWS} rows; that is no table", line)
    if not rows:
        raise file.fail("holds no vertex", len(file.text.splitlines()) or 1)
    declared = keys.get("rows", ("none", 1))
    if declared[0] != str(len(rows)):
        raise file.fail(f"declares {one_line(declared[0])} rows but holds {len(rows)}: is it truncated?", declared[1])
    if not file.text.endswith(("\n", "\r")):
        raise file.fail("the last line has no line end: the file is truncated", rows[-1][3])
    return keys, rows


def _row(file: SourceFile, text: str, line: int) -> Row:
    found = _ROW.fullmatch(text) if len(text) < 200 else None
    if found is None:
        what = one_line(text[:60])
        raise file.fail(f"{what!r} is no row of point number, three positions and three whole counts", line)
    x, y, z = (Decimal(found[k]) for k in (2, 3, 4))
    p, q, r = (int(value) for value in found[5].split(",")[1:])
    return int(found[1]), (x, y, z), (p, q, r), line


def _grid(file: SourceFile, axis: int, positions: list[Decimal]) -> Grid:
    if len(positions) < 2:
        raise file.fail(f"has one position of {AXES[axis]}; at least two are due")
    step = positions[1] - positions[0]
    if any(after - before != step for before, after in zip(positions, positions[1:], strict=False)):
        raise file.fail(f"the positions of {AXES[axis]} are not evenly spaced")
    return Grid(positions[0], step, len(positions))


def _magnification(file: SourceFile, keys: dict[str, tuple[str, int]]) -> tuple[int, int, int]:
    text, line = keys.get("magnification", ("", None))
    if not re.fullmatch(r"\d{1,3} \d{1,3} \d{1,3}", text):
        raise file.fail("the line '# magnification = 1 1 1' (of X, Y and Z) is missing or wrong", line)
    x, y, z = map(int, text.split())
    return x, y, z


def _read_records(
    machine: Machine, settings: VolumeSettings, file: SourceFile, beside: VolumeTable | None
) -> VolumeTable:
    """Read records in the style of the control; the grid is that of parameters 10803 ... 10814, else of the CSV."""
    own, data = parted(list(read_records(file)))
    parameters: dict[int, tuple[str, Record]] = {}
    for record in own:
        _, words = type_word(record, record.words())
        if len(words) != 1 or words[0][0] != "P":
            raise record.fail("a single value word P is due, e.g. P11")
        if record.number in parameters:
            raise record.fail(f"stands here a second time (first in line {parameters[record.number][1].line})")
        parameters[record.number] = words[0][1], record
    shape = _frame(machine, file, parameters) if parameters else beside
    if shape is None:
        raise file.fail("holds no parameters 10800 to 10814; give VOLUME.csv beside it, which has the grid")
    values = _values(settings, file, data)
    size = int(np.prod(shape.counts.shape[:3]))
    if len(values) != size:
        raise file.fail(
            f"holds {len(values)} points, the grid has {size}: is it truncated?", data[-1].line if data else 1
        )
    counts = np.zeros(shape.counts.shape, dtype=np.int64)
    for number, index in shape.numbered(settings.order):
        counts[index] = values[number - 1]
    return VolumeTable(shape.grids, counts, shape.magnification)


def _frame(machine: Machine, file: SourceFile, parameters: dict[int, tuple[str, Record]]) -> VolumeTable:
    """Empty table of the grid that the parameters describe."""
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
            raise record.fail(f"the interval {text} mm is not possible")
        start = Decimal(repr(machine.reference_point_mm[axis])) - (reference - 1) * step
        grids.append(Grid(start, step, count))
        magnification.append(whole(10809 + axis, 1, 100))
    counts = np.zeros((*(grid.count for grid in grids), 3), dtype=np.int64)
    return VolumeTable((grids[0], grids[1], grids[2]), counts, (magnification[0], magnification[1], magnification[2]))


def _values(settings: VolumeSettings, file: SourceFile, data: Sequence[Record]) -> list[list[int]]:
    """Three values of each point, in the order of the records' numbers."""
    found: list[list[int]] = []
    before: Record | None = None
    for record in sorted(data, key=lambda item: item.number):
        if before is not None and record.number != before.number + 1:
            same = record.number == before.number
            raise record.fail(
                f"stands here a second time (first in line {before.line})" if same else "a number before it is missing"
            )
        before, form = record, form_of(record)
        _, words = type_word(record, record.words())
        texts = [(letter, text) for letter, text in words]
        if form == "APAPAP":
            pairs = {int(Decimal(a[1])): p[1] for a, p in zip(texts[::2], texts[1::2], strict=True)}
            if sorted(pairs) != sorted(settings.axis_numbers):
                raise record.fail(f"has the axes {sorted(pairs)}; {sorted(settings.axis_numbers)} are due")
            texts = [("P", pairs[number]) for number in settings.axis_numbers]
        numbers = [record.whole(text, -MOST_VALUE, MOST_VALUE) for _, text in texts]
        if form == "P" and found and len(found[-1]) < 3:
            found[-1] += numbers
        else:
            found.append(numbers)
    if not found or len(found[-1]) != 3:
        raise file.fail("holds no complete point: is it truncated?", data[-1].line if data else 1)
    return found


def volume_violations(machine: Machine, settings: VolumeSettings, table: VolumeTable) -> list[str]:
    """Return values out of range, too many vertices, and travel that the grid leaves out."""
    messages = []
    for axis, grid in enumerate(table.grids):
        low, high = int(table.counts[..., axis].min()), int(table.counts[..., axis].max())
        if low < settings.value_low or high > settings.value_high:
            needed = int(np.ceil(table.magnification[axis] * max(low / settings.value_low, high / settings.value_high)))
            messages.append(
                f"the values of {AXES[axis]} go from {low} to {high}, the range is {settings.value_low} to "
                f"{settings.value_high}; set magnification.{AXES[axis]} = {needed} or more (coarser counts)"
            )
        if grid.count > settings.most_points:
            messages.append(f"{grid.count} vertices along {AXES[axis]}, at most {settings.most_points} are possible")
        first, last = float(grid.start), float(grid.last)
        messages += coverage_violations(machine, axis, first, last, "the grid")
    total = int(np.prod(table.counts.shape[:3]))
    if total > settings.most_in_all:
        messages.append(f"{total} vertices, at most {settings.most_in_all} are possible")
    return messages


def volume_usage(settings: VolumeSettings, table: VolumeTable) -> list[Usage]:
    """Return values and vertices against their limits; none of these is stated by a public document."""
    total = int(np.prod(table.counts.shape[:3]))
    found = [Usage("vertices", total, settings.most_in_all, "points", stated=False)]
    for axis, grid in enumerate(table.grids):
        low, high = int(table.counts[..., axis].min()), int(table.counts[..., axis].max())
        share = max(low / settings.value_low, high / settings.value_high, 0.0) * settings.value_high
        found.append(Usage(f"value of {AXES[axis]}", share, settings.value_high, "counts", stated=False))
        found.append(Usage(f"vertices along {AXES[axis]}", grid.count, settings.most_points, "points", stated=False))
    return found
