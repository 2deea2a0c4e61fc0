"""Comparison of before and after, and of predicted and measured: points paired, gauges aligned, changes tested."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from compgen.accuracy.evaluate import (
    LINES,
    MOST_IN_PAIRS,
    Accuracy,
    groups_of_errors,
    narrowed,
    statements_of,
    volume_fields,
)
from compgen.accuracy.field import (
    Alignment,
    ComparedFigure,
    ErrorField,
    ErrorSource,
    Figure,
    Spread,
    aligned,
    independent_spread,
    unknown_spread,
    volume_figures,
)
from compgen.accuracy.positioning import (
    EDITIONS,
    LATEST,
    SAME_CORNER_MM,
    SAME_TARGET_MM,
    DiagonalRun,
    RunStatistics,
    SetupBudget,
    accuracy_of_diagonals,
    accuracy_of_runs,
)
from compgen.data.comparison import normalized_error
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Deviations
from compgen.data.error_table import Curve, ErrorTable, hat_matrix
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import COVERAGE, MM_PER_UM, error_named
from compgen.data.toml_files import option
from compgen.drawing.display import Bars, Drawable, Overview, Panel
from compgen.errors import InputError, Message
from compgen.kinematics.first_order import tool_of
from compgen.kinematics.gauge import common_gauge_part

# The same points before and after: matched, or refused with the difference, or aligned as the user chooses.


#: Ways to align different points.
ALIGN = ("common", "interpolate", "model")
#: Positions closer than this are the same one, mm.
SAME_MM = 1e-3


def refuse(what: str, before: Sequence[object], after: Sequence[object], ways: str) -> InputError:
    """Return the error that says what the two do not have in common."""
    only_before, only_after = [x for x in before if x not in set(after)], [x for x in after if x not in set(before)]
    parts = []
    for name, only in (("BEFORE", only_before), ("AFTER", only_after)):
        if only:
            shown = ", ".join(str(x) for x in only[:3]) + (", ..." if len(only) > 3 else "")
            parts.append(f"only {name} has {shown}")
    return InputError(
        Message(
            "compare-points-differ",
            "BEFORE and AFTER do not have the same {what}: {parts}. A comparison needs the same points; {ways}",
            what=what,
            parts="; ".join(parts),
            ways=ways,
        ),
        field="--align",
    )


# --- errors --------------------------------------------------------------------------------------------------------


def paired_errors(before: ErrorSource, after: ErrorSource, align: str | None) -> tuple[ErrorSource, ErrorSource, str]:
    """Return both sources with the same errors at the same positions, and in words what was done.

    Raises
    ------
    InputError
        if they differ and ``align`` is not given: ``"common"`` keeps the errors and positions that both have,
        ``"interpolate"`` interpolates both linearly at all positions of both within the common range.
    """
    first, second = before.errors, after.errors
    if first.names != second.names and align != "common":
        ways = "--align common compares the errors that both have"
        raise refuse("errors", first.names, second.names, ways)
    same = all(
        _same(first.curves[n].position_mm, second.curves[n].position_mm) for n in first.curves if n in second.curves
    )
    if same and first.names == second.names:
        return before, after, "same errors at the same positions"
    names = [name for name in first.names if name in second.names]
    if not names:
        raise refuse("errors", first.names, second.names, "they have none in common")
    if not same and align not in ("common", "interpolate"):
        name = next(
            n
            for n in names
            if n in first.curves and not _same(first.curves[n].position_mm, second.curves[n].position_mm)
        )
        texts = [[f"{x:g} mm" for x in table.curves[name].position_mm] for table in (first, second)]
        ways = "--align interpolate compares both at all positions of both, --align common at those that both have"
        raise refuse(Message("positions-of-error", "positions of {name}", name=name), texts[0], texts[1], ways)
    nodes = {
        name: _joined(first.curves[name], second.curves[name], str(align)) for name in names if name in first.curves
    }
    text = (
        "interpolated linearly at all positions of both within the common range"
        if align == "interpolate"
        else (f"only what both have: {', '.join(names)}, at common positions")
    )
    return resampled(before, names, nodes), resampled(after, names, nodes), text


def _same(first: FloatArray, second: FloatArray) -> bool:
    return len(first) == len(second) and bool(np.all(np.abs(first - second) <= SAME_MM))


def _joined(first: Curve, second: Curve, align: str) -> FloatArray:
    low = max(first.position_mm[0], second.position_mm[0])
    high = min(first.position_mm[-1], second.position_mm[-1])
    near = np.abs(first.position_mm[:, None] - second.position_mm[None]).min(axis=1) <= SAME_MM
    kept = first.position_mm[near]
    if align == "interpolate":
        both = np.unique(np.concatenate([first.position_mm, second.position_mm]))
        both = both[np.concatenate([[True], np.diff(both) > SAME_MM])]
        kept = both[(both >= low) & (both <= high)]
    if len(kept) == 0:
        raise InputError(
            Message("compare-no-common-position", "BEFORE and AFTER have no position in common"), field="--align"
        )
    return np.asarray(kept)


def resampled(source: ErrorSource, names: Sequence[str], nodes_mm: dict[str, FloatArray]) -> ErrorSource:
    """Return some errors of a source, interpolated linearly at new positions; with the covariance."""
    curves, squareness, factors = {}, {}, []
    for name, rows in source.errors.rows().items():
        if name not in names:
            continue
        old = source.errors.curves.get(name)
        matrix = np.eye(1) if old is None else hat_matrix(old.position_mm, nodes_mm[name])
        factor = None if source.factor is None else matrix @ source.factor[rows]
        if old is None:
            squareness[name] = source.errors.squareness[name]
        else:
            u = np.full(len(matrix), np.nan) if factor is None else np.linalg.norm(factor, axis=1)
            curves[name] = Curve(nodes_mm[name], matrix @ old.value, u)
        factors.append(factor)
    known = [part for part in factors if part is not None]
    factor = np.vstack(known) if len(known) == len(factors) else None
    return replace(source, errors=ErrorTable(curves, squareness, source.errors.metadata), factor=factor)


# --- measured positions --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MeasuredField:
    """Deviations as a field, repeats averaged; ``keys`` identify the points, ``measured`` the components (3,)."""

    field: ErrorField
    keys: tuple[tuple[float, ...], ...]
    measured: tuple[bool, bool, bool]

    def at(self, keys: Sequence[tuple[float, ...]]) -> MeasuredField:
        """Return the field at some of its points, in the given order."""
        index = {key: k for k, key in enumerate(self.keys)}
        rows = np.array([index[key] for key in keys], dtype=np.int64)
        return MeasuredField(self.field.at_rows(rows), tuple(keys), self.measured)


def measured_field(machine: Machine, deviations: Deviations, u_um: float | None = None) -> MeasuredField:
    """Return measured deviations as a field over distinct points: position, tool, direction of approach.

    Parameters
    ----------
    machine : its tool offset is used if the file has none.
    deviations : the measurement; repeats at a point are averaged.
    u_um : standard uncertainty of each component in um; default: that of the file, otherwise from the scatter of
        repeats (pooled), otherwise unknown.
    """
    tool = tool_of(machine, deviations.tool_mm)
    tools = np.broadcast_to(tool, deviations.position_mm.shape)
    approach = np.zeros_like(tools) if deviations.approach is None else deviations.approach
    place = np.round(np.hstack([deviations.position_mm, tools]) / SAME_MM) * SAME_MM + 0.0
    keys, index = np.unique(np.hstack([place, approach]), axis=0, return_inverse=True)
    index = np.asarray(index, dtype=np.int64).ravel()
    count = np.bincount(index).astype(np.float64)[:, None]
    error, position, tip = (
        _means(index, values, count)
        for values in (np.nan_to_num(deviations.deviation_mm), deviations.position_mm, deviations.position_mm + tools)
    )
    spread: Spread = unknown_spread
    freedom = len(index) - len(count)
    if u_um is not None:
        spread = independent_spread(np.broadcast_to(u_um * MM_PER_UM / np.sqrt(count), error.shape))
    elif deviations.u_mm is not None:
        squares = _means(index, np.nan_to_num(deviations.u_mm) ** 2, count)
        spread = independent_spread(np.sqrt(squares / count))
    elif freedom > 0:
        rest = np.nan_to_num(deviations.deviation_mm) - error[index]
        pooled = np.sqrt(np.sum(rest**2, axis=0) / freedom)
        spread = independent_spread(pooled / np.sqrt(count))
    x, y, z = (not np.isnan(deviations.deviation_mm[:, k]).all() for k in range(3))
    return MeasuredField(ErrorField(position, tip, error, spread), tuple(map(tuple, keys.tolist())), (x, y, z))


def _means(index: NDArray[np.int64], values: FloatArray, count: FloatArray) -> FloatArray:
    sums = np.column_stack([np.bincount(index, values[:, k], len(count)) for k in range(3)])
    return np.asarray(sums / count)


def paired_fields(
    before: MeasuredField, after: MeasuredField, align: str | None
) -> tuple[MeasuredField, MeasuredField, str]:
    """Return both at the same points; InputError if they differ and ``align`` is not ``"common"``."""
    if before.measured != after.measured:
        raise InputError(
            Message(
                "compare-components-differ",
                "BEFORE and AFTER do not measure the same components dx, dy, dz; measure the same, or identify both",
            )
        )
    known = set(after.keys)
    common = [key for key in before.keys if key in known]
    same = len(common) == len(before.keys) == len(after.keys)
    if not same and align != "common" or not common:
        texts = [[_shown(key) for key in side.keys] for side in (before, after)]
        ways = "--align common compares those that both have, --align model compares the errors identified from each"
        raise refuse("points", texts[0], texts[1], ways)
    text = f"same {len(common)} points" if same else f"only the {len(common)} points that both have"
    return before.at(common), after.at(common), text


def _shown(key: tuple[float, ...]) -> str:
    x, y, z = key[:3]
    ways = [f"{value:+.0f}" for value in key[6:]]
    return f"({x:g}, {y:g}, {z:g}) mm" + (f" from {','.join(ways)}" if any(key[6:]) else "")


def check_same_positions(before: Lengths, after: Lengths, align: str | None) -> str:
    """Compare tracer lengths to the same targets: stations may differ, positions only if ``align`` is ``"model"``."""
    sets = []
    for lengths in (before, after):
        tools = np.zeros_like(lengths.position_mm) if lengths.tool_mm is None else lengths.tool_mm
        place = np.unique(np.round(np.hstack([lengths.position_mm, tools]) / SAME_MM) * SAME_MM + 0.0, axis=0)
        sets.append([f"({x:g}, {y:g}, {z:g}) mm" for x, y, z, *_ in place.tolist()])
    if sets[0] == sets[1]:
        return f"lengths to the same {len(sets[0])} positions"
    if align != "model":
        ways = "--align model compares the errors identified from each over the volume of the machine"
        raise refuse("positions", sets[0], sets[1], ways)
    return "lengths to different positions: the errors identified from each are compared"


# --- positioning runs ----------------------------------------------------------------------------------------------


def paired_runs(
    axis: str, before: RunStatistics, after: RunStatistics, align: str | None
) -> tuple[RunStatistics, RunStatistics, str]:
    """Return both at the same targets.

    ``"common"`` keeps the targets that both have; ``"interpolate"`` interpolates means and estimators of AFTER at the
    targets of BEFORE within its range.
    """
    first, second = before.position_mm, after.position_mm
    if len(first) == len(second) and bool(np.all(np.abs(first - second) <= SAME_TARGET_MM)):
        return before, after, f"{axis}: same {len(first)} targets"
    if align == "common":
        near = np.abs(first[:, None] - second[None]) <= SAME_TARGET_MM
        rows, columns = np.nonzero(near)
        if len(rows) < 2:
            raise InputError(
                Message(
                    "compare-few-targets",
                    "{axis}: BEFORE and AFTER have {rows} targets in common; at least two are needed",
                    axis=axis,
                    rows=len(rows),
                ),
                field="--align",
            )
        return _picked(before, rows), _picked(after, columns), f"{axis}: the {len(rows)} targets that both have"
    if align == "interpolate":
        rows = np.flatnonzero((first >= second[0]) & (first <= second[-1]))
        if len(rows) < 2:
            raise InputError(
                Message("compare-few-within", "{axis}: fewer than two targets of BEFORE are within AFTER", axis=axis),
                field="--align",
            )
        at = first[rows]
        values = np.vstack([np.interp(at, second, row) for row in after.values])
        count = np.vstack([np.interp(at, second, row) for row in after.count])
        text = f"{axis}: AFTER interpolated at {len(rows)} targets of BEFORE"
        return _picked(before, rows), RunStatistics(at, values, count), text
    texts = [[f"{x:g} mm" for x in side] for side in (first, second)]
    ways = (
        "--align common compares the targets that both have, --align interpolate interpolates AFTER at those of BEFORE"
    )
    raise refuse(Message("targets-of-axis", "targets of {axis}", axis=axis), texts[0], texts[1], ways)


def _picked(statistics: RunStatistics, rows: np.ndarray) -> RunStatistics:
    return RunStatistics(statistics.position_mm[rows], statistics.values[:, rows], statistics.count[:, rows])


# One gauge for all tables that are compared: what no measurement can show must not count as a change.
#
# Constants and slopes of curves are interchangeable with squareness and a placement of the workpiece, without any
# effect on the machine (:mod:`compgen.kinematics.gauge`). Both sides of a comparison are brought to the same choice:
# straightness zero at both ends of the travel, positioning and angular errors zero at the reference point, the rest in
# the squareness.


def in_common_gauge(source: ErrorSource) -> ErrorSource:
    """Return the source in the common gauge: the same E = C P up to a rigid motion; with the covariance.

    Angular errors that one tool does not show are left unchanged: they are known from another source.
    """
    errors, factor = source.errors, source.factor
    values, part = errors.values(), common_gauge_part(source.machine, errors)
    factor = None if factor is None else factor - part @ factor
    return replace(source, errors=errors.with_values(values - part @ values), factor=factor)


# Before and after, predicted and measured: improvement with its significance.


Overall = Literal["better", "worse", "not separated", "smaller", "larger", "same"]
#: Decisive figures of a volume, of axis runs (the first available), and of errors of single axes.
DECISIVE_VOLUME = ("rms", "max")
#: Share of components beyond k = 2 by chance, points at which components are tested one by one, and what counts as 0.
CHANCE, MOST_SINGLE, EXACT_MM = 0.05, 300, 1e-9
DECISIVE_RUNS = ("A", "E", "A_up", "A_down", "E_up", "E_down")
#: A positioning test of an axis or of a diagonal.
_Test = TypeVar("_Test")


@dataclass(frozen=True)
class CompareOptions:
    """How to compare.

    Parameters
    ----------
    align : how to align different points: ``"common"``, ``"interpolate"``, ``"model"``; None refuses them.
    alignment : of the volume; None is ``"axes"`` for errors, ``"as-given"`` for measured positions.
    line : reference line of straightness and squareness.
    edition : of ISO 230-2.
    budgets : contribution of the set-up to the uncertainties of axis runs, by axis.
    """

    align: str | None = option(
        None,
        "How to align different points: common keeps those that both have, interpolate interpolates linearly, "
        "model compares the errors identified from each. Default: different points are refused.",
        choices=ALIGN,
    )
    alignment: Alignment | None = option(
        None,
        "Volume: axes (default for errors): zero at the reference point, X and Y along their end points; as-given "
        "(default for measured positions).",
        choices=("as-given", "axes"),
    )
    line: str = option("ls", "Reference line of straightness.", choices=tuple(LINES))
    edition: int = option(
        LATEST, "Edition of ISO 230-2; that of 1988 has 3 s instead of 2 s.", choices=tuple(map(str, EDITIONS))
    )
    budgets: Mapping[str, SetupBudget] | None = None


@dataclass(frozen=True)
class PredictionAgreement:
    """Predicted against measured.

    Parameters
    ----------
    figures : figures of both fields; those of the measured one include the noise of the measurement.
    difference : figures of measured minus predicted; the difference at single points decides.
    beyond : share of its components with E_n above 1, (k = 2); nan if an uncertainty is unknown.
    allowed : the largest share that chance explains: 5 % and twice its standard deviation for that many components.
    components : how many components were tested.
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


