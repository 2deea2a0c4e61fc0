"""The points that the machine visits, with order and time: passes over a grid, or sessions of many runs.

A :class:`Trajectory` gives the points, a :class:`Session` repeats its lines under several loads and feeds; both yield
:class:`Stops` in order of time, with the temperatures there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine, Vector3
from compgen.data.names import AXES, SECONDS_PER_HOUR, SECONDS_PER_MIN
from compgen.data.records import approach_of
from compgen.data.toml_files import part_setting, setting
from compgen.errors import InputError, Message
from compgen.simulation.truth import counts

# The trajectory of a simulated measurement: the points that the machine visits, with order and time.


#: Decimals of commanded positions in mm: 0.1 um, no finer than in a lengths file, so that writing loses nothing.
POSITION_DECIMALS = 4

Levels = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Line:
    """A straight line of ``points`` equally spaced points, ends included, in mm."""

    from_mm: Vector3 = setting(toml_files.vector3)
    to_mm: Vector3 = setting(toml_files.vector3)
    points: int = setting(toml_files.whole(2))


@toml_files.accepts(toml_files.accepted(toml_files.vectors3))
def _tools(value: Any) -> tuple[Vector3, ...]:
    tools = toml_files.vectors3(value)
    if len(set(tools)) != len(tools):
        raise ValueError("each tool offset may be given only once")
    return tools


@dataclass(frozen=True)
class Trajectory:
    """What is visited.

    Parameters
    ----------
    kind : ``grid``, ``frame`` (the 12 edges of the grid's box), ``faces`` (its 6 faces) or ``lines``.
    counts : number of equally spaced levels of X, Y, Z over the travel, or None.
    levels_mm : explicit levels of X, Y, Z in mm; None for an axis means ``counts``, otherwise the machine's nodes.
    lines : the lines of kind ``lines``.
    there_and_back : whether each pass is repeated in reverse order.
    tools_mm : tool offsets, each with a separate pass; empty: the tool of the machine file.
    feed_mm_min, dwell_s : path speed between points and dwell at each.
    start_mm : where the machine starts; default: the machine's reference point.
    """

    kind: str = part_setting(lambda: {"enum": [*BLOCKS, "lines"], "default": "grid"}, "grid", key="type")
    counts: tuple[int, int, int] | None = setting(counts, None, key="levels")
    levels_mm: tuple[FloatArray | None, FloatArray | None, FloatArray | None] = part_setting(
        {f"{axis.lower()}_mm": toml_files.array_schema(toml_files.accepted(toml_files.number), 1) for axis in AXES},
        (None, None, None),
    )
    lines: tuple[Line, ...] = part_setting(lambda: toml_files.array_schema(toml_files.section_schema(Line), 1), ())
    there_and_back: bool = setting(toml_files.word_for({"there-and-back": True, "once": False}), True, key="runs")
    tools_mm: tuple[Vector3, ...] = setting(_tools, ())
    feed_mm_min: float = setting(toml_files.positive, 1000.0)
    dwell_s: float = setting(toml_files.positive, 3.0)
    start_mm: Vector3 | None = setting(toml_files.vector3, None)


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
    tool_mm : tool offset at each stop, shape (n, 3), or None for that of the machine file.
    covariates : other numbers by column name (feed_mm_min, load_kg, temp_<name>_c), each (n,).
    labels : other whole numbers by column name (line, repeat, block, setup), each (n,).
    way_mm : motion from the previous stop, shape (n, 3); for the first from the start.
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


def _levels(value: Any) -> FloatArray:
    items = toml_files.numbers(value)
    return np.array(items if len(items) == 1 else toml_files.ascending(value))


# --- reading -----------------------------------------------------------------------------------------------------


def read_trajectory(section: toml_files.Section) -> Trajectory:
    """Read the ``[trajectory]`` section of a scenario strictly."""
    kind = section.take("type", toml_files.choice(*(*BLOCKS, "lines")), "grid")
    lines = (
        tuple(toml_files.read_settings(Line, entry) for entry in section.sections("lines")) if kind == "lines" else ()
    )
    if kind == "lines" and not lines:
        raise section.fail("lines", "is missing; type = 'lines' needs [[trajectory.lines]] with from_mm, to_mm, points")
    explicit = [] if kind == "lines" else [section.take(f"{axis.lower()}_mm", _levels, None) for axis in AXES]
    return toml_files.read_settings(
        Trajectory,
        section,
        kind=kind,
        counts=None if kind == "lines" else section.take("levels", counts, None),
        levels_mm=tuple(explicit) or (None, None, None),
        lines=lines,
    )


# --- points ------------------------------------------------------------------------------------------------------


def serpentine(levels: Sequence[FloatArray]) -> FloatArray:
    """All points of a grid, X fastest, every line opposite to the one before: shape (n, 3); all moves are to neighbours."""
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


#: Trajectory types made from the levels of the three axes: blocks of points visited one after another.
BLOCKS: dict[str, Callable[[Levels], list[FloatArray]]] = {"grid": _grid, "frame": _frame, "faces": _faces}


def trajectory_points(trajectory: Trajectory, machine: Machine) -> FloatArray:
    """Points of one pass in order, shape (n, 3), mm, to 0.1 um; no point occurs twice in succession."""
    if trajectory.kind == "lines":
        blocks = [np.linspace(line.from_mm, line.to_mm, line.points) for line in trajectory.lines]
    else:
        chosen = []
        for axis, (explicit, entry) in enumerate(zip(trajectory.levels_mm, machine.axes, strict=True)):
            if explicit is None and trajectory.counts is not None:
                explicit = np.linspace(*entry.range_mm, trajectory.counts[axis])
            chosen.append(entry.nodes_mm if explicit is None else explicit)
        blocks = BLOCKS[trajectory.kind]((chosen[0], chosen[1], chosen[2]))
    points = np.round(np.concatenate(blocks), POSITION_DECIMALS) + 0.0
    moved = np.any(np.diff(points, axis=0) != 0, axis=1)
    kept: FloatArray = points[np.concatenate([[True], moved])]
    return kept


# --- stops -------------------------------------------------------------------------------------------------------


def plan_stops(trajectory: Trajectory, machine: Machine, repeats: int = 1) -> Stops:
    """Return all stops in order of time: for each repeat, each tool, the points there and, if requested, back.

    Raises
    ------
    InputError
        if a point is outside the machine's travel.
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
    """Points of one pass there and, if requested, back, each (n, 3), mm."""
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
            Message(
                "level-outside-travel",
                "{value} = {points:g} mm is outside the travel {low:g} ... {high:g} mm of {name}; "
                "choose levels within it",
                value=AXES[axis],
                points=points[row, axis],
                low=low,
                high=high,
                name=machine.name,
            ),
            field="[trajectory]",
        )


