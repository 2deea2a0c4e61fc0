"""Geometric errors and reversal as curves over the axis position, read and written; bases of such curves.

Identification, fit and export pass on :class:`ErrorTable`: 18 curves and 3 squareness errors in mm and rad. Files are
in um and urad (``*.errors.csv``). :class:`ReversalCurves` adds the difference between both directions of travel
(``*.reversal.csv``).
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import numbers, of_kind
from compgen.data.csv_files import CsvTable, FloatArray, csv_table, format_csv, read_csv
from compgen.data.files import read_text
from compgen.data.names import (
    AXES,
    CURVE_NAMES,
    ERROR_INDEX,
    ERROR_NAMES,
    LARGEST,
    MM_PER_UM,
    SQUARENESS_NAMES,
    error_named,
)
from compgen.data.records import axes_of, within
from compgen.drawing.display import Displayed, Drawable, Overview, Panel, PlottedLine, Tabular, package, shortened
from compgen.errors import CompgenWarning, InputError, nearest, repeated

K = TypeVar("K", bound=Hashable)

# Geometric errors as tables over the axis position: the object that identify, fit and export pass on.


#: Columns that an ``*.errors.csv`` file must have.
ERROR_COLUMNS = ("error", "position_mm", "value")


#: Names of errors of rotary axes, which :mod:`compgen.data.rotary` reads.
_OF_ROTARY_AXES = re.compile(r"E[XYZABC]0?[ABC]|T[XYZ]")


@dataclass(frozen=True, repr=False)
class Curve(Displayed):
    """One error over its axis: ``position_mm`` ascending, ``value`` and standard uncertainty ``u`` in mm or rad.

    All three have shape (n,); ``u`` is nan if unknown. Linear between positions, constant outside.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> curve = compgen.Curve(np.array([0.0, 100.0]), np.array([0.0, 5e-3]), np.array([0.0, 1e-4]))
    >>> curve.at(np.array([50.0, 200.0])).tolist()
    [0.0025, 0.005]
    """

    position_mm: FloatArray
    value: FloatArray
    u: FloatArray

    def __post_init__(self) -> None:
        for name, how in (("position_mm", {"finite": False}), ("value", {}), ("u", {"unknown": True, "least": 0.0})):
            object.__setattr__(self, name, numbers(name, getattr(self, name), None, **how))
        if not len(self.position_mm) == len(self.value) == len(self.u) > 0:
            sizes = f"{len(self.position_mm)}, {len(self.value)}, {len(self.u)}"
            raise InputError(
                f"lengths differ: {sizes}; expected one value and one u for each position", field="value, u"
            )
        ascending = self.position_mm[1:] > self.position_mm[:-1]
        if not (ascending.all() and np.isfinite(self.position_mm).all()):
            raise InputError("positions of a curve must be finite and ascending", field="position_mm")

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Value at the given positions, same shape."""
        return np.interp(position_mm, self.position_mm, self.value)

    def overview(self) -> Overview:
        """Range and number of the positions; the unit of the values, mm or rad, is not part of a curve."""
        ends = f"{self.position_mm[0]:g} to {self.position_mm[-1]:g} mm"
        largest = float(np.max(np.abs(self.value)))
        return Overview(f"{len(self.position_mm)} positions from {ends}, largest size {largest:.4g} (mm or rad)")


def _line(name: str, curve: Curve) -> PlottedLine:
    """A curve in um or urad."""
    unit = error_named(name).si_per_unit
    return PlottedLine(name, curve.position_mm, curve.value / unit, curve.u / unit)


