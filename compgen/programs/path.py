"""The path of an NC program on the machine: points of lines and arcs, the exact error there, commands that correct it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, ReversalCurves
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM, error_named
from compgen.errors import ConvergenceError
from compgen.kinematics import exact_error
from compgen.programs.bends import Bends

if TYPE_CHECKING:
    from compgen.heat import Growth

IntArray = NDArray[np.int64]
RAPID, FEED, CW, CCW = range(4)
#: What a move is to radius compensation: none, the move that leads to the contour, one of the contour, one that leaves X and Y
#: where they are, and the move that leads away.
PLAIN, ENTRY, CONTOUR, STILL, EXIT = range(5)
#: Axes that span the plane of an arc, by the axis normal to it: a turn from the first to the second is positive.
PLANE_AXES = ((1, 2), (2, 0), (0, 1))
#: The inverse is repeated until commands would change by less, mm.
CONVERGED_MM = 1e-9
_MOST_STEPS, _MOST_SAMPLES = 30, 200_000
#: A move is divided where the correction is off its chord by more than this part of the tolerance at a sample.
_DIVIDED = 0.7
_FIRST, _SECOND = np.array(PLANE_AXES).T


def in_all(found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether all three of (n, 3) are true; faster than ``all(axis=1)``, which treats each row by itself."""
    return np.asarray(found[:, 0] & found[:, 1] & found[:, 2])


def sizes(vectors: FloatArray) -> FloatArray:
    """Lengths (n,) of vectors (n, 3), as ``numpy.linalg.norm`` has them, and faster."""
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    return np.asarray(np.sqrt(x * x + y * y + z * z))


@dataclass(frozen=True)
class Moves:
    """Moves of a batch, all of shape (n, ...), in mm of the machine axes.

    ``kind`` is RAPID, FEED, CW or CCW; ``sweep_rad`` the signed angle of an arc about ``centre_mm`` in the plane normal to
    axis ``plane``. ``offset_mm`` is machine position minus program position, ``tool_mm`` the tool vector of the model.
    The end of a move is corrected along the axes ``corrected`` by what the model says at ``at_mm``.
    ``phase`` says what a move is to radius compensation, ``aside_mm`` how far to the left of the contour the tool centre is
    then, inf or -inf where the radius is not known.
    """

    line: IntArray
    kind: IntArray
    start_mm: FloatArray
    end_mm: FloatArray
    centre_mm: FloatArray
    plane: IntArray
    sweep_rad: FloatArray
    offset_mm: FloatArray
    tool_mm: FloatArray
    at_mm: FloatArray
    corrected: NDArray[np.bool_]
    phase: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    aside_mm: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if np.shape(self.phase) != np.shape(self.line):
            object.__setattr__(self, "phase", np.zeros(np.shape(self.line), dtype=np.int64))
            object.__setattr__(self, "aside_mm", np.zeros(np.shape(self.line)))

    def __len__(self) -> int:
        return len(self.line)

    @property
    def cutting(self) -> NDArray[np.bool_]:
        """Which moves are at feed."""
        return np.asarray(self.kind != RAPID)

    @property
    def corrected_there(self) -> NDArray[np.bool_]:
        """Which moves are corrected by what the model says at their end; others are strokes of a hole."""
        return in_all(self.at_mm == self.end_mm)

    def part(self, rows: Any) -> Moves:
        """Return the moves of ``rows``."""
        if isinstance(rows, np.ndarray) and rows.dtype == np.int64:  # take is twice as fast
            return Moves(*(getattr(self, name).take(rows, axis=0) for name in Moves.__dataclass_fields__))
        return Moves(*(getattr(self, name)[rows] for name in Moves.__dataclass_fields__))

    def only(self, chosen: NDArray[np.bool_]) -> Moves:
        """Return the moves that are chosen (n,); these themselves if all are."""
        return self if chosen.all() else self.part(np.flatnonzero(chosen))

    @staticmethod
    def joined(parts: Iterable[Moves]) -> Moves:
        """Return the moves of several parts in their order."""
        known = [part for part in parts if len(part)] or [Moves.of_rows([])]
        if len(known) == 1:
            return known[0]
        return Moves(*(np.concatenate([getattr(p, name) for p in known]) for name in Moves.__dataclass_fields__))

    @staticmethod
    def of_rows(rows: Sequence[tuple[float, ...]] | FloatArray) -> Moves:
        """Return the moves of rows: line, kind, plane, sweep, start, end, centre, offset, tool, at, corrected, phase, aside."""
        data = np.array(rows, dtype=np.float64).reshape(len(rows), 27)
        whole, phase = data[:, :3].astype(np.int64), data[:, 25].astype(np.int64)
        start, end, centre, offset, tool, at, corrected = (data[:, k : k + 3] for k in range(4, 25, 3))
        head = (whole[:, 0], whole[:, 1], start, end, centre, whole[:, 2], data[:, 3])
        return Moves(*head, offset, tool, at, corrected > 0, phase, data[:, 26])


