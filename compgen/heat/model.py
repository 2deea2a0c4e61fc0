"""The model of heat: displacement = sum of k (L - L at the zero), with L a temperature behind a first-order lag.

A lag begins, when the machine is switched on, at the temperature of its own sensor or at that of the ``start`` sensor: a
structure is then as warm as the bed, whatever the air and the spindle read. The zero is the moment from which displacements
count: the first reading of a session, or the moment at which a work offset was probed.

The model is proven within its hull: ranges of every sensor and of every difference of two sensors. Outside it fades
to zero over a margin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.errors import InputError, nearest
from compgen.heat.sessions import DIRECTIONS, Temperatures

FORMAT = 1
#: Beyond the hull the model fades over this share of the range, and at least over so many kelvin.
MARGIN_SHARE, MARGIN_K = 0.1, 0.5


@dataclass(frozen=True)
class Term:
    """One sensor behind a lag (0: none), which began at the temperature of sensor ``start``; ``per_k`` by direction."""

    sensor: str
    lag_s: float
    start: str
    per_k: Mapping[str, float] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """Name for people."""
        if not self.lag_s:
            return self.sensor
        began = "" if self.start == self.sensor else f" from {self.start}"
        return f"{self.sensor} after {self.lag_s / 60:.3g} min{began}"


@dataclass(frozen=True)
class Range:
    """The range of a sensor, or of ``sensor`` minus ``minus``, that was trained, and the margin beyond it, K."""

    sensor: str
    minus: str
    low: float
    high: float

    @property
    def margin_k(self) -> float:
        """Width over which the model fades."""
        return max(MARGIN_SHARE * (self.high - self.low), MARGIN_K)

    @property
    def text(self) -> str:
        """Name for people."""
        return f"{self.sensor} - {self.minus}" if self.minus else self.sensor

    def outside_k(self, celsius: Mapping[str, FloatArray]) -> FloatArray:
        """Kelvin beyond the range, 0 within, shape (n,)."""
        value = celsius[self.sensor] - (celsius[self.minus] if self.minus else 0.0)
        return np.maximum(0.0, np.maximum(self.low - value, value - self.high))


def hull_of(sensors: Sequence[str], sessions: Sequence[Mapping[str, FloatArray]]) -> tuple[Range, ...]:
    """Return the ranges of sensors and of their differences in sessions of readings."""
    pairs = [(name, "") for name in sensors] + list(combinations(sensors, 2))
    found = []
    for name, minus in pairs:
        values = [item[name] - (item[minus] if minus else 0.0) for item in sessions]
        found.append(Range(name, minus, float(min(v.min() for v in values)), float(max(v.max() for v in values))))
    return tuple(found)


def lagged(time_s: FloatArray, celsius: FloatArray, lag_s: float, start_c: float) -> FloatArray:
    """Return readings (n,) behind a first-order lag that began at ``start_c``; exact for straight lines between readings."""
    if lag_s <= 0:
        return celsius
    steps = np.diff(time_s)
    keeps = np.exp(-steps / lag_s)
    slopes = np.diff(celsius) / steps * lag_s
    given = celsius[1:] - slopes - keeps * (celsius[:-1] - slopes)
    found = np.empty(len(celsius))
    found[0] = state = start_c
    for k, (keep, more) in enumerate(zip(keeps.tolist(), given.tolist(), strict=True), start=1):
        found[k] = state = keep * state + more
    return found


@dataclass(frozen=True)
class HeatPrediction:
    """Displacement by direction (n,) in um or urad with its standard uncertainty, and the weight of the hull (n,)."""

    moved: Mapping[str, FloatArray]
    u: Mapping[str, FloatArray]
    weight: FloatArray
    left: tuple[str, ...]


@dataclass(frozen=True)
class HeatModel:
    """Terms with the covariance of their coefficients by direction, the hull, and what left-out sessions showed.

    ``rms`` is by direction (before, after): um over left-out sessions. ``sessions`` has a line for each left-out session.
    """

    machine: str
    terms: tuple[Term, ...]
    covariance: Mapping[str, FloatArray]
    hull: tuple[Range, ...]
    rms: Mapping[str, tuple[float, float]]
    sessions: tuple[Mapping[str, Any], ...] = ()
    source: Path | None = None

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors that the model reads, in order of the hull."""
        return tuple(item.sensor for item in self.hull if not item.minus)

    @property
    def directions(self) -> tuple[str, ...]:
        """Directions that the model predicts."""
        return tuple(name for name in DIRECTIONS if name in self.rms)

    def coefficients(self, direction: str) -> FloatArray:
        """Coefficients of the terms for a direction, um or urad per K, shape (terms,)."""
        return np.array([term.per_k.get(direction, 0.0) for term in self.terms])

    def states(self, temperatures: Temperatures) -> FloatArray:
        """Return the lagged temperatures, (n, terms)."""
        missing = [name for name in self.sensors if name not in temperatures.celsius]
        if missing:
            hint = nearest(missing[0], temperatures.celsius)
            raise InputError(f"there is no column temp_{missing[0]}_c, which the model of heat needs; {hint}")
        return states_of(self.terms, temperatures)

    def weight(self, temperatures: Temperatures) -> tuple[FloatArray, tuple[str, ...]]:
        """Return the weight of the hull (n,), 1 within, and the ranges that were left."""
        share, left = np.ones(len(temperatures)), []
        for item in self.hull:
            outside = item.outside_k(temperatures.celsius)
            share = np.minimum(share, np.clip(1 - outside / item.margin_k, 0.0, 1.0))
            if outside.max() > 0:
                left.append(item.text)
        return share, tuple(left)

    def predict(self, temperatures: Temperatures, zero_s: float | None = None) -> HeatPrediction:
        """Return the displacement since ``zero_s`` (default: the first reading); it is 0 far outside the hull."""
        states = self.states(temperatures)
        at = 0 if zero_s is None else int(np.argmin(np.abs(temperatures.time_s - zero_s)))
        change = states - states[at]
        share, left = self.weight(temperatures)
        moved = {name: share * (change @ self.coefficients(name)) for name in self.directions}
        u = {name: np.sqrt(self._variance(name, change)) for name in self.directions}
        return HeatPrediction(moved, u, share, left)

    def _variance(self, name: str, change: FloatArray) -> FloatArray:
        """Variance of a prediction: of the coefficients, and of what left-out sessions were off."""
        spread = np.einsum("nk,kl,nl->n", change, self.covariance[name], change)
        total: FloatArray = np.maximum(spread, 0.0) + self.rms[name][1] ** 2
        return total

    def text(self, made_from: Mapping[str, str]) -> str:
        """Return the text of ``*.heat.toml``; ``made_from`` has the SHA-256 of each session file."""
        lines = [
            "# Model of heat: displacement = sum of coefficient x (lagged temperature - the same at the zero).",
            f"format = {FORMAT}",
            f"machine = {_quoted(self.machine)}",
            "",
        ]
        for term in self.terms:
            lines += ["[[terms]]", f"sensor = {_quoted(term.sensor)}", f"lag_s = {_number(term.lag_s)}"]
            lines += [f"start = {_quoted(term.start)}"]
            lines += [f"{name}_{DIRECTIONS[name]}_per_k = {_number(k)}" for name, k in term.per_k.items()]
            lines.append("")
        for item in self.hull:
            minus = [f"minus = {_quoted(item.minus)}"] if item.minus else []
            ends = [f"low_c = {_number(item.low)}", f"high_c = {_number(item.high)}"]
            lines += ["[[hull]]", f"sensor = {_quoted(item.sensor)}", *minus, *ends, ""]
        for name in self.directions:
            before, after = self.rms[name]
            rows = ", ".join("[" + ", ".join(map(_number, row)) + "]" for row in self.covariance[name].tolist())
            lines += [f"[left_out.{name}]", f"before_rms = {_number(before)}", f"after_rms = {_number(after)}"]
            lines += [f"covariance = [{rows}]", ""]
        for row in self.sessions:
            lines += ["[[sessions]]", f"file = {_quoted(str(row['file']))}"]
            digest = made_from.get(str(row["file"]))
            lines += [f"sha256 = {_quoted(digest)}"] if digest else []
            lines += [f"{key} = {_number(value)}" for key, value in row.items() if key != "file"] + [""]
        return "\n".join(lines)


