"""Before against after, and predicted against measured: improvement with its significance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from compgen.accuracy.budget import Budget
from compgen.accuracy.evaluate import (
    MOST_IN_PAIRS,
    accuracy_of_runs,
    groups_of_errors,
    narrowed,
    statements_of,
    volume_fields,
)
from compgen.accuracy.field import Alignment, Field, aligned, volume_figures
from compgen.accuracy.figure import COVERAGE, ComparedFigure, Figure
from compgen.accuracy.iso230_2 import LATEST
from compgen.accuracy.iso_gauge import in_common_gauge
from compgen.accuracy.pairing import MeasuredField, paired_errors, paired_fields, paired_runs
from compgen.accuracy.runs import RunStatistics
from compgen.accuracy.source import ErrorSource
from compgen.core.machine import Machine
from compgen.core.names import error_named
from compgen.errors import InputError

Overall = Literal["better", "worse", "not separated", "smaller", "larger", "same"]
#: Figures that decide over a volume, over axis runs (the first that is there), and over errors of single axes.
DECISIVE_VOLUME = ("rms", "max")
#: Share of components beyond k = 2 by chance, points at which components are looked at one by one, and what counts as 0.
CHANCE, MOST_SINGLE, EXACT_MM = 0.05, 300, 1e-9
DECISIVE_RUNS = ("A", "E", "A_up", "A_down", "E_up", "E_down")


@dataclass(frozen=True)
class CompareOptions:
    """How to compare.

    Parameters
    ----------
    align : how to bring different points together: ``"common"``, ``"interpolate"``, ``"model"``; None refuses them.
    alignment : of the volume; None is ``"axes"`` for errors, ``"as-given"`` for measured positions.
    line : reference line of straightness and squareness.
    edition : of ISO 230-2.
    budgets : what the set-up adds to the uncertainties of axis runs, by axis.
    """

    align: str | None = None
    alignment: Alignment | None = None
    line: str = "ls"
    edition: int = LATEST
    budgets: Mapping[str, Budget] | None = None


@dataclass(frozen=True)
class Agreement:
    """Predicted against measured.

    Parameters
    ----------
    figures : figures of both fields; those of the measured one hold the noise of the measurement.
    difference : figures of measured minus predicted, and the difference at single points decides:
    beyond : share of its components with E_n above 1, (k = 2); nan where an uncertainty is not known.
    allowed : the largest share that chance explains: 5 % and twice its standard deviation for so many components.
    components : how many components were looked at.
    """

    figures: Mapping[str, ComparedFigure]
    difference: Mapping[str, Figure]
    beyond: float
    allowed: float
    components: int

    @property
    def verdict(self) -> Literal["agrees", "disagrees", "unknown"]:
        """Whether measured and predicted errors agree point by point; unknown without uncertainties."""
        if math.isnan(self.beyond):
            return "unknown"
        return "agrees" if self.beyond <= self.allowed else "disagrees"

    def summary(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        figures = {}
        for key, item in self.figures.items():
            figures[key] = {"predicted": item.before.summary(), "measured": item.after.summary(), "en": item.en}
        return {
            "verdict": self.verdict,
            "beyond_en_1": self.beyond,
            "beyond_en_1_allowed": self.allowed,
            "components": self.components,
            "figures": figures,
            "difference": {key: item.summary() for key, item in self.difference.items()},
        }


@dataclass(frozen=True)
class Comparison:
    """Figures before and after by group and key, those that decide, and in words what was compared and how."""

    kind: str
    groups: Mapping[str, Mapping[str, ComparedFigure]]
    decisive: tuple[tuple[str, str], ...]
    statements: tuple[str, ...]
    prediction: Agreement | None = None

    @property
    def verdict(self) -> Overall:
        """Worse if a decisive figure is, else better if one is, else the strongest of the other words."""
        found = [self.groups[group][key].verdict for group, key in self.decisive]
        order: tuple[Overall, ...] = ("worse", "larger", "better", "not separated", "smaller", "same")
        return next((word for word in order if word in found), "same")

    @property
    def improved(self) -> bool:
        """Whether the machine got better: significantly, or smaller where no uncertainty is known."""
        return self.verdict in ("better", "smaller")

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``compare.json``."""
        groups = {name: {key: item.summary() for key, item in group.items()} for name, group in self.groups.items()}
        return {
            "kind": self.kind,
            "verdict": self.verdict,
            "improved": self.improved,
            "decided_by": [f"{group} {key}" for group, key in self.decisive],
            "coverage_factor": COVERAGE,
            "statements": list(self.statements),
            "figures": groups,
            "prediction": None if self.prediction is None else self.prediction.summary(),
        }


