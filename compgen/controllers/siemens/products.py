"""SINUMERIK CEC tables: what a set of them adds up to, and angular errors as products of two tables.

Sources: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 245, 248, 249, 252 (boring mill example).
A table whose MULT_BY_TABLE names another one adds the product of both interpolated numbers to its output axis. The
readable documents do not say whether the direct terms of the two tables stay; the four readings are the modes S1 to S4.

Balanced folding, for e(x) z on one output axis: with a = sqrt(z_max / e_max) the tables A = a e(x) and B = z / a have
the product e(x) z and are both as small as they can be; the direct terms that the mode leaves are subtracted in the
ordinary tables over x and z, so that only the product remains.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from itertools import count

import numpy as np
from numpy.typing import NDArray

from compgen.controllers.base import SourceFile, Term
from compgen.controllers.siemens.syntax import LinearTable, exact_grid
from compgen.controllers.terms import one_dimensional_name, product_name
from compgen.core.csvio import FloatArray
from compgen.core.names import AXES

IntArray = NDArray[np.int64]

#: Whether (the table that is multiplied, its multiplier) also act directly, by mode.
MULT_MODES: dict[str, tuple[bool, bool]] = {
    "S1": (True, True),  # A + B + A B
    "S2": (False, False),  # A B
    "S3": (True, False),  # A + A B
    "S4": (False, True),  # B + A B
}
#: The same in words.
MODE_WORDS = {
    "S1": "both factors of a product also act directly",
    "S2": "factors of a product do not act directly",
    "S3": "the multiplier of a product does not act directly",
    "S4": "only the multiplier of a product acts directly",
}
#: Decimals of tables in mm, and of the factors of a product and the tables that hold their folds.
MM_DECIMALS, FACTOR_DECIMALS = 6, 9
#: Angles below this are no angles, and products that stay below half of the last decimal in mm are no products.
NEGLIGIBLE_RAD = 1e-12
NEGLIGIBLE_PRODUCT_MM = 0.5 * 10.0**-MM_DECIMALS

_LABEL = re.compile(r"; table (\d{1,6}): ([ -~]{1,300}); MD18342\[\d{1,6}\] = \d")
_UNITS_PER_MM = 10**FACTOR_DECIMALS
_UNITS_PER_MM_QUANTUM = 10 ** (FACTOR_DECIMALS - MM_DECIMALS)


@dataclass(frozen=True)
class CecTable:
    """One table: output over input axis (0..2); ``multiplier`` is the NUMBER (index + 1) of the other factor, or 0.

    ``direction`` is 0 (both), 1 or -1: the travel of the input axis in which the table acts. ``enabled`` is SD41300,
    ``weight`` SD41310. ``decimals`` and ``label`` are for writing only.
    """

    input_axis: int
    output_axis: int
    table: LinearTable
    direction: int = 0
    multiplier: int = 0
    enabled: bool = True
    weight: Decimal = Decimal(1)
    decimals: int = field(default=MM_DECIMALS, compare=False)
    label: str = field(default="", compare=False)

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Weighted interpolated value at positions of any shape, 0 if the table is switched off."""
        if not self.enabled:
            return np.zeros(np.shape(position_mm))
        return self.table.at(position_mm) * float(self.weight)


CecMap = Mapping[int, CecTable]


def sum_into_axes(tables: CecMap, mode: str, outputs: Mapping[int, FloatArray]) -> list[FloatArray]:
    """Return the total of each axis: direct terms as the mode leaves them, plus products.

    Parameters
    ----------
    tables : by index.
    mode : a key of :data:`MULT_MODES`.
    outputs : interpolated value of every table (0 where it does not act), of shapes that broadcast.
    """
    first_stays, multiplier_stays = MULT_MODES[mode]
    multipliers = {table.multiplier - 1 for table in tables.values() if table.multiplier}
    totals: list[FloatArray] = [np.zeros(())] * 3
    for index, table in tables.items():
        own = outputs[index]
        parts = []
        if (first_stays or not table.multiplier) and (multiplier_stays or index not in multipliers):
            parts.append(own)
        if table.multiplier - 1 in tables:
            parts.append(own * outputs[table.multiplier - 1])
        for part in parts:
            totals[table.output_axis] = totals[table.output_axis] + part
    return totals


def beside_kept(tables: CecMap, kept: Collection[int]) -> dict[int, CecTable]:
    """Return the tables with other indices, so that none of the ``kept`` ones is used; multipliers follow."""
    free = (index for index in count() if index not in kept)
    place = {old: next(free) for old in sorted(tables)}
    return {
        place[old]: replace(entry, multiplier=place[entry.multiplier - 1] + 1 if entry.multiplier else 0)
        for old, entry in sorted(tables.items())
    }