def states_of(terms: Sequence[Term], temperatures: Temperatures) -> FloatArray:
    """Return the lagged temperatures of terms, (n, terms)."""
    celsius = temperatures.celsius
    columns = [
        lagged(temperatures.time_s, celsius[item.sensor], item.lag_s, float(celsius[item.start][0])) for item in terms
    ]
    return np.stack(columns, axis=1) if columns else np.zeros((len(temperatures), 0))


def _quoted(text: str) -> str:
    import json

    return json.dumps(text, ensure_ascii=False)


def _number(value: float) -> str:
    text = f"{value:.9g}"
    return text if any(mark in text for mark in ".en") else f"{text}.0"


def read_heat(path: str | Path) -> HeatModel:
    """Read ``*.heat.toml`` strictly.

    Raises
    ------
    InputError
        with file and key, for anything that is not as :meth:`HeatModel.text` writes it.
    """
    root = toml_files.read_toml(path)
    root.take("format", toml_files.whole(FORMAT, FORMAT))
    machine = root.take("machine", toml_files.text)
    hull = tuple(_range(item) for item in root.sections("hull"))
    sensors = [item.sensor for item in hull if not item.minus]
    terms = tuple(_term(item, sensors) for item in root.sections("terms"))
    if not terms:
        raise root.fail("terms", "there is no term; expected one [[terms]] for each")
    known = [name for name in DIRECTIONS if any(name in term.per_k for term in terms)]
    left_out = root.section("left_out")
    rms, covariance = {}, {}
    for name in known:
        part = left_out.section(name)
        rms[name] = (part.take("before_rms", toml_files.not_negative), part.take("after_rms", toml_files.not_negative))
        covariance[name] = part.take("covariance", _square(len(terms)))
        part.finish()
    left_out.finish()
    sessions = tuple(dict(item.data) for item in root.sections("sessions"))
    for item in root.sections("sessions"):
        for key in item.data:
            item.take(key, toml_files.text if key in ("file", "sha256") else toml_files.number)
        item.finish()
    root.finish()
    return HeatModel(machine, terms, covariance, hull, rms, sessions, Path(path))