@dataclass(frozen=True, repr=False)
class Comparison(Drawable):
    """Figures before and after by group and key, the decisive ones, and in words what was compared and how."""

    kind: str
    groups: Mapping[str, Mapping[str, ComparedFigure]]
    decisive: tuple[tuple[str, str], ...]
    statements: tuple[str, ...]
    prediction: PredictionAgreement | None = None

    @property
    def verdict(self) -> Overall:
        """Worse if a decisive figure is, otherwise better if one is, otherwise the strongest of the other words."""
        found = [self.groups[group][key].verdict for group, key in self.decisive]
        order: tuple[Overall, ...] = ("worse", "larger", "better", "not separated", "smaller", "same")
        return next((word for word in order if word in found), "same")

    @property
    def improved(self) -> bool:
        """Whether the machine improved: significantly, or with smaller figures if no uncertainty is known."""
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

    def overview(self) -> Overview:
        """All figures before and after, and which became better."""
        rows = tuple(
            (f"{group} {key}", f"{x.before.value:.3f}", f"{x.after.value:.3f}", x.before.unit, x.verdict)
            for group, figures in self.groups.items()
            for key, x in figures.items()
        )
        title = f"{self.kind}: {self.verdict}, {len(rows)} figures before and after"
        return Overview(title, ("figure", "before", "after", "unit", "verdict"), rows, self.statements)

    def panels(self) -> Sequence[Panel]:
        """The figures of each group before and after, um and urad apart."""
        panels = []
        for group, figures in self.groups.items():
            for unit in ("um", "urad"):
                shown = {key: item for key, item in figures.items() if item.before.unit == unit}
                if shown:
                    before = Bars("before", tuple(shown), tuple(item.before.value for item in shown.values()))
                    after = Bars("after", tuple(shown), tuple(item.after.value for item in shown.values()))
                    panels.append(Panel(group, unit, bars=(before, after)))
        return panels


