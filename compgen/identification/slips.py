"""Slips in the files of a shop: values in another unit, directions exchanged, runs that are shifted, turned round or copied.

Repeats that disagree are noise only if they disagree without a pattern. A run is compared with the other runs over the same
targets: as it is, and as it would be after each slip that a person makes with a file. A slip is said if it explains what
the run differs by.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import PLANES, Circles
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Deviations
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import InputError, Message

#: Deviations that are all smaller than this are refused: 100 um written in mm.
SMALLEST_UM = 0.1
#: One run or component is compared with all: beside what is a hundred times larger it has another unit.
MUCH_SMALLER = 100.0
#: Fewest targets of runs that are compared: of three and more, of two, whose noise nothing else tells.
FEWEST, FEWEST_OF_TWO = 5, 8
#: A slip must make the rms difference of a run from the others smaller by this factor, and what is left be at most this
#: multiple of the scatter of the others.
BETTER, WITHIN = 4.0, 2.0
#: Differences below this are not worth a word, mm.
WORTH_MM = 0.5 * MM_PER_UM
#: Most pairs of values that are exchanged.
MOST_PAIRS = 4
#: What a value is multiplied by in another unit, with the names of the units.
UNITS = {
    1e-3: "mm", 1e-6: "m", 1e3: "nm", 1.0 / 25.4: "thousandths of an inch", 1e-3 / 25.4: "inches", 10.0: "tenths of a um",
    1e3 / 25.4: "millionths of an inch",
}  # fmt: skip


# --- units -----------------------------------------------------------------------------------------------------------


def check_sizes(measurement: Deviations | AxisRuns | Circles) -> None:
    """Ask for the unit where deviations are all zero, or too small for a machine tool.

    Raises
    ------
    InputError
        for all of them, or for one run or component that is small beside the others: each is judged by itself.
    """
    whole_um = _size_um(measurement, measurement.deviation_mm)
    if whole_um < SMALLEST_UM:
        raise _asked(measurement, "", 0, whole_um)
    for what, rows, values in _groups(measurement):
        size_um = _size_um(measurement, values)
        if 0.0 < size_um < min(SMALLEST_UM, whole_um / MUCH_SMALLER):
            raise _asked(measurement, what, int(rows[0]), size_um)


def _size_um(measurement: Deviations | AxisRuns | Circles, values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    if isinstance(measurement, Circles):  # the gauge has a zero of its own
        return float(np.ptp(known)) / MM_PER_UM if len(known) else 0.0
    return float(np.max(np.abs(known), initial=0.0)) / MM_PER_UM


def _asked(measurement: Deviations | AxisRuns | Circles, what: str, row: int, largest_um: float) -> InputError:
    message = f"{what}all deviations are zero; was nothing measured? Give the measured values"
    if largest_um:
        message = (
            f"{what}the largest deviation is {largest_um:.3g} um, too small for a machine tool; are the values in mm, a "
            "thousand times too small for um? Give them in um"
        )
    file, line = measurement.origin[row] if measurement.origin else (None, None)
    return InputError(
        Message("small-deviations-hint", "{message}, or add --small-deviations if they are right", message=message),
        file=file,
        line=line if what else None,
    )


def _groups(measurement: Deviations | AxisRuns | Circles) -> Iterator[tuple[str, NDArray[np.int64], FloatArray]]:
    """The values of each run, axis, plane and component of each file: what they are, rows, values (mm)."""
    none = np.zeros(len(measurement), dtype=np.int64)
    files = {name: k for k, name in enumerate(dict.fromkeys(str(file) for file, _ in measurement.origin))}
    of_file = np.array([files[str(file)] for file, _ in measurement.origin], dtype=np.int64) if files else none
    if isinstance(measurement, Deviations):
        what, run, names = none, measurement.labels.get("run", none), [""]
    elif isinstance(measurement, AxisRuns):
        what, run, names = measurement.axis, measurement.run, list(AXES)
    else:
        what, run, names = measurement.plane, measurement.run, list(PLANES)
    table = np.column_stack([of_file, what, run]).astype(np.int64)
    for key in np.unique(table, axis=0):
        rows = np.flatnonzero((table == key).all(axis=1))
        if isinstance(measurement, Deviations):
            for k, letter in enumerate("xyz"):
                yield f"d{letter}_um, run {key[2]}: ", rows, measurement.deviation_mm[rows, k]
        else:
            yield f"{names[key[1]]}, run {key[2]}: ", rows, measurement.deviation_mm[rows]


# --- repeats ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Repeats:
    """Runs over the same targets in one direction: ``what`` they are of, numbers of the runs, targets, values (runs, n), mm.

    ``back`` are the values of the same runs in the other direction of travel, if these have the same targets.
    """

    what: str
    runs: Sequence[int]
    targets: Sequence[str]
    values: FloatArray
    back: FloatArray | None = None


def patterns(measurement: Deviations | AxisRuns | Circles) -> tuple[str, ...]:
    """Return what is wrong with runs of a measurement that differ from the others in a way that a slip explains."""
    found: dict[str, None] = {}
    for repeats in _repeats(measurement):
        for text in _patterns(repeats):
            found[text] = None
    return tuple(found)


def _repeats(measurement: Deviations | AxisRuns | Circles) -> Iterator[Repeats]:
    if isinstance(measurement, AxisRuns):
        for axis in measurement.axes:
            own = measurement.axis == axis
            keys = np.round(measurement.position_mm[own], 4)
            rows = _table(keys, measurement.direction[own], measurement.run[own], measurement.deviation_mm[own])
            yield from _by_way(f"{AXES[axis]}", rows, lambda key: f"{key:g} mm")
    elif isinstance(measurement, Circles):
        keys = np.column_stack([measurement.plane, measurement.setup, measurement.radius_mm,
                                measurement.covariates.get("feed_mm_min", np.zeros(len(measurement)))])  # fmt: skip
        for key in np.unique(keys, axis=0):
            own = (keys == key).all(axis=1)
            angle = np.round(np.degrees(measurement.angle_rad[own]) % 360.0, 3)
            rows = _table(angle, measurement.direction[own], measurement.run[own], measurement.deviation_mm[own])
            yield from _by_way(f"circle in {list(PLANES)[int(key[0])]}", rows, lambda key: f"{key:g} degrees")
    elif "run" in measurement.labels:
        places = [
            f"({', '.join(f'{value:g}' for value in row)})" for row in np.round(measurement.position_mm, 4).tolist()
        ]
        order = {place: k for k, place in enumerate(dict.fromkeys(places))}
        keys = np.array([order[place] for place in places], dtype=np.float64)
        names = list(order)
        for k, letter in enumerate("xyz"):
            known = np.isfinite(measurement.deviation_mm[:, k])
            ways = np.zeros(int(known.sum()), dtype=np.int64)
            rows = _table(keys[known], ways, measurement.labels["run"][known], measurement.deviation_mm[known, k])
            yield from _by_way(f"d{letter}_um", rows, lambda key: names[int(key)])


_Table = Mapping[int, tuple[list[int], FloatArray, FloatArray]]


def _table(key: FloatArray, way: NDArray[np.int64], run: NDArray[np.int64], value: FloatArray) -> _Table:
    """Runs, targets and values (runs, n) by direction, at the targets that all runs of a direction have once."""
    found = {}
    for one in np.unique(way).tolist():
        own = way == one
        runs = np.unique(run[own])
        columns = [
            dict(zip(key[own & (run == r)].tolist(), value[own & (run == r)].tolist(), strict=True)) for r in runs
        ]
        shared = sorted(set(columns[0]).intersection(*columns[1:]))
        if len(runs) > 1 and len(shared) >= (FEWEST if len(runs) > 2 else FEWEST_OF_TWO):
            values = np.array([[column[at] for at in shared] for column in columns])
            found[one] = runs.tolist(), np.array(shared), values
    return found


def _by_way(what: str, table: _Table, named: Callable[[float], str]) -> Iterator[Repeats]:
    for way, (runs, targets, values) in table.items():
        other = table.get(-way)
        back = None
        if way and other is not None and other[0] == runs and np.array_equal(other[1], targets):
            back = other[2]
        direction = f", direction {way}" if way else ""
        yield Repeats(f"{what}{direction}", runs, [named(at) for at in targets.tolist()], values, back)


def _patterns(repeats: Repeats) -> Iterator[str]:
    agreeing = _agreeing(repeats.values)
    for k, run in enumerate(repeats.runs):
        alike = [j for j in agreeing if j != k] or [j for j in range(len(repeats.runs)) if j != k]
        others = repeats.values[alike]
        usual, own, scatter = np.median(others, axis=0), repeats.values[k], _scatter(others)
        if any((np.abs(own - other) == 0.0).all() for other in others) or not np.ptp(usual):
            continue
        level, plain = _rms(_level(own - usual)), _rms(own - usual)
        best: tuple[float, float, str] | None = None
        for after, text, at_level in _slips(repeats, k, usual):
            was = level if at_level else plain
            if (
                was < WORTH_MM
                or was < BETTER * max(after, scatter)
                or (scatter and after > WITHIN * scatter + 0.1 * WORTH_MM)
            ):
                continue
            if best is None or after < best[0]:
                best = after, was, text
        if best is not None and not (len(repeats.runs) == 2 and k == 0):  # of two, it is said once
            yield _told(repeats, run, alike, best)


def _told(repeats: Repeats, run: int, alike: Sequence[int], best: tuple[float, float, str]) -> str:
    """Say which run disagrees with which others, in which pattern, and by how much."""
    names = ", ".join(str(repeats.runs[j]) for j in alike)
    against = (
        "the other runs" if len(alike) == len(repeats.runs) - 1 > 1 else f"run{'s' if len(alike) > 1 else ''} {names}"
    )
    unsure = " (which of them is right, the file does not tell)" if 2 * len(alike) <= len(repeats.runs) else ""
    after_um, was_um = best[0] / MM_PER_UM, best[1] / MM_PER_UM
    return (
        f"{repeats.what}, run {run} disagrees with {against} in a pattern, which is no noise{unsure}: it agrees if {best[2]}: "
        f"then it differs by {after_um:.2g} um rms, as it is by {was_um:.2g} um; correct the file, or leave the run out"
    )


def _agreeing(values: FloatArray) -> list[int]:
    """Indices of the runs (runs, n) that agree with each other, the larger group: all of them if there is no other."""
    level = values - values.mean(axis=1, keepdims=True)
    apart = np.sqrt(np.mean((level[:, None] - level[None, :]) ** 2, axis=2))
    middle = int(np.argmin(np.sort(apart, axis=1)[:, : len(values) // 2 + 1].sum(axis=1)))
    order = np.argsort(apart[middle], kind="stable")
    size = np.maximum(apart[middle][order], 0.1 * WORTH_MM)
    if len(values) < 3:
        return list(range(len(values)))
    step = size[2:] / size[1:-1]
    if step.max() <= BETTER:
        return list(range(len(values)))
    cut = int(np.argmax(step)) + 2
    if 2 * cut == len(values) and 0 not in order[:cut]:  # two halves: that of the first run, in both directions
        return sorted(order[cut:].tolist())
    return sorted(order[:cut].tolist())


def _slips(repeats: Repeats, k: int, usual: FloatArray) -> Iterator[tuple[float, str, bool]]:
    """Rms difference of a run from the others after each slip, what it is, and whether a constant was taken off."""
    own, at = repeats.values[k], repeats.targets
    count = len(own)
    for step in (1, -1):
        moved = own[:-1] - usual[1:] if step > 0 else own[1:] - usual[:-1]
        first, second = (at[0], at[1]) if step > 0 else (at[1], at[0])
        yield _rms(_level(moved)), f"its values are shifted by one target (that at {first} belongs to {second})", True
    yield _rms(_level(own - usual[::-1])), f"its values are turned round (that at {at[0]} belongs to {at[-1]})", True
    yield _rms(_level(own + usual)), "the sign of its values is the opposite one", True
    for factor, unit in UNITS.items():
        yield _rms(own - factor * usual) / min(factor, 1.0), f"its values are {unit} and not um", False
    yield from _exchanged(own, usual, at)
    rest = _level(own - usual)
    far = int(np.argmax(np.abs(own - usual - np.median(own - usual))))
    kept = np.arange(count) != far
    off_um = float(rest[far] - rest[kept].mean()) / MM_PER_UM
    yield (
        _rms(_level((own - usual)[kept])),
        f"its value at {at[far]} is left out, which is off by {off_um:+.3g} um",
        True,
    )
    if repeats.back is not None:
        back, there = np.delete(repeats.back, k, axis=0), np.delete(repeats.values, k, axis=0)
        turned = np.concatenate([own - np.median(back, axis=0), repeats.back[k] - np.median(there, axis=0)])
        yield _rms(turned), "its directions are exchanged (1 and -1)", False
        yield _rms(own - np.median(back, axis=0)), "it was measured in the other direction than labelled", False


def _exchanged(own: FloatArray, usual: FloatArray, at: Sequence[str]) -> Iterator[tuple[float, str, bool]]:
    """Exchange the pairs of values that bring a run closest to the others."""
    values, pairs = own.copy(), []
    most = min(MOST_PAIRS, len(own) // 3)
    for _ in range(most):
        now = _level(values - usual)
        # exchanging i and j changes the sum of squares by 2 (v_i - v_j)(u_i - u_j)
        gain = (values[:, None] - values[None, :]) * (usual[:, None] - usual[None, :])
        i, j = divmod(int(np.argmin(gain)), len(own))
        if gain[i, j] >= 0.0 or _rms(now) < 0.1 * WORTH_MM:
            break
        values[[i, j]] = values[[j, i]]
        pairs.append(f"{at[min(i, j)]} and {at[max(i, j)]}")
        listed = "; ".join(sorted(pairs))
        yield _rms(_level(values - usual)), f"values are exchanged ({listed})", True


def _scatter(others: FloatArray) -> float:
    """Rms scatter of runs about their mean, each with a constant of its own, mm; 0 for a single run."""
    if len(others) < 2:
        return 0.0
    level = others - others.mean(axis=1, keepdims=True)
    freedom = (len(others) - 1) * (others.shape[1] - 1)
    return float(np.sqrt(np.sum((level - level.mean(axis=0)) ** 2) / freedom))


def _level(values: FloatArray) -> FloatArray:
    return np.asarray(values - values.mean())


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def copies(runs: AxisRuns) -> tuple[str, ...]:
    """Return which runs have exactly the values of another one: a file that was given or pasted twice counts double."""
    found = []
    for repeats in _repeats(runs):
        for k, run in enumerate(repeats.runs):
            same = [repeats.runs[j] for j in range(k) if np.array_equal(repeats.values[j], repeats.values[k])]
            if same and np.ptp(repeats.values[k]):
                found.append(f"{repeats.what}, run {run} has exactly the values of run {same[0]}: a copy counts twice")
    return tuple(found)
