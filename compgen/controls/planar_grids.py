"""Planar grids of small controls: ``kmotion`` (corrected X and Y, offset of Z) and ``aerotech-2d`` (X and Y)."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compgen.controls.screw_maps import AerotechSettings
from compgen.controls.shared.base import Settings, SourceFile, Term, Usage, parameter_row
from compgen.controls.shared.grids import equidistant_grid, loss_setting, rounded
from compgen.controls.shared.scanner import check_complete, check_size, content_lines, fixed_point, floating
from compgen.controls.shared.tables import TableController, TableGrid
from compgen.controls.shared.terms import field_on_grid, one_dimensional_terms, product_terms
from compgen.data.csv_files import FloatArray, fixed
from compgen.data.error_table import ErrorTable
from compgen.data.machine import MM_PER_UNIT
from compgen.data.names import AXES
from compgen.data.toml_files import choice, setting, whole
from compgen.errors import InputError
from compgen.kinematics.first_order import tool_of

_MOST_CHARACTERS = 20_000_000
#: KMotion takes so many rows and columns.
KMOTION_MOST = 4000


def planar(start_mm: FloatArray, step_mm: FloatArray, added_mm: FloatArray, *, extends: bool = False) -> TableGrid:
    """Return corrections (columns, rows, 3) over X and Y; ``start_mm`` and ``step_mm`` are (2,), for X and Y."""
    return TableGrid((0, 1), (0, 1, 2), start_mm, step_mm, added_mm, extends=extends)


class PlanarControl(TableController[Settings, TableGrid]):
    """What the two have in common: a correction that depends on X and Y, whatever Z is."""

    #: Axes that are corrected; decimals of a number of the file in mm.
    outputs: Sequence[int] = (0, 1)
    digits = 6

    def grids(self, tables: TableGrid) -> Sequence[TableGrid]:
        """Return the one grid."""
        return [tables]

    @abstractmethod
    def read_grid(self, source: SourceFile) -> TableGrid:
        """Read the file."""

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return functions of X and of Y, and their products with the other one of the two; Z counts at mid-travel."""
        nodes = [
            equidistant_grid(
                self.machine,
                errors,
                axis,
                most=getattr(self.settings, "most_points", 0),
                loss_mm=getattr(self.settings, "loss_mm", 0.0),
            ).nodes_mm
            for axis in range(2)
        ]
        nodes.append(np.array(self.machine.axes[2].range_mm))
        middle = (0.5 * (self.machine.lower_mm + self.machine.upper_mm)).tolist()
        pairs = [(output, axis) for output in self.outputs for axis in range(2)]
        products = [
            term
            for term in product_terms(self.machine, errors, nodes, middle)
            if term.axis != 2 and all(part.lever != 2 and part.output in self.outputs for part in term.carrier)
        ]
        return one_dimensional_terms(self.machine, errors, nodes, pairs, lever_origin_mm=middle) + products

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> TableGrid:
        """Return the sum of the terms at each place, rounded as written."""
        nodes = [next(term.nodes_mm for term in basis if term.axis == axis) for axis in range(2)]
        lines_mm = {0: nodes[0], 1: nodes[1], 2: np.array([0.5 * sum(self.machine.axes[2].range_mm)])}
        added = field_on_grid(basis, values, lines_mm, tool_of(self.machine, None))[:, :, 0]
        start, step = np.array([[part[0] for part in nodes], [part[1] - part[0] for part in nodes]])
        return self.as_written(planar(start, step, added))

    def as_written(self, grid: TableGrid) -> TableGrid:
        """Return the grid as read back from its text."""
        return planar(*(rounded(part, self.digits) for part in (grid.start, grid.step, grid.values)))

    def parse(self, files: Sequence[SourceFile]) -> TableGrid:
        """Read the one file."""
        if len(files) != 1:
            message = f"{len(files)} files were given; expected one with the grid"
            raise files[1].fail(message, 1) if files else InputError(message)
        check_size(files[0], _MOST_CHARACTERS)
        return self.read_grid(files[0])

    def violations(self, tables: TableGrid) -> list[str]:
        """Return travel that the grid does not cover, and too many rows or columns."""
        found, most = [], getattr(self.settings, "most_points", 0)
        for axis, nodes in tables.spans:
            found += self.not_covered(axis, nodes, "the grid")
            if len(nodes) > most:
                found.append(f"the grid has {len(nodes)} positions of {AXES[axis]}; at most {most} are possible")
        return found

    def usage(self, tables: TableGrid) -> list[Usage]:
        """Return columns and rows against the limit."""
        most = getattr(self.settings, "most_points", 0)
        return [Usage(f"positions of {AXES[axis]}", tables.values.shape[axis], most, "points") for axis in range(2)]

    def resolution_mm(self) -> float:
        """Half of the last decimal: a bilinear value is a mean of four."""
        return 0.5 * 10.0**-self.digits

    def left_out(self, errors: ErrorTable) -> list[str]:
        """Say for which Z the grid holds."""
        height = 0.5 * sum(self.machine.axes[2].range_mm)
        return [
            f"the grid does not know Z: what changes with Z (errors of Z itself, the lever arm of angles along Z) is corrected "
            f"for the mean of the travel, Z {height:g} mm, only"
        ]

    def example(self, grid: TableGrid) -> str:
        """Return the place of the largest correction, and where the axes go for it."""
        column, row, axis = np.unravel_index(int(np.argmax(np.abs(grid.values))), grid.values.shape)
        place = np.array([grid.nodes_mm(0)[column], grid.nodes_mm(1)[row]])
        added = grid.values[column, row]
        return (
            f"Example: at X {place[0]:.4f} Y {place[1]:.4f} mm the control adds {fixed(float(added[axis]), 6)} mm to "
            f"{AXES[int(axis)]}; column {column}, row {row}."
        )