def paired_figures(
    before: Mapping[str, Mapping[str, Figure]], after: Mapping[str, Mapping[str, Figure]]
) -> dict[str, dict[str, ComparedFigure]]:
    """Pair the figures before and after that both have."""
    return {
        group: {key: ComparedFigure(item, after[group][key]) for key, item in figures.items() if key in after[group]}
        for group, figures in before.items()
        if group in after
    }


def compare_errors(before: ErrorSource, after: ErrorSource, options: CompareOptions | None = None) -> Comparison:
    """Compare two sets of errors of one machine: per volume, axis, diagonal and error.

    Both are gauge-aligned first (:func:`compgen.accuracy.compare.in_common_gauge`), so that what no measurement shows
    does not count as a change of single errors. The volume is evaluated from the unchanged errors, in the stated
    alignment, which the gauge does not affect.

    Raises
    ------
    InputError
        for different errors or positions, unless the options say how to align them.
    """
    chosen = options or CompareOptions()
    first, second, text = paired_errors(before.measured, after.measured, chosen.align)
    machine, cut = first.machine, []
    lower, upper = machine.lower_mm, machine.upper_mm
    for name, curve in first.errors.curves.items():
        axis = error_named(name).axis
        if len(curve.position_mm) > 1:
            lower[axis] = max(lower[axis], curve.position_mm[0])
            upper[axis] = min(upper[axis], curve.position_mm[-1])
    if not (np.allclose(lower, machine.lower_mm) and np.allclose(upper, machine.upper_mm)):
        machine = narrowed(machine, lower, upper)
        cut.append("the curves end within the travel; the volume is the part that they cover")
    first, second = replace(first, machine=machine), replace(second, machine=machine)
    fields = volume_fields(machine, (first, second), chosen.alignment or "axes")
    gauged = [in_common_gauge(source) for source in (first, second)]
    groups = []
    for (full, pairs), source in zip(fields, gauged, strict=True):
        groups.append({"volume": volume_figures(full, pairs), **groups_of_errors(source, chosen.line)})
    statements = [text, *cut, *statements_of(machine, fields[0][0], chosen.line)]
    statements.append(
        "single errors: AFTER was gauge-aligned to BEFORE (compgen.kinematics.gauge) before they were compared"
    )
    statements += uncertainty_statements(first.known, second.known)
    decisive = tuple(("volume", key) for key in DECISIVE_VOLUME)
    return Comparison("errors", paired_figures(groups[0], groups[1]), decisive, tuple(statements))


