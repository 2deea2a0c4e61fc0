"""Entry by entry: parsed tables contain nothing that the errors do not require, at any node, with any tool.

Means over the volume do not show one wrong number among thousands, and a single tool does not show angles without a
lever. So the tables are made again from the errors, with the same settings, and numbers and corrections of both are
compared:

- If most numbers are the same, the given tables are these with some numbers changed: no correction may then differ
  by more than ``Judge.goal_mm`` allows one entry, beyond what the format's rounding explains.
- Tables made in another way (other nodes, other smoothing, another program) differ everywhere by a little. A
  place that differs far more than all others is then suspect: a single number, or a step.
- With tools other than the machine's no table may rotate the tool further than the errors do.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from decimal import Decimal
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import CompgenError
from compgen.kinematics.first_order import tool_of
from compgen.kinematics.many_points import full_grid
from compgen.tables.exporting import table_values
from compgen.tables.judge import POINT_SHARE, POINT_UNCERTAINTIES, Judge, displacement_uncertainty, node_positions
from compgen.tables.synthesis import basis_field

if TYPE_CHECKING:
    from compgen.tables.verification import ReadTables

BoolArray = NDArray[np.bool_]
#: All numbers in tables by their place, see :func:`numbers_of`.
Numbers = Mapping[str, FloatArray]

#: Tables that differ from the remade ones in at most this many numbers were edited by hand ...
FEW_CHANGED = 2
#: If this many numbers of a list differ, a run of them may have moved; two may only be rounded differently.
LEAST_RUN = 3
#: ... and in at most this share of those that depend on the errors, they were edited, or made from nearly
#: the same errors and rounded.
CHANGED_SHARE = 0.2
#: If so few numbers differ, a component of the correction may differ by this share of the goal; three reach the goal.
#: One step of the format may differ beyond that, up to the goal.
FEW_SHARE = 0.55
#: If more numbers differ than by hand, differences beyond rounding plus this share of the goal are rejected.
GOAL_SHARE = 0.5
#: Share of the goal by which a value may exceed what rounding does anywhere else in the tables.
ROUNDED_SHARE = 0.05
#: A format that rounds by more than the goal hides differences: this share of the range without the linear part.
COARSE_SHARE = 0.1
#: Standard uncertainties of the errors that explain a difference if more than a few numbers differ; otherwise only
#: another rounding does, unless in every list that differs at least this share of the numbers that depend on the errors
#: differs: another measurement moves whole curves.
CHANGED_UNCERTAINTIES = 3.0
WHOLE_SHARE = 0.5
#: In tables made in another way a step of the difference is suspect if it is this many times as large as all others (if
#: there are enough), and exceeds this share of the goal plus the format's rounding and this many standard
#: uncertainties.
SPIKE_RATIO, LEAST_OTHERS = 5.0, 4
SPIKE_SHARE, SPIKE_UNCERTAINTIES = 0.6, 4.0
#: Largest full grid of table nodes for tables of fewer numbers; beyond it planes, and lines beyond these.
MOST_NODES = 20_000


def numbers_of(tables: object) -> dict[str, FloatArray]:
    """Return all numbers in parsed tables, by their place."""
    return {place: values for place, values in _numbers(tables, "") if values.size}


def _numbers(item: object, place: str) -> Iterator[tuple[str, FloatArray]]:
    if isinstance(item, np.ndarray):
        if item.dtype.kind in "iuf":
            yield place, item.astype(np.float64).ravel()
    elif isinstance(item, int | float | Decimal | np.number) and not isinstance(item, bool):
        yield place, np.array([float(item)])
    elif is_dataclass(item):
        for part in fields(item):
            if part.compare:
                yield from _numbers(getattr(item, part.name), f"{place}.{part.name}")
    elif isinstance(item, Mapping):
        for key, value in item.items():
            yield from _numbers(value, f"{place}[{key}]")
    elif isinstance(item, Sequence) and not isinstance(item, str | bytes):
        for k, value in enumerate(item):
            yield from _numbers(value, f"{place}[{k}]")


def numbers_changed(first: Numbers, second: Numbers) -> dict[str, BoolArray]:
    """Return which numbers of two sets of tables differ, by place; zeros that only one of them has are ignored."""
    both = [place for place, values in first.items() if place in second and values.shape == second[place].shape]
    ends = np.cumsum([0, *(first[place].size for place in both)]).tolist()
    values, others = (np.concatenate([np.zeros(0), *(part[place] for place in both)]) for part in (first, second))
    differ = ~_same(values, others)
    compared = {place: differ[start:end] for place, start, end in zip(both, ends, ends[1:], strict=False)}
    changed = {}
    for place in [*first, *(place for place in second if place not in first)]:
        if place in compared:
            changed[place] = compared[place]
        elif place in first and place in second:
            changed[place] = np.ones(max(first[place].size, second[place].size), dtype=np.bool_)
        else:
            changed[place] = np.not_equal(first[place] if place in first else second[place], 0.0)
    return changed


def changed_by_list(first: Numbers, second: Numbers) -> dict[str, int]:
    """Return how many numbers differ in each array and list of single numbers; a run that moved by one place counts as one."""
    changed = numbers_changed(first, second)
    lists: dict[str, list[str]] = {}
    for place in changed:
        lists.setdefault(_list_of(place), []).append(place)
    found = {}
    for name, places in lists.items():
        count = sum(int(changed[place].sum()) for place in places)
        if count >= LEAST_RUN:
            values, others = (
                np.concatenate([part[place] for place in places if place in part] or [np.zeros(0)])
                for part in (first, second)
            )
            if values.shape == others.shape:
                # One wrong position moves a run of numbers by one place, up or down, with any number at its end, in
                # tables that are read in order of position.
                differ = np.flatnonzero(~_same(values, others))
                run, right = (part[differ[0] : differ[-1] + 1] for part in (values, others))
                if _same(run[1:], right[:-1]).all() or _same(run[:-1], right[1:]).all():
                    count = 1
        found[name] = count
    return found


def _list_of(place: str) -> str:
    """Return the list of a place such as ``.tables[0].values[7]``, without the index."""
    return re.sub(r"\[\d+\]$", "", place)


def _same(values: FloatArray, others: FloatArray) -> BoolArray:
    same = values == others
    if same.all():  # the usual case, and much faster to check
        return np.asarray(same)
    return np.isclose(values, others, rtol=1e-9, atol=1e-15, equal_nan=True)


def with_number(tables: Any, place: str, index: int, step: float) -> Any:
    """Return tables in which one number is changed by ``step``, by whole counts at least if numbers are whole.

    ``place`` and ``index`` are those of :func:`numbers_of`.
    """
    return _with_number(tables, "", place, index, step)


def _with_number(item: Any, here: str, place: str, index: int, step: float) -> Any:
    if isinstance(item, np.ndarray):
        values = item.copy()
        values.flat[index] += _at_least_one(step) if item.dtype.kind in "iu" else step
        return values
    if isinstance(item, Decimal):
        quantum = Decimal(1).scaleb(int(item.as_tuple().exponent))
        return item + quantum * int(_at_least_one(step / float(quantum)))
    if isinstance(item, int | float | np.number):
        whole = isinstance(item, int | np.integer)
        return item + (_at_least_one(step) if whole else step)
    if is_dataclass(item) and not isinstance(item, type):
        own = [part.name for part in fields(item) if _within(place, f"{here}.{part.name}")]
        changed = {name: _with_number(getattr(item, name), f"{here}.{name}", place, index, step) for name in own}
        return replace(item, **changed)
    if isinstance(item, Mapping):
        (key,) = (key for key in item if _within(place, f"{here}[{key}]"))
        return {**item, key: _with_number(item[key], f"{here}[{key}]", place, index, step)}
    parts = (f"{here}[{k}]" for k in range(len(item)))
    return type(item)(
        _with_number(value, part, place, index, step) if _within(place, part) else value
        for value, part in zip(item, parts, strict=True)
    )


def with_factor(tables: Any, places: Container[str], factor: float) -> Any:
    """Return tables in which all numbers at these places (of :func:`numbers_of`) are multiplied; whole numbers are rounded."""
    return _with_factor(tables, "", places, factor)


def _with_factor(item: Any, here: str, places: Container[str], factor: float) -> Any:
    if isinstance(item, np.ndarray):
        if here not in places:
            return item
        return np.rint(factor * item).astype(item.dtype) if item.dtype.kind in "iu" else factor * item
    if isinstance(item, int | float | Decimal | np.number):
        if here not in places:
            return item
        whole = isinstance(item, int | np.integer)
        return (
            type(item)(factor) * item if isinstance(item, Decimal) else round(factor * item) if whole else factor * item
        )
    if is_dataclass(item) and not isinstance(item, type):
        parts = {part.name: getattr(item, part.name) for part in fields(item) if part.compare and part.init}
        changed = {name: _with_factor(value, f"{here}.{name}", places, factor) for name, value in parts.items()}
        different = {name: value for name, value in changed.items() if value is not parts[name]}
        return replace(item, **different) if different else item
    if isinstance(item, Mapping):
        made = {key: _with_factor(value, f"{here}[{key}]", places, factor) for key, value in item.items()}
        return made if any(made[key] is not value for key, value in item.items()) else item
    if isinstance(item, Sequence) and not isinstance(item, str | bytes):
        listed = [_with_factor(value, f"{here}[{k}]", places, factor) for k, value in enumerate(item)]
        same = all(new is old for new, old in zip(listed, item, strict=True))
        return item if same else type(item)(listed)  # type: ignore[call-arg]
    return item


def _within(place: str, here: str) -> bool:
    return place == here or place.startswith((f"{here}.", f"{here}["))


def _at_least_one(step: float) -> int:
    return int(math.copysign(max(1, math.ceil(abs(step) - 1e-9)), step))


@dataclass(frozen=True)
class _Sample:
    """Corrections on a grid of points (nx, ny, nz, 3): of the given tables, the best before rounding, of the remade ones.

    ``tool_mm`` (3,) is None for the machine's own. ``slack_mm`` is the difference that rounding explains, same shape.
    """

    position_mm: FloatArray
    tool_mm: FloatArray | None
    own_mm: FloatArray
    best_mm: FloatArray
    made_mm: FloatArray
    slack_mm: FloatArray

    @property
    def miss_mm(self) -> FloatArray:
        """Return the difference beyond what rounding explains, with its sign."""
        miss = self.own_mm - self.best_mm
        return np.asarray(np.sign(miss) * np.maximum(np.abs(miss) - self.slack_mm, 0.0))

    def worst(self, surplus_mm: FloatArray) -> list[str]:
        """Describe for each axis the point with the largest surplus (nx, ny, nz, 3), if positive."""
        found = []
        for output in range(3):
            place = np.unravel_index(int(np.argmax(surplus_mm[..., output])), surplus_mm.shape[:-1])
            if surplus_mm[(*place, output)] > 0.0:
                found.append(self.place(place, output))
        return found

    def place(self, index: tuple[Any, ...], output: int) -> str:
        """Say what the tables contain at a point, and what the errors require."""
        x, y, z = self.position_mm[index]
        tool = "" if self.tool_mm is None else f" with the tool offset {', '.join(f'{k:g}' for k in self.tool_mm)} mm"
        own, best = (part[(*index, output)] / MM_PER_UM for part in (self.own_mm, self.best_mm))
        return (
            f"correction {AXES[output]} at X {x:g} Y {y:g} Z {z:g} mm{tool}: {round(own, 2) + 0.0:+.2f} um in the table, "
            f"the errors require {round(best, 2) + 0.0:+.2f} um"
        )


@dataclass(frozen=True)
class EntryCheck:
    """Given tables, and the tables made from a judge's errors with the same settings.

    ``made`` is None if the control cannot make tables of these errors; ``made_numbers`` are its numbers, ``depends`` says
    which of them depend on the errors at all (positions do not), by place. ``reversal_known`` says whether the reversal is
    part of ``made``.
    """

    machine: Machine
    judge: Judge
    given: ReadTables
    made: ReadTables | None
    made_numbers: Numbers
    depends: Mapping[str, BoolArray]
    reversal_known: bool

    def of(self, tables: ReadTables) -> EntryCheck:
        """Return the check of other tables of the same control and settings; what the errors give stays the same."""
        return replace(self, given=tables)

    @cached_property
    def given_numbers(self) -> Numbers:
        """All numbers of the given tables."""
        return numbers_of(self.given.tables)

    @cached_property
    def changed_in(self) -> Mapping[str, int]:
        """How many numbers differ in each list."""
        return {} if self.made is None else changed_by_list(self.given_numbers, self.made_numbers)

    def reasons(self) -> list[str]:
        """Describe for each axis the place with the largest excess over what the errors require; empty if there is none."""
        within = zip(self._all_nodes(), self.machine.lower_mm, self.machine.upper_mm, strict=True)
        nodes = [nodes[(nodes >= low) & (nodes <= high)] for nodes, low, high in within]
        for sample in self._at_nodes(nodes):
            found = self._wrong_numbers(sample) or self._spikes(sample)
            if found:
                return found
        if self._numbers_differ:
            for side in self._sides:
                found = self._wrong_numbers(self._sample(self.judge.line_mm[None, None], None, side))
                if found:
                    return found
        found = self._wrong_beyond_travel()
        if found:
            return found
        # what the tables add because of the tool: at most as much as the errors require
        ends = _ends(self.machine)
        for axis in range(3):
            levels = [nodes[k] if k == axis else ends[k] for k in range(3)]
            position_mm = full_grid(levels)
            own_tool = self._sample(position_mm, None, None)
            for sample in self._with_tools(position_mm):
                if np.array_equal(sample.own_mm, own_tool.own_mm):
                    break  # these tables do not depend on the tool
                found = self._wrong_numbers(sample) or self._spikes(sample) or self._turned(sample, own_tool)
                if found:
                    return found
        return []

    @property
    def _numbers_differ(self) -> bool:
        """Whether the given tables are the remade ones with some numbers changed."""
        depend = sum(int(part.sum()) for part in self.depends.values())
        return self._few_differ or (self.made is not None and 0 < self.changed <= CHANGED_SHARE * depend)

    @property
    def changed(self) -> int:
        """How many numbers differ."""
        return sum(self.changed_in.values())

    @property
    def _few_differ(self) -> bool:
        return self.made is not None and 0 < self.changed <= FEW_CHANGED

    @property
    def _sides(self) -> tuple[float | None, ...]:
        """Directions of travel to compare; None: the mean of both."""
        sets = [part for part in (self.given, self.made) if part is not None]
        differ = any(part.controller.by_direction(part.tables) for part in sets)
        both = differ and (self.reversal_known or self._few_differ)
        return (1.0, -1.0) if both else (None,)

    # --- where the tables are compared ---------------------------------------------------------------------------

    def _all_nodes(self) -> list[FloatArray]:
        """Nodes of both sets of tables and the travel ends, by axis."""
        sets = [part.controller.table_nodes_mm(part.tables) for part in (self.given, self.made) if part is not None]
        return [
            node_positions(self.machine, np.concatenate([nodes[axis] for nodes in sets]), axis) for axis in range(3)
        ]

    def _at_nodes(self, nodes: Sequence[FloatArray]) -> Iterator[_Sample]:
        for levels in _grids(self.machine, nodes, sum(part.size for part in self.given_numbers.values())):
            position_mm = full_grid(levels)
            for side in self._sides:
                yield self._sample(position_mm, None, side)

    def _sample(self, position_mm: FloatArray, tool_mm: FloatArray | None, side: float | None) -> _Sample:
        flat, shape = position_mm.reshape(-1, 3), position_mm.shape
        best = basis_field(self.judge.solver.basis, self.judge.values, flat, tool_of(self.machine, tool_mm))
        own, made = self._added(self.given, flat, tool_mm, side), best
        slack: FloatArray = np.full(flat.shape, self.judge.resolution_mm)
        if self.made is not None:
            # What the control makes of the best values: rounded, and looked up at the axis positions.
            made = mean = self._added(self.made, flat, tool_mm, None)
            slack = np.maximum(slack, np.abs(mean - best))
            if side is not None:
                made = self._added(self.made, flat, tool_mm, side)
                best = best + made - mean
                if not self.reversal_known:  # a constant backlash in the tables does not come from the errors
                    own = own - np.median(own - self._added(self.given, flat, tool_mm, None), axis=0)
        parts = (np.asarray(part).reshape(shape) for part in (own, best, made, slack))
        return _Sample(position_mm, tool_mm, *parts)

    def _with_tools(self, position_mm: FloatArray) -> Iterator[_Sample]:
        """Yield the sample with each tool: the first alone, since most tables depend on no tool, then all others at once."""
        tools, points = np.array(self.machine.tool_corners_mm).reshape(-1, 3), position_mm.reshape(-1, 3)
        for some in (tools[:1], tools[1:]):
            every = np.tile(points, (len(some), 1)).reshape(1, 1, -1, 3)
            if not len(some):
                return
            found = self._sample(every, np.repeat(some, len(points), axis=0), None)
            parts = (found.own_mm, found.best_mm, found.made_mm, found.slack_mm)
            for k, tool in enumerate(some):
                yield _Sample(position_mm, tool, *(x.reshape(len(some), *position_mm.shape)[k] for x in parts))

    def _added(
        self, tables: ReadTables, position_mm: FloatArray, tool_mm: FloatArray | None, side: float | None
    ) -> FloatArray:
        """Return the correction at points (n, 3) after travel in one direction, or the mean of both, shape (n, 3)."""
        tools = None if tool_mm is None else np.array(np.broadcast_to(tool_mm, position_mm.shape))
        if side is None:
            return tables.mean_correction(self.machine, position_mm, tools)
        added = tables.correction(self.machine, Points(position_mm, tools, np.full_like(position_mm, side)))
        return added - tables.anchor_offset_mm(self.machine)

    # --- what is wrong with them ----------------------------------------------------------------------------------

    def _wrong_numbers(self, sample: _Sample) -> list[str]:
        """Return the places of edited tables where the correction differs by more than the goal.

        If the steps of the format exceed the goal, one number may be rounded to its other neighbour: then it misses the
        best by no more than others do.
        """
        goal = self.judge.goal_mm
        if self._few_differ:
            step = 2.0 * self.judge.resolution_mm
            surplus = np.abs(sample.own_mm - sample.made_mm) - max(FEW_SHARE * goal, min(step, goal)) - 1e-9
            if self.judge.resolution_mm > goal:
                rounding = np.abs(sample.made_mm - sample.best_mm).reshape(-1, 3).max(axis=0) + ROUNDED_SHARE * goal
                surplus[np.abs(sample.own_mm - sample.best_mm) <= rounding] = -1.0
            return sample.worst(surplus)
        if not self._numbers_differ:
            return []
        coarse = COARSE_SHARE * self.judge.bent_mm if self.judge.resolution_mm > goal else 0.0
        explained = CHANGED_UNCERTAINTIES * self._u_mm(sample)
        depend: dict[str, int] = {}
        for place, part in self.depends.items():
            depend[_list_of(place)] = depend.get(_list_of(place), 0) + int(part.sum())
        whole = all(count >= WHOLE_SHARE * depend.get(name, 0) for name, count in self.changed_in.items() if count)
        # If whole lists differ, the tables may be of another measurement; if single numbers in a list do, errors that
        # hardly show in these steps explain one more rounding.
        if not whole:
            explained = np.minimum(explained, self.judge.resolution_mm)
        return sample.worst(np.abs(sample.miss_mm) - max(GOAL_SHARE * goal, coarse) - explained)

    def _u_mm(self, sample: _Sample) -> FloatArray:
        flat = sample.position_mm.reshape(-1, 3)
        return displacement_uncertainty(self.machine, self.judge.errors, flat, sample.tool_mm)

    def _spikes(self, sample: _Sample) -> list[str]:
        """Describe for each axis a single place where the difference changes far more than anywhere else along an axis."""
        # Another rounding shows at single places, by as much as the errors of both tables differ.
        limit = SPIKE_SHARE * self.judge.goal_mm + self.judge.resolution_mm
        miss = sample.miss_mm
        if np.max(np.abs(miss)) <= 0.5 * limit:
            return []
        limits = limit + SPIKE_UNCERTAINTIES * self._u_mm(sample)
        found: dict[int, str] = {}
        for axis in range(3):
            difference, position = np.moveaxis(miss, axis, 2), np.moveaxis(sample.position_mm, axis, 2)
            # steps over the intervals of the axis, less the usual slope of each line
            width = np.diff(position[0, 0, :, axis])[None, None, :, None]
            slope = np.diff(difference, axis=2) / width
            usual = np.median(slope, axis=2, keepdims=True) if width.size else 0.0
            steps = np.abs(slope - usual) * width
            for output in range(3):
                profile = steps[..., output].max(axis=(0, 1), initial=0.0)
                worst = int(np.argmax(profile)) if len(profile) else 0
                others = np.delete(profile, slice(max(worst - 2, 0), worst + 3))
                if len(others) < LEAST_OTHERS:
                    continue
                if profile[worst] > max(limits[output], SPIKE_RATIO * float(others.max())):
                    i, j = np.unravel_index(int(np.argmax(steps[:, :, worst, output])), steps.shape[:2])
                    k = worst + int(np.argmax(np.abs(difference[i, j, worst : worst + 2, output])))
                    index = [int(i), int(j)]
                    index.insert(axis, k)
                    found.setdefault(output, sample.place(tuple(index), output))
        return [found[output] for output in sorted(found)]

    def _wrong_beyond_travel(self) -> list[str]:
        """Compare the tables at their nodes outside the travel, too, if only single numbers were changed."""
        if self.made is None or not self._few_differ:
            return []
        ends = _ends(self.machine)
        for axis, nodes in enumerate(self._all_nodes()):
            low, high = self.machine.axes[axis].range_mm
            beyond = nodes[(nodes < low) | (nodes > high)]
            if not len(beyond):
                continue
            levels = [beyond if k == axis else ends[k] for k in range(3)]
            position_mm = full_grid(levels)
            for side in self._sides:
                flat = position_mm.reshape(-1, 3)
                own, best = (self._added(part, flat, None, side) for part in (self.given, self.made))
                own, best = own.reshape(position_mm.shape), best.reshape(position_mm.shape)
                sample = _Sample(position_mm, None, own, best, best, np.zeros_like(position_mm))
                limit = self.judge.goal_mm + 2.0 * self.judge.resolution_mm
                found = sample.worst(np.abs(sample.miss_mm) - limit)
                if found:
                    return found
        return []

    def _turned(self, sample: _Sample, own_tool: _Sample) -> list[str]:
        own, best = sample.own_mm - own_tool.own_mm, sample.best_mm - own_tool.best_mm
        share = POINT_SHARE * np.ptp(best.reshape(-1, 3), axis=0)
        beyond = np.maximum(own - np.maximum(best, 0.0), np.minimum(best, 0.0) - own)
        limit = np.maximum(self.judge.goal_mm, share) + (sample.slack_mm + own_tool.slack_mm)
        if (beyond <= limit).all():  # the usual case; the uncertainty of the errors only widens the limit
            return []
        return sample.worst(beyond - (limit + POINT_UNCERTAINTIES * self._u_mm(sample)))


def _ends(machine: Machine) -> list[FloatArray]:
    """Return both ends and the middle of the travel, by axis."""
    return [np.array([low, 0.5 * (low + high), high]) for low, high in (axis.range_mm for axis in machine.axes)]


def _grids(machine: Machine, nodes: Sequence[FloatArray], numbers: int) -> Iterator[list[FloatArray]]:
    """Levels of the grids on which every number shows: of all three axes, of pairs, or of one at a time.

    They suffice for tables of that many ``numbers``: a table over two axes has one for each pair of nodes.
    """
    ends, counts = _ends(machine), [len(part) for part in nodes]
    if math.prod(counts) <= max(MOST_NODES, numbers):
        yield list(nodes)
        return
    for axis in range(3):
        first, second = (k for k in range(3) if k != axis)
        if 3 * counts[first] * counts[second] <= max(MOST_NODES, 3 * numbers):
            yield [ends[k] if k == axis else nodes[k] for k in range(3)]
    for axis in range(3):
        yield [nodes[k] if k == axis else ends[k] for k in range(3)]


def entry_check(
    machine: Machine, judge: Judge, given: ReadTables, reversal: ReversalCurves | None = None
) -> EntryCheck:
    """Make the tables again from the errors of the judge, and compare their numbers with the given ones."""
    control = given.controller
    basis, in_tables = judge.solver.basis, None
    try:
        values = table_values(control, machine, judge.errors, judge.solver, judge.values)
        tables = control.build(basis, values)
        half = control.build(basis, {name: 0.5 * part for name, part in values.items()})
        numbers = numbers_of(tables)
        depends = numbers_changed(numbers, numbers_of(half))
        in_tables = None if reversal is None else control.reversal_in_tables(reversal)
        if in_tables is not None and in_tables.curves:
            tables = control.with_reversal(tables, in_tables)
            numbers = numbers_of(tables)
    except (CompgenError, OverflowError):  # these errors are too large for the control: others than it was made of
        return EntryCheck(machine, judge, given, None, {}, {}, reversal_known=False)
    known = in_tables is not None and bool(in_tables.curves)
    made = replace(given, tables=tables, files=(), contradictions=())
    return EntryCheck(machine, judge, given, made, numbers, depends, reversal_known=known)
