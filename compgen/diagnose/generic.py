"""Smooth terms without a name: what an effect that no catalogue holds would look like.

They stand in one search with the effects of the catalogue. Where one of them wins, the verdict is "unknown", with the
covariates that it depends on and the direction in which it acts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.diagnose.basis import DEGREE, legendre
from compgen.diagnose.groups import Group
from compgen.diagnose.layout import IntArray, Layout
from compgen.effects import Readings

Columns = dict[str, FloatArray]
#: Narrow bumps along each axis.
BUMPS = 12
#: More lines than this get no offsets of their own.
MOST_LINES = 400


def _scaled(values: FloatArray) -> FloatArray:
    """Values shifted and scaled to -1 ... +1."""
    low, high = float(values.min()), float(values.max())
    return np.asarray((2.0 * values - low - high) / (high - low) if high > low else np.zeros_like(values))


def _times(first: FloatArray, second: FloatArray) -> FloatArray:
    """All products of columns (n, a) and (n, b), (n, a b)."""
    return np.asarray((first[:, :, None] * second[:, None, :]).reshape(len(first), -1))


@dataclass(frozen=True)
class Covariates:
    """Covariates of the readings, scaled to -1 ... +1; what was not logged or never changed is None or absent."""

    readings: Readings
    layout: Layout
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
        """1, x, y, z and their products of second order, (n, 10)."""
        x, y, z = self.s.T
        return np.column_stack([np.ones(len(x)), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])


def covariates_of(readings: Readings, layout: Layout) -> Covariates:
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
    s = c.s
    for a, letter in enumerate("xyz"):
        yield f"fine structure in {letter}", (letter,), legendre(s[:, a], DEGREE + 6)[:, DEGREE + 1 :], False, True
        centres = np.linspace(-1, 1, BUMPS)
        yield f"bumps in {letter}", (letter,), np.exp(-(((s[:, [a]] - centres) * BUMPS / 2) ** 2)), False, True
    powers = [legendre(s[:, a], 3)[:, 1:] for a in range(3)]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        yield f"{'xyz'[a]} with {'xyz'[b]}", ("xyz"[a], "xyz"[b]), _times(powers[a], powers[b]), False, True
    triple = _times(_times(powers[0][:, :2], powers[1][:, :2]), powers[2][:, :2])
    yield "x with y with z", ("x", "y", "z"), triple, False, True


def _direction_terms(c: Covariates) -> Iterator[Term]:
    if c.approach is None:
        return
    for a, letter in enumerate("xyz"):
        sign = c.approach[:, [a]]
        if not np.any(sign) or np.all(sign == sign[0]):
            continue
        name = f"approach_{letter}"
        yield f"direction of {letter}", (name,), sign, False, True
        position = np.hstack([legendre(c.s[:, b], 3)[:, 1:] for b in range(3)])
        yield f"direction of {letter} with position", (name, "x", "y", "z"), sign * position, False, True
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


def _load_terms(c: Covariates) -> Iterator[Term]:
    for what, values in (("feed", c.feed), ("load", c.load)):
        if values is None:
            continue
        x, y, z = c.s.T
        shape = np.column_stack([c.quadratic, x * y * z])
        yield f"{what} with position", (what, "x", "y", "z"), values[:, None] * shape, False, True
        yield f"{what} squared", (what,), np.column_stack([values**2, values**3]), False, True
        yield f"{what} with time", (what, "time"), values[:, None] * legendre(c.time, 2)[:, 1:], True, True
    if c.setups.shape[1]:
        columns = _times(c.setups, c.quadratic)
        yield "set-up with position", ("setup", "x", "y", "z"), columns, False, True


def _slow_terms(c: Covariates) -> Iterator[Term]:
    yield "time", ("time",), legendre(c.time, 4)[:, 1:], True, True
    for a, letter in enumerate("xyz"):
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
    _direction_terms,
    _load_terms,
    _slow_terms,
    _line_terms,
)


def _length_terms(c: Covariates, station: int) -> Iterator[Term]:
    """Terms of one station that act along its beam."""
    r = c.readings
    here = (r.station == station).astype(np.float64)[:, None]
    range_mm = _scaled(r.range_mm)
    u = r.direction
    azimuth = np.arctan2(u[:, 1], u[:, 0])
    waves = np.column_stack([f(k * azimuth) for k in range(1, 7) for f in (np.cos, np.sin)])
    yield "range", ("range",), here * legendre(range_mm, 4)[:, 1:], False, True
    yield "beam azimuth", ("azimuth",), here * waves, False, True
    yield "beam elevation", ("elevation",), here * legendre(u[:, 2], 5)[:, 1:], False, True
    if c.temperature:
        warm = np.column_stack(list(c.temperature.values()))
        yield "temperatures", ("temperature",), here * warm, True, True
        yield "range with temperatures", ("range", "temperature"), here * range_mm[:, None] * warm, True, True
    yield "position", ("x", "y", "z"), here * c.quadratic[:, 1:], False, True
    yield "time", ("time",), here * legendre(c.time, 4)[:, 1:], True, True
    moved = legendre(c.time, 2)[:, 1:]
    yield "time with beam", ("time", "beam"), here * _times(moved, np.column_stack([u, range_mm])), True, True
    for _, covariates, columns, slow, predicts in _line_terms(c):
        yield "offset of each line", covariates, here * columns, slow, predicts


def _common_length_terms(c: Covariates) -> Iterator[Term]:
    """Terms that act along the beam of every station alike."""
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


def generic_groups(readings: Readings, layout: Layout) -> list[Group]:
    """Return the generic tier for the readings."""
    c = covariates_of(readings, layout)
    groups = []
    for source in TERMS:
        for text, covariates, columns, slow, predicts in source(c):
            for k, letter in enumerate(AXES):
                along = readings.direction[:, [k]]
                if np.any(along):
                    name = f"{text} in d{letter}"
                    groups.append(_group(name, covariates, f"d{letter}", along * columns, slow, predicts))
    if readings.kind == "lengths":
        for text, covariates, columns, slow, predicts in _common_length_terms(c):
            groups.append(_group(f"{text} (all stations)", covariates, "length", columns, slow, predicts))
        for station, name in enumerate(readings.stations):
            for text, covariates, columns, slow, predicts in _length_terms(c, station):
                label = (*covariates, f"station_{name}")
                groups.append(_group(f"{text} of {name}", label, "length", columns, slow, predicts))
    return groups


def _group(
    name: str, covariates: tuple[str, ...], direction: str, columns: FloatArray, slow: bool, predicts: bool
) -> Group:
    return Group(name, "generic", columns, covariates=covariates, direction=direction, slow=slow, predicts=predicts)


def base_groups(readings: Readings) -> list[Group]:
    """What belongs to the base model but is only fitted where the data ask for it: the tilt of the tools."""
    tools = readings.tool_mm
    spread = tools - tools.mean(axis=0)
    if readings.kind == "axis" or np.abs(spread).max() < 1e-6:
        return []
    columns = np.cross(tools, readings.direction)  # u . (eps x t) = eps . (t x u)
    return [Group("tilt of the tool", "base", columns)]