def uncertainty_statements(*known: bool) -> list[str]:
    """Return the basis of the verdicts; ``known``: whether each side has uncertainties."""
    if all(known):
        return [
            f"uncertainties: k = {COVERAGE:g}; 'better' requires intervals that do not overlap (then En > 1); "
            "contributions common to both measurements are counted in both"
        ]
    return ["no uncertainty is known for at least one side: figures are smaller or larger, never 'better' or 'worse'"]


def compare_fields(
    machine: Machine, before: MeasuredField, after: MeasuredField, options: CompareOptions | None = None
) -> Comparison:
    """Compare measured positions point by point; InputError for different points that are not aligned."""
    chosen = options or CompareOptions()
    first, second, text = paired_fields(before, after, chosen.align)
    alignment, measured = chosen.alignment or "as-given", first.measured
    if alignment != "as-given" and not all(measured):
        raise InputError(
            Message(
                "rigid-motion-needs-all",
                "a rigid motion can be removed only if dx, dy and dz were measured; use --alignment as-given",
            )
        )
    sides = [aligned(machine, side.field, alignment) for side in (first, second)]
    gone = [f"V_{axis}" for axis, there in zip("XYZ", measured, strict=True) if not there]
    groups = []
    for side in sides:
        figures = volume_figures(side, side.thinned(MOST_IN_PAIRS))
        groups.append({"volume": {key: item for key, item in figures.items() if key not in gone}})
    known = [not math.isnan(side.spread(np.ones_like(side.error_mm))) for side in sides]
    statements = [text, f"alignment: {sides[0].alignment}"]
    if gone:
        names = ", ".join(f"d{axis}" for axis, there in zip("xyz", measured, strict=True) if there)
        statements.append(
            f"only {names} were measured; of the other components nothing is known, and the figures leave them out"
        )
    statements += uncertainty_statements(*known)
    decisive = tuple(("volume", key) for key in DECISIVE_VOLUME)
    return Comparison("positions", paired_figures(groups[0], groups[1]), decisive, tuple(statements))