@dataclass(frozen=True)
class KmotionSettings:
    """Settings ``[controllers.kmotion]``."""

    units: str = setting(
        choice(*MM_PER_UNIT),
        "inch",
        meaning="unit of the numbers in the file: that in which the interpreter passes positions to the kinematics",
    )
    most_points: int = setting(whole(2, KMOTION_MOST), 100, meaning="largest number of rows and of columns")
    loss_mm: float = loss_setting()


class Kmotion(PlanarControl[KmotionSettings]):
    """``kmotion``: the geometric correction file of KMotion and KFLOP."""

    name = "kmotion"
    settings_class = KmotionSettings
    outputs, digits = (0, 1, 2), 7

    def as_written(self, grid: TableGrid) -> TableGrid:
        """Return the grid as read back: the file has the corrected places in its unit."""
        unit, quantum = MM_PER_UNIT[self.settings.units], 10.0**-self.digits
        # the first place is rounded down and the spacing up, so that the travel stays within the grid
        count = np.array(grid.values.shape[:2]) - 1
        last = grid.start + count * grid.step
        start = rounded(np.floor(np.round(grid.start / unit / quantum, 3)) * quantum, self.digits)
        step = rounded(np.ceil(np.round((last / unit - start) / count / quantum, 3)) * quantum, self.digits)
        places = self._places(planar(start * unit, step * unit, grid.values)) / unit
        return self._from_places(start, step, rounded(places, self.digits))

    def _places(self, grid: TableGrid) -> FloatArray:
        """Corrected X and Y, and the offset of Z, at each place, (columns, rows, 3), mm."""
        places = grid.values.copy()
        places[..., 0] += grid.nodes_mm(0)[:, None]
        places[..., 1] += grid.nodes_mm(1)[None, :]
        return places

    def _from_places(self, start: FloatArray, step: FloatArray, places: FloatArray) -> TableGrid:
        """Return the grid from numbers in the unit of the file."""
        unit = MM_PER_UNIT[self.settings.units]
        nothing = planar(start * unit, step * unit, np.zeros_like(places), extends=True)
        return replace(nothing, values=places * unit - self._places(nothing))

    def context(self, tables: TableGrid) -> dict[str, Any]:
        """Return rows, columns, spacing, origin and the corrected places, in the unit of the file."""
        unit = MM_PER_UNIT[self.settings.units]
        places = self._places(tables) / unit
        columns, rows = places.shape[:2]
        return {
            "sign_statement": (
                "The file has the corrected place of each position: the control moves X and Y there, and adds the third "
                f"number to Z. All numbers are in {self.settings.units}. {self.example(tables)}"
            ),
            "parameters": [
                parameter_row(
                    "unit of the file", self.settings.units, "must be that of the kinematics of the interpreter"
                )
            ],
            "warnings": [
                "Outside the grid the control extrapolates from the nearest cell, without a limit: keep within the travel."
            ],
            "columns": columns,
            "rows": rows,
            "start": (tables.start / unit).tolist(),
            "step": np.asarray(tables.step / unit).tolist(),
            "places": [
                [row, column, *places[column, row].tolist()] for row in range(rows) for column in range(columns)
            ],
            "units": self.settings.units,
        }

    def read_grid(self, source: SourceFile) -> TableGrid:
        """Read the numbers separated by commas; each place of the grid must be given once."""
        lines = content_lines(source, "#")
        words = [(line, word.strip()) for line, text in lines for word in text.strip(", ").split(",")]
        if len(words) < 6:
            raise source.fail("expected rows, columns, spacing and origin", lines[-1][0])
        size = [int(word) if re.fullmatch(r"[0-9]{1,4}", word) else 0 for _, word in words[:2]]
        if not all(2 <= count <= KMOTION_MOST for count in size):
            raise source.fail(f"expected 2 to {KMOTION_MOST} rows and columns, got {words[0][1][:9]!r}", words[0][0])
        step, start = (
            np.array([floating(source, *words[k], "spacing or origin") for k in pair]) for pair in ((2, 3), (4, 5))
        )
        if np.any(step <= 0.0):
            raise source.fail("the spacing must be above zero", words[2][0])
        rest = words[6:]
        if len(rest) != 5 * size[0] * size[1]:
            message = f"{len(rest)} numbers after the header; {size[0]} x {size[1]} places need {5 * size[0] * size[1]}"
            raise source.fail(message, (rest or words)[-1][0])
        places = np.full((size[1], size[0], 3), np.nan)
        for k in range(0, len(rest), 5):
            line, (row, column) = rest[k][0], (word for _, word in rest[k : k + 2])
            if not (re.fullmatch(r"[0-9]{1,4}", row) and re.fullmatch(r"[0-9]{1,4}", column)):
                raise source.fail(f"expected a row and a column, got {row[:9]!r}, {column[:9]!r}", line)
            if int(row) >= size[0] or int(column) >= size[1]:
                raise source.fail(f"row {row}, column {column} is not in a grid of {size[0]} x {size[1]}", line)
            if np.isfinite(places[int(column), int(row), 0]):
                raise source.fail(f"row {row}, column {column} is given a second time", line)
            places[int(column), int(row)] = [floating(source, *item, "a coordinate") for item in rest[k + 2 : k + 5]]
        return self._from_places(start, step, places)

    def resolution_mm(self) -> float:
        """Half of the last decimal of place, spacing and origin."""
        return 1.5 * MM_PER_UNIT[self.settings.units] * 10.0**-self.digits


