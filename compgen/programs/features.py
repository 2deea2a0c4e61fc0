"""Features of a part, found in the moves of its NC program: holes, circles, sides of contours, faces; and their quantities.

A quantity is evaluated from the vectors by which the tool is off at samples of the moves. Most are sums of weight times
vector; roundness and flatness are ranges after the best circle or plane is removed.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES
from compgen.programs.path import (
    PLANE_AXES,
    IntArray,
    Moves,
    directions_at,
    lengths_of,
    points_of,
)

#: Samples of a circle, of a side, of a side at one level of a wall, and of a row of a face; most rows of a face.
ON_CIRCLE, ON_SIDE, ON_LEVEL, ON_ROW, MOST_ROWS = 72, 9, 3, 21, 20
#: The shortest side, and the least height of a wall whose tilt is given, mm.
SHORTEST_SIDE_MM, LEAST_HEIGHT_MM = 5.0, 5.0
#: Points of a side are this close to the line between its ends, mm; the sides are at least this share of the lines of a contour.
STRAIGHT_MM, LEAST_SHARE = 0.002, 0.5
#: A closed contour of at least this many short lines is a circle if its points are this close to one, and no step is longer.
LEAST_POINTS, CIRCLE_MM, LONGEST_STEP_RAD = 16, 0.01, np.radians(30.0)
#: Of contours with more sides only neighbours and sides next but one are compared.
MOST_SIDES = 12
#: At least so many parallel rows are a face if they are so much of the path; so many closed contours in a row leave a floor.
LEAST_ROWS, ROWS_SHARE, LEAST_LOOPS = 4, 0.7, 3
#: How far a corner may be from a right angle, and sides from parallel, rad; what counts as the same place, mm.
SQUARE_RAD, SAME_MM = 1e-3, 1e-3
#: Moves that are looked at together if no rapid move comes between; contours, places of circles and faces that are kept.
MOST_MOVES, MOST_KEPT = 50_000, 2000
#: Features of each kind that are evaluated; of more, so many evenly.
MOST_EVALUATED = 100
#: Names of the planes by the axis normal to each; that of most programs is not said.
_PLANES = (" in YZ", " in ZX", "")
Item = TypeVar("Item")


@dataclass(frozen=True)
class Samples:
    """Points (n, 3) on moves, mm: number of the move in the program and share of its length, tool, direction of travel."""

    move: IntArray
    share: FloatArray
    position_mm: FloatArray
    tool_mm: FloatArray
    direction: FloatArray

    @staticmethod
    def joined(parts: Sequence[Samples]) -> Samples:
        """Return the samples of several parts in their order."""
        return Samples(*(np.concatenate([getattr(p, name) for p in parts]) for name in Samples.__dataclass_fields__))


@dataclass(frozen=True)
class Quantity:
    """One quantity of a feature: how it follows from the vectors (n, 3) by which the tool is off at its samples.

    It is the sum of ``weight`` (n, 3) times vector; with columns ``fitted`` (n, k), whose best fit is removed first, the
    range of weight times vector. ``nominal`` is in mm or degrees, ``unit`` that of its error: um, or urad.
    """

    name: str
    quantity: str
    line: int
    nominal: float
    unit: str
    samples: Samples
    weight: FloatArray
    fitted: FloatArray | None = None

    def value(self, off_mm: FloatArray) -> tuple[float, FloatArray]:
        """Return the error for vectors (n, 3), mm or rad, and its derivative by them, (n, 3)."""
        if self.fitted is None:
            return float(np.sum(self.weight * off_mm)), self.weight
        remove = np.eye(len(off_mm)) - self.fitted @ np.linalg.pinv(self.fitted)
        left = remove @ np.einsum("nk,nk->n", self.weight, off_mm)
        most, least = int(np.argmax(left)), int(np.argmin(left))
        return float(left[most] - left[least]), (remove[most] - remove[least])[:, None] * self.weight


@dataclass(frozen=True)
class _Chain:
    """Moves at feed that follow each other: their numbers in the program, and directions of the axes at their ends."""

    moves: Moves
    number: IntArray
    ended: FloatArray

    def part(self, rows: Any) -> _Chain:
        return _Chain(self.moves.part(rows), self.number[rows], self.ended[rows])

    @property
    def line(self) -> int:
        return int(self.moves.line[-1])

    def samples(self, along: FloatArray, measure: FloatArray) -> Samples:
        """Return samples where the sum of ``measure`` (moves,), length or angle, is ``along`` (n,)."""
        total = np.cumsum(measure)
        index = np.minimum(np.searchsorted(total, along), len(total) - 1)
        share = np.clip((along - total[index] + measure[index]) / measure[index], 0.0, 1.0)
        many, ended = self.moves.part(index), self.ended[index]
        direction = directions_at(many, np.clip(share, 1e-7, 1.0 - 1e-7))
        direction = np.where(direction != 0, direction, ended)
        return Samples(self.number[index], share, points_of(many, share), many.tool_mm, direction)

    def spread(self, count: int, *, ends: bool = False) -> Samples:
        """Return samples at equal distances, with both ends or half a distance from them."""
        length, index = lengths_of(self.moves), np.arange(count)
        return self.samples((index / (count - 1) if ends else (index + 0.5) / count) * length.sum(), length)


@dataclass(frozen=True)
class _Side:
    """A straight side in the plane normal to axis ``plane``: its moves, direction (3,), ends (2, 3) and line."""

    chain: _Chain
    plane: int

    @property
    def ends(self) -> FloatArray:
        return np.stack([self.chain.moves.start_mm[0], self.chain.moves.end_mm[-1]])

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))

    @property
    def along(self) -> FloatArray:
        return np.asarray((self.ends[1] - self.ends[0]) / self.length)

    @property
    def normal(self) -> FloatArray:
        """To the left of the direction of travel, seen from the positive end of the axis normal to the plane."""
        (a, b), normal = PLANE_AXES[self.plane], np.zeros(3)
        normal[a], normal[b] = -self.along[b], self.along[a]
        return normal

    @property
    def key(self) -> frozenset[tuple[float, ...]]:
        """Both ends in the plane, without the direction of travel."""
        return frozenset(tuple(np.round(end[list(PLANE_AXES[self.plane])], 3).tolist()) for end in self.ends)

    def samples(self) -> Samples:
        return self.chain.spread(ON_SIDE)

    def turn(self, samples: Samples) -> FloatArray:
        """Weights whose sum is the slope of the deviation along the normal, counter-clockwise positive."""
        at = (samples.position_mm - samples.position_mm.mean(axis=0)) @ self.along
        return np.asarray(at[:, None] * self.normal / float(at @ at))


@dataclass
class _Circle:
    """A full circle in the plane normal to axis ``plane``; ``chain`` ends with its last turn, ``measure`` is along that."""

    chain: _Chain
    plane: int
    centre_mm: FloatArray
    radius_mm: float
    measure: FloatArray

    def samples(self) -> Samples:
        total = float(self.measure.sum())
        turn = min(2.0 * np.pi, total) if self.chain.moves.sweep_rad[-1] else total
        return self.chain.samples(total - turn * (1.0 - (np.arange(ON_CIRCLE) + 0.5) / ON_CIRCLE), self.measure)


@dataclass
class PartFeatures:
    """Collects features from the moves of a program; what is machined in several passes counts once, as the last left it."""

    holes: dict[tuple[float, ...], tuple[_Chain, FloatArray]] = field(default_factory=dict)
    #: Circles by their place in a plane, each with the number of its run.
    _circles: dict[tuple[Any, ...], list[tuple[int, _Circle]]] = field(default_factory=dict)
    #: Sides of contours, by level, by what the contours are in their plane.
    _contours: dict[Any, dict[float, tuple[bool, list[_Side]]]] = field(default_factory=dict)
    _faces: dict[tuple[Any, ...], tuple[int, list[_Side]]] = field(default_factory=dict)
    _single_rows: list[_Side] = field(default_factory=list)
    _waiting: list[_Chain] = field(default_factory=list)
    _drilled: list[NDArray[np.bool_]] = field(default_factory=list)
    _count: int = 0

    def add(self, moves: Moves, drilled: set[int], ended: FloatArray, number: IntArray) -> None:
        """Take the moves of a batch; ``drilled`` are lines of drilling cycles, ``ended`` directions of the axes at the ends.

        ``number`` (n,) is that of each in the batch; arcs about corners have the number of the move before them.
        """
        chain = _Chain(moves, self._count + number, ended)
        self._count += int(number[-1]) + 1 if len(number) else 0
        in_hole = np.isin(moves.line, list(drilled))
        rows = np.arange(len(moves))
        stroke = in_hole & moves.cutting & (moves.start_mm[rows, moves.plane] > moves.end_mm[rows, moves.plane])
        for k in np.flatnonzero(stroke).tolist():
            plane = int(moves.plane[k])
            place = np.delete(np.round(moves.end_mm[k], 3), plane).tolist()
            self.holes[plane, *place] = chain.part([k]), moves.offset_mm[k]
        # contours may go on in the next batch: those up to the last rapid move are whole
        breaks = np.flatnonzero(~moves.cutting)
        last = int(breaks[-1]) + 1 if len(breaks) else 0
        if last or sum(len(part.number) for part in self._waiting) > MOST_MOVES:
            self._waiting.append(chain.part(slice(0, last)))
            self._drilled.append(in_hole[:last])
            self._look()
            chain, in_hole = chain.part(slice(last, None)), in_hole[last:]
        self._waiting.append(chain)
        self._drilled.append(in_hole)

    def quantities(self) -> Iterator[Quantity]:
        """Yield all quantities, those of holes first."""
        self._finish()
        yield from self._of_holes()
        yield from self._of_circles()
        yield from self._of_contours()
        yield from self._of_faces()

    def left_out(self) -> int:
        """Return how many features have no quantities, as there are more than are evaluated."""
        self._finish()
        circles = sum(len(items) for items in self._circles.values())
        counts = (len(self.holes), circles, len(self._contours), len(self._faces))
        return sum(max(count - MOST_EVALUATED, 0) for count in counts)

    # Finding.

    def _finish(self) -> None:
        self._look()
        self._end_rows()

    def _look(self) -> None:
        """Find circles, contours and faces in the moves that wait."""
        chain = _Chain(
            Moves.joined(part.moves for part in self._waiting),
            np.concatenate([part.number for part in self._waiting] or [np.zeros(0, dtype=np.int64)]),
            np.concatenate([part.ended for part in self._waiting] or [np.zeros((0, 3))]),
        )
        in_hole = np.concatenate([np.zeros(0, dtype=bool), *self._drilled])
        self._waiting, self._drilled = [], []
        if not len(chain.number):
            return
        plane, run = _plane_runs(chain.moves, in_hole)
        run += int(chain.number[0])
        round_ones = self._find_circles(chain, run)
        for low, high in _worth_a_look(chain.moves, plane, run):
            own = int(run[low])
            self._find_in_run(chain.part(slice(low, high)), int(plane[low]), own, leads_to_circle=own in round_ones)

    def _keep_circle(self, circle: _Circle, run: int) -> None:
        a, b = PLANE_AXES[circle.plane]
        place = (circle.plane, round(float(circle.centre_mm[a]), 3), round(float(circle.centre_mm[b]), 3))
        here = self._circles.get(place, [])
        # passes outwards or inwards without leaving the place: the last one is the wall
        rest = [(k, c) for k, c in here if k != run and round(c.radius_mm, 1) != round(circle.radius_mm, 1)]
        if here or len(self._circles) < MOST_KEPT:
            self._circles[place] = [*rest, (run, circle)]

    def _find_circles(self, chain: _Chain, run: IntArray) -> set[int]:
        """Full circles of one or several arcs about one centre that follow each other, also helices; returns their runs."""
        runs = set()
        moves, index = chain.moves, np.arange(len(chain.number))
        arc = moves.sweep_rad != 0
        a, b = np.array(PLANE_AXES)[moves.plane].T
        centre = np.stack([moves.centre_mm[index, a], moves.centre_mm[index, b]], axis=1)
        radius = np.hypot(moves.start_mm[index, a] - centre[:, 0], moves.start_mm[index, b] - centre[:, 1])
        follows = arc[1:] & arc[:-1] & (moves.plane[1:] == moves.plane[:-1])
        follows &= (np.abs(np.diff(np.nan_to_num(centre), axis=0)) < 2.0 * SAME_MM).all(axis=1)
        follows &= np.abs(np.diff(np.nan_to_num(radius))) < 2.0 * SAME_MM
        follows &= np.sign(moves.sweep_rad[1:]) == np.sign(moves.sweep_rad[:-1])
        first = np.flatnonzero(np.concatenate([[True], ~follows]))
        last = np.append(first[1:], len(index))
        total = np.add.reduceat(np.abs(moves.sweep_rad), first)
        for k in np.flatnonzero(total >= 2.0 * np.pi - 1e-6).tolist():
            rows = slice(int(first[k]), int(last[k]))
            found = chain.part(rows)
            middle = np.where(np.isnan(found.moves.centre_mm[-1]), found.moves.end_mm[-1], found.moves.centre_mm[-1])
            own = int(run[rows][-1])
            runs.add(own)
            turn = np.abs(found.moves.sweep_rad)
            self._keep_circle(_Circle(found, int(found.moves.plane[-1]), middle, float(radius[rows][-1]), turn), own)
        return runs

    def _find_in_run(self, chain: _Chain, plane: int, run: int, *, leads_to_circle: bool) -> None:
        """Closed contours in moves at one level; without any, and without full circles, rows of a face or an open contour."""
        loops = _loops(chain.moves, plane)
        kept: dict[tuple[Any, ...], list[_Side]] = {}
        every: list[_Side] = []
        for low, high in loops:
            loop = chain.part(slice(low, high))
            circle = _circle_of_lines(loop, plane)
            if circle is not None:
                self._keep_circle(circle, run)
                continue
            sides = _sides(loop, plane, closed=True)
            ends = np.concatenate([side.ends for side in sides]) if sides else np.zeros((1, 3))
            middle = tuple(np.round(0.5 * (ends.min(axis=0) + ends.max(axis=0)), 2).tolist())
            # contours within each other are passes: the last one is the wall
            kept[(*middle, len(sides))] = sides
            every += sides
        for sides in kept.values():
            self._keep_contour(sides, closed=True)
        if len(loops) >= LEAST_LOOPS and every:
            self._keep_face(every)
        if loops or leads_to_circle:
            self._end_rows()
            return
        sides = _sides(chain, plane, closed=False)
        longest = max(sides, key=lambda side: side.length, default=None)
        rows = [side for side in sides if longest is not None and abs(side.along @ longest.normal) < SQUARE_RAD]
        in_rows = sum(row.length for row in rows)
        if len(rows) >= LEAST_ROWS and in_rows > ROWS_SHARE * sum(side.length for side in sides):
            self._end_rows()
            self._keep_face(rows)
        elif len(sides) == 1 and sides[0].length > ROWS_SHARE * lengths_of(chain.moves).sum():
            before = self._single_rows[-1] if self._single_rows else sides[0]
            same = before.plane == plane and abs(float(before.along @ sides[0].normal)) < SQUARE_RAD
            if not same or abs(before.ends[0, plane] - sides[0].ends[0, plane]) > SAME_MM:
                self._end_rows()
            self._single_rows.append(sides[0])
        elif sides:
            self._end_rows()
            self._keep_contour(sides, closed=False)

    def _end_rows(self) -> None:
        """Rows that were milled one by one, with a rapid move back after each, are a face."""
        if len(self._single_rows) >= LEAST_ROWS:
            self._keep_face(self._single_rows)
        self._single_rows = []

    def _keep_contour(self, sides: list[_Side], *, closed: bool) -> None:
        if len(sides) < 2:
            return
        key = (sides[0].plane, frozenset(side.key for side in sides))
        if key not in self._contours and len(self._contours) >= MOST_KEPT:
            return
        levels = self._contours.setdefault(key, {})
        level = round(float(sides[0].ends[0, sides[0].plane]), 3)
        levels.pop(level, None)
        levels[level] = (closed, sides)

    def _keep_face(self, rows: list[_Side]) -> None:
        ends = np.concatenate([row.ends for row in rows])[:, list(PLANE_AXES[rows[0].plane])]
        box = tuple(np.round(np.concatenate([ends.min(axis=0), ends.max(axis=0)]), 1).tolist())
        if len(self._faces) < MOST_KEPT and (np.ptp(ends, axis=0) > SAME_MM).all():
            self._faces.pop((rows[0].plane, *box), None)
            self._faces[(rows[0].plane, *box)] = (rows[0].plane, rows)

    # Quantities.

    def _of_holes(self) -> Iterator[Quantity]:
        by_plane: dict[int, list[Any]] = {}
        for number, (chain, offset) in _evaluated(self.holes.values()):
            samples, plane = chain.samples(np.ones(1), np.ones(1)), int(chain.moves.plane[0])
            at, name = chain.moves.end_mm[0], _in_plane(f"hole {number}", plane)
            for k in sorted(PLANE_AXES[plane]):
                nominal = float(at[k] - offset[k])
                yield Quantity(name, f"position {AXES[k]}", chain.line, nominal, "um", samples, np.eye(3)[[k]])
            by_plane.setdefault(plane, []).append((name, chain.line, at, samples, lambda k: np.eye(3)[[k]]))
        for plane, found in by_plane.items():
            yield from _between(found, tuple(sorted(PLANE_AXES[plane])))

    def _of_circles(self) -> Iterator[Quantity]:
        by_plane: dict[int, list[Any]] = {}
        circles = [circle for items in self._circles.values() for _, circle in items]
        circles.sort(key=lambda circle: int(circle.chain.number[-1]))
        for number, circle in _evaluated(circles):
            name, line, plane = _in_plane(f"circle {number}", circle.plane), circle.chain.line, circle.plane
            samples = circle.samples()
            outward = samples.position_mm - circle.centre_mm
            outward[:, plane] = 0.0
            outward /= np.linalg.norm(outward, axis=1)[:, None]
            a, b = PLANE_AXES[plane]
            columns = np.stack([np.ones(ON_CIRCLE), outward[:, a], outward[:, b]], axis=1)
            # radius and centre of the least-squares circle
            rows = np.linalg.pinv(columns)
            weights = {k: rows[1 + j][:, None] * outward for j, k in enumerate((a, b))}
            diameter = 2.0 * circle.radius_mm
            yield Quantity(name, "diameter", line, diameter, "um", samples, 2.0 * rows[0][:, None] * outward)
            yield Quantity(name, "roundness", line, 0.0, "um", samples, outward, columns)
            for k in sorted((a, b)):
                nominal = float(circle.centre_mm[k] - circle.chain.moves.offset_mm[-1, k])
                yield Quantity(name, f"position {AXES[k]}", line, nominal, "um", samples, weights[k])
            by_plane.setdefault(plane, []).append((name, line, circle.centre_mm, samples, weights.__getitem__))
        for plane, found in by_plane.items():
            yield from _between(found, tuple(sorted(PLANE_AXES[plane])))

    def _of_contours(self) -> Iterator[Quantity]:
        corner = 0
        for _, ((plane, _), levels) in _evaluated(self._contours.items()):
            closed, sides = list(levels.values())[-1]
            count = len(sides)
            for k in range(count if closed and count > 2 else count - 1):
                one, two = sides[k], sides[(k + 1) % count]
                if abs(float(one.along @ two.along)) < SQUARE_RAD:
                    corner += 1
                    yield _corner(_in_plane(f"corner {corner}", plane), one, two)
            ahead = range(2, count if count <= MOST_SIDES else 3)
            for k, step in itertools.product(range(count), ahead):
                if k + step < count and _belong_together(sides[k], sides[k + step], next_but_one=step == 2):
                    yield from _parallel(sides[k], sides[k + step])
            if closed:
                yield from _walls(plane, [item for _, item in levels.values()], list(levels))

    def _of_faces(self) -> Iterator[Quantity]:
        for number, (plane, rows) in _evaluated(self._faces.values()):
            chosen = [rows[k] for k in np.unique(np.linspace(0, len(rows) - 1, MOST_ROWS).round().astype(int))]
            samples = Samples.joined([row.chain.spread(ON_ROW, ends=True) for row in chosen])
            at = samples.position_mm[:, list(PLANE_AXES[plane])]
            columns = np.column_stack([np.ones(len(at)), at - at.mean(axis=0)])
            weight = np.tile(np.eye(3)[plane], (len(at), 1))
            name, line = _in_plane(f"milled face {number}", plane), rows[-1].chain.line
            yield Quantity(name, "flatness", line, 0.0, "um", samples, weight, columns)


def _in_plane(name: str, plane: int) -> str:
    """Return the name of a feature, with its plane unless that is XY."""
    return name + _PLANES[plane]


def _evaluated(items: Iterable[Item]) -> list[tuple[int, Item]]:
    """Number and item, from 1, of all of them or of as many as are evaluated."""
    every = list(enumerate(items, 1))
    chosen = np.unique(np.linspace(0, len(every) - 1, min(len(every), MOST_EVALUATED)).round().astype(int))
    return [every[k] for k in chosen]


def _plane_runs(moves: Moves, in_hole: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    """Axis normal to the plane in which each move lies (-1: none), and the number of its run: moves in one plane at one level.

    It is the plane of the program if the move lies in it, otherwise another one in which it lies; a plunge has none.
    """
    index = np.arange(len(moves))
    moved = np.abs(moves.end_mm - moves.start_mm) > 1e-6
    along_tool = moved[index, moves.plane]
    others = np.array(PLANE_AXES)[moves.plane]
    rests = ~moved[index[:, None], others]
    other = np.where(rests[:, 0] & ~rests[:, 1], others[:, 0], np.where(rests[:, 1] & ~rests[:, 0], others[:, 1], -1))
    plane = np.where(along_tool, np.where(moves.sweep_rad != 0, -1, other), moves.plane)
    plane[~moves.cutting | in_hole] = -1
    level = np.where(plane >= 0, moves.start_mm[index, np.maximum(plane, 0)], 0.0)
    new = (plane[1:] != plane[:-1]) | (np.abs(np.diff(level)) > 1e-6)
    return plane, np.concatenate([[0], np.cumsum(new)])


def _worth_a_look(moves: Moves, plane: IntArray, run: IntArray) -> list[tuple[int, int]]:
    """Runs in a plane that have a long side, or turn once round in many short lines: first move and end."""
    first = np.flatnonzero(np.concatenate([[True], np.diff(run) > 0]))
    end = np.append(first[1:], len(run))
    way = moves.end_mm - moves.start_mm
    straight = moves.sweep_rad == 0
    length = np.linalg.norm(way, axis=1)
    a, b = np.array(PLANE_AXES)[np.maximum(plane, 0)].T
    index = np.arange(len(run))
    heading = np.arctan2(way[index, b], way[index, a])
    turn = np.concatenate([[0.0], (np.diff(heading) + np.pi) % (2.0 * np.pi) - np.pi])
    turn[~straight | np.concatenate([[True], ~straight[:-1]])] = 0.0
    turn[first] = 0.0
    # pieces of a side that was divided count together
    piece = np.concatenate([[0], np.cumsum((np.abs(turn[1:]) > SQUARE_RAD) | (np.diff(run) > 0) | ~straight[1:])])
    side = np.bincount(piece, np.where(straight, length, 0.0))[piece]
    has_side = np.maximum.reduceat(np.where(straight, side, 0.0), first) >= SHORTEST_SIDE_MM
    # less than a full turn, as the ways to and from the contour turn, too
    round_once = np.abs(np.add.reduceat(turn, first)) > np.pi
    chosen = (plane[first] >= 0) & (has_side | (round_once & (end - first >= LEAST_POINTS)))
    return [(int(first[k]), int(end[k])) for k in np.flatnonzero(chosen)]


def _loops(moves: Moves, plane: int) -> list[tuple[int, int]]:
    """Closed contours in a run: first move and end of each. One closes where the path comes back to one of its points."""
    axes = list(PLANE_AXES[plane])
    points = np.round(np.vstack([moves.start_mm[:1], moves.end_mm])[:, axes] / SAME_MM).astype(np.int64).tolist()
    found, seen = [], {tuple(points[0]): 0}
    for k, point in enumerate(map(tuple, points[1:]), 1):
        began = seen.get(point)
        if began is not None and k - began >= 3:
            found.append((began, k))
            seen = {}
        seen[point] = k
    return found


def _sides(chain: _Chain, plane: int, *, closed: bool) -> list[_Side]:
    """Straight sides of a contour; lines in one direction that follow each other are one side."""
    way = chain.moves.end_mm - chain.moves.start_mm
    length = np.linalg.norm(way, axis=1)
    straight = (chain.moves.sweep_rad == 0) & (length > 0)
    unit = way / np.where(length > 0, length, 1.0)[:, None]
    before = np.roll(unit, 1, axis=0)
    goes_on = straight & np.roll(straight, 1) & (np.einsum("nk,nk->n", unit, before) > 0)
    goes_on &= np.linalg.norm(np.cross(unit, before), axis=1) < SQUARE_RAD
    if closed and not goes_on.all():
        # a contour that begins within a side begins at its corner instead
        shift = int(np.flatnonzero(~goes_on)[0])
        order = np.roll(np.arange(len(length)), -shift)
        chain, straight, goes_on = chain.part(order), straight[order], goes_on[order]
    goes_on[0] = False
    first = np.flatnonzero(~goes_on)
    last = np.append(first[1:], len(length))
    found = [_Side(chain.part(slice(i, j)), plane) for i, j in _straight(chain.moves, first, last) if straight[i]]
    # what consists of short lines for the most part is a curve: its straight pieces are no sides
    in_sides = sum(side.length for side in found)
    return found if in_sides > LEAST_SHARE * length[straight].sum() else []


def _straight(moves: Moves, first: IntArray, last: IntArray) -> list[tuple[int, int]]:
    """Pieces of a contour, moves ``first`` to before ``last``, that are long and have their points on the line of their ends."""
    origin, way = moves.start_mm[first], moves.end_mm[last - 1] - moves.start_mm[first]
    length = np.linalg.norm(way, axis=1)
    own = np.repeat(np.arange(len(first)), last - first)
    unit = way / np.where(length > 0, length, 1.0)[:, None]
    off = np.linalg.norm(np.cross(moves.end_mm - origin[own], unit[own]), axis=1)
    fine = (np.maximum.reduceat(off, first) < STRAIGHT_MM) & (length >= SHORTEST_SIDE_MM)
    return [(int(first[k]), int(last[k])) for k in np.flatnonzero(fine)]


def _circle_of_lines(loop: _Chain, plane: int) -> _Circle | None:
    """A closed contour of short lines as a circle, if its points are on one; the largest step is 30 degrees."""
    moves = loop.moves
    if len(moves) < LEAST_POINTS or moves.sweep_rad.any():
        return None
    a, b = PLANE_AXES[plane]
    u, v = moves.end_mm[:, a], moves.end_mm[:, b]
    columns = np.column_stack([2.0 * (u - u[0]), 2.0 * (v - v[0]), np.ones(len(u))])
    p, q, c = np.linalg.lstsq(columns, (u - u[0]) ** 2 + (v - v[0]) ** 2, rcond=None)[0]
    centre = moves.end_mm[-1].copy()
    centre[a], centre[b] = u[0] + p, v[0] + q
    radius = float(np.sqrt(max(c + p * p + q * q, 0.0)))
    angle = np.arctan2(v - centre[b], u - centre[a])
    step = (np.diff(angle, append=angle[0]) + np.pi) % (2.0 * np.pi) - np.pi
    off = np.abs(np.hypot(u - centre[a], v - centre[b]) - radius).max()
    once = abs(abs(float(step.sum())) - 2.0 * np.pi) < 1e-6
    if off > CIRCLE_MM or np.abs(step).max() > LONGEST_STEP_RAD or not once:
        return None
    return _Circle(loop, plane, centre, radius, lengths_of(moves))


def _corner(name: str, one: _Side, two: _Side) -> Quantity:
    """Angle within a corner: a side turns by the slope of its normal deviation; the angle is 180 degrees minus the turn."""
    a, b = PLANE_AXES[one.plane]
    sign = 1.0 if one.along[a] * two.along[b] > one.along[b] * two.along[a] else -1.0
    first, second = one.samples(), two.samples()
    weight = np.concatenate([sign * one.turn(first), -sign * two.turn(second)])
    line = int(two.chain.moves.line[0])
    return Quantity(name, "angle", line, 90.0, "urad", Samples.joined([first, second]), weight)


def _belong_together(one: _Side, two: _Side, *, next_but_one: bool) -> bool:
    """Whether the distance of two sides is a size of the part.

    Sides in opposite directions overlap, as those of a pocket or a boss; the two sides of a shoulder, which are next but one,
    have one direction and do not.
    """
    first, second = (np.sort(side.ends @ one.along) for side in (one, two))
    overlap = float(min(first[1], second[1]) - max(first[0], second[0]))
    return overlap > 0 if one.along @ two.along < 0 else next_but_one and overlap < SAME_MM


def _parallel(one: _Side, two: _Side) -> Iterator[Quantity]:
    """Distance of parallel sides, and by how much it grows along the first over the length of the shorter."""
    gap = float((two.ends.mean(axis=0) - one.ends.mean(axis=0)) @ one.normal)
    if abs(float(one.along @ two.normal)) > SQUARE_RAD or abs(gap) <= SAME_MM:
        return
    first, second = one.samples(), two.samples()
    away = np.sign(gap) * one.normal
    line = int(two.chain.moves.line[0])
    name = _in_plane(f"sides at lines {int(one.chain.moves.line[0])} and {line}", one.plane)
    both = Samples.joined([first, second])
    mean = np.tile(away / ON_SIDE, (ON_SIDE, 1))
    yield Quantity(name, "distance", line, abs(gap), "um", both, np.concatenate([-mean, mean]))
    # a side that is travelled backwards has both its direction and its normal reversed, so that its slope has the same sign
    turned = np.concatenate([-one.turn(first), two.turn(second)])
    weight = np.sign(gap) * min(one.length, two.length) * turned
    yield Quantity(name, "parallelism", line, 0.0, "um", both, weight)


def _walls(plane: int, levels: Sequence[list[_Side]], height_mm: Sequence[float]) -> Iterator[Quantity]:
    """Tilt of the sides of a closed contour that is milled at several levels."""
    if np.ptp(height_mm) < LEAST_HEIGHT_MM:
        return
    chosen = np.unique(np.linspace(0, len(levels) - 1, ON_SIDE).round().astype(int))
    height = np.array([height_mm[k] for k in chosen])
    height -= height.mean()
    for last in levels[-1]:
        parts = [next(side for side in levels[k] if side.key == last.key).chain.spread(ON_LEVEL) for k in chosen]
        # towards plus of the axis that is most normal to the wall
        normal = last.normal * np.sign(last.normal[np.argmax(np.abs(last.normal))])
        slope = np.repeat(height / float(height @ height) / ON_LEVEL, ON_LEVEL)
        line = int(last.chain.moves.line[0])
        name, samples = _in_plane(f"wall at line {line}", plane), Samples.joined(parts)
        yield Quantity(name, f"tilt over {AXES[plane]}", line, 0.0, "urad", samples, slope[:, None] * normal)


def _between(
    items: Sequence[tuple[str, int, FloatArray, Samples, Callable[[int], FloatArray]]], axes: tuple[int, ...]
) -> Iterator[Quantity]:
    """Positions from the first of several holes or circles; distances: of a few all pairs, of many neighbours and the longest.

    Each item has its name, line, place (3,), samples, and the weights of its position along an axis.
    """
    for name, line, at, samples, weights in items[1:]:
        first, _, origin, start, from_there = items[0]
        both = Samples.joined([start, samples])
        for k in axes:
            weight = np.concatenate([-from_there(k), weights(k)])
            yield Quantity(name, f"position {AXES[k]} from {first}", line, float(at[k] - origin[k]), "um", both, weight)
    pairs = list(itertools.combinations(items, 2)) if len(items) <= 8 else list(itertools.pairwise(items))
    if len(items) > 8:
        place = np.array([item[2] for item in items])
        far = [int(np.argmax(np.linalg.norm(place - end, axis=1))) for end in (place.min(axis=0), place.max(axis=0))]
        pairs.append((items[far[0]], items[far[1]]))
    for (one, _, p, first_samples, of_one), (two, line, q, second_samples, of_two) in pairs:
        length = float(np.linalg.norm((q - p)[list(axes)]))
        if length > SAME_MM:
            way = (q - p) / length
            weight = np.concatenate([-sum(way[k] * of_one(k) for k in axes), sum(way[k] * of_two(k) for k in axes)])
            both = Samples.joined([first_samples, second_samples])
            yield Quantity(f"{one} to {two.split()[1]}", "distance", line, length, "um", both, weight)
