"""SINUMERIK CEC tables: sum of a set, products of tables, reversal as pairs, and which tables to keep."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from itertools import combinations, count

import numpy as np
from numpy.typing import NDArray

from compgen.controls.shared.base import SourceFile, Term, parameter_row
from compgen.controls.shared.grids import equidistant_grid
from compgen.controls.shared.terms import one_dimensional_name, product_name
from compgen.controls.siemens_text import LinearTable, exact_grid, exact_values
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, Curve, ErrorTable, ReversalCurves, hat_matrix, reversal_name
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.kinematics.first_order import tool_of
from compgen.kinematics.many_points import gauss_levels, grid_tables

# SINUMERIK CEC tables: the sum of a set, and angular errors as products of two tables.
#
# Source: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 245, 248, 249, 252 (boring mill example).
# A table whose MULT_BY_TABLE names another table adds the product of both interpolated values to its output axis. The
# available documents do not say whether the direct terms of both tables stay; the modes S1 to S4 are the four readings.
#
# Balanced folding, for e(x) z on one output axis: with a = sqrt(z_max / e_max) the tables A = a e(x) and B = z / a have
# the product e(x) z and are both as small as possible; the direct terms that the mode leaves are subtracted in the
# ordinary tables over x and z, so only the product remains.


IntArray = NDArray[np.int64]

#: By mode: whether (the multiplied table, its multiplier) also act directly.
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
#: Decimals of tables in mm; decimals of the factors of a product and of the tables that contain their folds.
MM_DECIMALS, FACTOR_DECIMALS = 6, 9
#: Angles below this count as zero; so do products below half of the last decimal in mm.
NEGLIGIBLE_RAD = 1e-12
NEGLIGIBLE_PRODUCT_MM = 0.5 * 10.0**-MM_DECIMALS

_LABEL = re.compile(r"; table (\d{1,6}): ([ -~]{1,300}); MD18342\[\d{1,6}\] = \d")
_UNITS_PER_MM = 10**FACTOR_DECIMALS
_UNITS_PER_MM_QUANTUM = 10 ** (FACTOR_DECIMALS - MM_DECIMALS)


@dataclass(frozen=True)
class CecTable:
    """One table: output over input axis (0..2); ``multiplier`` is the NUMBER (index + 1) of the other factor, or 0.

    ``direction`` is 0 (both), 1 or -1: the travel direction of the input axis in which the table acts. ``enabled`` is
    SD41300, ``weight`` SD41310. ``decimals`` and ``label`` are for writing only.
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
    """Return the total of each axis: the direct terms that the mode leaves, plus products.

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
        value = outputs[index]
        parts = []
        if (first_stays or not table.multiplier) and (multiplier_stays or index not in multipliers):
            parts.append(value)
        if table.multiplier - 1 in tables:
            parts.append(value * outputs[table.multiplier - 1])
        for part in parts:
            totals[table.output_axis] = totals[table.output_axis] + part
    return totals


def around_kept(tables: CecMap, kept: Collection[int]) -> dict[int, CecTable]:
    """Renumber the tables to avoid the ``kept`` indices; multipliers follow."""
    free = (index for index in count() if index not in kept)
    place = {old: next(free) for old in sorted(tables)}
    return {
        place[old]: replace(entry, multiplier=place[entry.multiplier - 1] + 1 if entry.multiplier else 0)
        for old, entry in sorted(tables.items())
    }


def term_names(tables: CecMap) -> set[str]:
    """Return the names of the terms in a set of tables: ordinary terms by axes, products by angle and lever."""
    factors = {entry.multiplier - 1 for entry in tables.values() if entry.multiplier}
    names = set()
    for index, entry in tables.items():
        if entry.multiplier - 1 in tables:
            names.add(product_name(entry.output_axis, entry.input_axis, tables[entry.multiplier - 1].input_axis))
        elif entry.direction == 0 and index not in factors:
            names.add(one_dimensional_name(entry.output_axis, entry.input_axis))
    return names


@dataclass
class _Set:
    """Tables under construction, in whole units of the last decimal (1e-9 mm), by (output, axis[, lever])."""

    ordinary: dict[tuple[int, int], IntArray] = field(default_factory=dict)
    folds: dict[tuple[int, int], list[str]] = field(default_factory=dict)
    angles: dict[tuple[int, int, int], IntArray] = field(default_factory=dict)
    levers: dict[tuple[int, int], IntArray] = field(default_factory=dict)

    def fold(self, key: tuple[int, int], units: IntArray, what: str) -> None:
        """Subtract the direct term of a factor from the ordinary table."""
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
    """Return the tables of a set of terms, numbered: ordinary tables, scaled angles, scaled levers.

    Parameters
    ----------
    terms : one-dimensional terms and products (function of one axis times lever); terms over one axis share nodes.
    values : corrections by term name, mm and rad.
    flip : True if the control subtracts its total: the ordinary terms and the angles change sign, the levers do not.
    mode : which direct terms are folded away, a key of :data:`MULT_MODES`.
    travel_mm : ends of the travel of X, Y, Z: the nodes of a lever whose axis has no term.

    Ordinary tables that are zero in every decimal, and products below half of the last decimal in mm, are left out; if
    all would be, the first ordinary table remains.
    """
    sign = -1 if flip else 1
    nodes = {axis: np.array(ends, dtype=np.float64) for axis, ends in enumerate(travel_mm)}
    nodes |= {term.axis: term.nodes_mm for term in terms if term.axis is not None}
    work = _Set()
    products: dict[tuple[int, int], list[Term]] = {}
    for term in terms:
        if term.axis is None:
            raise ValueError(f"{term.name}: a CEC table is a function of one axis")
        part = term.carrier[0]
        if part.lever is None:
            counts = np.rint(sign * part.sign * np.asarray(values[term.name]) * 10**MM_DECIMALS).astype(np.int64)
            work.ordinary[part.output, term.axis] = counts * _UNITS_PER_MM_QUANTUM
        else:
            largest_rad = float(np.max(np.abs(values[term.name])))
            largest_lever_mm = float(np.max(np.abs(nodes[part.lever] - part.origin_mm)))
            if largest_rad >= NEGLIGIBLE_RAD and largest_rad * largest_lever_mm >= NEGLIGIBLE_PRODUCT_MM:
                products.setdefault((part.output, part.lever), []).append(term)
    for (output, lever), group in sorted(products.items()):
        _add_products(work, nodes[lever], output, lever, [(term, sign * values[term.name]) for term in group], mode)
    return _numbered(work, nodes)


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
    # balanced: with a = sqrt(z_max / e_max) in mm, a e and z / a have the same largest value, sqrt(e_max z_max)
    largest_rad = float(np.max(np.abs(np.concatenate([value for _, value in angles]))))
    scale = math.sqrt(float(np.max(np.abs(ends_mm))) / largest_rad)
    ends = np.rint(ends_mm / scale * _UNITS_PER_MM).astype(np.int64)
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
    tables = []
    for (output, axis), units in ordinary.items():
        folds = work.folds.get((output, axis), [])
        decimals = FACTOR_DECIMALS if folds else MM_DECIMALS
        label = one_dimensional_name(output, axis) + (f", minus {' and '.join(folds)}" if folds else "")
        numbers = exact_values(units // 10 ** (FACTOR_DECIMALS - decimals), decimals)
        table = LinearTable(*exact_grid(nodes[axis]), values=numbers)
        tables.append(CecTable(axis, output, table, decimals=decimals, label=label))
    first_lever = len(tables) + len(work.angles)
    number_of = {key: first_lever + n + 1 for n, key in enumerate(sorted(work.levers))}
    for (output, axis, lever), units in sorted(work.angles.items()):
        grid = exact_grid(nodes[axis])
        label = f"{product_name(output, axis, lever)}: scaled angle over {AXES[axis]}"
        table = LinearTable(*grid, values=exact_values(units, FACTOR_DECIMALS))
        number = number_of[output, lever]
        tables.append(CecTable(axis, output, table, 0, number, decimals=FACTOR_DECIMALS, label=label))
    for (output, lever), ends in sorted(work.levers.items()):
        start, _, last = exact_grid(nodes[lever])
        label = f"scaled lever {AXES[lever].lower()} of {AXES[output]}"
        table = LinearTable(start, last - start, last, exact_values(ends, FACTOR_DECIMALS))
        tables.append(CecTable(lever, output, table, decimals=FACTOR_DECIMALS, label=label))
    return dict(enumerate(tables))


def written_decimals(table: LinearTable) -> int:
    """Return how many decimals the values of a table have in its text, at least as many as a table in mm."""
    places = [len(f"{value:f}".partition(".")[2]) for value in table.values]
    return min(max([MM_DECIMALS, *places]), FACTOR_DECIMALS)


def labels_in(files: Sequence[SourceFile]) -> dict[int, str]:
    """Return the table labels in the comments of an exported file, by index; they are used only for writing."""
    found = {}
    for source in files:
        for line in source.text.splitlines():
            match = _LABEL.match(line[:400])
            if match:
                found[int(match.group(1))] = match.group(2)
    return found


# Reversal as pairs of SINUMERIK CEC tables: one acts after positive travel of its base axis, the other after negative.
#
# Source: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 249 (DIRECTION), 264 (example of a pair).
# With reversal B (position reached in the positive minus in the negative direction) the tool is at +B/2 after positive
# travel, so the correction is -B/2 in the table with DIRECTION 1 and +B/2 in the table with DIRECTION -1.


def with_reversal_tables(
    machine: Machine,
    tables: CecMap,
    reversal: ReversalCurves,
    *,
    subtracts: bool,
    max_points: int,
    step_mm: tuple[float | None, ...],
) -> dict[int, CecTable]:
    """Return the tables followed by a pair for each reversal large enough to need one.

    Parameters
    ----------
    machine, tables : the machine and the existing tables, which keep their indices.
    reversal : values in mm.
    subtracts : whether the control subtracts the sum of the tables.
    max_points : most nodes per table.
    step_mm : requested node spacings, or None.
    """
    found = dict(tables)
    for (axis, component), curve in sorted(reversal.curves.items()):
        if np.max(np.abs(curve.value)) < WORTH_MM:
            continue
        nodes_mm = _nodes_mm(machine, axis, curve, max_points, step_mm[axis])
        half = 0.5 * curve.at(nodes_mm) * (1.0 if subtracts else -1.0)
        for direction in (1, -1):
            words = "positive" if direction > 0 else "negative"
            label = f"{reversal_name(axis, component)}, after {words} travel of {AXES[axis]}"
            units = np.rint(direction * half * 10**MM_DECIMALS).astype(np.int64)
            table = LinearTable(*exact_grid(nodes_mm), values=exact_values(units, MM_DECIMALS))
            found[max(found, default=-1) + 1] = CecTable(axis, component, table, direction, label=label)
    return found


def _nodes_mm(machine: Machine, axis: int, curve: Curve, max_points: int, step_mm: float | None) -> FloatArray:
    if len(curve.position_mm) == 1:
        return np.array(machine.axes[axis].range_mm)
    inside = replace(curve, u=np.full(len(curve.value), np.nan))
    as_errors = ErrorTable({f"E{AXES[axis]}{AXES[axis]}": inside})
    return equidistant_grid(machine, as_errors, axis, most=max_points, step_mm=step_mm).nodes_mm


def reversal_statement(tables: CecMap, names: tuple[str, ...]) -> str:
    """Say what the unidirectional tables do, with an example value from the file; empty if there are none."""
    for index, entry in sorted(tables.items()):
        if entry.direction == 1:
            value = float(max(entry.table.values, key=abs))
            base, output = names[entry.input_axis], names[entry.output_axis]
            return (
                f" Direction: table {index} acts only after positive travel of {base} and adds {value:+.6f} mm (its "
                f"largest value) to the sum of {output}; its partner with DIRECTION -1 adds the opposite after negative "
                "travel."
            )
    return ""


def backlash_rows(tables: CecMap, names: tuple[str, ...]) -> list[dict[str, str]]:
    """Return the machine data that must be zero because unidirectional tables contain the same effect."""
    meaning = "the tables with DIRECTION 1 and -1 already correct the reversal; another value would correct it twice"
    axes = sorted({entry.input_axis for entry in tables.values() if entry.direction})
    return [parameter_row(f"MD32450 $MA_BACKLASH[{names[axis]}]", "0", meaning) for axis in axes]


# Which CEC tables to keep when a control has too few: those that leave the smallest error over the volume.
#
# Every table moves one axis only, so each axis can be treated separately: each set of terms of an axis has a number of
# tables and a sum of squares that it removes from the required correction (least squares over the volume). The best
# combination of sets for the three axes within the number of tables is found exactly.


#: Directions of the normal matrix (unit diagonal) below this are not determined.
_UNDETERMINED = 1e-9
#: Terms whose natural values move the tool by less than this do not need a table.
_NOTHING_MM = 0.5e-6
#: A set of tables is as good as the best one if its remaining error is at most this factor times that of the best.
_AS_GOOD = 1.1
#: Uncorrected errors below this are not reported.
_NAMED_FROM_MM = 0.01 * MM_PER_UM


@dataclass(frozen=True)
class Choice:
    """Terms that fit in the tables, and the rest.

    Parameters
    ----------
    kept : terms in their order.
    dropped : (name, mm): for each term that does not fit, the additional rms over the volume that it would remove.
    allowed : number of tables available (None: not limited).
    needed : tables that all terms would take.
    left_mm : rms over the volume that all terms would remove and the kept ones do not.
    given : terms of tables of another kind, which are always present.
    """

    kept: list[Term]
    dropped: tuple[tuple[str, float], ...]
    allowed: int | None
    needed: int
    left_mm: float
    given: tuple[Term, ...] = ()

    def statements(self) -> list[str]:
        """Say what is left out, largest first; empty if everything fits."""
        if not self.dropped:
            return []
        return [
            f"{self.needed} tables are needed, but only {self.allowed} may be used; not corrected: "
            f"{_named(self.dropped) or 'tables of less than 0.01 um'}; together these leave "
            f"{self.left_mm / MM_PER_UM:.2f} um rms over the volume (first order)"
        ]


def table_count(terms: Sequence[Term], mode: str) -> int:
    """Return how many tables a set of terms takes: ordinary tables, tables that only contain folds, angles, levers."""
    first_stays, multiplier_stays = MULT_MODES[mode]
    ordinary, levers, angles = set(), set(), 0
    for term in terms:
        part = term.carrier[0]
        if part.lever is None:
            ordinary.add((part.output, term.axis))
            continue
        angles += 1
        levers.add((part.output, part.lever))
        ordinary |= {(part.output, term.axis)} if first_stays else set()
        ordinary |= {(part.output, part.lever)} if multiplier_stays else set()
    return len(ordinary) + len(levers) + angles


def chosen_terms(
    machine: Machine,
    errors: ErrorTable,
    terms: Sequence[Term],
    mode: str,
    allowed: int | None,
    given: Sequence[Term] = (),
) -> Choice:
    """Return the terms that fit in ``allowed`` tables and leave the smallest error.

    Parameters
    ----------
    machine, errors : what to correct; the work zone has more weight.
    terms : everything that the control could correct.
    mode : reading of products, a key of ``MULT_MODES``.
    allowed : number of tables, None: not limited.
    given : terms that tables of another kind always contain.
    """
    needed = table_count(terms, mode)
    if allowed is None or needed <= allowed:
        return Choice(list(terms), (), allowed, needed, 0.0)
    gains = [_Gains.of(machine, errors, terms, given, output) for output in range(3)]
    # the best set of each axis such that all together do not take more tables than allowed, by dynamic programming
    best: dict[int, tuple[float, list[tuple[Term, ...]]]] = {0: (0.0, [])}
    for gain in gains:
        options = gain.by_count(mode, allowed)
        joined: dict[int, tuple[float, list[tuple[Term, ...]]]] = {}
        for used, (so_far, parts) in best.items():
            for number, (value, part) in options.items():
                total = used + number
                if total <= allowed and (total not in joined or so_far + value > joined[total][0]):
                    joined[total] = so_far + value, [*parts, part]
        best = joined
    picked = max(best.values(), key=lambda item: item[0])[1]
    names = {term.name for part in picked for term in part} or {terms[0].name}
    kept = [term for term in terms if term.name in names]
    dropped, left_mm = _left_out(gains, picked)
    return Choice(kept, tuple(dropped), allowed, needed, left_mm, tuple(given))


def without_products(
    machine: Machine, errors: ErrorTable, terms: Sequence[Term], given: Sequence[Term] = ()
) -> list[str]:
    """Say what stays uncorrected because no products are written: their names, and the rms over the volume.

    ``terms`` are the ordinary terms and the products, ``given`` as in :func:`chosen_terms`. Empty if nothing is missed.
    """
    ordinary = [term for term in terms if term.carrier[0].lever is None]
    gains = [_Gains.of(machine, errors, terms, given, output) for output in range(3)]
    ordinary_of_axis = [[term for term in gain.terms if term in ordinary] for gain in gains]
    missed, left_mm = _left_out(gains, ordinary_of_axis)
    named = _named(missed)
    if not named:
        return []
    return [
        f"no products of tables are written; not corrected: {named}; together these leave "
        f"{left_mm / MM_PER_UM:.2f} um rms over the volume (first order)"
    ]


def _left_out(gains: Sequence[_Gains], kept: Sequence[Sequence[Term]]) -> tuple[list[tuple[str, float]], float]:
    """Return (name, rms mm) of the terms not kept, and the rms over the volume (mm) that they leave together."""
    pairs = list(zip(gains, kept, strict=True))
    left = sum(gain.taken(gain.terms) - gain.taken(part) for gain, part in pairs)
    return [item for gain, part in pairs for item in gain.missed(part)], float(np.sqrt(max(left, 0.0)))


def _named(missed: Sequence[tuple[str, float]]) -> str:
    """Names with their rms in um, largest first; values below 0.01 um are left out."""
    return ", ".join(
        f"{name} ({size / MM_PER_UM:.2f} um rms)"
        for name, size in sorted(missed, key=lambda item: -item[1])
        if size >= _NAMED_FROM_MM
    )


def terms_of_tables(
    machine: Machine, errors: ErrorTable, terms: Sequence[Term], mode: str, choice: Choice, names: set[str]
) -> list[Term]:
    """Return the terms ``names`` of existing tables if they are as good as the chosen terms, else the chosen terms.

    Two sets may leave nearly the same error; then slightly different errors lead to a different choice.
    """
    existing = [term for term in terms if term.name in names]
    if not choice.dropped or not existing or table_count(existing, mode) > (choice.allowed or 0):
        return choice.kept
    gains = [_Gains.of(machine, errors, terms, choice.given, output) for output in range(3)]
    left = [
        sum(
            gain.target - gain.taken([term for term in part if term.carrier[0].output == k])
            for k, gain in enumerate(gains)
        )
        for part in (existing, choice.kept)
    ]
    return existing if left[0] <= _AS_GOOD**2 * left[1] else choice.kept


def _times_lever(
    levels_mm: Sequence[FloatArray], axis: int, values: FloatArray, lever: int | None, origin_mm: float = 0.0
) -> list[FloatArray]:
    """Functions of one axis, ``values`` (levels, m), times a lever: their factors (levels, m) over each of X, Y, Z."""
    factors = [np.ones((len(level), values.shape[1])) for level in levels_mm]
    factors[axis] = values
    if lever is not None:
        factors[lever] = factors[lever] * (levels_mm[lever] - origin_mm)[:, None]
    return factors


@dataclass(frozen=True)
class _Gains:
    """Least squares of the terms of one output axis; ``taken`` is in mm^2, the mean over the volume.

    Every function in it is a sum of products of functions of one axis, so the mean over the volume of two of them is
    a sum of products of means over the axes: exact, without a sample of the volume.

    ``given`` are terms that are always present and need no table; ``target`` is the mean square to be removed, mm^2.
    """

    terms: tuple[Term, ...]
    given: tuple[Term, ...]
    normal: FloatArray
    right: FloatArray
    target: float
    columns: Mapping[str, IntArray]

    @classmethod
    def of(
        cls, machine: Machine, errors: ErrorTable, terms: Sequence[Term], given: Sequence[Term], output: int
    ) -> _Gains:
        own = [term for term in terms if term.carrier[0].output == output]
        # natural values that do not exceed the last decimal need no table
        reach = [1.0 if (lever := t.carrier[0].lever) is None else machine.axes[lever].length_mm for t in own]
        largest = [float(np.max(np.abs(term.start), initial=0.0)) for term in own]
        own = [term for term, size, span in zip(own, largest, reach, strict=True) if size * span > _NOTHING_MM]
        others = [term for term in given if term.carrier[0].output == output]
        sides = []
        for axis, travel in enumerate(machine.axes):
            bends = [curve.position_mm for name, curve in errors.curves.items() if error_named(name).axis == axis]
            bends += [term.nodes_mm for term in (*own, *others) if term.axis == axis]
            ends_mm = np.concatenate([travel.range_mm, machine.emphasis.ends_mm(axis), *bends])
            # at most of second degree between nodes (an angle times its own travel): three points make products exact
            sides.append(gauss_levels(np.unique(np.clip(ends_mm, *travel.range_mm)), 3, axis, machine.emphasis))
        levels_mm = [points for points, _ in sides]
        columns: dict[str, IntArray] = {}
        parts: list[list[FloatArray]] = []
        size = 0
        for term in (*own, *others):
            columns[term.name] = np.arange(size, size := size + len(term.nodes_mm))
            axis, part = int(term.axis or 0), term.carrier[0]
            values = part.sign * hat_matrix(term.nodes_mm, levels_mm[axis])
            parts.append(_times_lever(levels_mm, axis, values, part.lever, part.origin_mm))
        # the errors instead of their corrections: only squares count
        for axis, table in enumerate(grid_tables(machine, errors, tool_of(machine, None), levels_mm)):
            for group, lever in enumerate((None, 0, 1, 2)):
                parts.append(_times_lever(levels_mm, axis, table[:, group, output, None], lever))
        gram = np.ones(())
        for axis, (_, weight) in enumerate(sides):
            along = np.hstack([part[axis] for part in parts])
            gram = gram * (along.T @ (weight[:, None] * along))
        scale = 1.0 / np.maximum(np.sqrt(np.diag(gram)[:size]), 1e-12)
        normal, right = scale[:, None] * gram[:size, :size] * scale, scale * gram[:size, size:].sum(axis=1)
        return cls(tuple(own), tuple(others), normal, right, float(gram[size:, size:].sum()), columns)

    def taken(self, terms: Sequence[Term]) -> float:
        """Mean square that a set of terms removes, mm^2."""
        present = [term for term in (*terms, *self.given) if term.name in self.columns]
        if not present:
            return 0.0
        where = np.concatenate([self.columns[term.name] for term in present])
        solution = np.linalg.lstsq(self.normal[np.ix_(where, where)], self.right[where], rcond=_UNDETERMINED)[0]
        return float(self.right[where] @ solution)

    def missed(self, kept: Sequence[Term]) -> list[tuple[str, float]]:
        """Return (name, rms mm) of the terms not kept: the additional rms that each would remove."""
        own = self.taken(kept)
        return [
            (term.name, float(np.sqrt(max(self.taken([*kept, term]) - own, 0.0))))
            for term in self.terms
            if term not in kept
        ]

    def by_count(self, mode: str, allowed: int) -> dict[int, tuple[float, tuple[Term, ...]]]:
        """Return the best set for every number of tables: (mm^2, terms)."""
        best: dict[int, tuple[float, tuple[Term, ...]]] = {0: (self.taken(()), ())}
        for size in range(1, len(self.terms) + 1):
            for part in combinations(self.terms, size):
                count = table_count(part, mode)
                if count > allowed:
                    continue
                gain = self.taken(part)
                if count not in best or gain > best[count][0]:
                    best[count] = gain, part
        return best
