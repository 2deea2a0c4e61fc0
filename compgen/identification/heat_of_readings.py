"""Readings of known temperatures at the reference state: the growth that a model of heat tells is taken out of them.

The tool has moved by d(t) against the workpiece since the first reading (:mod:`compgen.heat.model`): that is in every reading,
in its own direction, and is subtracted there. What remains unknown is a displacement of a few known patterns, each one standard
uncertainty in size: the coefficients (their covariance), what days that were left out of the model were off (a line and a bow
over the time), and the moment at which a reading was taken. The readings are identified once more with each pattern added; how
the errors move is a further column of the factor of their covariance (GUM, JCGM 100:2008, eq. 10).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray, comments_of
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.errors import CompgenWarning, InputError, nearest
from compgen.heat.joining import (
    U_CLOCK_S,
    Moments,
    Stretch,
    columns_at,
    moments_of,
    on_clock,
    read_stretches,
    stretch_of,
)
from compgen.heat.model import HeatModel, read_heat
from compgen.heat.sessions import COLDEST_C, HOTTEST_C, Temperatures, check_machine
from compgen.identification.covariance import with_response
from compgen.identification.kinds import Measurement, MixedMeasurement
from compgen.identification.options import locate_stations
from compgen.identification.result import Identification
from compgen.kinematics.first_order import tool_of

if TYPE_CHECKING:
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles
    from compgen.data.deviations import Deviations

    Timed = Lengths | Deviations | AxisRuns | Circles

_AXES = ("dx", "dy", "dz")
#: Patterns that together have less than this share of the variance of all are left out: each costs one identification.
NEGLIGIBLE = 1e-3
#: Share of a standard uncertainty by which readings are changed to see how the errors move: the same outliers stay outliers.
STEP = 0.1
#: The same sensor in the measurement and in the file of temperatures may differ by this, K (rms): more is another clock.
SAME_K = 1.0
#: After a gap the state of a lag is known again after so many times its length.
FORGOTTEN = 3.0


@dataclass(frozen=True)
class HeatSource:
    """Where temperatures and their effect are known from: a model, and a file of temperatures as its stretches.

    Without stretches the columns of the measurement count; without a model temperatures become columns, and nothing is
    corrected.
    """

    model: HeatModel | None
    stretches: tuple[Stretch, ...] = ()
    file: Path | None = None
    u_clock_s: float = U_CLOCK_S

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files that were read; those of a folder are not listed: it grows."""
        model = None if self.model is None else self.model.source
        log = self.file if self.file is not None and self.file.is_file() else None
        return tuple(path for path in (model, log) if path is not None)


def heat_source(
    machine: Machine, model: Path | None, temperatures: Path | None, u_clock_s: float = U_CLOCK_S
) -> HeatSource:
    """Read a model of heat and a file of temperatures; InputError for the model of another machine."""
    read = None if model is None else read_heat(model)
    if read is not None and read.machine != machine.name:
        raise InputError(f"is the model of heat of {read.machine}, not of {machine.name}", file=model)
    stretches = () if temperatures is None else read_stretches(temperatures)
    for item in stretches:
        check_machine(item.table.metadata.get("machine", ""), machine.name, item.table.path)
    return HeatSource(read, stretches, temperatures, u_clock_s)


@dataclass(frozen=True)
class Joined:
    """One part of a measurement with its temperatures as columns, and its displacement.

    ``moved_mm`` (n, 3) is what is taken out; ``patterns_mm`` (n, 3, J) one standard uncertainty of each cause. ``outside``
    names what left the hull of the model: then nothing is taken out.
    """

    measurement: Timed
    moved_mm: FloatArray
    patterns_mm: FloatArray
    outside: tuple[str, ...] = ()
    celsius: Mapping[str, tuple[float, float]] | None = None