@dataclass(frozen=True)
class Aerotech2dSettings(AerotechSettings):
    """Settings ``[controllers.aerotech-2d]``: those of the axes, as for one-dimensional tables, and the size of the table."""

    most_points: int = setting(whole(2, 1000), 100, meaning="largest number of rows and of columns")


class Aerotech2d(PlanarControl[Aerotech2dSettings]):
    """``aerotech-2d``: two-dimensional axis calibration of A3200 and Automation1."""

    name = "aerotech-2d"
    settings_class = Aerotech2dSettings

    @property
    def ways(self) -> FloatArray:
        """Return +1 for X and Y, or -1 where the encoder counts against the axis, shape (2,)."""
        return np.array([self.settings.way(axis) for axis in range(2)])

    def context(self, tables: TableGrid) -> dict[str, Any]:
        """Return the header and, for each row of Y, the pairs of each column, in the direction of the encoders."""
        ways, numbers = self.ways, self.settings.axis_numbers
        sample, offset = ways * tables.step, -ways * tables.start
        pairs = ways * tables.values[..., :2]
        return {
            "sign_statement": (
                "A pair is the correction of X and Y, minus the measured error, in mm; the control ADDS it (inferred, see "
                f"below). {self.example(tables)}"
            ),
            "parameters": [
                parameter_row(
                    f"axis number of {AXES[axis]}", str(numbers[axis]), f"reversed_axes.{AXES[axis]} = {turned}".lower()
                )
                for axis, turned in enumerate(self.settings.reversed_axes[:2])
            ],
            "warnings": [],
            "numbers": numbers,
            "columns": tables.values.shape[0],
            "records": tables.values[..., 0].size,
            "sample": sample.tolist(),
            "offset": offset.tolist(),
            "lines": [[part for pair in line for part in pair] for line in pairs.transpose(1, 0, 2).tolist()],
        }

    def read_grid(self, source: SourceFile) -> TableGrid:
        """Read ``:START2D`` with its seven numbers and keys, the rows, and ``:END``."""
        keys: dict[str, float] = {}
        header: list[float] = []
        values: list[float] = []
        begun, ended = 0, False
        for line, text in content_lines(source, "'"):
            words = text.split()
            if ended or (not begun and words[0].upper() != ":START2D"):
                raise source.fail(f"expected {'nothing after :END' if ended else ':START2D'}, got {text[:40]!r}", line)
            if words[0].upper() == ":START2D":
                begun = begun or line
                for word in words[1:]:
                    key, _, number = word.upper().partition("=")
                    if not number and len(header) < 7:
                        header.append(float(fixed_point(source, line, word, "a number of the header")))
                    elif (key, number) in (("POSUNIT", "PRIMARY"), ("CORUNIT", "PRIMARY")):
                        keys.setdefault("unit", 1.0)
                    elif (key, number) == ("CORUNIT", "PRIMARY/1000"):
                        keys["unit"] = 1e-3
                    elif key in ("OFFSETROW", "OFFSETCOL") and key not in keys:
                        keys[key] = float(fixed_point(source, line, number, key))
                    else:
                        raise source.fail(
                            f"{word[:40]!r} is not understood or given twice; it may change the table", line
                        )
            elif words == [":END"]:
                ended = True
            else:
                values += [float(fixed_point(source, line, word, "a correction value")) for word in words]
        if not ended or len(header) < 7 or not {"OFFSETROW", "OFFSETCOL"} <= set(keys):
            raise source.fail(
                "needs seven numbers after :START2D, OFFSETROW, OFFSETCOL and :END; is it truncated?", begun
            )
        numbers = [float(number) for number in self.settings.axis_numbers]
        if header[:4] != [numbers[1], numbers[0], numbers[0], numbers[1]]:
            message = f"row, column and output axes are {header[:4]}; expected those of Y, X, X and Y in axis_numbers"
            raise source.fail(message, begun)
        columns = int(header[6])
        if columns < 2 or len(values) % (2 * columns) or len(values) < 4 * columns:
            raise source.fail(
                f"{len(values)} values do not fill rows of {columns} pairs; is the file truncated?", begun
            )
        check_complete(source, len(values) // 2)
        step = self.ways * np.array([header[5], header[4]])
        if np.any(step <= 0.0):
            raise source.fail("the signs of the sample distances do not fit reversed_axes of the machine file", begun)
        start = -self.ways * np.array([keys["OFFSETCOL"], keys["OFFSETROW"]])
        pairs = np.array(values).reshape(-1, columns, 2).transpose(1, 0, 2) * self.ways * keys.get("unit", 1.0)
        return planar(start, step, np.concatenate([pairs, np.zeros((*pairs.shape[:2], 1))], axis=2))