@dataclass(frozen=True)
class ExactModel:
    """The exact error of a machine, with its reversal if known; ``only`` (3,) are the axes that may be corrected.

    ``growth`` is the displacement by heat at the temperatures at which the program runs, the same all over the volume.
    """

    machine: Machine
    errors: ErrorTable
    reversal: ReversalCurves | None = None
    only: tuple[bool, bool, bool] = (True, True, True)
    growth: Growth | None = None

    def error(
        self,
        position_mm: FloatArray,
        tool_mm: FloatArray,
        direction: FloatArray,
        taken_up: FloatArray | float = 1.0,
    ) -> FloatArray:
        """Return the error of the tool tip at machine positions (n, 3) after travel in ``direction`` (n, 3): (n, 3), mm.

        ``taken_up`` (n, 3) is less than 1 while an axis that has turned takes up its slack, -1 at the beginning.
        """
        found = exact_error(self.machine, self.errors, position_mm, tool_mm)
        if self.growth is not None:
            found = found + self.growth.vector_mm
        return found if self.reversal is None else found + self.reversal.displacement(position_mm, direction, taken_up)

    def command(self, wanted_mm: FloatArray, tool_mm: FloatArray, direction: FloatArray) -> FloatArray:
        """Return machine positions (n, 3) at which the tip is where it would be at ``wanted_mm`` without errors.

        Solves command + error(command) = wanted by repetition; an error changes by about 1e-4 of a change of position,
        so that each step gains four digits. Coordinates that are nan stay nan.
        """
        unknown = np.isnan(wanted_mm)
        travel = np.array([axis.range_mm for axis in self.machine.axes])
        wanted = np.where(unknown, np.clip(0.0, travel[:, 0], travel[:, 1]), wanted_mm)
        found, allowed = wanted, np.array(self.only, dtype=np.float64)
        last = 0.0
        for _ in range(_MOST_STEPS):
            before, found = found, wanted - allowed * self.error(found, tool_mm, direction)
            change = float(np.abs(found - before).max(initial=0.0))
            # the next change would be smaller by the same factor as this one
            if change < CONVERGED_MM or (change < 0.1 * last and change * change < CONVERGED_MM * last):
                return np.where(unknown, np.nan, found)
            last = change
        raise ConvergenceError("the errors change too fast along the axes to be corrected; check the errors file")

    @property
    def lever_mm(self) -> float:
        """The longest lever at which a rotation acts."""
        reach_mm = float(np.linalg.norm([max(map(abs, axis.range_mm)) for axis in self.machine.axes]))
        return reach_mm + float(np.linalg.norm(self.machine.tool_offset_mm)) + 300.0

    @property
    def by_direction(self) -> bool:
        """Whether the error depends on the direction of travel."""
        return self.reversal is not None

    @cached_property
    def bends(self) -> Bends | None:
        """What bends the error along a move; None if that is not known."""
        return Bends.of(self.errors, self.reversal, self.lever_mm)

    def bend(self) -> float:
        """Return half the range of the slope of the error along any line in the volume, an upper bound, mm per mm.

        Over a length l, the error is within bend * l / 2 of the straight line between its ends.
        """
        lever_mm = self.lever_mm
        total = 0.0
        for name, curve in self.errors.curves.items():
            # beyond its ends a curve is constant
            slopes = np.concatenate([[0.0], np.diff(curve.value) / np.diff(curve.position_mm), [0.0]])
            if error_named(name).kind == "linear":
                total += 0.5 * float(np.ptp(slopes))
            else:
                total += float(np.abs(slopes).max()) * lever_mm + 0.5 * float(np.ptp(curve.value))
        return total


