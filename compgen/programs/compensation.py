"""Radius compensation: the path of the tool centre beside a contour, as the control finds it.

Lines and arcs move aside by the radius. At an inner corner both end where they meet; about an outer one the tool goes on an
arc around the corner. The move to the contour ends, and that from it begins, beside the contour, at right angles to its first
and last move. Where a move would vanish, or an arc turn inside out, the control stops with an alarm: such contours have no path.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.names import MM_PER_UM
from compgen.errors import InputError
from compgen.programs.path import (
    CCW,
    CONTOUR,
    CW,
    ENTRY,
    EXIT,
    PLAIN,
    RAPID,
    STILL,
    ExactModel,
    IntArray,
    Moves,
    points_of,
    tool_centres,
)

#: Radii that are not known are taken to be up to so large, mm.
LARGEST_RADIUS_MM = 25.0
#: Directions that differ by less are one, rad: the offset of both ends is one point.
_ONE_WAY_RAD = 1e-7
#: A contour that turns by more goes back on itself, rad.
_BACK_RAD = math.radians(179.5)
#: An arc that the tool follows on its inner side is larger than its radius by this, mm.
_LEAST_RADIUS_MM = 1e-4
#: Lines and arcs that miss each other by less touch, mm: numbers of a program are rounded.
_TOUCH_MM = 0.01
#: Arcs about corners that are shorter are none, mm.
_SHORTEST_CORNER_MM = 0.01
#: By how much pieces of one move may bend the contour, rad: controls go straight on there.
_LARGEST_BEND_RAD = 0.05


@dataclass(frozen=True)
class CentrePath:
    """The path of the tool centre: one move for each of the program, and arcs about outer corners.

    ``after`` are the moves that the arcs follow; ``problem`` is the first move that has no such path, and why.
    """

    moves: Moves
    corners: Moves
    after: IntArray
    problem: tuple[int, str] | None = None


@dataclass
class _Side:
    """A line or an arc of a contour, in the plane as complex numbers, and the same moved aside by ``aside``."""

    row: int
    start: complex
    end: complex
    centre: complex
    sweep: float
    aside: float
    #: Where it begins and ends once the corners are known, and by how much of its length or angle they shorten it.
    first: complex = 0j
    last: complex = 0j
    trimmed: float = 0.0

    def __post_init__(self) -> None:
        self.first = self.start + 1j * self.aside * self.way(self.start)
        self.last = self.end + 1j * self.aside * self.way(self.end)

    def way(self, point: complex) -> complex:
        """Direction of travel at a point."""
        along = self.end - self.start if not self.sweep else 1j * math.copysign(1.0, self.sweep) * (point - self.centre)
        return along / abs(along)

    def radius(self) -> float:
        """Radius of the arc that the tool centre follows; below 0 where it turns inside out."""
        programmed = min(abs(self.start - self.centre), abs(self.end - self.centre))
        return programmed - math.copysign(1.0, self.sweep) * self.aside

    def trim(self, point: complex, *, at_end: bool) -> None:
        """End or begin at a point of the path of the tool centre."""
        was = self.last if at_end else self.first
        way = was - point if at_end else point - was
        if self.sweep:
            turned = cmath.phase((was - self.centre) / (point - self.centre)) * (1.0 if at_end else -1.0)
            self.trimmed += turned * math.copysign(1.0, self.sweep)
        else:
            self.trimmed += (way * self.way(self.start).conjugate()).real
        if at_end:
            self.last = point
        else:
            self.first = point

    def left(self) -> float:
        """What the corners leave of its length (mm) or angle (rad)."""
        return (abs(self.sweep) if self.sweep else abs(self.end - self.start)) - self.trimmed


def _meeting(one: _Side, other: _Side) -> complex | None:
    """The point nearest to the corner where the paths of the tool centre beside two moves meet."""
    near = 0.5 * (one.last + other.first)
    if not one.sweep and not other.sweep:
        a, b = one.way(one.end), other.way(other.start)
        across = (a.conjugate() * b).imag
        return one.last + a * (((other.first - one.last).conjugate() * b).imag / across)
    if one.sweep and other.sweep:
        found = _circles(one.centre, abs(one.last - one.centre), other.centre, abs(other.first - other.centre))
    else:
        line, arc = (other, one) if one.sweep else (one, other)
        point = one.last if line is one else other.first
        radius = abs((other.first if line is one else one.last) - arc.centre)
        found = _line_and_circle(point, line.way(line.start), arc.centre, radius)
    return min(found, key=lambda point: abs(point - near)) if found else None


def _line_and_circle(point: complex, way: complex, centre: complex, radius: float) -> list[complex]:
    towards = (centre - point) * way.conjugate()
    if abs(towards.imag) > radius + _TOUCH_MM:
        return []
    half = math.sqrt(max(radius * radius - towards.imag * towards.imag, 0.0))
    return [point + way * (towards.real + half), point + way * (towards.real - half)]


def _circles(one: complex, radius: float, other: complex, radius_there: float) -> list[complex]:
    apart = abs(other - one)
    if apart < 1e-9 or apart > radius + radius_there + _TOUCH_MM or apart < abs(radius - radius_there) - _TOUCH_MM:
        return []
    along = (apart * apart + radius * radius - radius_there * radius_there) / (2.0 * apart)
    half, way = math.sqrt(max(radius * radius - along * along, 0.0)), (other - one) / apart
    return [one + way * complex(along, half), one + way * complex(along, -half)]


class _Problem(Exception):  # noqa: N818 -- is caught where it is raised
    """A move that has no path of the tool centre, and why."""


def _joined(one: _Side, other: _Side) -> tuple[complex, complex, complex, float] | None:
    """Join two sides at their corner; returns the arc about an outer one: from, to, about, by which angle."""
    turn = cmath.phase(other.way(other.start) / one.way(one.end))
    if not other.aside or abs(turn) < _ONE_WAY_RAD:
        return None
    if abs(turn) > _BACK_RAD:
        raise _Problem(other.row, "the contour goes back on itself, so that the side of the tool is not clear")
    if turn * other.aside < 0.0:
        return one.last, other.first, other.start, turn
    point = _meeting(one, other)
    if point is None:
        raise _Problem(other.row, "the tool is too large for the corner before: the paths of its centre do not meet")
    one.trim(point, at_end=True)
    other.trim(point, at_end=False)
    return None


def _sides(moves: Moves) -> dict[int, _Side]:
    """The moves of contours by their number."""
    found = {}
    rows = np.flatnonzero(moves.phase == CONTOUR).tolist()
    part = moves.part(np.array(rows, dtype=np.int64))
    points = part.start_mm, part.end_mm, np.nan_to_num(part.centre_mm)
    start, end, centre = ((item[:, 0] + 1j * item[:, 1]).tolist() for item in points)
    aside = np.where(np.isfinite(part.aside_mm), part.aside_mm, 0.0).tolist()
    for k, row in enumerate(rows):
        found[row] = _Side(row, start[k], end[k], centre[k], float(part.sweep_rad[k]), aside[k])
    return found


def centre_path(moves: Moves, owner: IntArray | None = None) -> CentrePath:
    """Return the path of the tool centre of moves, which are those of whole contours.

    ``owner`` (n,) is for each move the number of the one that it is a piece of: between pieces of one, the contour hardly bends.
    """
    if not moves.phase.any():
        return CentrePath(moves, moves.part(slice(0, 0)), np.zeros(0, dtype=np.int64))
    sides, problem = _sides(moves), None
    arcs: list[tuple[int, tuple[complex, complex, complex, float]]] = []
    before: _Side | None = None
    for row, phase in enumerate(moves.phase.tolist()):
        if phase in (PLAIN, ENTRY, EXIT):
            before = None
        side = sides.get(row)
        if side is None:
            continue
        try:
            if side.sweep and side.aside and side.radius() < _LEAST_RADIUS_MM:
                raise _Problem(
                    row, f"the tool of radius {abs(side.aside):g} mm is too large for the inner side of the arc"
                )
            arc = _joined(before, side) if before else None
            if arc and abs(arc[3] * side.aside) > _SHORTEST_CORNER_MM:
                arcs.append((before.row if before else 0, arc))
            if before and owner is not None and owner[before.row] == owner[row]:
                _hold_bend(before, side)
            for one in filter(None, (before, side)):
                if one.left() <= 0.0:
                    raise _Problem(
                        one.row, f"nothing is left of the move beside a tool of radius {abs(one.aside):g} mm"
                    )
        except _Problem as found:
            problem = problem or (int(found.args[0]), str(found.args[1]))
        before = side
    return CentrePath(_centred(moves, sides), *_corners(moves, arcs), problem)


def _hold_bend(one: _Side, other: _Side) -> None:
    turn = abs(cmath.phase(other.way(other.start) / one.way(one.end)))
    if turn > _LARGEST_BEND_RAD:
        raise _Problem(
            other.row,
            f"the pieces of the move would bend the contour by {math.degrees(turn):.1f} deg, where controls may insert arcs; use "
            "a larger --shortest-mm or --tolerance-um, or smooth errors (volcomp fit)",
        )


def _centred(moves: Moves, sides: dict[int, _Side]) -> Moves:
    """Moves of the tool centre: those beside a contour, and the moves to it, along Z beside it and from it."""
    start, end, sweep = np.array(moves.start_mm), np.array(moves.end_mm), np.array(moves.sweep_rad)
    phase, rows = moves.phase.tolist(), list(sides)
    then = np.searchsorted(rows, np.arange(len(phase)), side="right")
    here: complex | None = None
    for row, what in enumerate(phase):
        if what == PLAIN:
            here = None
            continue
        if here is not None:
            start[row, :2] = here.real, here.imag
        if row in sides:
            side = sides[row]
            here, first = side.last, side.first
            start[row, :2] = first.real, first.imag
            if side.sweep:
                sweep[row] = math.copysign(max(side.left(), 1e-9), side.sweep)
        elif what == ENTRY:
            first_row = rows[then[row]] if then[row] < len(rows) else len(phase)
            # nothing but moves along Z stands before the first move of the contour
            alone = first_row == len(phase) or any(other != STILL for other in phase[row + 1 : first_row])
            here = None if alone else sides[first_row].first
        elif what == EXIT:
            here = None
        if here is not None:
            end[row, :2] = here.real, here.imag
    whole = (moves.at_mm == moves.end_mm).all(axis=1)[:, None]
    none = np.zeros(len(moves), dtype=np.int64)
    at = np.where(whole, end, moves.at_mm)
    return replace(
        moves, start_mm=start, end_mm=end, sweep_rad=sweep, at_mm=at, phase=none, aside_mm=np.zeros(len(moves))
    )


def _corners(moves: Moves, arcs: list[tuple[int, tuple[complex, complex, complex, float]]]) -> tuple[Moves, IntArray]:
    """Arcs about outer corners as moves, and the moves that they follow."""
    rows = np.array([row for row, _ in arcs], dtype=np.int64)
    part, count = moves.part(rows), len(rows)
    places = [np.array(part.end_mm), np.array(part.end_mm), np.full((count, 3), np.nan)]
    for k, (_, arc) in enumerate(arcs):
        for place, point in zip(places, arc[:3], strict=True):
            place[k, :2] = point.real, point.imag
    (start, end, centre), sweep = places, np.array([arc[3] for _, arc in arcs])
    kind = np.where(part.kind == RAPID, RAPID, np.where(sweep > 0, CCW, CW))
    plane, none = np.full(count, 2), np.zeros(count, dtype=np.int64)
    zero, tool = part.offset_mm, part.tool_mm
    found = Moves(
        part.line, kind, start, end, centre, plane, sweep, zero, tool, end, part.corrected, none, np.zeros(count)
    )
    return found, rows


def peaks(corners: Moves) -> FloatArray:
    """Return how far a control goes at outer corners that it does not round, (n, 2, 3), mm: straight on along both sides.

    ``corners`` are the arcs about the corners. Up to a right angle both points are where the paths meet; beyond, they are the
    radius away from the arc, as FANUC goes.
    """
    ends = np.stack([corners.start_mm, corners.end_mm], axis=1)
    arm = ends - corners.centre_mm[:, None]
    way = (
        np.stack([-arm[..., 1], arm[..., 0], np.zeros(arm.shape[:2])], axis=-1)
        * np.sign(corners.sweep_rad)[:, None, None]
    )
    far = np.tan(np.minimum(0.5 * np.abs(corners.sweep_rad), 0.25 * np.pi))
    return np.asarray(ends + way * (far[:, None] * np.array([1.0, -1.0]))[..., None])


def unknown_radius(model: ExactModel, moves: Moves, tolerance_mm: float) -> InputError | None:
    """Return why a contour needs the radius of its tool: the correction differs within what it may be; None if it does not."""
    rows = np.flatnonzero((moves.phase == CONTOUR) & np.isinf(moves.aside_mm))
    if not len(rows):
        return None
    own = np.repeat(rows, 5)
    share = np.tile(np.linspace(0.0, 1.0, 5), len(rows))
    points = points_of(moves, share, own)
    far = replace(moves, aside_mm=np.where(np.isinf(moves.aside_mm), np.sign(moves.aside_mm), 0.0) * LARGEST_RADIUS_MM)
    tools, still = moves.tool_mm[own], np.zeros(points.shape)
    there = tool_centres(far, points, own)
    change = (model.command(there, tools, still) - there) - (model.command(points, tools, still) - points)
    size = np.linalg.norm(np.where(moves.corrected[own], change, 0.0), axis=1)
    worst = int(np.argmax(size))
    if size[worst] <= tolerance_mm:
        return None
    return InputError(
        f"the radius of the tool is not known, and the correction changes by up to {size[worst] / MM_PER_UM:.1f} um within "
        f"{LARGEST_RADIUS_MM:g} mm beside the contour; give it: --tool-radius 5, or radius_mm in the file of --tools (0 if the "
        "contour is the path of the tool centre and the control has the wear alone)",
        line=int(moves.line[own[worst]]),
    )