@dataclass(frozen=True, repr=False)
class ErrorTable(Drawable, Tabular):
    """Some or all of the 21 errors of a machine, in mm and rad; an error that is absent is zero.

    ``curves`` holds the 18 functions by name, ``squareness`` the constants by name as (value, uncertainty).

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> positioning = compgen.Curve(np.array([0.0, 100.0]), np.array([0.0, 5e-3]), np.array([0.0, 1e-4]))
    >>> errors = compgen.ErrorTable({"EXX": positioning}, {"EC0Y": (30e-6, 1e-6)})
    >>> errors
    <ErrorTable: 2 errors: EXX, EC0Y>
    >>> errors.only("EC0Y").names
    ('EC0Y',)
    """

    curves: Mapping[str, Curve] = field(default_factory=dict)
    squareness: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for field_name, given, allowed, what in (
            ("curves", self.curves, CURVE_NAMES, "18 errors that are functions"),
            ("squareness", self.squareness, SQUARENESS_NAMES, "3 squareness errors"),
        ):
            of_kind(field_name, given, Mapping)
            for name in given:
                if name not in allowed:
                    raise InputError(f"{name!r} is not one of the {what}", field=field_name)
        of_kind("metadata", self.metadata, Mapping)
        for name, curve in self.curves.items():
            of_kind(f"curves[{name}]", curve, Curve)
        for name, pair in self.squareness.items():
            value, u = numbers(f"squareness[{name}]", pair, 2, unknown=True).tolist()
            if not np.isfinite(value) or u < 0.0:
                expected = "value and standard uncertainty of zero or more (nan: unknown), rad"
                raise InputError(f"is ({value:g}, {u:g}); expected {expected}", field=f"squareness[{name}]")

    def to_columns(self) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of ``*.errors.csv``: values in um and urad, each (n,); no position for squareness."""
        names: list[str] = []
        rows: list[FloatArray] = [np.empty((0, 3))]
        for name in self.names:
            unit = error_named(name).si_per_unit
            if name in self.squareness:
                found = np.array([[np.nan, *self.squareness[name]]])
            else:
                curve = self.curves[name]
                found = np.column_stack([curve.position_mm, curve.value, curve.u])
            names += [name] * len(found)
            rows.append(found / [1.0, unit, unit])
        position_mm, value, u_value = np.concatenate(rows).T
        return {"error": names, "position_mm": position_mm, "value": value, "u_value": u_value}

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset``: each curve over the positions of its axis, with ``u_NAME``; squareness without any.

        Curves of one axis at the same positions share the coordinate (``x_mm``), another one has its own (``EXX_mm``). ``units``
        of each variable is um or urad, as in files.

        Raises
        ------
        ImportError
            if xarray is not installed.
        """
        xarray = package("xarray", "to_xarray()")
        made: dict[str, Any] = {}
        places: dict[str, FloatArray] = {}
        for name in self.names:
            own = error_named(name)
            attributes = {"units": own.unit}
            if name in self.squareness:
                pair = np.array(self.squareness[name]) / own.si_per_unit
                made |= {name: ((), pair[0], attributes), f"u_{name}": ((), pair[1], attributes)}
                continue
            curve, place = self.curves[name], f"{'xyz'[own.axis]}_mm"
            if not np.array_equal(places.setdefault(place, curve.position_mm), curve.position_mm):
                place = f"{name}_mm"
                places[place] = curve.position_mm
            made[name] = (place, curve.value / own.si_per_unit, attributes)
            made[f"u_{name}"] = (place, curve.u / own.si_per_unit, attributes)
        return xarray.Dataset(made, coords=places, attrs=dict(self.metadata))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the errors that are present, in the order of the columns of C."""
        return tuple(name for name in ERROR_NAMES if name in self.curves or name in self.squareness)

    def at(self, position_mm: FloatArray) -> FloatArray:
        """All 21 errors P at axis positions of shape (n, 3): shape (n, 21), mm and rad, absent ones zero."""
        position_mm = np.asarray(position_mm, dtype=np.float64)
        values = np.zeros((len(position_mm), len(ERROR_NAMES)))
        for name, curve in self.curves.items():
            values[:, ERROR_INDEX[name]] = curve.at(position_mm[:, error_named(name).axis])
        for name, (value, _) in self.squareness.items():
            values[:, ERROR_INDEX[name]] = value
        return values

    def warn_outside(self, position_mm: FloatArray) -> None:
        """Warn when positions of shape (n, 3) leave the range of a curve, whose end value is then used."""
        for name, curve in self.curves.items():
            along = position_mm[:, error_named(name).axis]
            low, high = curve.position_mm[0], curve.position_mm[-1]
            if len(curve.position_mm) > 1 and (along.min() < low - 1e-6 or along.max() > high + 1e-6):
                warnings.warn(
                    f"{name} is known from {low:g} to {high:g} mm, but positions range from {along.min():g} to "
                    f"{along.max():g} mm; its end values are used outside",
                    CompgenWarning,
                    stacklevel=3,
                )
                return

    def only(self, *names: str) -> ErrorTable:
        """Return a table with just the errors ``names``; the others are zero."""
        return ErrorTable(
            {name: curve for name, curve in self.curves.items() if name in names},
            {name: value for name, value in self.squareness.items() if name in names},
            self.metadata,
        )

    def values(self) -> FloatArray:
        """All values in the order of the names, (k,), mm and rad; a squareness counts as one value."""
        return self._stacked(
            [(self.squareness[n][0],) if n in self.squareness else self.curves[n].value for n in self.names]
        )

    def uncertainties(self) -> FloatArray:
        """Standard uncertainties in the order of :meth:`values`, (k,), mm and rad; nan if unknown."""
        return self._stacked(
            [(self.squareness[n][1],) if n in self.squareness else self.curves[n].u for n in self.names]
        )

    @staticmethod
    def _stacked(parts: Sequence[Sequence[float] | FloatArray]) -> FloatArray:
        return np.concatenate([np.zeros(0), *(np.asarray(part) for part in parts)])

    def rows(self) -> dict[str, slice]:
        """Slice of the values of each error in :meth:`values`."""
        found, first = {}, 0
        for name in self.names:
            count = 1 if name in self.squareness else len(self.curves[name].value)
            found[name] = slice(first, first + count)
            first += count
        return found

    def labels(self) -> tuple[tuple[str, ...], FloatArray]:
        """Name and position in mm of each of :meth:`values`, (k,); nan for squareness."""
        names = [name for name, rows in self.rows().items() for _ in range(rows.start, rows.stop)]
        at = [(np.nan,) if name in self.squareness else self.curves[name].position_mm for name in self.names]
        return tuple(names), self._stacked(at)

    def with_values(self, values: FloatArray | None = None, u: FloatArray | None = None) -> ErrorTable:
        """Return the table with other values or uncertainties (k,), in the order of :meth:`values`."""
        values = self.values() if values is None else values
        u = self.uncertainties() if u is None else u
        curves, squareness = {}, {}
        for name, rows in self.rows().items():
            if name in self.squareness:
                squareness[name] = (float(values[rows][0]), float(u[rows][0]))
            else:
                curves[name] = Curve(self.curves[name].position_mm, values[rows], u[rows])
        return ErrorTable(curves, squareness, self.metadata)

    def replace(
        self,
        *,
        curves: Mapping[str, Curve] | None = None,
        squareness: Mapping[str, tuple[float, float]] | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> ErrorTable:
        """Return a copy with the given parts replaced."""
        return ErrorTable(
            self.curves if curves is None else curves,
            self.squareness if squareness is None else squareness,
            self.metadata if metadata is None else metadata,
        )

    def overview(self) -> Overview:
        """Largest value of each error with its position, and its largest standard uncertainty."""
        machine = f" of {self.metadata['machine']}" if "machine" in self.metadata else ""
        count = f"{len(self.names)} error{'s' * (len(self.names) != 1)}"
        title = f"{count}{machine}: {shortened(self.names)}" if self.names else "no errors"
        rows = tuple(self._row(name) for name in self.names)
        return Overview(title, ("error", "largest", "at (mm)", "u (k = 1)", "unit"), rows)

    def _row(self, name: str) -> tuple[str, str, str, str, str]:
        error = error_named(name)
        if name in self.squareness:
            largest, u = self.squareness[name]
            place = ""
        else:
            curve = self.curves[name]
            k = int(np.argmax(np.abs(curve.value)))
            largest, u, place = float(curve.value[k]), float(np.max(curve.u)), f"{curve.position_mm[k]:g}"
        known = "" if np.isnan(u) else f"{u / error.si_per_unit:.3f}"
        return name, f"{largest / error.si_per_unit:+.3f}", place, known, error.unit

    def panels(self) -> Sequence[Panel]:
        """Translations and rotations of each axis over its position; squareness errors are constants and not drawn."""
        panels = []
        for axis, letter in enumerate(AXES):
            for unit in ("um", "urad"):
                names = [name for name in self.names if name in self.curves and error_named(name).axis == axis]
                lines = tuple(_line(name, self.curves[name]) for name in names if error_named(name).unit == unit)
                if lines:
                    panels.append(Panel(f"errors of {letter}", f"error ({unit})", lines, x_label=f"{letter} (mm)"))
        return panels


# The line of a straightness: how a straightedge lay, unless something says what it was aligned to.


#: The comment ``# squareness = ...`` of errors whose lines and constants say nothing about squareness: of a straightedge and a
#: level, or of separate sheets for straightness and squareness.
SQUARENESS_APART = "measured apart from straightness"
#: Straightness curves of each pair of axes: as two arms of one square their lines show the squareness, one alone does not.
ARMS = {"EC0Y": ("EYX", "EXY"), "EB0Z": ("EZX", "EXZ"), "EA0Z": ("EZY", "EYZ")}

#: Slope and standard uncertainty of the lines of straightness curves, rad.
Lines = Mapping[str, tuple[float, float]]


#: Comment of a table: lengths, mm, of the arms of the squares that its squareness errors were read from.
SPANS_KEY = "squareness_span_mm"


def format_spans(spans_mm: Mapping[str, tuple[float, float]]) -> str:
    """Return the comment :data:`SPANS_KEY`.

    >>> format_spans({"EC0Y": (300.0, 200.0)})
    'EC0Y 300 200'
    """
    return "; ".join(f"{name} {first:g} {second:g}" for name, (first, second) in spans_mm.items())


def square_spans_mm(table: ErrorTable) -> dict[str, tuple[float, float]]:
    """Return the lengths of the two arms, in the order of :data:`ARMS`, of each square that a table was read from.

    Raises
    ------
    InputError
        for a comment that is not understood.
    """
    found = {}
    for entry in filter(None, (part.strip() for part in table.metadata.get(SPANS_KEY, "").split(";"))):
        match = re.fullmatch(r"(E[ABC]0[YZ])\s+([0-9.]{1,12})\s+([0-9.]{1,12})", entry)
        try:
            spans = (float(match[2]), float(match[3])) if match and match[1] in ARMS else None
        except ValueError:
            spans = None
        if match is None or spans is None or not 0 < min(spans) <= max(spans) < LARGEST:
            text = f"{entry[:60]!r} is not a squareness error and the lengths of two arms in mm, such as EC0Y 300 300"
            raise InputError(text, field=SPANS_KEY)
        found[match[1]] = spans
    return found


def is_apart(table: ErrorTable) -> bool:
    """Whether a table says that its lines and constants are not of the machine."""
    return table.metadata.get("squareness") == SQUARENESS_APART


def marked_apart(table: ErrorTable) -> ErrorTable:
    """Return errors read by an instrument, marked as apart if neither squareness nor both arms of a square are among them."""
    related = table.squareness or any(set(pair) <= set(table.curves) for pair in ARMS.values())
    moved = any(name != f"E{name[2]}{name[2]}" for name in table.curves)
    return table if related or not moved else table.replace(metadata={**table.metadata, "squareness": SQUARENESS_APART})


def about_own_lines(table: ErrorTable, without: Collection[str] = ()) -> tuple[ErrorTable, Lines]:
    """Return a table whose straightness is zero at its own ends, with the noise of these, and the lines that were removed.

    The curves ``without`` stay as they are, also those of a single position.
    """
    curves, lines = dict(table.curves), {}
    for name, curve in table.curves.items():
        if not error_named(name).is_straightness or name in without or len(curve.value) < 2:
            continue
        ends, span_mm = curve.value[[0, -1]], float(np.ptp(curve.position_mm))
        lines[name] = float(ends[1] - ends[0]) / span_mm, float(np.hypot(*curve.u[[0, -1]])) / span_mm
        if not ends.any() and not curve.u[[0, -1]].any():
            continue  # zero by definition
        share = (curve.position_mm - curve.position_mm[0]) / span_mm
        value = curve.value - np.column_stack([1.0 - share, share]) @ ends
        u = np.sqrt(curve.u**2 + ((1.0 - share) * curve.u[0]) ** 2 + (share * curve.u[-1]) ** 2)
        value[[0, -1]] = u[[0, -1]] = 0.0
        curves[name] = Curve(curve.position_mm, value, u)
    return table.replace(curves=curves), lines


def read_errors(path: str | Path) -> ErrorTable:
    """Read an ``*.errors.csv`` file of the contract (um and urad) into an :class:`ErrorTable` (mm and rad).

    Examples
    --------
    >>> import compgen
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> len(errors.names), round(1e6 * errors.squareness["EC0Y"][0], 3)
    (17, 2903.269)
    """
    return parse_errors(read_text(path), Path(path))


def parse_errors(text: str, source: Path) -> ErrorTable:
    """Read the text of an ``*.errors.csv`` file like :func:`read_errors`; ``source`` is the name in messages."""
    return errors_of_table(csv_table(source, text, required=ERROR_COLUMNS, optional=("u_value", "position_deg")))


def errors_of_table(table: CsvTable) -> ErrorTable:
    """Return the errors (mm and rad) of a CSV table with the columns of an ``*.errors.csv`` file (um and urad)."""
    names = table.text("error")
    values = table.numbers("value")
    u_values = _uncertainties(table, "u_value")
    positions_mm = table.numbers("position_mm", empty=np.nan)
    curves: dict[str, Curve] = {}
    squareness: dict[str, tuple[float, float]] = {}
    for row, name in enumerate(names):
        if name not in ERROR_INDEX:
            if _OF_ROTARY_AXES.fullmatch(name):
                raise table.fail(
                    row,
                    "error",
                    f"{name!r} is an error of a rotary axis; here are those of X, Y and Z only: give linear.errors.csv, which "
                    "identify writes beside it if the linear axes were measured, too; predict takes both, and export and verify "
                    "for controls of rotary axes (docs/five-axis.md)",
                )
            known = nearest(name, ERROR_NAMES)
            raise table.fail(row, "error", f"{name!r} is not an error of ISO 230-1 here; {known}")
    for name, rows in _grouped(names).items():
        unit = error_named(name).si_per_unit
        if name in SQUARENESS_NAMES:
            if len(rows) > 1:
                first = f"first in line {table.lines[rows[0]]}"
                raise table.fail(rows[1], "error", f"{name} appears a second time ({first})")
            if table.columns["position_mm"][rows[0]]:
                raise table.fail(rows[0], "position_mm", f"{name} is a constant; leave its position empty")
            squareness[name] = (float(values[rows[0]]) * unit, float(u_values[rows[0]]) * unit)
        else:
            for row in rows[np.isnan(positions_mm[rows])]:
                raise table.fail(row, "position_mm", f"is empty; {name} is a function and needs a position in mm")
            picked = _ascending(table, name, rows, positions_mm)
            curves[name] = Curve(positions_mm[picked], values[picked] * unit, u_values[picked] * unit)
    return ErrorTable(curves, squareness, {key: value for key, value in table.metadata.items() if key != "rows"})


def _grouped(keys: Iterable[K]) -> dict[K, NDArray[np.int64]]:
    """Return the rows of each key, in the order of their first rows."""
    rows: dict[K, list[int]] = {}
    for row, key in enumerate(keys):
        rows.setdefault(key, []).append(row)
    return {key: np.array(found) for key, found in rows.items()}


def _ascending(table: CsvTable, name: str, rows: NDArray[np.int64], positions_mm: FloatArray) -> NDArray[np.int64]:
    """Return the rows of a curve in order of position; each position occurs once."""
    twice = repeated(positions_mm[rows].tolist())
    if twice is not None:
        first, row = rows[list(twice)]
        message = f"{name} has a value at {positions_mm[row]:g} mm already in line {table.lines[first]}"
        raise table.fail(row, "position_mm", message)
    return rows[np.argsort(positions_mm[rows])]


def _uncertainties(table: CsvTable, column: str) -> FloatArray:
    """Return an optional column of standard uncertainties, nan for empty cells."""
    if column not in table.columns:
        return np.full(len(table), np.nan)
    values = table.numbers(column, empty=np.nan)
    for row in np.flatnonzero(values < 0)[:1]:
        raise table.fail(
            int(row), column, f"{values[row]:g} is negative; expected a standard uncertainty of zero or more"
        )
    return values


def format_errors(errors: ErrorTable, metadata: Mapping[str, object] | None = None) -> str:
    """Return the text of an ``*.errors.csv`` file; values in um and urad with 9 decimals.

    Examples
    --------
    >>> import compgen
    >>> text = compgen.format_errors(compgen.ErrorTable(squareness={"EC0Y": (30e-6, 1e-6)}))
    >>> print(text.splitlines()[-1])
    EC0Y,,30.000000000,1.000000000
    """
    of_kind("errors", errors, ErrorTable)
    columns = errors.to_columns()
    digits = {"position_mm": 6, "value": 9, "u_value": 9}
    return format_csv(columns, {**errors.metadata, **(metadata or {})}, digits)


# Reversal of each axis over its position: ``*.reversal.csv``, what a control needs in addition to the mean errors of
# both directions.
#
# The reversal value B is that of ISO 230-2: the position reached moving in positive direction minus the one reached
# moving in negative direction. The error curves are the means of both, so the tool is at +B/2 after positive travel and
# at -B/2 after negative travel, relative to the curves.


#: A larger reversal is rejected as a wrong unit, um.
LARGEST_UM = 1000.0
#: A smaller reversal is not worth a table, mm.
WORTH_MM = 0.1 * MM_PER_UM
#: A reversal below this many standard uncertainties is not removed from the readings.
SIGNIFICANT = 5.0
#: No machine tool has more; a larger number has another unit.
LARGEST_MM, LARGEST_RAD = 2.0, 0.1
_PAIRS_OF_AXES = frozenset((axis, component) for axis in range(3) for component in range(3))


@dataclass(frozen=True, repr=False)
class ReversalCurves(Displayed):
    """Reversal values in mm by (axis that travels, component of the tip's displacement), both 0..2.

    A curve with one position is constant over the travel. Missing ones are zero.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> backlash = compgen.Curve(np.zeros(1), np.array([-8e-3]), np.zeros(1))  # X stops 8 um short: constant, negative
    >>> reversal = compgen.ReversalCurves({(0, 0): backlash})
    >>> reversal.displacement(np.zeros((2, 3)), np.array([[1, 0, 0], [-1, 0, 0]]))[:, 0].tolist()
    [-0.004, 0.004]
    """

    curves: Mapping[tuple[int, int], Curve]
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        of_kind("curves", self.curves, Mapping)
        of_kind("metadata", self.metadata, Mapping)
        for key, curve in self.curves.items():
            if key not in _PAIRS_OF_AXES:
                expected = "(axis that travels, component), both 0, 1 or 2 for X, Y, Z"
                raise InputError(f"the key {key!r} is not {expected}", field="curves")
            of_kind(f"curves[{key}]", curve, Curve)

    def displacement(
        self, position_mm: FloatArray, approach: FloatArray, taken_up: FloatArray | float = 1.0
    ) -> FloatArray:
        """Return the displacement of the tip from the mean of both directions, shape (n, 3), mm.

        Parameters
        ----------
        position_mm : commanded positions, shape (n, 3).
        approach : last direction of travel of each axis, shape (n, 3): +1, -1, or 0 (unknown: the mean).
        taken_up : 1 where an axis has taken up its slack, -1 where it has just turned, shape (n, 3); by default all.
        """
        moved, share = np.zeros((len(position_mm), 3)), np.sign(approach) * taken_up
        for (axis, component), curve in self.curves.items():
            moved[:, component] += 0.5 * share[:, axis] * curve.at(position_mm[:, axis])
        return moved

    def mean_mm(self, axis: int) -> float:
        """Return the mean of an axis' reversal along itself over its positions, 0 if there is none."""
        curve = self.curves.get((axis, axis))
        return 0.0 if curve is None else float(np.mean(curve.value))

    def without(self, other: ReversalCurves) -> ReversalCurves:
        """Return the curves that are not in ``other``."""
        return ReversalCurves({key: curve for key, curve in self.curves.items() if key not in other.curves})

    @property
    def largest_mm(self) -> dict[tuple[int, int], float]:
        """Reversal of the largest magnitude of each curve, with its sign."""
        return {key: float(curve.value[np.argmax(np.abs(curve.value))]) for key, curve in self.curves.items()}

    def overview(self) -> Overview:
        """Range of the reversal value of each axis and component."""
        rows = tuple(
            (
                AXES[axis],
                AXES[component],
                f"{curve.value.min() / MM_PER_UM:+.3f} ... {curve.value.max() / MM_PER_UM:+.3f}",
            )
            for (axis, component), curve in self.curves.items()
        )
        found = [f"{AXES[axis]}{'' if axis == component else AXES[component]}" for axis, component in self.curves]
        return Overview(f"reversal of {', '.join(found) or 'no axis'}", ("axis", "component", "reversal (um)"), rows)


def reversal_name(axis: int, component: int) -> str:
    """Name in messages, e.g. ``reversal X`` or ``reversal X in y`` for the displacement across.

    >>> reversal_name(0, 0), reversal_name(0, 1)
    ('reversal X', 'reversal X in Y')
    """
    return f"reversal {AXES[axis]}" + ("" if axis == component else f" in {AXES[component]}")


def read_reversal(path: str | Path) -> ReversalCurves:
    r"""Read a ``*.reversal.csv`` file (um) into :class:`ReversalCurves` (mm).

    Columns ``axis``, ``position_mm`` (empty: constant over the travel), ``value_um``; optional ``u_value_um`` and
    ``component`` (X, Y, Z; default the axis itself).

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import compgen
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "x.reversal.csv"
    ...     with path.open("w") as file:
    ...         print("axis,position_mm,value_um", "X,,-8", sep="\n", file=file)
    ...     reversal = compgen.read_reversal(path)
    >>> reversal.mean_mm(0)
    -0.008
    """
    table = read_csv(path, ("axis", "position_mm", "value_um"), ("u_value_um", "component"))
    axes = axes_of(table, "axis")
    components = axes_of(table, "component") if "component" in table.columns else axes
    position_mm = table.numbers("position_mm", empty=np.nan)
    value_um = within(LARGEST_UM, "um", f"not a reversal of a machine tool; expected um, at most {LARGEST_UM:g}")(
        table, "value_um"
    )
    u_um = _uncertainties(table, "u_value_um")
    curves = {}
    for key, rows in _grouped(zip(axes.tolist(), components.tolist(), strict=True)).items():
        name = reversal_name(*key)
        for row in rows[np.isnan(position_mm[rows])] if len(rows) > 1 else ():
            what = f"is empty, and {name} has {len(rows)} rows; a constant has one row, a function a position in each"
            raise table.fail(row, "position_mm", what)
        picked = _ascending(table, name, rows, position_mm)
        curves[key] = Curve(np.nan_to_num(position_mm[picked]), value_um[picked] * MM_PER_UM, u_um[picked] * MM_PER_UM)
    return ReversalCurves(curves, {key: value for key, value in table.metadata.items() if key != "rows"})


def format_reversal(reversal: ReversalCurves, metadata: Mapping[str, object] | None = None) -> str:
    """Return the text of a ``*.reversal.csv`` file; values in um with 6 decimals, constants without a position."""
    rows: list[tuple[int, int, float, float, float]] = []
    for (axis, component), curve in sorted(reversal.curves.items()):
        constant = len(curve.position_mm) == 1
        for position, value, u in zip(curve.position_mm, curve.value, curve.u, strict=True):
            rows.append((axis, component, np.nan if constant else position, value / MM_PER_UM, u / MM_PER_UM))
    if not rows:
        raise InputError("there is no reversal to write")
    axes, components, positions, values, u_values = zip(*rows, strict=True)
    columns: dict[str, Sequence[str] | FloatArray] = {
        "axis": [AXES[axis] for axis in axes],
        "component": [AXES[component] for component in components],
        "position_mm": np.array(positions),
        "value_um": np.array(values),
        "u_value_um": np.array(u_values),
    }
    return format_csv(columns, {**reversal.metadata, **(metadata or {})})


# Bases of curves over one axis: hat functions between nodes, and null spaces of a few linear constraints.


# Bases of curves over one axis, and reference lines through straightness readings.


def hat_entries(nodes_mm: FloatArray, position_mm: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Left node (m,) of the interval of each position, and the share (m,) of the right node in the value there.

    Linear between ``nodes_mm`` (n,), n > 1, constant outside.
    """
    left = np.clip(np.searchsorted(nodes_mm, position_mm, side="right") - 1, 0, len(nodes_mm) - 2)
    share = np.clip((position_mm - nodes_mm[left]) / (nodes_mm[left + 1] - nodes_mm[left]), 0.0, 1.0)
    return left, share


def hat_matrix(nodes_mm: FloatArray, position_mm: FloatArray) -> FloatArray:
    """Matrix (m, n) that interpolates values at ``nodes_mm`` (n,) linearly at ``position_mm`` (m,), constant outside.

    >>> hat_matrix(np.array([0.0, 10.0, 30.0]), np.array([5.0, 30.0, 99.0]))
    array([[0.5, 0.5, 0. ],
           [0. , 0. , 1. ],
           [0. , 0. , 1. ]])
    """
    nodes, position = np.asarray(nodes_mm), np.asarray(position_mm)
    matrix = np.zeros((len(position), len(nodes)))
    if len(nodes) == 1:
        matrix[:, 0] = 1.0
        return matrix
    left, share = hat_entries(nodes, position)
    rows = np.arange(len(position))
    matrix[rows, left] = 1.0 - share
    matrix[rows, left + 1] += share
    return matrix


def spline_matrix(nodes_mm: FloatArray, position_mm: FloatArray) -> FloatArray:
    """Matrix (m, n) of the clamped cubic B-splines with n coefficients over the range of ``nodes_mm`` (n,).

    The knots are distributed like the nodes (averages of three neighbouring nodes), first and last fourfold, so the
    first and the last coefficient are the end values. Positions (m,) outside the range get the end value.
    """
    from scipy.interpolate import BSpline  # imported here: slow to load, and not needed for linear curves

    nodes = np.asarray(nodes_mm, dtype=np.float64)
    inner = (nodes[1:-3] + nodes[2:-2] + nodes[3:-1]) / 3.0
    knots = np.concatenate([np.repeat(nodes[0], 4), inner, np.repeat(nodes[-1], 4)])
    inside = np.clip(position_mm, nodes[0], nodes[-1])
    return np.asarray(BSpline.design_matrix(inside, knots, 3).toarray(), dtype=np.float64)


def free_basis(constraints: FloatArray, size: int) -> FloatArray:
    """Basis (size, free) of all x with ``constraints`` (k, size) x = 0, see :func:`eliminated`: mostly zeros and ones."""
    free, bound, rows = eliminated(constraints, size)
    basis = np.zeros((size, len(free)))
    basis[free, np.arange(len(free))] = 1.0
    basis[bound] = rows
    return basis


def eliminated(constraints: FloatArray, size: int) -> tuple[NDArray[np.intp], list[int], FloatArray]:
    """Solve ``constraints`` (k, size) x = 0 for as many unknowns: which stay free, which are bound, x[bound] = rows x[free].

    Each row eliminates the unknown with its largest factor; the others keep their meaning: a row with a single entry
    gives an exact zero.
    """
    rows = np.atleast_2d(constraints).astype(np.float64) if np.size(constraints) else np.zeros((0, size))
    pivots: list[int] = []
    for k in range(len(rows)):
        pivot = int(np.argmax(np.abs(rows[k])))
        if abs(rows[k, pivot]) < 1e-12:
            continue  # dependent on the rows before it
        rows[k] /= rows[k, pivot]
        others = np.arange(len(rows)) != k
        rows[others] -= rows[others, pivot][:, None] * rows[k]
        pivots.append(pivot)
    keep = np.ones(size, dtype=bool)
    keep[pivots] = False
    used = np.flatnonzero(np.abs(rows).max(axis=1, initial=0.0) > 1e-12).tolist()
    return np.flatnonzero(keep), pivots, -rows[used][:, keep]


# Reference lines through straightness readings (ISO 230-1): least squares, minimum zone, or through the end points.


def fitted_line(position_mm: FloatArray, value: FloatArray, kind: str = "ls") -> tuple[float, float]:
    """Return (constant, slope) of the line a + b q through values (n,) at positions (n,).

    ``kind`` is ``"ls"`` for least squares, ``"minzone"`` for the line whose largest vertical distance is smallest
    (Jia et al. 2022 call it "least inclusion"), ``"end-point"`` for the line through the values at the two ends.
    """
    if kind == "end-point":
        first, last = int(np.argmin(position_mm)), int(np.argmax(position_mm))
        slope = float((value[last] - value[first]) / (position_mm[last] - position_mm[first]))
        return float(value[first]) - slope * float(position_mm[first]), slope
    if kind == "ls":
        slope, constant = np.polyfit(position_mm, value, 1)
        return float(constant), float(slope)
    # the minimum-zone line is parallel to an edge of the convex hull: the narrowest strip over all of its edges
    points = np.column_stack([position_mm, value])[np.lexsort((value, position_mm))]
    best = (np.inf, 0.0, 0.0)
    for sign in (1.0, -1.0):
        hull: list[FloatArray] = []  # the lower one, by Andrew's monotone chain
        for point in points * [1.0, sign]:
            while len(hull) > 1:
                (q1, y1), (q2, y2) = hull[-2], hull[-1]
                if (q2 - q1) * (point[1] - y1) - (y2 - y1) * (point[0] - q1) > 0.0:  # a left turn
                    break
                hull.pop()
            hull.append(point)
        for (q1, y1), (q2, y2) in pairwise(hull):
            if q2 <= q1:
                continue
            edge = float(sign * (y2 - y1) / (q2 - q1))
            rest = value - edge * position_mm
            if (width := float(np.ptp(rest))) < best[0]:
                best = (width, 0.5 * float(rest.max() + rest.min()), edge)
    return best[1], best[2]