def _bent(model: ExactModel, moves: Moves, command_mm: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Moves for which a bound of the bend is known, and bounds (m,) of what nodes and what levers bend, mm.

    ``command_mm`` (n, 3) are those at the ends of the moves: the curves count at commands, not where the tool is.
    """
    bends = model.bends
    if bends is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0)
    known = in_all(moves.corrected) & (moves.phase == PLAIN) & in_all(np.isfinite(command_mm + moves.start_mm))
    rows = np.flatnonzero(known)
    some = moves.part(rows)
    start, end, length = some.start_mm, some.end_mm, lengths_of(some)
    way, low, high = np.abs(end - start), np.minimum(start, end), np.maximum(start, end)
    arcs = np.flatnonzero(some.sweep_rad)
    if len(arcs):
        own, index = some.part(arcs), np.arange(len(arcs))
        radius = np.maximum(*_radii(own))
        for axis in (_FIRST[own.plane], _SECOND[own.plane]):
            middle = own.centre_mm[index, axis]
            low[arcs, axis], high[arcs, axis], way[arcs, axis] = middle - radius, middle + radius, length[arcs]
    margin = np.abs(command_mm[rows] - end) + bends.change * length[:, None]
    return rows, *bends.parts(low - margin, high + margin, way, length)


def _parts_needed(nodes: FloatArray, levers: FloatArray, within_mm: float) -> FloatArray:
    """Into how many parts moves are divided so that each bends by less: of nodes each has its share, of levers the square."""
    return np.asarray(np.ceil(np.maximum(2.0 * nodes / within_mm, np.sqrt(2.0 * levers / within_mm)) - 1e-6))


def lengths_of(moves: Moves) -> FloatArray:
    """Return the length of each move, (n,), mm; a helix by its angle and rise."""
    straight = sizes(moves.end_mm - moves.start_mm)
    rows = np.flatnonzero(moves.sweep_rad)
    if len(rows):
        arcs = moves.part(rows)
        r, index = _radii(arcs), np.arange(len(rows))
        rise = (arcs.end_mm - arcs.start_mm)[index, arcs.plane]
        straight[rows] = np.hypot(0.5 * (r[0] + r[1]) * np.abs(arcs.sweep_rad), rise)
    return np.asarray(straight, dtype=np.float64)


def _in_plane(moves: Moves, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coordinates of points (n, 3) from the centres of arcs, in the plane of each."""
    index, a, b = np.arange(len(moves)), _FIRST[moves.plane], _SECOND[moves.plane]
    return points[index, a] - moves.centre_mm[index, a], points[index, b] - moves.centre_mm[index, b]


def _radii(arcs: Moves) -> tuple[FloatArray, FloatArray]:
    return np.hypot(*_in_plane(arcs, arcs.start_mm)), np.hypot(*_in_plane(arcs, arcs.end_mm))


def points_of(moves: Moves, fraction: FloatArray, own: IntArray | None = None) -> FloatArray:
    """Return the point of each move at its ``fraction`` (n,) of length, (n, 3), mm; ``own`` (n,) if not all moves in order."""
    start, end, sweep = moves.start_mm, moves.end_mm, moves.sweep_rad
    if own is not None:
        start, end, sweep = start.take(own, axis=0), end.take(own, axis=0), sweep.take(own)
    points = start + fraction[:, None] * (end - start)
    rows = np.flatnonzero(sweep)
    if len(rows):
        arcs, share, index = moves.part(rows if own is None else own[rows]), fraction[rows], np.arange(len(rows))
        u, v = _in_plane(arcs, arcs.start_mm)
        first, last = _radii(arcs)
        angle = np.arctan2(v, u) + share * arcs.sweep_rad
        radius = first + share * (last - first)
        at, (a, b) = points[rows], (_FIRST[arcs.plane], _SECOND[arcs.plane])
        at[index, a] = arcs.centre_mm[index, a] + radius * np.cos(angle)
        at[index, b] = arcs.centre_mm[index, b] + radius * np.sin(angle)
        at[share == 1.0] = arcs.end_mm[share == 1.0]
        at[share == 0.0] = arcs.start_mm[share == 0.0]
        points[rows] = at
    return points


def _leftwards(moves: Moves, points_mm: FloatArray) -> FloatArray:
    """Unit vectors (n, 3) in XY to the left of the direction of travel, at one point of each move."""
    way = (moves.end_mm - moves.start_mm)[:, :2]
    arcs = np.flatnonzero(moves.sweep_rad)
    radial = points_mm[arcs, :2] - moves.centre_mm[arcs, :2]
    way[arcs] = np.stack([-radial[:, 1], radial[:, 0]], axis=1) * np.sign(moves.sweep_rad[arcs])[:, None]
    length = np.hypot(way[:, 0], way[:, 1])
    way = way / np.where(length > 0, length, 1.0)[:, None]
    return np.stack([-way[:, 1], way[:, 0], np.zeros(len(way))], axis=1)


def tool_centres(moves: Moves, points_mm: FloatArray, own: IntArray | None = None) -> FloatArray:
    """Return where the tool centre is at points (n, 3) of moves: beside those of a contour with radius compensation."""
    phase = moves.phase if own is None else moves.phase.take(own)
    rows = np.flatnonzero(phase == CONTOUR)
    if not len(rows):
        return points_mm
    part, found = moves.part(rows if own is None else own[rows]), np.array(points_mm)
    found[rows] += _known(part.aside_mm)[:, None] * _leftwards(part, points_mm[rows])
    return found


def _known(aside_mm: FloatArray) -> FloatArray:
    """A radius that is not known counts as 0."""
    return np.where(np.isfinite(aside_mm), aside_mm, 0.0)


def reach_of(moves: Moves) -> tuple[FloatArray, FloatArray]:
    """Return the least and the largest machine position of each move, (n, 3), mm, also along arcs; nan where it is not corrected.

    An axis that the program has not placed is where the control says, and is not looked at.
    """
    least, most = np.array(moves.end_mm), np.array(moves.end_mm)
    rows = np.flatnonzero(moves.sweep_rad)
    if len(rows):
        arcs, index = moves.part(rows), np.arange(len(rows))
        u, v = _in_plane(arcs, arcs.start_mm)
        (first, last), begin = _radii(arcs), np.arctan2(v, u)
        for quarter in range(4):
            # an arc may be farther out where it is parallel to an axis
            way = ((0.5 * np.pi * quarter - begin) * np.sign(arcs.sweep_rad)) % (2.0 * np.pi)
            share = way / np.abs(arcs.sweep_rad)
            axis = (_FIRST, _SECOND)[quarter % 2][arcs.plane]
            out = first + share * (last - first)
            place = arcs.centre_mm[index, axis] + (out if quarter < 2 else -out)
            place = np.where(share < 1.0, place, arcs.end_mm[index, axis])
            least[rows, axis] = np.minimum(least[rows, axis], place)
            most[rows, axis] = np.maximum(most[rows, axis], place)
    return np.where(moves.corrected, least, np.nan), np.where(moves.corrected, most, np.nan)


def _portions(samples: IntArray) -> list[IntArray]:
    """Indices of moves in portions of about _MOST_SAMPLES, so that memory does not grow with their length."""
    every = np.arange(len(samples))
    return np.split(every, np.flatnonzero(np.diff(np.cumsum(samples) // _MOST_SAMPLES)) + 1) if len(samples) else []


def directions_at(moves: Moves, fraction: FloatArray) -> FloatArray:
    """Return the sign of travel of each axis at a ``fraction`` of each move, (n, 3); 0 where an axis rests."""
    change = moves.end_mm - moves.start_mm
    rows = np.flatnonzero(moves.sweep_rad)
    if len(rows):
        arcs, index = moves.part(rows), np.arange(len(rows))
        u, v = _in_plane(arcs, points_of(arcs, fraction[rows]))
        own, turn = change[rows], np.sign(arcs.sweep_rad)
        own[index, _FIRST[arcs.plane]], own[index, _SECOND[arcs.plane]] = -v * turn, u * turn
        change[rows] = np.where(np.abs(own) > 1e-9 * np.abs(own).max(axis=1, keepdims=True), own, 0.0)
    return np.where(np.abs(np.nan_to_num(change)) > 1e-9, np.sign(np.nan_to_num(change)), 0.0)


def is_closed(sweep_rad: FloatArray | float) -> NDArray[np.bool_]:
    """Return which arcs are full circles, one or several."""
    turns = np.abs(np.asarray(sweep_rad)) / (2.0 * np.pi)
    return np.asarray((turns > 0.5) & (np.abs(turns - np.round(turns)) < 1e-9))


def kept_directions(found: FloatArray, before: FloatArray) -> FloatArray:
    """Return directions (n, 3) where a resting axis (0) keeps its last one; ``before`` (3,) is that of the first."""
    every = np.vstack([before, found])
    last = np.maximum.accumulate(np.where(every != 0, np.arange(len(every))[:, None], 0), axis=0)
    return np.take_along_axis(every, last, axis=0)[1:]


def closest_offset(moves: Moves, own: IntArray, points_mm: FloatArray, fraction: FloatArray) -> FloatArray:
    """Return vectors (n, 3) to points (n, 3) from the paths of the moves ``own``; ``fraction`` is about where they belong.

    A peck may end a little higher or lower: the line of its stroke counts, also beyond its end.
    """
    start = moves.start_mm.take(own, axis=0)
    way = moves.end_mm.take(own, axis=0) - start
    square = np.einsum("ij,ij->i", way, way)
    along = np.einsum("ij,ij->i", points_mm - start, way) / np.where(square > 0, square, 1.0)
    share = np.where(square > 0, along, 1.0)
    rows = np.flatnonzero(moves.sweep_rad.take(own))
    if len(rows):
        arcs = moves.part(own[rows])
        u, v = _in_plane(arcs, points_mm[rows])
        u0, v0 = _in_plane(arcs, arcs.start_mm)
        angle = (np.arctan2(v, u) - np.arctan2(v0, u0)) / arcs.sweep_rad
        turn = 2.0 * np.pi / np.abs(arcs.sweep_rad)
        share[rows] = angle + turn * np.round((fraction[rows] - angle) / turn)
    peck = (~moves.corrected_there).take(own)
    return points_mm - points_of(moves, np.where(peck, share, np.clip(share, 0.0, 1.0)), own)


# Division of moves: straight pieces, and arcs of which each is again an arc.


@dataclass(frozen=True)
class Pieces:
    """Corrected pieces of moves, in order: index of the move, share where the piece ends, command, centre of an arc."""

    move: IntArray
    share: FloatArray
    command_mm: FloatArray
    centre_mm: FloatArray

    def begins(self) -> FloatArray:
        """Return the share of its move where each piece begins."""
        return np.where(np.diff(self.move, prepend=-1) > 0, 0.0, np.roll(self.share, 1))


@dataclass
class Corrector:
    """Turns moves into corrected pieces; remembers the direction of each axis from batch to batch.

    ``tolerance_mm`` is the largest deviation within a piece, ``shortest_mm`` the shortest piece that a division makes.
    ``resolution_mm`` is the last decimal of the program: arcs that change by less stay as they are.
    """

    model: ExactModel
    tolerance_mm: float
    shortest_mm: float
    resolution_mm: float
    direction: FloatArray = field(default_factory=lambda: np.zeros(3))
    #: The command at the end of the last move.
    command_mm: FloatArray = field(default_factory=lambda: np.full(3, np.nan))

    def __post_init__(self) -> None:
        bend = self.model.bend()
        #: Distance of samples, so that the error between them is known to a quarter of the tolerance.
        self.step_mm = 0.5 * self.tolerance_mm / bend if bend > 0 else np.inf

    def pieces(self, moves: Moves, by_radius: NDArray[np.bool_], drilled: NDArray[np.bool_]) -> Pieces:
        """Return the corrected pieces of moves.

        ``by_radius`` (n,) are arcs that are programmed with a radius, ``drilled`` (n,) moves of a cycle, which stay whole.
        """
        one = np.ones(len(moves))
        began = ended = np.zeros((len(moves), 3))
        if self.model.by_direction:
            began = kept_directions(directions_at(moves, 1e-7 * one), self.direction)
            ended = kept_directions(directions_at(moves, one - 1e-7), self.direction)
        before = np.vstack([self.direction, ended[:-1]])[: len(moves)]
        if len(moves):
            self.direction = ended[-1]
        compensated = moves.phase != PLAIN
        # slack that is taken up by short pieces would be a step in the contour
        ended = np.where(compensated[:, None], 0.0, ended)
        command = self._ends(moves, ended)
        begin = np.vstack([self.command_mm, command[:-1]])[: len(moves)]
        self.command_mm = command[-1] if len(moves) else self.command_mm
        divisible = ~drilled & moves.cutting & moves.corrected.any(axis=1) & moves.corrected_there
        divisible &= ~compensated | (moves.phase == CONTOUR)
        turned: NDArray[np.bool_] = np.zeros(len(moves), dtype=bool)
        if self.model.reversal is not None:
            turned = np.asarray(((began * before) < 0).any(axis=1)) & ~compensated
        divisible &= (moves.sweep_rad != 0) | turned | self._may_bend(moves, command)
        lines = np.flatnonzero(divisible & (moves.sweep_rad == 0))
        samples = np.ceil(lengths_of(moves.part(lines)) / self.step_mm).astype(np.int64) + 1
        inner = [self._straight(moves, lines[part], ended, turned, (begin, command)) for part in _portions(samples)]
        arcs = np.flatnonzero(divisible & (moves.sweep_rad != 0))
        centre = np.array(moves.centre_mm)
        if len(arcs):
            found = self._arcs(moves, arcs, by_radius, (before, ended), turned, (begin, command))
            last = found.share == 1.0
            centre[found.move[last]] = found.centre_mm[last]
            inner.append(Pieces(*(getattr(found, name)[~last] for name in Pieces.__dataclass_fields__)))
        whole = Pieces(np.arange(len(moves)), one, command, centre)
        every = [*inner, whole]
        joined = [np.concatenate([getattr(part, name) for part in every]) for name in Pieces.__dataclass_fields__]
        order = np.lexsort((joined[1], joined[0]))
        return Pieces(*(item[order] for item in joined))

    def _may_bend(self, moves: Moves, command: FloatArray) -> NDArray[np.bool_]:
        """Which straight moves the error may bend by so much that they are divided; True where no bound is known.

        ``command`` are those at their ends: the curves that a move crosses are those at its commands.
        """
        rows, nodes, levers = _bent(self.model, moves, command)
        found = np.ones(len(moves), dtype=bool)
        found[rows] = nodes + levers > _DIVIDED * self.tolerance_mm
        return found

    def _ends(self, moves: Moves, direction: FloatArray) -> FloatArray:
        """Commands for the ends of moves (n, 3); of contours with radius compensation so that the tool centre is right.

        A corner goes to where both lines that the tool centre follows beside it are right. Where X and Y rest they keep their
        command, since the control would take a step of a few um for a piece of the contour.
        """
        contour = np.flatnonzero(moves.phase == CONTOUR)
        beside, normal = np.zeros((len(moves), 3)), np.zeros((2, len(moves), 3))
        if len(contour):
            part = moves.part(contour)
            for side, points in enumerate((part.start_mm, part.end_mm)):
                normal[side, contour] = _leftwards(part, points)
            beside[contour] = _known(part.aside_mm)[:, None] * normal[1, contour]
        first, then = _joints(moves.phase)
        enters = moves.phase[first] == ENTRY
        beside[first[enters]] = _known(moves.aside_mm[then[enters]])[:, None] * normal[0, then[enters]]
        for k in np.flatnonzero((moves.phase == STILL) & (moves.aside_mm != 0)).tolist():
            beside[k] = beside[k - 1] if k else 0.0
        at = moves.at_mm + beside
        shift = self.model.command(at, moves.tool_mm, direction) - at
        if len(first):
            begins = moves.start_mm[then] + _known(moves.aside_mm[then])[:, None] * normal[0, then]
            shift_then = self.model.command(begins, moves.tool_mm[then], direction[then]) - begins
            shift[first] = _corner_shifts(shift[first], shift_then, normal[1, first], normal[0, then], then - first > 1)
        command = np.asarray(moves.end_mm + np.where(moves.corrected, shift, 0.0))
        for k in np.flatnonzero((moves.phase == STILL) & moves.corrected[:, :2].all(axis=1)).tolist():
            command[k, :2] = command[k - 1, :2] if k else self.command_mm[:2]
        return command

    def _commands(self, moves: Moves, owner: IntArray, wanted_mm: FloatArray, direction: FloatArray) -> FloatArray:
        """Commands (n, 3) for points of the moves ``owner``; points of a contour go by as much as the tool centre beside them."""
        centre = tool_centres(moves, wanted_mm, owner)
        command = self.model.command(centre, moves.tool_mm.take(owner, axis=0), direction)
        command = command if centre is wanted_mm else wanted_mm + (command - centre)
        return np.asarray(np.where(moves.corrected.take(owner, axis=0), command, wanted_mm))

    def _shortest(self, moves: Moves) -> FloatArray:
        """The shortest pieces of moves, mm: those of contours so long that a rounded end turns the tool by a few mrad only.

        The tool centre moves by the radius times that angle: more than a part of the piece, and it would vanish at an inner bend.
        """
        radius = np.abs(_known(moves.aside_mm))
        return np.asarray(np.maximum(self.shortest_mm, 6.4 * np.sqrt(radius * self.resolution_mm)))

    def _straight(
        self,
        moves: Moves,
        rows: IntArray,
        ended: FloatArray,
        turned: NDArray[np.bool_],
        ends: tuple[FloatArray, FloatArray],
    ) -> Pieces:
        """Inner ends of the pieces of straight moves, by Ramer's method: divide where the correction is off its chord most.

        ``ends`` are the commands (n, 3) where moves of contours begin and end.
        """
        length = lengths_of(moves.part(rows))
        # shorter moves cannot bend by more than the tolerance
        rows = rows[(length > 4.0 * self.step_mm) | (turned[rows] & (length > 2.0 * self.shortest_mm))]
        if not len(rows):
            return Pieces(rows, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
        length = lengths_of(moves.part(rows))
        most = np.floor(length / self._shortest(moves.part(rows)))
        count = np.clip(np.ceil(length / self.step_mm), np.where(turned[rows], 2.0, 1.0), np.maximum(most, 1.0))
        count = count.astype(np.int64) + 1
        first = np.cumsum(count) - count
        own = np.repeat(np.arange(len(rows)), count)
        share = (np.arange(len(own)) - first[own]) / (count[own] - 1)
        breaks = np.isin(share, (0.0, 1.0))
        takes_up = np.flatnonzero(turned[rows] & (count > 2))
        # after a reversal the slack is taken up at once: the first piece is as short as allowed
        share[first[takes_up] + 1] = np.minimum(share[first[takes_up] + 1], self.shortest_mm / length[takes_up])
        breaks[first[takes_up] + 1] = True
        may_break: NDArray[np.bool_] | bool = True
        if moves.phase.any():
            cut = _cut_by_corners(moves)[rows][own]
            # a piece that an inner corner takes away has no path beside it, and the tool does not come there
            apart = np.stack([share, 1.0 - share], axis=1) * length[own, None]
            may_break = ((cut == 0.0) | (apart > cut + self._shortest(moves.part(rows))[own, None])).all(axis=1)
        owner = rows[own]
        wanted = points_of(moves, share, owner)
        target = self._commands(moves, owner, wanted, ended.take(owner, axis=0))
        contour = np.flatnonzero(moves.phase[rows] == CONTOUR)
        if len(contour):
            target[first[contour]] = ends[0][rows[contour]]
            target[first[contour] + count[contour] - 1] = ends[1][rows[contour]]
        along = _along(moves.part(rows))[own]
        while True:
            at, part = np.flatnonzero(breaks), np.cumsum(breaks) - 1
            left, right = at[part], at[np.minimum(part + 1, len(at) - 1)]
            width = np.where(breaks, 1.0, share[right] - share[left])
            chord = target[left] + ((share - share[left]) / width)[:, None] * (target[right] - target[left])
            across = target - chord
            # the corner of a contour may be farther along its lines than what is right within them
            across -= np.einsum("ij,ij->i", across, along)[:, None] * along
            off = np.where(may_break & ~breaks, sizes(across), 0.0)
            new = (off > _DIVIDED * self.tolerance_mm) & (off == np.maximum.reduceat(off, at)[part])
            if not new.any():
                break
            breaks[new] = True
        inner = breaks & (share > 0.0) & (share < 1.0)
        return Pieces(rows[own[inner]], share[inner], target[inner], np.full((int(inner.sum()), 3), np.nan))

    def _arcs(
        self,
        moves: Moves,
        rows: IntArray,
        by_radius: NDArray[np.bool_],
        directions: tuple[FloatArray, FloatArray],
        turned: NDArray[np.bool_],
        ends: tuple[FloatArray, FloatArray],
    ) -> Pieces:
        """Pieces of arcs: one arc where that follows the correction, otherwise halves, and halves of these.

        ``directions`` are the signs of travel (n, 3) before each move and at its end, ``ends`` the commands (n, 3) where moves of
        contours begin and end.
        """
        done: list[tuple[Any, ...]] = []
        length, work = lengths_of(moves), self._cuts(moves, rows, turned)
        most = length / self.step_mm
        known, nodes, levers = _bent(self.model, moves.part(rows), ends[1][rows])
        most[rows[known]] = np.minimum(most[rows[known]], _parts_needed(nodes, levers, 0.25 * self.tolerance_mm))
        while len(work):  # all arcs at a time, then the halves of those that do not follow
            again = []
            # each arc has as many samples as its own length and angle need, in steps of a factor of two
            move, share = work[:, 0].astype(np.int64), work[:, 2] - work[:, 1]
            least = np.where(share * np.abs(moves.sweep_rad[move]) > 0.5 * np.pi + 1e-6, 16, 8)
            needed = np.clip(share * most[move], least, 2048)
            steps = 2 ** np.ceil(np.log2(needed)).astype(np.int64)
            for count in np.unique(steps).tolist():
                for some in _portions(steps[steps == count]):
                    part = work[steps == count][some]
                    move, low, high = part[:, 0].astype(np.int64), part[:, 1], part[:, 2]
                    end, centre, fine = self._fit_arcs(
                        moves, (move, low, high), count, by_radius, directions, length, ends
                    )
                    done.append((move[fine], high[fine], end[fine], centre[fine]))
                    rest, half = ~fine, 0.5 * (low + high)
                    again += [np.stack([move, low, half], axis=1)[rest], np.stack([move, half, high], axis=1)[rest]]
            work = np.concatenate(again)
        return Pieces(*(np.concatenate(column) for column in zip(*done, strict=True)))

    def _fit_arcs(
        self,
        moves: Moves,
        parts: tuple[IntArray, FloatArray, FloatArray],
        steps: int,
        by_radius: NDArray[np.bool_],
        directions: tuple[FloatArray, FloatArray],
        length: FloatArray,
        ends: tuple[FloatArray, FloatArray],
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Ends and centres, (n, 3), of corrected parts of arcs, and which follow; ``parts``: move, shares of begin and end."""
        move, low, high = parts
        before, ended = directions
        share = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, steps + 1)
        share[:, -1] = high
        many = np.repeat(move, steps + 1)
        wanted = points_of(moves, share.ravel(), many)
        contour, direction = moves.phase[move] == CONTOUR, ended[move]
        if self.model.by_direction:
            middle = directions_at(moves.part(move), 0.5 * (low + high))
            known = (middle != 0) | contour[:, None]
            direction = np.where(known, np.where(contour[:, None], 0.0, middle), direction)
        target = self._commands(moves, many, wanted, np.repeat(direction, steps + 1, axis=0))
        sweep = (high - low) * moves.sweep_rad[move]
        target = target.reshape(len(move), steps + 1, 3)
        for side, share_there, there in ((0, low == 0.0, ends[0]), (-1, high == 1.0, ends[1])):
            own = np.flatnonzero(contour & share_there)
            target[own, side] = there[move[own]]
        still = np.abs(target.reshape(-1, 3) - wanted).reshape(len(move), -1).max(axis=1) < 0.25 * self.resolution_mm
        centre, off = _fitted_arcs(target, moves.plane[move], sweep)
        centre[still] = moves.centre_mm[move[still]]
        # an arc by its radius is well defined up to a third of a circle; one that nearly closes could become a full one
        wide = by_radius[move] & (np.abs(sweep) > 2.1)
        index, (a, b) = np.arange(len(move)), (_FIRST[moves.plane[move]], _SECOND[moves.plane[move]])
        chord = np.hypot(*(target[index, -1, k] - target[index, 0, k] for k in (a, b)))
        gap = np.where(is_closed(sweep), chord, 0.0)
        wide |= gap > max(0.25 * self.resolution_mm, 0.2 * self.tolerance_mm)
        wide |= ~is_closed(sweep) & (np.abs(sweep) > np.pi) & (chord < 50.0 * self.resolution_mm)
        short = (high - low) * length[move] < 2.0 * self._shortest(moves.part(move))
        fine = still | ((off <= _DIVIDED * self.tolerance_mm) & ~wide) | short
        if self.model.reversal is not None:
            # the slack of an axis that has turned is taken up within a short arc, from where the piece before it ended
            arcs = moves.part(move)
            came = directions_at(arcs, np.maximum(low - 1e-7, 0.0))
            within = (low > 0.0)[:, None]
            came = np.where(within, np.where(came != 0, came, ended[move]), before[move])
            start = self.model.command(wanted[:: steps + 1], arcs.tool_mm, came)
            start = np.where(arcs.corrected, start, wanted[:: steps + 1])
            slack = np.hypot(*(start[index, k] - target[index, 0, k] for k in (a, b))) > self.resolution_mm
            slack &= ~contour
            around = _arc_centre(start, target[:, -1], arcs, sweep)
            centre[slack], fine[slack] = around[slack], short[slack]
        # only the block as a whole says how many turns it has
        fine &= (np.abs(sweep) < 2.0 * np.pi + 1e-9) | (high - low == 1.0)
        return target[:, -1], centre, fine

    def _cuts(self, moves: Moves, rows: IntArray, turned: NDArray[np.bool_]) -> FloatArray:
        """Parts of arcs ``rows`` (move, share of begin, share of end) within which no axis reverses.

        With reversal curves there is a short piece after each reversal, also at the begin of those that ``turned``.
        """
        if self.model.reversal is None:
            return np.stack([rows, np.zeros(len(rows)), np.ones(len(rows))], axis=1)
        arcs, quarter = moves.part(rows), 0.5 * np.pi
        u, v = _in_plane(arcs, arcs.start_mm)
        start, sweep = np.arctan2(v, u), arcs.sweep_rad
        first = np.ceil(np.minimum(start, start + sweep) / quarter)
        count = (np.floor(np.maximum(start, start + sweep) / quarter) + 1 - first).astype(np.int64)
        own = np.repeat(np.arange(len(rows)), count)
        rank = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
        share = np.abs((quarter * (first[own] + rank) - start[own]) / sweep[own])
        inside = (share > 1e-9) & (share < 1 - 1e-9) & (arcs.phase[own] == PLAIN)
        own, share = own[inside], share[inside]
        every, short, at_begin = np.arange(len(rows)), self.shortest_mm / lengths_of(arcs), np.flatnonzero(turned[rows])
        owners = np.concatenate([every, every, own, own, at_begin])
        shares = np.concatenate([0.0 * short, 0.0 * short + 1.0, share, share + short[own], short[at_begin]])
        # what is shorter than a few last decimals is no piece of its own
        gap = 4.0 * self.resolution_mm / lengths_of(arcs)[owners]
        allowed = np.isin(shares, (0.0, 1.0)) | ((shares > gap) & (shares < 1.0 - gap))
        known = np.unique(np.stack([owners, shares, gap], axis=1)[allowed], axis=0)
        near = (np.diff(known[:, 0]) == 0) & (np.diff(known[:, 1]) <= known[1:, 2]) & (known[1:, 1] < 1.0)
        known = known[~np.concatenate([[False], near]), :2]
        parts = np.concatenate([known[:-1], known[1:, 1:]], axis=1)[known[1:, 0] == known[:-1, 0]]
        return np.column_stack([rows[parts[:, 0].astype(np.int64)], parts[:, 1:]])


def _joints(phase: IntArray) -> tuple[IntArray, IntArray]:
    """Moves that end where a contour goes on, and the moves with which it does; what leaves X and Y may stand between."""
    every = np.flatnonzero((phase == ENTRY) | (phase == CONTOUR))
    follows = phase[every[1:]] == CONTOUR
    return every[:-1][follows], every[1:][follows]


def _cut_by_corners(moves: Moves) -> FloatArray:
    """How much of each move of a contour inner corners take away at its begin and at its end, (n, 2), mm; 0 for others.

    Between straight moves it is the radius times the tangent of half the turn; beside an arc about that.
    """
    found = np.zeros((len(moves), 2))
    first, then = _joints(moves.phase)
    both = (moves.phase[first] == CONTOUR) & np.isfinite(moves.aside_mm[then])
    first, then = first[both], then[both]
    if not len(first):
        return found
    before, after = moves.part(first), moves.part(then)
    one, other = _leftwards(before, before.end_mm), _leftwards(after, after.start_mm)
    turn = np.arctan2(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0], (one * other).sum(axis=1))
    aside = after.aside_mm
    cut = np.where(turn * aside > 0.0, np.abs(aside) * np.tan(0.5 * np.minimum(np.abs(turn), 3.0)), 0.0)
    found[first, 1], found[then, 0] = cut, cut
    return found


def _along(moves: Moves) -> FloatArray:
    """Unit vectors (n, 3) along straight moves of contours, 0 for others."""
    way = np.where((moves.phase == CONTOUR)[:, None], moves.end_mm - moves.start_mm, 0.0)
    length = np.linalg.norm(way, axis=1)
    return np.asarray(way / np.where(length > 0, length, 1.0)[:, None])


def _corner_shifts(
    before: FloatArray, then: FloatArray, normal: FloatArray, normal_then: FloatArray, apart: NDArray[np.bool_]
) -> FloatArray:
    """How far corners of contours go, (n, 3): along both normals as far as the tool centre beside them has to.

    ``before`` and ``then`` are the shifts of the tool centre at the end of one side and where the next begins, ``apart`` whether
    a move along Z stands between. After the move that leads to the contour (normal 0) only the next side counts.
    """
    enters = ~normal.any(axis=1)
    half, found = 0.5 * (before - then), 0.5 * (before + then)
    found[enters, :2] = then[enters, :2]
    found[apart | enters, 2] = before[apart | enters, 2]
    for across, other, least in (
        (normal - normal_then, normal + normal_then, 1e-4),
        (normal + normal_then, normal - normal_then, 1e-2),
    ):
        square = np.einsum("ij,ij->i", across, across)
        # nearly one direction, or back on itself: the tool centres are nearly one, or no corner does it
        good = ~(enters | apart) & (square > least)
        size = np.einsum("ij,ij->i", other, half) / np.where(good, square, 1.0)
        found[good, :2] += (size[:, None] * across)[good, :2]
    return found


def _arc_centre(start_mm: FloatArray, end_mm: FloatArray, arcs: Moves, sweep: FloatArray) -> FloatArray:
    """Centres (n, 3) of arcs of less than half a turn between two points, with about the radius of ``arcs`` and their sense."""
    index, a, b = np.arange(len(arcs)), _FIRST[arcs.plane], _SECOND[arcs.plane]
    du, dv = end_mm[index, a] - start_mm[index, a], end_mm[index, b] - start_mm[index, b]
    chord = np.maximum(np.hypot(du, dv), 1e-12)
    height = np.sqrt(np.maximum(_radii(arcs)[0], chord) ** 2 - 0.25 * chord**2) * np.sign(sweep) / chord
    centre = np.full((len(arcs), 3), np.nan)
    centre[index, a] = start_mm[index, a] + 0.5 * du - height * dv
    centre[index, b] = start_mm[index, b] + 0.5 * dv + height * du
    return centre


def _fitted_arcs(target: FloatArray, plane: IntArray, sweep: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres (n, 3) of arcs from first to last of points (n, k, 3) and how far the points are off, (n,), mm.

    The centre has the same distance from both ends. Along the normal of their chord it fits the other points best:
    |p - c| = |s - c| is linear in the centre. Ends that coincide (a full circle) leave both coordinates free.
    """
    index, (a, b) = np.arange(len(target)), (_FIRST[plane], _SECOND[plane])
    u, v, w = target[index, :, a], target[index, :, b], target[index, :, plane]
    du, dv = u - u[:, :1], v - v[:, :1]
    half = 0.5 * (du**2 + dv**2)
    ends = np.hypot(du[:, -1], dv[:, -1])
    closed = is_closed(sweep)
    width = np.where(closed, 1.0, np.where(ends > 0, ends, 1.0))
    nu, nv = -dv[:, -1] / width, du[:, -1] / width
    side = du * nu[:, None] + dv * nv[:, None]
    middle = 0.5 * (du * du[:, -1:] + dv * dv[:, -1:])
    off = np.einsum("ij,ij->i", side, half - middle) / np.maximum(np.einsum("ij,ij->i", side, side), 1e-300)
    cu, cv = 0.5 * du[:, -1] + off * nu, 0.5 * dv[:, -1] + off * nv
    for k in np.flatnonzero(closed):
        cu[k], cv[k] = np.linalg.lstsq(np.stack([du[k], dv[k]], axis=1), half[k], rcond=None)[0]
    radius = np.hypot(cu, cv)
    radial = np.hypot(du - cu[:, None], dv - cv[:, None]) - radius[:, None]
    rise = w - (w[:, :1] + np.linspace(0.0, 1.0, w.shape[1]) * (w[:, -1:] - w[:, :1]))
    centre = np.full((len(target), 3), np.nan)
    centre[index, a], centre[index, b] = u[:, 0] + cu, v[:, 0] + cv
    return centre, np.hypot(radial, rise).max(axis=1)


# Deviations of the tool from the path.


@dataclass(frozen=True)
class PathDeviations:
    """Samples (n,) of moves at feed: machine position, vectors to the tool from the point at the same share and from the path.

    ``line`` is that of the block, ``weight_mm`` the length that a sample stands for, ``at_end`` the ends of moves.
    """

    line: IntArray
    position_mm: FloatArray
    whole_mm: FloatArray
    normal_mm: FloatArray
    weight_mm: FloatArray
    at_end: NDArray[np.bool_]


def _slack_taken_up(
    reversal: ReversalCurves,
    at_mm: FloatArray,
    direction: FloatArray,
    before: tuple[FloatArray, FloatArray],
    anew: NDArray[np.bool_],
) -> FloatArray:
    """How much of its slack each axis has taken up at samples, (n, 3): from -1 where it has just turned to 1.

    The tool rests while the command moves by the reversal value, so its displacement changes by as much. ``before`` are
    direction and command before each sample, ``anew`` (n,) where slack of earlier samples is over. An axis that
    overshoots (a positive reversal value) has no slack.
    """
    found = np.ones_like(direction)
    came, came_from = before
    for axis in {axis for axis, component in reversal.curves if axis == component}:
        value = reversal.curves[axis, axis].at(at_mm[:, axis])
        turned = came[:, axis] * direction[:, axis] < 0.0
        place = np.where(turned, came_from[:, axis], np.inf)
        last = np.maximum.accumulate(np.where(turned | anew, np.arange(len(place)), 0))
        share = 2.0 * np.abs(at_mm[:, axis] - place[last]) / np.maximum(-value, 1e-12) - 1.0
        found[:, axis] = np.where(value < 0.0, np.clip(share, -1.0, 1.0), 1.0)
    return found


#: Samples of a move at least, also of one that the error hardly bends, and of a quarter turn of such an arc.
_LEAST_SAMPLES, _HARDLY_BENT, _IN_A_QUARTER = 2, 5, 8


def _samples_needed(model: ExactModel, driven: Moves, within_mm: float) -> FloatArray:
    """How many samples each move needs (n,), so that the error is within this of what is between them; inf if not known."""
    found = np.full(len(driven), np.inf)
    if model.by_direction:
        return found  # slack has steps of its own
    rows, nodes, levers = _bent(model, driven, driven.end_mm)
    quarters = np.abs(driven.sweep_rad[rows]) / (0.5 * np.pi)
    needed = np.maximum(_parts_needed(nodes, levers, within_mm), np.ceil(_IN_A_QUARTER * quarters - 1e-6)) + 1.0
    found[rows] = np.maximum(needed, _HARDLY_BENT)
    return found


def path_deviations(
    model: ExactModel,
    step_mm: float,
    wanted: Moves,
    owner: IntArray,
    driven: Moves,
    shares: tuple[FloatArray, FloatArray],
    directions: tuple[FloatArray, FloatArray],
    within_mm: float = 0.0,
) -> Iterator[PathDeviations]:
    """Sample moves that are driven and compare the tool there with the moves that are wanted.

    Parameters
    ----------
    model, step_mm : the machine, and the distance of samples.
    within_mm : fewer samples where the error is known to be within this of what is between them.
    wanted, directions : moves of the program, and the directions of the axes before each and at its end.
    owner, shares : for each driven move the wanted one, and the shares of that at which it begins and ends.
    driven : the moves at feed that the machine executes.
    """
    (low, high), (before, ended) = shares, directions
    length, ends = lengths_of(driven), wanted.corrected_there
    count = np.clip(np.ceil(length / step_mm - 1e-6), _LEAST_SAMPLES, 2000)
    needed = _samples_needed(model, driven, within_mm) if within_mm else count
    from_start = needed < count  # few samples have one at the start, which else is close to the first
    count = np.where(from_start, needed, count).astype(np.int64)
    for part in _portions(count):
        own = np.repeat(part, count[part])
        begin = np.repeat(np.cumsum(count[part]) - count[part], count[part])
        first = from_start[own]
        share = (np.arange(len(own)) - begin + ~first) / (count[own] - first)
        path = owner[own]
        at, direction = points_of(driven, share, own), ended.take(path, axis=0)
        where = np.clip(low[own] + share * (high - low)[own], 0.0, 1.0)
        taken_up: FloatArray | float = 1.0
        if model.reversal is not None:
            # that of the programmed arc; a piece ends where an axis turns, and has its direction to the end
            within = low[own] + np.clip(share, 1e-3, 1.0 - 1e-3) * (high - low)[own]
            now = directions_at(wanted.part(path), np.clip(within, 0.0, 1.0))
            direction = np.where((wanted.sweep_rad[path] != 0)[:, None] & (now != 0), now, direction)
            begins = np.arange(len(own)) == begin
            fresh = begins & (low[own] == 0.0)  # the moves before this one may be rapid, and are not among the samples
            came = np.where(fresh[:, None], before.take(path, axis=0), np.roll(direction, 1, axis=0))
            came_from = np.where(begins[:, None], driven.start_mm.take(own, axis=0), np.roll(at, 1, axis=0))
            rapid = np.append(wanted.kind[:-1] == RAPID, True)[path - 1]
            taken_up = _slack_taken_up(model.reversal, at, direction, (came, came_from), fresh & rapid)
        actual = at + model.error(at, wanted.tool_mm.take(path, axis=0), direction, taken_up)
        whole, normal = actual - points_of(wanted, where, path), closest_offset(wanted, path, actual, where)
        # on a steep helix the point at the same angle may be farther away than that at the same share
        nearer = sizes(whole) < sizes(normal)
        yield PathDeviations(
            wanted.line[path],
            at,
            whole,
            np.where(nearer[:, None], whole, normal),
            length[own] / (count[own] - first) * np.where(first & ((share == 0.0) | (share == 1.0)), 0.5, 1.0),
            # the end of a peck is none of the part
            (share == 1.0) & (high[own] == 1.0) & ends[path],
        )


@dataclass
class PathFigures:
    """Deviations of the tool from the programmed path over the length of all moves at feed, in mm.

    ``largest`` and ``rms`` compare with the point at the same share of a move, ``normal`` ones with the nearest point of
    the path, ``ends`` with the ends of the moves; ``line`` is that of ``largest_mm``, ``normal_line`` that of ``normal_mm``.
    """

    largest_mm: float = 0.0
    line: int = 0
    normal_line: int = 0
    normal_mm: float = 0.0
    ends_mm: float = 0.0
    length_mm: float = 0.0
    _square: float = 0.0
    _normal_square: float = 0.0

    def add(self, found: PathDeviations) -> None:
        """Add the deviations of some samples."""
        size, across = sizes(found.whole_mm), sizes(found.normal_mm)
        worst = int(np.argmax(size))
        if size[worst] > self.largest_mm:
            self.largest_mm, self.line = float(size[worst]), int(found.line[worst])
        farthest = int(np.argmax(across))
        if across[farthest] > self.normal_mm:
            self.normal_mm, self.normal_line = float(across[farthest]), int(found.line[farthest])
        self.ends_mm = max(self.ends_mm, float(size[found.at_end].max(initial=0.0)))
        self.length_mm += float(found.weight_mm.sum())
        self._square += float(found.weight_mm @ size**2)
        self._normal_square += float(found.weight_mm @ across**2)

    @property
    def rms_mm(self) -> float:
        """Root mean square of the deviation over the length."""
        return float(np.sqrt(self._square / self.length_mm)) if self.length_mm else 0.0

    @property
    def worst_mm(self) -> float:
        """Largest distance from the path or from the end of a move; shift along a move on the way does not count."""
        return max(self.normal_mm, self.ends_mm)

    @property
    def normal_rms_mm(self) -> float:
        """Root mean square of the distance from the path over the length."""
        return float(np.sqrt(self._normal_square / self.length_mm)) if self.length_mm else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the figures in um."""
        return {
            "max_um": self.largest_mm / MM_PER_UM,
            "rms_um": self.rms_mm / MM_PER_UM,
            "normal_max_um": self.normal_mm / MM_PER_UM,
            "normal_rms_um": self.normal_rms_mm / MM_PER_UM,
            "ends_max_um": self.ends_mm / MM_PER_UM,
            "worst_line": self.line,
            "normal_line": self.normal_line,
        }