def label_points(position_mm: FloatArray) -> tuple[str, ...]:
    """Number the points in order of first occurrence; equal positions have equal labels."""
    numbers: dict[tuple[float, ...], int] = {}
    order = [numbers.setdefault(tuple(row), len(numbers) + 1) for row in position_mm.tolist()]
    width = max(4, len(str(len(numbers))))
    return tuple(f"P{number:0{width}d}" for number in order)


def _times(moves: FloatArray, trajectory: Trajectory) -> FloatArray:
    travel_s = np.linalg.norm(moves, axis=1) / trajectory.feed_mm_min * SECONDS_PER_MIN
    travel_s[0] = 0.0  # the clock starts at the first stop
    return np.cumsum(travel_s + trajectory.dwell_s)


# A measurement session of runs: every line at several loads and feeds, repeated, in random order, with temperatures.
#
# A session labels its readings (line, repeat, run, block, setup) and logs feed, load and temperatures for a diagnosis.


#: Lead-in before the first stop of a run, as a share of the distance to the second.
LEAD_IN = 0.05


def different_numbers(check: Callable[[Any], float]) -> Callable[[Any], tuple[float, ...]]:
    """A list of different numbers, each of which passes ``check``."""

    @toml_files.accepts({**toml_files.array_schema(toml_files.accepted(check), 1), "uniqueItems": True})
    def conditions(value: Any) -> tuple[float, ...]:
        items = tuple(toml_files.not_negative(item) for item in toml_files.numbers(value))
        if not items or len(set(items)) != len(items):
            raise ValueError("expected a list of different numbers that are not negative")
        return tuple(check(item) for item in items)

    return conditions


@dataclass(frozen=True)
class Session:
    """Number and conditions of the runs of each line.

    Parameters
    ----------
    repeats : runs of every line under equal conditions.
    loads_kg, feeds_mm_min : conditions under each of which every line is run; empty: no load logged, feed of the
        trajectory.
    shuffled : random order of the runs within each set-up.
    jitter : largest shift of each point along its line, as a share of the line's length; the same in repeats.
    """

    repeats: int = setting(toml_files.whole(1, 1000), 1)
    loads_kg: tuple[float, ...] = setting(different_numbers(toml_files.not_negative), ())
    feeds_mm_min: tuple[float, ...] = setting(different_numbers(toml_files.positive), ())
    shuffled: bool = setting(toml_files.word_for({"as-listed": False, "random": True}), False, key="order")
    jitter: float = setting(toml_files.share(0.5, "the line's length"), 0.0)


@dataclass(frozen=True)
class Temperature:
    """One channel over time: base + ramp t + cycle sin(2 pi t / period) + warm-up (1 - exp(-t / time constant))."""

    base_c: float = setting(toml_files.number, 20.0)
    ramp_k_per_h: float = setting(toml_files.number, 0.0)
    cycle_k: float = setting(toml_files.number, 0.0)
    cycle_s: float = setting(toml_files.positive, SECONDS_PER_HOUR)
    warmup_k: float = setting(toml_files.number, 0.0)
    warmup_s: float = setting(toml_files.positive, SECONDS_PER_HOUR)

    def at(self, time_s: FloatArray) -> FloatArray:
        """Temperature in degC at times (n,)."""
        cycle = self.cycle_k * np.sin(2.0 * np.pi * time_s / self.cycle_s)
        warmup = self.warmup_k * -np.expm1(-time_s / self.warmup_s)
        return np.asarray(self.base_c + self.ramp_k_per_h * time_s / SECONDS_PER_HOUR + cycle + warmup)


