"""Readings along one axis from any format, converted to axis runs or to one error over the axis."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from compgen.data.axis_runs import SAME_TARGET_MM, two_way_mean, worth_a_table
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, ReversalCurves, marked_apart
from compgen.data.names import AXES, CURVE_NAMES, MM_PER_UM, RAD_PER_URAD, error_named
from compgen.errors import InputError, nearest

IntArray = NDArray[np.int64]
#: A reading is reported if it is this far from the median, mm or rad, and this many times further than nine in ten
#: others.
_NOTABLE, _FAR = 0.1, 20.0
#: Runs are compared if readings are missing at fewer than this many times as many places as there are readings.
_SPARSE = 100
_AXIS = re.compile(r"(?<![A-Z])([XYZ])[0-9]?(?![A-Z])")


@dataclass(frozen=True)
class OneAxis:
    """n readings along one axis, in the order of the file.

    Parameters
    ----------
    position_mm : targets (n,).
    direction : +1, -1, or 0 if unknown, (n,).
    run : number of the run, from 1, (n,); both directions of a cycle count as one run.
    value : measured minus target (n,), mm or rad.
    line : line of the file, (n,).
    covariates : other numbers by native name (time_s, temp_..._c), each (n,).
    in_time : whether the rows are in the order in which they were measured; tables by target or direction are not.
    """

    position_mm: FloatArray
    direction: IntArray
    run: IntArray
    value: FloatArray
    line: IntArray
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    in_time: bool = False

    def ordered(self) -> OneAxis:
        """Return the rows in order of time: run by run, up then down, unless the file gives another order.

        Rows already in order of time remain; another order (a cycle that begins downwards) is kept in the column
        ``order``, because the order of rows alone never counts as time.
        """
        usual = np.lexsort((self.position_mm * self.direction, -self.direction, self.run))
        if "time_s" in self.covariates and np.isfinite(self.covariates["time_s"]).all():
            return self.rows(np.argsort(self.covariates["time_s"], kind="stable"))
        if not self.in_time or not self.direction.all():
            return self.rows(usual) if self.direction.all() else self
        if np.array_equal(usual, np.arange(len(usual))):
            return self
        return replace(self, covariates={**self.covariates, "order": np.arange(1.0, len(usual) + 1)})

    def rows(self, rows: IntArray) -> OneAxis:
        """Return some of the readings, in the given order."""
        return replace(
            self,
            position_mm=self.position_mm[rows],
            direction=self.direction[rows],
            run=self.run[rows],
            value=self.value[rows],
            line=self.line[rows],
            covariates={name: values[rows] for name, values in self.covariates.items()},
        )

    def negated(self) -> OneAxis:
        """Return the readings with corrections converted to errors."""
        return replace(self, value=-self.value)

    @property
    def targets_mm(self) -> FloatArray:
        """Distinct targets, ascending."""
        rounded = np.round(self.position_mm / SAME_TARGET_MM).astype(np.int64)
        _, first = np.unique(rounded, return_index=True)
        return self.position_mm[first]

    def summary(self) -> dict[str, object]:
        """Return what was measured, in the words of ISO 230-2."""
        targets = self.targets_mm
        ways = [int(way) for way in np.unique(self.direction)]
        return {
            "targets": len(targets),
            "from_mm": float(targets[0]),
            "to_mm": float(targets[-1]),
            "runs": len(np.unique(self.run)),
            "directions": {1: "positive only", -1: "negative only", 0: "unknown"}[ways[0]]
            if len(ways) == 1
            else "both",
            "readings": len(self.value),
            "rms": float(np.sqrt(np.mean(self.value**2))),
            "largest": float(np.max(np.abs(self.value))),
        }


def axis_in(text: str) -> str | None:
    """Return the one axis X, Y or Z that a text names; None if it names none or several.

    >>> axis_in("X axis"), axis_in("y1"), axis_in("XY"), axis_in("spindle")
    ('X', 'Y', None, None)
    """
    found = set(_AXIS.findall(text.upper()))
    return found.pop() if len(found) == 1 else None


def motion(position_mm: FloatArray, run: IntArray) -> IntArray:
    """Direction of travel (n,) from the order of the rows within each run; the first row has that of the second.

    A run of a single target has direction 0, and a repeated target keeps the direction of the row before it.
    """
    order = np.argsort(run, kind="stable")  # all runs at once: a file may have as many as rows
    own, place = run[order], np.arange(len(order))
    begins = np.diff(own, prepend=own[:1] - 1) != 0
    step = np.sign(np.round(np.diff(position_mm[order], prepend=0.0) / SAME_TARGET_MM)).astype(np.int64)
    step[begins] = 0
    start = np.maximum.accumulate(np.where(begins, place, 0))
    last = np.maximum.accumulate(np.where(step != 0, place, -1))
    after = np.minimum.accumulate(np.where(step != 0, place, len(place))[::-1])[::-1]
    ends = np.append(np.flatnonzero(begins)[1:], len(place))[np.cumsum(begins) - 1]
    source = np.where(last > start, last, np.where(after < ends, after, -1))
    direction = np.zeros(len(position_mm), dtype=np.int64)
    direction[order] = np.where(source >= 0, step[source], 0)
    return direction


def cycles(direction: IntArray, one_way: IntArray) -> IntArray:
    """Number of the cycle (n,) for numbers of one-way runs: the k-th run up and the k-th run down are cycle k."""
    result = np.zeros(len(one_way), dtype=np.int64)
    for way in (1, -1, 0):
        rows = direction == way
        _, index = np.unique(one_way[rows], return_inverse=True)
        result[rows] = index + 1
    return result


def earlier_rows(keys: FloatArray) -> tuple[IntArray, IntArray]:
    """Return for each row the first one with the same key, and its number of occurrences so far (from 1), (rows,)."""
    rows = (
        np.ascontiguousarray(keys)
        .view([("", keys.dtype)] * keys.shape[1])
        .ravel()
        .view(f"V{keys.itemsize * keys.shape[1]}")
    )
    _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
    order = np.argsort(inverse.ravel(), kind="stable")
    group = inverse.ravel()[order]
    starts = np.flatnonzero(np.concatenate([[True], group[1:] != group[:-1]]))
    position_in_group = np.arange(len(group)) - np.repeat(starts, np.diff([*starts, len(group)]))
    count = np.empty(len(group), dtype=np.int64)
    count[order] = position_in_group + 1
    return first[inverse.ravel()].astype(np.int64), count


def check_error(error: str, axis: str | None, *, angular: bool) -> str:
    """Return the error given by the user; InputError if it is not one of this axis or has another unit."""
    if error not in CURVE_NAMES:
        raise InputError(f"{error!r} is not an error over an axis; {nearest(error, CURVE_NAMES)}", field="--error")
    known = error_named(error)
    if (known.kind == "angular") != angular:
        expected = "an angle (EAX ... ECZ)" if angular else "a displacement (EXX ... EZZ)"
        raise InputError(f"{error} does not fit: the file contains {expected}", field="--error")
    if axis is not None and AXES[known.axis] != axis:
        raise InputError(f"{error} belongs to axis {AXES[known.axis]}, the file to {axis}", field="--error")
    return error


def errors_of(runs: OneAxis, error: str, metadata: Mapping[str, str]) -> tuple[ErrorTable, ReversalCurves | None]:
    """Return the bidirectional mean over the targets as one error, and the reversal of the axis.

    See :func:`compgen.data.axis_runs.two_way_mean`. The reversal is None for angles, for one direction, and below
    0.1 um.
    """
    centre, reversal, _ = two_way_mean(runs.position_mm, runs.direction, runs.value)
    table = marked_apart(ErrorTable({error: centre}, {}, dict(metadata)))
    name = error_named(error)
    if name.kind != "linear" or reversal is None or not worth_a_table(reversal):
        return table, None
    return table, ReversalCurves({(name.axis, name.direction): reversal}, dict(metadata))


def remarks(runs: OneAxis, axis: str, *, angular: bool) -> list[str]:
    """Return which readings are missing, and which runs are equal to the last digit; nothing for a regular test."""
    found, name = [], f"axis {axis}" if axis else "the axis"
    keys = np.round(runs.position_mm / SAME_TARGET_MM).astype(np.int64)
    _, target = np.unique(keys, return_inverse=True)
    _, rows, one_way = np.unique(2 * runs.run + (runs.direction < 0), return_index=True, return_inverse=True)
    shape = (int(one_way.max()) + 1, int(target.max()) + 1)
    if shape[0] * shape[1] > _SPARSE * len(runs.value):
        shape = (0, shape[1])  # hardly two readings of any run: there are no runs to compare
    table = np.full(shape, np.nan)
    if len(table):
        table[one_way, target] = runs.value
    empty = int(np.isnan(table).sum())
    if empty and len(runs.value) > table.size // 2:
        row, column = np.argwhere(np.isnan(table))[0]
        at = runs.targets_mm[column]
        what = "reading is" if empty == 1 else "readings are"
        found.append(f"{name}: {empty} of {table.size} {what} missing, the first in one-way run {row + 1} at {at:g} mm")
    away = np.abs(runs.value - np.median(runs.value))
    worst = int(np.argmax(away))
    # a reading far outside the spread of the others
    if len(away) >= 3 and away[worst] >= max(_NOTABLE, _FAR * float(np.quantile(np.delete(away, worst), 0.9))):
        at, value = runs.position_mm[worst], runs.value[worst]
        size = f"{value / RAD_PER_URAD:.5g} urad" if angular else f"{value / MM_PER_UM:.5g} um"
        found.append(f"{name}: {size} at {at:g} mm, line {runs.line[worst]}, is far from all others; a mistake?")
    first: dict[bytes, int] = {}
    # copies: equal at three targets or more in the same direction, but not all alike
    whole = ~np.isnan(table).any(axis=1) & (np.ptp(table, axis=1) > 0) if len(table) and table.shape[1] > 2 else []
    for k in np.flatnonzero(whole).tolist():
        values, row = table[k], int(rows[k])
        earlier = first.setdefault(values.tobytes() + bytes([int(runs.direction[row]) + 1]), row)
        if earlier != row:
            pair = f"{int(runs.run[earlier])} and {int(runs.run[row])}"
            found.append(
                f"{name}: runs {pair} are equal to the last digit at every target; is one a copy of the other?"
            )
            break
    return found