def compare_runs(
    before: Mapping[str, RunStatistics], after: Mapping[str, RunStatistics], options: CompareOptions | None = None
) -> Comparison:
    """Compare positioning runs axis by axis (ISO 230-2, VDI/DGQ 3441); constants of a set-up cancel in all figures."""
    return _compare_tests(
        ("axis runs", "axes"), before, after, options or CompareOptions(), paired_runs, accuracy_of_runs
    )


def _compare_tests(
    what: tuple[str, str],
    before: Mapping[str, _Test],
    after: Mapping[str, _Test],
    options: CompareOptions,
    pair: Callable[[str, _Test, _Test, str | None], tuple[_Test, _Test, str]],
    evaluate: Callable[[Mapping[str, _Test], int, Mapping[str, SetupBudget] | None], Accuracy],
) -> Comparison:
    """Compare tests of the axes or diagonals that both sides have."""
    if options.align == "model" or options.alignment is not None:
        raise InputError(
            Message(
                "compare-no-alignment",
                "{what} cannot be aligned by a rigid motion or a model; use --align common or interpolate",
                what=what[0],
            )
        )
    names = [name for name in before if name in after]
    if set(before) != set(after) and (options.align != "common" or not names):
        raise InputError(
            Message(
                "compare-counts-differ",
                "BEFORE has {before}, AFTER {after}; --align common compares the {what} that both have",
                before=", ".join(before),
                after=", ".join(after),
                what=what[1],
            ),
            field="--align",
        )
    pairs = {name: pair(name, before[name], after[name], options.align) for name in names}
    first = evaluate({name: item[0] for name, item in pairs.items()}, options.edition, options.budgets)
    second = evaluate({name: item[1] for name, item in pairs.items()}, options.edition, options.budgets)
    groups = paired_figures(first.groups, second.groups)
    # Ed and Bd of the diagonals decide; without them the first available figure of each axis or diagonal
    decisive = tuple(("diagonals", key) for key in groups.get("diagonals", {}))
    if not decisive:
        decisive = tuple((name, next(key for key in DECISIVE_RUNS if key in groups[name])) for name in names)
    known = not any(math.isnan(item.before.u + item.after.u) for group in groups.values() for item in group.values())
    statements = (*(item[2] for item in pairs.values()), *first.statements, *uncertainty_statements(known))
    return Comparison(what[0], groups, decisive, statements)


