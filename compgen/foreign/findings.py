"""Findings about a foreign file: options, result, and the units that its numbers suggest.

:class:`Imported` is the result, :class:`TableFindings` the state of a table while it is read; what the user answers is in
:mod:`compgen.foreign.answers`. Units that a file does not state are judged from the data (:func:`judge_lengths`,
:func:`slope_of`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data.axis_runs import AxisRuns, format_axis_runs
from compgen.data.circles import Circles, format_circles
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact, Deviations, Part, format_artefact, format_deviations, format_part
from compgen.data.error_table import ErrorTable, ReversalCurves, format_errors, format_reversal
from compgen.data.lengths import Lengths, format_lengths
from compgen.data.rotary import SphereCentres, format_spheres
from compgen.errors import InputError
from compgen.foreign.answers import ImportOptions, Kind
from compgen.foreign.cells import Table
from compgen.foreign.column_names import (
    MM_PER_LENGTH,
    RAD_PER_ANGLE,
    NamedColumn,
    is_deviation,
    known_unit,
)
from compgen.foreign.laser_files import Capture, format_capture
from compgen.foreign.questions import ANGLE_UNITS, LENGTH_UNITS, Asking, Question, unit_choices
from compgen.foreign.source import parse_number, shown

# The result of an import: the object, what was understood, and what is in doubt.


SUFFIXES = {
    "axis": ".axis.csv",
    "lengths": ".lengths.csv",
    "deviations": ".deviations.csv",
    "errors": ".errors.csv",
    "capture": ".capture.csv",
    "circle": ".circle.csv",
    "artefact": ".artefact.csv",
    "part": ".part.csv",
    "sphere": ".sphere.csv",
}
Data = AxisRuns | Lengths | Deviations | ErrorTable | Capture | Circles | Artefact | Part | SphereCentres
_WRITERS: dict[type, Callable[[Any], str]] = {
    AxisRuns: format_axis_runs,
    Lengths: format_lengths,
    Deviations: format_deviations,
    ErrorTable: format_errors,
    Capture: format_capture,
    Circles: format_circles,
    Artefact: format_artefact,
    Part: format_part,
    SphereCentres: format_spheres,
}


@dataclass(frozen=True)
class Imported:
    """A foreign file as a native object.

    Parameters
    ----------
    path, format : the file, and the name of its format.
    kind : kind of native file.
    data : the object, mm and rad.
    understood : what was read from the file or inferred, in words and numbers.
    questions : what is open; until the user answers what is required of it, no other command accepts the file.
    notes : remarks that require no decision.
    reversal : difference of both directions, if ``data`` contains only their mean.
    other_errors : errors on other sheets of a workbook of axis runs (squareness, straightness).
    """

    path: Path
    format: str
    kind: Kind
    data: Data
    understood: Mapping[str, Any]
    questions: tuple[Question, ...] = ()
    notes: tuple[str, ...] = ()
    reversal: ReversalCurves | None = None
    other_errors: ErrorTable | None = None

    @property
    def doubts(self) -> tuple[str, ...]:
        """What has to be answered before the file is used, each as a line for the terminal."""
        return tuple(question.text for question in self.questions if question.required)

    @property
    def offers(self) -> tuple[str, ...]:
        """What may be answered and need not, each as a line for the terminal."""
        return tuple(question.text for question in self.questions if not question.required)

    @property
    def file_name(self) -> str:
        """Name of the native file."""
        return f"{self.path.stem}{SUFFIXES[self.kind]}"

    def check_settled(self) -> None:
        """Raise InputError if something is in doubt."""
        if self.doubts:
            raise InputError(
                f"leaves open: {'; '.join(self.doubts)}. run and identify take these options; 'volcomp import' shows what was "
                "understood and accepts what is missing; pass its result to this command",
                file=self.path,
            )

    def files(self) -> dict[str, str]:
        """Return the texts of the native files by name."""
        found = {self.file_name: _WRITERS[type(self.data)](self.data)}
        if self.reversal is not None:
            found[f"{self.path.stem}.reversal.csv"] = format_reversal(self.reversal)
        if self.other_errors is not None:
            found[f"{self.path.stem}{SUFFIXES['errors']}"] = format_errors(self.other_errors)
        return found

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``--json``."""
        return {
            "file": str(self.path),
            "format": self.format,
            "kind": self.kind,
            "understood": dict(self.understood),
            "doubts": list(self.doubts),
            "questions": [question.to_dict() for question in self.questions],
            "notes": list(self.notes),
        }