def _range(section: toml_files.Section) -> Range:
    sensor, minus = section.take("sensor", toml_files.name), section.take("minus", toml_files.name, "")
    found = Range(sensor, minus, section.take("low_c", toml_files.number), section.take("high_c", toml_files.number))
    if found.low > found.high:
        raise section.fail("low_c", "is above high_c")
    section.finish()
    return found


def _term(section: toml_files.Section, sensors: Sequence[str]) -> Term:
    lag_s = section.take("lag_s", toml_files.not_negative)
    named = {key: section.take(key, toml_files.name) for key in ("sensor", "start")}
    for key, name in named.items():
        if name not in sensors:
            raise section.fail(key, f"{name!r} has no range in [[hull]]: where the model holds would not be known")
    per_k: dict[str, float] = {}
    for name, unit in DIRECTIONS.items():
        value = section.take(f"{name}_{unit}_per_k", toml_files.number, math.nan)
        per_k |= {} if math.isnan(value) else {name: value}
    section.finish()
    return Term(named["sensor"], lag_s, named["start"], per_k)


def _square(size: int) -> Any:
    def check(value: Any) -> FloatArray:
        if not isinstance(value, list) or len(value) != size:
            raise ValueError(f"expected {size} rows of {size} numbers")
        rows = [toml_files.numbers(row) for row in value]
        if any(len(row) != size for row in rows):
            raise ValueError(f"expected {size} rows of {size} numbers")
        return np.array(rows).reshape(size, size)

    return check