def agreement(predicted: ErrorField, measured: ErrorField) -> PredictionAgreement:
    """Compare a predicted field with the measured one at the same points, in the same alignment."""
    first, second = (volume_figures(field, field.thinned(MOST_IN_PAIRS)) for field in (predicted, measured))

    def spread(weight: np.ndarray) -> float:
        return math.hypot(predicted.spread(weight), measured.spread(weight))

    rest = replace(measured, error_mm=measured.error_mm - predicted.error_mm, spread=spread)
    difference = volume_figures(rest, rest.thinned(MOST_IN_PAIRS))
    looked_at = rest.thinned(MOST_SINGLE)
    weight, u = np.zeros_like(looked_at.error_mm), np.zeros_like(looked_at.error_mm)
    for index in np.ndindex(weight.shape):
        weight[index] = 1.0
        u[index] = looked_at.spread(weight)
        weight[index] = 0.0
    beyond, count = math.nan, 0
    if not np.isnan(u).any():
        counted = (u > EXACT_MM) | (np.abs(looked_at.error_mm) > EXACT_MM)  # the alignment makes some exactly zero
        count = int(counted.sum())
        above = normalized_error(looked_at.error_mm, COVERAGE * u)[counted] > 1.0
        beyond = int(above.sum()) / max(count, 1)
    allowed = CHANCE + 2.0 * math.sqrt(CHANCE * (1.0 - CHANCE) / max(count, 1))
    figures = {key: ComparedFigure(first[key], second[key]) for key in first}
    return PredictionAgreement(figures, {key: difference[key] for key in ("max", "rms", "p95")}, beyond, allowed, count)


