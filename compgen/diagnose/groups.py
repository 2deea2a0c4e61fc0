"""The groups of columns that a diagnosis chooses from: effects of the catalogue, smooth terms, richer base curves."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.sparse import csr_array

from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES
from compgen.diagnose.base_fit import (
    DEGREE,
    BaseFit,
    CurveBasis,
    Part,
    along,
    first_basis,
    fit_base,
    legendre,
    orthonormal,
    size_of,
    tip_columns,
    values_of,
    wider_bases,
)
from compgen.diagnose.layout import IntArray, MeasurementLayout
from compgen.diagnose.observed import Observed
from compgen.effects import Effect, Readings, catalogue
from compgen.errors import CompgenWarning
from compgen.kinematics.exact_chain import exact_columns

# Groups of columns that a diagnosis chooses from: effects of the catalogue and unnamed smooth terms.


Tier = Literal["named", "generic", "base"]


@dataclass(frozen=True)
class Placed:
    """Columns (n, k) = place @ values; a term in position or time has one row of ``values`` (T, k) per stop.

    ``place`` (n, T) contains the direction of each reading; if it is None, ``values`` are the columns.
    """

    values: FloatArray
    place: csr_array | None = None

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.values.shape[1])

    def columns(self, out: FloatArray | None = None) -> FloatArray:
        """All columns, (n, k), written to ``out`` if given."""
        found = self.values if self.place is None else np.asarray(self.place @ self.values)
        if out is None:
            return found
        out[:] = found
        return out

    def products(self, vectors: FloatArray, summed: dict[int, FloatArray]) -> FloatArray:
        """Products (k, q) with vectors (n, q); ``summed`` caches the products with ``place``, which terms share."""
        if self.place is None:
            return np.asarray(self.values.T @ vectors)
        if id(self.place) not in summed:
            summed[id(self.place)] = np.asarray(self.place.T @ vectors)
        return np.asarray(self.values.T @ summed[id(self.place)])


@dataclass(frozen=True)
class Scanned:
    """Columns of neighbouring scan positions, ``each`` per position: adjacent steps differ in only a few readings.

    ``changes`` (n, k): the columns of the first position, then the change of each position from the previous one.
    """

    changes: csr_array
    each: int

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.changes.shape[1])

    def columns(self, out: FloatArray | None = None) -> FloatArray:
        """All columns, (n, k), written to ``out`` if given."""
        found = np.empty(self.changes.shape) if out is None else out
        found[:] = 0.0
        changes = self.changes.tocoo()
        found[changes.row, changes.col] = changes.data
        by_position = found.reshape(len(found), -1, self.each)
        np.cumsum(by_position, axis=1, out=by_position)
        return found

    def products(self, vectors: FloatArray, _: dict[int, FloatArray]) -> FloatArray:
        """Products (k, q) with vectors (n, q)."""
        found = np.asarray(self.changes.T @ vectors)
        return np.asarray(np.cumsum(found.reshape(-1, self.each, found.shape[1]), axis=0).reshape(found.shape))


@dataclass(frozen=True)
class Group:
    """Columns (n, k) that enter the model together.

    Parameters
    ----------
    name : of the effect, or a description of the smooth term.
    tier : ``"named"``, ``"generic"``, or ``"base"`` for columns of the base model, which are never reported.
    source, place : the source of the columns (change of each reading per unit), and which of them belong to this group.
    effect : the effect of the catalogue, with its scan position fixed.
    scans : number of scan positions, of which this is one.
    position : its scan position.
    covariates, direction : what a generic term depends on, and how it acts (``dX``, ``length``).
    slow : whether it depends on time or temperature.
    predicts : whether it can predict left-out readings.
    """

    name: str
    tier: Tier
    source: Placed | Scanned
    place: slice | None = None
    effect: Effect | None = None
    scans: int = 1
    position: float | None = None
    covariates: tuple[str, ...] = ()
    direction: str = ""
    slow: bool = False
    predicts: bool = True

    @property
    def columns(self) -> FloatArray:
        """Change of each reading per unit, (n, k); recomputed at each call."""
        return self.source.columns()[:, self.place or slice(None)]


#: An axis that moves by less than this is at rest, and positions closer than this are one level, mm.
SAME_MM = 1e-3
#: Least levels of an axis that show a periodic error: twice the coefficients of the curves.
LEAST_LEVELS = 2 * (DEGREE + 1)
#: Columns of unit length with a singular value below this are not independent.
DEPENDENT = 1e-6
#: A column below this (mm per unit of its parameter) is rounding: the effect of an axis that stands at its zero.
ROUNDING = 1e-9
#: Maximum number of scan positions of an effect.
MOST_SCANS = 400
#: Scan positions whose columns are stored together; share of changed readings below which only the changes are stored.
TOGETHER, LEAST_CHANGED = 64, 0.2


def named_groups(readings: Readings, only: Sequence[str] = ()) -> tuple[list[Group], list[str]]:
    """Return the groups of the catalogue, one per scan position, and the names without the covariate they need."""
    groups: list[Group] = []
    missing: list[str] = []
    for name, effect in catalogue(readings.stations).items():
        if (only and name not in only) or readings.kind not in effect.card.kinds:
            continue
        if not _can_show(effect, readings):
            missing.append(name)
            continue
        positions = list(effect.positions(readings))
        before = len(groups)
        if len(positions) > MOST_SCANS:
            positions = [positions[k] for k in np.linspace(0, len(positions) - 1, MOST_SCANS).astype(int)]
        choices: list[float | None] = [*positions] if positions else [None]
        for first in range(0, len(choices), TOGETHER):
            found = []
            for position in choices[first : first + TOGETHER]:
                fixed = (effect if position is None else effect.at(position)).shown(readings)
                columns = None if fixed is None else fixed.columns(readings)
                if fixed is not None and columns is not None and _independent(fixed, columns):
                    found.append((position, fixed, columns))
            if not found:
                continue
            source = source_of([columns for _, _, columns in found])
            ends = np.cumsum([0, *(columns.shape[1] for _, _, columns in found)]).tolist()
            for k, (position, fixed, _) in enumerate(found):
                place, card = slice(ends[k], ends[k + 1]), fixed.card
                groups.append(
                    Group(
                        name,
                        "named",
                        source,
                        place,
                        fixed,
                        max(len(positions), 1),
                        position,
                        card.covariates,
                        slow=len(positions) > 1,
                    )
                )
        if len(groups) == before:
            missing.append(name)
    return groups, missing


def _can_show(effect: Effect, readings: Readings) -> bool:
    """Whether the axis of an effect moves, and its positions are close enough to show a wave."""
    axis = getattr(effect, "axis", None)
    if axis is None or effect.card.name.startswith(("spindle_growth", "settling")):
        return True
    position = readings.position_mm[:, axis]
    if np.ptp(position) < SAME_MM:
        return False
    # what a few levels leave over of a curve of the machine alternates from level to level, as waves of any pitch may
    levels = len(np.unique(np.round(position / SAME_MM)))
    return not effect.card.name.startswith("periodic") or levels >= LEAST_LEVELS


def _independent(effect: Effect, columns: FloatArray) -> bool:
    """Whether columns (n, k) are finite, and none is a sum of others: products with an axis at rest are."""
    if not np.isfinite(columns).all() or np.abs(columns).max() < ROUNDING:
        return False
    if columns.shape[1] == 1 or effect.card.name.startswith("periodic"):
        return True
    size = np.linalg.norm(columns, axis=0)
    return bool(size.min() > ROUNDING) and int(np.linalg.matrix_rank(columns / size, tol=DEPENDENT)) == columns.shape[1]


def source_of(every: Sequence[FloatArray]) -> Placed | Scanned:
    """Columns of neighbouring scan positions: all of them, or their changes if those are few."""
    width = every[0].shape[1]
    if len(every) > 1 and all(columns.shape[1] == width for columns in every):  # scanning a degree changes the number
        changes = [every[0], *(after - before for before, after in pairwise(every))]
        places = [np.flatnonzero(change) for change in changes]
        if sum(map(len, places)) < LEAST_CHANGED * len(changes) * changes[0].size:
            values = np.concatenate([change.ravel()[place] for change, place in zip(changes, places, strict=True)])
            rows = np.concatenate([place // width for place in places])
            columns = np.concatenate([width * k + place % width for k, place in enumerate(places)])
            return Scanned(csr_array((values, (rows, columns)), shape=(len(every[0]), width * len(every))), width)
    return Placed(np.hstack(every))


def check_names(names: Sequence[str], stations: Sequence[str]) -> None:
    """Warn of names that are not effects of the catalogue."""
    unknown = [name for name in names if name not in catalogue(stations)]
    if unknown:
        warnings.warn(f"{', '.join(unknown)}: no such effect", CompgenWarning, stacklevel=3)


# Unnamed smooth terms: what an effect that is not in the catalogue would look like.
#
# They are searched together with the effects of the catalogue. If one of them wins, the verdict is "unknown", with the
# covariates that it depends on and the direction in which it acts.


Columns = dict[str, FloatArray]
#: Narrow bumps along each axis.
BUMPS = 12
#: With more lines than this, lines do not get separate offsets.
MOST_LINES = 400


def _scaled(values: FloatArray) -> FloatArray:
    """Values shifted and scaled to -1 ... +1."""
    low, high = float(values.min()), float(values.max())
    return np.asarray((2.0 * values - low - high) / (high - low) if high > low else np.zeros_like(values))


def _times(first: FloatArray, second: FloatArray) -> FloatArray:
    """All products of the columns (n, a) and (n, b), (n, a b)."""
    return np.asarray((first[:, :, None] * second[:, None, :]).reshape(len(first), -1))


@dataclass(frozen=True)
class Covariates:
    """Covariates of the readings, scaled to -1 ... +1; covariates not logged or constant are None or absent."""

    readings: Readings
    layout: MeasurementLayout
    s: FloatArray
    time: FloatArray
    temperature: dict[str, FloatArray]
    approach: FloatArray | None
    feed: FloatArray | None
    load: FloatArray | None
    setups: FloatArray
    in_run: FloatArray
    line: IntArray

    @property
    def quadratic(self) -> FloatArray:
        """1, x, y, z and their products of second order, (n, 10); without those of an axis at rest."""
        x, y, z = self.s.T
        columns = [np.ones(len(x)), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
        return np.column_stack([column for column in columns if np.any(column)])


def covariates_of(readings: Readings, layout: MeasurementLayout) -> Covariates:
    """Collect and scale the covariates."""
    logged = {n: v for n, v in readings.covariates.items() if np.isfinite(v).all() and np.ptp(v) > 0}
    setup = readings.labels.get("setup", np.zeros(len(readings), dtype=np.int64))
    kinds = np.unique(setup)
    approach = readings.approach if readings.approach is not None and np.any(readings.approach) else None
    return Covariates(
        readings,
        layout,
        np.column_stack([_scaled(readings.position_mm[:, axis]) for axis in range(3)]),
        _scaled(layout.time)[layout.stop],
        {n[5:-2]: _scaled(v) for n, v in logged.items() if n.startswith("temp_")},
        approach,
        _scaled(logged["feed_mm_min"]) if "feed_mm_min" in logged else None,
        _scaled(logged["load_kg"]) if "load_kg" in logged else None,
        (setup[:, None] == kinds[None, 1:]).astype(np.float64),
        layout.in_run[layout.stop],
        layout.condition[layout.stop],
    )


#: One generic term: description, covariates, columns that act in each of the three directions, slow, predicts.
Term = tuple[str, tuple[str, ...], FloatArray, bool, bool]


def _static_terms(c: Covariates) -> Iterator[Term]:
    s, moves = c.s, np.any(c.s, axis=0)
    for a, letter in enumerate("xyz"):
        if not moves[a]:
            continue
        yield f"fine structure in {letter}", (letter,), legendre(s[:, a], DEGREE + 6)[:, DEGREE + 1 :], False, True
        centres = np.linspace(-1, 1, BUMPS)
        yield f"bumps in {letter}", (letter,), np.exp(-(((s[:, [a]] - centres) * BUMPS / 2) ** 2)), False, True
    powers = [legendre(s[:, a], 3)[:, 1:] for a in range(3)]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        if not (moves[a] and moves[b]):
            continue
        yield f"{'xyz'[a]} with {'xyz'[b]}", ("xyz"[a], "xyz"[b]), _times(powers[a], powers[b]), False, True
    if not moves.all():
        return
    triple = _times(_times(powers[0][:, :2], powers[1][:, :2]), powers[2][:, :2])
    yield "x with y with z", ("x", "y", "z"), triple, False, True


def _condition_terms(c: Covariates) -> Iterator[Term]:
    for a, letter in enumerate("xyz" if c.approach is not None else ""):
        assert c.approach is not None
        sign = c.approach[:, [a]]
        if not np.any(sign) or np.all(sign == sign[0]):
            continue
        name = f"approach_{letter}"
        yield f"direction of {letter}", (name,), sign, False, True
        moving = [b for b in range(3) if np.any(c.s[:, b])]
        if moving:
            position = np.hstack([legendre(c.s[:, b], 3)[:, 1:] for b in moving])
            along = (name, *("xyz"[b] for b in moving))
            yield f"direction of {letter} with position", along, sign * position, False, True
        if c.temperature:
            warm = np.column_stack(list(c.temperature.values()))
            yield f"direction of {letter} with temperature", (name, "temperature"), sign * warm, True, True
        yield f"direction of {letter} with time", (name, "time"), sign * legendre(c.time, 2)[:, 1:], True, True
        for what, values in (("feed", c.feed), ("load", c.load)):
            if values is not None:
                columns = sign * np.column_stack([values, values**2])
                yield f"direction of {letter} with {what}", (name, what), columns, False, True
        others = [b for b in range(3) if b > a]
        if others:
            yield f"directions of {letter} and others", (name,), sign * c.approach[:, others], False, True
    for what, values in (("feed", c.feed), ("load", c.load)):
        if values is None:
            continue
        x, y, z = c.s.T
        shape = np.column_stack([c.quadratic, *([x * y * z] if np.any(x * y * z) else [])])
        yield f"{what} with position", (what, "x", "y", "z"), values[:, None] * shape, False, True
        yield f"{what} squared", (what,), np.column_stack([values**2, values**3]), False, True
        yield f"{what} with time", (what, "time"), values[:, None] * legendre(c.time, 2)[:, 1:], True, True
    if c.setups.shape[1]:
        columns = _times(c.setups, c.quadratic)
        yield "set-up with position", ("setup", "x", "y", "z"), columns, False, True


def _slow_terms(c: Covariates) -> Iterator[Term]:
    yield "time", ("time",), legendre(c.time, 4)[:, 1:], True, True
    for a, letter in enumerate("xyz"):
        if not np.any(c.s[:, a]):
            continue
        columns = _times(legendre(c.time, 2)[:, 1:], legendre(c.s[:, a], 2)[:, 1:])
        yield f"time with {letter}", ("time", letter), columns, True, True
    for name, values in c.temperature.items():
        covariates = (f"temp_{name}", "x", "y", "z")
        yield f"temperature {name} with position", covariates, values[:, None] * c.quadratic, True, True
        yield f"temperature {name} squared", (f"temp_{name}",), np.column_stack([values, values**2]), True, True
    if np.ptp(c.in_run) > 0:
        columns = np.column_stack([legendre(c.in_run, 2)[:, 1:], np.exp(-3.0 * (c.in_run + 1.0))])
        yield "place in the run", ("in_run",), columns, False, True


def _line_terms(c: Covariates) -> Iterator[Term]:
    lines = int(c.line.max()) + 1
    if 3 <= lines <= MOST_LINES and len(c.line) >= 8 * lines:
        columns = (c.line[:, None] == np.arange(lines)).astype(np.float64)
        yield "offset of each line", ("line",), columns, False, False


TERMS: Sequence[Callable[[Covariates], Iterator[Term]]] = (
    _static_terms,
    _condition_terms,
    _slow_terms,
    _line_terms,
)


def _station_terms(c: Covariates) -> Iterator[Term]:
    """Terms along the beam of one station."""
    range_mm, u = _scaled(c.readings.range_mm), c.readings.direction
    azimuth = np.arctan2(u[:, 1], u[:, 0])
    waves = np.column_stack([f(k * azimuth) for k in range(1, 7) for f in (np.cos, np.sin)])
    yield "range", ("range",), legendre(range_mm, 4)[:, 1:], False, True
    yield "beam azimuth", ("azimuth",), waves, False, True
    yield "beam elevation", ("elevation",), legendre(u[:, 2], 5)[:, 1:], False, True
    if c.temperature:
        warm = np.column_stack(list(c.temperature.values()))
        yield "temperatures", ("temperature",), warm, True, True
        yield "range with temperatures", ("range", "temperature"), range_mm[:, None] * warm, True, True
    yield "position", ("x", "y", "z"), c.quadratic[:, 1:], False, True
    yield "time", ("time",), legendre(c.time, 4)[:, 1:], True, True
    moved = legendre(c.time, 2)[:, 1:]
    yield "time with beam", ("time", "beam"), _times(moved, np.column_stack([u, range_mm])), True, True
    yield from _line_terms(c)


def _common_length_terms(c: Covariates) -> Iterator[Term]:
    """Terms that act equally along the beam of every station."""
    r = c.readings
    range_mm = _scaled(r.range_mm)
    yield "range", ("range",), legendre(range_mm, 4)[:, 1:], False, True
    yield "time", ("time",), legendre(c.time, 4)[:, 1:], True, True
    yield (
        "range with time",
        ("range", "time"),
        _times(legendre(range_mm, 2)[:, 1:], legendre(c.time, 2)[:, 1:]),
        True,
        True,
    )
    yield "beam elevation", ("elevation",), legendre(r.direction[:, 2], 5)[:, 1:], False, True
    if c.temperature:
        warm = np.column_stack(list(c.temperature.values()))
        yield "range with temperatures", ("range", "temperature"), range_mm[:, None] * warm, True, True
    for what, values in (("feed", c.feed), ("load", c.load)):
        if values is not None:
            columns = np.column_stack([values, values**2, values * range_mm])
            yield f"{what} along the beam", (what, "range"), columns, False, True


def generic_groups(readings: Readings, layout: MeasurementLayout) -> list[Group]:
    """Return the generic groups for the readings."""
    c = covariates_of(readings, layout)
    stop, count = layout.stop, len(readings)
    first = np.unique(stop, return_index=True)[1]
    places: dict[tuple[str, bool], csr_array] = {}

    def groups_of(term: Term, ways: Sequence[tuple[str, str, tuple[str, ...], FloatArray]]) -> list[Group]:
        # one group for each way a term acts (suffix of the name, direction, extra covariates, weight of each reading)
        text, covariates, columns, slow, predicts = term
        groups = []
        by_stop = columns[first]
        same = np.array_equal(by_stop[stop], columns)
        for ending, direction, more, weight in ways:
            rows = np.flatnonzero(weight)
            at = stop[rows] if same else np.arange(len(rows))
            key = ending, same
            if key not in places:
                shape = (count, layout.stops if same else len(rows))
                places[key] = csr_array((weight[rows], (rows, at)), shape=shape)
            source = Placed(by_stop if same else columns[rows], places[key])
            groups.append(
                Group(
                    text + ending, "generic", source, covariates=(*covariates, *more), direction=direction, slow=slow,
                    predicts=predicts,
                )
            )  # fmt: skip
        return groups

    axes = [(f" in d{AXES[k]}", f"d{AXES[k]}", (), readings.direction[:, k]) for k in range(3)]
    axes = [way for way in axes if np.any(way[3])]
    groups = [group for terms in TERMS for term in terms(c) for group in groups_of(term, axes)]
    if readings.kind == "lengths":
        every = [(" (all stations)", "length", (), np.ones(count))]
        groups += [group for term in _common_length_terms(c) for group in groups_of(term, every)]
        beams = [
            (f" of {name}", "length", (f"station_{name}",), (readings.station == k).astype(np.float64))
            for k, name in enumerate(readings.stations)
        ]
        of_terms = [groups_of(term, beams) for term in _station_terms(c)]
        groups += [group for of_station in zip(*of_terms, strict=True) for group in of_station]
    return groups


def base_groups(readings: Readings) -> list[Group]:
    """Terms of the base model that are fitted only if the data require them: the tilt of the tools."""
    tools = readings.tool_mm
    spread = tools - tools.mean(axis=0)
    if readings.kind == "axis" or np.abs(spread).max() < 1e-6:
        return []
    columns = np.cross(tools, readings.direction)  # u . (eps x t) = eps . (t x u)
    return [Group("tilt of the tool", "base", Placed(columns))]


# Richness of the base model: smooth curves first; steeper curves and nodes take part in the search.
#
# Nodes could absorb an effect that repeats along an axis, and what a named effect explains with few parameters should
# not go into the machine errors. The wider curves of an axis are therefore one group of the search, charged for every
# column, and are added to the base model only if they win.


#: Directions of new columns with less than this (squared) left after projecting out the old ones are ignored.
LEAST_SQUARE = 1e-6
#: Wider curves are examined if their chi-square exceeds its mean by this many standard deviations.
CHANCE = 4.0


@dataclass(frozen=True)
class Wider:
    """A wider basis of one axis that the readings may require, and its added columns as a group of the search."""

    axis: int
    basis: CurveBasis
    group: Group


def fit_smooth(observed: Observed) -> BaseFit:
    """Fit the smooth base model."""
    poses = observed.poses
    basis = first_basis(observed.machine, poses.position_mm, len(observed), len(poses.position_mm))
    return fit_base(observed, basis)


def wider_of(fit: BaseFit) -> tuple[Wider, ...]:
    """Preselection: for each axis, the wider basis with the largest likelihood ratio, if one explains more than chance."""
    if not fit.basis.errors:
        return ()
    poses, machine = fit.observed.poses, fit.observed.machine
    old = fit.basis.parts(poses.position_mm)
    errors = values_of(old, fit.unknowns, len(poses.position_mm))
    by_errors = exact_columns(machine, errors, poses.position_mm, poses.tool_mm)[1]
    readings = along(fit.readings.direction, poses)
    base = orthonormal(fit.jacobian)
    found: list[Wider] = []
    for axis in range(3):
        best, least = None, -np.inf
        for basis in wider_bases(fit.basis, axis, poses.position_mm, len(fit.observed)):
            # Derivative of the readings, at the fit, by the coefficients that the wider curves add.
            added: list[Part] = []
            for before, after in zip(old, basis.parts(poses.position_mm), strict=True):
                more = after.basis[:, before.basis.shape[1] :]
                added.append(Part(after.name, slice(size_of(added), size_of(added) + more.shape[1]), more))
            if not size_of(added):  # no error of the model depends on this axis
                continue
            columns = np.asarray(readings @ tip_columns(added, by_errors).reshape(-1, size_of(added)))
            gain, count = _gain(fit, base, columns)
            log_ratio = gain - count * (1.0 + np.log(max(gain / max(count, 1), 1.0)))
            if count and gain > count + CHANCE * np.sqrt(2.0 * count) and log_ratio > least:
                best, least = (basis, columns), log_ratio
        if best is not None:
            # the visible share of a group refers to its whole span, which includes the curves of the fit
            whole = Placed(np.hstack([fit.jacobian[:, : size_of(old)], best[1]]))
            found.append(Wider(axis, best[0], Group(f"wider curves of {AXES[axis]}", "base", whole)))
    return tuple(found)


def widened(fit: BaseFit, taken: Sequence[Wider]) -> BaseFit:
    """Refit the base model with the wider bases ``taken``."""
    basis = fit.basis
    for item in taken:
        basis = basis.with_axis(item.axis, item.basis)
    return fit_base(fit.observed, basis, start=_extended(fit, basis))


def _gain(fit: BaseFit, base: FloatArray, extra: FloatArray) -> tuple[float, int]:
    """Gain in chi-square from columns added to the base model, over the residual variance, and how many are new.

    ``base`` is an orthonormal basis of its Jacobian.
    """
    norm = np.sqrt(np.maximum(np.einsum("nk,nk->k", extra, extra), 1e-300))
    seen = base.T @ extra / norm
    square, vectors = np.linalg.eigh(extra.T @ extra / np.outer(norm, norm) - seen.T @ seen)
    kept = square > LEAST_SQUARE
    score = (fit.residual_mm @ extra) / norm - (fit.residual_mm @ base) @ seen
    explained = float(np.sum((vectors[:, kept].T @ score) ** 2 / square[kept]))
    count = int(kept.sum())
    freedom = len(fit.observed) - fit.jacobian.shape[1] - count
    left_over = float(np.sum(fit.residual_mm**2)) - explained
    return explained / max(left_over / max(freedom, 1), 1e-300), count


def _extended(fit: BaseFit, wider: CurveBasis) -> FloatArray:
    """Start values for a wider basis: the present values, zero for new coefficients."""
    position_mm = fit.observed.poses.position_mm[:1]
    old, new = fit.basis.parts(position_mm), wider.parts(position_mm)
    values = np.zeros(size_of(new))
    for before, after in zip(old, new, strict=True):
        count = before.basis.shape[1]
        values[after.place.start : after.place.start + count] = fit.unknowns[before.place]
    return np.concatenate([values, fit.unknowns[size_of(old) :]])