# Unit and sign as hypotheses tested with the data.
#
# Three methods, the strongest first. If a file contains target AND reading, the slope of the reading over the target is
# the ratio of their units, and its sign is the sign. Tracer lengths and commanded points obey |P - S|^2 = (k L + c)^2,
# linear in k^2, S and the rest, so least squares gives the unit k and, by the sign of k L + c, the sign. Deviations
# alone have only their magnitude: it is compared with that of usual machine tools.


#: Usual magnitude of a deviation: a constant, and a part for each metre of travel; one standard deviation is a factor
#: of 5.
USUAL_UM, USUAL_UM_PER_M, SPREAD_DECADES = 2.0, 10.0, 0.7
USUAL_URAD = 10.0
#: Usual travel, and its spread.
USUAL_TRAVEL_MM, TRAVEL_DECADES = 800.0, 0.5
#: A hypothesis with a smaller share is not used without confirmation.
SURE = 0.95
#: A declared unit that makes the data this much larger or smaller than usual is doubted (decades).
ABSURD_DECADES = 2.2
#: Largest deviation of a slope from a ratio of units.
SLOPE_TOLERANCE = 0.02


@dataclass(frozen=True)
class UnitVerdict:
    """The best hypothesis, its share among all (0..1), and the shares of the others."""

    best: str
    share: float
    shares: Mapping[str, float]

    @property
    def sure(self) -> bool:
        """Whether it may be used without confirmation."""
        return self.share >= SURE

    def text(self) -> str:
        """Return the best two in words."""
        ranked = sorted(self.shares.items(), key=lambda item: -item[1])[:2]
        return ", ".join(f"{name} {100 * share:.1f} %" for name, share in ranked)


def verdict_of(scores: Mapping[str, float]) -> UnitVerdict:
    """Return the shares of hypotheses with the given log-likelihoods."""
    top = max(scores.values())
    weights = {name: float(np.exp(score - top)) for name, score in scores.items()}
    total = sum(weights.values())
    shares = {name: weight / total for name, weight in weights.items()}
    best = max(shares, key=lambda name: shares[name])
    return UnitVerdict(best, shares[best], shares)


def decades_off(values: FloatArray, si_per_unit: float, usual_si: float) -> float:
    """Return by how many powers of ten the RMS of ``values`` about their mean (a single one: itself) exceeds the usual."""
    centre = values.mean() if len(values) > 1 else 0.0
    rms = float(np.sqrt(np.mean((values - centre) ** 2))) * si_per_unit
    return float(np.log10(max(rms, 1e-15) / usual_si))


def usual_deviation_mm(span_mm: float) -> float:
    """Return the usual size of deviations over a travel, mm."""
    return 1e-3 * (USUAL_UM + USUAL_UM_PER_M * span_mm / 1000.0)


def unit_of_deviations(values: FloatArray, units: Mapping[str, float], usual_si: float) -> UnitVerdict:
    """Judge units of bare deviations by their size; ``units`` holds mm or rad for each unit."""
    scores = {
        name: -0.5 * (decades_off(values, scale, usual_si) / SPREAD_DECADES) ** 2 for name, scale in units.items()
    }
    return verdict_of(scores)


def unit_of_positions(span: float) -> UnitVerdict:
    """Judge mm, m and inch for positions of this range; mm is ten times as likely a priori."""
    scores = {
        name: prior - 0.5 * (float(np.log10(max(span * scale, 1e-12) / USUAL_TRAVEL_MM)) / TRAVEL_DECADES) ** 2
        for name, scale, prior in (("mm", 1.0, 0.0), ("m", 1e3, -np.log(10.0)), ("in", 25.4, -np.log(50.0)))
    }
    return verdict_of(scores)