def paired_figures(
    before: Mapping[str, Mapping[str, Figure]], after: Mapping[str, Mapping[str, Figure]]
) -> dict[str, dict[str, ComparedFigure]]:
    """Put figures before and after side by side, those that both have."""
    return {
        group: {key: ComparedFigure(item, after[group][key]) for key, item in figures.items() if key in after[group]}
        for group, figures in before.items()
        if group in after
    }


def compare_errors(before: ErrorSource, after: ErrorSource, options: CompareOptions | None = None) -> Comparison:
    """Compare two sets of errors of one machine: per volume, axis, diagonal and error.

    Both are gauge-aligned first (:func:`compgen.accuracy.iso_gauge.in_common_gauge`), so that what no measurement shows does
    not count as a change of single errors. The volume is that of the errors as they are, in the stated alignment, on which
    the gauge has no influence.

    Raises
    ------
    InputError
        for different errors or positions, unless the options say how to align them.
    """
    chosen = options or CompareOptions()
    first, second, text = paired_errors(before, after, chosen.align)
    machine, cut = _known_part(first.machine, first)
    first, second = replace(first, machine=machine), replace(second, machine=machine)
    fields = volume_fields(machine, (first, second), chosen.alignment or "axes")
    gauged = [in_common_gauge(source) for source in (first, second)]
    groups = []
    for (full, pairs), source in zip(fields, gauged, strict=True):
        groups.append({"volume": volume_figures(full, pairs), **groups_of_errors(source, chosen.line)})
    statements = [text, *cut, *statements_of(machine, fields[0][0], chosen.line)]
    statements.append(
        "single errors: AFTER was gauge-aligned to BEFORE (compgen.model.gauge) before they were compared"
    )
    statements += said_of_uncertainty(first.known, second.known)
    decisive = tuple(("volume", key) for key in DECISIVE_VOLUME)
    return Comparison("errors", paired_figures(groups[0], groups[1]), decisive, tuple(statements))


def _known_part(machine: Machine, source: ErrorSource) -> tuple[Machine, list[str]]:
    """Machine with its travel cut to what the curves know, where they end within it."""
    lower, upper = machine.lower_mm, machine.upper_mm
    for name, curve in source.errors.curves.items():
        axis = error_named(name).axis
        if len(curve.position_mm) > 1:
            lower[axis] = max(lower[axis], curve.position_mm[0])
            upper[axis] = min(upper[axis], curve.position_mm[-1])
    if np.allclose(lower, machine.lower_mm) and np.allclose(upper, machine.upper_mm):
        return machine, []
    return narrowed(machine, lower, upper), ["the curves end within the travel; the volume is the part that they know"]


def said_of_uncertainty(*known: bool) -> list[str]:
    """Say what the verdicts rest on; ``known``: whether each side has uncertainties."""
    if all(known):
        return [
            f"uncertainties: k = {COVERAGE:g}; 'better' needs bands that separate (then En > 1); what both measurements "
            "share is counted in both"
        ]
    return ["no uncertainty is known for at least one side: figures are smaller or larger, never 'better' or 'worse'"]


def compare_fields(
    machine: Machine, before: MeasuredField, after: MeasuredField, options: CompareOptions | None = None
) -> Comparison:
    """Compare measured positions point by point; InputError for different points unless aligned."""
    chosen = options or CompareOptions()
    first, second, text = paired_fields(before, after, chosen.align)
    sides = [_aligned(machine, side, chosen.alignment or "as-given") for side in (first, second)]
    groups = [{"volume": _of_measured(side, first.measured)} for side in sides]
    known = [not math.isnan(side.spread(np.ones_like(side.error_mm))) for side in sides]
    statements = [text, f"alignment: {sides[0].alignment}", *_components(first.measured), *said_of_uncertainty(*known)]
    decisive = tuple(("volume", key) for key in DECISIVE_VOLUME)
    return Comparison("positions", paired_figures(groups[0], groups[1]), decisive, tuple(statements))


def _aligned(machine: Machine, side: MeasuredField, alignment: Alignment) -> Field:
    if alignment != "as-given" and not all(side.measured):
        raise InputError(
            "a rigid motion can be taken out only where dx, dy and dz were measured; take --alignment as-given"
        )
    return aligned(machine, side.field, alignment)