@dataclass(frozen=True)
class AtReference:
    """A measurement at the reference state, and how its readings would be if one cause was larger by its uncertainty."""

    machine: Machine
    measurement: Measurement | ErrorTable
    joined: tuple[Joined, ...]
    source: HeatSource
    whole: Measurement | ErrorTable

    @property
    def corrected(self) -> bool:
        """Whether anything was taken out."""
        return self.source.model is not None and not self.outside

    @property
    def outside(self) -> tuple[str, ...]:
        """What left the hull of the model."""
        return tuple(dict.fromkeys(text for item in self.joined for text in item.outside))

    def with_pattern(self, along: FloatArray) -> Measurement | ErrorTable:
        """Return the measurement with the patterns (J,) taken out as well."""
        parts = iter(self.joined)

        def changed(part: Any) -> Any:
            if isinstance(part, ErrorTable):
                return part
            item = next(parts)
            return _minus(self.machine, item.measurement, item.moved_mm + item.patterns_mm @ along)

        return cast("Measurement | ErrorTable", _each(self.whole, changed))

    def patterns(self) -> FloatArray:
        """Return few independent combinations of the patterns, (J, r), that have nearly all of the variance."""
        if not self.joined:
            return np.zeros((0, 0))
        stacked = np.concatenate([item.patterns_mm.reshape(-1, item.patterns_mm.shape[2]) for item in self.joined])
        _, sizes, along = np.linalg.svd(stacked, full_matrices=False)
        total = float(np.sum(sizes**2))
        if total <= 0.0:
            return np.zeros((stacked.shape[1], 0))
        left = 1.0 - np.cumsum(sizes**2) / total
        return np.asarray(along[: int(np.argmax(left <= NEGLIGIBLE)) + 1].T)

    def notes(self) -> dict[str, Any]:
        """Return the object ``heat`` of ``corrections``."""
        model = self.source.model
        celsius: dict[str, list[float]] = {}
        for item in self.joined:
            for name, (low, high) in (item.celsius or {}).items():
                known = celsius.get(name, [low, high])
                celsius[name] = [min(known[0], low), max(known[1], high)]
        moved = np.concatenate([item.moved_mm for item in self.joined])
        return {
            "model": None if model is None or model.source is None else model.source.name,
            "temperatures": None if self.source.file is None else self.source.file.name,
            "corrected": self.corrected,
            "outside_hull": list(self.outside),
            "largest_um": {
                name: float(np.abs(moved[:, k]).max(initial=0.0)) / MM_PER_UM for k, name in enumerate(_AXES)
            },
            "temperatures_c": celsius,
        }

    def says(self) -> str:
        """Return what is said of it before anything is identified."""
        if self.source.model is None:
            return "temperatures are joined to the readings; no model of heat is known, so growth is not taken out"
        if self.outside:
            return (
                f"{', '.join(self.outside)} left the range in which the model of heat was learned: nothing is taken out of these "
                "readings; what the model would say is added to u. Measure drift in this state and learn again"
            )
        largest = self.notes()["largest_um"]
        parts = ", ".join(f"{name} up to {value:.2f} um" for name, value in largest.items() if value)
        return f"heat taken out of the readings since the first one: {parts or 'nothing'}"


def at_reference_heat(machine: Machine, measurement: Measurement | ErrorTable, source: HeatSource) -> AtReference:
    """Join temperatures to the readings by time, and take out what heat has moved since the first of them.

    Raises
    ------
    InputError
        for readings without a time, moments without temperatures, sensors that are missing or broken, and for kinds of
        measurement of which the readings have no time or no direction (artefacts, parts, six-DOF readings).
    """
    timed = [part for part in _parts(measurement) if not isinstance(part, ErrorTable)]
    if not timed:
        raise InputError(
            "the files have errors and no readings, whose temperatures would count; leave out --temperatures"
        )
    clocks = [_times(part, source) for part in timed]
    temperatures, begins = None, True
    if source.stretches:
        assert source.file is not None
        temperatures, begins = stretch_of(
            source.stretches, [clock for clocks_of in clocks for clock, _ in clocks_of], source.file
        )
    first = min((float(clock.at_s.min()) for clocks_of in clocks for clock, _ in clocks_of), default=0.0)
    if temperatures is not None and source.model is not None:
        _sound(source.model, temperatures, first, source, begins=begins)
    joined = tuple(
        _joined(part, clocks_of, temperatures, source, first) for part, clocks_of in zip(timed, clocks, strict=True)
    )
    if any(item.outside for item in joined):
        joined = tuple(_as_unknown(item) for item in joined)
    results = iter(joined)

    def changed(part: Any) -> Any:
        if isinstance(part, ErrorTable):
            return part
        item = next(results)
        return _minus(machine, item.measurement, item.moved_mm)

    return AtReference(machine, _each(measurement, changed), joined, source, measurement)