@dataclass(frozen=True)
class Slope:
    """Reading = slope * target + offset, in units of the reading; ``unit_ratio`` and ``sign`` if the slope is a ratio."""

    slope: float
    offset: float
    unit_ratio: float | None
    sign: int


def slope_of(target: FloatArray, reading: FloatArray) -> Slope:
    """Compare readings with targets, both (n,): the size of the slope is a ratio of units, its sign a sign."""
    if np.ptp(target) == 0.0:  # a single target shows no slope
        return Slope(0.0, float(np.mean(reading)), None, 1)
    slope, offset = np.polyfit(target, reading, 1).tolist()
    for ratio in (1.0, 1e3, 1e-3, 25.4, 1.0 / 25.4, 1e4):
        if abs(abs(slope) / ratio - 1.0) < SLOPE_TOLERANCE:
            return Slope(slope, offset, ratio, 1 if slope > 0 else -1)
    return Slope(slope, offset, None, 1 if slope > 0 else -1)


@dataclass(frozen=True)
class LengthGeometry:
    """Joint result of lengths and points: mm per unit of length, and the sign of growing lengths."""

    mm_per_unit: float
    sign: int


def judge_lengths(position_mm: FloatArray, length: FloatArray) -> LengthGeometry | None:
    """Judge the unit and the sign of the lengths of ONE station and set-up.

    |P|^2 = k^2 L^2 + 2 k c L + 2 S P + (c^2 - |S|^2) with points P (n, 3) in mm and lengths L (n,) in their unit. Of
    the two solutions, which differ in the sign of k and c, the one with k L + c > 0 everywhere is used.

    Returns
    -------
    the result, or None if the points are too few or inconclusive (k^2 not above zero, mixed signs).
    """
    if len(length) < 8:
        return None
    centre = position_mm.mean(axis=0)
    points, own = position_mm - centre, length - length.mean()
    size, scale = float(np.abs(points).max()), float(np.abs(own).max())
    if size == 0.0 or scale == 0.0:
        return None
    p, read = points / size, own / scale
    design = np.column_stack([read**2, read, p, np.ones(len(read))])
    found, _, rank, _ = np.linalg.lstsq(design, np.sum(p**2, axis=1), rcond=1e-10)
    square, linear = float(found[0]), float(found[1])
    if square <= 0.0 or rank < 3:
        return None
    k = float(np.sqrt(square))
    distance = k * read + linear / (2.0 * k)
    if not (np.all(distance > 0) or np.all(distance < 0)):
        return None
    return LengthGeometry(k * size / scale, 1 if distance[0] > 0 else -1)


# Findings about one table while it is read: the units in use, what was understood, what is in doubt.


#: A unit in brackets, after the word "in" (en, em), or at the end of a line.
_UNIT_IN_TEXT = re.compile(r"[\[(]([^\])]{1,8})[\])]|\b(?:in|en|em)\s+(\S{1,6})|\s([u\u00b5\u03bc]m|mm)\s*$")
#: Units that are considered if a file states none.
_LENGTHS = {name: MM_PER_LENGTH[name] for name in ("um", "mm", "nm", "in")}
_ANGLES = {name: RAD_PER_ANGLE[name] for name in ("urad", "mrad", "arcsec", "deg")}


