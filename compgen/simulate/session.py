"""A measurement session of runs: every line at several loads and feeds, repeated, in random order, with temperatures.

A session labels its readings (line, repeat, run, block, setup) and logs feed, load and temperatures, as a diagnosis
needs them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine, Vector3
from compgen.simulate.trajectory import (
    POSITION_DECIMALS,
    SECONDS_PER_MIN,
    Stops,
    Trajectory,
    approach_of,
    check_stops,
    label_points,
    passes_of,
)

SECONDS_PER_HOUR = 3600.0
#: Lead-in before the first stop of a run, as a share of the way to the second.
LEAD_IN = 0.05


@dataclass(frozen=True)
class Session:
    """How often and under which conditions the lines are run.

    Parameters
    ----------
    repeats : runs of every line under equal conditions.
    loads_kg, feeds_mm_min : conditions, each of which every line is run at; empty: no load logged, the trajectory's feed.
    shuffled : random order of the runs within each set-up.
    jitter : largest shift of each point along its line, as a share of the line's length; the same in repeats.
    """

    repeats: int = 1
    loads_kg: tuple[float, ...] = ()
    feeds_mm_min: tuple[float, ...] = ()
    shuffled: bool = False
    jitter: float = 0.0


@dataclass(frozen=True)
class Temperature:
    """One channel over time: base + ramp t + cycle sin(2 pi t / period) + warm-up (1 - exp(-t / time constant))."""

    base_c: float = 20.0
    ramp_k_per_h: float = 0.0
    cycle_k: float = 0.0
    cycle_s: float = SECONDS_PER_HOUR
    warmup_k: float = 0.0
    warmup_s: float = SECONDS_PER_HOUR

    def at(self, time_s: FloatArray) -> FloatArray:
        """Temperature in degC at times (n,)."""
        cycle = self.cycle_k * np.sin(2.0 * np.pi * time_s / self.cycle_s)
        warmup = self.warmup_k * -np.expm1(-time_s / self.warmup_s)
        return np.asarray(self.base_c + self.ramp_k_per_h * time_s / SECONDS_PER_HOUR + cycle + warmup)


def read_session(section: tomlio.Section) -> Session:
    """Read the ``[session]`` section of a scenario strictly."""
    session = Session(
        repeats=section.take("repeats", tomlio.whole(1, 1000), 1),
        loads_kg=section.take("loads_kg", _conditions, ()),
        feeds_mm_min=section.take("feeds_mm_min", _feeds, ()),
        shuffled=section.take("order", tomlio.choice("as-listed", "random"), "as-listed") == "random",
        jitter=section.take("jitter", _share, 0.0),
    )
    section.finish()
    return session


def read_temperatures(section: tomlio.Section) -> dict[str, Temperature]:
    """Read the ``[temperatures.NAME]`` sections of a scenario strictly; the column is ``temp_NAME_c``."""
    found = {}
    for name in section.data:
        inner = section.section(name)
        found[name] = Temperature(
            base_c=inner.take("base_c", tomlio.number, 20.0),
            ramp_k_per_h=inner.take("ramp_k_per_h", tomlio.number, 0.0),
            cycle_k=inner.take("cycle_k", tomlio.number, 0.0),
            cycle_s=inner.take("cycle_s", tomlio.positive, SECONDS_PER_HOUR),
            warmup_k=inner.take("warmup_k", tomlio.number, 0.0),
            warmup_s=inner.take("warmup_s", tomlio.positive, SECONDS_PER_HOUR),
        )
        inner.finish()
    return found


def _conditions(value: Any) -> tuple[float, ...]:
    items = tuple(tomlio.not_negative(item) for item in tomlio.numbers(value))
    if not items or len(set(items)) != len(items):
        raise ValueError("a list of different numbers that are not negative is expected")
    return items


def _feeds(value: Any) -> tuple[float, ...]:
    return tuple(tomlio.positive(item) for item in _conditions(value))


def _share(value: Any) -> float:
    result = tomlio.not_negative(value)
    if result > 0.5:
        raise ValueError("a share of the line's length from 0 to 0.5 is expected")
    return result


def plan_session(
    session: Session, trajectory: Trajectory, machine: Machine, passes: int, rng: np.random.Generator
) -> Stops:
    """Return the stops of all runs in order of time: for each pass of the instrument and each set-up its runs.

    Raises
    ------
    InputError
        if a point lies outside the machine's travel.
    """
    lines = [_jittered(line, session.jitter, machine, rng) for line in _lines(trajectory, machine)]
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
    """Lines one after another, each also backwards where the trajectory goes there and back; other kinds are one line."""
    if trajectory.kind != "lines":
        return passes_of(trajectory, machine)
    there = [np.linspace(line.from_mm, line.to_mm, line.points) for line in trajectory.lines]
    return [way for line in there for way in ([line, line[::-1]] if trajectory.there_and_back else [line])]


def _jittered(line: FloatArray, jitter: float, machine: Machine, rng: np.random.Generator) -> FloatArray:
    if jitter > 0.0:
        shift = rng.uniform(-jitter, jitter, len(line))
        line = np.clip(line + shift[:, None] * (line[-1] - line[0]), machine.lower_mm, machine.upper_mm)
    return np.asarray(np.round(line, POSITION_DECIMALS) + 0.0)


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

    Every run is begun from a lead-in before its first stop, so that this is approached like the others.
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
