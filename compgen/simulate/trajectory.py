"""The trajectory of a simulated measurement: which points the machine visits, in which order and when."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine, Vector3
from compgen.core.names import AXES
from compgen.errors import InputError
from compgen.simulate.truth import counts

#: Decimals of commanded positions in mm: 0.1 um, no finer than a lengths file keeps, so that writing loses nothing.
POSITION_DECIMALS = 4
SECONDS_PER_MIN = 60.0

Levels = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Line:
    """A straight line of ``points`` equally spaced points, ends included, in mm."""

    from_mm: Vector3
    to_mm: Vector3
    points: int


@dataclass(frozen=True)
class Trajectory:
    """What is visited.

    Parameters
    ----------
    kind : ``grid``, ``frame`` (the 12 edges of the grid's box), ``faces`` (its 6 faces) or ``lines``.
    counts : number of equally spaced levels of X, Y, Z over the travel, or None.
    levels_mm : explicit levels of X, Y, Z in mm; None for an axis takes ``counts``, else the machine's nodes.
    lines : the lines of kind ``lines``.
    there_and_back : whether each pass is repeated in reverse order.
    tools_mm : tool offsets, each of which makes a pass of its own; empty: the machine's own tool.
    feed_mm_min, dwell_s : path speed between points and time of standing at each.
    start_mm : where the machine comes from; default the machine's reference point.
    """

    kind: str = "grid"
    counts: tuple[int, int, int] | None = None
    levels_mm: tuple[FloatArray | None, FloatArray | None, FloatArray | None] = (None, None, None)
    lines: tuple[Line, ...] = ()
    there_and_back: bool = True
    tools_mm: tuple[Vector3, ...] = ()
    feed_mm_min: float = 1000.0
    dwell_s: float = 3.0
    start_mm: Vector3 | None = None


@dataclass(frozen=True)
class Stops:
    """The stops of the machine in order of time, n of them.

    Parameters
    ----------
    position_mm : commanded positions, shape (n, 3).
    point : label of the point; equal positions have equal labels.
    run : 1 there, 2 back, shape (n,).
    time_s : time of reading since the first stop began, shape (n,).
    approach : last direction of travel of each axis, +1, -1 or 0 while it has not moved, shape (n, 3).
    tool_mm : tool offset at each stop, shape (n, 3), or None for the machine's own.
    covariates : further numbers by column name (feed_mm_min, load_kg, temp_<name>_c), each (n,).
    labels : further whole numbers by column name (line, repeat, block, setup), each (n,).
    way_mm : motion from the stop before, shape (n, 3); of the first from where the machine came.
    """

    position_mm: FloatArray
    point: tuple[str, ...]
    run: NDArray[np.int64]
    time_s: FloatArray
    approach: FloatArray
    tool_mm: FloatArray | None = None
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    way_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        """Return the number of stops."""
        return len(self.position_mm)


# --- reading -----------------------------------------------------------------------------------------------------


def read_trajectory(section: tomlio.Section) -> Trajectory:
    """Read the ``[trajectory]`` section of a scenario strictly."""
    kind = section.take("type", tomlio.choice(*(*BLOCKS, "lines")), "grid")
    lines = tuple(_read_line(entry) for entry in section.sections("lines")) if kind == "lines" else ()
    if kind == "lines" and not lines:
        raise section.fail("lines", "is missing; type = 'lines' needs [[trajectory.lines]] with from_mm, to_mm, points")
    explicit = [] if kind == "lines" else [section.take(f"{axis.lower()}_mm", _levels, None) for axis in AXES]
    trajectory = Trajectory(
        kind=kind,
        counts=None if kind == "lines" else section.take("levels", counts, None),
        levels_mm=(explicit[0], explicit[1], explicit[2]) if explicit else (None, None, None),
        lines=lines,
        there_and_back=section.take("runs", tomlio.choice("there-and-back", "once"), "there-and-back") != "once",
        tools_mm=section.take("tools_mm", _tools, ()),
        feed_mm_min=section.take("feed_mm_min", tomlio.positive, 1000.0),
        dwell_s=section.take("dwell_s", tomlio.positive, 3.0),
        start_mm=section.take("start_mm", tomlio.vector3, None),
    )
    section.finish()
    return trajectory


def _read_line(entry: tomlio.Section) -> Line:
    line = Line(
        entry.take("from_mm", tomlio.vector3),
        entry.take("to_mm", tomlio.vector3),
        entry.take("points", tomlio.whole(2)),
    )
    entry.finish()
    return line


def _levels(value: Any) -> FloatArray:
    items = tomlio.numbers(value)
    return np.array(items if len(items) == 1 else tomlio.ascending(value))


def _tools(value: Any) -> tuple[Vector3, ...]:
    if not isinstance(value, list) or not value:
        raise ValueError("a list of tool offsets [[x, y, z], ...] is expected")
    tools = tuple(tomlio.vector3(item) for item in value)
    if len(set(tools)) != len(tools):
        raise ValueError("each tool offset may be given once")
    return tools


# --- points ------------------------------------------------------------------------------------------------------


def serpentine(levels: Sequence[FloatArray]) -> FloatArray:
    """All points of a grid, X fastest, every line against the one before: shape (n, 3); no move but to a neighbour."""
    x, y, z = levels
    rows = []
    for plane, height in enumerate(z):
        for k, across in enumerate(y[:: -1 if plane % 2 else 1]):
            along = x[:: -1 if (plane * len(y) + k) % 2 else 1]
            rows.append(np.column_stack([along, np.full(len(x), across), np.full(len(x), height)]))
    return np.concatenate(rows)


def _grid(levels: Levels) -> list[FloatArray]:
    return [serpentine(levels)]


def _frame(levels: Levels) -> list[FloatArray]:
    edges = []
    for axis in range(3):
        first, second = (other for other in range(3) if other != axis)
        for a, b in ((0, 0), (-1, 0), (-1, -1), (0, -1)):
            edge = list(levels)
            edge[first], edge[second] = levels[first][[a]], levels[second][[b]]
            edges.append(serpentine(edge))
    return edges


def _faces(levels: Levels) -> list[FloatArray]:
    faces = []
    for axis in range(3):
        for end in (0, -1):
            face = list(levels)
            face[axis] = levels[axis][[end]]
            faces.append(serpentine(face))
    return faces


#: Trajectory types made from the levels of the three axes: blocks of points that are visited one after another.
BLOCKS: dict[str, Callable[[Levels], list[FloatArray]]] = {"grid": _grid, "frame": _frame, "faces": _faces}


def trajectory_points(trajectory: Trajectory, machine: Machine) -> FloatArray:
    """Points of one pass in order, shape (n, 3), mm, to 0.1 um; a point is not visited twice in succession."""
    if trajectory.kind == "lines":
        blocks = [np.linspace(line.from_mm, line.to_mm, line.points) for line in trajectory.lines]
    else:
        chosen = tuple(_axis_levels(trajectory, machine, axis) for axis in range(3))
        blocks = BLOCKS[trajectory.kind](cast(Levels, chosen))
    points = np.round(np.concatenate(blocks), POSITION_DECIMALS) + 0.0
    moved = np.any(np.diff(points, axis=0) != 0, axis=1)
    kept: FloatArray = points[np.concatenate([[True], moved])]
    return kept


def _axis_levels(trajectory: Trajectory, machine: Machine, axis: int) -> FloatArray:
    explicit = trajectory.levels_mm[axis]
    if explicit is not None:
        return explicit
    if trajectory.counts is not None:
        return np.linspace(*machine.axes[axis].range_mm, trajectory.counts[axis])
    return machine.axes[axis].nodes_mm


# --- stops -------------------------------------------------------------------------------------------------------


def plan_stops(trajectory: Trajectory, machine: Machine, repeats: int = 1) -> Stops:
    """Return all stops in order of time: for each repeat, each tool, the points there and, if asked for, back.

    Raises
    ------
    InputError
        if a point lies outside the machine's travel.
    """
    passes = passes_of(trajectory, machine)
    there = passes[0]
    check_stops(there, machine)
    tools = np.round(np.array(trajectory.tools_mm or [machine.tool_offset_mm]), POSITION_DECIMALS)
    one_tool = np.concatenate(passes)
    runs = np.repeat(np.arange(1, len(passes) + 1), len(there))
    position_mm = np.tile(one_tool, (repeats * len(tools), 1))
    moves = np.diff(position_mm, axis=0, prepend=[trajectory.start_mm or machine.reference_point_mm])
    return Stops(
        position_mm=position_mm,
        point=label_points(position_mm),
        run=np.tile(runs, repeats * len(tools)),
        time_s=_times(moves, trajectory),
        approach=approach_of(moves),
        tool_mm=np.tile(np.repeat(tools, len(one_tool), axis=0), (repeats, 1)) if trajectory.tools_mm else None,
        way_mm=moves,
    )


def passes_of(trajectory: Trajectory, machine: Machine) -> list[FloatArray]:
    """Points of one pass there and, if asked for, back, each (n, 3), mm."""
    there = trajectory_points(trajectory, machine)
    return [there, there[::-1]] if trajectory.there_and_back else [there]


def check_stops(points: FloatArray, machine: Machine) -> None:
    """Raise InputError for a point outside the travel."""
    slack_mm = 10.0**-POSITION_DECIMALS
    outside = (points < machine.lower_mm - slack_mm) | (points > machine.upper_mm + slack_mm)
    if outside.any():
        row, axis = np.argwhere(outside)[0]
        low, high = machine.axes[axis].range_mm
        raise InputError(
            f"{AXES[axis]} = {points[row, axis]:g} mm lies outside the travel {low:g} ... {high:g} mm of "
            f"{machine.name}; choose levels within it",
            field="[trajectory]",
        )


def label_points(position_mm: FloatArray) -> tuple[str, ...]:
    """Number the points in the order in which they first come; equal positions have equal labels."""
    numbers: dict[tuple[float, ...], int] = {}
    order = [numbers.setdefault(tuple(row), len(numbers) + 1) for row in position_mm.tolist()]
    width = max(4, len(str(len(numbers))))
    return tuple(f"P{number:0{width}d}" for number in order)


def _times(moves: FloatArray, trajectory: Trajectory) -> FloatArray:
    travel_s = np.linalg.norm(moves, axis=1) / trajectory.feed_mm_min * SECONDS_PER_MIN
    travel_s[0] = 0.0  # the clock starts at the first stop
    return np.cumsum(travel_s + trajectory.dwell_s)


def approach_of(moves: FloatArray) -> FloatArray:
    """Last direction of travel of each axis after moves (n, 3): +1, -1, or 0 while it has not moved yet; (n, 3)."""
    moving = moves != 0
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moves))[:, None], 0), axis=0)
    return np.sign(np.take_along_axis(moves, last, axis=0))
