"""How far heat has moved the tool at stated temperatures: what a program is corrected by, and what a part will show.

Temperatures are a file over time, in which lags are followed, or single values, at which the machine is taken as settled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.files import sha256_of_file
from compgen.data.names import MM_PER_UM
from compgen.errors import InputError, nearest, visible_line
from compgen.heat.model import HeatModel
from compgen.heat.sessions import (
    COLDEST_C,
    DIRECTIONS,
    HOTTEST_C,
    Temperatures,
    check_machine,
    read_temperatures,
)

TEMPERATURES, AT, ZERO = "--temperatures", "--heat-at", "--heat-zero"
_AXES = ("dx", "dy", "dz")
#: Length of a tool for which the share of a tilt is said, mm.
TOOL_MM = 100.0


@dataclass(frozen=True)
class Growth:
    """Displacement of the tool since the zero by direction, um or urad, with standard uncertainties, at ``celsius``."""

    moved: Mapping[str, float]
    u: Mapping[str, float]
    celsius: Mapping[str, float]
    zero_c: Mapping[str, float]
    model: tuple[str, str]
    notes: tuple[str, ...] = ()

    @property
    def vector_mm(self) -> FloatArray:
        """Displacement (3,), actual minus nominal; 0 in a direction without a model."""
        return np.array([self.moved.get(name, 0.0) for name in _AXES]) * MM_PER_UM

    @property
    def u_mm(self) -> FloatArray:
        """Standard uncertainties (3,); 0 in a direction of which nothing is known, which a note says."""
        return np.array([self.u.get(name, 0.0) for name in _AXES]) * MM_PER_UM

    def as_dict(self) -> dict[str, Any]:
        """Return the object ``heat`` of JSON files."""
        found: dict[str, Any] = {"model": self.model[0], "sha256": self.model[1]}
        found |= {"temperatures_c": dict(self.celsius), "zero_c": dict(self.zero_c)}
        for name, value in self.moved.items():
            found |= {f"{name}_{DIRECTIONS[name]}": value, f"u_{name}_{DIRECTIONS[name]}": self.u[name]}
        return found

    def lines(self) -> list[str]:
        """Return what is said of the growth, and what it leaves open."""
        parts = [f"{name} {value:+.2f} (u {self.u[name]:.2f}) {DIRECTIONS[name]}" for name, value in self.moved.items()]
        read = ", ".join(
            f"{name} {value:.2f} ({value - self.zero_c[name]:+.2f} K)" for name, value in self.celsius.items()
        )
        found = [f"heat since the zero ({self.model[0]}): {', '.join(parts)} at {read} degC"]
        unknown = [name for name in _AXES if name not in self.moved]
        if unknown:
            found.append(f"the model of heat says nothing of {', '.join(unknown)}: what heat does there is not known")
        tilts = [f"{name} {self.moved[name]:+.1f}" for name in ("ea", "eb") if name in self.moved]
        if tilts:
            most = max(abs(self.moved[name]) for name in ("ea", "eb") if name in self.moved) * TOOL_MM * 1e-3
            found.append(
                f"the tilt of the spindle ({', '.join(tilts)} urad) is not in it, since the length of tool at which drift was "
                f"measured is not known: {most:.2f} um for each {TOOL_MM:g} mm of difference"
            )
        return [*found, *self.notes]


def growth_at(model: HeatModel, stated: str, at: str | None, zero: str | None) -> Growth:
    """Return the growth at temperatures: ``stated`` is a file, or values such as ``spindle=28.5,bed=22``.

    ``at`` and ``zero`` are moments of the file (its last and first reading by default), or ``zero`` are values, too.

    Raises
    ------
    InputError
        for a state beyond the hull of the model, for sensors that are missing or broken, for moments outside the file.
    """
    assert model.source is not None
    source = (model.source.name, sha256_of_file(model.source))
    if "=" in stated and not Path(stated).exists():
        return _settled(model, stated, at, zero, source)
    read = read_temperatures(stated)
    _sound(model, read, stated)
    last = _moment(read, at, AT, float(read.time_s[-1]), stated)
    first = _moment(read, zero, ZERO, float(read.time_s[0]), stated)
    if last < first:
        raise InputError(f"is {first - last:g} s before the zero; give a moment after it", field=AT)
    if at is None and any("a gap of" in text for text in read.notes):
        message = (
            "has a gap after which the state of the machine is not known; name a moment before it with --heat-at, "
        )
        raise InputError(f"{message}or begin the file after the gap", file=stated)
    states = model.states(read)
    change = _at(read, states, last) - _at(read, states, first)
    celsius, zero_c = (
        {name: float(_at(read, read.celsius[name], moment)) for name in model.sensors} for moment in (last, first)
    )
    notes = []
    if any(term.lag_s for term in model.terms):
        notes.append(
            f"lags begin at the first reading of {Path(stated).name}: the machine was switched on then (assumed)"
        )
    if zero is None:
        notes.append("growth counts from the first reading: the work offset was probed then (assumed)")
    return _growth(model, change, celsius, zero_c, source, notes)


def _growth(
    model: HeatModel,
    change: FloatArray,
    celsius: Mapping[str, float],
    zero_c: Mapping[str, float],
    source: tuple[str, str],
    notes: list[str],
) -> Growth:
    for readings, field in ((celsius, TEMPERATURES), (zero_c, ZERO)):
        _in_hull(model, readings, field)
    moved = {name: float(change @ model.coefficients(name)) for name in model.directions}
    variance = {name: max(float(change @ model.covariance[name] @ change), 0.0) for name in model.directions}
    u = {name: math.sqrt(variance[name] + model.rms[name][1] ** 2) for name in model.directions}
    return Growth(moved, u, celsius, zero_c, source, tuple(notes))


def _in_hull(model: HeatModel, celsius: Mapping[str, float], field: str) -> None:
    """Refuse a state that was never seen: nothing proves the model there."""
    for item in model.hull:
        value = celsius[item.sensor] - (celsius[item.minus] if item.minus else 0.0)
        if float(item.outside_k({name: np.array([v]) for name, v in celsius.items()})[0]) > 1e-6:
            unit = "K" if item.minus else "degC"
            raise InputError(
                f"{item.text} is {value:.2f} {unit}, and the model of heat was learned from {item.low:.2f} to {item.high:.2f} "
                f"{unit}: it says nothing of this state; measure drift in it and learn again, or leave out {TEMPERATURES}",
                field=field,
            )


def _sound(model: HeatModel, read: Temperatures, file: str) -> None:
    check_machine(read.machine, model.machine, file)
    broken = [name for name in model.sensors if name in read.broken]
    if broken:
        raise InputError(f"temp_{broken[0]}_c jumps, and the model of heat needs it; mend the sensor", file=file)


def _at(read: Temperatures, values: FloatArray, moment_s: float) -> FloatArray:
    """Return values (n, ...) at a moment, on the straight line between two readings."""
    if values.ndim == 1:
        return np.asarray(np.interp(moment_s, read.time_s, values))
    return np.array([np.interp(moment_s, read.time_s, column) for column in values.T])


def _moment(read: Temperatures, text: str | None, field: str, default: float, file: str) -> float:
    """Return a moment, s of the file: seconds since its first reading or on its clock, or ISO time with zone."""
    if text is None:
        return default
    try:
        found = float(text)
    except ValueError:
        found = _from_iso(read, text, field, file)
    low, high = float(read.time_s[0]), float(read.time_s[-1])
    if not low <= found <= high:
        raise InputError(f"{visible_line(text)[:40]} is outside the readings: time_s {low:g} to {high:g}", field=field)
    return found


def _from_iso(read: Temperatures, text: str, field: str, file: str) -> float:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        message = (
            f"{visible_line(text)[:40]!r} is no moment; expected time_s of {Path(file).name}, or ISO time with zone"
        )
        raise InputError(message, field=field) from None
    if moment.tzinfo is None:
        raise InputError(f"{text} has no zone; add it, e.g. {text}+01:00", field=field)
    if read.since is None:
        raise InputError(f"{text} cannot be found in {Path(file).name}, which has time_s; give seconds", field=field)
    return moment.timestamp() - read.since


# Single values.


def _settled(model: HeatModel, stated: str, at: str | None, zero: str | None, source: tuple[str, str]) -> Growth:
    """Return the growth of a machine that has settled at values, since it had settled at those of the zero."""
    if at is not None:
        raise InputError("belongs to a file of temperatures; leave it out", field=AT)
    if zero is None:
        message = "is missing: growth counts from a state, that in which the work offset was probed; give its temperatures, e.g. "
        raise InputError(f"{message}{ZERO} {','.join(f'{name}=20' for name in model.sensors)}", field=ZERO)
    celsius, zero_c = _values(model, stated, TEMPERATURES), _values(model, zero, ZERO)
    change = np.array([celsius[term.sensor] - zero_c[term.sensor] for term in model.terms])
    lags = [term.lag_s for term in model.terms if term.lag_s]
    notes = []
    if lags:
        notes.append(
            f"the machine is taken as settled, {3 * max(lags) / 60:.0f} min at these temperatures and before the zero at "
            "those; give a file of temperatures where it was not"
        )
    return _growth(model, change, celsius, zero_c, source, notes)


def _values(model: HeatModel, text: str, field: str) -> dict[str, float]:
    found: dict[str, float] = {}
    for part in text.split(","):
        name, _, number = (piece.strip() for piece in part.partition("="))
        name = name.removeprefix("temp_").removesuffix("_c") if name not in model.sensors else name
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not COLDEST_C <= value <= HOTTEST_C:
            example = f"{model.sensors[0]}=21.5"
            raise InputError(
                f"{visible_line(part)[:40]!r} is no temperature; expected e.g. {example} (degC)", field=field
            )
        if name not in model.sensors:
            raise InputError(
                f"the model of heat has no sensor {visible_line(name)}; {nearest(name, model.sensors)}", field=field
            )
        if name in found:
            raise InputError(f"{name} is given twice; give it once", field=field)
        found[name] = value
    missing = [name for name in model.sensors if name not in found]
    if missing:
        raise InputError(f"{missing[0]} is missing, which the model of heat needs; add {missing[0]}=degC", field=field)
    return found