# Measured diagonals before and after (ISO 230-6).


def compare_diagonals(
    machine: Machine,
    before: Mapping[str, DiagonalRun],
    after: Mapping[str, DiagonalRun],
    options: CompareOptions | None = None,
) -> Comparison:
    """Compare measured diagonals; Ed and Bd decide, or E of every diagonal if not all four were measured.

    Raises
    ------
    InputError
        for different diagonals or positions, unless the options say how to align them (``common``, ``interpolate``).
    """
    chosen, evaluate = options or CompareOptions(), partial(accuracy_of_diagonals, machine)
    return _compare_tests(("diagonals", "diagonals"), before, after, chosen, _paired, evaluate)


def _paired(
    name: str, before: DiagonalRun, after: DiagonalRun, align: str | None
) -> tuple[DiagonalRun, DiagonalRun, str]:
    """Return both at the same positions; distances of AFTER are counted from the start of BEFORE."""
    offset = after.start_mm - before.start_mm
    along = float(offset @ before.unit)
    across = [offset - along * before.unit, after.end_mm - before.end_mm]
    across[1] = across[1] - (across[1] @ before.unit) * before.unit
    if max(float(np.linalg.norm(part)) for part in across) > SAME_CORNER_MM:
        message = f"{name} is a different line in AFTER; measure it between the same ends"
        raise InputError(message, field=f"diagonal {name}")
    moved = replace(after.statistics, position_mm=after.statistics.position_mm + along)
    first, second, text = paired_runs(name, before.statistics, moved, align)
    ends = [before.start_mm + first.position_mm[k] * before.unit for k in (0, -1)]
    sides = [replace(run, start_mm=ends[0], end_mm=ends[1]) for run in (before, after)]
    return replace(sides[0], statistics=first), replace(sides[1], statistics=second), text