def _as_unknown(item: Joined) -> Joined:
    """Take nothing out; what would have been is one more pattern."""
    patterns = np.concatenate([item.patterns_mm, item.moved_mm[:, :, None]], axis=2)
    return replace(item, moved_mm=np.zeros_like(item.moved_mm), patterns_mm=patterns)


def _parts(measurement: Any) -> list[Any]:
    return [part for _, part in measurement.parts] if isinstance(measurement, MixedMeasurement) else [measurement]


def _each(measurement: Any, change: Callable[[Any], Any]) -> Any:
    if isinstance(measurement, MixedMeasurement):
        return MixedMeasurement(tuple((name, change(part)) for name, part in measurement.parts))
    return change(measurement)


# When and at which temperatures readings were taken.


def _times(part: Any, source: HeatSource) -> list[tuple[Moments, NDArray[np.intp]]]:
    """Return the moments of the rows of each file of a part."""
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles
    from compgen.data.deviations import PART, Deviations

    file = part.origin[0][0] if len(getattr(part, "origin", ())) else None
    is_part = isinstance(part, Deviations) and part.metadata.get("measured") == PART
    if not isinstance(part, Lengths | Deviations | AxisRuns | Circles) or is_part:
        raise InputError(
            "has readings of a kind that heat is not taken out of: lengths, deviations, axis runs and circles with time_s "
            "are known; leave out --temperatures and --heat",
            file=file,
        )
    if "time_s" not in part.covariates:
        raise InputError("has no column time_s; temperatures are joined by time", file=file, field="time_s")
    time_s = part.covariates["time_s"]
    if not source.stretches:
        return [(Moments(time_s, epoch=False), np.arange(len(part)))]
    if not len(part.origin):
        return [(moments_of(time_s, part.metadata, None), np.arange(len(part)))]
    names = np.array([str(name) for name, _ in part.origin])
    found = []
    for name in dict.fromkeys(names.tolist()):
        rows = np.flatnonzero(names == name)
        found.append((moments_of(time_s[rows], {**part.metadata, **comments_of(name)}, name), rows))
    return found


def _joined(
    part: Timed,
    clocks: Sequence[tuple[Moments, NDArray[np.intp]]],
    temperatures: Temperatures | None,
    source: HeatSource,
    first: float,
) -> Joined:
    model = source.model
    if temperatures is None:
        temperatures = _own_temperatures(part, model)
    epoch = clocks[0][0].epoch
    at_s, other_s = np.zeros(len(part)), np.zeros(len(part))
    for clock, rows in clocks:
        at_s[rows] = on_clock(temperatures, clock.possible[0], epoch=epoch)
        other_s[rows] = on_clock(temperatures, clock.possible[-1], epoch=epoch)
    columns = {name: columns_at(temperatures, values, at_s) for name, values in temperatures.celsius.items()}
    part = _with_columns(part, columns, source)
    if model is None:
        return Joined(part, np.zeros((len(part), 3)), np.zeros((len(part), 3, 0)), (), _ranges(columns))
    states = model.states(temperatures)
    begin = on_clock(temperatures, np.array([first]), epoch=epoch) if source.stretches else np.array([first])
    zero = columns_at(temperatures, states, begin)
    change = columns_at(temperatures, states, at_s) - zero
    outside = _outside(model, temperatures, at_s)
    later = []
    if source.stretches:
        late = columns_at(temperatures, states, at_s + source.u_clock_s)
        late -= columns_at(temperatures, states, begin + source.u_clock_s)
        later.append(late - change)
        other = columns_at(temperatures, states, other_s)
        other -= columns_at(temperatures, states, other_s.min(keepdims=True))
        known = not np.any(other_s != at_s)
        later.append(np.zeros_like(change) if known else 0.5 * (other - change))
    moved, patterns = _moved(model, change, at_s, later)
    used = {name: columns[name] for name in model.sensors}
    return Joined(part, moved, patterns, outside, _ranges(used))