def term_names(tables: CecMap) -> set[str]:
    """Return the names of the terms that a set of tables holds: ordinary ones by axes, products by angle and lever."""
    factors = {entry.multiplier - 1 for entry in tables.values() if entry.multiplier}
    names = set()
    for index, entry in tables.items():
        if entry.multiplier - 1 in tables:
            names.add(product_name(entry.output_axis, entry.input_axis, tables[entry.multiplier - 1].input_axis))
        elif entry.direction == 0 and index not in factors:
            names.add(one_dimensional_name(entry.output_axis, entry.input_axis))
    return names


def balanced_scale(largest_rad: float, largest_lever_mm: float) -> float:
    """Return a = sqrt(z_max / e_max) in mm: with it a e and z / a have the same largest value, sqrt(e_max z_max)."""
    return math.sqrt(largest_lever_mm / largest_rad)


def balanced_factors(angle_rad: FloatArray, lever_mm: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return a, the scaled angles a e (n,) and the scaled lever z / a (m,), in mm, for one product e z."""
    scale = balanced_scale(float(np.max(np.abs(angle_rad))), float(np.max(np.abs(lever_mm))))
    return scale, scale * np.asarray(angle_rad), np.asarray(lever_mm) / scale


@dataclass
class _Set:
    """Tables under construction, in whole units of the last decimal (1e-9 mm), by (output, axis[, lever])."""

    ordinary: dict[tuple[int, int], IntArray] = field(default_factory=dict)
    folds: dict[tuple[int, int], list[str]] = field(default_factory=dict)
    angles: dict[tuple[int, int, int], IntArray] = field(default_factory=dict)
    levers: dict[tuple[int, int], IntArray] = field(default_factory=dict)

    def fold(self, key: tuple[int, int], units: IntArray, what: str) -> None:
        """Subtract the direct term of a factor in the ordinary table."""
        self.ordinary[key] = self.ordinary.get(key, np.zeros(len(units), dtype=np.int64)) - units
        self.folds.setdefault(key, []).append(what)


def folded_tables(
    terms: Sequence[Term],
    values: Mapping[str, FloatArray],
    *,
    flip: bool,
    mode: str,
    travel_mm: Sequence[tuple[float, float]] = (),
) -> dict[int, CecTable]:
    """Return the tables of a set of terms, numbered: ordinary ones, scaled angles, scaled levers.

    Parameters
    ----------
    terms : one-dimensional terms and products (function of one axis times lever); all of one axis share their nodes.
    values : corrections by term name, mm and rad.
    flip : True if the control subtracts its total: the ordinary terms and the angles change sign, the levers do not.
    mode : which direct terms are folded away, a key of :data:`MULT_MODES`.
    travel_mm : ends of the travel of X, Y, Z: the nodes of a lever over whose axis there is no term.

    Ordinary tables that are zero in every decimal, and products that stay below half of the last decimal in mm, are
    left out; if all are, the first ordinary table remains.
    """
    sign = -1 if flip else 1
    nodes = {axis: np.array(ends, dtype=np.float64) for axis, ends in enumerate(travel_mm)}
    nodes |= {term.axis: term.nodes_mm for term in terms if term.axis is not None}
    work = _Set()
    products: dict[tuple[int, int], list[Term]] = {}
    for term in terms:
        if term.axis is None:
            raise ValueError(f"{term.name}: a CEC table is a function of an axis")
        part = term.carrier[0]
        if part.lever is None:
            counts = np.rint(sign * part.sign * np.asarray(values[term.name]) * 10**MM_DECIMALS).astype(np.int64)
            work.ordinary[part.output, term.axis] = counts * _UNITS_PER_MM_QUANTUM
        elif _matters(values[term.name], nodes[part.lever] - part.origin_mm):
            products.setdefault((part.output, part.lever), []).append(term)
    for (output, lever), group in sorted(products.items()):
        _add_products(work, nodes[lever], output, lever, [(term, sign * values[term.name]) for term in group], mode)
    return _numbered(work, nodes)


def _matters(angle_rad: FloatArray, lever_mm: FloatArray) -> bool:
    largest = float(np.max(np.abs(angle_rad)))
    return largest >= NEGLIGIBLE_RAD and largest * float(np.max(np.abs(lever_mm))) >= NEGLIGIBLE_PRODUCT_MM


def _add_products(
    work: _Set,
    lever_nodes_mm: FloatArray,
    output: int,
    lever: int,
    angles: Sequence[tuple[Term, FloatArray]],
    mode: str,
) -> None:
    """Add all products of one output axis with one lever; they share the lever's table."""
    first_stays, multiplier_stays = MULT_MODES[mode]
    part = angles[0][0].carrier[0]
    ends_mm = lever_nodes_mm[[0, -1]] - part.origin_mm
    scale, _, scaled_ends = balanced_factors(np.concatenate([value for _, value in angles]), ends_mm)
    ends = np.rint(scaled_ends * _UNITS_PER_MM).astype(np.int64)
    for term, value in angles:
        axis = int(term.axis or 0)
        units = np.rint(term.carrier[0].sign * scale * value * _UNITS_PER_MM).astype(np.int64)
        work.angles[output, axis, lever] = units
        if first_stays:
            work.fold((output, axis), units, f"the scaled angle of {product_name(output, axis, lever)}")
    work.levers[output, lever] = ends
    if multiplier_stays:
        line = _line(ends, len(lever_nodes_mm))
        work.fold((output, lever), line, f"the scaled lever {AXES[lever].lower()} of {AXES[output]}")


def _line(ends: IntArray, count: int) -> IntArray:
    """Whole numbers nearest to the straight line between two whole numbers, at ``count`` equidistant nodes."""
    intervals = count - 1
    rise = int(ends[1]) - int(ends[0])
    return np.array(
        [int(ends[0]) + (2 * rise * n + intervals) // (2 * intervals) for n in range(count)], dtype=np.int64
    )


def _numbered(work: _Set, nodes: Mapping[int, FloatArray]) -> dict[int, CecTable]:
    ordinary = {key: units for key, units in sorted(work.ordinary.items()) if np.any(units)}
    if not ordinary and not work.angles:
        ordinary = dict(sorted(work.ordinary.items())[:1])
    tables = [_ordinary_table(work, key, units, nodes[key[1]]) for key, units in ordinary.items()]
    first_lever = len(tables) + len(work.angles)
    number_of = {key: first_lever + n + 1 for n, key in enumerate(sorted(work.levers))}
    for (output, axis, lever), units in sorted(work.angles.items()):
        grid = exact_grid(nodes[axis])
        label = f"{product_name(output, axis, lever)}: scaled angle over {AXES[axis]}"
        table = LinearTable(*grid, values=_decimals(units, FACTOR_DECIMALS))
        number = number_of[output, lever]
        tables.append(CecTable(axis, output, table, 0, number, decimals=FACTOR_DECIMALS, label=label))
    for (output, lever), ends in sorted(work.levers.items()):
        start, _, last = exact_grid(nodes[lever])
        label = f"scaled lever {AXES[lever].lower()} of {AXES[output]}"
        table = LinearTable(start, last - start, last, _decimals(ends, FACTOR_DECIMALS))
        tables.append(CecTable(lever, output, table, decimals=FACTOR_DECIMALS, label=label))
    return dict(enumerate(tables))


def _ordinary_table(work: _Set, key: tuple[int, int], units: IntArray, nodes_mm: FloatArray) -> CecTable:
    output, axis = key
    folds = work.folds.get(key, [])
    decimals = FACTOR_DECIMALS if folds else MM_DECIMALS
    label = one_dimensional_name(output, axis) + (f", less {' and '.join(folds)}" if folds else "")
    values = _decimals(units // 10 ** (FACTOR_DECIMALS - decimals), decimals)
    table = LinearTable(*exact_grid(nodes_mm), values=values)
    return CecTable(axis, output, table, decimals=decimals, label=label)


def _decimals(units: IntArray, decimals: int) -> tuple[Decimal, ...]:
    return tuple(Decimal(int(count)).scaleb(-decimals) for count in units)


def written_decimals(table: LinearTable) -> int:
    """Return with how many decimals the values of a table stand in its text, at least those of a table in mm."""
    places = [len(f"{value:f}".partition(".")[2]) for value in table.values]
    return min(max([MM_DECIMALS, *places]), FACTOR_DECIMALS)


def labels_in(files: Sequence[SourceFile]) -> dict[int, str]:
    """Return what the comments of an exported file call its tables, by index; they matter for nothing but writing."""
    found = {}
    for source in files:
        for line in source.text.splitlines():
            match = _LABEL.match(line[:400])
            if match:
                found[int(match.group(1))] = match.group(2)
    return found