def _of_measured(field: Field, measured: tuple[bool, bool, bool]) -> dict[str, Figure]:
    figures = volume_figures(field, _thinned(field))
    gone = {f"V_{axis}" for axis, there in zip("XYZ", measured, strict=True) if not there}
    return {key: item for key, item in figures.items() if key not in gone}


def _components(measured: tuple[bool, bool, bool]) -> list[str]:
    names = [axis for axis, there in zip("xyz", measured, strict=True) if there]
    return [] if all(measured) else [f"only d{', d'.join(names)} were measured; the other components count as zero"]


def _thinned(field: Field, most: int = MOST_IN_PAIRS) -> Field:
    """Every so-manieth point of a large field, for pairs."""
    if len(field) <= most:
        return field
    rows = np.unique(np.round(np.linspace(0, len(field) - 1, most)).astype(int))

    def spread(weight: np.ndarray) -> float:
        full = np.zeros_like(field.error_mm)
        full[rows] = weight
        return field.spread(full)

    parts = {"position_mm": field.position_mm[rows], "tip_mm": field.tip_mm[rows], "error_mm": field.error_mm[rows]}
    return replace(field, spread=spread, **parts)


def compare_runs(
    before: Mapping[str, RunStatistics], after: Mapping[str, RunStatistics], options: CompareOptions | None = None
) -> Comparison:
    """Compare positioning runs axis by axis (ISO 230-2, VDI/DGQ 3441); constants of a set-up drop out of all figures."""
    chosen = options or CompareOptions()
    if chosen.align == "model" or chosen.alignment is not None:
        raise InputError(
            "axis runs have no rigid motion and no model to align by; --align common or interpolate is possible"
        )
    axes = [axis for axis in before if axis in after]
    if set(before) != set(after) and (chosen.align != "common" or not axes):
        raise InputError(
            f"BEFORE holds {', '.join(before)}, AFTER {', '.join(after)}; --align common compares the axes that both hold",
            field="--align",
        )
    pairs = {axis: paired_runs(axis, before[axis], after[axis], chosen.align) for axis in axes}
    sides = [
        accuracy_of_runs({axis: pair[0] for axis, pair in pairs.items()}, chosen.edition, chosen.budgets),
        accuracy_of_runs({axis: pair[1] for axis, pair in pairs.items()}, chosen.edition, chosen.budgets),
    ]
    groups = paired_figures(sides[0].groups, sides[1].groups)
    decisive = tuple((axis, next(key for key in DECISIVE_RUNS if key in groups[axis])) for axis in axes)
    known = [not any(math.isnan(item.before.u + item.after.u) for g in groups.values() for item in g.values())]
    statements = (*(pair[2] for pair in pairs.values()), *sides[0].statements, *said_of_uncertainty(*known))
    return Comparison("axis runs", groups, decisive, statements)


def agreement(predicted: Field, measured: Field) -> Agreement:
    """Compare a predicted field with the measured one at the same points, both aligned alike."""
    first, second = (volume_figures(field, _thinned(field)) for field in (predicted, measured))

    def spread(weight: np.ndarray) -> float:
        return math.hypot(predicted.spread(weight), measured.spread(weight))

    rest = replace(measured, error_mm=measured.error_mm - predicted.error_mm, spread=spread)
    difference = volume_figures(rest, _thinned(rest))
    beyond, count = _share_beyond(_thinned(rest, MOST_SINGLE))
    allowed = CHANCE + 2.0 * math.sqrt(CHANCE * (1.0 - CHANCE) / max(count, 1))
    figures = {key: ComparedFigure(first[key], second[key]) for key in first}
    return Agreement(figures, {key: difference[key] for key in ("max", "rms", "p95")}, beyond, allowed, count)


def _share_beyond(difference: Field) -> tuple[float, int]:
    """Share of the components of a difference beyond its expanded uncertainty, and the number of components."""
    beyond = count = 0
    weight = np.zeros_like(difference.error_mm)
    for index, value in np.ndenumerate(difference.error_mm):
        weight[index] = 1.0
        u = difference.spread(weight)
        weight[index] = 0.0
        if math.isnan(u):
            return math.nan, 0
        if u > EXACT_MM or abs(value) > EXACT_MM:  # the alignment makes some components exactly zero
            count += 1
            beyond += int(abs(value) > COVERAGE * u)
    return beyond / max(count, 1), count