def _ranges(columns: Mapping[str, FloatArray]) -> dict[str, tuple[float, float]]:
    return {name: (float(values.min()), float(values.max())) for name, values in columns.items()}


def _own_temperatures(part: Timed, model: HeatModel | None) -> Temperatures:
    """Return the temperatures that the measurement itself has, in the order of time."""
    file = part.origin[0][0] if len(part.origin) else None
    names = {key[len("temp_") : -len("_c")]: key for key in part.covariates if key.startswith("temp_")}
    missing = [] if model is None else [name for name in model.sensors if name not in names]
    if missing or not names:
        what = (
            f"no column temp_{missing[0]}_c, which the model of heat needs; {nearest(missing[0], names)}"
            if missing
            else "no temperatures"
        )
        raise InputError(f"has {what}; give --temperatures FILE", file=file)
    wanted = names if model is None else {name: names[name] for name in model.sensors}
    time_s, rows = np.unique(part.covariates["time_s"], return_index=True)
    celsius = {name: part.covariates[key][rows] for name, key in wanted.items()}
    for name, values in celsius.items():
        if not np.isfinite(values).all() or values.min() < COLDEST_C or values.max() > HOTTEST_C:
            text = f"is empty, or outside {COLDEST_C:g} ... {HOTTEST_C:g} degC, for some readings; mend it, or leave heat out"
            raise InputError(text, file=file, field=f"temp_{name}_c")
    if len(time_s) < 2:
        raise InputError("has one moment only; growth counts between moments", file=file, field="time_s")
    return Temperatures(time_s, celsius)


def _sound(model: HeatModel, temperatures: Temperatures, first: float, source: HeatSource, *, begins: bool) -> None:
    """Refuse sensors that are broken, and lags whose state is not known after a gap."""
    broken = [name for name in model.sensors if name in temperatures.broken]
    if broken:
        raise InputError(f"temp_{broken[0]}_c jumps, and the model of heat needs it; mend the sensor", file=source.file)
    longest = max((term.lag_s for term in model.terms), default=0.0)
    before = first - (temperatures.since or 0.0) - float(temperatures.time_s[0])
    if not begins and before < FORGOTTEN * longest:
        raise InputError(
            f"has a gap {before / 60:.0f} min before the measurement; how warm the machine was is known again "
            f"{FORGOTTEN * longest / 60:.0f} min after it (three times the longest lag)",
            file=source.file,
        )


def _with_columns(part: Timed, columns: Mapping[str, FloatArray], source: HeatSource) -> Timed:
    """Return the part with the joined temperatures as columns; one that it has must agree: it shows that the clocks do."""
    added = {}
    for name, values in columns.items():
        key = f"temp_{name}_c"
        own = part.covariates.get(key)
        if own is None:
            added[key] = values
            continue
        both = np.isfinite(own)
        apart = float(np.sqrt(np.mean((own - values)[both] ** 2))) if both.any() else 0.0
        if apart > SAME_K:
            raise InputError(
                f"has {key} {apart:.1f} K (rms) off the column of this name of the measurement: are the clocks or time zones "
                "different, or is it another sensor?",
                file=source.file,
            )
    return replace(part, covariates={**part.covariates, **added})