@dataclass
class TableFindings(Asking):
    """One table being read; ``fields`` holds its columns by field, ``used`` the names of used columns.

    ``letter`` is the axis by the names of the columns. ``checked_sign`` is True if a second column confirmed the sign
    of the values; ``runs`` are the columns of a run each.
    """

    table: Table
    fields: Mapping[str, NamedColumn]
    options: ImportOptions
    understood: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    used: set[str] = field(default_factory=set)
    letter: str | None = None
    checked_sign: bool = False
    runs: list[str] = field(default_factory=list)

    def numbers(self, key: str) -> FloatArray:
        """Return the column of a field in its own unit (rows,)."""
        return np.array(self.table.numbers(self.fields[key].name))

    def is_numeric(self, name: str) -> bool:
        """Whether at least half of the filled cells of a column are numbers; False for an empty one."""
        filled = [cell for cell in self.table.column(name) if cell]
        return bool(filled) and 2 * sum(parse_number(cell) is not None for cell in filled) >= len(filled)

    def unit(self, key: str, *also: str) -> str | None:
        """Return the unit that the user gave for a field, or for one of ``also``, otherwise the one in the column's name."""
        return self.options.given_unit(key, *also) or self.fields[key].unit

    def positions_mm(self, key: str, values: FloatArray) -> FloatArray:
        """Return positions in mm: by option, by the column's name, otherwise by their magnitude."""
        unit = self.unit(key, "position")
        if unit is None:
            judged = unit_of_positions(float(np.ptp(values)))
            # positions are probably also in inches if another field is
            said = {key: known_unit(unit) for key, unit in self.options.units.items()}
            said |= {shown(column.name): column.unit for column in self.fields.values() if column.unit}
            inches = next((key for key, unit in said.items() if unit in ("in", "mil")), None)
            if inches and judged.best != "in":
                self.ask(
                    f"{inches} is in inches, and the file states no unit of {key}",
                    "units",
                    unit_choices("in", "mm"),
                    f"give --unit {key}=in or mm",
                    key=key,
                )
            unit = judged.best if inches else self._weighed(key, judged, ("mm", "in", "m"))
        if unit not in MM_PER_LENGTH:
            message = f"{unit} is not a unit of length; expected positions of a linear axis"
            raise self.table.grid.fail(message, None, self.fields[key].name)
        self.understood.setdefault("position_unit", unit)
        return values * MM_PER_LENGTH[unit]

    def values_si(self, key: str, name: str, values: FloatArray, usual_si: float, *, angular: bool) -> FloatArray:
        """Return deviations in mm or rad: by option, by the column's name, otherwise by their magnitude.

        A declared unit is doubted if it makes the data absurdly large or small and another one does not.
        """
        units = RAD_PER_ANGLE if angular else MM_PER_LENGTH
        column = self.fields.get(key)
        given = self.options.given_unit(key, "value")
        unit = given or (column.unit if column else None)
        if unit is None:  # above the table: ``Unit: um``, or the only unit in the lines about deviations
            above = self.table.metadata
            said = next((text for key, text in above.items() if key in ("unit", "units", "einheit")), None)
            lines = [line for key, text in above.items() if is_deviation(line := f"{key} {text}")]
            parts = [said] if said else ["".join(part) for line in lines for part in _UNIT_IN_TEXT.findall(line)]
            found = {known_unit(part) for part in parts}
            unit = found.pop() if len(found) == 1 else None
        judged = unit_of_deviations(values, _ANGLES if angular else _LENGTHS, usual_si)
        among = ANGLE_UNITS if angular else LENGTH_UNITS
        if unit is None:
            unit = self._weighed(key, judged, among)
        elif unit not in units:
            raise InputError(
                f"{name!r} is in {unit}; expected a unit of {'angle' if angular else 'length'}", field="--unit"
            )
        elif given is None and abs(decades_off(values, units[unit], usual_si)) > ABSURD_DECADES and judged.best != unit:
            self.ask(
                f"{name!r} states {unit}, but the numbers look like {judged.best}",
                "units",
                unit_choices(*dict.fromkeys((unit, judged.best, *among))),
                f"give --unit {key}=...",
                key=key,
                default=judged.best,
            )
        self.understood["unit"] = unit
        return values * units[unit]

    def _weighed(self, key: str, judged: UnitVerdict, among: Sequence[str]) -> str:
        if judged.sure:
            self.notes.append(f"the file states no unit of {key}; by the magnitude of the numbers {judged.text()}")
        else:
            self.ask(
                f"the file states no unit of {key} ({judged.text()})",
                "units",
                unit_choices(*dict.fromkeys((judged.best, *among))),
                f"give --unit {key}=...",
                key=key,
                default=judged.best,
            )
        return judged.best
