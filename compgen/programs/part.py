"""What errors of a machine leave on a part: deviation along the path, holes, circles, distances, squareness of corners."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data.charts import page_assets, rounded
from compgen.data.csv_files import FloatArray
from compgen.data.files import read_bytes
from compgen.data.lengths import Points
from compgen.data.names import AXES, MM_PER_UM
from compgen.identify.covariance import Covariance, error_design
from compgen.kinematics.many_points import full_grid
from compgen.programs.dialects import dialect_named
from compgen.programs.path import (
    PLANE_AXES,
    RAPID,
    ExactModel,
    Moves,
    PathFigures,
    directions_at,
    is_closed,
    kept_directions,
    path_deviations,
    points_of,
)
from compgen.programs.reader import Reader, Setup, SingleBlock
from compgen.tables import ReadTables

#: Samples along an axis for the slope of tables, besides their nodes.
BEND_SAMPLES = 101
#: Distance of samples along the path, mm; samples of a circle and of a side; the shortest side.
STEP_MM, ON_CIRCLE, ON_SIDE, SHORTEST_SIDE_MM = 2.0, 36, 9, 5.0
#: Features that are evaluated, and the points of the picture; a picture with more shows no more.
MOST_FEATURES, MOST_POINTS = 500, 6000
#: How far a corner may be from a right angle, and sides from parallel, rad.
_SQUARE_RAD = 1e-3


@dataclass(frozen=True)
class CompensatedModel(ExactModel):
    """The exact model with the tables of a control active: they add to the command before the machine moves."""

    tables: ReadTables | None = None

    def error(self, position_mm: FloatArray, tool_mm: FloatArray, direction: FloatArray) -> FloatArray:
        """Return what the control adds plus the error where the machine then is."""
        if self.tables is None:
            return super().error(position_mm, tool_mm, direction)
        tool = np.broadcast_to(tool_mm, position_mm.shape)
        added = self.tables.correction(self.machine, Points(position_mm, tool_mm=tool, approach=direction))
        return np.asarray(added + super().error(position_mm + added, tool_mm, direction))

    def bend(self) -> float:
        """Add half the range of the slope of the tables, on nine lines along each axis."""
        total = super().bend()
        if self.tables is None:
            return total
        ends = [np.array(axis.range_mm) for axis in self.machine.axes]
        nodes_mm = self.tables.controller.table_nodes_mm(self.tables.tables)
        for axis, (low, high) in enumerate(ends):
            inside = nodes_mm[axis][(nodes_mm[axis] >= low) & (nodes_mm[axis] <= high)]
            levels = [np.array([part[0], part.mean(), part[1]]) for part in ends]
            levels[axis] = np.unique(np.concatenate([np.linspace(low, high, BEND_SAMPLES), inside]))
            points = np.moveaxis(full_grid(levels), axis, 0)
            flat = points.reshape(-1, 3)
            added = self.tables.correction(self.machine, Points(flat, approach=np.ones_like(flat))).reshape(
                points.shape
            )
            slopes = np.diff(added, axis=0) / np.diff(levels[axis])[:, None, None, None]
            total += 0.5 * float(np.linalg.norm(np.ptp(slopes, axis=0), axis=-1).max())
        return total


@dataclass(frozen=True)
class Feature:
    """One quantity of a feature: nominal size (mm, or degrees), its error before and after, and standard uncertainty.

    Errors are in um, those of corners in urad; ``u`` is nan if the errors have no covariance.
    """

    name: str
    quantity: str
    line: int
    nominal: float
    unit: str
    error: float
    after: float
    u: float

    def as_dict(self) -> dict[str, Any]:
        """Return the feature for JSON."""
        names = {"error": f"error_{self.unit}", "after": f"after_{self.unit}", "u": f"u_{self.unit}"}
        return {names.get(key, key): value for key, value in self.__dict__.items()}


@dataclass(frozen=True)
class PartPrediction:
    """What a machine will leave on a part; ``after`` is with the tables of a control, None without them."""

    machine: str
    program: str
    figures: PathFigures
    after: PathFigures | None
    features: tuple[Feature, ...]
    left_out: int
    assumed: tuple[str, ...]
    position_mm: FloatArray = field(repr=False)
    deviation_mm: FloatArray = field(repr=False)

    def as_dict(self) -> dict[str, Any]:
        """Return the object of ``part.json``."""
        return {
            "machine": self.machine,
            "program": self.program,
            "path_mm": self.figures.length_mm,
            "path": self.figures.as_dict(),
            "path_after": None if self.after is None else self.after.as_dict(),
            "features": [feature.as_dict() for feature in self.features],
            "features_left_out": self.left_out,
            "assumed": list(self.assumed),
        }


@dataclass(frozen=True)
class _Sampled:
    """Points of a feature with their tool and direction, and weights (n, 3): the error is the sum of weight times vector."""

    name: str
    quantity: str
    line: int
    nominal: float
    unit: str
    position_mm: FloatArray
    tool_mm: FloatArray
    direction: FloatArray
    weight: FloatArray


class _Features:
    """Collects holes, full circles and straight sides of a program; what is machined in several passes counts once."""

    def __init__(self) -> None:
        self.holes: dict[tuple[float, ...], tuple[int, FloatArray, FloatArray, FloatArray]] = {}
        self.offsets: dict[tuple[float, ...], FloatArray] = {}
        self.circles: dict[tuple[float, ...], tuple[Moves, FloatArray]] = {}
        self.sides: dict[tuple[float, ...], tuple[Moves, FloatArray]] = {}
        self.chains: dict[tuple[tuple[float, ...], tuple[float, ...]], None] = {}
        self._last: tuple[float, ...] | None = None
        self._first: tuple[float, ...] = ()

    def add(self, moves: Moves, drilled: set[int], ended: FloatArray) -> None:
        """Take the features of some moves; ``drilled`` are lines of drilling cycles."""
        length = np.linalg.norm(moves.end_mm - moves.start_mm, axis=1)
        chosen = (moves.sweep_rad != 0) | (length >= SHORTEST_SIDE_MM) | np.isin(moves.line, list(drilled))
        chosen |= moves.kind == RAPID
        for k in np.flatnonzero(chosen).tolist():
            row = moves.part([k])
            if row.kind[0] == RAPID:
                self._last = None
            elif int(row.line[0]) in drilled:
                at = row.end_mm[0]
                key = tuple(np.round(at[:2], 3).tolist())
                if row.start_mm[0, 2] > at[2]:
                    self.offsets[key] = row.offset_mm[0]
                    self.holes[key] = (int(row.line[0]), at, row.tool_mm[0], ended[k])
            elif row.sweep_rad[0] and is_closed(float(row.sweep_rad[0])):
                radius = float(np.nanmax(np.abs(row.start_mm[0] - row.centre_mm[0])))
                self.circles[(*np.round(np.nan_to_num(row.centre_mm[0]), 3).tolist(), round(radius, 1))] = (
                    row,
                    ended[k],
                )
            elif not row.sweep_rad[0]:
                ends = np.round(np.concatenate([row.start_mm[0, :2], row.end_mm[0, :2]]), 3)
                if abs(row.end_mm[0, 2] - row.start_mm[0, 2]) > 1e-6:
                    self._last = None
                    continue
                key = tuple(ends.tolist())
                self.sides[key] = (row, ended[k])
                if self._last is None:
                    self._first = key
                else:
                    self.chains[(self._last, key)] = None
                    if key[2:] == self._first[:2]:
                        self.chains[(key, self._first)] = None
                self._last = key

    def quantities(self) -> list[_Sampled]:
        """Return all quantities, holes first."""
        return [*self._holes(), *self._circles(), *self._sides()]

    def _holes(self) -> list[_Sampled]:
        found, items = [], list(self.holes.values())
        for number, ((line, at, tool, direction), offset) in enumerate(
            zip(items, self.offsets.values(), strict=True), 1
        ):
            name, where = f"hole {number}", ([at], [tool], [direction])
            for k in range(2):
                found.append(_sampled(name, f"position {AXES[k]}", line, at[k] - offset[k], *where, np.eye(3)[[k]]))
        return found + _distances("hole", [(number, *item) for number, item in enumerate(items, 1)])

    def _circles(self) -> list[_Sampled]:
        found, centres = [], []
        for number, (row, direction) in enumerate(self.circles.values(), 1):
            share = np.arange(ON_CIRCLE) / ON_CIRCLE
            many = row.part(np.zeros(ON_CIRCLE, dtype=np.int64))
            points, (a, b) = points_of(many, share), PLANE_AXES[int(row.plane[0])]
            outward = points - row.centre_mm
            outward[:, int(row.plane[0])] = 0.0
            radius = float(np.linalg.norm(outward[0]))
            outward /= radius
            line, name = int(row.line[0]), f"circle {number}"
            directions = kept_directions(directions_at(many, share), direction)
            where = (points, many.tool_mm, directions)
            found.append(_sampled(name, "diameter", line, 2.0 * radius, *where, 2.0 * outward / ON_CIRCLE))
            for k in (a, b):
                weight = 2.0 * outward[:, [k]] * outward / ON_CIRCLE
                nominal = float(row.centre_mm[0, k] - row.offset_mm[0, k])
                found.append(_sampled(name, f"position {AXES[k]}", line, nominal, *where, weight))
            middle = np.where(np.isnan(row.centre_mm[0]), row.end_mm[0], row.centre_mm[0])
            centres.append((number, line, middle, row.tool_mm[0], direction))
        return found + _distances("circle", centres)

    def _sides(self) -> list[_Sampled]:
        """Angles between sides that follow each other at a right angle, distances of parallel ones next but one."""
        found, paired = [], set[frozenset[tuple[float, ...]]]()
        after = {first: second for first, second in self.chains}
        for number, (first, second) in enumerate(self.chains, 1):
            third = after.get(second)
            one, two = _side(*self.sides[first]), _side(*self.sides[second])
            cross = float(one.along[0] * two.along[1] - one.along[1] * two.along[0])
            line = int(self.sides[second][0].line[0])
            if abs(float(one.along @ two.along)) < _SQUARE_RAD:
                # a side turns by the slope of its normal deviation; the angle within the corner is 180 degrees minus the turn
                sign = 1.0 if cross > 0 else -1.0
                weight = np.concatenate([sign * one.turn, -sign * two.turn])
                found.append(_sampled(f"corner {number}", "angle", line, 90.0, *_both(one, two), weight, unit="urad"))
            if third is not None and frozenset((first, third)) not in paired:
                paired.add(frozenset((first, third)))
                three = _side(*self.sides[third])
                gap = float((three.middle - one.middle) @ one.normal)
                if abs(float(one.along @ three.normal)) < _SQUARE_RAD and abs(gap) > 1e-3:
                    away = np.sign(gap) * one.normal / ON_SIDE
                    weight = np.concatenate([np.tile(-away, (ON_SIDE, 1)), np.tile(away, (ON_SIDE, 1))])
                    name = f"sides at lines {int(self.sides[first][0].line[0])} and {int(self.sides[third][0].line[0])}"
                    found.append(_sampled(name, "distance", line, abs(gap), *_both(one, three), weight))
        return found


@dataclass(frozen=True)
class _Side:
    points: FloatArray
    tool: FloatArray
    direction: FloatArray
    along: FloatArray
    normal: FloatArray
    turn: FloatArray
    middle: FloatArray


def _side(row: Moves, direction: FloatArray) -> _Side:
    share = (np.arange(ON_SIDE) + 0.5) / ON_SIDE
    many = row.part(np.zeros(ON_SIDE, dtype=np.int64))
    way = row.end_mm[0] - row.start_mm[0]
    length = float(np.linalg.norm(way))
    along = way / length
    normal = np.array([-along[1], along[0], 0.0])
    at = (share - 0.5) * length
    turn = at[:, None] * normal / float(at @ at)
    return _Side(
        points_of(many, share), many.tool_mm, np.tile(direction, (ON_SIDE, 1)), along, normal, turn,
        0.5 * (row.start_mm[0] + row.end_mm[0]),
    )  # fmt: skip


def _both(one: _Side, two: _Side) -> tuple[FloatArray, FloatArray, FloatArray]:
    return tuple(np.concatenate([getattr(one, name), getattr(two, name)]) for name in ("points", "tool", "direction"))  # type: ignore[return-value]


def _sampled(
    name: str,
    quantity: str,
    line: int,
    nominal: float,
    points: Any,
    tool: Any,
    direction: Any,
    weight: Any,
    unit: str = "um",
) -> _Sampled:
    arrays = (np.asarray(item, dtype=np.float64) for item in (points, tool, direction, weight))
    return _Sampled(name, quantity, line, float(nominal), unit, *arrays)


def _distances(kind: str, items: Sequence[tuple[int, int, FloatArray, FloatArray, FloatArray]]) -> list[_Sampled]:
    """Distances of all pairs of a few features; of many, those that follow each other and the longest."""
    pairs = list(itertools.combinations(items, 2)) if len(items) <= 8 else list(itertools.pairwise(items))
    if len(items) > 8:
        at = np.array([item[2] for item in items])
        far = [int(np.argmax(np.linalg.norm(at - place, axis=1))) for place in (at.min(axis=0), at.max(axis=0))]
        pairs.append((items[far[0]], items[far[1]]))
    found = []
    for (one, _, p, t, d), (two, line, q, u, e) in pairs:
        length = float(np.linalg.norm(q - p))
        if length > 0:
            way = (q - p) / length
            found.append(
                _sampled(f"{kind} {one} to {two}", "distance", line, length, [p, q], [t, u], [d, e], [-way, way])
            )
    return found


def predict_part(
    model: ExactModel,
    program: str | Path,
    dialect: str = "linuxcnc",
    setup: Setup = Setup(),  # noqa: B008 -- frozen
    *,
    covariance: Covariance | None = None,
    tables: ReadTables | None = None,
    show: Callable[[str], None] = lambda _: None,
) -> PartPrediction:
    """Predict what the errors of a machine leave on the part of an NC program.

    Every move at feed is sampled on the exact model. Features are found in the program: holes of drilling cycles, full
    circles, straight sides that follow each other. Their errors are weighted sums of the vectors of the tool at samples, so
    that the covariance of the errors gives their uncertainty.

    Parameters
    ----------
    model : the machine with its errors and reversal.
    program, dialect, setup : the program, how it is written, its work offsets and tools.
    covariance : of the errors, for the uncertainty of the features.
    tables : tables of the control; then figures and features are given with them, too.
    show : called with the step that is running.
    """
    source, known = Path(program), dialect_named(dialect)
    read_bytes(source, 1)
    reader = Reader(model.machine, known, setup, source)
    with_tables = CompensatedModel(model.machine, model.errors, model.reversal, model.only, tables)
    figures, after, features = PathFigures(), PathFigures() if tables is not None else None, _Features()
    thinned, direction = _Thinned(), np.zeros(3)
    with source.open("rb") as stream:
        for batch in reader.batches(stream):
            moves = batch.moves
            ended = kept_directions(directions_at(moves, np.full(len(moves), 1.0 - 1e-7)), direction)
            direction = ended[-1] if len(moves) else direction
            rows = np.flatnonzero(moves.cutting)
            shares = (np.zeros(len(rows)), np.ones(len(rows)))
            for found in path_deviations(model, STEP_MM, moves, rows, moves.part(rows), shares, ended):
                figures.add(found)
                thinned.add(found.position_mm, found.normal_mm)
            if after is not None:
                for found in path_deviations(with_tables, STEP_MM, moves, rows, moves.part(rows), shares, ended):
                    after.add(found)
            drilled = {
                item.number
                for item in batch.segments
                if isinstance(item, SingleBlock) and item.kind in ("cycle", "hole")
            }
            features.add(moves, drilled, ended)
            show(f"{batch.first_line + len(batch.words.start) - 2} blocks")
    model.errors.warn_outside(reader.reached_mm)
    quantities = features.quantities()
    evaluated = [_feature(item, model, with_tables, covariance) for item in quantities[:MOST_FEATURES]]
    return PartPrediction(
        model.machine.name,
        source.name,
        figures,
        after,
        tuple(evaluated),
        max(len(quantities) - MOST_FEATURES, 0),
        tuple(reader.assumed),
        *thinned.points(),
    )


def _feature(
    item: _Sampled, model: ExactModel, with_tables: CompensatedModel, covariance: Covariance | None
) -> Feature:
    where = (item.position_mm, item.tool_mm, item.direction)
    error, after = (float(np.sum(item.weight * one.error(*where))) for one in (model, with_tables))
    u = np.nan
    if covariance is not None:
        design = error_design(model.machine, covariance, item.position_mm, item.tool_mm)
        row = np.einsum("nk,nkp->p", item.weight, design) @ covariance.errors_factor
        u = float(np.linalg.norm(row))
    per = 1.0 / MM_PER_UM if item.unit == "um" else 1e6
    left = after * per if with_tables.tables is not None else np.nan
    return Feature(item.name, item.quantity, item.line, item.nominal, item.unit, error * per, left, u * per)


class _Thinned:
    """Keeps points of a path of any length, evenly, for a picture."""

    def __init__(self) -> None:
        self.every, self.passed = 1, 0
        self.kept: list[FloatArray] = []
        self.count = 0

    def add(self, position_mm: FloatArray, deviation_mm: FloatArray) -> None:
        first = -self.passed % self.every
        rows = np.hstack([position_mm, deviation_mm])[first :: self.every]
        self.passed += len(position_mm)
        self.kept.append(rows)
        self.count += len(rows)
        while self.count > MOST_POINTS:
            self.kept = [np.concatenate(self.kept)[::2]]
            self.count, self.every = len(self.kept[0]), 2 * self.every

    def points(self) -> tuple[FloatArray, FloatArray]:
        every = np.concatenate([np.zeros((0, 6)), *self.kept])
        return every[:, :3], every[:, 3:]


# The page with a picture that is turned with the mouse.

_SHOWN = {
    "normal_max_um": "largest distance from the path",
    "normal_rms_um": "rms",
    "ends_max_um": "largest at ends of moves",
    "max_um": "largest with what is along the path",
    "rms_um": "rms",
}


def part_page(found: PartPrediction) -> str:
    """Return a page in one file: figures, features, and the path with its deviations, turned with the mouse."""
    style, script, policy = page_assets("part.js")
    data = {
        "at": [rounded(row, 6) for row in found.position_mm],
        "off": [rounded(row / MM_PER_UM, 4) for row in found.deviation_mm],
    }
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">'
        f'<meta name="viewport" content="width=device-width"><title>{escape(found.program)}</title><style>{style}</style>'
    )
    figures = [("as the machine is", found.figures), *([("with tables", found.after)] if found.after else [])]
    lines = "".join(
        f"<tr><td>{name}</td>" + "".join(f"<td>{one.as_dict()[key]:.2f}</td>" for key in _SHOWN) + "</tr>"
        for name, one in figures
    )
    rows = "".join(
        f"<tr><td>{escape(f.name)}</td><td>{escape(f.quantity)}</td><td>{f.line}</td><td>{f.nominal:.3f}</td>"
        f"<td>{f.error:+.2f}</td><td>{'' if np.isnan(f.after) else f'{f.after:+.2f}'}</td>"
        f"<td>{'' if np.isnan(f.u) else f'{f.u:.2f}'}</td><td>{f.unit}</td></tr>"
        for f in found.features
    )
    titles = "".join(f"<th>{name}</th>" for name in _SHOWN.values())
    features = f"""<table><tr><th>feature</th><th>quantity</th><th>line</th><th>nominal (mm, deg)</th><th>error</th>
<th>with tables</th><th>u (k = 1)</th><th>unit</th></tr>{rows}</table>"""
    body = f"""<h1>{escape(found.program)} on {escape(found.machine)}</h1>
<table><tr><th>tool from the path (um)</th>{titles}</tr>{lines}</table>
<p>Grey: the path as programmed. Colours and arrows: the deviation normal to it, as the machine is. Turn with the mouse or
the arrow keys, zoom with the wheel or + and -.
<label>Enlarged <input id="scale" type="range" min="0" max="100" value="50"></label> <span id="says"></span></p>
<canvas id="part" width="1000" height="620" tabindex="0" role="img" aria-label="path of the tool with its deviation"
style="max-width: 100%"></canvas>
{features if rows else "<p>The program has no holes, full circles or sides whose size could be given.</p>"}
<script type="application/json" id="data">{json.dumps(data)}</script>"""
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>\n{body}\n<script>{script}</script></body></html>\n'
    )