def _outside(model: HeatModel, temperatures: Temperatures, at_s: FloatArray) -> tuple[str, ...]:
    celsius = {name: columns_at(temperatures, temperatures.celsius[name], at_s) for name in model.sensors}
    found = []
    for item in model.hull:
        beyond = item.outside_k(celsius)
        if beyond.max() > 1e-6:
            found.append(
                f"{item.text} ({int(np.count_nonzero(beyond > 1e-6))} readings, by up to {beyond.max():.2f} K)"
            )
    return tuple(found)


# Displacement of the readings and its uncertainty.


def _moved(
    model: HeatModel, change: FloatArray, at_s: FloatArray, later: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return displacement (n, 3) and patterns (n, 3, J) of changes (n, terms) of the lagged temperatures."""
    moved = np.zeros((len(change), 3))
    patterns: list[FloatArray] = []
    share = np.interp(at_s, [at_s.min(), max(at_s.max(), at_s.min() + 1e-9)], [-1.0, 1.0])
    shapes = [np.sqrt(3.0) * share, np.sqrt(5.0) * 0.5 * (3.0 * share**2 - 1.0)]  # Legendre: rms 1 over the time
    for axis, name in enumerate(_AXES):
        if name not in model.directions:
            continue
        k = model.coefficients(name) * MM_PER_UM
        moved[:, axis] = change @ k
        values, vectors = np.linalg.eigh(model.covariance[name])
        own = [change @ column for column in (vectors * np.sqrt(np.maximum(values, 0.0))).T]
        own += [model.rms[name][1] / np.sqrt(2.0) * shape for shape in shapes]
        own_mm = [MM_PER_UM * column for column in own]
        for column in own_mm:
            patterns.append(_along(axis, column))
    for off in later:  # of all directions together
        k = np.stack([model.coefficients(name) for name in _AXES], axis=1) * MM_PER_UM
        patterns.append(off @ k)
    stacked = np.stack(patterns, axis=2) if patterns else np.zeros((len(change), 3, 0))
    return moved, stacked


def _along(axis: int, column: FloatArray) -> FloatArray:
    found = np.zeros((len(column), 3))
    found[:, axis] = column
    return found


def _minus(machine: Machine, part: Timed, moved_mm: FloatArray) -> Timed:
    """Return readings without a displacement (n, 3) of the tool against the workpiece."""
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles

    if isinstance(part, Lengths):
        return replace(part, length_mm=part.length_mm - np.sum(_sight(machine, part) * moved_mm, axis=1))
    if isinstance(part, AxisRuns):
        return replace(part, deviation_mm=part.deviation_mm - moved_mm[np.arange(len(part)), part.axis])
    if isinstance(part, Circles):
        return replace(part, deviation_mm=part.deviation_mm - np.sum(part.radial() * moved_mm, axis=1))
    return replace(part, deviation_mm=part.deviation_mm - moved_mm)


def _sight(machine: Machine, lengths: Lengths) -> FloatArray:
    """Unit vectors (n, 3) from station to target, of the machine taken as perfect: 1 mm at 1 m changes 20 um by 0.02 um."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        known = locate_stations(machine, lengths)
    line = lengths.position_mm + tool_of(machine, lengths.tool_mm) - known.position_mm[lengths.station]
    return np.asarray(line / np.linalg.norm(line, axis=1, keepdims=True))


# Identification with the uncertainty of heat.


def identified_at_reference(
    found: AtReference, identify: Callable[[Measurement | ErrorTable], Identification]
) -> Identification:
    """Identify the readings at the reference state; u of the errors contains that of the heat that was taken out.

    ``identify`` is called once for the result, and once for each pattern of what remains unknown.
    """
    result = identify(found.measurement)
    result = replace(result, corrections={**result.corrections, "heat": found.notes()})
    if found.outside:
        result = replace(result, doubts=(*result.doubts, found.says()))
    if not result.has_covariance:
        return result
    others = []
    for along in found.patterns().T:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CompgenWarning)
            others.append(identify(found.with_pattern(STEP * along)))
    return with_response(result, others, "heat", STEP)