def read_session(section: toml_files.Section) -> Session:
    """Read the ``[session]`` section of a scenario strictly."""
    return toml_files.read_settings(Session, section)


def read_temperatures(section: toml_files.Section) -> dict[str, Temperature]:
    """Read the ``[temperatures.NAME]`` sections of a scenario strictly; the column is ``temp_NAME_c``."""
    return {name: toml_files.read_settings(Temperature, section.section(name)) for name in section.data}


def plan_session(
    session: Session, trajectory: Trajectory, machine: Machine, passes: int, rng: np.random.Generator
) -> Stops:
    """Return the stops of all runs in order of time: for each pass of the instrument and each set-up its runs.

    Raises
    ------
    InputError
        if a point is outside the machine's travel.
    """
    lines = []
    for line in _lines(trajectory, machine):
        if session.jitter > 0.0:
            shift = rng.uniform(-session.jitter, session.jitter, len(line))
            line = np.clip(line + shift[:, None] * (line[-1] - line[0]), machine.lower_mm, machine.upper_mm)
        lines.append(np.round(line, POSITION_DECIMALS) + 0.0)
    check_stops(np.concatenate(lines), machine)
    tools = np.round(np.array(trajectory.tools_mm or [machine.tool_offset_mm]), POSITION_DECIMALS)
    conditions = list(
        product(range(len(lines)), session.loads_kg or (0.0,), session.feeds_mm_min or (trajectory.feed_mm_min,))
    )
    rows: list[tuple[float, ...]] = []
    points: list[FloatArray] = []
    for block, (_, setup) in enumerate(product(range(passes), range(len(tools))), start=1):
        runs = [(*condition, repeat) for repeat in range(1, session.repeats + 1) for condition in conditions]
        order = rng.permutation(len(runs)) if session.shuffled else np.arange(len(runs))
        for line, load, feed, repeat in (runs[k] for k in order):
            points.append(lines[line])
            rows.append((len(lines[line]), block, setup + 1, len(rows) + 1, line + 1, repeat, load, feed))
    return _stops(session, trajectory, machine, np.concatenate(points), np.array(rows), tools)


def _lines(trajectory: Trajectory, machine: Machine) -> list[FloatArray]:
    """Return the lines in sequence, each also backwards if the trajectory returns; other kinds are one line."""
    if trajectory.kind != "lines":
        return passes_of(trajectory, machine)
    there = [np.linspace(line.from_mm, line.to_mm, line.points) for line in trajectory.lines]
    return [way for line in there for way in ([line, line[::-1]] if trajectory.there_and_back else [line])]


def _stops(
    session: Session,
    trajectory: Trajectory,
    machine: Machine,
    position_mm: FloatArray,
    runs: FloatArray,
    tools: FloatArray,
) -> Stops:
    counts = runs[:, 0].astype(int)
    each = np.repeat(runs, counts, axis=0)
    feed = each[:, 7]
    way_mm, approach, distance_mm = _ways(position_mm, counts, trajectory.start_mm or machine.reference_point_mm)
    travel_s = distance_mm / feed * SECONDS_PER_MIN
    travel_s[0] = 0.0
    names = ("block", "setup", "run", "line", "repeat")
    labels = {name: each[:, k].astype(np.int64) for k, name in enumerate(names, start=1)}
    return Stops(
        position_mm=position_mm,
        point=label_points(position_mm),
        run=labels.pop("run"),
        time_s=np.cumsum(travel_s + trajectory.dwell_s),
        approach=approach,
        tool_mm=tools[labels["setup"] - 1] if trajectory.tools_mm else None,
        covariates={"feed_mm_min": feed, **({"load_kg": each[:, 6]} if session.loads_kg else {})},
        labels=labels if len(tools) > 1 else {name: labels[name] for name in ("block", "line", "repeat")},
        way_mm=way_mm,
    )


def _ways(
    position_mm: FloatArray, counts: NDArray[np.int64], start_mm: Vector3
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Last motion to each stop (n, 3), last directions (n, 3) and distance travelled since the stop before (n,).

    Every run starts from a lead-in before its first stop, so that this is approached like the others.
    """
    first = np.cumsum(counts) - counts
    follow = np.minimum(first + 1, first + counts - 1)
    lead_in = position_mm[first] - LEAD_IN * (position_mm[follow] - position_mm[first])
    path = np.insert(position_mm, first, lead_in, axis=0)
    moves = np.diff(path, axis=0, prepend=[start_mm])
    stops = np.delete(np.arange(len(path)), first + np.arange(len(first)))
    length = np.cumsum(np.linalg.norm(moves, axis=1))[stops]
    return moves[stops], approach_of(moves)[stops], np.diff(length, prepend=0.0)


def with_temperatures(stops: Stops, temperatures: Mapping[str, Temperature]) -> Stops:
    """Return the stops with the temperature of every channel at their times."""
    logged = {f"temp_{name}_c": channel.at(stops.time_s) for name, channel in temperatures.items()}
    return replace(stops, covariates={**stops.covariates, **logged})
